//! TE, transformation estimation: `C_d` -> one pose hypothesis.

mod gsac;
mod irls;
mod mac;
mod ransac;
mod sac_cot;

pub use gsac::Gsac;
pub use irls::Irls;
pub use mac::Mac;
pub use ransac::Ransac;
pub use sac_cot::SacCot;

use nalgebra::Isometry3;

use super::{Context, Estimate, EstimatePose, Hypothesis, Ranked, variants};
use crate::kernels::compatibility::{Payoff, payoff_matrix};
use crate::kernels::dense_graph::DenseGraph;
use crate::kernels::kabsch::{rigid_fit, triangle_height};
use crate::kernels::mae::mae;
use crate::kernels::par;

variants! {
    /// The ways to estimate a pose.
    Te {
        /// Guided sampling: the triplets with the most votes.
        Gsac = "gsac",
        /// Least squares, re-weighted.
        Irls = "irls",
        /// Uniform sampling.
        Ransac = "ransac",
        /// Triangles of the compatibility graph.
        SacCot = "sac_cot",
        /// Maximal cliques of the compatibility graph.
        Mac = "mac",
    }
}

impl EstimatePose for Te {
    fn estimate_pose(&self, context: &Context<'_>, dense: &Ranked) -> Estimate {
        match self {
            Self::Gsac(gsac) => gsac.estimate_pose(context, dense),
            Self::Irls(irls) => irls.estimate_pose(context, dense),
            Self::Ransac(ransac) => ransac.estimate_pose(context, dense),
            Self::SacCot(sac_cot) => sac_cot.estimate_pose(context, dense),
            Self::Mac(mac) => mac.estimate_pose(context, dense),
        }
    }
}

/// Whether three correspondences are, on either side, within `min_height_pr` of one line: too thin to fix a
/// rotation.
fn is_degenerate(context: &Context<'_>, ids: [u32; 3], min_height_pr: f64) -> bool {
    let min_height = context.length(min_height_pr);
    let [i, j, k] = ids.map(|id| id as usize);
    let thin =
        |points: &[nalgebra::Point3<f64>]| triangle_height(&points[i], &points[j], &points[k]) <= min_height;
    thin(&context.pairs.source) || thin(&context.pairs.target)
}

/// The compatibility graph of the best-ranked members of `C_d`, at most [`MAX_NODES`], by rank: exp(-r^2 / d_cmp^2),
/// where it is at least `t_cmp`. Whether there are members without a node.
fn compatibility_graph(
    context: &Context<'_>,
    dense: &Ranked,
    d_cmp_pr: f64,
    t_cmp: f64,
) -> (DenseGraph, bool) {
    let ids = &dense.ids()[..dense.len().min(MAX_NODES)];
    let columns = context.pairs.columns.gather(ids);
    let weights = payoff_matrix(&columns, Payoff::Gaussian, d_cmp_pr, || context.interrupt.is_set());
    (DenseGraph::new(weights, t_cmp as f32), ids.len() < dense.len())
}

/// Members of `C_d` that a dense graph may have as nodes: its weights take 4 MiB.
const MAX_NODES: usize = 1024;

/// Samples that are shared out to the threads in one go: once the run is interrupted even to skip ten million takes its time.
const SAMPLES_AT_A_TIME: usize = 1 << 14;

/// Fits a pose to each sample of ids, scores it by MAE on the alive correspondences (Eq. 7-8), and returns
/// the best one; the earlier one of equals. None once the run was interrupted.
fn best_of<S: AsRef<[u32]> + Sync>(context: &Context<'_>, samples: &[S]) -> Option<Hypothesis> {
    let score = |s: usize| -> Option<(f32, Isometry3<f64>)> {
        if context.interrupt.is_set() {
            return None;
        }
        let pose = rigid_fit(context.pairs.pairs(samples[s].as_ref().iter().copied()))?;
        Some((mae(context.alive.columns(), &pose, context.scene.tolerances.t_he_pr), pose))
    };
    let mut best: Option<(f32, Isometry3<f64>)> = None;
    for start in (0..samples.len()).step_by(SAMPLES_AT_A_TIME) {
        if context.interrupt.is_set() {
            return None;
        }
        let num = SAMPLES_AT_A_TIME.min(samples.len() - start);
        for (mae, pose) in par::map(num, 4, |i| score(start + i)).into_iter().flatten() {
            if best.is_none_or(|(top, _)| mae > top) {
                best = Some((mae, pose));
            }
        }
    }
    best.map(|(mae, target_from_source)| Hypothesis { target_from_source, score: f64::from(mae) })
}
