//! One point for each occupied cell of a lattice.

use nalgebra::{Point3, Vector3};

use super::FeatureError;
use super::door::{check_length, check_points, unit_normals};
use crate::interrupt::{Interrupt, Phase};
use crate::kernels::par;
use crate::kernels::sort::sorted;

/// A cloud with one point for each voxel.
#[derive(Debug, Clone, PartialEq)]
pub struct Thinned {
    /// The mean of the points of each voxel, sorted by voxel: x first, then y, then z.
    pub points: Vec<Point3<f64>>,
    /// The mean of their normals, of length 1; as many as points, if normals were given.
    pub normals: Option<Vec<Vector3<f64>>>,
}

/// Points, or voxels, that one thread takes at a time.
const GRAIN: usize = 1 << 14;

/// Bits of a key for each axis.
const BITS: u32 = 21;

/// Thins a cloud to the mean of the points in each voxel (the convention of Open3D's `voxel_down_sample`: the lattice
/// begins half a voxel below the least coordinates, so both give the same points).
///
/// Where the normals of a voxel cancel (a thin wall), the one of its first row stands for all. The order of the rows
/// changes the result by rounding only.
///
/// # Errors
/// If a coordinate is not finite, if there is not one normal for each point, if `voxel` is not above 0 or so small that
/// more than 2^21 fit along an axis.
///
/// # Complexity
/// O(n log n) time, 16 bytes a point beside the result.
pub fn voxel_downsample(
    points: &[Point3<f64>],
    normals: Option<&[Vector3<f64>]>,
    voxel: f64,
    interrupt: &Interrupt,
) -> Result<Thinned, FeatureError> {
    check_points("points", points)?;
    check_length("voxel", voxel)?;
    let unit = normals.map(|normals| unit_normals("normals", normals, points.len())).transpose()?;
    if !interrupt.enter(Phase::Thin) {
        return Err(FeatureError::Interrupted);
    }
    let Some(&first) = points.first() else {
        return Ok(Thinned { points: Vec::new(), normals: unit });
    };
    let (low, high) = points.iter().fold((first, first), |(low, high), p| (low.inf(p), high.sup(p)));
    let (origin, extent) = (low - Vector3::repeat(0.5 * voxel), (high - low).max());
    let most = 1_u64 << BITS;
    if extent / voxel >= (most - 2) as f64 {
        return Err(FeatureError::VoxelTooSmall { voxel, extent, most });
    }
    let key = |p: &Point3<f64>| {
        // Not negative: a cast rounds down.
        let cell = |axis: usize| ((p[axis] - origin[axis]) / voxel) as u64;
        (cell(0) << (2 * BITS)) | (cell(1) << BITS) | cell(2)
    };
    let of_row = |row: usize| (key(&points[row]), row as u32);
    let rows = par::chunks(points.len(), GRAIN, |run| run.map(of_row).collect::<Vec<_>>()).concat();
    let rows = sorted(rows, interrupt).ok_or(FeatureError::Interrupted)?;
    let voxels: Vec<&[(u64, u32)]> = rows.chunk_by(|a, b| a.0 == b.0).collect();
    let mean = |voxel: &&[(u64, u32)]| mean(voxel, first, |row| points[row]);
    let normals = match unit {
        Some(unit) => Some(each(&voxels, interrupt, |voxel| mean_direction(voxel, &unit))?),
        None => None,
    };
    Ok(Thinned { points: each(&voxels, interrupt, mean)?, normals })
}

/// What `of` makes of each voxel.
fn each<T: Copy + Send>(
    voxels: &[&[(u64, u32)]],
    interrupt: &Interrupt,
    of: impl Fn(&&[(u64, u32)]) -> T + Sync + Send,
) -> Result<Vec<T>, FeatureError> {
    let parts = par::chunks(voxels.len(), GRAIN, |run| {
        if interrupt.is_set() { Vec::new() } else { voxels[run].iter().map(&of).collect() }
    });
    if interrupt.is_set() { Err(FeatureError::Interrupted) } else { Ok(parts.concat()) }
}

/// Relative to `near`, so that clouds far from the origin lose nothing.
fn mean(voxel: &[(u64, u32)], near: Point3<f64>, point: impl Fn(usize) -> Point3<f64>) -> Point3<f64> {
    let sum: Vector3<f64> = voxel.iter().map(|&(_, row)| point(row as usize) - near).sum();
    near + sum / voxel.len() as f64
}

fn mean_direction(voxel: &[(u64, u32)], normals: &[Vector3<f64>]) -> Vector3<f64> {
    let sum: Vector3<f64> = voxel.iter().map(|&(_, row)| normals[row as usize]).sum();
    // What is shorter than this is rounding.
    sum.try_normalize(1e-9).unwrap_or(normals[voxel[0].1 as usize])
}
