//! The features for Python: numpy in, numpy out, the GIL released in between. The maths is in `ibi_core::features`.

// pyo3 hands arguments over by value; a read-only array is a handle, cheap to own.
#![expect(clippy::needless_pass_by_value)]

use std::time::Instant;

use ibi_core::Interrupt;
use ibi_core::features::{
    self, Amount, Descriptors, FeatureError, Matching, Mesh, Neighborhood, PlaneSearch, Views,
};
use ibi_core::kernels::neighbors::Neighbors;
use ibi_core::nalgebra::{Point3, Vector3};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::exceptions::PyTimeoutError;
use pyo3::prelude::*;

use crate::InputError;
use crate::register::{self, rows, rows3};

/// Adds the functions of this file to the module.
pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(features_voxel_downsample, m)?)?;
    m.add_function(wrap_pyfunction!(features_estimate_normals, m)?)?;
    m.add_function(wrap_pyfunction!(features_fpfh, m)?)?;
    m.add_function(wrap_pyfunction!(features_match, m)?)?;
    m.add_function(wrap_pyfunction!(features_dominant_plane, m)?)?;
    m.add_function(wrap_pyfunction!(features_sample_mesh, m)?)?;
    m.add_function(wrap_pyfunction!(features_outer_surface, m)?)?;
    m.add_function(wrap_pyfunction!(features_nearest_rows, m)?)?;
    Ok(())
}

type Rows<'py> = PyReadonlyArray2<'py, f64>;
type Floats<'py> = Bound<'py, PyArray2<f64>>;

#[pyfunction]
#[pyo3(signature = (points, normals, voxel, num_threads, timeout_s=None))]
fn features_voxel_downsample<'py>(
    py: Python<'py>,
    points: Rows<'py>,
    normals: Option<Rows<'py>>,
    voxel: f64,
    num_threads: Option<usize>,
    timeout_s: Option<f64>,
) -> PyResult<(Floats<'py>, Option<Floats<'py>>)> {
    let points = rows3(&points, Point3::new)?;
    let normals = normals.map(|normals| rows3(&normals, Vector3::new)).transpose()?;
    // Of fewer points a second thread is not worth its start.
    let num_threads = if points.len() < 50_000 { Some(1) } else { num_threads };
    let thinned = in_pool(py, num_threads, timeout_s, |interrupt| {
        features::voxel_downsample(&points, normals.as_deref(), voxel, interrupt)
    })?;
    let normals = thinned.normals.map(|normals| vectors(py, normals)).transpose()?;
    Ok((vectors(py, thinned.points.into_iter().map(|p| p.coords).collect())?, normals))
}

#[pyfunction]
#[pyo3(signature = (points, radius, max_neighbors, viewpoint, num_threads, timeout_s=None))]
#[allow(clippy::too_many_arguments)] // Python's keyword arguments
fn features_estimate_normals<'py>(
    py: Python<'py>,
    points: Rows<'py>,
    radius: f64,
    max_neighbors: usize,
    viewpoint: Option<[f64; 3]>,
    num_threads: Option<usize>,
    timeout_s: Option<f64>,
) -> PyResult<Floats<'py>> {
    let points = rows3(&points, Point3::new)?;
    let neighborhood = Neighborhood { radius, max_neighbors };
    let viewpoint = viewpoint.map(Point3::from);
    let normals = in_pool(py, num_threads, timeout_s, |interrupt| {
        features::estimate_normals(&points, neighborhood, viewpoint, interrupt)
    })?;
    vectors(py, normals)
}

#[pyfunction]
#[pyo3(signature = (points, normals, radius, max_neighbors, keypoints, num_threads, timeout_s=None))]
#[allow(clippy::too_many_arguments)] // Python's keyword arguments
fn features_fpfh<'py>(
    py: Python<'py>,
    points: Rows<'py>,
    normals: Rows<'py>,
    radius: f64,
    max_neighbors: usize,
    keypoints: Option<PyReadonlyArray1<'py, i64>>,
    num_threads: Option<usize>,
    timeout_s: Option<f64>,
) -> PyResult<Bound<'py, PyArray2<f32>>> {
    let (points, normals) = (rows3(&points, Point3::new)?, rows3(&normals, Vector3::new)?);
    let neighborhood = Neighborhood { radius, max_neighbors };
    let keypoints = keypoints.map(|rows| keypoint_rows(&rows, points.len())).transpose()?;
    let descriptors = in_pool(py, num_threads, timeout_s, |interrupt| {
        features::fpfh(&points, &normals, neighborhood, keypoints.as_deref(), interrupt)
    })?;
    let rows = descriptors.len();
    descriptors.into_flattened().into_pyarray(py).reshape([rows, features::FPFH_DIM])
}

/// The core counts rows from 0; what is negative must be refused by the number that the user gave.
fn keypoint_rows(rows: &PyReadonlyArray1<'_, i64>, len: usize) -> PyResult<Vec<usize>> {
    let row = |(at, &row): (usize, &i64)| {
        usize::try_from(row).map_err(|_| {
            to_py(FeatureError::RowOutOfRange { argument: "keypoints", at, row, of: "points", len })
        })
    };
    rows.as_array().iter().enumerate().map(row).collect()
}

/// For each query the row of the nearest of the points, of which there is one at least; all finite.
#[pyfunction]
fn features_nearest_rows<'py>(
    py: Python<'py>,
    points: Rows<'py>,
    queries: Rows<'py>,
) -> PyResult<Bound<'py, PyArray1<i64>>> {
    let (points, queries) = (rows3(&points, Point3::new)?, rows3(&queries, Point3::new)?);
    let rows: Vec<i64> = py.detach(|| {
        let tree = Neighbors::new(&points);
        queries.iter().filter_map(|query| tree.nearest(query)).map(|(row, _)| i64::from(row)).collect()
    });
    Ok(rows.into_pyarray(py))
}

/// (M, 2) int64 [source row, target row], and (M,) float64.
type Pairs<'py> = (Bound<'py, PyArray2<i64>>, Bound<'py, PyArray1<f64>>);

#[pyfunction]
#[pyo3(signature = (src_feat, tgt_feat, k, mutual, ratio, num_threads, timeout_s=None))]
#[allow(clippy::too_many_arguments)] // Python's keyword arguments
fn features_match<'py>(
    py: Python<'py>,
    src_feat: PyReadonlyArray2<'py, f32>,
    tgt_feat: PyReadonlyArray2<'py, f32>,
    k: usize,
    mutual: bool,
    ratio: Option<f64>,
    num_threads: Option<usize>,
    timeout_s: Option<f64>,
) -> PyResult<Pairs<'py>> {
    let own = |array: &PyReadonlyArray2<'_, f32>| {
        let array = array.as_array();
        (array.iter().copied().collect::<Vec<f32>>(), array.ncols())
    };
    let (src, tgt) = (own(&src_feat), own(&tgt_feat));
    if src.1 == 0 || tgt.1 == 0 {
        return Err(InputError::new_err("descriptors must have at least 1 column"));
    }
    let matching = Matching { k, mutual, max_ratio: ratio };
    let matches = in_pool(py, num_threads, timeout_s, |interrupt| {
        let [src, tgt] = [&src, &tgt].map(|(values, dim)| Descriptors { values, dim: *dim });
        features::match_features(src, tgt, matching, interrupt)
    })?;
    let count = matches.rows.len();
    let rows: Vec<i64> = matches.rows.into_flattened().into_iter().map(i64::from).collect();
    Ok((rows.into_pyarray(py).reshape([count, 2])?, matches.similarity.into_pyarray(py)))
}

/// The normal, the offset, which points are near, and the share of those behind.
type Plane<'py> = ([f64; 3], f64, Bound<'py, PyArray1<bool>>, f64);

#[pyfunction]
#[pyo3(signature = (points, distance, min_share, viewpoint, seed, num_threads, timeout_s=None))]
#[allow(clippy::too_many_arguments)] // Python's keyword arguments
fn features_dominant_plane<'py>(
    py: Python<'py>,
    points: Rows<'py>,
    distance: f64,
    min_share: f64,
    viewpoint: Option<[f64; 3]>,
    seed: u64,
    num_threads: Option<usize>,
    timeout_s: Option<f64>,
) -> PyResult<Option<Plane<'py>>> {
    let points = rows3(&points, Point3::new)?;
    let search = PlaneSearch { distance, min_share, seed };
    let viewpoint = viewpoint.map(Point3::from);
    let plane = in_pool(py, num_threads, timeout_s, |interrupt| {
        features::dominant_plane(&points, &search, viewpoint, interrupt)
    })?;
    Ok(plane.map(|p| (p.normal.into(), p.offset, p.inliers.into_pyarray(py), p.behind)))
}

#[pyfunction]
fn features_sample_mesh<'py>(
    py: Python<'py>,
    vertices: Rows<'py>,
    faces: PyReadonlyArray2<'py, i64>,
    count: Option<usize>,
    spacing: f64,
    seed: u64,
) -> PyResult<(Floats<'py>, Floats<'py>)> {
    let (vertices, faces) = mesh(&vertices, &faces)?;
    let mesh = Mesh { vertices: &vertices, faces: &faces };
    let amount = count.map_or(Amount::Spacing(spacing), Amount::Count);
    let sampled =
        in_pool(py, Some(1), None, |interrupt| features::sample_mesh(&mesh, amount, seed, interrupt))?;
    let points = sampled.points.into_iter().map(|p| p.coords).collect();
    Ok((vectors(py, points)?, vectors(py, sampled.normals)?))
}

#[pyfunction]
#[allow(clippy::too_many_arguments)] // Python's keyword arguments
fn features_outer_surface<'py>(
    py: Python<'py>,
    points: Rows<'py>,
    normals: Rows<'py>,
    vertices: Rows<'py>,
    faces: PyReadonlyArray2<'py, i64>,
    num_views: usize,
    max_angle_rad: f64,
    lift: Option<f64>,
    num_threads: Option<usize>,
) -> PyResult<Bound<'py, PyArray1<bool>>> {
    let (points, normals) = (rows3(&points, Point3::new)?, rows3(&normals, Vector3::new)?);
    let (vertices, faces) = mesh(&vertices, &faces)?;
    let mesh = Mesh { vertices: &vertices, faces: &faces };
    let views = Views { count: num_views, max_angle_rad, lift };
    let is_outer = in_pool(py, num_threads, None, |interrupt| {
        features::outer_surface(&points, &normals, &mesh, &views, interrupt)
    })?;
    Ok(is_outer.into_pyarray(py))
}

type Corners = (Vec<Point3<f64>>, Vec<[usize; 3]>);

fn mesh(vertices: &Rows<'_>, faces: &PyReadonlyArray2<'_, i64>) -> PyResult<Corners> {
    let vertices = rows3(vertices, Point3::new)?;
    let len = vertices.len();
    let corner = |row: usize, column: usize, index: i64| {
        usize::try_from(index).map_err(|_| to_py(FeatureError::FaceIndex { row, column, index, len }))
    };
    let face = |(row, &[a, b, c]): (usize, &[i64; 3])| {
        Ok([corner(row, 0, a)?, corner(row, 1, b)?, corner(row, 2, c)?])
    };
    let faces: PyResult<Vec<[usize; 3]>> = rows(faces)?.iter().enumerate().map(face).collect();
    Ok((vertices, faces?))
}

/// Runs `job` on threads of its own, where Ctrl-C reaches it; with `timeout_s` a `TimeoutError` says that time has run out.
fn in_pool<T: Send>(
    py: Python<'_>,
    num_threads: Option<usize>,
    timeout_s: Option<f64>,
    job: impl FnOnce(&Interrupt) -> Result<T, FeatureError> + Send,
) -> PyResult<T> {
    let start = Instant::now();
    register::in_pool(py, num_threads, |interrupt| {
        job(&interrupt.clone().with_timeout(start, timeout_s)).map_err(to_py)
    })
}

fn vectors(py: Python<'_>, rows: Vec<Vector3<f64>>) -> PyResult<Floats<'_>> {
    let count = rows.len();
    let flat: Vec<f64> = rows.iter().flat_map(|v| [v.x, v.y, v.z]).collect();
    flat.into_pyarray(py).reshape([count, 3])
}

fn to_py(error: FeatureError) -> PyErr {
    let message = error.to_string();
    // Of a signal nobody sees it: that is raised first.
    if error == FeatureError::Interrupted {
        PyTimeoutError::new_err(message)
    } else {
        InputError::new_err(message)
    }
}
