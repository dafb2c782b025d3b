use nalgebra::Isometry3;

use crate::error::Error;
use crate::kernels::kabsch::rigid_fit;
use crate::ranges::{at_least_1, at_most};
use crate::stages::{Context, Estimate, EstimatePose, Hypothesis, Ranked};

/// Correspondences with at least this share of the most votes make the first fit.
const TRUSTED: f32 = 0.5;

/// `irls`: a rigid fit to the correspondences with the most votes, then fits to the alive inliers of the fit
/// before, within 2 `t_he`, 2 `t_he`, `t_he`, ... (iteratively re-weighted least squares with 0/1 weights).
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(default, deny_unknown_fields)
)]
pub struct Irls {
    /// Fits after the first. 1 to 1000.
    pub n_refits: u32,
}

impl Default for Irls {
    fn default() -> Self {
        Self { n_refits: 4 }
    }
}

impl Irls {
    pub(super) fn check(&self) -> Result<(), Error> {
        at_least_1("te.n_refits", self.n_refits)?;
        at_most("te.n_refits", self.n_refits, 1000, "at most 1000")
    }
}

impl EstimatePose for Irls {
    fn estimate_pose(&self, context: &Context<'_>, dense: &Ranked) -> Estimate {
        let Some(&top) = dense.scores().first() else { return Estimate::default() };
        let trusted = dense.scores().partition_point(|&s| s >= TRUSTED * top);
        let ids = &dense.ids()[..trusted];
        let hypothesis = rigid_fit(context.pairs.pairs(ids.iter().copied())).map(|mut pose| {
            for refit in 0..self.n_refits {
                if context.interrupt.is_set() {
                    break;
                }
                let wide = if refit < 2 { 2.0 } else { 1.0 };
                match refitted(context, &pose, wide * context.scene.tolerances.t_he_pr) {
                    Some(better) => pose = better,
                    None => break,
                }
            }
            Hypothesis { target_from_source: pose, score: context.mae(&pose) }
        });
        Estimate {
            hypothesis,
            num_samples: 1,
            num_degenerate: u32::from(hypothesis.is_none()),
            capped: false,
        }
    }
}

/// The fit to the alive correspondences within `distance_pr` of `pose`.
fn refitted(context: &Context<'_>, pose: &Isometry3<f64>, distance_pr: f64) -> Option<Isometry3<f64>> {
    let inliers = context.inliers(pose, distance_pr);
    rigid_fit(context.pairs.pairs(inliers.iter().copied()))
}
