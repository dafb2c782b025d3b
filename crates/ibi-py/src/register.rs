//! `register`: arrays in, arrays out, the GIL released in between.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

use ibi_core::kernels::par::Pool;
use ibi_core::nalgebra::{Matrix3, Point3, Vector3};
use ibi_core::{
    CancelToken, Cloud, Correspondences, Interrupt, PreparedCloud, Registrar, Registration, Round,
};
use numpy::ndarray::ArrayView2;
use numpy::{PyArray1, PyArray3, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3};
use pyo3::exceptions::{PySystemExit, PyTimeoutError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::runs::{self, Run};
use crate::stages::Own;
use crate::symmetries::Symmetries;
use crate::{InputError, params, to_py_err};

/// How often a run in the background lets Python look for Ctrl-C.
const SIGNAL_PERIOD: Duration = Duration::from_millis(20);

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<Source>()?;
    m.add_function(wrap_pyfunction!(register_clouds, m)?)
}

/// A source that was checked and prepared, for any number of registrations.
#[pyclass(frozen, module = "ibi_rs._core")]
struct Source(Arc<PreparedCloud<'static>>);

#[pymethods]
impl Source {
    #[new]
    #[pyo3(signature = (points, normals=None, frames=None, symmetries=None))]
    #[allow(clippy::needless_pass_by_value)] // PyO3 owns
    fn new(
        py: Python<'_>,
        points: PyReadonlyArray2<'_, f64>,
        normals: Option<PyReadonlyArray2<'_, f64>>,
        frames: Option<PyReadonlyArray3<'_, f64>>,
        symmetries: Option<&Symmetries>,
    ) -> PyResult<Self> {
        let cloud = with_normals(Cloud::from(rows3(&points, Point3::new)?), normals.as_ref())?;
        let mut cloud = with_frames(cloud, frames.as_ref())?;
        if let Some(symmetries) = symmetries {
            cloud = cloud.with_symmetries(symmetries.0.clone());
        }
        let prepared = in_background(py, |cancel, _| {
            PreparedCloud::source_until(&cloud, &runs::watched(cancel)).map_err(|e| to_py_err(&e))
        })?;
        Ok(Self(Arc::new(prepared)))
    }

    #[getter]
    fn spacing(&self) -> f64 {
        self.0.spacing
    }

    /// With `timeout_s`, counted from the call, a `TimeoutError` says that time has run out.
    #[pyo3(signature = (num_threads, timeout_s=None))]
    fn diameter(&self, py: Python<'_>, num_threads: Option<usize>, timeout_s: Option<f64>) -> PyResult<f64> {
        let start = Instant::now();
        in_pool(py, num_threads, |interrupt| {
            let diameter = self.0.diameter(&interrupt.clone().with_timeout(start, timeout_s));
            diameter.ok_or_else(|| PyTimeoutError::new_err("interrupted"))
        })
    }
}

/// See `ibi_rs.register`, which brings its arguments into the shapes and dtypes that are wanted here.
#[pyfunction(name = "register")]
#[pyo3(signature = (source, tgt, corr, params, *, tgt_normals=None, tgt_frames=None, similarity=None, viewpoint=None, measured=None, num_threads=None, on_round=None, scs=None, ce=None, te=None, hv=None))]
#[allow(clippy::too_many_arguments, clippy::needless_pass_by_value)] // Python's keyword arguments; PyO3 owns
fn register_clouds<'py>(
    py: Python<'py>,
    source: &Source,
    tgt: PyReadonlyArray2<'py, f64>,
    corr: &Bound<'py, PyAny>,
    params: &str,
    tgt_normals: Option<PyReadonlyArray2<'py, f64>>,
    tgt_frames: Option<PyReadonlyArray3<'py, f64>>,
    similarity: Option<PyReadonlyArray1<'py, f64>>,
    viewpoint: Option<[f64; 3]>,
    measured: Option<PyReadonlyArray2<'py, f64>>,
    num_threads: Option<usize>,
    on_round: Option<Py<PyAny>>,
    scs: Option<Py<PyAny>>,
    ce: Option<Py<PyAny>>,
    te: Option<Py<PyAny>>,
    hv: Option<Py<PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let params = params::parse(params)?;
    let source = Arc::clone(&source.0);
    // Copied, as other threads may write to the array; borrowed from here on, as scenes can be large.
    let tgt = rows3(&tgt, Point3::new)?;
    let target = with_normals(Cloud::new(&tgt), tgt_normals.as_ref())?;
    let mut target = with_frames(target, tgt_frames.as_ref())?;
    if let Some(viewpoint) = viewpoint {
        target = target.with_viewpoint(Point3::from(viewpoint));
    }
    if let Some(measured) = measured {
        target = target.with_measured(rows3(&measured, Point3::new)?);
    }
    let mut correspondences = correspondences(corr)?;
    if let Some(similarity) = similarity {
        correspondences = correspondences.with_similarity(similarity.as_array().to_vec());
    }
    let registration = in_background(py, |cancel, caller| {
        let mut failure = None;
        let has_failed = cancel.clone();
        let mut observer = |round: &Round| {
            if has_failed.is_cancelled() {
                return ControlFlow::Break(()); // a round that a stage has failed in is none to tell of
            }
            tell(on_round.as_ref(), round).unwrap_or_else(|error| {
                failure = Some(error);
                ControlFlow::Break(())
            })
        };
        let run = || {
            let mut registrar = Registrar::of(source).params(params).cancel_token(cancel);
            if let Some(watcher) = runs::watcher() {
                registrar = registrar.watcher(watcher);
            }
            if let Some(num_threads) = num_threads {
                registrar = registrar.num_threads(num_threads);
            }
            let own = |callable| Own::new(callable, caller.clone());
            if let Some(scs) = scs {
                registrar = registrar.with_scs(own(scs));
            }
            if let Some(ce) = ce {
                registrar = registrar.with_ce(own(ce));
            }
            if let Some(te) = te {
                registrar = registrar.with_te(own(te));
            }
            if let Some(hv) = hv {
                registrar = registrar.with_hv(own(hv));
            }
            registrar.register_observed(&target, &correspondences, &mut observer)
        };
        let result = run().map_err(|e| to_py_err(&e));
        failure.map_or(result, Err)
    })?;
    to_dict(py, &registration)
}

/// Lets a job in the background call Python in the thread that it was started from.
///
/// There alone signals are seen, so that Ctrl-C reaches what is called, and there the user's thread-local state holds:
/// `numpy.errstate`, `torch.no_grad`. A thread of the pool would have to wait for the GIL as well.
#[derive(Clone)]
pub(crate) struct Caller {
    calls: Sender<Call>,
    cancel: CancelToken,
}

type Call = Box<dyn FnOnce(Python<'_>) -> PyResult<()> + Send>;

impl Caller {
    /// What `job` answers; `None` if it fails, or if another has failed or a signal has come before: the run is then
    /// cancelled, and `in_background` raises the error.
    pub(crate) fn call<T: Send + 'static>(
        &self,
        job: impl FnOnce(Python<'_>) -> PyResult<T> + Send + 'static,
    ) -> Option<T> {
        if self.cancel.is_cancelled() {
            return None;
        }
        let (answer, answered) = channel();
        let call: Call = Box::new(move |py| {
            let _ = answer.send(job(py)?); // somebody waits for it
            Ok(())
        });
        let answer = self.calls.send(call).ok().and_then(|()| answered.recv().ok());
        if answer.is_none() {
            self.cancel.cancel(); // here too, so that this thread sees it from now on
        }
        answer
    }
}

/// Runs `job` in the background, on so many threads of its own; by default as many as the process may use.
pub(crate) fn in_pool<T: Send>(
    py: Python<'_>,
    num_threads: Option<usize>,
    job: impl FnOnce(&Interrupt) -> PyResult<T> + Send,
) -> PyResult<T> {
    in_background(py, |cancel, _| {
        let pool = Pool::new(num_threads).map_err(|error| to_py_err(&error))?;
        pool.install(|| job(&runs::watched(cancel)))
    })
}

/// Runs `job` on a thread of its own with the GIL released, while this one, which alone may see signals, looks
/// for Ctrl-C and makes the calls that the job asks for. A signal, or an error of a call, cancels the job and is
/// raised once the job has ended.
pub(crate) fn in_background<T: Send>(
    py: Python<'_>,
    job: impl FnOnce(CancelToken, Caller) -> PyResult<T> + Send,
) -> PyResult<T> {
    let cancel = CancelToken::default();
    let run = Run::enter(py, &cancel)?;
    let token = cancel.clone();
    let result = py.detach(|| {
        std::thread::scope(|scope| {
            // The job's end is seen by this: with it goes the last sender.
            let (calls, asked) = channel::<Call>();
            let caller = Caller { calls, cancel: token.clone() };
            let worker = scope.spawn(move || job(token, caller));
            let mut outcome = Ok(());
            loop {
                let happened = asked.recv_timeout(SIGNAL_PERIOD);
                if let Err(RecvTimeoutError::Disconnected) = happened {
                    break;
                }
                if outcome.is_ok() {
                    let attached = Python::try_attach(|py| match happened {
                        Ok(call) => call(py),
                        Err(_) => py.check_signals(),
                    });
                    outcome = attached.unwrap_or_else(|| Err(PySystemExit::new_err("the process ends")));
                    if outcome.is_err() {
                        cancel.cancel();
                    }
                }
            }
            let result = worker.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
            outcome.and(result)
        })
    });
    run.go_on()?; // what was cut off is no result
    result
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

fn with_normals<'a>(cloud: Cloud<'a>, normals: Option<&PyReadonlyArray2<'_, f64>>) -> PyResult<Cloud<'a>> {
    Ok(match normals {
        Some(normals) => cloud.with_normals(rows3(normals, Vector3::new)?),
        None => cloud,
    })
}

/// (N, 3, 3), the axes of each frame as rows.
fn with_frames<'a>(cloud: Cloud<'a>, frames: Option<&PyReadonlyArray3<'_, f64>>) -> PyResult<Cloud<'a>> {
    let Some(frames) = frames else { return Ok(cloud) };
    let frames = frames.as_array();
    if frames.shape()[1..] != [3, 3] {
        return Err(InputError::new_err("frames must be of shape (N, 3, 3)"));
    }
    let frame = |rows: ArrayView2<'_, f64>| Matrix3::from_fn(|i, j| rows[[i, j]]);
    Ok(cloud.with_frames(frames.outer_iter().map(frame).collect()))
}

pub(crate) fn rows3<T>(
    array: &PyReadonlyArray2<'_, f64>,
    row: impl Fn(f64, f64, f64) -> T,
) -> PyResult<Vec<T>> {
    Ok(rows(array)?.iter().map(|&[x, y, z]| row(x, y, z)).collect())
}

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

/// (M, 2) int64 rows or (M, 6) float64 points.
fn correspondences(corr: &Bound<'_, PyAny>) -> PyResult<Correspondences> {
    if let Ok(ids) = corr.extract::<PyReadonlyArray2<'_, i64>>() {
        // A negative index wraps to one that is out of range; the core refuses it and reports it as it was.
        let wrap = |index: i64| usize::try_from(index).unwrap_or(index as usize);
        return Ok(Correspondences::from_rows(rows(&ids)?.iter().map(|row| row.map(wrap)).collect()));
    }
    let pairs: PyReadonlyArray2<'_, f64> = corr.extract()?;
    let pair = |&[px, py, pz, qx, qy, qz]: &[f64; 6]| [Point3::new(px, py, pz), Point3::new(qx, qy, qz)];
    Ok(Correspondences::from_points(rows(&pairs)?.iter().map(pair).collect()))
}

/// Arrays as arrays, the rest as JSON under "report".
fn to_dict<'py>(py: Python<'py>, registration: &Registration) -> PyResult<Bound<'py, PyDict>> {
    let poses = &registration.poses;
    // nalgebra stores columns, numpy rows.
    let rows = poses.iter().flat_map(|p| {
        let matrix = p.target_from_source.to_homogeneous().transpose();
        matrix.iter().copied().collect::<Vec<f64>>()
    });
    let matrices: Bound<'py, PyArray3<f64>> = PyArray1::from_iter(py, rows).reshape([poses.len(), 4, 4])?;
    let column = |f: fn(&ibi_core::Pose) -> f64| poses.iter().map(f).collect::<Vec<f64>>();
    let inliers: Vec<_> =
        poses.iter().map(|p| PyArray1::from_iter(py, p.inliers.iter().map(|&id| i64::from(id)))).collect();
    let labels = registration.labels.iter().map(|label| label.map_or(-1, u32::cast_signed));
    let result = PyDict::new(py);
    result.set_item("target_from_source", matrices)?;
    result.set_item("score", column(|p| p.score))?;
    result.set_item("overlap", column(|p| p.overlap))?;
    result.set_item("closeness", column(|p| p.closeness))?;
    result.set_item("back_fit", column(|p| p.back_fit))?;
    result.set_item("evidence", column(|p| p.evidence))?;
    result.set_item("inlier_rmse", column(|p| p.inlier_rmse))?;
    result.set_item("inliers", inliers)?;
    result.set_item("round", poses.iter().map(|p| p.round).collect::<Vec<u32>>())?;
    result.set_item("labels", PyArray1::from_iter(py, labels))?;
    result.set_item("rounds", json(&registration.rounds)?)?;
    result.set_item("stop_reason", json(&registration.stop_reason)?)?;
    result.set_item("stop_message", registration.stop_reason.to_string())?;
    result.set_item("timings", json(&registration.timings)?)?;
    result.set_item("resolution", registration.resolution)?;
    Ok(result)
}

fn json(value: &impl serde::Serialize) -> PyResult<String> {
    serde_json::to_string(value).map_err(|e| PyValueError::new_err(e.to_string()))
}
