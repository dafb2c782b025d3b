//! `register`: arrays in, arrays out, the GIL released in between.

use std::ops::ControlFlow;
use std::sync::Arc;

use ibi_core::nalgebra::Point3;
use ibi_core::{CancelToken, Cloud, Observer, Registrar, Registration, Round};
use numpy::{PyArray1, PyReadonlyArray1, PyReadonlyArray3};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::background::{Caller, in_background};
use crate::convert::{
    Rows, correspondences, json, matrices, rows3, square, vectors, with_frames, with_normals,
};
use crate::error::{OrPyErr, ToPyErr};
use crate::model::{Model, run};
use crate::params;
use crate::stages::{self, OwnStages};

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(register_clouds, m)?)
}

/// See `ibi_rs.register`, which brings its arguments into the shapes and dtypes that are wanted here. `own` has the
/// callables that stand for stages, by their names.
#[pyfunction(name = "register")]
#[pyo3(signature = (model, tgt, corr, params, *, tgt_normals=None, tgt_frames=None, similarity=None, viewpoint=None, measured=None, num_threads=None, on_round=None, own=None))]
#[allow(clippy::too_many_arguments, clippy::needless_pass_by_value)] // Python's keyword arguments; PyO3 owns
fn register_clouds<'py>(
    py: Python<'py>,
    model: &Model,
    tgt: Rows<'py>,
    corr: &Bound<'py, PyAny>,
    params: &str,
    tgt_normals: Option<Rows<'py>>,
    tgt_frames: Option<PyReadonlyArray3<'py, f64>>,
    similarity: Option<PyReadonlyArray1<'py, f64>>,
    viewpoint: Option<Vec<[f64; 3]>>,
    measured: Option<Vec<Rows<'py>>>,
    num_threads: Option<usize>,
    on_round: Option<Py<PyAny>>,
    own: Option<OwnStages>,
) -> PyResult<Bound<'py, PyDict>> {
    let params = params::parse(params)?;
    // Copied, as other threads may write to the array; borrowed from here on, as scenes can be large.
    let tgt = rows3(&tgt, Point3::new)?;
    let target = scan(&tgt, tgt_normals.as_ref(), viewpoint, measured.as_deref())?;
    let target = with_frames(target, tgt_frames.as_ref())?;
    let mut correspondences = correspondences(corr)?;
    if let Some(similarity) = similarity {
        correspondences = correspondences.with_similarity(similarity.as_array().to_vec());
    }
    let registration = observed(py, on_round.as_ref(), |cancel, caller, observer| {
        let registrar = Registrar::of(Arc::clone(model.0.source())).params(params);
        let registrar = run(cancel, num_threads).registrar(registrar);
        let registrar = stages::put_in(registrar, own.unwrap_or_default(), &caller);
        registrar.register_observed(&target, &correspondences, observer)
    })?;
    to_dict(py, &registration)
}

/// A scene, as far as it is the same for registration and detection.
pub(crate) fn scan<'a>(
    tgt: &'a [Point3<f64>],
    normals: Option<&Rows<'_>>,
    viewpoints: Option<Vec<[f64; 3]>>,
    measured: Option<&[Rows<'_>]>,
) -> PyResult<Cloud<'a>> {
    let mut cloud = with_normals(Cloud::new(tgt), normals)?;
    if let Some(viewpoints) = viewpoints {
        cloud = cloud.with_viewpoints(viewpoints.into_iter().map(Point3::from).collect());
    }
    if let Some(measured) = measured {
        let parts = measured.iter().map(|part| Ok(rows3(part, Point3::new)?.into()));
        cloud = cloud.with_measured_by_each(parts.collect::<PyResult<_>>()?);
    }
    Ok(cloud)
}

/// Runs a registration in the background; `on_round` is told each round in the thread that plays it.
pub(crate) fn observed<T: Send, E: ToPyErr>(
    py: Python<'_>,
    on_round: Option<&Py<PyAny>>,
    run: impl FnOnce(CancelToken, Caller, &mut dyn Observer) -> Result<T, E> + Send,
) -> PyResult<T> {
    in_background(py, |cancel, caller| {
        let mut failure = None;
        let has_failed = cancel.clone();
        let mut observer = |round: &Round| {
            if has_failed.is_cancelled() {
                return ControlFlow::Break(()); // a round that a stage has failed in is none to tell of
            }
            tell(on_round, round).unwrap_or_else(|error| {
                failure = Some(error);
                ControlFlow::Break(())
            })
        };
        let result = run(cancel, caller, &mut observer).or_py_err();
        failure.map_or(result, Err)
    })
}

/// Calls the Python callback; `False` ends the run.
fn tell(callback: Option<&Py<PyAny>>, round: &Round) -> PyResult<ControlFlow<()>> {
    let Some(callback) = callback else { return Ok(ControlFlow::Continue(())) };
    let round = json(round)?;
    let told = Python::try_attach(|py| {
        let answer = callback.bind(py).call1((round,))?;
        let stop = answer.is_instance_of::<pyo3::types::PyBool>() && !answer.is_truthy()?;
        Ok(if stop { ControlFlow::Break(()) } else { ControlFlow::Continue(()) })
    });
    told.unwrap_or(Ok(ControlFlow::Break(()))) // the process ends
}

/// Arrays as arrays, what is nested as JSON.
pub(crate) fn to_dict<'py>(py: Python<'py>, registration: &Registration) -> PyResult<Bound<'py, PyDict>> {
    let poses = &registration.poses;
    let column = |f: fn(&ibi_core::Pose) -> f64| poses.iter().map(f).collect::<Vec<f64>>();
    let inliers: Vec<_> =
        poses.iter().map(|p| PyArray1::from_iter(py, p.inliers.iter().map(|&id| i64::from(id)))).collect();
    let labels = registration.labels.iter().map(|label| label.map_or(-1, u32::cast_signed));
    let result = PyDict::new(py);
    result.set_item("target_from_source", matrices(py, poses.iter().map(|p| &p.target_from_source))?)?;
    result.set_item("score", column(|p| p.score))?;
    result.set_item("overlap", column(|p| p.overlap))?;
    result.set_item("closeness", column(|p| p.closeness))?;
    result.set_item("back_fit", column(|p| p.back_fit))?;
    result.set_item("evidence", column(|p| p.evidence))?;
    result.set_item("inlier_rmse", column(|p| p.inlier_rmse))?;
    result.set_item("inliers", inliers)?;
    result.set_item("round", poses.iter().map(|p| p.round).collect::<Vec<u32>>())?;
    let measures: Vec<_> = poses.iter().map(|p| p.measures).collect();
    result.set_item("measures", json(&measures)?)?;
    result.set_item("centre", vectors(py, poses.iter().map(|p| p.centre.into()))?)?;
    let covariances: PyResult<Vec<_>> =
        poses.iter().map(|p| p.covariance.map(|of| square(py, &of)).transpose()).collect();
    result.set_item("covariance", covariances?)?;
    let free: Vec<_> = poses.iter().map(|p| &p.free_motions).collect();
    result.set_item("free_motions", json(&free)?)?;
    let rejected = &registration.rejected;
    result.set_item("rejected_poses", matrices(py, rejected.iter().map(|r| &r.target_from_source))?)?;
    let told: Vec<_> = rejected.iter().map(|r| (r.score, r.objection, r.round, r.measures)).collect();
    result.set_item("rejected", json(&told)?)?;
    result.set_item("labels", PyArray1::from_iter(py, labels))?;
    result.set_item("rounds", json(&registration.rounds)?)?;
    result.set_item("stop_reason", json(&registration.stop_reason)?)?;
    result.set_item("stop_message", registration.stop_reason.to_string())?;
    result.set_item("timings", json(&registration.timings)?)?;
    result.set_item("resolution", registration.resolution)?;
    Ok(result)
}
