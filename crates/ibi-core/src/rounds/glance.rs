//! A glance before a close look: most poses are hopeless, and few points show it.

use super::judge::{Close, Judge, Judged, Polished};
use super::memory::Tried;
use super::timed::timed;
use crate::detail::Detail;
use crate::registration::Timings;
use crate::stages::{Context, Hypothesis};

/// A pose with an MAE of so much is looked at closely at once.
const MANY_INLIERS: f64 = 10.0;

/// Judges at a glance what is hopeless, or known once it is polished roughly, and closely what is not.
///
/// The rough polish is of hypotheses that have few inliers, or of all where the scene is seen from one side; a close look goes
/// on from there.
pub(super) struct Glance<'a> {
    pub(super) close: Close<'a>,
    pub(super) tried: Option<&'a Tried>,
    /// Whether the round before came to nothing: a hopeless pose is not expected after a success.
    pub(super) is_lean: bool,
}

impl Judge for Glance<'_> {
    fn judge(&self, context: &Context<'_>, raw: &Hypothesis, timings: &mut Timings) -> Option<Judged> {
        let is_one_sided = context.scene.is_one_sided();
        let is_poor = raw.score < MANY_INLIERS || is_one_sided;
        if !self.close.enter_polish(context) {
            return None;
        }
        let rough = || self.close.polished(context, Detail::Glance, raw);
        let polished = if is_poor { timed(&mut timings.refine_s, rough) } else { None };
        let supported = polished.and_then(Polished::if_supported);
        let glanced = supported.unwrap_or(*raw);
        // In a scan clouds fit almost anywhere: what has lost its correspondences there might as well be elsewhere.
        if supported.is_some() || !is_one_sided {
            let same = self.tried.and_then(|tried| tried.near(context.scene, &glanced.target_from_source));
            if same.is_some() {
                return same;
            }
        }
        let fitted = polished.filter(|_| !is_one_sided).map_or(glanced, |polished| polished.hypothesis);
        if self.is_lean
            && let Some(verdict) = timed(&mut timings.hv_s, || self.close.hv.glance(context, &fitted))
        {
            return Some(Judged { hypothesis: glanced, verdict });
        }
        self.close.judge_from(context, raw, &glanced, timings)
    }
}
