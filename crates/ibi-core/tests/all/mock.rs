//! Stages that are closures.

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
