//! A part to be found in scans.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use nalgebra::{Point3, Vector3};

use super::faces::faces;
use super::surface::{FromMesh, MeshSymmetries, Surface};
use super::{DetectionError, Run, VOXELS_PER_SPACING};
use crate::error::Error;
use crate::features::{
    Descriptors, FPFH_DIM, Matching, Mesh, Neighborhood, fpfh, match_features, voxel_downsample,
};
use crate::interrupt::Interrupt;
use crate::kernels::par::Pool;
use crate::scene::{Cloud, PreparedCloud};
use crate::symmetries::{FindSymmetries, Symmetries, find_symmetries};

/// Of a descriptor.
const FEATURE_VOXELS: f64 = 6.0;
const FEATURE_NEIGHBORS: usize = 150;

/// Model points so near are twins, in spacings; with a larger share of them the model is thinned to be described.
const TWIN_SPACINGS: f64 = 0.1;
const MAX_TWINS: f64 = 0.1;

/// A part, checked and prepared once, to be found in any number of scans; threads may share it.
///
/// # Examples
/// From a mesh to poses:
/// ```
/// use ibi_core::detection::{Detect, FromMesh, Model};
/// use ibi_core::{Cloud, nalgebra::{Point3, Vector3}};
///
/// // A box of 3 x 2 x 1, its faces wound so that normals point outwards.
/// let corner = |i: u8| Point3::new(f64::from(i / 4) * 3.0, f64::from(i / 2 % 2) * 2.0, f64::from(i % 2));
/// let vertices: Vec<Point3<f64>> = (0..8).map(corner).collect();
/// let faces = [
///     [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
///     [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
/// ];
/// let part = Model::from_mesh(&vertices, &faces, &FromMesh::default())?;
///
/// // A scene that shows it twice, from all sides. The scan of a depth camera has `with_viewpoint` instead of normals.
/// let shifts = [Vector3::new(9.0, 0.0, 0.0), Vector3::new(0.0, 7.0, 4.0)];
/// let points: Vec<_> = shifts.iter().flat_map(|by| part.points().iter().map(move |p| p + by)).collect();
/// let scan = Cloud::from(points).with_normals(part.normals().unwrap_or_default().repeat(2));
/// let found = part.detect(&scan, &Detect::default())?;
/// assert_eq!(found.registration.poses.len(), 2);
/// assert_eq!(found.doubts().count(), 0);
/// # Ok::<(), ibi_core::detection::DetectionError>(())
/// ```
#[derive(Debug)]
pub struct Model {
    source: Arc<PreparedCloud<'static>>,
    /// As they were given. Those of the source are of length 1, and are not brought to it twice: that gives other bits.
    normals: Option<Vec<Vector3<f64>>>,
    origin: Origin,
    /// At each voxel that a scan has asked for.
    described: Mutex<BTreeMap<u64, Arc<Described>>>,
    pub(super) inward: OnceLock<f64>,
    /// How long and how wide its faces are, once asked for.
    faces: OnceLock<Vec<[f64; 2]>>,
}

/// What the points of a model are from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Origin {
    /// A cloud. Its voxel is 1.25 times its spacing.
    Cloud,
    /// A mesh, thinned to `voxel`.
    Mesh {
        /// Data units.
        voxel: f64,
        /// Whether the voxel was chosen by the user: then a scan that is coarser is worth a word.
        is_given: bool,
    },
}

impl Model {
    /// Points on the outer surface of a mesh: of a CAD file. What lies within the part is left out, as no camera sees it;
    /// faces that are seen from their backs only are turned.
    ///
    /// # Errors
    /// If the mesh has no area, has a value that is not finite, if a face names no vertex or none is seen from outside; if the
    /// voxel is not above 0; if symmetries cannot be looked for; if it is interrupted.
    pub fn from_mesh(
        vertices: &[Point3<f64>],
        faces: &[[usize; 3]],
        options: &FromMesh,
    ) -> Result<Self, DetectionError> {
        let mesh = Mesh { vertices, faces };
        let interrupt = options.run.interrupt();
        Pool::new(options.run.num_threads)?.install(|| {
            let surface = Surface::of(&mesh, options.voxel, &interrupt)?;
            let symmetries = match &options.symmetries {
                MeshSymmetries::Given(symmetries) => symmetries.clone(),
                MeshSymmetries::Find => {
                    let dense = Surface::of(&mesh, Some(0.5 * surface.voxel), &interrupt)?;
                    let settings = FindSymmetries::default();
                    find_symmetries(&dense.points, Some(&dense.normals), settings, &interrupt)?
                }
            };
            let (fine, of_fine) = surface.fine;
            let cloud = Cloud::from(surface.points)
                .with_normals(surface.normals)
                .with_symmetries(symmetries)
                .with_fine(fine, of_fine);
            let origin = Origin::Mesh { voxel: surface.voxel, is_given: options.voxel.is_some() };
            Self::until(&cloud, origin, &interrupt)
        })
    }

    /// A cloud, with normals that point outwards if it is to be detected.
    ///
    /// # Errors
    /// Those of [`crate::Registrar::new`].
    pub fn from_cloud(cloud: &Cloud<'static>) -> Result<Self, DetectionError> {
        Self::restored(cloud, Origin::Cloud, &Run::default())
    }

    /// A model as it was: of its points, and where they are from.
    ///
    /// # Errors
    /// Those of [`crate::Registrar::new`]; or if it is interrupted.
    pub fn restored(cloud: &Cloud<'static>, origin: Origin, run: &Run) -> Result<Self, DetectionError> {
        Self::until(cloud, origin, &run.interrupt())
    }

    fn until(cloud: &Cloud<'static>, origin: Origin, interrupt: &Interrupt) -> Result<Self, DetectionError> {
        let source = Arc::new(PreparedCloud::source_until(cloud, interrupt)?);
        let normals = cloud.normals.clone();
        Ok(Self {
            source,
            normals,
            origin,
            described: Mutex::default(),
            inward: OnceLock::new(),
            faces: OnceLock::new(),
        })
    }

    /// What a [`crate::Registrar`] takes.
    #[must_use]
    pub fn source(&self) -> &Arc<PreparedCloud<'static>> {
        &self.source
    }

    /// In data units.
    #[must_use]
    pub fn points(&self) -> &[Point3<f64>] {
        &self.source.points
    }

    /// One for each point, as they were given.
    #[must_use]
    pub fn normals(&self) -> Option<&[Vector3<f64>]> {
        self.normals.as_deref()
    }

    /// What leaves it looking the same, as declared or found.
    #[must_use]
    pub fn symmetries(&self) -> &Symmetries {
        &self.source.symmetries
    }

    /// What its points are from.
    #[must_use]
    pub fn origin(&self) -> Origin {
        self.origin
    }

    /// What a scan is thinned to, data units, unless it is coarser.
    #[must_use]
    pub fn voxel(&self) -> f64 {
        match self.origin {
            Origin::Cloud => VOXELS_PER_SPACING * self.source.spacing,
            Origin::Mesh { voxel, .. } => voxel,
        }
    }

    /// Largest distance of two points, data units.
    pub(super) fn diameter(&self, interrupt: &Interrupt) -> Result<f64, Error> {
        self.source.diameter(interrupt).ok_or_else(|| interrupt.error())
    }

    /// How long and how wide its flat faces are, data units; none without normals.
    pub(super) fn faces(&self, interrupt: &Interrupt) -> Result<&[[f64; 2]], Error> {
        if let Some(known) = self.faces.get() {
            return Ok(known);
        }
        let normals = self.source.normals.as_deref().unwrap_or_default();
        let points = if normals.is_empty() { &[] } else { self.points() };
        let found = faces(points, normals, self.voxel(), interrupt).ok_or_else(|| interrupt.error())?;
        Ok(self.faces.get_or_init(|| found.into_iter().map(|face| face.extents).collect()))
    }

    /// Its descriptors at a voxel, made when first asked for.
    pub(super) fn described(
        &self,
        normals: &[Vector3<f64>],
        voxel: f64,
        interrupt: &Interrupt,
    ) -> Result<Arc<Described>, DetectionError> {
        let known = || self.described.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(described) = known().get(&voxel.to_bits()) {
            return Ok(Arc::clone(described));
        }
        let described = Arc::new(self.describe(normals, voxel, interrupt)?);
        known().insert(voxel.to_bits(), Arc::clone(&described));
        Ok(described)
    }

    /// As it is where the voxel is its own, unless many of its points are twins; else thinned.
    fn describe(
        &self,
        normals: &[Vector3<f64>],
        voxel: f64,
        interrupt: &Interrupt,
    ) -> Result<Described, DetectionError> {
        let points = self.points();
        let distinct = voxel_downsample(points, None, TWIN_SPACINGS * self.source.spacing, interrupt)?;
        let has_few_twins = distinct.points.len() as f64 >= (1.0 - MAX_TWINS) * points.len() as f64;
        if voxel <= self.voxel() && has_few_twins {
            return Ok(Described { rows: None, values: describe(points, normals, voxel, interrupt)? });
        }
        let thinned = voxel_downsample(points, Some(normals), voxel, interrupt)?;
        let rows = nearest_rows(points, &thinned.points, interrupt)?;
        let of_thinned = thinned.normals.unwrap_or_default();
        Ok(Described { rows: Some(rows), values: describe(&thinned.points, &of_thinned, voxel, interrupt)? })
    }
}

/// The descriptors of a model.
#[derive(Debug)]
pub(super) struct Described {
    /// Which points of the model they stand for; `None`: all.
    pub(super) rows: Option<Vec<u32>>,
    pub(super) values: Vec<f32>,
}

/// The same for both clouds.
pub(super) fn describe(
    points: &[Point3<f64>],
    normals: &[Vector3<f64>],
    voxel: f64,
    interrupt: &Interrupt,
) -> Result<Vec<f32>, DetectionError> {
    let neighborhood = Neighborhood { radius: FEATURE_VOXELS * voxel, max_neighbors: FEATURE_NEIGHBORS };
    Ok(fpfh(points, normals, neighborhood, None, interrupt)?.into_flattened())
}

/// For each query the row of the nearest point. A mean of two points is as near to both: of such the lower row, which no tree
/// promises.
fn nearest_rows(
    points: &[Point3<f64>],
    queries: &[Point3<f64>],
    interrupt: &Interrupt,
) -> Result<Vec<u32>, DetectionError> {
    // In single precision, so about the middle.
    let middle = points.iter().map(|p| p.coords).sum::<Vector3<f64>>() / points.len() as f64;
    let local = |points: &[Point3<f64>]| -> Vec<f32> {
        points.iter().flat_map(|p| <[f32; 3]>::from((p.coords - middle).cast())).collect()
    };
    let (points, queries) = (local(points), local(queries));
    let [points, queries] = [&points, &queries].map(|values| Descriptors { values, dim: 3 });
    let matches = match_features(points, queries, Matching::default(), interrupt)?;
    Ok(matches.rows.into_iter().map(|[row, _]| row).collect())
}

/// Numbers of a descriptor.
pub(super) const DIM: usize = FPFH_DIM;
