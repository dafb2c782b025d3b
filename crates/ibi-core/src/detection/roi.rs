//! A box to look into.

use nalgebra::{Isometry3, Point3, Vector3};

use super::DetectionError;

/// A box in the scan: what lies outside is not searched, nor matched, but it stays in what was measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Roi {
    /// Moves a box about the origin, its sides along the axes, to where it is in the scan; data units.
    pub target_from_box: Isometry3<f64>,
    /// Lengths of its sides, data units; above 0.
    pub size: Vector3<f64>,
}

impl Roi {
    /// One with its sides along the axes of the scan, between two corners of which `low` has the lesser coordinates.
    #[must_use]
    pub fn between(low: Point3<f64>, high: Point3<f64>) -> Self {
        let middle = nalgebra::center(&low, &high);
        Self { target_from_box: Isometry3::translation(middle.x, middle.y, middle.z), size: high - low }
    }

    /// Whether a point lies in it, or on its surface.
    #[must_use]
    pub fn contains(&self, point: &Point3<f64>) -> bool {
        let inside = self.target_from_box.inverse_transform_point(point);
        (0..3).all(|axis| 2.0 * inside[axis].abs() <= self.size[axis])
    }

    pub(super) fn check(&self) -> Result<(), DetectionError> {
        let is_finite = self.target_from_box.to_homogeneous().iter().all(|x| x.is_finite());
        if !is_finite {
            return Err(DetectionError::RoiPlace);
        }
        match (0..3).find(|&axis| !(self.size[axis] > 0.0 && self.size[axis].is_finite())) {
            Some(axis) => Err(DetectionError::RoiSize { axis, size: self.size[axis] }),
            None => Ok(()),
        }
    }
}
