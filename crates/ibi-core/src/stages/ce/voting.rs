use crate::error::Error;
use crate::kernels::compatibility::votes;
use crate::params::at_least_3;
use crate::stages::{Context, Enhance, Ranked};

/// `voting`: every seed votes for every alive correspondence by their consistency; the `n_vot` with the most
/// votes are `C_d` (Eq. 5-6; Yang et al. 2019). Seeds are candidates too.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(default, deny_unknown_fields)
)]
pub struct Voting {
    /// `N_vot`: size of `C_d`. At least 3.
    pub n_vot: u32,
}

impl Default for Voting {
    fn default() -> Self {
        Self { n_vot: 300 }
    }
}

impl Voting {
    pub(super) fn check(&self) -> Result<(), Error> {
        at_least_3("ce.n_vot", self.n_vot)
    }
}

impl Enhance for Voting {
    fn enhance(&self, context: &Context<'_>, seeds: &Ranked) -> Ranked {
        let voters = context.pairs.columns.gather(seeds.ids());
        let votes = votes(context.alive.columns(), &voters, context.params.delta_r_pr);
        Ranked::best_of(context.alive.ids().iter().copied().zip(votes).collect(), self.n_vot as usize)
    }
}
