//! The features for Python: numpy in, numpy out, the GIL released in between. The maths is in `ibi_core::features`.

// pyo3 hands arguments over by value; a read-only array is a handle, cheap to own.
#![expect(clippy::needless_pass_by_value)]

use ibi_core::features::{
    self, Amount, Descriptors, FeatureError, Matching, Mesh, Neighborhood, PlaneSearch, Views,
};
use ibi_core::nalgebra::{Point3, Vector3};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;

use crate::background::in_pool;
use crate::convert::{Floats, Rows, mesh, pairs, rows3, vectors};
use crate::error::{InputError, ToPyErr};

/// Adds the functions of this file to the module.
pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(features_voxel_downsample, m)?)?;
    m.add_function(wrap_pyfunction!(features_estimate_normals, m)?)?;
    m.add_function(wrap_pyfunction!(features_fpfh, m)?)?;
    m.add_function(wrap_pyfunction!(features_match, m)?)?;
    m.add_function(wrap_pyfunction!(features_dominant_plane, m)?)?;
    m.add_function(wrap_pyfunction!(features_sample_mesh, m)?)?;
    m.add_function(wrap_pyfunction!(features_outer_surface, m)?)?;
    Ok(())
}

#[pyfunction]
fn features_voxel_downsample<'py>(
    py: Python<'py>,
    points: Rows<'py>,
    normals: Option<Rows<'py>>,
    voxel: f64,
    num_threads: Option<usize>,
) -> PyResult<(Floats<'py>, Option<Floats<'py>>)> {
    let points = rows3(&points, Point3::new)?;
    let normals = normals.map(|normals| rows3(&normals, Vector3::new)).transpose()?;
    // Of fewer points a second thread is not worth its start.
    let num_threads = if points.len() < 50_000 { Some(1) } else { num_threads };
    let thinned = in_pool(py, num_threads, |interrupt| {
        features::voxel_downsample(&points, normals.as_deref(), voxel, interrupt)
    })?;
    let normals = thinned.normals.map(|rows| vectors(py, rows.into_iter().map(Into::into))).transpose()?;
    Ok((vectors(py, thinned.points.into_iter().map(Into::into))?, normals))
}

#[pyfunction]
#[allow(clippy::too_many_arguments)] // Python's keyword arguments
fn features_estimate_normals<'py>(
    py: Python<'py>,
    points: Rows<'py>,
    radius: f64,
    max_neighbors: usize,
    viewpoint: Option<[f64; 3]>,
    num_threads: Option<usize>,
) -> PyResult<Floats<'py>> {
    let points = rows3(&points, Point3::new)?;
    let neighborhood = Neighborhood { radius, max_neighbors };
    let viewpoint = viewpoint.map(Point3::from);
    let normals = in_pool(py, num_threads, |interrupt| {
        features::estimate_normals(&points, neighborhood, viewpoint, interrupt)
    })?;
    vectors(py, normals.into_iter().map(Into::into))
}

#[pyfunction]
#[allow(clippy::too_many_arguments)] // Python's keyword arguments
fn features_fpfh<'py>(
    py: Python<'py>,
    points: Rows<'py>,
    normals: Rows<'py>,
    radius: f64,
    max_neighbors: usize,
    keypoints: Option<PyReadonlyArray1<'py, i64>>,
    num_threads: Option<usize>,
) -> PyResult<Bound<'py, PyArray2<f32>>> {
    let (points, normals) = (rows3(&points, Point3::new)?, rows3(&normals, Vector3::new)?);
    let neighborhood = Neighborhood { radius, max_neighbors };
    let keypoints = keypoints.map(|rows| keypoint_rows(&rows, points.len())).transpose()?;
    let descriptors = in_pool(py, num_threads, |interrupt| {
        features::fpfh(&points, &normals, neighborhood, keypoints.as_deref(), interrupt)
    })?;
    let rows = descriptors.len();
    descriptors.into_flattened().into_pyarray(py).reshape([rows, features::FPFH_DIM])
}

/// The core counts rows from 0; what is negative must be refused by the number that the user gave.
fn keypoint_rows(rows: &PyReadonlyArray1<'_, i64>, len: usize) -> PyResult<Vec<usize>> {
    let row = |(at, &row): (usize, &i64)| {
        usize::try_from(row).map_err(|_| {
            FeatureError::RowOutOfRange { argument: "keypoints", at, row, of: "points", len }.to_py_err()
        })
    };
    rows.as_array().iter().enumerate().map(row).collect()
}

/// (M, 2) int64 [source row, target row], and (M,) float64.
type Pairs<'py> = (Bound<'py, PyArray2<i64>>, Bound<'py, PyArray1<f64>>);

#[pyfunction]
#[allow(clippy::too_many_arguments)] // Python's keyword arguments
fn features_match<'py>(
    py: Python<'py>,
    src_feat: PyReadonlyArray2<'py, f32>,
    tgt_feat: PyReadonlyArray2<'py, f32>,
    k: usize,
    mutual: bool,
    ratio: Option<f64>,
    num_threads: Option<usize>,
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
    let matches = in_pool(py, num_threads, |interrupt| {
        let [src, tgt] = [&src, &tgt].map(|(values, dim)| Descriptors { values, dim: *dim });
        features::match_features(src, tgt, matching, interrupt)
    })?;
    Ok((pairs(py, matches.rows)?, matches.similarity.into_pyarray(py)))
}

/// The normal, the offset, which points are near, and the share of those behind.
type Plane<'py> = ([f64; 3], f64, Bound<'py, PyArray1<bool>>, f64);

#[pyfunction]
#[allow(clippy::too_many_arguments)] // Python's keyword arguments
fn features_dominant_plane<'py>(
    py: Python<'py>,
    points: Rows<'py>,
    distance: f64,
    min_share: f64,
    viewpoint: Option<[f64; 3]>,
    seed: u64,
    num_threads: Option<usize>,
) -> PyResult<Option<Plane<'py>>> {
    let points = rows3(&points, Point3::new)?;
    let search = PlaneSearch { distance, min_share, seed };
    let viewpoint = viewpoint.map(Point3::from);
    let plane = in_pool(py, num_threads, |interrupt| {
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
    let sampled = in_pool(py, Some(1), |interrupt| features::sample_mesh(&mesh, amount, seed, interrupt))?;
    let points = vectors(py, sampled.points.into_iter().map(Into::into))?;
    Ok((points, vectors(py, sampled.normals.into_iter().map(Into::into))?))
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
    let is_outer = in_pool(py, num_threads, |interrupt| {
        features::outer_surface(&points, &normals, &mesh, &views, interrupt)
    })?;
    Ok(is_outer.into_pyarray(py))
}
