use super::{best_of, is_degenerate};
use crate::error::Error;
use crate::ranges::{at_least_1, at_most, non_negative};
use crate::stages::{Context, Estimate, EstimatePose, Ranked, Stage};

/// `ransac`: triplets drawn uniformly from `C_d` give a pose each; the one with the best MAE over the alive
/// correspondences wins (Fischler & Bolles 1981, scored by Eq. 7-8).
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(default, deny_unknown_fields)
)]
pub struct Ransac {
    /// Triplets drawn. 1 to 10,000,000.
    pub n_ransac: u32,
    /// Triplets whose points are within this distance of one line, on either side, are skipped and counted,
    /// in pr. >= 0.
    pub min_height_pr: f64,
}

impl Default for Ransac {
    fn default() -> Self {
        Self { n_ransac: 1000, min_height_pr: 2.0 }
    }
}

impl Ransac {
    pub(super) fn check(&self) -> Result<(), Error> {
        at_least_1("te.n_ransac", self.n_ransac)?;
        at_most("te.n_ransac", self.n_ransac, 10_000_000, "at most 10,000,000")?;
        non_negative("te.min_height_pr", self.min_height_pr)
    }
}

impl EstimatePose for Ransac {
    fn estimate_pose(&self, context: &Context<'_>, dense: &Ranked) -> Estimate {
        if dense.len() < 3 {
            return Estimate::default();
        }
        let mut rng = context.rng(Stage::Te);
        let mut triplets = Vec::new();
        for sample in 0..self.n_ransac {
            if sample % 4096 == 0 && context.interrupt.is_set() {
                return Estimate::default();
            }
            let triplet = three_of(dense.ids(), || rng.below(dense.len()));
            if !is_degenerate(context, triplet, self.min_height_pr) {
                triplets.push(triplet);
            }
        }
        Estimate {
            hypothesis: best_of(context, &triplets),
            num_samples: self.n_ransac,
            num_degenerate: self.n_ransac - triplets.len() as u32,
            capped: false,
        }
    }
}

/// Three different members of `ids` (at least three long).
fn three_of(ids: &[u32], mut draw: impl FnMut() -> usize) -> [u32; 3] {
    let i = draw();
    let j = std::iter::repeat_with(&mut draw).find(|&j| j != i).unwrap_or(i);
    let k = std::iter::repeat_with(&mut draw).find(|&k| k != i && k != j).unwrap_or(i);
    [ids[i], ids[j], ids[k]]
}
