//! The rigid motion that best maps points onto points (Kabsch 1976; Umeyama 1991 for the sign).

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// Relative size of the second singular value below which the points count as collinear, where the rotation
/// about their line would be anyone's guess.
const RANK_TOLERANCE: f64 = 1e-10;

/// The `target_from_source` that minimises sum |T p_i - q_i|^2 over the pairs; a proper rotation always.
/// `None` for fewer than three pairs, or when either side's points are collinear or coincide.
#[must_use]
pub fn rigid_fit<'a, I>(pairs: I) -> Option<Isometry3<f64>>
where
    I: IntoIterator<Item = (&'a Point3<f64>, &'a Point3<f64>)> + Clone,
{
    let (mut n, mut sum_p, mut sum_q) = (0_u32, Vector3::zeros(), Vector3::zeros());
    for (p, q) in pairs.clone() {
        n += 1;
        sum_p += p.coords;
        sum_q += q.coords;
    }
    if n < 3 {
        return None;
    }
    let (mean_p, mean_q) = (sum_p / f64::from(n), sum_q / f64::from(n));
    let mut covariance = Matrix3::zeros();
    for (p, q) in pairs {
        covariance += (q.coords - mean_q) * (p.coords - mean_p).transpose();
    }
    let svd = covariance.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let s = svd.singular_values;
    if s[1] <= RANK_TOLERANCE * s[0] {
        return None;
    }
    // A reflection fits best when noise turns flat points inside out; the axis to flip is the weakest one.
    // nalgebra sorts the singular values in descending order.
    let sign = (u.determinant() * v_t.determinant()).signum();
    let rotation = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t;
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    let translation = mean_q - rotation * mean_p;
    let pose = Isometry3::from_parts(Translation3::from(translation), rotation);
    pose.to_homogeneous().iter().all(|x| x.is_finite()).then_some(pose)
}

/// The smallest altitude of a triangle: how far its points are from one line. 0 if they coincide.
#[must_use]
pub fn triangle_height(a: &Point3<f64>, b: &Point3<f64>, c: &Point3<f64>) -> f64 {
    let (u, v, w) = (b - a, c - a, c - b);
    let longest = u.norm_squared().max(v.norm_squared()).max(w.norm_squared()).sqrt();
    if longest > 0.0 { u.cross(&v).norm() / longest } else { 0.0 }
}
