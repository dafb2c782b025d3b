//! The checks at the door; what is behind it trusts its input.

use nalgebra::{Point3, Vector3};

use super::FeatureError;
use crate::checks::{MAX_COORDINATE, first_not_finite, unit_vectors};

/// No more rows than 32-bit ids can name, all of them finite.
pub(super) fn check_points(argument: &'static str, points: &[Point3<f64>]) -> Result<(), FeatureError> {
    check_len(argument, points.len())?;
    check_finite(argument, points.iter().map(|p| p.coords))
}

pub(super) fn check_len(argument: &'static str, len: usize) -> Result<(), FeatureError> {
    if len >= u32::MAX as usize { Err(FeatureError::TooMany { argument, len }) } else { Ok(()) }
}

/// The same for one place.
pub(super) fn check_place(argument: &'static str, place: Option<&Point3<f64>>) -> Result<(), FeatureError> {
    check_finite(argument, place.iter().map(|p| p.coords))
}

fn check_finite(
    argument: &'static str,
    rows: impl Iterator<Item = Vector3<f64>>,
) -> Result<(), FeatureError> {
    match first_not_finite(rows) {
        Some((row, value)) => Err(FeatureError::NotFinite { argument, row, value }),
        None => Ok(()),
    }
}

/// One normal of length 1 for each of `points`.
pub(super) fn unit_normals(
    argument: &'static str,
    normals: &[Vector3<f64>],
    expected: usize,
) -> Result<Vec<Vector3<f64>>, FeatureError> {
    if normals.len() != expected {
        return Err(FeatureError::LengthMismatch { argument, len: normals.len(), of: "points", expected });
    }
    check_finite(argument, normals.iter().copied())?;
    unit_vectors(normals).map_err(|row| FeatureError::ZeroNormal { argument, row })
}

/// A length that must be more than 0.
pub(super) fn check_length(argument: &'static str, value: f64) -> Result<(), FeatureError> {
    if value > 0.0 && value < MAX_COORDINATE {
        return Ok(());
    }
    Err(FeatureError::Setting { argument, value, allowed: "above 0 and finite" })
}
