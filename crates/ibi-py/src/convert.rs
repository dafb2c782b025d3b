//! Arrays of numpy to what the core takes, and back.

use ibi_core::features::FeatureError;
use ibi_core::nalgebra::{Isometry3, Matrix3, Matrix6, Point3, Rotation3, UnitQuaternion, Vector3};
use ibi_core::{Cloud, Correspondences};
use numpy::ndarray::{ArrayView2, Axis};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray2, PyReadonlyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::error::{InputError, ToPyErr};

pub(crate) type Rows<'py> = PyReadonlyArray2<'py, f64>;
pub(crate) type Pose<'py> = PyReadonlyArray2<'py, f64>;
pub(crate) type Poses<'py> = PyReadonlyArray3<'py, f64>;
pub(crate) type Floats<'py> = Bound<'py, PyArray2<f64>>;

/// How far from a rotation a matrix may be, per entry of R^T R: the rounding of single precision passes, a
/// scale or a shear does not.
const RIGID_TOLERANCE: f64 = 1e-6;

/// The rows of a C-contiguous array.
pub(crate) fn rows<'a, const N: usize, T: numpy::Element>(
    array: &'a PyReadonlyArray2<'_, T>,
) -> PyResult<&'a [[T; N]]> {
    let array = array.as_array();
    if array.ncols() != N {
        return Err(InputError::new_err(format!("expected {N} columns, got {}", array.ncols())));
    }
    let values = array.to_slice().ok_or_else(|| InputError::new_err("expected a C-contiguous array"))?;
    Ok(values.as_chunks().0)
}

pub(crate) fn rows3<T>(array: &Rows<'_>, row: impl Fn(f64, f64, f64) -> T) -> PyResult<Vec<T>> {
    Ok(rows(array)?.iter().map(|&[x, y, z]| row(x, y, z)).collect())
}

pub(crate) fn with_normals<'a>(cloud: Cloud<'a>, normals: Option<&Rows<'_>>) -> PyResult<Cloud<'a>> {
    Ok(match normals {
        Some(normals) => cloud.with_normals(rows3(normals, Vector3::new)?),
        None => cloud,
    })
}

/// (N, 3, 3), the axes of each frame as rows.
pub(crate) fn with_frames<'a>(
    cloud: Cloud<'a>,
    frames: Option<&PyReadonlyArray3<'_, f64>>,
) -> PyResult<Cloud<'a>> {
    let Some(frames) = frames else { return Ok(cloud) };
    let frames = frames.as_array();
    if frames.shape()[1..] != [3, 3] {
        return Err(InputError::new_err("frames must be of shape (N, 3, 3)"));
    }
    let frame = |rows: ArrayView2<'_, f64>| Matrix3::from_fn(|i, j| rows[[i, j]]);
    Ok(cloud.with_frames(frames.outer_iter().map(frame).collect()))
}

/// (N, 3) to points, all finite.
pub(crate) fn finite_points(name: &str, array: &Rows<'_>) -> PyResult<Vec<Point3<f64>>> {
    let points = rows3(array, Point3::new)?;
    match points.iter().position(|p| p.iter().any(|x| !x.is_finite())) {
        Some(row) => Err(InputError::new_err(format!("{name}[{row}] must be finite"))),
        None => Ok(points),
    }
}

/// (M, 2) int64 rows or (M, 6) float64 points.
pub(crate) fn correspondences(corr: &Bound<'_, PyAny>) -> PyResult<Correspondences> {
    if let Ok(ids) = corr.extract::<PyReadonlyArray2<'_, i64>>() {
        // A negative index wraps to one that is out of range; the core refuses it and reports it as it was.
        let wrap = |index: i64| usize::try_from(index).unwrap_or(index as usize);
        return Ok(Correspondences::from_rows(rows(&ids)?.iter().map(|row| row.map(wrap)).collect()));
    }
    let pairs: Rows<'_> = corr.extract()?;
    let pair = |&[px, py, pz, qx, qy, qz]: &[f64; 6]| [Point3::new(px, py, pz), Point3::new(qx, qy, qz)];
    Ok(Correspondences::from_points(rows(&pairs)?.iter().map(pair).collect()))
}

type Corners = (Vec<Point3<f64>>, Vec<[usize; 3]>);

/// (V, 3) and (F, 3). The core counts from 0; what is negative is refused by the number that the user gave.
pub(crate) fn mesh(vertices: &Rows<'_>, faces: &PyReadonlyArray2<'_, i64>) -> PyResult<Corners> {
    let vertices = rows3(vertices, Point3::new)?;
    let len = vertices.len();
    let corner = |row: usize, column: usize, index: i64| {
        usize::try_from(index).map_err(|_| FeatureError::FaceIndex { row, column, index, len }.to_py_err())
    };
    let face = |(row, &[a, b, c]): (usize, &[i64; 3])| {
        Ok([corner(row, 0, a)?, corner(row, 1, b)?, corner(row, 2, c)?])
    };
    let faces: PyResult<Vec<[usize; 3]>> = rows(faces)?.iter().enumerate().map(face).collect();
    Ok((vertices, faces?))
}

/// (K, 4, 4) to rigid motions.
pub(crate) fn poses(name: &str, array: &Poses<'_>) -> PyResult<Vec<Isometry3<f64>>> {
    let matrices = array.as_array();
    let motions = matrices.axis_iter(Axis(0)).enumerate();
    motions.map(|(row, matrix)| rigid_motion(&matrix, || format!("{name}[{row}]"))).collect()
}

/// (4, 4) to a rigid motion.
pub(crate) fn pose(name: &str, array: &Pose<'_>) -> PyResult<Isometry3<f64>> {
    rigid_motion(&array.as_array(), || name.to_owned())
}

fn rigid_motion(m: &ArrayView2<'_, f64>, name: impl Fn() -> String) -> PyResult<Isometry3<f64>> {
    let must = |what: &str| Err(InputError::new_err(format!("{} must {what}", name())));
    if m.shape() != [4, 4] {
        return must(&format!("have shape (4, 4), not {:?}", m.shape()));
    }
    if m.iter().any(|x| !x.is_finite()) {
        return must("be finite");
    }
    let rotation = Matrix3::from_fn(|row, col| m[(row, col)]);
    let last_row = [m[(3, 0)], m[(3, 1)], m[(3, 2)], m[(3, 3)] - 1.0];
    if last_row.iter().any(|x| x.abs() > RIGID_TOLERANCE) {
        return must("be a rigid motion: its last row must be 0 0 0 1");
    }
    if (rotation.transpose() * rotation - Matrix3::identity()).amax() > RIGID_TOLERANCE {
        return must("be a rigid motion: its 3x3 part must be orthonormal to 1e-6");
    }
    if rotation.determinant() < 0.0 {
        return must("be a rigid motion: its 3x3 part is a reflection, of determinant -1");
    }
    // Normalised: what single precision left off would otherwise go on into every product.
    let quaternion = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    let translation = Vector3::new(m[(0, 3)], m[(1, 3)], m[(2, 3)]);
    let quaternion = UnitQuaternion::new_normalize(quaternion.into_inner());
    Ok(Isometry3::from_parts(translation.into(), quaternion))
}

/// The entries of a motion row by row, as numpy has them; nalgebra stores columns.
pub(crate) fn entries(motion: &Isometry3<f64>) -> impl Iterator<Item = f64> + use<> {
    let columns = motion.to_homogeneous();
    (0..16).map(move |i| columns[(i / 4, i % 4)])
}

/// (K, 4, 4).
pub(crate) fn matrices<'py, 'a>(
    py: Python<'py>,
    motions: impl ExactSizeIterator<Item = &'a Isometry3<f64>>,
) -> PyResult<Bound<'py, PyArray3<f64>>> {
    let shape = [motions.len(), 4, 4];
    motions.flat_map(entries).collect::<Vec<_>>().into_pyarray(py).reshape(shape)
}

/// (6, 6).
pub(crate) fn square<'py>(py: Python<'py>, matrix: &Matrix6<f64>) -> PyResult<Floats<'py>> {
    (0..36).map(|i| matrix[(i / 6, i % 6)]).collect::<Vec<_>>().into_pyarray(py).reshape([6, 6])
}

/// (N, 3).
pub(crate) fn vectors(py: Python<'_>, rows: impl ExactSizeIterator<Item = [f64; 3]>) -> PyResult<Floats<'_>> {
    let shape = [rows.len(), 3];
    rows.flatten().collect::<Vec<_>>().into_pyarray(py).reshape(shape)
}

/// (M, 2) int64.
pub(crate) fn pairs(py: Python<'_>, rows: Vec<[u32; 2]>) -> PyResult<Bound<'_, PyArray2<i64>>> {
    let shape = [rows.len(), 2];
    PyArray1::from_iter(py, rows.into_flattened().into_iter().map(i64::from)).reshape(shape)
}

pub(crate) fn json(value: &impl serde::Serialize) -> PyResult<String> {
    serde_json::to_string(value).map_err(|e| PyValueError::new_err(e.to_string()))
}
