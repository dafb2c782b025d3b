//! How much of the model lies on the scene (Quan et al. 2018), and where.

use nalgebra::{Isometry3, Point3, Vector3};

use super::neighbors::Neighbors;
use super::par;

/// A cloud with its normals, if they are to count.
#[derive(Debug, Clone, Copy)]
pub struct Surface<'a> {
    /// The points.
    pub points: &'a [Point3<f64>],
    /// Unit normals, one per point.
    pub normals: Option<&'a [Vector3<f64>]>,
}

/// What it takes for a source point to lie on the target.
#[derive(Debug, Clone, Copy)]
pub struct Contact {
    /// Largest distance, data units.
    pub distance: f64,
    /// With normals: least cosine between them.
    pub min_normal_cos: f64,
    /// With normals and a viewpoint: points that face away from it cannot be seen and do not count.
    pub viewpoint: Option<Point3<f64>>,
}

/// Where a source point comes to lie.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Place {
    /// It faces away from the viewpoint.
    Hidden,
    /// No target point is near enough, or the nearest one is turned away.
    Free,
    /// On this row of the target.
    On(u32),
}

/// Where each source point lies once the pose has moved it.
///
/// # Complexity
/// O(|source| log |target|).
#[must_use]
pub fn places(
    source: &Surface<'_>,
    target: &Surface<'_>,
    neighbors: &Neighbors,
    target_from_source: &Isometry3<f64>,
    contact: &Contact,
) -> Vec<Place> {
    let distance_sq = contact.distance * contact.distance;
    par::map(source.points.len(), 64, |i| {
        let moved = target_from_source * source.points[i];
        let normal = source.normals.map(|normals| target_from_source.rotation * normals[i]);
        if let (Some(normal), Some(viewpoint)) = (normal, contact.viewpoint)
            && normal.dot(&(viewpoint - moved)) <= 0.0
        {
            return Place::Hidden;
        }
        let Some((row, dist_sq)) = neighbors.nearest(&moved) else { return Place::Free };
        let agrees = match (normal, target.normals) {
            (Some(normal), Some(normals)) => normal.dot(&normals[row as usize]) >= contact.min_normal_cos,
            _ => true,
        };
        if dist_sq <= distance_sq && agrees { Place::On(row) } else { Place::Free }
    })
}

/// Share of the visible source points that lie on the target; 0 if none is visible.
#[must_use]
pub fn overlap(places: &[Place]) -> f64 {
    let visible = places.iter().filter(|&&place| place != Place::Hidden).count();
    let on = places.iter().filter(|place| matches!(place, Place::On(_))).count();
    on as f64 / visible.max(1) as f64
}
