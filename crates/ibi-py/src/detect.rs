//! `Model.correspond` and `Model.detect`: a scan in, matches or poses out.

use ibi_core::Registrar;
use ibi_core::detection::{Detect, Detection, Doubt, MatchedScan, Measured, Roi};
use ibi_core::nalgebra::{Point3, Vector3};
use numpy::{IntoPyArray, PyArray1, PyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::background::{Caller, in_pool};
use crate::convert::{Floats, Pose, Rows, json, pairs, pose, rows3, vectors};
use crate::error::OrPyErr;
use crate::model::{Model, Models, run};
use crate::params;
use crate::register::{observed, scan, to_dict};
use crate::stages::{self, OwnStages};

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(measured_rows, m)?)?;
    m.add_function(wrap_pyfunction!(correspond, m)?)?;
    m.add_function(wrap_pyfunction!(detect, m)?)?;
    m.add_function(wrap_pyfunction!(detect_together, m)?)
}

/// Points, normals if there are enough, how many rows were left out, how many points had no normal.
type MeasuredRows<'py> = (Floats<'py>, Option<Floats<'py>>, usize, usize);

/// The rows of a scan that are finite, and their normals, completed.
#[pyfunction]
#[pyo3(signature = (points, normals=None))]
#[allow(clippy::needless_pass_by_value)] // PyO3 owns
fn measured_rows<'py>(
    py: Python<'py>,
    points: Rows<'py>,
    normals: Option<Rows<'py>>,
) -> PyResult<MeasuredRows<'py>> {
    let points = rows3(&points, Point3::new)?;
    let normals = normals.map(|normals| rows3(&normals, Vector3::new)).transpose()?;
    let measured = py.detach(|| Measured::of(&points, normals.as_deref())).or_py_err()?;
    let normals = measured.normals.map(|rows| vectors(py, rows.into_iter().map(Into::into))).transpose()?;
    let points = vectors(py, measured.points.into_iter().map(Into::into))?;
    Ok((points, normals, measured.num_dropped, measured.num_without_normal))
}

/// Points, normals, [row of the model, row of the points], similarity, background, voxel, doubts.
type Matched<'py> = (
    Floats<'py>,
    Floats<'py>,
    Bound<'py, PyArray2<i64>>,
    Bound<'py, PyArray1<f64>>,
    Floats<'py>,
    f64,
    Vec<String>,
);

#[pyfunction]
#[allow(clippy::too_many_arguments, clippy::needless_pass_by_value)] // Python's arguments; PyO3 owns
fn correspond<'py>(
    py: Python<'py>,
    model: &Model,
    tgt: Rows<'py>,
    tgt_normals: Option<Rows<'py>>,
    viewpoint: Option<Vec<[f64; 3]>>,
    measured: Option<Vec<Rows<'py>>>,
    remove_plane: Option<bool>,
    check_units: bool,
    roi: Option<Place<'py>>,
    background: Option<Rows<'py>>,
    num_threads: Option<usize>,
) -> PyResult<Matched<'py>> {
    let tgt = rows3(&tgt, Point3::new)?;
    let scan = scan(&tgt, tgt_normals.as_ref(), viewpoint, measured.as_deref())?;
    let (roi, background) = (region(roi)?, empty(background)?);
    let options = Detect { remove_plane, check_units, roi, background, ..Detect::default() };
    let matched = in_pool(py, num_threads, |interrupt| model.0.correspond(&scan, &options, interrupt))?;
    Ok((
        vectors(py, matched.points.into_iter().map(Into::into))?,
        vectors(py, matched.normals.into_iter().map(Into::into))?,
        pairs(py, matched.matches.rows)?,
        matched.matches.similarity.into_pyarray(py),
        vectors(py, matched.background.into_iter().map(Into::into))?,
        matched.voxel,
        matched.doubts.iter().map(Doubt::to_string).collect(),
    ))
}

/// (4, 4) target_from_box and the lengths of its sides.
type Place<'py> = (Pose<'py>, [f64; 3]);

fn region(roi: Option<Place<'_>>) -> PyResult<Option<Roi>> {
    let of =
        |(at, size): Place<'_>| Ok(Roi { target_from_box: pose("roi", &at)?, size: Vector3::from(size) });
    roi.map(of).transpose()
}

fn empty(background: Option<Rows<'_>>) -> PyResult<Option<Vec<Point3<f64>>>> {
    background.map(|rows| rows3(&rows, Point3::new)).transpose()
}

/// As `register`, with `warnings`, `background` and `resolution_set`, that of the parameters. `own` is called with the points and the
/// correspondences that are registered, and returns the callables that stand for stages.
#[pyfunction]
#[allow(clippy::too_many_arguments, clippy::needless_pass_by_value)] // Python's arguments; PyO3 owns
fn detect<'py>(
    py: Python<'py>,
    model: &Model,
    tgt: Rows<'py>,
    params: &str,
    tgt_normals: Option<Rows<'py>>,
    viewpoint: Option<Vec<[f64; 3]>>,
    measured: Option<Vec<Rows<'py>>>,
    remove_plane: Option<bool>,
    check_units: bool,
    roi: Option<Place<'py>>,
    background: Option<Rows<'py>>,
    num_threads: Option<usize>,
    on_round: Option<Py<PyAny>>,
    own: Option<Py<PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let params = Some(params::parse(params)?);
    let tgt = rows3(&tgt, Point3::new)?;
    let scan = scan(&tgt, tgt_normals.as_ref(), viewpoint, measured.as_deref())?;
    let (roi, background) = (region(roi)?, empty(background)?);
    let found = observed(py, on_round.as_ref(), |cancel, caller, observer| {
        let options =
            Detect { params, remove_plane, check_units, roi, background, run: run(cancel, num_threads) };
        let set_up = |registrar, matched: &MatchedScan| own_stages(registrar, matched, own, &caller);
        model.0.detect_with(&scan, &options, set_up, observer)
    })?;
    detected(py, &found)
}

/// Several models: what `detect` gives of each, [index of the model, index of its pose] of all, best first, the reason why the whole
/// ended, as JSON and as words, and its seconds. `own` has a callable for each model, or is empty.
#[pyfunction]
#[allow(clippy::too_many_arguments, clippy::needless_pass_by_value)] // Python's arguments; PyO3 owns
fn detect_together<'py>(
    py: Python<'py>,
    models: &Models,
    tgt: Rows<'py>,
    params: &str,
    tgt_normals: Option<Rows<'py>>,
    viewpoint: Option<Vec<[f64; 3]>>,
    measured: Option<Vec<Rows<'py>>>,
    remove_plane: Option<bool>,
    check_units: bool,
    roi: Option<Place<'py>>,
    background: Option<Rows<'py>>,
    num_threads: Option<usize>,
    on_round: Option<Py<PyAny>>,
    own: Vec<Py<PyAny>>,
) -> PyResult<Together<'py>> {
    let params = Some(params::parse(params)?);
    let tgt = rows3(&tgt, Point3::new)?;
    let scan = scan(&tgt, tgt_normals.as_ref(), viewpoint, measured.as_deref())?;
    let (roi, background) = (region(roi)?, empty(background)?);
    let found = observed(py, on_round.as_ref(), |cancel, caller, observer| {
        let options =
            Detect { params, remove_plane, check_units, roi, background, run: run(cancel, num_threads) };
        let mut own: Vec<Option<Py<PyAny>>> = own.into_iter().map(Some).collect();
        let set_up = |at: usize, registrar, matched: &MatchedScan| {
            let own = own.get_mut(at).and_then(Option::take);
            own_stages(registrar, matched, own, &caller)
        };
        models.0.detect_with(&scan, &options, set_up, observer)
    })?;
    let parts = found.parts.iter().map(|part| detected(py, part)).collect::<PyResult<Vec<_>>>()?;
    Ok((parts, found.ranking, json(&found.stop_reason)?, found.stop_reason.to_string(), found.total_s))
}

type Together<'py> = (Vec<Bound<'py, PyDict>>, Vec<[usize; 2]>, String, String, f64);

fn own_stages(
    registrar: Registrar<'static>,
    matched: &MatchedScan,
    own: Option<Py<PyAny>>,
    caller: &Caller,
) -> Registrar<'static> {
    let Some(own) = own else { return registrar };
    let (points, rows) = (matched.points.clone(), matched.matches.rows.clone());
    let stages = caller.call(move |py| {
        let tgt = vectors(py, points.into_iter().map(Into::into))?;
        own.bind(py).call1((tgt, pairs(py, rows)?))?.extract::<OwnStages>()
    });
    stages::put_in(registrar, stages.unwrap_or_default(), caller)
}

fn detected<'py>(py: Python<'py>, found: &Detection) -> PyResult<Bound<'py, PyDict>> {
    let result = to_dict(py, &found.registration)?;
    result.set_item("warnings", found.doubts().map(Doubt::to_string).collect::<Vec<_>>())?;
    result.set_item("resolution_set", found.params.resolution)?;
    let background = found.scan.as_ref().map_or(&[][..], |scan| &scan.background);
    result.set_item("background", vectors(py, background.iter().copied().map(Into::into))?)?;
    Ok(result)
}
