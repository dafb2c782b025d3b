use crate::error::Error;
use crate::stages::{Context, Hypothesis, Validate, Verdict};

/// `none`: accepts every pose, as in the paper's ablation.
#[derive(Debug, Clone, Default, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(deny_unknown_fields))]
pub struct None {}

impl None {
    #[allow(clippy::unnecessary_wraps, clippy::unused_self)] // the shape of every variant's check
    pub(super) fn check(&self) -> Result<(), Error> {
        Ok(())
    }
}

impl Validate for None {
    fn validate(&self, _context: &Context<'_>, _hypothesis: &Hypothesis) -> Verdict {
        Verdict { value: 1.0, threshold: 0.0 }
    }
}
