//! How much of the model lies on the scene (Quan et al. 2018), and where.

use nalgebra::{Isometry3, Point3, Vector3};

use super::graph::up_to_sign;
use super::neighbors::Neighbors;
use super::par;
use super::rng::Rng;

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
    /// Whether the sign of a normal means something; else the magnitude of the cosine counts.
    pub oriented: bool,
    /// With oriented normals and a viewpoint: points that face away from it cannot be seen and do not count.
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
    par::map(source.points.len(), 64, |i| place(source, target, neighbors, target_from_source, contact, i).0)
}

/// Mean over the visible source points of max(0, 1 - d / `contact.distance`), d being the distance to the nearest
/// target point if that is not `claimed` and agrees in its normal; 0 if none is visible. [`overlap`] with a slope
/// in the place of a step: it tells a snug fit from a loose one.
///
/// # Complexity
/// O(|source| log |target|).
#[must_use]
pub fn fit(
    source: &Surface<'_>,
    target: &Surface<'_>,
    neighbors: &Neighbors,
    target_from_source: &Isometry3<f64>,
    contact: &Contact,
    claimed: Option<&[bool]>,
) -> f64 {
    let near = par::map(source.points.len(), 64, |i| {
        match place(source, target, neighbors, target_from_source, contact, i) {
            (Place::Hidden, _) => None,
            (Place::On(row), dist_sq) if claimed.is_none_or(|claimed| !claimed[row as usize]) => {
                Some(1.0 - dist_sq.sqrt() / contact.distance)
            }
            _ => Some(0.0),
        }
    });
    let visible = near.iter().flatten().count();
    near.iter().flatten().sum::<f64>() / visible.max(1) as f64
}

/// The fit of a pose that only chance has put somewhere on the target: the mean of max(0, 1 - d / distance)
/// over `samples` source points, each turned at random about another one that lies on a target point.
#[must_use]
pub fn chance_fit(
    source: &Surface<'_>,
    target: &Surface<'_>,
    neighbors: &Neighbors,
    contact: &Contact,
    mut rng: Rng,
    samples: usize,
) -> f64 {
    let contact = Contact { viewpoint: None, ..*contact };
    let poses: Vec<(usize, Isometry3<f64>)> = (0..samples)
        .map(|_| {
            let [i, about] = [(); 2].map(|()| rng.below(source.points.len()));
            let onto = target.points[rng.below(target.points.len())];
            let rotation = rng.rotation();
            let shift = onto - rotation * source.points[about];
            (i, Isometry3::from_parts(shift.into(), rotation))
        })
        .collect();
    let near = par::map(samples, 64, |s| {
        let (i, pose) = &poses[s];
        match place(source, target, neighbors, pose, &contact, *i) {
            (Place::On(_), dist_sq) => 1.0 - dist_sq.sqrt() / contact.distance,
            _ => 0.0,
        }
    });
    near.iter().sum::<f64>() / samples.max(1) as f64
}

/// Where source point i lies, and the squared distance to the target point nearest to it.
fn place(
    source: &Surface<'_>,
    target: &Surface<'_>,
    neighbors: &Neighbors,
    target_from_source: &Isometry3<f64>,
    contact: &Contact,
    i: usize,
) -> (Place, f64) {
    let moved = target_from_source * source.points[i];
    let normal = source.normals.map(|normals| target_from_source.rotation * normals[i]);
    if let (Some(normal), Some(viewpoint), true) = (normal, contact.viewpoint, contact.oriented)
        && normal.dot(&(viewpoint - moved)) <= 0.0
    {
        return (Place::Hidden, f64::INFINITY);
    }
    let Some((row, dist_sq)) = neighbors.nearest(&moved) else { return (Place::Free, f64::INFINITY) };
    let agrees = match (normal, target.normals) {
        (Some(normal), Some(normals)) => {
            up_to_sign(normal.dot(&normals[row as usize]), contact.oriented) >= contact.min_normal_cos
        }
        _ => true,
    };
    let is_on = dist_sq <= contact.distance * contact.distance && agrees;
    (if is_on { Place::On(row) } else { Place::Free }, dist_sq)
}

/// Share of the visible source points that lie on the target; 0 if none is visible.
#[must_use]
pub fn overlap(places: &[Place]) -> f64 {
    let visible = places.iter().filter(|&&place| place != Place::Hidden).count();
    let on = places.iter().filter(|place| matches!(place, Place::On(_))).count();
    on as f64 / visible.max(1) as f64
}
