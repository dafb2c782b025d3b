//! A model's surface against itself, moved.

use nalgebra::{Isometry3, Point3, Vector3};

use super::SymmetryError;
use crate::features::{Neighborhood, estimate_normals, voxel_downsample};
use crate::interrupt::Interrupt;
use crate::kernels::diameter::diameter;
use crate::kernels::icp::{Stop, icp};
use crate::kernels::nearby::Nearby;
use crate::kernels::overlap::{Contact, Surface};
use crate::kernels::rng::Rng;

/// Fewer points show no shape.
const LEAST_POINTS: usize = 10;
/// More than this are thinned, to so many voxels along the diagonal of the bounding box.
const MOST_POINTS: usize = 8000;
const VOXELS: f64 = 48.0;
/// Points that the diameter is measured on.
const DIAMETER_POINTS: usize = 2000;
/// Points that all starts are looked at with, that they are polished on, first and last, and that they are judged by.
const GLANCE_POINTS: usize = 96;
const ROUGH_POINTS: usize = 256;
const FINE_POINTS: usize = 1000;
const JUDGED_POINTS: usize = 2000;
/// Points that the gaps are measured on.
const GAP_POINTS: usize = 512;
/// How far a point is looked for, in diameters: farther off is as bad.
pub(super) const REACH: f64 = 0.1;
/// Normals that differ by more than 60 degrees are not of one place: for the refinement, not for the judgement.
const MIN_NORMAL_COS: f64 = 0.5;
/// So many points have others within the gap that the sampling explains.
const GAP_QUANTILE: f64 = 0.95;
/// So many points must lie within the tolerance; the others within twice of it. Edges, where voxels have averaged two
/// sides, are among the others.
const WITHIN: f64 = 0.98;

/// The points of a model at diameter 1 about their mean, with normals of either sign.
pub(super) struct Shape {
    /// Of the model as it was given: its mean and its diameter.
    pub(super) centre: Point3<f64>,
    pub(super) size: f64,
    points: Vec<Point3<f64>>,
    normals: Vec<Vector3<f64>>,
    nearby: Nearby,
    rough: (Vec<Point3<f64>>, Vec<Vector3<f64>>),
    fine: (Vec<Point3<f64>>, Vec<Vector3<f64>>),
    glance: Vec<Point3<f64>>,
    judged: Vec<Point3<f64>>,
    /// Distance to the nearest other point that most points keep: what the sampling leaves open.
    gap: f64,
}

impl Shape {
    pub(super) fn new(
        points: &[Point3<f64>],
        normals: Option<&[Vector3<f64>]>,
        interrupt: &Interrupt,
    ) -> Result<Self, SymmetryError> {
        let (low, high) = match points.first() {
            Some(&first) => points.iter().fold((first, first), |(low, high), p| (low.inf(p), high.sup(p))),
            None => return Err(SymmetryError::TooFewPoints { len: 0, least: LEAST_POINTS }),
        };
        // As fine as can be: nothing but the checks, if there are few.
        let extent = (high - low).norm();
        let is_large = points.len() > MOST_POINTS;
        let voxel = if is_large { extent / VOXELS } else { extent / f64::from(1 << 19) };
        let thinned = voxel_downsample(points, normals, if voxel > 0.0 { voxel } else { 1.0 }, interrupt)?;
        let len = thinned.points.len();
        if len < LEAST_POINTS {
            return Err(SymmetryError::TooFewPoints { len, least: LEAST_POINTS });
        }
        let centre = Point3::from(thinned.points.iter().map(|p| p - low).sum::<Vector3<f64>>() / len as f64);
        let centre = low + centre.coords;
        let size = diameter(&sampled(&thinned.points, DIAMETER_POINTS), interrupt);
        let size = size.ok_or(SymmetryError::Interrupted)?;
        let points: Vec<Point3<f64>> =
            thinned.points.iter().map(|p| Point3::from((p - centre) / size)).collect();
        let gap = gap(&points);
        let normals = if let Some(normals) = thinned.normals {
            normals
        } else {
            // Enough neighbours for a plane, however the points are spread.
            let around = Neighborhood { radius: 3.0 * gap, max_neighbors: 20 };
            estimate_normals(&points, around, None, interrupt)?
        };
        let nearby = Nearby::new(&points, REACH);
        let [rough, fine] =
            [ROUGH_POINTS, FINE_POINTS].map(|count| (sampled(&points, count), sampled(&normals, count)));
        let [glance, judged] = [GLANCE_POINTS, JUDGED_POINTS].map(|count| sampled(&points, count));
        Ok(Self { centre, size, points, normals, nearby, rough, fine, glance, judged, gap })
    }

    /// Axes of the spread of the points.
    pub(super) fn principal_axes(&self) -> [Vector3<f64>; 3] {
        let spread =
            self.points.iter().map(|p| p.coords * p.coords.transpose()).sum::<nalgebra::Matrix3<f64>>();
        let vectors = spread.symmetric_eigen().eigenvectors;
        [0, 1, 2].map(|k| vectors.column(k).into_owned())
    }

    /// How far a few points are off, on average and at most [`REACH`] each: to choose among many starts.
    pub(super) fn glance(&self, motion: &Isometry3<f64>) -> f64 {
        let off = self.off(&self.glance, motion, |moved, row| (moved - self.points[row]).norm());
        off.sum::<f64>() / self.glance.len() as f64
    }

    /// How far each of `points` is off once it is moved: `off(moved, row)` with the row of the nearest point, and
    /// [`REACH`] where there is none.
    fn off(
        &self,
        points: &[Point3<f64>],
        motion: &Isometry3<f64>,
        off: impl Fn(&Point3<f64>, usize) -> f64,
    ) -> impl Iterator<Item = f64> {
        let (rotation, shift) = (motion.rotation.to_rotation_matrix(), motion.translation.vector);
        let moved: Vec<_> = points.iter().map(|p| rotation * p + shift).collect();
        let nearest = self.nearby.nearest_each(REACH, &moved);
        moved
            .into_iter()
            .zip(nearest)
            .map(move |(moved, row)| row.map_or(REACH, |row| off(&moved, row as usize)))
    }

    /// The motion, moved to where the surface fits itself best.
    pub(super) fn refined(&self, start: &Isometry3<f64>) -> Isometry3<f64> {
        let all = Surface { points: &self.points, normals: Some(&self.normals) };
        let polished = |some: &(Vec<Point3<f64>>, Vec<Vector3<f64>>), start, distance, stop| {
            let some = Surface { points: &some.0, normals: Some(&some.1) };
            let contact = Contact {
                distance,
                min_normal_cos: MIN_NORMAL_COS,
                oriented: false,
                view: None,
                to_planes: false,
            };
            icp(&some, &all, &self.nearby, start, &contact, stop)
        };
        let start = polished(&self.rough, start, REACH, Stop::new(20, 0.01));
        polished(&self.fine, &start, 0.5 * REACH, Stop::new(4, 0.005))
    }

    /// How far the moved surface is off the unmoved one, both ways, in diameters: the distance that [`WITHIN`] of the
    /// points keep, or half that of the farthest, if that is more. Of a point it is the distance to the tangent plane of
    /// the nearest one, or how much farther off that is than the sampling explains.
    pub(super) fn deviation(&self, motion: &Isometry3<f64>) -> f64 {
        let mut off: Vec<f64> = Vec::with_capacity(2 * self.judged.len());
        for motion in [*motion, motion.inverse()] {
            off.extend(self.off(&self.judged, &motion, |moved, row| {
                let apart = moved - self.points[row];
                apart.dot(&self.normals[row]).abs().max(apart.norm() - self.gap)
            }));
        }
        let at = ((off.len() as f64 * WITHIN) as usize).min(off.len() - 1);
        let (_, most, rest) = off.select_nth_unstable_by(at, f64::total_cmp);
        rest.iter().fold(*most, |worst, off| worst.max(0.5 * off))
    }
}

/// Some of the rows, the same for all that are as many.
fn sampled<T: Copy>(rows: &[T], count: usize) -> Vec<T> {
    let all: Vec<u32> = (0..rows.len() as u32).collect();
    Rng::new(0, 0, 0).sample(&all, count).into_iter().map(|row| rows[row as usize]).collect()
}

/// The distance to the nearest other point that [`GAP_QUANTILE`] of the points keep.
fn gap(points: &[Point3<f64>]) -> f64 {
    let some = sampled(points, GAP_POINTS);
    let mut nearest: Vec<f64> = some
        .iter()
        .map(|p| {
            let others = points.iter().map(|q| (p - q).norm_squared()).filter(|&dist_sq| dist_sq > 0.0);
            others.fold(f64::INFINITY, f64::min)
        })
        .collect();
    let at = (nearest.len() as f64 * GAP_QUANTILE) as usize;
    nearest.select_nth_unstable_by(at, f64::total_cmp).1.sqrt()
}
