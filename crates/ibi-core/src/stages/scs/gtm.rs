use crate::error::Error;
use crate::kernels::compatibility::{Payoff, payoff_matrix};
use crate::kernels::otsu::otsu;
use crate::kernels::replicator::replicator;
use crate::ranges::{at_least_1, at_least_3, at_most};
use crate::stages::{Context, Ranked, SelectSeeds, Stage};

/// Bins of the histogram in which Otsu's threshold is searched.
pub(super) const OTSU_BINS: usize = 100;

/// Largest sample: its payoff matrix takes 1 GiB.
const MAX_DOWNSAMPLE: u32 = 16_384;

/// `gtm`: a sample of the correspondences plays a game of mutual support; those whose share of the population
/// exceeds Otsu's threshold after a few generations are the seeds (Eq. 2-4; Rodola et al. 2013).
///
/// Memory: 4 `n_downsample`^2 bytes.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(default, deny_unknown_fields)
)]
pub struct Gtm {
    /// `N_downsample`: correspondences that play, drawn anew each round. 3 to 16384.
    pub n_downsample: u32,
    /// `N_gtm`: generations of the replicator. At least 1.
    pub n_gtm: u32,
    /// What two correspondences gain from each other.
    pub payoff: Payoff,
}

impl Default for Gtm {
    fn default() -> Self {
        Self { n_downsample: 1024, n_gtm: 20, payoff: Payoff::Gaussian }
    }
}

impl Gtm {
    pub(super) fn check(&self) -> Result<(), Error> {
        at_least_3("scs.n_downsample", self.n_downsample)?;
        at_most("scs.n_downsample", self.n_downsample, MAX_DOWNSAMPLE, "at most 16384 (1 GiB of payoffs)")?;
        at_least_1("scs.n_gtm", self.n_gtm)
    }
}

impl SelectSeeds for Gtm {
    fn select_seeds(&self, context: &Context<'_>) -> Ranked {
        // PAPER: when the sample is drawn is not said. A new one each round, uniform over what is alive, so
        // that the order of the input does not matter.
        let sample = context.rng(Stage::Scs).sample(context.alive.ids(), self.n_downsample as usize);
        let players = context.pairs.columns.gather(&sample);
        let payoff = payoff_matrix(&players, self.payoff, context.delta_r_pr, || context.interrupt.is_set());
        let population = replicator(&payoff, self.n_gtm as usize, || context.interrupt.is_set());
        let Some(population) = population else { return Ranked::default() };
        // Equal shares have no threshold: nothing is to be told apart, so all are seeds.
        let t_gtm = otsu(&population, OTSU_BINS).unwrap_or(0.0);
        Ranked::new(sample.into_iter().zip(population).filter(|&(_, x)| x > t_gtm).collect())
    }
}
