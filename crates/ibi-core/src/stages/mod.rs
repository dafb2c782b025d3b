//! The four stages: what each is asked, what it answers, and what passes between them.
//!
//! Each stage is an open trait, for a type of your own, and a closed enum of the variants that parameter files
//! can name. The enum implements the trait by asking the variant it holds.

pub mod ce;
mod context;
pub mod hv;
mod passes;
pub mod scs;
pub mod te;
mod variants;

pub use self::context::Context;
pub use self::passes::{Estimate, Hypothesis, Ranked, Verdict};
pub(crate) use self::variants::variants;
use crate::error::Argument;
pub use crate::evidence::{Claims, NearClaims, Support};
pub use crate::kernels::graph::Graph;
pub use crate::kernels::rng::{Rng, Stage};

/// SCS: picks from the alive correspondences a few that are highly consistent with each other.
pub trait SelectSeeds: Send + Sync {
    /// The seeds `C_s`; empty when there are none.
    fn select_seeds(&self, context: &Context<'_>) -> Ranked;

    /// An optional argument of the registration without which this selection cannot do; a run that lacks it is refused
    /// at its begin. By default there is none.
    fn needs(&self) -> Option<Argument> {
        None
    }
}

/// CE: gathers the alive correspondences that agree with the seeds.
pub trait Enhance: Send + Sync {
    /// The dense correspondences `C_d`, best first.
    fn enhance(&self, context: &Context<'_>, seeds: &Ranked) -> Ranked;
}

/// TE: estimates one pose from the dense correspondences.
pub trait EstimatePose: Send + Sync {
    /// The best hypothesis found, and how many were tried.
    fn estimate_pose(&self, context: &Context<'_>, dense: &Ranked) -> Estimate;
}

/// HV: holds the pose against the two clouds.
pub trait Validate: Send + Sync {
    /// Accepted or rejected, with the measured value. Asked again at the end of a contest, also after the run was
    /// interrupted: unlike the other stages it must then still answer truly.
    fn validate(&self, context: &Context<'_>, hypothesis: &Hypothesis) -> Verdict;

    /// A verdict at a first glance, on a hypothesis that was polished only roughly: a rejection, if no closer look could
    /// change it. By default there is none.
    fn glance(&self, context: &Context<'_>, hypothesis: &Hypothesis) -> Option<Verdict> {
        let _ = (context, hypothesis);
        None
    }

    /// The verdict that [`Self::validate`] would come to where [`Context::support`] of a close look, with claimed scene points
    /// left out, is `support`. `None`, which is the default, if more must be known.
    fn verdict_of(&self, support: &Support) -> Option<Verdict> {
        let _ = support;
        None
    }

    /// The verdict on a pose that was looked at close up, on all that one camera measured: `log_odds` speaks for it, and it
    /// explains the share `explained` of the source. `None`, which is the default, leaves it at what [`Self::validate`] said.
    fn verdict_of_closeup(&self, log_odds: f64, explained: f64) -> Option<Verdict> {
        let _ = (log_odds, explained);
        None
    }

    /// Whether the verdict depends on nothing but the pose, what is alive and what is claimed. Then a hypothesis that ends
    /// up where another one was judged is not judged again. By default it may depend on more.
    fn is_repeatable(&self) -> bool {
        false
    }

    /// Whether an accepted hypothesis is good enough to become an instance at once, without waiting for the end of the
    /// contest. By default none is.
    fn is_sure(&self, verdict: &Verdict) -> bool {
        let _ = verdict;
        false
    }
}
