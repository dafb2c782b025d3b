//! Symmetries for Python: numpy in, numpy out. The maths is in `ibi_core`.

// pyo3 hands arguments over by value; a read-only array is a handle, cheap to own.
#![expect(clippy::needless_pass_by_value)]

use ibi_core::nalgebra::{Point3, Vector3};
use ibi_core::{Axis, FindSymmetries, Turning, find_symmetries};
use numpy::{PyArray2, PyArray3};
use pyo3::prelude::*;

use crate::background::in_pool;
use crate::convert::{Pose, Poses, Rows, matrices, pose, poses, rows3, vectors};
use crate::error::OrPyErr;

/// Adds the contents of this file to the module.
pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<Symmetries>()?;
    m.add_function(wrap_pyfunction!(symmetries_find, m)?)
}

/// Checked; see `ibi_rs.Symmetries`, which is in front of it.
#[pyclass(frozen, module = "ibi_rs._core")]
pub(crate) struct Symmetries(pub(crate) ibi_core::Symmetries);

#[pymethods]
impl Symmetries {
    /// Motions (S, 4, 4), and axes and points of them, (A, 3) each.
    #[new]
    fn new(discrete: Poses<'_>, axes: Rows<'_>, offsets: Rows<'_>) -> PyResult<Self> {
        let discrete = poses("discrete", &discrete)?;
        let (axes, offsets) = (rows3(&axes, Vector3::new)?, rows3(&offsets, Point3::new)?);
        let axis = |(direction, point)| Axis { direction, point };
        let continuous: Vec<Axis> = axes.into_iter().zip(offsets).map(axis).collect();
        Ok(Self(ibi_core::Symmetries::new(&discrete, &continuous).or_py_err()?))
    }

    /// The motions, the identity first; the axes, and a point of each.
    #[expect(clippy::type_complexity)] // three arrays
    fn arrays<'py>(
        &self,
        py: Python<'py>,
    ) -> PyResult<(Bound<'py, PyArray3<f64>>, Bound<'py, PyArray2<f64>>, Bound<'py, PyArray2<f64>>)> {
        let continuous = self.0.continuous();
        let axes = vectors(py, continuous.iter().map(|axis| axis.direction.into()))?;
        let offsets = vectors(py, continuous.iter().map(|axis| axis.point.into()))?;
        Ok((matrices(py, self.0.discrete().iter())?, axes, offsets))
    }

    /// Whether all rotations about a point are among them.
    #[getter]
    fn is_ball(&self) -> bool {
        matches!(self.0.turning(), Turning::Any(_))
    }

    /// Of the poses that look like each of `poses` the one nearest to the reference.
    fn nearest<'py>(
        &self,
        py: Python<'py>,
        poses: Poses<'py>,
        reference: Pose<'py>,
    ) -> PyResult<Bound<'py, PyArray3<f64>>> {
        let (poses, reference) = (self::poses("pose", &poses)?, pose("reference", &reference)?);
        let nearest: Vec<_> = poses.iter().map(|pose| self.0.nearest(pose, &reference)).collect();
        matrices(py, nearest.iter())
    }

    fn discretised<'py>(&self, py: Python<'py>, max_step: f64) -> PyResult<Bound<'py, PyArray3<f64>>> {
        matrices(py, self.0.discretised(max_step).or_py_err()?.iter())
    }
}

#[pyfunction]
fn symmetries_find(
    py: Python<'_>,
    points: Rows<'_>,
    normals: Option<Rows<'_>>,
    tolerance: f64,
) -> PyResult<Symmetries> {
    let points = rows3(&points, Point3::new)?;
    let normals = normals.map(|normals| rows3(&normals, Vector3::new)).transpose()?;
    let found = in_pool(py, Some(1), |interrupt| {
        find_symmetries(&points, normals.as_deref(), FindSymmetries { tolerance }, interrupt)
    })?;
    Ok(Symmetries(found))
}
