use crate::error::Error;
use crate::stages::{Context, Enhance, Ranked};

/// `off`: `C_d` is `C_s`, ranked by the seeds' own scores, as in the paper's ablation.
#[derive(Debug, Clone, Default, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(deny_unknown_fields))]
pub struct Off {}

impl Off {
    #[allow(clippy::unnecessary_wraps, clippy::unused_self)] // the shape of every variant's check
    pub(super) fn check(&self) -> Result<(), Error> {
        Ok(())
    }
}

impl Enhance for Off {
    fn enhance(&self, _context: &Context<'_>, seeds: &Ranked) -> Ranked {
        seeds.clone()
    }
}
