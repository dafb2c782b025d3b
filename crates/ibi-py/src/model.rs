//! A part that was checked and prepared, for any number of scenes.

// pyo3 hands arguments over by value; a read-only array is a handle, cheap to own.
#![expect(clippy::needless_pass_by_value)]

use std::sync::Arc;

use ibi_core::detection::{self, FromMesh, MeshSymmetries, Origin, Run};
use ibi_core::features::FeatureError;
use ibi_core::nalgebra::{Point3, Vector3};
use ibi_core::{CancelToken, Cloud};
use numpy::{PyReadonlyArray2, PyReadonlyArray3};
use pyo3::prelude::*;

use crate::background::{in_background, in_pool};
use crate::convert::{Floats, Rows, mesh, rows3, vectors, with_frames, with_normals};
use crate::error::OrPyErr;
use crate::runs;
use crate::symmetries::Symmetries;

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<Model>()?;
    m.add_class::<Models>()
}

/// See `ibi_rs.Model`, which is in front of it.
#[pyclass(frozen, module = "ibi_rs._core")]
pub(crate) struct Model(pub(crate) Arc<detection::Model>);

/// How the core is to run what `cancel` ends.
pub(crate) fn run(cancel: CancelToken, num_threads: Option<usize>) -> Run {
    Run { num_threads, cancel, watcher: runs::watcher() }
}

#[pymethods]
impl Model {
    /// `mesh_voxel`: of what was made of a mesh its voxel, and whether the user gave it.
    #[new]
    #[pyo3(signature = (points, normals=None, frames=None, symmetries=None, mesh_voxel=None, fine=None))]
    fn new(
        py: Python<'_>,
        points: Rows<'_>,
        normals: Option<Rows<'_>>,
        frames: Option<PyReadonlyArray3<'_, f64>>,
        symmetries: Option<&Symmetries>,
        mesh_voxel: Option<(f64, bool)>,
        fine: Option<(Rows<'_>, Rows<'_>)>,
    ) -> PyResult<Self> {
        let cloud = with_normals(Cloud::from(rows3(&points, Point3::new)?), normals.as_ref())?;
        let mut cloud = with_frames(cloud, frames.as_ref())?;
        if let Some(symmetries) = symmetries {
            cloud = cloud.with_symmetries(symmetries.0.clone());
        }
        if let Some((points, normals)) = fine {
            cloud = cloud.with_fine(rows3(&points, Point3::new)?, rows3(&normals, Vector3::new)?);
        }
        let origin = mesh_voxel.map_or(Origin::Cloud, |(voxel, is_given)| Origin::Mesh { voxel, is_given });
        let model = in_background(py, |cancel, _| {
            detection::Model::restored(&cloud, origin, &run(cancel, None)).or_py_err()
        })?;
        Ok(Self(Arc::new(model)))
    }

    /// Without symmetries they are looked for.
    #[staticmethod]
    fn from_mesh(
        py: Python<'_>,
        vertices: Rows<'_>,
        faces: PyReadonlyArray2<'_, i64>,
        voxel: Option<f64>,
        symmetries: Option<&Symmetries>,
        num_threads: Option<usize>,
    ) -> PyResult<Self> {
        let (vertices, faces) = mesh(&vertices, &faces)?;
        let symmetries =
            symmetries.map_or(MeshSymmetries::Find, |held| MeshSymmetries::Given(held.0.clone()));
        let model = in_background(py, |cancel, _| {
            let options = FromMesh { voxel, symmetries, run: run(cancel, num_threads) };
            detection::Model::from_mesh(&vertices, &faces, &options).or_py_err()
        })?;
        Ok(Self(Arc::new(model)))
    }

    fn points<'py>(&self, py: Python<'py>) -> PyResult<Floats<'py>> {
        vectors(py, self.0.points().iter().map(|&p| p.into()))
    }

    fn normals<'py>(&self, py: Python<'py>) -> PyResult<Option<Floats<'py>>> {
        self.0.normals().map(|normals| vectors(py, normals.iter().map(|&n| n.into()))).transpose()
    }

    /// More points of the surface, and their normals.
    fn fine<'py>(&self, py: Python<'py>) -> PyResult<Option<(Floats<'py>, Floats<'py>)>> {
        let Some((points, normals)) = &self.0.source().fine else { return Ok(None) };
        let points = vectors(py, points.iter().map(|&p| p.into()))?;
        Ok(Some((points, vectors(py, normals.iter().map(|&n| n.into()))?)))
    }

    fn symmetries(&self) -> Symmetries {
        Symmetries(self.0.symmetries().clone())
    }

    #[getter]
    fn spacing(&self) -> f64 {
        self.0.source().spacing
    }

    #[getter]
    fn voxel(&self) -> f64 {
        self.0.voxel()
    }

    #[getter]
    fn mesh_voxel(&self) -> Option<(f64, bool)> {
        match self.0.origin() {
            Origin::Cloud => None,
            Origin::Mesh { voxel, is_given } => Some((voxel, is_given)),
        }
    }

    fn diameter(&self, py: Python<'_>, num_threads: Option<usize>) -> PyResult<f64> {
        in_pool(py, num_threads, |interrupt| {
            self.0.source().diameter(interrupt).ok_or(FeatureError::Interrupted)
        })
    }
}

/// See `ibi_rs.Models`, which is in front of it.
#[pyclass(frozen, module = "ibi_rs._core")]
pub(crate) struct Models(pub(crate) detection::Models);

#[pymethods]
impl Models {
    #[new]
    fn new(parts: Vec<(String, Py<Model>)>) -> PyResult<Self> {
        let parts = parts.into_iter().map(|(name, model)| (name, Arc::clone(&model.get().0))).collect();
        Ok(Self(detection::Models::new(parts).or_py_err()?))
    }
}
