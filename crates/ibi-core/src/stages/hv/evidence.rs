use crate::detail::Detail;
use crate::error::Error;
use crate::evidence::Support;
use crate::ranges::share;
use crate::stages::{Context, Hypothesis, Validate, Verdict};

/// `evidence`: accepts a pose if it is right with a probability of more than `t_score`.
///
/// Judged by how unlikely it is that so many correspondences agree by chance, in this scene, and by how much closer
/// the two clouds lie than chance would put them. The verdict is given in log odds. In a scene seen from one side only
/// what the camera can see counts, and the margin is in proportion to how much of the source a pose explains.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(default, deny_unknown_fields)
)]
pub struct Evidence {
    /// The probability to exceed. 0 to 1.
    pub t_score: f64,
    /// A pose that is right with a probability of more than this becomes an instance at once; the others wait for the
    /// end of the contest. 0 to 1; 1: all wait.
    pub t_sure: f64,
    /// Whether target points that an accepted instance explains support no later one, so that an instance is
    /// found once.
    pub exclusive: bool,
}

impl Default for Evidence {
    fn default() -> Self {
        Self { t_score: 0.5, t_sure: 0.99, exclusive: true }
    }
}

impl Evidence {
    pub(super) fn check(&self) -> Result<(), Error> {
        share("hv.t_score", self.t_score)?;
        share("hv.t_sure", self.t_sure)
    }
}

/// A glance rejects what falls short by more than this in log odds: four standard deviations of the fit of 64 points,
/// and of about 100 that can be seen.
const GLANCE_MARGIN: f64 = 4.0;
const GLANCE_MARGIN_ONE_SIDED: f64 = 2.0;

/// A camera shows a quarter of a part, give or take.
const USUALLY_EXPLAINED: f64 = 0.25;

impl Evidence {
    fn support(&self, context: &Context<'_>, detail: Detail, hypothesis: &Hypothesis) -> Support {
        context.support(detail, &hypothesis.target_from_source, self.exclusive)
    }

    /// Compared as log odds, in which the best of many sure poses still stands out.
    fn verdict(&self, support: &Support) -> Verdict {
        Verdict { value: support.log_odds(), threshold: log_odds(self.t_score) }
    }

    /// One flat face fits in many places. Of two poses the one that explains more of the scene comes first.
    fn ranked(&self, support: &Support) -> Verdict {
        let verdict = self.verdict(support);
        if !support.one_sided {
            return verdict;
        }
        in_proportion(verdict, support.explained)
    }
}

/// The margin of a verdict in proportion to how much of the source is explained.
fn in_proportion(Verdict { value, threshold }: Verdict, explained: f64) -> Verdict {
    Verdict { value: threshold + (value - threshold) * explained / USUALLY_EXPLAINED, threshold }
}

impl Validate for Evidence {
    fn validate(&self, context: &Context<'_>, hypothesis: &Hypothesis) -> Verdict {
        self.ranked(&self.support(context, Detail::Look, hypothesis))
    }

    fn verdict_of(&self, support: &Support) -> Option<Verdict> {
        self.exclusive.then(|| self.ranked(support))
    }

    fn glance(&self, context: &Context<'_>, hypothesis: &Hypothesis) -> Option<Verdict> {
        let support = self.support(context, Detail::Glance, hypothesis);
        let verdict = self.verdict(&support);
        let margin = if support.one_sided { GLANCE_MARGIN_ONE_SIDED } else { GLANCE_MARGIN };
        (verdict.value < verdict.threshold - margin).then_some(verdict)
    }

    fn verdict_of_closeup(&self, log_odds: f64, explained: f64) -> Option<Verdict> {
        Some(in_proportion(Verdict { value: log_odds, threshold: self::log_odds(self.t_score) }, explained))
    }

    fn is_sure(&self, verdict: &Verdict) -> bool {
        verdict.value > log_odds(self.t_sure)
    }
}

fn log_odds(probability: f64) -> f64 {
    let share = probability.clamp(1e-15, 1.0 - 1e-15);
    (share / (1.0 - share)).ln()
}
