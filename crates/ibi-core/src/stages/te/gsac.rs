use super::{best_of, is_degenerate};
use crate::error::Error;
use crate::kernels::triplets::TopTriplets;
use crate::ranges::{at_least_1, at_most, non_negative};
use crate::stages::{Context, Estimate, EstimatePose, Ranked};

/// Triplets looked at, at most, for each one wanted. Votes are alike where correspondences are neighbours, so
/// the first few hundred triplets may all be thin: where only `n_gsac` were looked at, some rounds had no
/// hypothesis at all.
const PATIENCE: usize = 100;

/// `gsac`: guided sampling. The `n_gsac` triplets of `C_d` with the largest sum of votes, thin ones left out,
/// give a pose each; the one with the best MAE over the alive correspondences wins (Eq. 7-8).
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(default, deny_unknown_fields)
)]
pub struct Gsac {
    /// `N_gsac`: triplets tried. 1 to 1,000,000.
    pub n_gsac: u32,
    /// Triplets whose points are within this distance of one line, on either side, are skipped and counted,
    /// in pr. >= 0. Noise of one pr turns a thinner triangle by tens of degrees.
    pub min_height_pr: f64,
}

impl Default for Gsac {
    fn default() -> Self {
        Self { n_gsac: 100, min_height_pr: 2.0 }
    }
}

impl Gsac {
    pub(super) fn check(&self) -> Result<(), Error> {
        at_least_1("te.n_gsac", self.n_gsac)?;
        at_most("te.n_gsac", self.n_gsac, 1_000_000, "at most 1,000,000")?;
        non_negative("te.min_height_pr", self.min_height_pr)
    }
}

impl EstimatePose for Gsac {
    fn estimate_pose(&self, context: &Context<'_>, dense: &Ranked) -> Estimate {
        let ids = dense.ids();
        let wanted = self.n_gsac as usize;
        let mut triplets = Vec::new();
        let mut num_samples = 0;
        // PAPER: the paper sorts all triplets of C_d, 4,455,100 of them at N_vot = 300.
        for triplet in TopTriplets::new(dense.scores()).take(wanted.saturating_mul(PATIENCE)) {
            if num_samples % 4096 == 0 && context.interrupt.is_set() {
                return Estimate::default();
            }
            num_samples += 1;
            let triplet = triplet.map(|i| ids[i]);
            // PAPER: thin triplets are not mentioned; fitted, they turn the model about their line at random.
            if !is_degenerate(context, triplet, self.min_height_pr) {
                triplets.push(triplet);
            }
            if triplets.len() == wanted {
                break;
            }
        }
        Estimate {
            hypothesis: best_of(context, &triplets),
            num_samples,
            num_degenerate: num_samples - triplets.len() as u32,
            capped: false,
        }
    }
}
