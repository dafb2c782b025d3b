//! Angles of rotations.

use nalgebra::UnitQuaternion;

/// The angle from one rotation to another, in \[0, pi\] rad; good to the last digits near 0 and pi, too.
#[must_use]
pub(crate) fn angle_between(a: &UnitQuaternion<f64>, b: &UnitQuaternion<f64>) -> f64 {
    let relative = a.inverse() * b;
    // |w|: a quaternion and its negative are the same rotation.
    2.0 * relative.imag().norm().atan2(relative.w.abs())
}
