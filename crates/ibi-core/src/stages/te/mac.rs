use super::{best_of, compatibility_graph};
use crate::error::Error;
use crate::kernels::cliques::{Limits, heaviest_cliques};
use crate::ranges::{at_least_1, at_most, positive, share};
use crate::stages::{Context, Estimate, EstimatePose, Ranked};

/// `mac`: maximal cliques of the second-order compatibility graph over `C_d`, for each member the heaviest one that holds
/// it, give a pose each; the one with the best MAE over the alive correspondences wins (Zhang et al. 2023, MAC; Eq. 7-8).
///
/// The nodes of the graph are the 1024 best of `C_d` at most. Its weights take 8 n^2 bytes.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(default, deny_unknown_fields)
)]
pub struct Mac {
    /// `d_cmp`: two correspondences are compatible by exp(-r^2 / `d_cmp`^2), in pr. > 0.
    pub d_cmp_pr: f64,
    /// `t_cmp`: least compatibility of an edge of the first order. 0 to 1.
    pub t_cmp: f64,
    /// Least weight of an edge of the second order, as a share of the largest. 0 to 1.
    pub t_sog: f64,
    /// Maximal cliques looked at, at most; a round that has come so far is `capped`. 1 to 1,000,000,000.
    pub max_cliques: u32,
    /// Steps of the search, at most; a round that has come so far is `capped`. 1 to 1,000,000,000.
    pub max_steps: u32,
}

impl Default for Mac {
    fn default() -> Self {
        Self { d_cmp_pr: 10.0, t_cmp: 0.9, t_sog: 0.5, max_cliques: 10_000, max_steps: 20_000 }
    }
}

impl Mac {
    pub(super) fn check(&self) -> Result<(), Error> {
        positive("te.d_cmp_pr", self.d_cmp_pr)?;
        share("te.t_cmp", self.t_cmp)?;
        share("te.t_sog", self.t_sog)?;
        at_least_1("te.max_cliques", self.max_cliques)?;
        at_most("te.max_cliques", self.max_cliques, 1_000_000_000, "at most 1,000,000,000")?;
        at_least_1("te.max_steps", self.max_steps)?;
        at_most("te.max_steps", self.max_steps, 1_000_000_000, "at most 1,000,000,000")
    }
}

impl EstimatePose for Mac {
    fn estimate_pose(&self, context: &Context<'_>, dense: &Ranked) -> Estimate {
        let interrupted = || context.interrupt.is_set();
        let (first, is_cut) = compatibility_graph(context, dense, self.d_cmp_pr, self.t_cmp);
        // PAPER: where the second order is cut off is not said. A share of the largest weight knows no unit.
        let second = first.second_order(self.t_sog as f32, interrupted);
        let limits = Limits { max_cliques: self.max_cliques as usize, max_steps: self.max_steps as usize };
        let found = heaviest_cliques(&second, limits, interrupted);
        let ids = |clique: &Vec<u32>| -> Vec<u32> {
            clique.iter().map(|&node| dense.ids()[node as usize]).collect()
        };
        let samples: Vec<Vec<u32>> = found.heaviest.iter().map(ids).collect();
        let num_samples = samples.len() as u32;
        Estimate {
            hypothesis: best_of(context, &samples),
            num_samples,
            num_degenerate: 0,
            capped: found.capped || is_cut,
        }
    }
}
