//! What the property tests of the metrics draw from.

use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use proptest::prelude::*;
use std::ops::Range;

/// Rigid motions: any rotation, translations within 10 of the origin.
pub(crate) fn isometries() -> impl Strategy<Value = Isometry3<f64>> {
    let quaternion = prop::array::uniform4(-1.0..1.0)
        .prop_map(|[w, i, j, k]| nalgebra::Quaternion::new(w, i, j, k))
        .prop_filter("too short to normalise", |q| q.norm() > 1e-3);
    (quaternion, prop::array::uniform3(-10.0..10.0))
        .prop_map(|(q, t)| Isometry3::from_parts(Vector3::from(t).into(), UnitQuaternion::new_normalize(q)))
}

/// Clouds within 10 of the origin, repeated and collinear points included.
pub(crate) fn points(count: Range<usize>) -> impl Strategy<Value = Vec<Point3<f64>>> {
    let coordinate = || prop_oneof![-10.0..10.0, (-2..=2_i32).prop_map(f64::from)];
    let point = (coordinate(), coordinate(), coordinate()).prop_map(|(x, y, z)| Point3::new(x, y, z));
    prop::collection::vec(point, count)
}

/// Predicted and true poses; the predictions are near a truth, several near the same one, or anywhere.
pub(super) fn scenes() -> impl Strategy<Value = (Vec<Isometry3<f64>>, Vec<Isometry3<f64>>)> {
    prop::collection::vec(isometries(), 0..6).prop_flat_map(|truth| {
        let around = truth.clone();
        let near = (any::<prop::sample::Index>(), isometries()).prop_map(move |(which, noise)| {
            let small = Isometry3::from_parts(
                (noise.translation.vector * 0.06).into(),
                Isometry3::identity().rotation.slerp(&noise.rotation, 0.15),
            );
            if around.is_empty() { noise } else { around[which.index(around.len())] * small }
        });
        (prop::collection::vec(prop_oneof![3 => near, 1 => isometries()], 0..8), Just(truth))
    })
}
