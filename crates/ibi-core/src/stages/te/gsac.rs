use super::{best_of, is_degenerate};
use crate::error::Error;
use crate::kernels::triplets::TopTriplets;
use crate::params::{at_least_1, non_negative};
use crate::stages::{Context, Estimate, EstimatePose, Ranked};

/// `gsac`: guided sampling. The `n_gsac` triplets of `C_d` with the largest sum of votes give a pose each; the
/// one with the best MAE over the alive correspondences wins (Eq. 7-8).
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(default, deny_unknown_fields))]
pub struct Gsac {
    /// `N_gsac`: triplets tried. At least 1.
    pub n_gsac: u32,
    /// Triplets whose points are within this distance of one line, on either side, are skipped and counted,
    /// in pr. >= 0.
    pub min_height_pr: f64,
}

impl Default for Gsac {
    fn default() -> Self {
        Self { n_gsac: 100, min_height_pr: 0.1 }
    }
}

impl Gsac {
    pub(super) fn check(&self) -> Result<(), Error> {
        at_least_1("te.n_gsac", self.n_gsac)?;
        non_negative("te.min_height_pr", self.min_height_pr)
    }
}

impl EstimatePose for Gsac {
    fn estimate_pose(&self, context: &Context<'_>, dense: &Ranked) -> Estimate {
        let ids = dense.ids();
        // PAPER: the paper sorts all triplets of C_d, 4,455,100 of them at N_vot = 300.
        let top = TopTriplets::new(dense.scores()).take(self.n_gsac as usize);
        let samples: Vec<[u32; 3]> = top.map(|t| t.map(|i| ids[i])).collect();
        // PAPER: thin triplets are not mentioned; fitted, they turn the model about their line at random.
        let mut triplets = samples.clone();
        triplets.retain(|&t| !is_degenerate(context, t, self.min_height_pr));
        Estimate {
            hypothesis: best_of(context, &triplets),
            num_samples: samples.len() as u32,
            num_degenerate: (samples.len() - triplets.len()) as u32,
        }
    }
}
