//! How much of the model lies on the scene (Quan et al. 2018).

use nalgebra::{Isometry3, Point3};

use super::neighbors::Neighbors;
use super::par;

/// Share of `source` points that, moved by the pose, have a target point within `d_op` (data units).
/// 0 for an empty source.
///
/// # Complexity
/// O(|source| log |target|).
#[must_use]
pub fn overlap(
    source: &[Point3<f64>],
    target: &Neighbors,
    target_from_source: &Isometry3<f64>,
    d_op: f64,
) -> f64 {
    if source.is_empty() {
        return 0.0;
    }
    let d_op_sq = d_op * d_op;
    let close = par::map(source.len(), 64, |i| {
        let moved = target_from_source * source[i];
        target.nearest(&moved).is_some_and(|(_, dist_sq)| dist_sq <= d_op_sq)
    });
    close.iter().filter(|&&c| c).count() as f64 / source.len() as f64
}
