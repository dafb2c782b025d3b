//! Local reference frames and the accumulator against their naive twins and laws; what `hough3d` makes of frames that
//! are given, and of those it computes; which frames are refused.

use ibi_core::kernels::frames::{frame, frames};
use ibi_core::kernels::hough::{peak, shares};
use ibi_core::kernels::nearby::Nearby;
use ibi_core::nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Vector3};
use ibi_core::stages::ce::Voting;
use ibi_core::stages::scs::Hough3d;
use ibi_core::{Argument, Cloud, Correspondences, Error, Params, Registrar, Registration};
use ibi_testkit::scenes::{Recipe, Scene};
use ibi_testkit::strategies::rigid_motions;
use ibi_testkit::{Rng, naive};
use proptest::prelude::*;

/// Points without any order, so that few decisions hang on rounding.
fn scattered(count: std::ops::Range<usize>) -> impl Strategy<Value = Vec<Point3<f64>>> {
    prop::collection::vec(prop::array::uniform3(-1.0..1.0_f64).prop_map(Point3::from), count)
}

/// Frames whose decisions are closer than this are not compared.
const MARGIN: f64 = 1e-4;

proptest! {
    #[test]
    fn a_frame_is_its_twin(points in scattered(1..60), radius in 0.3..3.0_f64) {
        let centre = points[0];
        let fast = frame(&centre, points.iter().copied(), radius);
        match naive::frame(&points, &centre, radius) {
            Some((slow, margin)) if margin > MARGIN => {
                let fast = fast.unwrap();
                prop_assert!((fast - slow).amax() < 1e-9 / margin, "{fast} {slow}");
            }
            Some(_) => {}
            None => prop_assert!(fast.is_none()),
        }
    }

    #[test]
    fn a_frame_is_a_rotation_and_turns_with_the_cloud(
        points in scattered(5..60), motion in rigid_motions(10.0), unit in 0.01..100.0_f64,
    ) {
        let Some(here) = frame(&points[0], points.iter().copied(), 1.5) else { return Ok(()) };
        prop_assert!((here * here.transpose()).is_identity(1e-9) && here.determinant() > 0.0);
        let moved: Vec<Point3<f64>> = points.iter().map(|p| (motion * p) * unit).collect();
        let there = frame(&moved[0], moved.iter().copied(), 1.5 * unit);
        let (_, margin) = naive::frame(&points, &points[0], 1.5).unwrap();
        if margin > MARGIN {
            let expected = here * motion.rotation.to_rotation_matrix().matrix().transpose();
            prop_assert!((there.unwrap() - expected).amax() < 1e-7 / margin);
        }
    }

    #[test]
    fn frames_find_the_neighbours_that_there_are(points in scattered(1..80), radius in 0.1..1.0_f64) {
        let rows: Vec<u32> = (0..points.len() as u32).step_by(3).collect();
        let all = frames(&points, &Nearby::new(&points, 0.2), &rows, radius, || false);
        prop_assert_eq!(all.len(), rows.len());
        for (&row, fast) in rows.iter().zip(all) {
            match naive::frame(&points, &points[row as usize], radius) {
                Some((slow, margin)) if margin > MARGIN => {
                    prop_assert!((fast.unwrap() - slow).amax() < 1e-9 / margin);
                }
                _ => {}
            }
        }
    }

    #[test]
    fn a_vote_is_shared_out_whole(place in prop::array::uniform3(-1e3..1e3_f32), width in 0.1..10.0_f32) {
        let all: Vec<_> = shares(place, width).collect();
        let sum: f32 = all.iter().map(|&(_, share)| share).sum();
        prop_assert!((sum - 1.0).abs() < 1e-5 && all.iter().all(|&(_, share)| share >= 0.0));
        for (cell, share) in all {
            let expected = naive::hough_shares(&[place.map(f64::from)], cell.map(i64::from), width.into());
            // 6e-8 of a coordinate of 1e3, in cells of 0.1.
            prop_assert!((f64::from(share) - expected[0]).abs() < 5e-3);
        }
    }

    #[test]
    fn the_peak_is_the_cell_that_gathers_most(places in prop::collection::vec(prop::array::uniform3(-4.0..4.0_f32), 0..60)) {
        let votes: Vec<(u32, [f32; 3])> = (0_u32..).step_by(2).zip(places.iter().copied()).collect();
        let found = peak(&votes, 1.0, || false);
        let places: Vec<[f64; 3]> = places.iter().map(|place| place.map(f64::from)).collect();
        let range = -6..6_i64;
        let cells = range.clone().flat_map(|x| range.clone().flat_map(move |y| (-6..6).map(move |z| [x, y, z])));
        let all: Vec<Vec<f64>> = cells.map(|cell| naive::hough_shares(&places, cell, 1.0)).collect();
        let most = all.iter().map(|shares| shares.iter().sum::<f64>()).fold(0.0, f64::max);
        let sum: f64 = found.iter().map(|&(_, share)| f64::from(share)).sum();
        prop_assert!((sum - most).abs() < 1e-4, "{sum} {most}");
        // The voters are those of one cell.
        let mut mine = vec![0.0; places.len()];
        for (voter, share) in &found {
            mine[*voter as usize / 2] = f64::from(*share);
        }
        let is_mine = |shares: &Vec<f64>| shares.iter().zip(&mine).all(|(a, b)| (a - b).abs() < 1e-5);
        prop_assert!(all.iter().any(is_mine));
        prop_assert!(found.is_sorted_by(|a, b| a.0 < b.0));
    }
}

#[test]
fn no_frame_where_no_direction_is_special() {
    let line: Vec<Point3<f64>> = (0..20).map(|i| Point3::new(f64::from(i), 0.0, 0.0)).collect();
    assert!(frame(&line[5], line.iter().copied(), 10.0).is_none());
    let same = vec![Point3::new(1.0, 2.0, 3.0); 20];
    assert!(frame(&same[0], same.iter().copied(), 1.0).is_none());
    let few = [Point3::origin(), Point3::new(1.0, 0.0, 0.0), Point3::new(0.0, 0.5, 0.1)];
    assert!(frame(&few[0], few.iter().copied(), 2.0).is_none());
}

#[test]
fn votes_from_far_away_end_somewhere_or_nowhere() {
    let votes = |place: [f32; 3]| (0..5).map(|voter| (voter, place)).collect::<Vec<_>>();
    assert_eq!(peak(&votes([3e20, f32::MAX, -f32::MAX]), 1.0, || false).len(), 5);
    // Beyond the floats is nowhere.
    assert!(peak(&votes([1.0, f32::MAX, -2.0]), 1e-9, || false).is_empty());
    assert!(peak(&[], 1.0, || false).is_empty());
    assert!(peak(&votes([1.0; 3]), 1.0, || true).is_empty());
}

// --------------------------------------------------------------------------------------------------- the stage

fn scene() -> Scene {
    Recipe { num_points: 200, true_pairs: 120, num_outliers: 300, ..Recipe::default() }.build()
}

fn params() -> Params {
    let ce = Voting { n_vot: 100 }.into();
    Params { scs: Hough3d::default().into(), ce, t_he_pr: 1.0, d_op_pr: 0.5, ..Params::paper_synthetic() }
}

/// Those of the source, those of the target.
type Frames = [Vec<Matrix3<f64>>; 2];

fn run(scene: &Scene, frames: Option<Frames>) -> Result<Registration, Error> {
    let (mut source, mut target) = (Cloud::new(&scene.source), Cloud::new(&scene.target));
    if let Some([of_source, of_target]) = frames {
        (source, target) = (source.with_frames(of_source), target.with_frames(of_target));
    }
    Registrar::new(&source)?
        .params(params())
        .num_threads(1)
        .register(&target, &Correspondences::from_rows(scene.rows.clone()))
}

/// Any frame at each source point; at each target point the same frame moved, or any frame where nothing was moved.
fn exact_frames(scene: &Scene) -> Frames {
    let mut rng = Rng::new(3);
    let mut any = || *rng.pose_at(Vector3::zeros()).rotation.to_rotation_matrix().matrix();
    let source: Vec<Matrix3<f64>> = scene.source.iter().map(|_| any()).collect();
    let turned = |pose: &Isometry3<f64>| {
        let back = pose.rotation.to_rotation_matrix().matrix().transpose();
        source.iter().map(|frame| frame * back).collect::<Vec<_>>()
    };
    let mut target: Vec<Matrix3<f64>> = scene.truth.iter().flat_map(turned).collect();
    target.resize_with(scene.target.len(), any);
    [source, target]
}

fn hits(scene: &Scene, result: &Registration) -> usize {
    let poses: Vec<_> = result.poses.iter().map(|pose| pose.target_from_source).collect();
    scene.hits(&poses, 0.1, 0.1)
}

#[test]
fn instances_are_found_with_frames_of_either_origin() {
    let scene = scene();
    let computed = run(&scene, None).unwrap();
    assert_eq!(hits(&scene, &computed), 2, "{}", computed.stop_reason);
    let given = run(&scene, Some(exact_frames(&scene))).unwrap();
    assert_eq!(hits(&scene, &given), 2, "{}", given.stop_reason);
    // With exact frames all true pairs of an instance vote for one place; some wrong ones do, by chance.
    assert!((120..200).contains(&given.rounds[0].num_seeds), "{} seeds", given.rounds[0].num_seeds);
}

#[test]
fn frames_must_fit() {
    let scene = scene();
    let good = exact_frames(&scene);
    let with = |change: &dyn Fn(&mut Frames)| {
        let mut frames = good.clone();
        change(&mut frames);
        run(&scene, Some(frames)).err().map(|error| error.to_string())
    };
    assert_eq!(with(&|_| {}), None);
    let rounded = |frame: &mut Matrix3<f64>| *frame = frame.map(|x| f64::from(x as f32));
    assert_eq!(with(&|frames| frames.iter_mut().flatten().for_each(rounded)), None);
    let short = "tgt_frames has 449 rows; it must have one for each of the 450 rows of tgt";
    assert_eq!(with(&|frames| frames[1].truncate(449)).as_deref(), Some(short));
    for bad in [
        Matrix3::zeros(),
        -Matrix3::identity(),
        Matrix3::identity() * 1.01,
        Matrix3::from_element(f64::NAN),
        Rotation3::identity().matrix() + Matrix3::from_element(0.01),
    ] {
        let message = "src_frames[7] is no rotation; its rows must be orthonormal to 1e-3 and right-handed";
        assert_eq!(with(&|frames| frames[0][7] = bad).as_deref(), Some(message));
    }
    let source = Cloud::new(&scene.source).with_frames(good[0].clone());
    let error = Registrar::new(&source)
        .unwrap()
        .params(params())
        .register(&Cloud::new(&scene.target), &Correspondences::from_rows(scene.rows.clone()))
        .unwrap_err();
    assert_eq!(error, Error::FramesOfOneCloud { given: Argument::SrcFrames, missing: Argument::TgtFrames });
    assert_eq!(
        error.to_string(),
        "src_frames is given but tgt_frames is not; give frames for both clouds or for neither"
    );
}
