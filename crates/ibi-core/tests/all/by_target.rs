//! Pairs by the place of their target points: brute force in `f64`, and the laws that hold whatever the data.

use std::collections::HashSet;
use std::ops::Range;

use ibi_core::kernels::by_target::ByTarget;
use ibi_core::kernels::columns::Columns;
use ibi_core::nalgebra::{Isometry3, Point3, Vector3};
use ibi_testkit::Rng;
use ibi_testkit::naive::{self, Pair};
use ibi_testkit::strategies::{correspondences, permutations, point, rigid_motions};
use proptest::prelude::*;

/// A coordinate of the columns is off by 6e-8 of the extent of its side; a residual has seven of them and the rotation
/// in `f32`: by 1e-6 of it at most.
const ROUNDING: f64 = 1e-6;

/// What radii are widened by, for rounding.
const LEEWAY: f64 = 2e-6;

fn columns(pairs: &[Pair], unit: f64) -> Columns {
    let (source, target): (Vec<_>, Vec<_>) = pairs.iter().copied().unzip();
    Columns::new(&source, &target, unit)
}

/// The largest distance of a point from the mean of its side.
fn extent(points: impl Iterator<Item = Point3<f64>> + Clone) -> f64 {
    let n = points.clone().count().max(1);
    let mean = points.clone().map(|p| p.coords).sum::<Vector3<f64>>() / n as f64;
    points.map(|p| (p.coords - mean).norm()).fold(0.0, f64::max)
}

/// Of both sides, with what the pose and the coordinates lose in `f64`.
fn doubt(pairs: &[Pair], pose: &Isometry3<f64>) -> f64 {
    let largest = pairs.iter().flat_map(|(p, q)| [p.coords.norm(), q.coords.norm()]).fold(0.0, f64::max);
    let extents = extent(pairs.iter().map(|pair| pair.0)) + extent(pairs.iter().map(|pair| pair.1));
    ROUNDING * extents + 4e-15 * (largest + pose.translation.vector.norm())
}

fn sorted(mut ids: Vec<u32>) -> Vec<u32> {
    ids.sort_unstable();
    ids
}

/// Each id once, all of `surely` among them, and none that is not in `perhaps`.
fn assert_between(ids: &[u32], surely: &[u32], perhaps: &[u32]) {
    let set: HashSet<u32> = ids.iter().copied().collect();
    assert_eq!(ids.len(), set.len(), "an id twice");
    assert!(surely.iter().all(|id| set.contains(id)), "{ids:?} lacks some of {surely:?}");
    assert!(ids.iter().all(|id| perhaps.contains(id)), "{ids:?} has more than {perhaps:?}");
}

/// What the positions of `runs` hold; they must come in order and none twice.
fn held(by_target: &ByTarget, runs: impl Iterator<Item = Range<usize>>) -> HashSet<u32> {
    let mut end = 0;
    let mut ids = HashSet::new();
    for run in runs {
        assert!(end <= run.start && run.start < run.end, "not ascending, or empty: {run:?}");
        end = run.end;
        ids.extend(run.map(|at| by_target.id(at)));
    }
    assert!(end <= by_target.sorted().len());
    ids
}

/// Ids are a permutation, and the sorted columns are the columns in its order.
fn check_order(by_target: &ByTarget, columns: &Columns) {
    let n = columns.len();
    let ids: Vec<u32> = (0..n).map(|at| by_target.id(at)).collect();
    assert!((0..n).all(|at| by_target.sorted().pair(at) == columns.pair(ids[at] as usize)));
    assert_eq!(by_target.sorted().len(), n);
    assert!(sorted(ids).into_iter().eq(0..n as u32), "each pair once");
}

/// Everything about one pose and one distance, both in data units.
fn check_pose(pairs: &[Pair], by_target: &ByTarget, pose: &Isometry3<f64>, distance: f64, unit: f64) {
    let doubt = doubt(pairs, pose) + LEEWAY * distance;
    let surely = naive::close_pairs(pairs, pose, distance - doubt);
    let perhaps = naive::close_pairs(pairs, pose, distance + doubt);
    assert_between(&by_target.close_pairs(pose, distance / unit), &surely, &perhaps);

    let near = held(by_target, by_target.near_pose(pose, distance / unit));
    let reaches = |q: &Point3<f64>| pairs.iter().any(|(p, _)| (pose * p - q).norm() < distance - doubt);
    for (id, (_, q)) in (0..).zip(pairs) {
        assert!(near.contains(&id) || !reaches(q), "{id} is near the pose");
    }
}

/// Everything about one place among the targets.
fn check_place(pairs: &[Pair], by_target: &ByTarget, place: &Point3<f64>, radius: f64) {
    let targets: Vec<Point3<f64>> = pairs.iter().map(|pair| pair.1).collect();
    let Columns { centres: (_, centre), unit, .. } = *by_target.sorted();
    // Coordinates of the place are rounded as well.
    let off = (place.coords - centre).norm() + extent(targets.iter().copied());
    let doubt = ROUNDING * off + LEEWAY * radius + 4e-15 * centre.norm();
    let surely = naive::within(&targets, place, radius - doubt);
    let perhaps = naive::within(&targets, place, radius + doubt);
    assert_between(&by_target.within(place, radius), &surely, &perhaps);

    let local: [f32; 3] = ((place.coords - centre) / unit).cast().into();
    let around = held(by_target, by_target.around(local, (radius / unit) as f32));
    assert!(surely.iter().all(|id| around.contains(id)), "around {place}");
}

/// Correspondences of all kinds; those of one motion, which `pose` is or is not, and wrong ones.
fn pairs(most: usize) -> impl Strategy<Value = Vec<Pair>> {
    (correspondences(0..most), 0..6_u8, point()).prop_map(|(mut pairs, kind, at)| {
        match kind {
            0 => pairs.iter_mut().for_each(|pair| pair.1 = at),
            1 => pairs.iter_mut().for_each(|pair| pair.0 = at),
            2 => pairs.iter_mut().for_each(|pair| *pair = (at, at)),
            3 => pairs.iter_mut().for_each(|(p, q)| (p.z, q.y, q.z) = (0.0, 1.0, 2.0)),
            _ => pairs.extend_from_within(..pairs.len() / 2),
        }
        pairs
    })
}

/// A model of 60 points, three copies of it exactly placed, and wrong pairs all over the place.
fn scene(seed: u64) -> (Vec<Pair>, Vec<Isometry3<f64>>) {
    let mut rng = Rng::new(seed);
    let model: Vec<Point3<f64>> = (0..60).map(|_| Point3::from(rng.in_box(1.0))).collect();
    let poses: Vec<_> = [[0.0, 0.0, 0.0], [6.0, 1.0, 0.0], [-2.0, 9.0, 4.0]]
        .map(|at| rng.pose_at(Vector3::from(at)))
        .to_vec();
    let mut pairs: Vec<Pair> =
        poses.iter().flat_map(|pose| model.iter().map(move |p| (*p, pose * p))).collect();
    pairs.extend((0..300).map(|i| (model[i % 60], Point3::from(rng.in_box(12.0)))));
    rng.shuffle(&mut pairs);
    (pairs, poses)
}

fn distances() -> impl Strategy<Value = f64> {
    prop_oneof![Just(1e-3), 0.01..1.0, 1.0..30.0]
}

proptest! {
    #[test]
    fn by_target_is_its_twin(
        pairs in pairs(60), pose in rigid_motions(5.0), place in point(), distance in distances(), unit in 0.1..10.0,
    ) {
        let columns = columns(&pairs, unit);
        let by_target = ByTarget::new(&columns);
        check_order(&by_target, &columns);
        check_pose(&pairs, &by_target, &pose, distance, unit);
        check_place(&pairs, &by_target, &place, distance);
        if let Some((p, q)) = pairs.first() {
            check_place(&pairs, &by_target, q, distance);
            // One pair fits for certain.
            let mut fits = pose;
            fits.translation.vector += q - pose * p;
            check_pose(&pairs, &by_target, &fits, distance, unit);
        }
    }

    // Neither side's frame nor the unit of the data costs precision.
    #[test]
    fn by_target_keeps_its_precision_far_away_and_in_any_unit(
        pairs in pairs(40), pose in rigid_motions(5.0), place in point(), distance in distances(),
        one in rigid_motions(1e6), other in rigid_motions(1e6),
        unit in prop::sample::select(vec![1e-6, 1e-3, 1.0, 1e3, 1e6]),
    ) {
        let moved: Vec<Pair> = pairs.iter().map(|(p, q)| ((one * p) * unit, (other * q) * unit)).collect();
        let mut there = other * pose * one.inverse();
        there.translation.vector *= unit;
        let by_target = ByTarget::new(&columns(&moved, 0.3 * unit));
        check_pose(&moved, &by_target, &there, distance * unit, 0.3 * unit);
        check_place(&moved, &by_target, &((other * place) * unit), distance * unit);
        // What is close does not depend on the frame, up to rounding.
        let doubt = doubt(&moved, &there) / unit + LEEWAY * distance;
        let (fewest, most) = (distance - doubt, distance + doubt);
        assert_between(
            &by_target.close_pairs(&there, distance / 0.3),
            &naive::close_pairs(&pairs, &pose, fewest),
            &naive::close_pairs(&pairs, &pose, most),
        );
    }

    // The spread of the source points is known from above, and not much too large.
    #[test]
    fn source_diameter_holds_all_distances(pairs in pairs(60), unit in 0.1..10.0) {
        let diameter = f64::from(ByTarget::new(&columns(&pairs, unit)).source_diameter()) * unit;
        let widest = pairs.iter().flat_map(|(p, _)| pairs.iter().map(move |(p2, _)| (p - p2).norm()));
        let widest = widest.fold(0.0, f64::max);
        // The diagonal of a box is at most sqrt(3) times the widest distance in it, for each axis is at most that.
        let rounding = 1e-6 * widest;
        prop_assert!(diameter >= widest - rounding && diameter <= 1.001 * 3_f64.sqrt() * widest + rounding);
    }

    #[test]
    fn a_far_pose_has_no_close_pairs(
        pairs in pairs(60), pose in rigid_motions(5.0), way in point(), distance in distances(), exponent in 2..30,
    ) {
        prop_assume!(way.coords.norm() > 0.1);
        let mut far = pose;
        // Beyond both clouds and the distance, which together reach less than 100.
        far.translation.vector += way.coords.normalize() * 1.2 * 10_f64.powi(exponent);
        let by_target = ByTarget::new(&columns(&pairs, 1.0));
        prop_assert!(by_target.close_pairs(&far, distance).is_empty());
        let place = Point3::from(far.translation.vector);
        prop_assert_eq!(by_target.within(&place, distance).len(), 0);
    }

    #[test]
    fn the_order_of_the_pairs_does_not_matter(
        (pairs, order) in pairs(60).prop_flat_map(|pairs| {
            let n = pairs.len();
            (Just(pairs), permutations(n))
        }),
        pose in rigid_motions(5.0), distance in distances(),
    ) {
        let permuted: Vec<Pair> = order.iter().map(|&i| pairs[i]).collect();
        let there = ByTarget::new(&columns(&permuted, 1.0)).close_pairs(&pose, distance);
        let here: Vec<u32> = there.into_iter().map(|id| order[id as usize] as u32).collect();
        let doubt = doubt(&pairs, &pose) + LEEWAY * distance;
        assert_between(
            &here,
            &naive::close_pairs(&pairs, &pose, distance - doubt),
            &naive::close_pairs(&pairs, &pose, distance + doubt),
        );
    }
}

#[test]
fn no_pairs_and_one() {
    let none = ByTarget::new(&columns(&[], 1.0));
    assert!(none.sorted().is_empty() && none.source_diameter().abs() < f32::MIN_POSITIVE);
    assert!(none.close_pairs(&Isometry3::identity(), 1e9).is_empty());
    assert_eq!(none.near_pose(&Isometry3::identity(), 1e9).count(), 0);
    assert_eq!(none.around([0.0; 3], 1e9).count(), 0);
    assert_eq!(none.within(&Point3::origin(), 1e9).len(), 0);

    let one = [(Point3::new(1.0, 2.0, 3.0), Point3::new(1e6, -1e6, 0.5))];
    let by_target = ByTarget::new(&columns(&one, 0.1));
    let fits = Isometry3::translation(1e6 - 1.0, -1e6 - 2.0, -2.5);
    assert_eq!(by_target.close_pairs(&fits, 1e-3), [0]);
    assert!(by_target.close_pairs(&Isometry3::identity(), 1e5).is_empty());
    assert_eq!(by_target.within(&one[0].1, 0.0), [0]);
}

// Many cells: the copies are a sixth as wide as the scene.
#[test]
fn the_copies_of_a_scene_come_up_around_their_poses() {
    for (seed, offset) in [(1, 0.0), (2, 1e6), (3, -1e6)] {
        let (mut pairs, mut poses) = scene(seed);
        let offset = Vector3::new(offset, 0.5 * offset, -offset);
        for (_, q) in &mut pairs {
            *q += offset;
        }
        for pose in &mut poses {
            pose.translation.vector += offset;
        }
        let by_target = ByTarget::new(&columns(&pairs, 0.1));
        check_order(&by_target, &columns(&pairs, 0.1));
        for pose in &poses {
            for distance in [1e-3, 0.1, 1.0, 5.0] {
                check_pose(&pairs, &by_target, pose, distance, 0.1);
                check_place(&pairs, &by_target, &Point3::from(pose.translation.vector), distance);
            }
            let close = by_target.close_pairs(pose, 0.01 / 0.1);
            assert!((60..70).contains(&close.len()), "a copy and few that fit by chance: {}", close.len());
            // The reason for the grid: a pose concerns only those near it.
            let near = held(&by_target, by_target.near_pose(pose, 0.1));
            assert!(near.len() < pairs.len() / 2, "{} of {}", near.len(), pairs.len());
        }
    }
}

// A model like a needle: its ends are as far from the middle as the ball around it reaches, and no cell to spare.
#[test]
fn the_ends_of_a_needle_come_up() {
    let mut rng = Rng::new(5);
    for _ in 0..300 {
        let pose = rng.pose_at(Vector3::new(1.0, -2.0, 0.0));
        let end = rng.normal_vector().normalize();
        let ends = [Point3::from(end), Point3::from(-end)];
        let mut pairs: Vec<Pair> = ends.iter().map(|p| (*p, pose * p)).collect();
        pairs.extend((0..40).map(|i| (ends[i % 2], Point3::from(rng.in_box(8.0)))));
        let by_target = ByTarget::new(&columns(&pairs, 0.1));
        let close = by_target.close_pairs(&pose, 1e-3 / 0.1);
        assert!(close.contains(&0) && close.contains(&1), "{close:?}");
        for distance in [1e-3, 0.3] {
            check_pose(&pairs, &by_target, &pose, distance, 0.1);
        }
    }
}

// Thousands in one column of cells, a part of which fits: more than are computed at a time.
#[test]
fn crowded_cells_lose_nothing() {
    let mut rng = Rng::new(6);
    let pose = rng.pose_at(Vector3::new(3.0, 2.0, 1.0));
    let pair = |rng: &mut Rng| {
        let p = Point3::from(rng.in_box(1.0));
        (p, pose * p + rng.in_box(0.2))
    };
    for n in [255, 256, 257, 5000] {
        let pairs: Vec<Pair> = (0..n).map(|_| pair(&mut rng)).collect();
        let by_target = ByTarget::new(&columns(&pairs, 0.1));
        for distance in [0.02, 0.15, 0.3] {
            let close = by_target.close_pairs(&pose, distance / 0.1);
            assert!(n < 5000 || distance < 0.1 || close.len() > 1000, "{} close ones", close.len());
            let (fewest, most) = (distance - 1e-5, distance + 1e-5);
            let [surely, perhaps] = [fewest, most].map(|d| naive::close_pairs(&pairs, &pose, d));
            assert_between(&close, &surely, &perhaps);
        }
    }
    // One cell for all.
    let same: Vec<Pair> = (0..1000).map(|_| (pair(&mut rng).0, Point3::new(3.0, 2.0, 1.0))).collect();
    check_pose(&same, &ByTarget::new(&columns(&same, 0.1)), &pose, 0.5, 0.1);
}

// One target point a million times farther away than all others does not make these share a cell.
#[test]
fn a_stray_target_leaves_the_cells_small() {
    let (mut pairs, poses) = scene(4);
    pairs.push((Point3::origin(), Point3::new(1e6, -1e6, 1e6)));
    let by_target = ByTarget::new(&columns(&pairs, 0.1));
    for pose in &poses {
        // The mean of the targets is moved by it, by which their coordinates lose digits: 1e6 / 481 * 6e-8.
        let close: HashSet<u32> = by_target.close_pairs(pose, 0.01 / 0.1).into_iter().collect();
        assert!(naive::close_pairs(&pairs, pose, 0.008).iter().all(|id| close.contains(id)));
        assert!(held(&by_target, by_target.near_pose(pose, 0.1)).len() < pairs.len() / 2);
    }
    assert_eq!(by_target.within(&Point3::new(1e6, -1e6, 1e6), 1.0), [480]);
}
