//! Scoring a pose on correspondences: mean-average-error style (Eq. 7-8; Yang et al. 2021).

use nalgebra::{Isometry3, Matrix3, Vector3};

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
    pairs.sum(|p, q| (1.0 - residual_sq(p, q).sqrt() * inv).max(0.0))
}

/// Rows of the pairs with |T p - q| < `t_he`, ascending; `t_he` in the unit of the columns.
///
/// # Complexity
/// O(pairs).
#[must_use]
pub fn close_pairs(pairs: &Columns, target_from_source: &Isometry3<f64>, t_he: f64) -> Vec<u32> {
    let residual_sq = residual_sq(pairs, target_from_source);
    let t_he_sq = (t_he * t_he) as f32;
    // All residuals first: that vectorises, and few are small.
    let mut residuals_sq = vec![0.0; pairs.len()];
    pairs.map_into(&mut residuals_sq, residual_sq);
    (0_u32..).zip(residuals_sq).filter(|&(_, r)| r < t_he_sq).map(|(i, _)| i).collect()
}

/// |T p - q|^2 as a function of (p, q), in the frame and unit of the columns.
fn residual_sq(
    pairs: &Columns,
    target_from_source: &Isometry3<f64>,
) -> impl Fn([f32; 3], [f32; 3]) -> f32 + use<> {
    let rotation = target_from_source.rotation.to_rotation_matrix();
    let (centre_p, centre_q) = pairs.centres;
    let shift = rotation * centre_p + target_from_source.translation.vector - centre_q;
    let t: Vector3<f32> = (shift / pairs.unit).cast();
    let r: Matrix3<f32> = rotation.matrix().cast();
    move |p, q| {
        let dx = r.m11 * p[0] + r.m12 * p[1] + r.m13 * p[2] + t.x - q[0];
        let dy = r.m21 * p[0] + r.m22 * p[1] + r.m23 * p[2] + t.y - q[1];
        let dz = r.m31 * p[0] + r.m32 * p[1] + r.m33 * p[2] + t.z - q[2];
        dx * dx + dy * dy + dz * dz
    }
}
