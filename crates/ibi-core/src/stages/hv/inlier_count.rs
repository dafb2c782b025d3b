use crate::error::Error;
use crate::ranges::at_least_1;
use crate::stages::{Context, Hypothesis, Validate, Verdict};

/// `inlier_count`: accepts a pose if more than `t_inliers` alive correspondences have a residual below `t_he`.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(default, deny_unknown_fields)
)]
pub struct InlierCount {
    /// The count to exceed; the paper tries 50, 100 and 150. At least 1.
    pub t_inliers: u32,
}

impl Default for InlierCount {
    fn default() -> Self {
        Self { t_inliers: 50 }
    }
}

impl InlierCount {
    pub(super) fn check(&self) -> Result<(), Error> {
        at_least_1("hv.t_inliers", self.t_inliers)
    }
}

impl Validate for InlierCount {
    fn validate(&self, context: &Context<'_>, hypothesis: &Hypothesis) -> Verdict {
        let inliers = context.inliers(&hypothesis.target_from_source, context.scene.tolerances.t_he_pr);
        Verdict { value: inliers.len() as f64, threshold: self.t_inliers.into() }
    }
}
