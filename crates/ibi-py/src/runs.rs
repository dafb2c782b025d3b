//! The runs in flight: all are told to end when the process does, and a test can watch what they do.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, RwLock};
use std::thread::ThreadId;
use std::time::{Duration, Instant};

use ibi_core::{CancelToken, Interrupt, Watcher};
use numpy::{PyArray1, PyArrayMethods};
use pyo3::exceptions::PySystemExit;
use pyo3::prelude::*;

/// So long the end of the process waits for runs, each of which ends within 0.1 s but for a callable that does not return.
const LAST_WAIT: Duration = Duration::from_secs(10);

/// How often the wait lets Python look for Ctrl-C.
const SIGNAL_PERIOD: Duration = Duration::from_millis(20);

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    // Not by `add_function`, which would list it in `__all__`.
    m.setattr("_watch", wrap_pyfunction!(watch, m)?)?;
    let end = wrap_pyfunction!(end_all, m)?;
    m.py().import("atexit")?.call_method1("register", (end,))?;
    // What the first array to be read would import is imported now: within Rust no thread may be waiting for Python, but
    // in a run, when the process ends.
    PyArray1::<f64>::zeros(m.py(), 1, false).try_readonly()?;
    Ok(())
}

// At the end of the process -------------------------------------------------------------------------------

/// Threads of Python that are no daemons are waited for by Python. A daemon may be within a run while the interpreter is
/// taken apart, and a callback that then returns, or the run itself, would be ended in the middle of Rust: the process
/// aborts. So whoever leaves a run does it before that, and none enters one after.
struct Runs {
    in_flight: Vec<InFlight>,
    /// The thread that ends the process; it alone may still run something.
    ended_by: Option<Thread>,
}

struct InFlight {
    thread: Thread,
    cancel: CancelToken,
}

/// In which process, as a fork takes the list along and leaves the threads behind.
type Thread = (u32, ThreadId);

fn this_thread() -> Thread {
    (std::process::id(), std::thread::current().id())
}

static RUNS: Mutex<Runs> = Mutex::new(Runs { in_flight: Vec::new(), ended_by: None });
static HAS_LEFT: Condvar = Condvar::new();

fn runs() -> MutexGuard<'static, Runs> {
    RUNS.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A run in flight, for as long as this lives.
pub(crate) struct Run(Thread);

impl Run {
    /// Both ends of a run are attached, so that no fork finds the list locked.
    pub(crate) fn enter(_: Python<'_>, cancel: &CancelToken) -> PyResult<Self> {
        let thread = this_thread();
        let run = Self(thread);
        run.go_on()?;
        runs().in_flight.push(InFlight { thread, cancel: cancel.clone() });
        Ok(run)
    }

    /// `SystemExit` where the process has begun to end, of which a thread dies in silence.
    pub(crate) fn go_on(&self) -> PyResult<()> {
        match runs().ended_by {
            Some(by) if by.0 == self.0.0 && by.1 != self.0.1 => {
                Err(PySystemExit::new_err("the process ends"))
            }
            _ => Ok(()),
        }
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        let mut runs = runs();
        // The last one, as a callback may have called again.
        if let Some(at) = runs.in_flight.iter().rposition(|run| run.thread == self.0) {
            runs.in_flight.remove(at);
        }
        HAS_LEFT.notify_all();
    }
}

/// Called by `atexit`: cancels all runs of other threads, and waits until they are left.
#[pyfunction(name = "_end_all")]
fn end_all(py: Python<'_>) -> PyResult<()> {
    let this = this_thread();
    let is_other = |run: &InFlight| run.thread.0 == this.0 && run.thread.1 != this.1;
    runs().ended_by = Some(this);
    let start = Instant::now();
    loop {
        let is_over = py.detach(|| {
            let runs = runs();
            runs.in_flight.iter().filter(|run| is_other(run)).for_each(|run| run.cancel.cancel());
            let has_others = |runs: &mut Runs| runs.in_flight.iter().any(is_other);
            let waited = HAS_LEFT.wait_timeout_while(runs, SIGNAL_PERIOD, has_others);
            let (_runs, waited) = waited.unwrap_or_else(PoisonError::into_inner);
            !waited.timed_out() || start.elapsed() > LAST_WAIT
        });
        if is_over {
            return Ok(());
        }
        py.check_signals()?;
    }
}

// For tests -----------------------------------------------------------------------------------------------

static WATCHER: RwLock<Option<Watcher>> = RwLock::new(None);

/// Has each run from now on call `callable` with the name of each phase that begins, in the thread that begins it; None
/// ends that. For tests, which so know when to send a signal.
#[pyfunction(name = "_watch")]
fn watch(callable: Option<Py<PyAny>>) {
    let watcher = callable.map(|callable| -> Watcher {
        Arc::new(move |phase| {
            Python::try_attach(|py| {
                if let Err(error) = callable.call1(py, (format!("{phase:?}"),)) {
                    error.write_unraisable(py, None);
                }
            });
        })
    });
    *WATCHER.write().unwrap_or_else(PoisonError::into_inner) = watcher;
}

/// What `_watch` has set.
pub(crate) fn watcher() -> Option<Watcher> {
    WATCHER.read().unwrap_or_else(PoisonError::into_inner).clone()
}

/// With that watcher, if there is one.
pub(crate) fn watched(interrupt: Interrupt) -> Interrupt {
    match watcher() {
        Some(watcher) => interrupt.with_watcher(watcher),
        None => interrupt,
    }
}
