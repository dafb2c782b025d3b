//! Whether the scene goes on where the part should end.
//!
//! A flat face fits on any larger flat surface; what tells them apart is where it ends. Around the faces of a model there are
//! places where its surface does not go on: just beyond its creases and rims. Where a pose puts the face on what was measured, and
//! what was measured goes on at such a place, the pose is a part of something larger: another part, a wall, the same part elsewhere.

use nalgebra::{Isometry3, Point3, Vector3};

use super::rays::Rays;
use super::seen::{Look, Seen, Tolerance, look};
use crate::kernels::nearby::Nearby;
use crate::kernels::sight::across;

/// Places just beyond the ends of a model's faces, in its frame: where the tangent plane goes on and the surface does not.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Rim {
    /// The point of the model that each belongs to, by row.
    pub rows: Vec<u32>,
    /// From there to the place, in the tangent plane.
    pub offsets: Vec<Vector3<f64>>,
}

/// Directions in which the surface around a point is followed.
const DIRECTIONS: usize = 8;

/// Of the way that a tangent plane is followed: how far at least the surface must have fallen away, and how far at most the place
/// may lie within the part, as it does beyond an inner crease.
const FALLEN: f64 = 0.6;
const WITHIN: f64 = 0.15;

impl Rim {
    /// Of points on a surface, with outward unit normals. Tangent planes are followed for `reach`, at least 1.5 spacings of the
    /// points; the surface must have fallen away by more than `fallen`, or 0.6 of the reach if that is more.
    ///
    /// # Complexity
    /// O(points).
    #[must_use]
    pub fn new(points: &[Point3<f64>], normals: &[Vector3<f64>], reach: f64, fallen: f64) -> Self {
        let fallen = fallen.max(FALLEN * reach);
        let probes = || {
            points.iter().zip(normals).flat_map(|(_, normal)| {
                let [u, v] = across(normal);
                (0..DIRECTIONS).map(move |k| {
                    let (sin, cos) = (std::f64::consts::TAU * k as f64 / DIRECTIONS as f64).sin_cos();
                    reach * (cos * u + sin * v)
                })
            })
        };
        let places: Vec<Point3<f64>> =
            probes().enumerate().map(|(at, offset)| points[at / DIRECTIONS] + offset).collect();
        // Its own point is that near.
        let within = 1.01 * reach;
        let nearest = Nearby::new(points, within).nearest_each(within, &places);
        let mut rim = Self::default();
        for (at, ((offset, place), row)) in probes().zip(&places).zip(nearest).enumerate() {
            let is_beyond = row.is_none_or(|row| {
                let gap = place - points[row as usize];
                gap.norm() > fallen && gap.dot(&normals[row as usize]) > -WITHIN * reach
            });
            if is_beyond {
                rim.rows.push((at / DIRECTIONS) as u32);
                rim.offsets.push(offset);
            }
        }
        rim
    }

    /// The places beyond points of the model that are supported, once a pose has moved them: the row of each point and the place.
    fn beyond<'a>(
        &'a self,
        points: &'a [Point3<f64>],
        sight: &'a [Look],
        target_from_source: &Isometry3<f64>,
    ) -> impl Iterator<Item = (usize, Point3<f64>)> + 'a {
        let rotation = target_from_source.rotation.to_rotation_matrix();
        let all = self.rows.iter().zip(&self.offsets).map(|(&row, offset)| (row as usize, offset));
        let supported = all.filter(|(row, _)| sight[*row].seen == Seen::Supported);
        supported.map(move |(row, offset)| (row, points[row] + rotation * offset))
    }
}

/// A scan with normals, thinned or not.
#[derive(Debug, Clone, Copy)]
pub struct Scan<'a> {
    /// The points.
    pub points: &'a [Point3<f64>],
    /// Unit normals towards the eye.
    pub normals: &'a [Vector3<f64>],
    /// Finds the points, within as far as a function says that it asks.
    pub nearby: &'a Nearby,
}

/// A model that a pose has moved, and what is said of each of its points.
#[derive(Debug, Clone, Copy)]
pub struct Placed<'a> {
    /// The pose.
    pub target_from_source: &'a Isometry3<f64>,
    /// Its points, moved.
    pub points: &'a [Point3<f64>],
    /// Their normals, turned.
    pub normals: &'a [Vector3<f64>],
    /// What the eye, or all of them, say of each.
    pub sight: &'a [Look],
}

/// What was measured just beyond the ends of a model's faces.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct Contour {
    /// The face goes on: speaks against the pose.
    pub runs_on: u32,
    /// It ends: the eye sees past it.
    pub ends: u32,
    /// Something else is in front, the part itself perhaps, or nothing was measured: nothing is told.
    pub unknown: u32,
}

/// Least cosine between the normals of a face and of what goes on beyond it, in the plane of the face.
const SAME_FACE_COS: f64 = 0.8;

/// A face goes on where a point of the scan lies within `aside` (a voxel of a thinned scan) of a place beyond its end, in its tangent
/// plane and with its normal. It ends where it does not and all that one of the eyes measured there lies behind. Where no `rays` are known
/// it ends wherever it does not go on.
///
/// # Complexity
/// O(places of the rim), times the rays that pass near each.
#[must_use]
pub fn contour(
    rim: &Rim,
    scan: Scan<'_>,
    rays: &[&Rays],
    placed: Placed<'_>,
    tolerance: Tolerance,
    aside: f64,
) -> Contour {
    let beyond = rim.beyond(placed.points, placed.sight, placed.target_from_source);
    let (rows, places): (Vec<usize>, Vec<Point3<f64>>) = beyond.unzip();
    let nearest = scan.nearby.nearest_each(aside, &places);
    let mut contour = Contour::default();
    for ((row, place), near) in rows.into_iter().zip(&places).zip(nearest) {
        let normal = &placed.normals[row];
        let goes_on = near.is_some_and(|near| {
            let near = near as usize;
            let gap = (scan.points[near] - place).dot(normal);
            gap.abs() <= tolerance.across && scan.normals[near].dot(normal) >= SAME_FACE_COS
        });
        let sees_past = |rays: &&Rays| look(rays, place, normal, tolerance).seen == Seen::Contradicted;
        let is_past = || rays.is_empty() || rays.iter().any(sees_past);
        *if goes_on {
            &mut contour.runs_on
        } else if is_past() {
            &mut contour.ends
        } else {
            &mut contour.unknown
        } += 1;
    }
    contour
}

/// How many places of the rim the faces of a part run on at, as the rays alone have it: each counts as the share of its rays that end
/// in the tangent plane, of the eye of which most do. Where a pose shifts a little that changes a little, so it is for the search for a better one
/// ([`super::slip::worth`]); [`contour`], which also compares normals, tells more of where it ends up.
#[must_use]
pub fn run_on(rim: &Rim, rays: &[&Rays], placed: Placed<'_>, tolerance: Tolerance) -> f64 {
    let beyond = rim.beyond(placed.points, placed.sight, placed.target_from_source);
    let share = |(row, place): (usize, Point3<f64>)| {
        rays.iter().map(|rays| look(rays, &place, &placed.normals[row], tolerance).share).fold(0.0, f64::max)
    };
    beyond.map(share).sum()
}

/// What was measured around a part, where it should not be.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct Overrun {
    /// Points of the scan outside of the part that carry a supported face of it on: speak against the pose.
    pub beyond: u32,
    /// Points of the scan on the part, near a supported face.
    pub on: u32,
}

/// How far a point must lie from the part to be outside of it, and how far it may, voxels.
const OUTSIDE_VOXELS: f64 = 0.9;
const AROUND_VOXELS: f64 = 2.4;

/// Of points around a part: how steeply they may leave its tangent plane, and the least cosine between normals. Smooth surfaces go
/// on, too.
const LEAVING: f64 = 0.3;
const GOES_ON_COS: f64 = 0.85;

/// Points of a scan that was thinned to a `voxel` on a part and around it. Unlike [`contour`] it needs no creases: a ball of 0.8
/// times the size is overrun as a box is. `near_source` holds the model's points, best for questions within 2.4 voxels; `centre` and
/// `radius`
/// are of a ball around the model, in its frame.
///
/// # Complexity
/// O(points of the scan in the ball), times those of the model around each.
#[must_use]
pub fn overrun(
    near_source: &Nearby,
    (centre, radius): (&Point3<f64>, f64),
    scan: Scan<'_>,
    placed: Placed<'_>,
    across: f64,
    voxel: f64,
) -> Overrun {
    let reach = AROUND_VOXELS * voxel;
    let pose = placed.target_from_source;
    let back = pose.inverse();
    let (rotation, shift) = (back.rotation.to_rotation_matrix(), back.translation.vector);
    let mut overrun = Overrun::default();
    for row in scan.nearby.within(&(pose * centre), radius + reach) {
        let row = row as usize;
        let point = &scan.points[row];
        // The nearest point of all may lie on a side of the part that nothing is known of.
        let (mut nearest, mut least, mut least_of_all) = (None, f64::INFINITY, f64::INFINITY);
        for near in near_source.within(&(rotation * point + shift), reach) {
            let near = near as usize;
            let far_sq = (point - placed.points[near]).norm_squared();
            least_of_all = least_of_all.min(far_sq);
            if far_sq < least && placed.sight[near].seen == Seen::Supported {
                (nearest, least) = (Some(near), far_sq);
            }
        }
        let Some(near) = nearest else { continue };
        let (gap, normal) = (point - placed.points[near], &placed.normals[near]);
        if least_of_all < (OUTSIDE_VOXELS * voxel).powi(2) {
            overrun.on += 1;
        } else if gap.dot(normal).abs() < across.max(LEAVING * least.sqrt())
            && scan.normals[row].dot(normal) > GOES_ON_COS
        {
            overrun.beyond += 1;
        }
    }
    overrun
}
