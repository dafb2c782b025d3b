use crate::error::Error;
use crate::params::share;
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
    /// Whether target points that an accepted instance explains support no later one, so that an instance is
    /// found once.
    pub exclusive: bool,
}

impl Default for Evidence {
    fn default() -> Self {
        Self { t_score: 0.5, exclusive: true }
    }
}

impl Evidence {
    pub(super) fn check(&self) -> Result<(), Error> {
        share("hv.t_score", self.t_score)
    }
}

impl Validate for Evidence {
    fn validate(&self, context: &Context<'_>, hypothesis: &Hypothesis) -> Verdict {
        let support = context.support(&hypothesis.target_from_source, self.exclusive);
        // Compared as log odds, in which the best of many sure poses still stands out.
        let share = self.t_score.clamp(1e-15, 1.0 - 1e-15);
        let threshold = (share / (1.0 - share)).ln();
        Verdict { value: support.log_odds(), threshold }
    }
}
