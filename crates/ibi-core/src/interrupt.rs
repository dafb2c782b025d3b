//! Ending a computation from outside: by a token, by the clock.

use std::fmt;
use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Instant;

use crate::error::Error;
use crate::stop::StopReason;

/// Cancels the runs it was handed to, from any thread.
#[derive(Debug, Clone, Default)]
pub struct CancelToken(Arc<AtomicBool>);

impl CancelToken {
    /// Asks the runs to stop; they do within milliseconds and keep what they have found and could still check.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether somebody has asked.
    #[must_use]
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// What a computation is doing: all that can take long. Each asks its [`Interrupt`] while it works.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[allow(missing_docs)]
pub enum Phase {
    Prepare,
    Graph,
    Select,
    Enhance,
    Estimate,
    Chance,
    Polish,
    Validate,
    Contest,
    JointCheck,
    Rank,
    Spacing,
    Diameter,
    Shadow,
    Thin,
    Normals,
    Fpfh,
    Match,
    Plane,
    SampleMesh,
    OuterSurface,
    Symmetries,
    Metrics,
}

impl Phase {
    /// All of them.
    pub const ALL: [Self; 23] = [
        Self::Prepare,
        Self::Graph,
        Self::Select,
        Self::Enhance,
        Self::Estimate,
        Self::Chance,
        Self::Polish,
        Self::Validate,
        Self::Contest,
        Self::JointCheck,
        Self::Rank,
        Self::Spacing,
        Self::Diameter,
        Self::Shadow,
        Self::Thin,
        Self::Normals,
        Self::Fpfh,
        Self::Match,
        Self::Plane,
        Self::SampleMesh,
        Self::OuterSurface,
        Self::Symmetries,
        Self::Metrics,
    ];
}

/// What long computations ask from time to time: was the run cancelled, is it out of time?
#[derive(Clone)]
pub struct Interrupt {
    token: CancelToken,
    start: Instant,
    timeout_s: f64,
    watcher: Option<Watcher>,
    asks: Option<Arc<Asks>>,
}

/// How often an interrupt was asked, and how often it lets go on.
#[derive(Debug)]
struct Asks {
    made: AtomicUsize,
    most: usize,
}

/// Is told each phase as it begins, by the thread that begins it.
pub type Watcher = Arc<dyn Fn(Phase) + Send + Sync>;

impl Interrupt {
    /// Set once `token` is, or once `timeout_s` seconds have gone by since `start`.
    #[must_use]
    pub fn new(token: CancelToken, start: Instant, timeout_s: Option<f64>) -> Self {
        Self { token, start, timeout_s: timeout_s.unwrap_or(f64::INFINITY), watcher: None, asks: None }
    }

    /// With a limit of time in the place of the one that it has, if any is given.
    #[must_use]
    pub fn with_timeout(mut self, start: Instant, timeout_s: Option<f64>) -> Self {
        if let Some(timeout_s) = timeout_s {
            (self.start, self.timeout_s) = (start, timeout_s);
        }
        self
    }

    /// One that is never set.
    #[must_use]
    pub fn never() -> Self {
        Self::from(CancelToken::default())
    }

    /// With somebody who is told what the computation begins to do.
    #[must_use]
    pub fn with_watcher(mut self, watcher: Watcher) -> Self {
        self.watcher = Some(watcher);
        self
    }

    /// One that lets go on when it is asked so often, and is set from then on: for tests, which so end a computation wherever
    /// they want to.
    #[doc(hidden)]
    #[must_use]
    pub fn after_asks(most: usize) -> Self {
        Self { asks: Some(Arc::new(Asks { made: AtomicUsize::new(0), most })), ..Self::never() }
    }

    /// How often one of [`Self::after_asks`] was asked.
    #[doc(hidden)]
    #[must_use]
    pub fn num_asked(&self) -> usize {
        self.asks.as_ref().map_or(0, |asks| asks.made.load(Ordering::Relaxed))
    }

    /// Tells the watcher, if there is one, that `phase` begins.
    pub fn begin(&self, phase: Phase) {
        if let Some(watcher) = &self.watcher {
            watcher(phase);
        }
    }

    /// Begins `phase`, unless the computation is to end; returns whether it goes on.
    #[must_use]
    pub fn enter(&self, phase: Phase) -> bool {
        if self.is_set() {
            return false;
        }
        self.begin(phase);
        !self.is_set()
    }

    /// Whether the computation is to end; what it returns then is thrown away.
    #[must_use]
    pub fn is_set(&self) -> bool {
        let is_asked_enough =
            || self.asks.as_ref().is_some_and(|asks| asks.made.fetch_add(1, Ordering::Relaxed) >= asks.most);
        self.token.is_cancelled() || is_asked_enough() || self.elapsed_s() >= self.timeout_s
    }

    /// An error once the computation is to end.
    pub(crate) fn proceed(&self) -> Result<(), Error> {
        match self.check() {
            ControlFlow::Break(reason) => Err(Error::Interrupted { reason }),
            ControlFlow::Continue(()) => Ok(()),
        }
    }

    /// What is returned once the computation has been found to be set.
    pub(crate) fn error(&self) -> Error {
        // Once set it stays so.
        self.proceed().err().unwrap_or(Error::Interrupted { reason: StopReason::Cancelled })
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

/// Without a limit of time.
impl From<CancelToken> for Interrupt {
    fn from(token: CancelToken) -> Self {
        Self::new(token, Instant::now(), None)
    }
}

impl fmt::Debug for Interrupt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Interrupt").field("is_set", &self.is_set()).finish_non_exhaustive()
    }
}
