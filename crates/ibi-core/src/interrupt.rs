//! Ending a run from outside: by a token, by the clock.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use crate::registration::StopReason;

/// Cancels the runs it was handed to, from any thread.
#[derive(Debug, Clone, Default)]
pub struct CancelToken(Arc<AtomicBool>);

impl CancelToken {
    /// Asks the runs to stop; they do within milliseconds and keep what they have found.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether somebody has asked.
    #[must_use]
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// What long computations ask from time to time: was the run cancelled, is it out of time?
#[derive(Debug)]
pub struct Interrupt {
    token: CancelToken,
    start: Instant,
    timeout_s: f64,
}

impl Interrupt {
    pub(crate) fn new(token: CancelToken, start: Instant, timeout_s: Option<f64>) -> Self {
        Self { token, start, timeout_s: timeout_s.unwrap_or(f64::INFINITY) }
    }

    /// Whether the run is to end; what the caller returns then is thrown away.
    #[must_use]
    pub fn is_set(&self) -> bool {
        self.token.is_cancelled() || self.elapsed_s() >= self.timeout_s
    }

    pub(crate) fn check(&self) -> ControlFlow<StopReason> {
        if self.token.is_cancelled() {
            return ControlFlow::Break(StopReason::Cancelled);
        }
        let (value, threshold) = (self.elapsed_s(), self.timeout_s);
        if value >= threshold {
            return ControlFlow::Break(StopReason::Timeout { value, threshold });
        }
        ControlFlow::Continue(())
    }

    fn elapsed_s(&self) -> f64 {
        self.start.elapsed().as_secs_f64()
    }
}
