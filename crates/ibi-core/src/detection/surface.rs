//! Points on the outer surface of a mesh: what a camera can see of a part.

use nalgebra::{Point3, Vector3};

use super::bodies::across;
use super::{DetectionError, Run};
use crate::features::{Amount, FeatureError, Mesh, Views, outer_surface, sample_mesh, voxel_downsample};
use crate::interrupt::Interrupt;
use crate::symmetries::Symmetries;

/// The voxel, in diagonals of the mesh.
const VOXELS_PER_DIAGONAL: f64 = 24.0;
const MAX_VOXELS_PER_DIAGONAL: f64 = 48.0;

/// A slender part is thinned less: with 200 points it is not known again.
const MIN_POINTS: usize = 700;

/// How much denser the mesh is sampled than it is thinned to.
const SAMPLES_PER_VOXEL: f64 = 2.0;

/// Share of a mesh that is seen from its back only. Less is a gap that a ray slipped through.
const MIN_TURNED: f64 = 0.02;

/// Of so many points it is told from so few directions whether there are faces that are turned.
const FEW_POINTS: usize = 500;
const FEW_VIEWS: usize = 16;

/// How a model is made of a mesh.
#[derive(Debug, Clone, Default)]
pub struct FromMesh {
    /// Spacing of the points, data units; > 0. `None`: 1/24 of the diagonal of the mesh, and less, down to 1/48, where that
    /// leaves fewer than 700 points.
    pub voxel: Option<f64>,
    /// What leaves the part looking the same.
    pub symmetries: MeshSymmetries,
    /// Threads, and how to end it.
    pub run: Run,
}

/// Where the symmetries of a part are from.
#[derive(Debug, Clone)]
pub enum MeshSymmetries {
    /// Declared; none by default.
    Given(Symmetries),
    /// Found on points of the mesh that are half a voxel apart.
    Find,
}

impl Default for MeshSymmetries {
    fn default() -> Self {
        Self::Given(Symmetries::default())
    }
}

/// Points on the outer surface of a mesh, one a voxel.
pub(super) struct Surface {
    pub(super) points: Vec<Point3<f64>>,
    /// Outwards, of length 1.
    pub(super) normals: Vec<Vector3<f64>>,
    /// What was thinned: half a voxel apart, with the normals of the faces that they lie on.
    pub(super) fine: (Vec<Point3<f64>>, Vec<Vector3<f64>>),
    pub(super) voxel: f64,
}

impl Surface {
    pub(super) fn of(
        mesh: &Mesh<'_>,
        voxel: Option<f64>,
        interrupt: &Interrupt,
    ) -> Result<Self, DetectionError> {
        if let Some(voxel) = voxel {
            return Self::thinned(mesh, voxel, interrupt);
        }
        sample_mesh(mesh, Amount::Count(1), 0, interrupt)?; // refuses what is no mesh, and has no diagonal
        let corners = mesh.faces.iter().flatten().map(|&vertex| &mesh.vertices[vertex]);
        let voxel = across(corners) / VOXELS_PER_DIAGONAL;
        let surface = Self::thinned(mesh, voxel, interrupt)?;
        let share = surface.points.len() as f64 / MIN_POINTS as f64;
        if share >= 1.0 {
            return Ok(surface);
        }
        let finer = share.sqrt().max(VOXELS_PER_DIAGONAL / MAX_VOXELS_PER_DIAGONAL);
        Self::thinned(mesh, voxel * finer, interrupt)
    }

    fn thinned(mesh: &Mesh<'_>, voxel: f64, interrupt: &Interrupt) -> Result<Self, DetectionError> {
        if !(voxel > 0.0 && voxel.is_finite()) {
            let allowed = "above 0 and finite";
            return Err(FeatureError::Setting { argument: "voxel", value: voxel, allowed }.into());
        }
        let sampled = sample_mesh(mesh, Amount::Spacing(voxel / SAMPLES_PER_VOXEL), 0, interrupt);
        let sampled = sampled.map_err(|error| match error {
            FeatureError::TooManySamples { count, most } => {
                DetectionError::VoxelTooFine { voxel, count, most }
            }
            error => error.into(),
        })?;
        let (points, mut normals) = (sampled.points, sampled.normals);
        let mut is_seen = outer_surface(&points, &normals, mesh, &Views::default(), interrupt)?;
        for row in turned(&points, &normals, &is_seen, mesh, interrupt)? {
            normals[row].neg_mut();
            is_seen[row] = true;
        }
        let rows: Vec<usize> = (0..points.len()).filter(|&row| is_seen[row]).collect();
        if rows.is_empty() {
            return Err(DetectionError::NoneOutside);
        }
        let points: Vec<_> = rows.iter().map(|&row| points[row]).collect();
        let normals: Vec<_> = rows.iter().map(|&row| normals[row]).collect();
        let thinned = voxel_downsample(&points, Some(&normals), voxel, interrupt)?;
        let of_thinned = thinned.normals.unwrap_or_default();
        Ok(Self { points: thinned.points, normals: of_thinned, fine: (points, normals), voxel })
    }
}

/// The points that are seen from the backs of their faces only, which are turned inwards. Of a sheet, seen from both sides,
/// the front counts. None if they are few.
fn turned(
    points: &[Point3<f64>],
    normals: &[Vector3<f64>],
    is_seen: &[bool],
    mesh: &Mesh<'_>,
    interrupt: &Interrupt,
) -> Result<Vec<usize>, DetectionError> {
    let unseen: Vec<usize> = (0..points.len()).filter(|&row| !is_seen[row]).collect();
    let least = MIN_TURNED * points.len() as f64;
    let some: Vec<usize> = unseen.iter().copied().step_by(1 + unseen.len() / FEW_POINTS).collect();
    let mut turned = Vec::new();
    for (rows, views) in
        [(some, Views { count: FEW_VIEWS, ..Views::default() }), (unseen.clone(), Views::default())]
    {
        if (unseen.len() as f64) < least || rows.is_empty() {
            return Ok(Vec::new());
        }
        let at: Vec<_> = rows.iter().map(|&row| points[row]).collect();
        let backs: Vec<_> = rows.iter().map(|&row| -normals[row]).collect();
        let is_back = outer_surface(&at, &backs, mesh, &views, interrupt)?;
        turned = rows.iter().zip(is_back).filter(|&(_, is_back)| is_back).map(|(&row, _)| row).collect();
        let share = turned.len() as f64 / rows.len() as f64;
        if share * (unseen.len() as f64) < least {
            return Ok(Vec::new());
        }
    }
    Ok(turned)
}
