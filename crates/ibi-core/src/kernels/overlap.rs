//! How much of the model lies on the scene (Quan et al. 2018), and where.

use std::ops::Range;

use nalgebra::{Isometry3, Point3, Vector3};

use super::graph::up_to_sign;
use super::nearby::Nearby;
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

/// Points whose nearest neighbours one thread looks up at a time: fewer are not worth waking another.
const GRAIN: usize = 2048;

/// Where each source point lies once the pose has moved it. `nearby` holds the target, within at least
/// `contact.distance`.
///
/// # Complexity
/// O(|source|) for targets that fill a surface.
#[must_use]
pub fn places(
    source: &Surface<'_>,
    target: &Surface<'_>,
    nearby: &Nearby,
    target_from_source: &Isometry3<f64>,
    contact: &Contact,
) -> Vec<Place> {
    let chunks = par::chunks(source.points.len(), GRAIN, |rows| {
        let mut places = vec![Place::Hidden; rows.len()];
        let first = rows.start;
        each_place(source, target, nearby, target_from_source, contact, rows, |i, place, _| {
            places[i - first] = place;
        });
        places
    });
    chunks.concat()
}

/// Mean over the visible source points of max(0, 1 - d / `contact.distance`), d being the distance to the nearest
/// target point if that is not `claimed` and agrees in its normal; 0 if none is visible. [`overlap`] with a slope
/// in the place of a step: it tells a snug fit from a loose one.
///
/// # Complexity
/// As [`places`].
#[must_use]
pub fn fit(
    source: &Surface<'_>,
    target: &Surface<'_>,
    nearby: &Nearby,
    target_from_source: &Isometry3<f64>,
    contact: &Contact,
    is_claimed: impl Fn(u32) -> bool + Sync,
) -> f64 {
    let chunks = par::chunks(source.points.len(), GRAIN, |rows| {
        let (mut visible, mut sum) = (0_u32, 0.0);
        each_place(source, target, nearby, target_from_source, contact, rows, |_, place, distance| {
            visible += 1;
            if matches!(place, Place::On(row) if !is_claimed(row)) {
                sum += 1.0 - distance / contact.distance;
            }
        });
        (visible, sum)
    });
    let visible: u32 = chunks.iter().map(|(visible, _)| visible).sum();
    chunks.iter().map(|(_, sum)| sum).sum::<f64>() / f64::from(visible.max(1))
}

/// The fit of a pose that only chance has put somewhere on the target: the mean of max(0, 1 - d / distance)
/// over `samples` source points, each turned at random about another one that lies on a target point.
#[must_use]
pub fn chance_fit(
    source: &Surface<'_>,
    target: &Surface<'_>,
    nearby: &Nearby,
    contact: &Contact,
    mut rng: Rng,
    samples: usize,
) -> f64 {
    let contact = Contact { viewpoint: None, ..*contact };
    let mut sum = 0.0;
    for _ in 0..samples {
        let [i, about] = [(); 2].map(|()| rng.below(source.points.len()));
        let onto = target.points[rng.below(target.points.len())];
        let rotation = rng.rotation();
        let pose = Isometry3::from_parts((onto - rotation * source.points[about]).into(), rotation);
        each_place(source, target, nearby, &pose, &contact, i..i + 1, |_, place, distance| {
            if matches!(place, Place::On(_)) {
                sum += 1.0 - distance / contact.distance;
            }
        });
    }
    sum / samples.max(1) as f64
}

/// Tells `found(i, place, distance)` of each visible source point i of `rows`: where it lies, and how far it is from
/// the target point it lies on.
fn each_place(
    source: &Surface<'_>,
    target: &Surface<'_>,
    nearby: &Nearby,
    target_from_source: &Isometry3<f64>,
    contact: &Contact,
    rows: Range<usize>,
    mut found: impl FnMut(usize, Place, f64),
) {
    let rotation = target_from_source.rotation.to_rotation_matrix();
    let shift = target_from_source.translation.vector;
    let facing = contact.viewpoint.filter(|_| contact.oriented).zip(source.normals);
    let visible = rows.filter_map(|i| {
        let moved = rotation * source.points[i] + shift;
        let is_hidden =
            facing.is_some_and(|(eye, normals)| (rotation * normals[i]).dot(&(eye - moved)) <= 0.0);
        (!is_hidden).then_some((i, moved))
    });
    let normals = source.normals.zip(target.normals);
    nearby.nearest_each(contact.distance, visible, |i, moved, row| {
        let on =
            row.map(|row| (row, (moved - target.points[row as usize]).norm())).filter(|&(row, distance)| {
                let agree = |(n, m): (&[Vector3<f64>], &[Vector3<f64>])| {
                    up_to_sign((rotation * n[i]).dot(&m[row as usize]), contact.oriented)
                        >= contact.min_normal_cos
                };
                distance <= contact.distance && normals.is_none_or(agree)
            });
        match on {
            Some((row, distance)) => found(i, Place::On(row), distance),
            None => found(i, Place::Free, f64::INFINITY),
        }
    });
}

/// Share of the visible source points that lie on the target; 0 if none is visible.
#[must_use]
pub fn overlap(places: &[Place]) -> f64 {
    let visible = places.iter().filter(|&&place| place != Place::Hidden).count();
    let on = places.iter().filter(|place| matches!(place, Place::On(_))).count();
    on as f64 / visible.max(1) as f64
}
