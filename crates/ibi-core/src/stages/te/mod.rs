//! TE, transformation estimation: `C_d` -> one pose hypothesis.

mod gsac;
mod irls;
mod ransac;

pub use gsac::Gsac;
pub use irls::Irls;
pub use ransac::Ransac;

use nalgebra::Isometry3;

use super::{Context, Estimate, EstimatePose, Hypothesis, Ranked, variants};
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
    }
}

impl EstimatePose for Te {
    fn estimate_pose(&self, context: &Context<'_>, dense: &Ranked) -> Estimate {
        match self {
            Self::Gsac(gsac) => gsac.estimate_pose(context, dense),
            Self::Irls(irls) => irls.estimate_pose(context, dense),
            Self::Ransac(ransac) => ransac.estimate_pose(context, dense),
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

/// Fits a pose to each triplet of ids, scores it by MAE on the alive correspondences (Eq. 7-8), and returns
/// the best one; the earlier one of equals.
fn best_of(context: &Context<'_>, triplets: &[[u32; 3]]) -> Option<Hypothesis> {
    let score = |t: usize| -> Option<(f32, Isometry3<f64>)> {
        if context.interrupt.is_set() {
            return None;
        }
        let pose = rigid_fit(context.pairs.pairs(triplets[t]))?;
        Some((mae(context.alive.columns(), &pose, context.params.t_he_pr), pose))
    };
    let mut best: Option<(f32, Isometry3<f64>)> = None;
    for (mae, pose) in par::map(triplets.len(), 4, score).into_iter().flatten() {
        if best.is_none_or(|(top, _)| mae > top) {
            best = Some((mae, pose));
        }
    }
    best.map(|(mae, target_from_source)| Hypothesis { target_from_source, score: f64::from(mae) })
}
