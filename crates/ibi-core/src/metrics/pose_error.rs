//! Errors between two poses that need no model.

use nalgebra::{Isometry3, Matrix4};

use crate::kernels::rotation::angle_between;

/// The angle of the rotation that leads from one pose to the other, in \[0, pi\] rad.
///
/// From the relative unit quaternion (w, v): 2 atan2(|v|, |w|). The usual arc cosine of the trace is NaN once
/// rounding lifts its argument above 1, and loses half of the digits near 0 and pi; this form does neither.
///
/// # Examples
///
/// ```
/// use ibi_core::metrics::rotation_error_rad;
/// use nalgebra::{Isometry3, Vector3};
///
/// let a = Isometry3::rotation(Vector3::z() * 0.1);
/// let b = Isometry3::rotation(Vector3::z() * 0.3);
/// assert!((rotation_error_rad(&a, &b) - 0.2).abs() < 1e-15);
/// assert_eq!(rotation_error_rad(&a, &a), 0.0);
/// ```
#[must_use]
pub fn rotation_error_rad(a: &Isometry3<f64>, b: &Isometry3<f64>) -> f64 {
    angle_between(&a.rotation, &b.rotation)
}

/// The distance of the two translations, in the unit of the data.
///
/// Depends on where the model's origin lies: for an origin far from the model, a small rotation error shows
/// as a large translation. Centre the model when the origin means nothing.
///
/// # Examples
///
/// ```
/// use ibi_core::metrics::translation_error;
/// use nalgebra::Isometry3;
///
/// let a = Isometry3::translation(1.0, 0.0, 0.0);
/// let b = Isometry3::translation(1.0, 3.0, 4.0);
/// assert_eq!(translation_error(&a, &b), 5.0);
/// ```
#[must_use]
pub fn translation_error(a: &Isometry3<f64>, b: &Isometry3<f64>) -> f64 {
    (a.translation.vector - b.translation.vector).norm()
}

/// The Frobenius norm of the difference of the two 4x4 matrices: sqrt(8 sin^2(a / 2) + d^2)
/// for a rotation error a and a translation error d.
///
/// Adds numbers without a unit to lengths, so it depends on the unit of the data: in metres rotation
/// dominates, in millimetres translation does. Kept as it is because ECC's evaluation matches by it.
///
/// # Examples
///
/// ```
/// use ibi_core::metrics::frobenius_distance;
/// use nalgebra::{Isometry3, Vector3};
/// use std::f64::consts::PI;
///
/// // Half a turn about z changes two diagonal entries from 1 to -1: sqrt(4 + 4), and 1 for the translation.
/// let half_turn = Isometry3::new(Vector3::x(), Vector3::z() * PI);
/// let distance = frobenius_distance(&Isometry3::identity(), &half_turn);
/// assert!((distance - 3.0).abs() < 1e-12);
/// ```
#[must_use]
pub fn frobenius_distance(a: &Isometry3<f64>, b: &Isometry3<f64>) -> f64 {
    let difference: Matrix4<f64> = a.to_homogeneous() - b.to_homogeneous();
    difference.norm()
}

#[cfg(test)]
mod tests {
    use super::super::strategies::isometries;
    use super::*;
    use nalgebra::{Unit, UnitQuaternion, Vector3};
    use proptest::prelude::*;
    use std::f64::consts::PI;

    proptest! {
        #[test]
        fn the_angle_is_the_one_turned_by(a in isometries(), axis in isometries(), angle in 0.0..=PI) {
            let axis = Unit::new_normalize(axis.rotation * Vector3::x());
            let b = a * UnitQuaternion::from_axis_angle(&axis, angle);
            prop_assert!((rotation_error_rad(&a, &b) - angle).abs() < 1e-14);
        }

        // The matrix form of the same angle: |skew part| = 2 sqrt(2) sin, trace = 1 + 2 cos.
        #[test]
        fn the_angle_agrees_with_the_matrix_form(a in isometries(), b in isometries()) {
            let relative = (a.rotation.inverse() * b.rotation).to_rotation_matrix().into_inner();
            let sine = (relative - relative.transpose()).norm() / 8.0_f64.sqrt();
            let cosine = (relative.trace() - 1.0) / 2.0;
            prop_assert!((rotation_error_rad(&a, &b) - sine.atan2(cosine)).abs() < 1e-12);
        }

        #[test]
        fn frobenius_is_a_function_of_angle_and_translation(a in isometries(), b in isometries()) {
            let half_sine = (rotation_error_rad(&a, &b) / 2.0).sin();
            let expected = (8.0 * half_sine * half_sine + translation_error(&a, &b).powi(2)).sqrt();
            prop_assert!((frobenius_distance(&a, &b) - expected).abs() < 1e-12);
        }

        // Moving the scene (left) changes no error; moving the model (right) changes only translations.
        #[test]
        fn invariances(a in isometries(), b in isometries(), motion in isometries()) {
            let (left_a, left_b) = (motion * a, motion * b);
            prop_assert!((rotation_error_rad(&left_a, &left_b) - rotation_error_rad(&a, &b)).abs() < 1e-12);
            prop_assert!((translation_error(&left_a, &left_b) - translation_error(&a, &b)).abs() < 1e-12);
            prop_assert!((frobenius_distance(&left_a, &left_b) - frobenius_distance(&a, &b)).abs() < 1e-12);
            let (right_a, right_b) = (a * motion, b * motion);
            prop_assert!((rotation_error_rad(&right_a, &right_b) - rotation_error_rad(&a, &b)).abs() < 1e-12);
        }

        #[test]
        fn symmetric_and_zero_on_itself(a in isometries(), b in isometries()) {
            prop_assert_eq!(frobenius_distance(&a, &b), frobenius_distance(&b, &a));
            prop_assert!((rotation_error_rad(&a, &b) - rotation_error_rad(&b, &a)).abs() < 1e-15);
            prop_assert!(rotation_error_rad(&a, &a) < 1e-15);
            prop_assert_eq!(translation_error(&a, &a), 0.0);
        }
    }

    #[test]
    fn tiny_angles_keep_their_digits() {
        // The arc cosine of the trace would answer 0 here: cos(1e-9) rounds to 1.
        let b = Isometry3::rotation(Vector3::x() * 1e-9);
        assert!((rotation_error_rad(&Isometry3::identity(), &b) / 1e-9 - 1.0).abs() < 1e-12);
    }

    #[test]
    fn half_a_turn_is_pi_about_any_axis() {
        for axis in [Vector3::x(), Vector3::y(), Vector3::z(), Vector3::new(1.0, -2.0, 3.0).normalize()] {
            let b = Isometry3::rotation(axis * PI);
            assert!((rotation_error_rad(&Isometry3::identity(), &b) - PI).abs() < 1e-15);
        }
    }
}
