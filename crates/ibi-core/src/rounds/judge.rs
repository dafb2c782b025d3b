//! Judging an estimated pose: it is polished on the clouds, then validated.

use super::timed::timed;
use crate::detail::Detail;
use crate::interrupt::Phase;
use crate::params::Refine;
use crate::registration::Timings;
use crate::stages::{Context, Hypothesis, Validate, Verdict};

/// Poses that move no point farther apart than this are as good as each other.
const NEGLIGIBLE_PR: f64 = 0.3;

/// What became of an estimated pose.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Judged {
    /// As it was judged, polished or not.
    pub(crate) hypothesis: Hypothesis,
    pub(crate) verdict: Verdict,
}

/// Holds an estimated pose against both clouds.
pub(super) trait Judge {
    /// `None` once the run is to end.
    fn judge(&self, context: &Context<'_>, raw: &Hypothesis, timings: &mut Timings) -> Option<Judged>;
}

/// Polishes a hypothesis to the end and validates it.
#[derive(Clone, Copy)]
pub(super) struct Close<'a> {
    pub(super) hv: &'a dyn Validate,
    pub(super) refine: Refine,
}

impl Judge for Close<'_> {
    fn judge(&self, context: &Context<'_>, raw: &Hypothesis, timings: &mut Timings) -> Option<Judged> {
        self.judge_from(context, raw, raw, timings)
    }
}

impl Close<'_> {
    /// The same, where the polish begins at `start`.
    pub(super) fn judge_from(
        &self,
        context: &Context<'_>,
        raw: &Hypothesis,
        start: &Hypothesis,
        timings: &mut Timings,
    ) -> Option<Judged> {
        let Timings { refine_s, hv_s, .. } = timings;
        if !self.enter_polish(context) {
            return None;
        }
        let polished = timed(refine_s, || self.polished(context, Detail::Look, start));
        let hypothesis = polished.and_then(Polished::if_supported).unwrap_or(*raw);
        if !context.interrupt.enter(Phase::Validate) {
            return None;
        }
        let verdict = timed(hv_s, || self.hv.validate(context, &hypothesis));
        // The clouds of a cluttered scene may draw a good pose away.
        let scene = context.scene;
        let shift = scene.source.displacement(&raw.target_from_source, &hypothesis.target_from_source);
        if verdict.accepted() && shift > NEGLIGIBLE_PR * scene.resolution {
            let before = timed(hv_s, || self.hv.validate(context, raw));
            if before.value > verdict.value {
                return Some(Judged { hypothesis: *raw, verdict: before });
            }
        }
        Some(Judged { hypothesis, verdict })
    }

    /// Begins to polish, where that is wanted; false once the run is to end.
    pub(super) fn enter_polish(&self, context: &Context<'_>) -> bool {
        self.refine == Refine::None || context.interrupt.enter(Phase::Polish)
    }

    /// The hypothesis polished on the clouds; `None` if the parameters do not want it.
    pub(super) fn polished(
        &self,
        context: &Context<'_>,
        detail: Detail,
        hypothesis: &Hypothesis,
    ) -> Option<Polished> {
        let target_from_source = match self.refine {
            Refine::None => return None,
            Refine::Icp | Refine::IcpTurns => context.scene.icp(detail, &hypothesis.target_from_source),
        };
        let t_he_pr = context.scene.tolerances.t_he_pr;
        let support = context.witnesses().inliers(&target_from_source, t_he_pr).len();
        let is_supported = support >= context.t_s as usize;
        Some(Polished { hypothesis: Hypothesis { target_from_source, ..*hypothesis }, is_supported })
    }
}

/// A hypothesis polished on the clouds, and whether at least `t_s` alive correspondences still agree with it: the clouds
/// alone fit flat faces almost anywhere.
#[derive(Debug, Clone, Copy)]
pub(super) struct Polished {
    pub(super) hypothesis: Hypothesis,
    is_supported: bool,
}

impl Polished {
    pub(super) fn if_supported(self) -> Option<Hypothesis> {
        self.is_supported.then_some(self.hypothesis)
    }
}
