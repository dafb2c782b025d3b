//! Scoring a pose on correspondences: mean-average-error style (Eq. 7-8; Yang et al. 2021).

use nalgebra::Isometry3;

use super::columns::Columns;

/// sum over pairs of max(0, (`t_he` - e) / `t_he`) with e = |T p - q|: Eq. 7-8. `t_he` in the unit of
/// the columns.
///
/// # Complexity
/// O(pairs).
#[must_use]
pub fn mae(pairs: &Columns, target_from_source: &Isometry3<f64>, t_he: f64) -> f32 {
    let residual_sq = residual_sq(pairs, target_from_source);
    let inv = 1.0 / t_he as f32;
    pairs.sum(move |p, q| (1.0 - residual_sq(p, q).sqrt() * inv).max(0.0))
}

/// |T p - q|^2 as a function of (p, q), in the frame and unit of the columns.
pub(crate) fn residual_sq(
    pairs: &Columns,
    target_from_source: &Isometry3<f64>,
) -> impl Fn([f32; 3], [f32; 3]) -> f32 + Copy + use<> {
    let (r, t) = pairs.frame(target_from_source);
    move |p, q| {
        let dx = r.m11 * p[0] + r.m12 * p[1] + r.m13 * p[2] + t.x - q[0];
        let dy = r.m21 * p[0] + r.m22 * p[1] + r.m23 * p[2] + t.y - q[1];
        let dz = r.m31 * p[0] + r.m32 * p[1] + r.m33 * p[2] + t.z - q[2];
        dx * dx + dy * dy + dz * dz
    }
}
