//! Work in the background: the GIL released, Ctrl-C heard, Python called in the thread that asked for the work.

use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::Duration;

use ibi_core::Pool;
use ibi_core::{CancelToken, Interrupt};
use pyo3::exceptions::PySystemExit;
use pyo3::prelude::*;

use crate::error::{OrPyErr, ToPyErr};
use crate::runs::{self, Run};

/// How often a run in the background lets Python look for Ctrl-C.
const SIGNAL_PERIOD: Duration = Duration::from_millis(20);

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
pub(crate) fn in_pool<T: Send, E: ToPyErr>(
    py: Python<'_>,
    num_threads: Option<usize>,
    job: impl FnOnce(&Interrupt) -> Result<T, E> + Send,
) -> PyResult<T> {
    in_background(py, |cancel, _| {
        let pool = Pool::new(num_threads).or_py_err()?;
        pool.install(|| job(&runs::watched(cancel)).or_py_err())
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
