//! How far the points of a scan lie off the surface that they were measured on.

use nalgebra::{Matrix3, Point3, Vector3};

use super::rays::{MAX_ANGLE, Rays};
use crate::kernels::nearby::Nearby;

/// Points that a plane is laid through.
const NEIGHBORS: usize = 12;

/// Of a plane through points.
const FREEDOMS: usize = 3;

/// Points that are asked.
const SAMPLE: usize = 1024;

/// The standard deviation, across the surface, of the points that an eye measured: the median over some of them of how far the
/// 12 whose rays are nearest lie off their common plane. Edges are too few to count, curvature is too slight from one ray to the
/// next. What bends a whole surface (a lens, a wavy depth) is not in it. 0 for fewer than 12 points.
#[must_use]
pub fn noise_of_rays(rays: &Rays, points: &[Point3<f64>]) -> f64 {
    // A disc of 4 spacings holds some 50 rays of a regular image.
    let around = |point: &Point3<f64>| {
        let to = (point - rays.eye()).normalize();
        let mut near = Vec::new();
        rays.each_near(point, 4.0 * rays.spacing(), |end, _| {
            near.push((to.cross(end).norm_squared() / end.norm_squared(), Point3::from(*end)));
        });
        near
    };
    median_roughness(points, around)
}

/// How far apart the points are that an eye measured, on surfaces as it sees them: as if those within `radius` of some `points`, the median
/// of their numbers, filled the disc. Pixels without a depth are none. Infinite where there are no points.
#[must_use]
pub fn spacing_of_rays(rays: &Rays, points: &[Point3<f64>], radius: f64) -> f64 {
    let some = points.iter().step_by(points.len().div_ceil(SAMPLE).max(1));
    let around = |point: &Point3<f64>| {
        let to = point - rays.eye();
        let mut count = 0.0;
        rays.each_near(point, (radius / to.norm()).min(MAX_ANGLE), |end, _| {
            count += f64::from(u8::from((end - to).norm() <= 2.0 * radius));
        });
        count
    };
    let mut counts: Vec<f64> = some.map(around).collect();
    let middle = counts.len() / 2;
    let most = if counts.is_empty() { 0.0 } else { *counts.select_nth_unstable_by(middle, f64::total_cmp).1 };
    (std::f64::consts::PI / most).sqrt() * radius
}

/// An edge is a disc of rays, this wide and this deep, voxels; and so few rays or edges tell nothing.
const EDGE_RADIUS: f64 = 1.5;
const EDGE_DEPTH: f64 = 4.0;
const FEW_RAYS: usize = 6;
const FEW_EDGES: usize = 30;

/// A ray is one of those that the points were made of if it ends so near to one, voxels. Among those alone steps are not as deep, and edges
/// less sharp by so much: of piles of the tuning half they have 0.33 to 0.60 for 0.45 to 0.75.
const OWN: f64 = 2.0;
const OWN_LESS: f64 = 0.12;

/// How sharp the edges are at which one surface ends before another: of all discs of rays 1.5 voxels about some of the points, whose ends
/// span 4 voxels in depth, the mean share of that span that no ray ends in. Near 1 where rays end on one surface or the other, and small
/// where what measured has smoothed the step (a window of stereo, light that spreads) and rays end all over it. What is told by the rays
/// that the points were made of, those of `nearby`, counts if it is less: what they lie on may have been measured otherwise. `None` where
/// there is hardly an edge.
#[must_use]
pub fn sharpness_of_edges(rays: &Rays, points: &[Point3<f64>], nearby: &Nearby, voxel: f64) -> Option<f64> {
    let [mut of_all, mut of_own] = [const { Vec::new() }; 2];
    for point in points.iter().step_by(points.len().div_ceil(SAMPLE).max(1)) {
        let angle = (EDGE_RADIUS * voxel / (point - rays.eye()).norm()).min(MAX_ANGLE);
        let mut ends = Vec::new();
        rays.each_near(point, angle, |end, _| ends.push(*end));
        let gap = widest_gap(ends.iter().map(Vector3::norm), voxel);
        if gap.is_none() {
            continue;
        }
        of_all.extend(gap);
        let is_own = |end: &&Vector3<f64>| nearby.within(&(rays.eye() + *end), OWN * voxel).next().is_some();
        of_own.extend(widest_gap(ends.iter().filter(is_own).map(Vector3::norm), voxel));
    }
    let mean = |gaps: &[f64]| (gaps.len() >= FEW_EDGES).then(|| gaps.iter().sum::<f64>() / gaps.len() as f64);
    let of_own = mean(&of_own).map_or(f64::INFINITY, |of_own| of_own + OWN_LESS);
    mean(&of_all).map(|of_all| of_all.min(of_own))
}

/// The widest gap between ranges that span the depth of an edge, in spans.
fn widest_gap(ranges: impl Iterator<Item = f64>, voxel: f64) -> Option<f64> {
    let mut ranges: Vec<f64> = ranges.collect();
    ranges.sort_unstable_by(f64::total_cmp);
    let span = ranges.last()? - ranges[0];
    let is_edge = ranges.len() >= FEW_RAYS && span >= EDGE_DEPTH * voxel;
    is_edge.then(|| ranges.windows(2).map(|pair| pair[1] - pair[0]).fold(0.0, f64::max) / span)
}

/// The same as [`noise_of_rays`] of a scan that no single eye made: of the 12 nearest points, within the reach of `nearby`, which holds the points.
#[must_use]
pub fn noise_of_cloud(points: &[Point3<f64>], nearby: &Nearby) -> f64 {
    let around = |point: &Point3<f64>| {
        let rows = nearby.within(point, nearby.reach());
        rows.map(|row| ((points[row as usize] - point).norm_squared(), points[row as usize])).collect()
    };
    median_roughness(points, around)
}

fn median_roughness(points: &[Point3<f64>], around: impl Fn(&Point3<f64>) -> Vec<(f64, Point3<f64>)>) -> f64 {
    let some = points.iter().step_by(points.len().div_ceil(SAMPLE).max(1));
    let mut all: Vec<f64> = some.filter_map(|point| roughness(around(point))).collect();
    let middle = all.len() / 2;
    if all.is_empty() { 0.0 } else { *all.select_nth_unstable_by(middle, f64::total_cmp).1 }
}

/// Root mean square distance of the nearest of some points from their plane, for as many degrees of freedom as it leaves.
fn roughness(mut near: Vec<(f64, Point3<f64>)>) -> Option<f64> {
    if near.len() < NEIGHBORS {
        return None;
    }
    let order = |a: &(f64, Point3<f64>), b: &(f64, Point3<f64>)| {
        let [a, b] = [a, b].map(|(far, p)| (*far, p.x, p.y, p.z));
        a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.total_cmp(&b.2)).then(a.3.total_cmp(&b.3))
    };
    near.select_nth_unstable_by(NEIGHBORS - 1, order);
    near.truncate(NEIGHBORS);
    let middle = near.iter().map(|(_, p)| p.coords).sum::<Vector3<f64>>() / NEIGHBORS as f64;
    let spread: Matrix3<f64> =
        near.iter().map(|(_, p)| (p.coords - middle) * (p.coords - middle).transpose()).sum();
    let least = spread.symmetric_eigenvalues().min().max(0.0);
    Some((least / (NEIGHBORS - FREEDOMS) as f64).sqrt())
}
