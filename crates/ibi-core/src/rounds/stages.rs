//! The stages as a round asks them: each told to the watcher, timed, and not begun once the run is to end.

use super::glance::Glance;
use super::judge::{Close, Judge, Judged};
use super::memory::{Remembering, Tried};
use super::shortcuts::Shortcuts;
use super::timed::timed;
use crate::interrupt::Phase;
use crate::params::Params;
use crate::registration::Timings;
use crate::stages::{Context, Enhance, Estimate, EstimatePose, Ranked, SelectSeeds, Validate};

/// The stages of a run, of the parameters or of the user's own.
#[derive(Clone, Copy)]
pub(crate) struct Stages<'r> {
    pub(crate) scs: &'r dyn SelectSeeds,
    pub(crate) ce: &'r dyn Enhance,
    pub(crate) te: &'r dyn EstimatePose,
    pub(crate) hv: &'r dyn Validate,
    /// Whether the seed selection, and whether any stage, is one of the user's own.
    pub(crate) has_own_scs: bool,
    pub(crate) has_own: bool,
    pub(crate) params: &'r Params,
    pub(crate) shortcuts: Shortcuts,
}

impl Stages<'_> {
    /// SCS, and how long it took.
    pub(crate) fn select_seeds(&self, context: &Context<'_>) -> (Ranked, Timings) {
        let mut timings = Timings::default();
        if !context.interrupt.enter(Phase::Select) {
            return (Ranked::default(), timings);
        }
        let seeds = timed(&mut timings.scs_s, || self.scs.select_seeds(context));
        (seeds, timings)
    }
}

/// The stages within one round. An answer of `None`: the run is to end.
pub(crate) struct Asked<'a> {
    pub(super) stages: &'a Stages<'a>,
    pub(super) tried: &'a Tried,
    /// Whether the round before came to nothing.
    pub(super) is_lean: bool,
    pub(super) timings: Timings,
}

impl Asked<'_> {
    pub(crate) fn enhance(&mut self, context: &Context<'_>, seeds: &Ranked) -> Option<Ranked> {
        let ce = self.stages.ce;
        let goes_on = context.interrupt.enter(Phase::Enhance);
        goes_on.then(|| timed(&mut self.timings.ce_s, || ce.enhance(context, seeds)))
    }

    pub(crate) fn estimate_pose(&mut self, context: &Context<'_>, dense: &Ranked) -> Option<Estimate> {
        let te = self.stages.te;
        let goes_on = context.interrupt.enter(Phase::Estimate);
        goes_on.then(|| timed(&mut self.timings.te_s, || te.estimate_pose(context, dense)))
    }

    /// What becomes of the estimated pose, if there is one.
    pub(crate) fn validate(&mut self, context: &Context<'_>, estimate: &Estimate) -> Option<Judged> {
        let Stages { hv, params, shortcuts, .. } = *self.stages;
        let tried = Some(self.tried).filter(|_| shortcuts.memory && hv.is_repeatable());
        let close = Close { hv, refine: params.refine };
        let glance = Glance { close, tried, is_lean: self.is_lean };
        let judge: &dyn Judge = if shortcuts.glance { &glance } else { &close };
        Remembering { tried, judge }.judge(context, &estimate.hypothesis?, &mut self.timings)
    }
}
