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
use numpy::{IntoPyArray, PyArray1, PyReadonlyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::background;
use crate::convert::{Pose, Poses, Rows, finite_points, pose, poses};
use crate::error::OrPyErr;
use crate::symmetries::Symmetries;

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
fn metrics_add(py: Python<'_>, model: Rows<'_>, predicted: Pose<'_>, truth: Pose<'_>) -> PyResult<f64> {
    let (points, predicted, truth) =
        (finite_points("model", &model)?, pose("predicted", &predicted)?, pose("truth", &truth)?);
    py.detach(|| Model::new(points).map(|model| model.add(&predicted, &truth))).or_py_err()
}

#[pyfunction]
fn metrics_add_s(
    py: Python<'_>,
    model: Rows<'_>,
    predicted: Pose<'_>,
    truth: Pose<'_>,
    num_threads: Option<usize>,
) -> PyResult<f64> {
    let (points, predicted, truth) =
        (finite_points("model", &model)?, pose("predicted", &predicted)?, pose("truth", &truth)?);
    in_pool(py, num_threads, points.len(), |interrupt| {
        Model::new(points)?.add_s(&predicted, &truth, interrupt)
    })
}

#[pyfunction]
fn metrics_mssd(
    py: Python<'_>,
    model: Rows<'_>,
    predicted: Pose<'_>,
    truth: Pose<'_>,
    symmetries: &Symmetries,
) -> PyResult<f64> {
    let (points, predicted, truth) =
        (finite_points("model", &model)?, pose("predicted", &predicted)?, pose("truth", &truth)?);
    in_pool(py, Some(1), 0, |interrupt| {
        Model::new(points)?.mssd(&predicted, &truth, &symmetries.0, interrupt)
    })
}

#[pyfunction]
fn metrics_diameter(py: Python<'_>, points: Rows<'_>, num_threads: Option<usize>) -> PyResult<f64> {
    let points = finite_points("points", &points)?;
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
        return Err(PyValueError::new_err(format!("cost[{}, {}] must be finite", cell / cols, cell % cols)));
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
    model: Rows<'py>,
    diameter_fraction: f64,
    symmetries: &Symmetries,
    num_threads: Option<usize>,
) -> PyResult<Scored<'py>> {
    let (predicted, truth) = (poses("predicted", &predicted)?, poses("truth", &truth)?);
    let (points, matching) = (finite_points("model", &model)?, self::matching(matching)?);
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
    model: Rows<'py>,
    symmetries: &Symmetries,
    num_threads: Option<usize>,
) -> PyResult<(f64, Bound<'py, PyArray1<f64>>)> {
    let (predicted, truth) = (poses("predicted", &predicted)?, poses("truth", &truth)?);
    let (points, matching) = (finite_points("model", &model)?, self::matching(matching)?);
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
                .map_err(|error| PyValueError::new_err(format!("scenes[{index}]: {error}")))
        })
        .collect();
    let mean = metrics::mean_score(&scenes?).or_py_err()?;
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
        .ok_or_else(|| PyValueError::new_err(format!("matching must be {}, not '{name}'", names())))
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
    background::in_pool(py, num_threads, job)
}
