//! What the property tests draw from.

use nalgebra::{Isometry3, Point3, Quaternion, Translation3, UnitQuaternion, Vector3};
use proptest::prelude::*;
use std::ops::Range;

use crate::naive::Pair;

/// Coordinates on a grid of 2^-10 within 10 of 0, often the same few: points either coincide exactly or are
/// far enough apart for `f32` to tell, so that oracles in `f64` agree on which ones coincide.
pub fn coordinates() -> impl Strategy<Value = f64> + Clone {
    prop_oneof![
        3 => (-10_240..=10_240_i32).prop_map(|x| f64::from(x) / 1024.0),
        1 => (-2..=2_i32).prop_map(f64::from),
    ]
}

/// Points within 10 of the origin along each axis; repeated, collinear and coplanar ones among them.
pub fn point() -> impl Strategy<Value = Point3<f64>> + Clone {
    (coordinates(), coordinates(), coordinates()).prop_map(|(x, y, z)| Point3::new(x, y, z))
}

/// A cloud of [`point`]s.
pub fn points(count: Range<usize>) -> impl Strategy<Value = Vec<Point3<f64>>> {
    prop::collection::vec(point(), count)
}

/// Any rotation, translations within `reach` along each axis.
pub fn rigid_motions(reach: f64) -> impl Strategy<Value = Isometry3<f64>> + Clone {
    let rotation = prop::array::uniform4(-1.0..1.0)
        .prop_map(|[w, i, j, k]| Quaternion::new(w, i, j, k))
        .prop_filter("too short to normalise", |q| q.norm() > 1e-3)
        .prop_map(UnitQuaternion::new_normalize);
    (rotation, prop::array::uniform3(-reach..reach))
        .prop_map(|(r, t)| Isometry3::from_parts(Translation3::from(Vector3::from(t)), r))
}

/// Correspondences: some true for one motion up to small noise, some arbitrary.
pub fn correspondences(count: Range<usize>) -> impl Strategy<Value = Vec<Pair>> {
    let noise = prop::array::uniform3(-0.1..0.1).prop_map(Vector3::from);
    let draw = (point(), point(), noise, any::<bool>());
    (rigid_motions(5.0), prop::collection::vec(draw, count)).prop_map(|(pose, draws)| {
        let pair = |(p, q, noise, right): (Point3<f64>, Point3<f64>, Vector3<f64>, bool)| {
            // Back onto the grid of `coordinates`.
            let near = (pose * p + noise).map(|x| (x * 1024.0).round() / 1024.0);
            (p, if right { near } else { q })
        };
        draws.into_iter().map(pair).collect()
    })
}

/// Scores in descending order, ties among them.
pub fn scores(count: Range<usize>) -> impl Strategy<Value = Vec<f32>> {
    let score = prop_oneof![0.0..100.0_f32, (0..4_u8).prop_map(f32::from)];
    prop::collection::vec(score, count).prop_map(|mut scores| {
        scores.sort_by(|a, b| b.total_cmp(a));
        scores
    })
}

/// Values >= 0 with at most 16 significant bits, so that multiples of them up to 2^8 are exact in `f32`.
pub fn levels(count: Range<usize>) -> impl Strategy<Value = Vec<f32>> {
    let level = prop_oneof![0..65_536_u32, 0..4_u32].prop_map(|x| x as f32 / 1024.0);
    prop::collection::vec(level, count)
}

/// A symmetric matrix, row-major n x n, with a zero diagonal and entries in 0..=1, zeros among them.
pub fn payoffs(size: Range<usize>) -> impl Strategy<Value = (usize, Vec<f32>)> {
    let entry = prop_oneof![2 => 0.0..1.0_f32, 1 => Just(0.0_f32)];
    size.prop_flat_map(move |n| (Just(n), prop::collection::vec(entry.clone(), n * n))).prop_map(
        |(n, mut matrix)| {
            for i in 0..n {
                matrix[i * n + i] = 0.0;
                for j in 0..i {
                    matrix[i * n + j] = matrix[j * n + i];
                }
            }
            (n, matrix)
        },
    )
}

/// An order of 0..n.
pub fn permutations(n: usize) -> impl Strategy<Value = Vec<usize>> {
    Just((0..n).collect::<Vec<_>>()).prop_shuffle()
}
