//! Stages that are closures, and a time limit that strikes where it is to.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use ibi_core::stages::{
    Context, Enhance, Estimate, EstimatePose, Hypothesis, Ranked, SelectSeeds, Validate, Verdict,
};

/// A stage that is a closure.
pub(crate) struct Mock<F>(pub(crate) F);

impl<F: Fn(&Context<'_>) -> Ranked + Send + Sync> SelectSeeds for Mock<F> {
    fn select_seeds(&self, context: &Context<'_>) -> Ranked {
        (self.0)(context)
    }
}

impl<F: Fn(&Context<'_>, &Ranked) -> Ranked + Send + Sync> Enhance for Mock<F> {
    fn enhance(&self, context: &Context<'_>, seeds: &Ranked) -> Ranked {
        (self.0)(context, seeds)
    }
}

impl<F: Fn(&Context<'_>, &Ranked) -> Estimate + Send + Sync> EstimatePose for Mock<F> {
    fn estimate_pose(&self, context: &Context<'_>, dense: &Ranked) -> Estimate {
        (self.0)(context, dense)
    }
}

impl<F: Fn(&Context<'_>, &Hypothesis) -> Verdict + Send + Sync> Validate for Mock<F> {
    fn validate(&self, context: &Context<'_>, hypothesis: &Hypothesis) -> Verdict {
        (self.0)(context, hypothesis)
    }
}

/// What `run` gives with a time limit that is long enough for it to reach `round`, on whatever machine; it is called with
/// the limit, and with what is to be told of the rounds it has reached.
pub(crate) fn long_enough<T>(round: u32, run: impl Fn(f64, Box<dyn Fn(u32) + Send + Sync>) -> T) -> T {
    for doublings in 0..14 {
        let is_reached = Arc::new(AtomicBool::new(false));
        let inside = Arc::clone(&is_reached);
        let reached = move |at| {
            if at == round {
                inside.store(true, Ordering::SeqCst);
            }
        };
        let result = run(0.01 * f64::from(1 << doublings), Box::new(reached));
        if is_reached.load(Ordering::SeqCst) {
            return result;
        }
    }
    panic!("round {round} is not reached within a minute");
}
