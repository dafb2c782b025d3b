//! The metrics for Python: numpy in, numpy and numbers out. The maths is in `ibi_core::metrics`.
//!
//! `ibi_rs.metrics` checks shapes and names before it calls; what only the numbers can tell (finite, rigid)
//! is checked here. All errors are `ValueError`s of one line that names the argument.

// pyo3 hands arguments over by value; a read-only array is a handle, cheap to own.
#![expect(clippy::needless_pass_by_value)]

use ibi_core::Interrupt;
use ibi_core::metrics::{
    self, Criterion, Matching, MetricsError, Model, PoseThresholds, SceneScore, rotation_error_rad,
    translation_error,
};
use ibi_core::nalgebra::{Isometry3, Matrix3, Point3, Rotation3, UnitQuaternion, Vector3};
use numpy::ndarray::{ArrayView2, Axis};
use numpy::{IntoPyArray, PyArray1, PyReadonlyArray2, PyReadonlyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::register;
use crate::symmetries::Symmetries;

/// How far from a rotation a matrix may be, per entry of R^T R: the rounding of single precision passes, a
/// scale or a shear does not.
const RIGID_TOLERANCE: f64 = 1e-6;

/// Adds the functions of this file to the module.
pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(metrics_rotation_error_rad, m)?)?;
    m.add_function(wrap_pyfunction!(metrics_translation_error, m)?)?;
    m.add_function(wrap_pyfunction!(metrics_frobenius_distance, m)?)?;
    m.add_function(wrap_pyfunction!(metrics_add, m)?)?;
    m.add_function(wrap_pyfunction!(metrics_add_s, m)?)?;
    m.add_function(wrap_pyfunction!(metrics_mssd, m)?)?;
    m.add_function(wrap_pyfunction!(metrics_diameter, m)?)?;
    m.add_function(wrap_pyfunction!(metrics_assignment, m)?)?;
    m.add_function(wrap_pyfunction!(metrics_score_pose, m)?)?;
    m.add_function(wrap_pyfunction!(metrics_score_add_s, m)?)?;
    m.add_function(wrap_pyfunction!(metrics_mssd_recall, m)?)?;
    m.add_function(wrap_pyfunction!(metrics_mean_score, m)?)?;
    Ok(())
}

pub(crate) type Poses<'py> = PyReadonlyArray3<'py, f64>;
pub(crate) type Pose<'py> = PyReadonlyArray2<'py, f64>;
type Points<'py> = PyReadonlyArray2<'py, f64>;

/// Counts of hits (truth, predicted); recall, precision, F1; then one entry per prediction: the row of its
/// truth or -1, rotation error (rad), translation error, distance (NaN without a truth), whether it is a hit.
type Scored<'py> = (
    (usize, usize),
    (f64, f64, f64),
    Bound<'py, PyArray1<i64>>,
    Bound<'py, PyArray1<f64>>,
    Bound<'py, PyArray1<f64>>,
    Bound<'py, PyArray1<f64>>,
    Bound<'py, PyArray1<bool>>,
);

#[pyfunction]
fn metrics_rotation_error_rad(a: Pose<'_>, b: Pose<'_>, symmetries: &Symmetries) -> PyResult<f64> {
    let (a, b) = (pose("a", &a)?, pose("b", &b)?);
    Ok(rotation_error_rad(&symmetries.0.nearest(&a, &b), &b))
}

#[pyfunction]
fn metrics_translation_error(a: Pose<'_>, b: Pose<'_>, symmetries: &Symmetries) -> PyResult<f64> {
    let (a, b) = (pose("a", &a)?, pose("b", &b)?);
    Ok(translation_error(&symmetries.0.nearest(&a, &b), &b))
}

#[pyfunction]
fn metrics_frobenius_distance(a: Pose<'_>, b: Pose<'_>) -> PyResult<f64> {
    Ok(metrics::frobenius_distance(&pose("a", &a)?, &pose("b", &b)?))
}

#[pyfunction]
fn metrics_add(py: Python<'_>, model: Points<'_>, predicted: Pose<'_>, truth: Pose<'_>) -> PyResult<f64> {
    let (points, predicted, truth) =
        (points("model", &model)?, pose("predicted", &predicted)?, pose("truth", &truth)?);
    py.detach(|| Ok(Model::new(points)?.add(&predicted, &truth))).map_err(to_py)
}

#[pyfunction]
fn metrics_add_s(
    py: Python<'_>,
    model: Points<'_>,
    predicted: Pose<'_>,
    truth: Pose<'_>,
    num_threads: Option<usize>,
) -> PyResult<f64> {
    let (points, predicted, truth) =
        (points("model", &model)?, pose("predicted", &predicted)?, pose("truth", &truth)?);
    in_pool(py, num_threads, points.len(), |interrupt| {
        Model::new(points)?.add_s(&predicted, &truth, interrupt)
    })
}

#[pyfunction]
fn metrics_mssd(
    py: Python<'_>,
    model: Points<'_>,
    predicted: Pose<'_>,
    truth: Pose<'_>,
    symmetries: &Symmetries,
) -> PyResult<f64> {
    let (points, predicted, truth) =
        (points("model", &model)?, pose("predicted", &predicted)?, pose("truth", &truth)?);
    in_pool(py, Some(1), 0, |interrupt| {
        Model::new(points)?.mssd(&predicted, &truth, &symmetries.0, interrupt)
    })
}

#[pyfunction]
fn metrics_diameter(py: Python<'_>, points: Points<'_>, num_threads: Option<usize>) -> PyResult<f64> {
    let points = self::points("points", &points)?;
    in_pool(py, num_threads, points.len(), |interrupt| metrics::diameter(&points, interrupt))
}

/// One column per row, -1 for a row left over.
#[pyfunction]
fn metrics_assignment<'py>(
    py: Python<'py>,
    cost: PyReadonlyArray2<'py, f64>,
) -> PyResult<Bound<'py, PyArray1<i64>>> {
    let cost = cost.as_array();
    let (rows, cols) = cost.dim();
    let cost: Vec<f64> = cost.iter().copied().collect();
    if let Some(cell) = cost.iter().position(|x| !x.is_finite()) {
        return Err(value_error(format!("cost[{}, {}] must be finite", cell / cols, cell % cols)));
    }
    let columns = in_pool(py, Some(1), 0, |interrupt| metrics::assignment(&cost, rows, cols, interrupt))?;
    Ok(columns.into_iter().map(row_or_minus_one).collect::<Vec<_>>().into_pyarray(py))
}

#[pyfunction]
#[allow(clippy::too_many_arguments)] // Python's keyword arguments
fn metrics_score_pose<'py>(
    py: Python<'py>,
    predicted: Poses<'py>,
    truth: Poses<'py>,
    matching: &str,
    rotation_rad: f64,
    translation: f64,
    symmetries: &Symmetries,
    num_threads: Option<usize>,
) -> PyResult<Scored<'py>> {
    let (predicted, truth) = (poses("predicted", &predicted)?, poses("truth", &truth)?);
    let matching = self::matching(matching)?;
    let criterion = Criterion::Pose(PoseThresholds { rotation_rad, translation });
    let score = in_pool(py, num_threads, predicted.len() * truth.len(), |interrupt| {
        metrics::score_scene_modulo(&predicted, &truth, matching, &criterion, &symmetries.0, interrupt)
    })?;
    Ok(scored(py, &score))
}

#[pyfunction]
#[allow(clippy::too_many_arguments)] // Python's keyword arguments
fn metrics_score_add_s<'py>(
    py: Python<'py>,
    predicted: Poses<'py>,
    truth: Poses<'py>,
    matching: &str,
    model: Points<'py>,
    diameter_fraction: f64,
    symmetries: &Symmetries,
    num_threads: Option<usize>,
) -> PyResult<Scored<'py>> {
    let (predicted, truth) = (poses("predicted", &predicted)?, poses("truth", &truth)?);
    let (points, matching) = (points("model", &model)?, self::matching(matching)?);
    let work = predicted.len() * truth.len() * points.len();
    let score = in_pool(py, num_threads, work, |interrupt| {
        let model = Model::new(points)?;
        let criterion = Criterion::AddS { model: &model, diameter_fraction };
        metrics::score_scene_modulo(&predicted, &truth, matching, &criterion, &symmetries.0, interrupt)
    })?;
    Ok(scored(py, &score))
}

/// The average recall, and the recall at each part of the diameter.
#[pyfunction]
fn metrics_mssd_recall<'py>(
    py: Python<'py>,
    predicted: Poses<'py>,
    truth: Poses<'py>,
    matching: &str,
    model: Points<'py>,
    symmetries: &Symmetries,
    num_threads: Option<usize>,
) -> PyResult<(f64, Bound<'py, PyArray1<f64>>)> {
    let (predicted, truth) = (poses("predicted", &predicted)?, poses("truth", &truth)?);
    let (points, matching) = (points("model", &model)?, self::matching(matching)?);
    let work = predicted.len() * truth.len() * points.len();
    let found = in_pool(py, num_threads, work, |interrupt| {
        let model = Model::new(points)?;
        metrics::mssd_recall(&model, &predicted, &truth, &symmetries.0, matching, interrupt)
    })?;
    Ok((found.average, found.recalls.to_vec().into_pyarray(py)))
}

/// MHR, MHP and MHF1 of scenes given as (truth, predicted, truth hit, predicted hit).
#[pyfunction]
fn metrics_mean_score(
    matching: &str,
    counts: Vec<(usize, usize, usize, usize)>,
) -> PyResult<(f64, f64, f64)> {
    let matching = self::matching(matching)?;
    let scenes: Result<Vec<_>, _> = counts
        .into_iter()
        .enumerate()
        .map(|(index, (truth, predicted, truth_hit, predicted_hit))| {
            SceneScore::from_counts(matching, truth, predicted, truth_hit, predicted_hit)
                .map_err(|error| value_error(format!("scenes[{index}]: {error}")))
        })
        .collect();
    let mean = metrics::mean_score(&scenes?).map_err(to_py)?;
    Ok((mean.mhr, mean.mhp, mean.mhf1))
}

fn scored<'py>(py: Python<'py>, score: &SceneScore) -> Scored<'py> {
    let error_of = |of: fn(&metrics::PoseMatch) -> f64| {
        let errors: Vec<f64> = score.matches.iter().map(|m| m.as_ref().map_or(f64::NAN, of)).collect();
        errors.into_pyarray(py)
    };
    let truth: Vec<i64> = score.matches.iter().map(|m| row_or_minus_one(m.map(|m| m.truth))).collect();
    let is_hit: Vec<bool> = score.matches.iter().map(|m| m.is_some_and(|m| m.is_hit)).collect();
    (
        (score.num_truth_hit, score.num_predicted_hit),
        (score.recall, score.precision, score.f1),
        truth.into_pyarray(py),
        error_of(|m| m.rotation_error_rad),
        error_of(|m| m.translation_error),
        error_of(|m| m.distance),
        is_hit.into_pyarray(py),
    )
}

/// Numpy has no missing integer.
fn row_or_minus_one(row: Option<usize>) -> i64 {
    row.map_or(-1, |row| i64::try_from(row).unwrap_or(i64::MAX))
}

fn matching(name: &str) -> PyResult<Matching> {
    let names = || Matching::ALL.map(|m| format!("'{m}'")).join(" or ");
    Matching::ALL
        .into_iter()
        .find(|m| m.name() == name)
        .ok_or_else(|| value_error(format!("matching must be {}, not '{name}'", names())))
}

/// (N, 3) to points.
fn points(name: &str, array: &Points<'_>) -> PyResult<Vec<Point3<f64>>> {
    let rows = array.as_array();
    if rows.ncols() != 3 {
        return Err(value_error(format!("{name} must have shape (N, 3), not {:?}", rows.shape())));
    }
    if let Some(row) = rows.outer_iter().position(|row| row.iter().any(|x| !x.is_finite())) {
        return Err(value_error(format!("{name}[{row}] must be finite")));
    }
    Ok(rows.outer_iter().map(|row| Point3::new(row[0], row[1], row[2])).collect())
}

/// (K, 4, 4) to rigid motions.
pub(crate) fn poses(name: &str, array: &Poses<'_>) -> PyResult<Vec<Isometry3<f64>>> {
    let matrices = array.as_array();
    let motions = matrices.axis_iter(Axis(0)).enumerate();
    motions
        .map(|(row, matrix)| rigid_motion(&matrix, || format!("{name}[{row}]")).map_err(value_error))
        .collect()
}

/// (4, 4) to a rigid motion.
pub(crate) fn pose(name: &str, array: &Pose<'_>) -> PyResult<Isometry3<f64>> {
    rigid_motion(&array.as_array(), || name.to_owned()).map_err(value_error)
}

/// The rigid motion of a (4, 4) matrix; else what is wrong with it, in words.
pub(crate) fn rigid_motion(
    m: &ArrayView2<'_, f64>,
    name: impl Fn() -> String,
) -> Result<Isometry3<f64>, String> {
    let must = |what: &str| Err(format!("{} must {what}", name()));
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

/// Less work, in points looked at, is not worth a second thread.
const LITTLE: usize = 10_000;

/// Runs `job` on threads of its own, where Ctrl-C reaches it.
fn in_pool<T: Send>(
    py: Python<'_>,
    num_threads: Option<usize>,
    work: usize,
    job: impl FnOnce(&Interrupt) -> Result<T, MetricsError> + Send,
) -> PyResult<T> {
    let num_threads = if work < LITTLE { Some(1) } else { num_threads };
    register::in_pool(py, num_threads, |interrupt| job(interrupt).map_err(to_py))
}

fn to_py(error: MetricsError) -> PyErr {
    value_error(error.to_string())
}

fn value_error(message: String) -> PyErr {
    PyValueError::new_err(message)
}
