use super::{best_of, compatibility_graph, is_degenerate};
use crate::error::Error;
use crate::kernels::triangles::heaviest_triangles;
use crate::ranges::{at_least_1, at_most, non_negative, positive, share};
use crate::stages::{Context, Estimate, EstimatePose, Ranked};

/// `sac_cot`: the triangles of the compatibility graph over `C_d` with the largest sum of compatibilities give a pose
/// each; the one with the best MAE over the alive correspondences wins (Yang et al. 2021, SAC-COT; Eq. 7-8).
///
/// The nodes of the graph are the 1024 best of `C_d` at most. Its weights take 4 n^2 bytes.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(default, deny_unknown_fields)
)]
pub struct SacCot {
    /// Triangles tried. 1 to 1,000,000.
    pub n_sac_cot: u32,
    /// `d_cmp`: two correspondences are compatible by exp(-r^2 / `d_cmp`^2), in pr. > 0.
    pub d_cmp_pr: f64,
    /// `t_cmp`: least compatibility of an edge. 0 to 1.
    pub t_cmp: f64,
    /// Triangles looked at, at most; a round that has come so far is `capped`. 1 to 1,000,000,000.
    pub max_triangles: u32,
    /// Triangles whose points are within this distance of one line, on either side, are skipped and counted, in pr. >= 0.
    pub min_height_pr: f64,
}

impl Default for SacCot {
    fn default() -> Self {
        Self { n_sac_cot: 100, d_cmp_pr: 10.0, t_cmp: 0.9, max_triangles: 1_000_000, min_height_pr: 2.0 }
    }
}

impl SacCot {
    pub(super) fn check(&self) -> Result<(), Error> {
        at_least_1("te.n_sac_cot", self.n_sac_cot)?;
        at_most("te.n_sac_cot", self.n_sac_cot, 1_000_000, "at most 1,000,000")?;
        positive("te.d_cmp_pr", self.d_cmp_pr)?;
        share("te.t_cmp", self.t_cmp)?;
        at_least_1("te.max_triangles", self.max_triangles)?;
        at_most("te.max_triangles", self.max_triangles, 1_000_000_000, "at most 1,000,000,000")?;
        non_negative("te.min_height_pr", self.min_height_pr)
    }
}

impl EstimatePose for SacCot {
    fn estimate_pose(&self, context: &Context<'_>, dense: &Ranked) -> Estimate {
        let (graph, is_cut) = compatibility_graph(context, dense, self.d_cmp_pr, self.t_cmp);
        let ids = |triangle: [u32; 3]| triangle.map(|node| dense.ids()[node as usize]);
        let found = heaviest_triangles(
            &graph,
            self.n_sac_cot as usize,
            self.max_triangles as usize,
            // PAPER: thin triangles are not mentioned; close points are compatible whatever the pose, so they come first.
            |triangle| !is_degenerate(context, ids(triangle), self.min_height_pr),
            || context.interrupt.is_set(),
        );
        let triangles: Vec<[u32; 3]> = found.heaviest.into_iter().map(ids).collect();
        Estimate {
            hypothesis: best_of(context, &triangles),
            num_samples: triangles.len() as u32 + found.num_refused,
            num_degenerate: found.num_refused,
            capped: found.capped || is_cut,
        }
    }
}
