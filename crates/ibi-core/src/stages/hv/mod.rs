//! HV, hypothesis validation: pose, source, target -> accepted or rejected.

mod evidence;
mod inlier_count;
mod none;
mod overlap;

pub use evidence::Evidence;
pub use inlier_count::InlierCount;
pub use none::None;
pub use overlap::Overlap;

use super::{Context, Hypothesis, Validate, Verdict, variants};
use crate::evidence::Support;

variants! {
    /// The ways to validate a hypothesis.
    Hv {
        /// Share of source points that lie on the target.
        Overlap = "overlap",
        /// What speaks for the pose, against what chance would bring.
        Evidence = "evidence",
        /// Number of alive correspondences that agree.
        InlierCount = "inlier_count",
        /// Everything is accepted.
        None = "none",
    }
}

impl Validate for Hv {
    fn validate(&self, context: &Context<'_>, hypothesis: &Hypothesis) -> Verdict {
        match self {
            Self::Overlap(overlap) => overlap.validate(context, hypothesis),
            Self::Evidence(evidence) => evidence.validate(context, hypothesis),
            Self::InlierCount(count) => count.validate(context, hypothesis),
            Self::None(none) => none.validate(context, hypothesis),
        }
    }

    fn is_repeatable(&self) -> bool {
        true
    }

    fn glance(&self, context: &Context<'_>, hypothesis: &Hypothesis) -> Option<Verdict> {
        match self {
            Self::Evidence(evidence) => evidence.glance(context, hypothesis),
            _ => Option::None,
        }
    }

    fn verdict_of(&self, support: &Support) -> Option<Verdict> {
        match self {
            Self::Evidence(evidence) => evidence.verdict_of(support),
            _ => Option::None,
        }
    }

    fn verdict_of_closeup(&self, log_odds: f64, explained: f64) -> Option<Verdict> {
        match self {
            Self::Evidence(evidence) => evidence.verdict_of_closeup(log_odds, explained),
            _ => Option::None,
        }
    }

    fn is_sure(&self, verdict: &Verdict) -> bool {
        match self {
            Self::Evidence(evidence) => evidence.is_sure(verdict),
            _ => false,
        }
    }
}
