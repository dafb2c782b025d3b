//! The features: each against its naive twin, and the laws that hold whatever the data.

use ibi_core::features::{
    Amount, Descriptors, FPFH_DIM, FeatureError, Matches, Matching, Mesh, Neighborhood, PlaneSearch, Views,
    dominant_plane, estimate_normals, fpfh, match_features, outer_surface, sample_mesh, voxel_downsample,
};
use ibi_core::kernels::par::Pool;
use ibi_core::nalgebra::{Isometry3, Point3, Vector3};
use ibi_core::{CancelToken, Interrupt};
use ibi_testkit::strategies::{permutations, points, rigid_motions};
use ibi_testkit::{Rng, features as naive};
use proptest::prelude::*;

fn never() -> Interrupt {
    Interrupt::never()
}

/// A bumpy ball of radius about 1, with normals that are a little off.
fn ball(count: usize, seed: u64) -> (Vec<Point3<f64>>, Vec<Vector3<f64>>) {
    let mut rng = Rng::new(seed);
    let mut point = |_| {
        let out = rng.normal_vector().normalize();
        let bump = 1.0 + 0.1 * (5.0 * out.x).sin() * (4.0 * out.y).cos();
        (Point3::from(out * bump), (out + 0.2 * rng.normal_vector()).normalize())
    };
    (0..count).map(&mut point).unzip()
}

fn in_order<T: Copy>(items: &[T], order: &[usize]) -> Vec<T> {
    order.iter().map(|&i| items[i]).collect()
}

/// How many rows differ by more than rounding: an angle that changes its bin changes the row of its point, and a little
/// those around.
fn flips(a: &[[f32; FPFH_DIM]], b: &[[f32; FPFH_DIM]]) -> usize {
    assert_eq!(a.len(), b.len());
    let off = |(a, b): (&[f32; FPFH_DIM], &[f32; FPFH_DIM])| {
        a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    };
    a.iter().zip(b).map(off).filter(|&off| off > 1e-3).count()
}

// ----------------------------------------------------------------------------------------------------- voxels

proptest! {
    #[test]
    fn voxels_are_their_twin(cloud in points(0..60), voxel in 0.05..30.0) {
        let mut rng = Rng::new(1);
        let normals: Vec<Vector3<f64>> = cloud.iter().map(|_| rng.normal_vector()).collect();
        let thin = voxel_downsample(&cloud, Some(&normals), voxel, &Interrupt::never()).unwrap();
        let voxels = naive::voxels(&cloud, voxel);
        prop_assert_eq!(thin.points.len(), voxels.len());
        for ((p, n), rows) in thin.points.iter().zip(thin.normals.unwrap()).zip(voxels.values()) {
            let mean = rows.iter().map(|&row| cloud[row].coords).sum::<Vector3<f64>>() / rows.len() as f64;
            prop_assert!((p.coords - mean).norm() < 1e-12);
            let direction = rows.iter().map(|&row| normals[row].normalize()).sum::<Vector3<f64>>();
            prop_assert!((n - direction.normalize()).norm() < 1e-6 / direction.norm());
        }
    }
}

#[test]
fn voxels_that_cannot_be_counted_are_refused() {
    let cloud = [Point3::origin(), Point3::new(1.0, 0.0, 0.0)];
    let error = voxel_downsample(&cloud, None, 1e-7, &Interrupt::never()).unwrap_err();
    assert_eq!(
        error.to_string(),
        "voxel is 1e-7 and the points are 1e0 across; at most 2097152 voxels fit along an axis"
    );
    assert_eq!(voxel_downsample(&cloud, None, 1e-6, &Interrupt::never()).unwrap().points.len(), 2);
}

// ---------------------------------------------------------------------------------------------------- normals

proptest! {
    // No direction has less spread: the normal itself is not unique on a line.
    #[test]
    fn across_a_normal_is_least_spread(cloud in points(0..60), radius in 0.5..20.0, most in 3..40_usize) {
        let neighborhood = Neighborhood { radius, max_neighbors: most };
        let normals = estimate_normals(&cloud, neighborhood, None, &never()).unwrap();
        for (row, n) in normals.iter().enumerate() {
            prop_assert!((n.norm() - 1.0).abs() < 1e-12);
            let rows = naive::neighbors(&cloud, row, radius, most);
            let spread = naive::spread(&cloud, &rows);
            if rows.len() < 3 || spread.amax() == 0.0 {
                prop_assert_eq!(*n, Vector3::z());
                continue;
            }
            let least = spread.symmetric_eigenvalues().min();
            prop_assert!(n.dot(&(spread * n)) < least + 1e-9 * spread.amax(), "{} {}", n, spread);
            prop_assert!((n.z, n.y, n.x) >= (0.0, 0.0, 0.0));
        }
    }

    #[test]
    fn normals_face_the_viewpoint(cloud in points(3..40), eye in points(1..2)) {
        let neighborhood = Neighborhood { radius: 8.0, max_neighbors: 20 };
        for (n, p) in estimate_normals(&cloud, neighborhood, Some(eye[0]), &never()).unwrap().iter().zip(&cloud) {
            prop_assert!(n.dot(&(eye[0] - p)) >= 0.0);
        }
    }
}

// ------------------------------------------------------------------------------------------------------- FPFH

proptest! {
    #![proptest_config(ProptestConfig::with_cases(30))]

    #[test]
    fn fpfh_is_its_twin(seed in 0..1000_u64, radius in 0.1..0.9, most in 2..80_usize) {
        let (points, normals) = ball(200, seed);
        let neighborhood = Neighborhood { radius, max_neighbors: most };
        let ours = fpfh(&points, &normals, neighborhood, None, &never()).unwrap();
        let twin: Vec<[f32; FPFH_DIM]> =
            naive::fpfh(&points, &normals, radius, most).iter().map(|row| row.map(|x| x as f32)).collect();
        prop_assert!(flips(&ours, &twin) <= 100, "{}", flips(&ours, &twin));
        prop_assert!(ours.as_flattened().iter().all(|x| (-1e-3..=200.01).contains(x)));
    }

    #[test]
    fn fpfh_survives_motion_and_another_order(seed in 0..1000_u64, pose in rigid_motions(100.0), order in permutations(200)) {
        let (points, normals) = ball(200, seed);
        let neighborhood = Neighborhood { radius: 0.4, max_neighbors: 50 };
        let here = fpfh(&points, &normals, neighborhood, None, &never()).unwrap();
        let moved: Vec<Point3<f64>> = points.iter().map(|p| pose * p).collect();
        let turned: Vec<Vector3<f64>> = normals.iter().map(|n| pose * n).collect();
        prop_assert!(flips(&fpfh(&moved, &turned, neighborhood, None, &never()).unwrap(), &here) <= 100);
        let (points, normals) = (in_order(&points, &order), in_order(&normals, &order));
        let shuffled = fpfh(&points, &normals, neighborhood, None, &never()).unwrap();
        prop_assert_eq!(flips(&shuffled, &in_order(&here, &order)), 0);
    }
}

// Over many pairs: fewer than one angle in a hundred thousand is near enough to an edge for `f32` to move it.
#[test]
fn few_angles_change_their_bins() {
    let (mut rows, mut off) = (0, 0);
    for seed in 0..10 {
        let (points, normals) = ball(500, seed);
        let ours =
            fpfh(&points, &normals, Neighborhood { radius: 0.3, max_neighbors: 60 }, None, &never()).unwrap();
        let twin = naive::fpfh(&points, &normals, 0.3, 60);
        let twin: Vec<_> = twin.iter().map(|row| row.map(|x| x as f32)).collect();
        (rows, off) = (rows + ours.len(), off + flips(&ours, &twin));
    }
    assert!(off <= rows / 50, "{off} of {rows} rows");
}

#[test]
fn fpfh_of_key_points_is_that_of_their_rows() {
    let (points, normals) = ball(600, 3);
    let neighborhood = Neighborhood { radius: 0.3, max_neighbors: 40 };
    let all = fpfh(&points, &normals, neighborhood, None, &never()).unwrap();
    let rows = [5, 599, 5, 0, 77];
    let some = fpfh(&points, &normals, neighborhood, Some(&rows), &never()).unwrap();
    assert_eq!(some, rows.map(|row| all[row]));
    let error = fpfh(&points, &normals, neighborhood, Some(&[3, 600]), &never()).unwrap_err();
    assert_eq!(error.to_string(), "keypoints[1] is 600; points has rows 0 to 599");
}

// --------------------------------------------------------------------------------------------------- matching

fn joined(source: &[Vec<f32>], target: &[Vec<f32>], dim: usize, matching: Matching) -> Matches {
    let (source, target): (Vec<f32>, Vec<f32>) = (source.concat(), target.concat());
    let rows = |values| Descriptors { values, dim };
    match_features(rows(&source), rows(&target), matching, &never()).unwrap()
}

/// Rows of numbers on a coarse lattice, so that many are equally far, or of any numbers.
fn descriptors(dim: usize, most: usize) -> impl Strategy<Value = Vec<Vec<f32>>> {
    let number = prop_oneof![(-3..4_i8).prop_map(f32::from), -3.0..3.0_f32];
    prop::collection::vec(prop::collection::vec(number, dim), 0..most)
}

proptest! {
    #[test]
    fn matches_are_their_twin(
        (dim, source, target) in (1..40_usize).prop_flat_map(|d| (Just(d), descriptors(d, 90), descriptors(d, 150))),
        k in 1..4_usize, mutual: bool, max_ratio in prop::option::of(0.3..=1.0),
    ) {
        let found = joined(&source, &target, dim, Matching { k, mutual, max_ratio });
        let back = naive::nearest_rows(&target, &source, k);
        let mut expected = Vec::new();
        for (t, near) in naive::nearest_rows(&source, &target, k).iter().enumerate() {
            let left_out = near.get(k).map_or(f64::INFINITY, |hit| hit.1);
            for &(s, distance) in near.iter().take(k) {
                let ratio = if left_out > 0.0 { distance / left_out } else { 1.0 };
                let is_mutual = !mutual || back[s].iter().take(k).any(|hit| hit.0 == t);
                if is_mutual && max_ratio.is_none_or(|most| ratio <= most) {
                    expected.push(([s as u32, t as u32], 1.0 - ratio));
                }
            }
        }
        prop_assert_eq!(&found.rows, &expected.iter().map(|pair| pair.0).collect::<Vec<_>>());
        for (a, b) in found.similarity.iter().zip(&expected) {
            prop_assert!((a - b.1).abs() < 1e-12);
        }
    }
}

// ---------------------------------------------------------------------------------------------- planes, meshes

const TRIANGLE: [Point3<f64>; 3] =
    [Point3::new(0.0, 0.0, 0.0), Point3::new(3.0, 0.0, 0.0), Point3::new(0.0, 2.0, 0.0)];

proptest! {
    #[test]
    fn a_plane_is_where_it_was_put(pose in rigid_motions(1e3), seed in 0..100_u64) {
        let mut rng = Rng::new(seed);
        let on = |rng: &mut Rng| rng.in_box(1.0).component_mul(&Vector3::new(1.0, 1.0, 0.001));
        let mut points: Vec<Point3<f64>> = (0..400).map(|_| pose * Point3::from(on(&mut rng))).collect();
        let above = Vector3::new(0.0, 0.0, 1.3);
        points.extend((0..300).map(|_| pose * Point3::from(rng.in_box(1.0) + above)));
        let search = PlaneSearch { distance: 0.01, min_share: 0.3, seed };
        let plane = dominant_plane(&points, &search, None, &never()).unwrap().unwrap();
        prop_assert!(plane.normal.dot(&(pose * Vector3::z())) > 0.99999);
        prop_assert!((plane.offset - plane.normal.dot(&pose.translation.vector)).abs() < 1e-3);
        prop_assert!(plane.inliers.iter().enumerate().all(|(row, &near)| near == (row < 400)));
        let below = Some(pose * Point3::new(0.0, 0.0, -5.0));
        let turned = dominant_plane(&points, &search, below, &never()).unwrap().unwrap();
        prop_assert_eq!(turned.normal, -plane.normal);
        let strict = PlaneSearch { min_share: 0.6, ..search };
        prop_assert_eq!(dominant_plane(&points, &strict, None, &never()).unwrap(), None);
    }

    // No two of a side are too near, and none has left the face.
    #[test]
    fn samples_keep_their_distance(count in 1..300_usize, seed: u64) {
        let mesh = Mesh { vertices: &TRIANGLE, faces: &[[0, 1, 2]] };
        let sampled = sample_mesh(&mesh, Amount::Count(count), seed, &never()).unwrap();
        prop_assert_eq!(sampled.points.len(), count);
        prop_assert!(sampled.normals.iter().all(|n| *n == Vector3::z()));
        // Half the distance that a lattice would have.
        let least = 0.5 * (3.0 / (count as f64 * 0.75_f64.sqrt())).sqrt();
        for (i, p) in sampled.points.iter().enumerate() {
            prop_assert!(p.z == 0.0 && p.x >= 0.0 && p.y >= 0.0 && p.x / 3.0 + p.y / 2.0 < 1.0 + 1e-12);
            prop_assert!(sampled.points[..i].iter().all(|q| (p - q).norm() > least || count < 10));
        }
        let spaced = sample_mesh(&mesh, Amount::Spacing(0.2), seed, &never()).unwrap();
        for (i, p) in spaced.points.iter().enumerate() {
            prop_assert!(spaced.points[..i].iter().all(|q| (p - q).norm() >= 0.2));
        }
    }
}

#[test]
fn a_face_without_its_corner_is_refused() {
    let mesh = Mesh { vertices: &TRIANGLE, faces: &[[0, 1, 2], [0, 3, 1]] };
    let error = sample_mesh(&mesh, Amount::Count(9), 0, &never()).unwrap_err();
    assert_eq!(error.to_string(), "faces[1, 1] is 3; vertices has rows 0 to 2");
    let flat = Mesh { vertices: &TRIANGLE, faces: &[[0, 1, 1]] };
    let error = sample_mesh(&flat, Amount::Spacing(1.0), 0, &never()).unwrap_err();
    assert_eq!(error, FeatureError::NoArea);
}

// -------------------------------------------------------------------------------------------------------- all

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let (points, normals) = ball(3000, 8);
    let neighborhood = Neighborhood { radius: 0.2, max_neighbors: 30 };
    let run = |threads| {
        Pool::new(Some(threads)).unwrap().install(|| {
            let estimated = estimate_normals(&points, neighborhood, None, &never()).unwrap();
            let described = fpfh(&points, &normals, neighborhood, None, &never()).unwrap();
            let rows = |values| Descriptors { values, dim: FPFH_DIM };
            let (some, all) = (described[..500].as_flattened(), described.as_flattened());
            let matching = Matching { k: 3, mutual: true, max_ratio: None };
            let mesh = Mesh { vertices: &points, faces: &[[0, 1, 2], [3, 4, 5], [6, 7, 8], [9, 10, 11]] };
            let outer = outer_surface(&points, &normals, &mesh, &Views::default(), &never()).unwrap();
            let search = PlaneSearch { distance: 0.1, min_share: 0.05, seed: 0 };
            let plane = dominant_plane(&points, &search, None, &never()).unwrap();
            assert!(plane.is_some());
            (
                outer,
                plane,
                estimated,
                match_features(rows(some), rows(all), matching, &never()).unwrap(),
                described,
            )
        })
    };
    assert!(run(1) == run(2) && run(2) == run(3));
}

#[test]
fn who_is_interrupted_gets_no_answer() {
    let (points, normals) = ball(100, 1);
    let token = CancelToken::default();
    token.cancel();
    let interrupt = Interrupt::from(token);
    let neighborhood = Neighborhood { radius: 0.4, max_neighbors: 30 };
    let interrupted = Some(FeatureError::Interrupted);
    assert_eq!(estimate_normals(&points, neighborhood, None, &interrupt).err(), interrupted);
    assert_eq!(fpfh(&points, &normals, neighborhood, None, &interrupt).err(), interrupted);
    let rows = Descriptors { values: &[1.0, 2.0], dim: 1 };
    assert_eq!(match_features(rows, rows, Matching::default(), &interrupt).err(), interrupted);
    let mesh = Mesh { vertices: &TRIANGLE, faces: &[[0, 1, 2]] };
    assert_eq!(sample_mesh(&mesh, Amount::Count(9), 0, &interrupt).err(), interrupted);
    assert_eq!(outer_surface(&points, &normals, &mesh, &Views::default(), &interrupt).err(), interrupted);
    let search = PlaneSearch { distance: 0.1, min_share: 0.2, seed: 0 };
    assert_eq!(dominant_plane(&points, &search, None, &interrupt).err(), interrupted);
}

// Coordinates that a map gives, and one stray point far away.
#[test]
fn clouds_far_off_lose_nothing() {
    let (mut points, mut normals) = ball(400, 5);
    let neighborhood = Neighborhood { radius: 0.3, max_neighbors: 60 };
    let here = fpfh(&points, &normals, neighborhood, None, &never()).unwrap();
    let offset = Isometry3::translation(3e5, -5e6, 1e3);
    for p in &mut points {
        *p = offset * *p;
    }
    points.push(Point3::new(-1e9, 0.0, 1e9));
    normals.push(Vector3::z());
    let there = fpfh(&points, &normals, neighborhood, None, &never()).unwrap();
    assert!(flips(&there[..400], &here) <= 40);
    assert_eq!(there[400], [0.0; FPFH_DIM]);
}
