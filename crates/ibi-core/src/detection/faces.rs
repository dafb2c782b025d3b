//! Flat pieces of a surface, and which of those in a scan are no face of a part: walls, floors, faces of larger parts.

use nalgebra::{Matrix3, Point3, SymmetricEigen, Vector3};

use crate::interrupt::{Interrupt, Phase};
use crate::kernels::nearby::Nearby;

/// A flat piece of a surface that hangs together.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Face {
    /// Of the cloud.
    pub(super) rows: Vec<u32>,
    /// Of the box around it in its plane, the longer side first, data units.
    pub(super) extents: [f64; 2],
}

/// So near to each other are neighbours in a face, and so near to its plane are its points, voxels.
const LINK_VOXELS: f64 = 1.5;
const ACROSS_VOXELS: f64 = 0.8;

/// Least cosine between the normal of a face and those of its points; and, to begin with, the least mean among neighbours.
const FACE_COS: f64 = 0.966;
const FLAT_COS: f64 = 0.97;

/// Fewer points are no face.
const MIN_ROWS: usize = 20;

/// The mean of the unit normals of a face is at least so long: that of a strip of a cylinder that was followed for as far as it has the
/// normal is shorter, and so it is where noise has all kinds of normals look alike.
const PLANE_MEAN: f64 = 0.994;

/// Of the diameter of a model: however small its faces are, what is not larger than this may be of it.
const LEAST_FACE: f64 = 0.5;

/// A face is fitted anew each time that it has grown by as much.
const REFIT: f64 = 1.5;

/// What is so much longer or wider than a face is not that face, nor one that was measured a little too large.
const LARGER: f64 = 1.5;
const MARGIN_VOXELS: f64 = 2.0;

/// The faces of a cloud that was thinned to a voxel, with unit normals: each grows from its flattest point on, over what lies in
/// its plane and has its normal. `None` once interrupted.
///
/// # Complexity
/// O(n log n), times the points within 1.5 voxels of each.
pub(super) fn faces(
    points: &[Point3<f64>],
    normals: &[Vector3<f64>],
    voxel: f64,
    interrupt: &Interrupt,
) -> Option<Vec<Face>> {
    if !interrupt.enter(Phase::Plane) {
        return None;
    }
    let nearby = Nearby::new(points, LINK_VOXELS * voxel);
    let around = |row: u32| nearby.within(&points[row as usize], LINK_VOXELS * voxel);
    let mut flattest: Vec<(f64, u32)> = Vec::with_capacity(points.len());
    for row in 0..points.len() as u32 {
        if row % 1024 == 0 && interrupt.is_set() {
            return None;
        }
        let (mut sum, mut count) = (0.0, 0.0);
        // Not those of the other side, where a wall is thin.
        let cosines = around(row).map(|near| normals[near as usize].dot(&normals[row as usize]));
        for cos in cosines.filter(|&cos| cos > 0.0) {
            sum += cos;
            count += 1.0;
        }
        if sum >= FLAT_COS * count {
            flattest.push((sum / count, row));
        }
    }
    flattest.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let mut is_taken = vec![false; points.len()];
    let mut found = Vec::new();
    for (_, first) in flattest {
        if interrupt.is_set() {
            return None;
        }
        if is_taken[first as usize] {
            continue;
        }
        is_taken[first as usize] = true;
        let mut rows = vec![first];
        let mut plane = Plane { through: points[first as usize], normal: normals[first as usize] };
        let (mut at, mut refit) = (0, MIN_ROWS);
        while at < rows.len() {
            for near in around(rows[at]) {
                let row = near as usize;
                let is_in = || {
                    normals[row].dot(&plane.normal) >= FACE_COS
                        && plane.distance(&points[row]) <= ACROSS_VOXELS * voxel
                };
                if !is_taken[row] && is_in() {
                    is_taken[row] = true;
                    rows.push(near);
                }
            }
            at += 1;
            if rows.len() >= refit {
                plane = Plane::of(points, &rows, &plane.normal).0;
                refit = (REFIT * rows.len() as f64) as usize;
            }
        }
        let sum: Vector3<f64> = rows.iter().map(|&row| normals[row as usize]).sum();
        if rows.len() >= MIN_ROWS && sum.norm() >= PLANE_MEAN * rows.len() as f64 {
            let extents = Plane::of(points, &rows, &plane.normal).1;
            found.push(Face { rows, extents });
        }
    }
    Some(found)
}

/// Whether a face in a scan, thinned to a voxel, is larger than each of those of models; `diameter`: of the largest.
pub(super) fn is_larger(extents: [f64; 2], than: &[[f64; 2]], diameter: f64, voxel: f64) -> bool {
    let margin = MARGIN_VOXELS * voxel;
    than.iter()
        .chain([&[LEAST_FACE * diameter; 2]])
        .all(|of| (0..2).any(|k| extents[k] > LARGER * of[k] + margin))
}

#[derive(Clone, Copy)]
struct Plane {
    through: Point3<f64>,
    normal: Vector3<f64>,
}

impl Plane {
    /// Fitted to points, with its normal to the side of another; and how long and how wide they lie in it.
    fn of(points: &[Point3<f64>], rows: &[u32], side: &Vector3<f64>) -> (Self, [f64; 2]) {
        let of_rows = || rows.iter().map(|&row| points[row as usize]);
        let first = points[rows[0] as usize];
        let through = first + of_rows().map(|p| p - first).sum::<Vector3<f64>>() / rows.len() as f64;
        let spread: Matrix3<f64> = of_rows().map(|p| (p - through) * (p - through).transpose()).sum();
        let eigen = SymmetricEigen::new(spread);
        let least = eigen.eigenvalues.imin();
        let normal = eigen.eigenvectors.column(least).into_owned();
        let length = |axis: usize| {
            let along = of_rows().map(|p| (p - through).dot(&eigen.eigenvectors.column(axis)));
            let (low, high) = along.fold((0.0_f64, 0.0_f64), |(low, high), x| (low.min(x), high.max(x)));
            high - low
        };
        let [a, b] = [length((least + 1) % 3), length((least + 2) % 3)];
        let normal = if normal.dot(side) < 0.0 { -normal } else { normal };
        (Self { through, normal }, [a.max(b), a.min(b)])
    }

    fn distance(&self, point: &Point3<f64>) -> f64 {
        (point - self.through).dot(&self.normal).abs()
    }
}
