//! Refinement and overlap: where source points come to lie, what iterative closest points make of a pose, and
//! who may claim a scene point.

use crate::mock::Mock;
use crate::oriented::{Oriented, clouds, seen_from};
use ibi_core::kernels::icp::{Stop, icp};
use ibi_core::kernels::nearby::Nearby;
use ibi_core::kernels::overlap::{Contact, MIN_FACING_COS, Place, Surface, overlap, overlap_of, places};
use ibi_core::kernels::par::Pool;
use ibi_core::nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use ibi_core::stages::hv::{Hv, Overlap};
use ibi_core::stages::scs::LocalGtm;
use ibi_core::stages::te::Irls;
use ibi_core::stages::{Context, Estimate, EstimatePose, Hypothesis, Ranked, Verdict};
use ibi_core::{Cloud, Correspondences, Params, Pose, Refine, Registrar, Removal};
use ibi_testkit::Rng;
use ibi_testkit::naive;
use ibi_testkit::scenes::asymmetric_model;
use ibi_testkit::strategies::{points, rigid_motions};
use proptest::prelude::*;

fn contact(distance: f64, viewpoint: Option<Point3<f64>>) -> Contact<'static> {
    Contact {
        distance,
        min_normal_cos: 0.5,
        oriented: true,
        view: viewpoint.map(seen_from),
        to_planes: false,
    }
}

fn viewpoints() -> impl Strategy<Value = Option<Point3<f64>>> {
    let far = prop::array::uniform3(-50.0..50.0).prop_map(|p| Some(Point3::from(p)));
    prop_oneof![Just(None), far]
}

// ------------------------------------------------------------------------------------------- places, overlap

/// What is this close to a threshold may fall on either side of it.
const UNDECIDED: f64 = 1e-9;

/// Holds one place against its definition; `oriented` says whether normals count.
fn check_place(
    place: Place,
    (point, normal): (Point3<f64>, Vector3<f64>),
    target: &Oriented,
    contact: &Contact<'_>,
    oriented: bool,
) {
    let facing = match contact.view {
        Some(view) if oriented => {
            let to_eye = view.eyes[0].place - point;
            normal.dot(&to_eye) - MIN_FACING_COS * to_eye.norm()
        }
        _ => f64::INFINITY,
    };
    let nearest = naive::nearest_dist_sq(&target.points, &point).sqrt();
    let cos = |row: usize| if oriented { normal.dot(&target.normals[row]) } else { 1.0 };
    // Which of several nearest ones it is, is the tree's choice.
    let is_nearest = |row: usize| (target.points[row] - point).norm() <= nearest + UNDECIDED;
    match place {
        Place::Hidden => assert!(facing <= UNDECIDED, "{facing}"),
        Place::Through => panic!("nothing was measured"),
        Place::Free => {
            let turned_away = |row| is_nearest(row) && cos(row) < contact.min_normal_cos + UNDECIDED;
            assert!(facing > -UNDECIDED, "{facing}");
            assert!(
                nearest > contact.distance - UNDECIDED || (0..target.points.len()).any(turned_away),
                "{nearest}"
            );
        }
        Place::On(row) => {
            let row = row as usize;
            assert!(facing > -UNDECIDED && is_nearest(row), "{facing} {nearest}");
            assert!(nearest <= contact.distance + UNDECIDED, "{nearest}");
            assert!(cos(row) >= contact.min_normal_cos - UNDECIDED, "{}", cos(row));
        }
    }
}

proptest! {
    #[test]
    fn places_are_their_twin(
        source in clouds(0..40), others in clouds(0..40), pose in rigid_motions(5.0), kept in 0..40_usize,
        distance in 0.05..5.0, viewpoint in viewpoints(),
    ) {
        // Part of the source lies on the target, with its normals.
        let mut target = source.moved(&pose);
        target.points.truncate(kept);
        target.normals.truncate(kept);
        target.points.extend(others.points);
        target.normals.extend(others.normals);
        let near = Nearby::new(&target.points, distance);
        let contact = contact(distance, viewpoint);
        for oriented in [false, true] {
            let places =
                places(&source.surface(oriented), &target.surface(oriented), &near, &pose, &contact);
            prop_assert_eq!(places.len(), source.points.len());
            let moved = source.moved(&pose);
            for (i, &place) in places.iter().enumerate() {
                check_place(place, (moved.points[i], moved.normals[i]), &target, &contact, oriented);
            }
            let count = |wanted: fn(&Place) -> bool| places.iter().filter(|place| wanted(place)).count();
            let (hidden, on) = (count(|p| *p == Place::Hidden), count(|p| matches!(p, Place::On(_))));
            let visible = places.len() - hidden;
            let share = if visible == 0 { 0.0 } else { on as f64 / visible as f64 };
            prop_assert_eq!(overlap_of(&places), share);
            let surfaces = (source.surface(oriented), target.surface(oriented));
            prop_assert_eq!(overlap(&surfaces.0, &surfaces.1, &near, &pose, &contact), share);
        }
    }
}

#[test]
fn points_that_face_away_are_hidden_and_count_in_no_overlap() {
    let source = Oriented {
        points: vec![Point3::origin(), Point3::new(1.0, 0.0, 0.0), Point3::new(2.0, 0.0, 0.0)],
        normals: vec![Vector3::z(), -Vector3::z(), Vector3::z()],
    };
    let target = Oriented { points: vec![Point3::origin()], normals: vec![Vector3::z()] };
    let (near, pose) = (Nearby::new(&target.points, 0.1), Isometry3::identity());
    let at = |oriented, viewpoint| {
        let contact = contact(0.1, viewpoint);
        places(&source.surface(oriented), &target.surface(oriented), &near, &pose, &contact)
    };
    let (above, below) = (Some(Point3::new(0.0, 0.0, 9.0)), Some(Point3::new(0.0, 0.0, -9.0)));
    assert_eq!(at(true, above), [Place::On(0), Place::Hidden, Place::Free]);
    assert_eq!(overlap_of(&at(true, above)), 0.5);
    assert_eq!(at(true, below), [Place::Hidden, Place::Free, Place::Hidden]);
    assert_eq!(overlap_of(&at(true, below)), 0.0);
    // Neither without a viewpoint nor without normals is anything known to be hidden.
    assert_eq!(at(true, None), [Place::On(0), Place::Free, Place::Free]);
    assert_eq!(at(false, above), at(true, None));
    assert_eq!(overlap_of(&[Place::Hidden; 3]), 0.0);
    assert_eq!(overlap_of(&[]), 0.0);
}

// -------------------------------------------------------------------------------------------------------- icp

/// Ends after so many steps, however small.
fn after(steps: u32) -> Stop {
    Stop::new(steps, 0.0)
}

/// The cost that `icp` promises never to raise, from its definition: of what can be seen at the start.
fn cost(
    source: &Surface<'_>,
    target: &Surface<'_>,
    near: &Nearby,
    [start, pose]: [&Isometry3<f64>; 2],
    contact: &Contact<'_>,
) -> f64 {
    let d = contact.distance;
    let seen = places(source, target, near, start, contact);
    let squares: Vec<f64> = places(source, target, near, pose, &Contact { view: None, ..*contact })
        .into_iter()
        .enumerate()
        .filter(|(i, _)| seen[*i] != Place::Hidden)
        .filter_map(|(i, place)| match place {
            Place::Hidden | Place::Through => None,
            Place::Free => Some(d * d),
            Place::On(row) => {
                let gap = pose * source.points[i] - target.points[row as usize];
                Some(target.normals.map_or(gap.norm_squared(), |n| gap.dot(&n[row as usize]).powi(2)))
            }
        })
        .collect();
    if squares.is_empty() { d * d } else { squares.iter().sum::<f64>() / squares.len() as f64 }
}

/// Root mean square distance between where two poses put the points.
fn distance(points: &[Point3<f64>], a: &Isometry3<f64>, b: &Isometry3<f64>) -> f64 {
    (points.iter().map(|p| (a * p - b * p).norm_squared()).sum::<f64>() / points.len() as f64).sqrt()
}

fn is_proper(pose: &Isometry3<f64>) -> bool {
    let rotation = pose.rotation.to_rotation_matrix().into_inner();
    pose.to_homogeneous().iter().all(|x| x.is_finite())
        && (rotation.determinant() - 1.0).abs() < 1e-9
        && (rotation * rotation.transpose()).is_identity(1e-9)
}

#[test]
fn icp_comes_closer_to_the_truth() {
    let source = Oriented::model(500);
    let spacing = naive::mean_spacing(&source.points);
    let mut rng = Rng::new(5);
    // The same points; and the same surface sampled anew, where the truth is not the least cost any more and
    // points, unlike planes, hold each other where they are: the share of the error that may be left.
    for (sampling, of_points, of_planes) in [(500, 1e-3, 1e-3), (1700, 0.6, 0.2)] {
        let model = Oriented::model(sampling);
        for seed in 0..10 {
            let truth = rng.pose_at(Vector3::new(3.0, -2.0, 5.0));
            let target = model.moved(&truth);
            let near = Nearby::new(&target.points, 3.0 * spacing);
            let axis = rng.normal_vector().normalize() * 3_f64.to_radians();
            let shift = rng.normal_vector().normalize() * (0.5 * spacing);
            let off = Isometry3::from_parts(Translation3::from(shift), UnitQuaternion::new(axis));
            let start = truth * off;
            for (oriented, viewpoint) in [(false, None), (true, None), (true, Some(Point3::origin()))] {
                let (from, to) = (source.surface(oriented), target.surface(oriented));
                let found = icp(&from, &to, &near, &start, &contact(3.0 * spacing, viewpoint), after(20));
                let before = distance(&source.points, &start, &truth);
                let after = distance(&source.points, &found, &truth);
                let which = format!("{sampling} points, {oriented} {viewpoint:?}, {seed}");
                assert!(is_proper(&found), "{which}");
                let share_left = if oriented { of_planes } else { of_points };
                assert!(after < share_left * before, "{which}: {before} before, {after} after");
            }
        }
    }
}

#[test]
fn icp_leaves_the_truth_where_it_is() {
    let source = Oriented::model(300);
    let truth = Rng::new(8).pose_at(Vector3::new(1.0, 2.0, 3.0));
    let target = source.moved(&truth);
    let near = Nearby::new(&target.points, 0.5);
    for oriented in [false, true] {
        let (from, to) = (source.surface(oriented), target.surface(oriented));
        let found = icp(&from, &to, &near, &truth, &contact(0.3, None), after(8));
        assert!(distance(&source.points, &found, &truth) < 1e-9);
        // No steps, no change.
        let start = truth * Isometry3::translation(0.01, 0.0, 0.0);
        assert_eq!(icp(&from, &to, &near, &start, &contact(0.3, None), after(0)), start);
    }
}

proptest! {
    #[test]
    fn icp_is_never_worse_than_its_start(
        target in prop_oneof![clouds(1..60), Just(Oriented::model(120))],
        source in prop_oneof![clouds(1..40), Just(Oriented::model(120))],
        start in prop_oneof![rigid_motions(0.3), rigid_motions(5.0), rigid_motions(1e4)],
        distance in prop_oneof![0.01..0.5, 0.5..50.0], viewpoint in viewpoints(), steps in 0..10_u32,
    ) {
        let near = Nearby::new(&target.points, distance);
        let contact = contact(distance, viewpoint);
        for oriented in [false, true] {
            let (source, target) = (source.surface(oriented), target.surface(oriented));
            let found = icp(&source, &target, &near, &start, &contact, after(steps));
            prop_assert!(is_proper(&found), "{found}");
            let of = |pose| cost(&source, &target, &near, [&start, pose], &contact);
            let (before, after) = (of(&start), of(&found));
            prop_assert!(after <= before * (1.0 + 1e-9) + 1e-12, "{before} before, {after} after");
        }
    }

    #[test]
    fn icp_survives_planes_lines_and_identical_points(
        cloud in points(1..30), kind in 0..3_u8, start in rigid_motions(1.0), distance in 0.1..10.0,
    ) {
        // All in a plane, on a line, at one place; every normal the same.
        let flat = |p: &Point3<f64>| Point3::new(
            if kind < 2 { p.x } else { 1.0 }, if kind < 1 { p.y } else { -2.0 }, 0.5,
        );
        let points: Vec<_> = cloud.iter().map(flat).collect();
        let cloud = Oriented { normals: vec![Vector3::z(); points.len()], points };
        let near = Nearby::new(&cloud.points, distance);
        for oriented in [false, true] {
            let surface = cloud.surface(oriented);
            let found = icp(&surface, &surface, &near, &start, &contact(distance, None), after(8));
            prop_assert!(is_proper(&found), "{found}");
        }
    }
}

#[test]
fn a_plane_settles_on_a_plane_and_does_not_slide_away() {
    let lattice = |n: i32| {
        let half = f64::from(n - 1) / 2.0;
        let at = |k: i32| f64::from(k) - half;
        let points: Vec<_> = (0..n * n).map(|i| Point3::new(at(i % n), at(i / n), 0.0)).collect();
        Oriented { normals: vec![Vector3::z(); points.len()], points }
    };
    let (source, mut target) = (lattice(15), lattice(41));
    // Noise holds the plane a little, in no place worth going to.
    let mut rng = Rng::new(2);
    target.points.iter_mut().for_each(|p| p.z += 0.1 * rng.normal());
    target.normals.iter_mut().for_each(|n| *n = (*n + rng.normal_vector() * 1e-3).normalize());
    let near = Nearby::new(&target.points, 3.0);
    let turn = UnitQuaternion::new(Vector3::new(0.03, -0.02, 0.2));
    let start = Isometry3::from_parts(Translation3::new(3.3, -2.4, 0.3), turn);
    for oriented in [false, true] {
        let (from, to) = (source.surface(oriented), target.surface(oriented));
        let found = icp(&from, &to, &near, &start, &contact(3.0, None), after(8));
        assert!(is_proper(&found));
        let shift = found.translation.vector - start.translation.vector;
        assert!(shift.xy().norm() < 1.0, "slid by {shift}");
        let off =
            |pose: &Isometry3<f64>| source.points.iter().map(|p| (pose * p).z.abs()).fold(0.0, f64::max);
        assert!(off(&found) < 0.1 * off(&start), "{} left", off(&found));
    }
}

#[test]
fn icp_gives_the_same_bits_for_any_number_of_threads() {
    let (source, target) = (Oriented::model(700), Oriented::model(900));
    let near = Nearby::new(&target.points, 0.5);
    let start = Isometry3::new(Vector3::new(0.02, -0.03, 0.01), Vector3::new(0.02, 0.03, -0.04));
    let all = || {
        [false, true].map(|oriented| {
            let (from, to) = (source.surface(oriented), target.surface(oriented));
            let found = icp(&from, &to, &near, &start, &contact(0.3, None), after(8));
            found.to_homogeneous().map(f64::to_bits)
        })
    };
    let serial = all();
    for num_threads in [1, 2, 7] {
        assert_eq!(Pool::new(Some(num_threads)).unwrap().install(all), serial);
    }
}

// -------------------------------------------------------------------------------------- claimed scene points

/// A model that half a turn about z maps onto itself: point i onto point i + half of them.
fn half_turn_model(half: usize) -> Vec<Point3<f64>> {
    let once: Vec<_> = asymmetric_model(half).iter().map(|p| p + Vector3::new(0.4, 0.3, 0.0)).collect();
    let again = once.iter().map(|p| Point3::new(-p.x, -p.y, p.z));
    once.iter().copied().chain(again).collect()
}

#[test]
fn a_symmetric_instance_is_found_once_if_scene_points_are_exclusive() {
    let source = half_turn_model(100);
    let pose = Rng::new(4).pose_at(Vector3::new(4.0, 1.0, -2.0));
    let target: Vec<_> = source.iter().map(|p| pose * p).collect();
    // Half of the correspondences speak for the pose, half for it turned; in a contest nothing is removed before
    // it ends.
    let rows: Vec<[usize; 2]> = (0..400).map(|row| [(row + 100 * (row / 200)) % 200, row % 200]).collect();
    let found = |exclusive| {
        let params = Params {
            t_he_pr: 2.0,
            t_s: 4,
            scs: LocalGtm::default().into(),
            te: Irls::default().into(),
            hv: Overlap { t_overlap: 0.5, exclusive }.into(),
            removal: Removal::Inliers,
            n_contest: 2,
            max_rejections: Some(10),
            ..Params::paper_synthetic()
        };
        let registrar = Registrar::new(&Cloud::new(&source)).unwrap().params(params).num_threads(1);
        registrar.register(&Cloud::new(&target), &Correspondences::from_rows(rows.clone())).unwrap()
    };
    let (once, more) = (found(true), found(false));
    assert_eq!((once.poses.len(), more.poses.len()), (1, 2));
    let turned = pose * Isometry3::rotation(Vector3::z() * std::f64::consts::PI);
    let off = |found: &Pose, truth| distance(&source, &found.target_from_source, truth);
    assert!(once.poses.iter().all(|found| off(found, &pose).min(off(found, &turned)) < 1e-6));
    for truth in [&pose, &turned] {
        assert_eq!(more.poses.iter().filter(|found| off(found, truth) < 1e-6).count(), 1);
    }
    // Both runs entered the same hypotheses for their first contest.
    assert_eq!(once.rounds[..2].iter().filter(|round| round.accepted()).count(), 2);
}

// --------------------------------------------------------------------------- the refined pose and the unrefined

/// A transformation estimation that always answers with one pose.
fn always(pose: Isometry3<f64>) -> impl EstimatePose + 'static {
    let hypothesis = Hypothesis { target_from_source: pose, score: 1.0 };
    Mock(move |_: &Context<'_>, _: &Ranked| Estimate {
        hypothesis: Some(hypothesis),
        num_samples: 1,
        num_degenerate: 0,
        capped: false,
    })
}

/// What one round makes of the hypothesis `start` on a model that is its own target, where the correspondences
/// agree with a pose of their own: the verdict, and the pose if it was accepted.
fn judged(
    start: Isometry3<f64>,
    agreeing_with: &Isometry3<f64>,
    params: Params,
) -> (Verdict, Option<Isometry3<f64>>) {
    let model = Oriented::model(200);
    let pairs = model.points.iter().map(|p| [*p, agreeing_with * p]).collect();
    let cloud = Cloud::new(&model.points).with_normals(model.normals);
    let params = Params { max_rounds: Some(1), ..params };
    let registrar = Registrar::new(&cloud).unwrap().params(params).num_threads(1).with_te(always(start));
    let result = registrar.register(&cloud, &Correspondences::from_points(pairs)).unwrap();
    (result.rounds[0].verdict.unwrap(), result.poses.first().map(|pose| pose.target_from_source))
}

fn with_each_validation(params: &Params) -> impl Iterator<Item = Params> {
    Hv::all().into_iter().map(move |hv| Params { hv, ..params.clone() })
}

#[test]
fn a_refined_pose_must_keep_the_agreement_of_its_correspondences() {
    let spacing = naive::mean_spacing(&asymmetric_model(200));
    let here = Isometry3::identity();
    let off = Isometry3::translation(0.5 * spacing, 0.0, 0.0);
    for params in with_each_validation(&Params { t_he_pr: 0.3, ..Params::default() }) {
        let pose = |agreeing_with, refine| {
            judged(off, agreeing_with, Params { refine, ..params.clone() })
                .1
                .unwrap_or_else(|| panic!("{}", params.hv.name()))
        };
        // Carried to where the clouds fit: good if the correspondences say so too, also where the measure cannot
        // tell the two poses apart.
        let refined = pose(&here, Refine::Icp);
        assert!(refined.translation.vector.norm() < 0.01 * spacing, "{} {refined}", params.hv.name());
        // Carried away from all of them: what was there before stays.
        assert_eq!(pose(&off, Refine::Icp), off, "{}", params.hv.name());
        assert_eq!(pose(&off, Refine::None), off);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn refinement_never_lowers_the_verdict(
        shift in prop::array::uniform3(-0.3..0.3), turn in prop::array::uniform3(-0.3..0.3),
        there in prop::array::uniform3(-0.2..0.2), oriented: bool, t_he_pr in 0.3..5.0,
    ) {
        let start = Isometry3::new(Vector3::from(shift), Vector3::from(turn));
        let agreeing_with = Isometry3::translation(there[0], there[1], there[2]);
        let params = Params { t_he_pr, oriented_normals: oriented, ..Params::default() };
        for params in with_each_validation(&params) {
            let (refined, _) = judged(start, &agreeing_with, params.clone());
            let (plain, _) = judged(start, &agreeing_with, Params { refine: Refine::None, ..params });
            // What is rejected at a glance has the value of a glance.
            let is_hopeless = !refined.accepted() && !plain.accepted();
            prop_assert!(refined.value >= plain.value || is_hopeless, "{refined:?} {plain:?}");
            prop_assert_eq!(refined.threshold, plain.threshold);
        }
    }
}

#[test]
fn a_pose_that_no_correspondence_agrees_with_is_no_instance_although_the_clouds_fit() {
    let source = asymmetric_model(200);
    let (near, far) = (Isometry3::translation(4.0, 0.0, 0.0), Isometry3::translation(-4.0, 0.0, 0.0));
    let target: Vec<_> = [near, far].iter().flat_map(|pose| source.iter().map(move |p| pose * p)).collect();
    // Only the first copy has correspondences.
    let correspondences = Correspondences::from_rows((0..200).map(|row| [row, row]).collect());
    let found = |pose, params: Params| {
        let params = Params { max_rounds: Some(1), ..params };
        let registrar = Registrar::new(&Cloud::new(&source)).unwrap().params(params).with_te(always(pose));
        registrar.register(&Cloud::new(&target), &correspondences).unwrap().poses.len()
    };
    for refine in [Refine::None, Refine::Icp] {
        let evidence = Params { refine, ..Params::default() };
        assert_eq!((found(near, evidence.clone()), found(far, evidence.clone())), (1, 0));
        // Overlap asks the clouds alone, as in the paper.
        let overlap = Params { hv: Overlap::default().into(), joint_check: false, ..evidence };
        assert_eq!((found(near, overlap.clone()), found(far, overlap)), (1, 1));
    }
}
