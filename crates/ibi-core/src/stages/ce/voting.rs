use crate::error::Error;
use crate::kernels::by_target::ball;
use crate::kernels::compatibility::{vote_reach, votes_until};
use crate::ranges::at_least_3;
use crate::stages::{Context, Enhance, Ranked};

/// `voting`: every seed votes for every alive correspondence by their consistency; the `n_vot` with the most
/// votes are `C_d` (Eq. 5-6; Yang et al. 2019). Seeds are candidates too; who has no vote is none.
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
        let delta_r = context.delta_r_pr;
        let by_target = &context.pairs.by_target;
        let voters = context.pairs.columns.gather(seeds.ids());
        // Whose target point lies farther from that of a seed than their source points can be apart has no vote from it.
        let reach = by_target.source_diameter() + vote_reach(delta_r);
        let (centre, spread) = ball(&voters.q);
        let runs = by_target.around(centre, spread + reach).flatten();
        let (ids, places): (Vec<u32>, Vec<u32>) = runs
            .map(|at| (by_target.id(at), at as u32))
            .filter(|&(id, _)| context.alive.contains(id))
            .unzip();
        let votes =
            votes_until(&by_target.sorted().gather(&places), &voters, delta_r, || context.interrupt.is_set());
        if context.interrupt.is_set() {
            return Ranked::default();
        }
        // PAPER: the N_vot best, whatever they have. Those without a vote are taken at random, and removal `dense` would
        // take them out for nothing.
        let voted = ids.into_iter().zip(votes).filter(|&(_, votes)| votes > 0.0);
        Ranked::best_of(voted.collect(), self.n_vot as usize)
    }
}
