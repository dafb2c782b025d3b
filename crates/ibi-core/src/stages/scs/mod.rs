//! SCS, seed correspondence selection: alive correspondences -> `C_s`, few and highly consistent.

mod gtm;
mod local_gtm;

pub use gtm::Gtm;
pub use local_gtm::LocalGtm;

use super::{Context, Ranked, SelectSeeds, variants};

variants! {
    /// The ways to select seeds.
    Scs {
        /// Game-theoretic matching.
        Gtm = "gtm",
        /// Game-theoretic matching in one neighbourhood at a time.
        LocalGtm = "local_gtm",
    }
}

impl SelectSeeds for Scs {
    fn select_seeds(&self, context: &Context<'_>) -> Ranked {
        match self {
            Self::Gtm(gtm) => gtm.select_seeds(context),
            Self::LocalGtm(local_gtm) => local_gtm.select_seeds(context),
        }
    }
}
