use crate::error::Error;
use crate::params::share;
use crate::scene::Detail;
use crate::stages::{Context, Hypothesis, Validate, Verdict};

/// `evidence`: accepts a pose if it is right with a probability of more than `t_score`.
///
/// Judged by how unlikely it is that so many correspondences agree by chance, in this scene, and by how much closer
/// the two clouds lie than chance would put them. The verdict is given in log odds.
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

/// A glance rejects what falls short by more than this in log odds: four standard deviations of the fit of 64 points.
const GLANCE_MARGIN: f64 = 4.0;

impl Evidence {
    fn verdict(&self, context: &Context<'_>, detail: Detail, hypothesis: &Hypothesis) -> Verdict {
        let support = context.support(detail, &hypothesis.target_from_source, self.exclusive);
        // Compared as log odds, in which the best of many sure poses still stands out.
        Verdict { value: support.log_odds(), threshold: log_odds(self.t_score) }
    }
}

impl Validate for Evidence {
    fn validate(&self, context: &Context<'_>, hypothesis: &Hypothesis) -> Verdict {
        self.verdict(context, Detail::Look, hypothesis)
    }

    fn glance(&self, context: &Context<'_>, hypothesis: &Hypothesis) -> Option<Verdict> {
        let verdict = self.verdict(context, Detail::Glance, hypothesis);
        (verdict.value < verdict.threshold - GLANCE_MARGIN).then_some(verdict)
    }

    fn is_sure(&self, verdict: &Verdict) -> bool {
        verdict.value > log_odds(self.t_sure)
    }
}

fn log_odds(probability: f64) -> f64 {
    let share = probability.clamp(1e-15, 1.0 - 1e-15);
    (share / (1.0 - share)).ln()
}
