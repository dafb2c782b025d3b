//! Which measured points the surface of a model explains, at full resolution: what poses of different models compete for.

use nalgebra::{Isometry3, Point3, Vector3};

use super::rays::faces;
use crate::kernels::neighbors::Neighbors;

/// Points on a surface, as they are given and not moved.
#[derive(Debug, Clone, Copy)]
pub struct Shape<'a> {
    /// Data units.
    pub points: &'a [Point3<f64>],
    /// Outwards, of length 1, one for each point.
    pub normals: &'a [Vector3<f64>],
}

/// How far a measured point may lie from a point of the surface that explains it, data units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reach {
    /// Across the surface, to its tangent plane.
    pub across: f64,
    /// Along it.
    pub aside: f64,
}

/// Rows of `scan`, ascending, that a surface explains once it has been moved: those of which the nearest point of the surface, among
/// those that one of `eyes` can see, is within reach. Without eyes all of it can be seen.
///
/// # Complexity
/// O((surface + scan near it) log surface).
#[must_use]
pub fn explained(
    shape: Shape<'_>,
    target_from_source: &Isometry3<f64>,
    eyes: &[Point3<f64>],
    scan: &[Point3<f64>],
    reach: Reach,
) -> Vec<u32> {
    let back = target_from_source.inverse();
    let eyes: Vec<Point3<f64>> = eyes.iter().map(|eye| back * eye).collect();
    let is_turned = |row: usize| eyes.iter().any(|eye| faces(eye, &shape.points[row], &shape.normals[row]));
    let seen: Vec<usize> = (0..shape.points.len()).filter(|&row| eyes.is_empty() || is_turned(row)).collect();
    let Some(&first) = seen.first() else { return Vec::new() };
    let points: Vec<Point3<f64>> = seen.iter().map(|&row| shape.points[row]).collect();
    let bounds = |(low, high): (Point3<f64>, Point3<f64>), p: &Point3<f64>| (low.inf(p), high.sup(p));
    let start = (shape.points[first], shape.points[first]);
    let (low, high) = points.iter().fold(start, bounds);
    let centre = nalgebra::center(&low, &high);
    let farthest_sq = reach.across * reach.across + reach.aside * reach.aside;
    // Far points need no search.
    let radius = 0.5 * (high - low).norm() + farthest_sq.sqrt();
    let middle = target_from_source * centre;
    let tree = Neighbors::new(&points);
    let is_explained = |point: &Point3<f64>| {
        if (point - middle).norm_squared() > radius * radius {
            return false;
        }
        let point = back * point;
        tree.nearest(&point).is_some_and(|(at, dist_sq)| {
            let across = (point - points[at as usize]).dot(&shape.normals[seen[at as usize]]);
            dist_sq <= farthest_sq && across.abs() <= reach.across
        })
    };
    (0..).zip(scan).filter(|(_, point)| is_explained(point)).map(|(row, _)| row).collect()
}
