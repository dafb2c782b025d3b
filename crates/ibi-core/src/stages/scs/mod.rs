//! SCS, seed correspondence selection: alive correspondences -> `C_s`, few and highly consistent.

mod gtm;

pub use gtm::Gtm;

use super::{Context, Ranked, SelectSeeds, variants};

variants! {
    /// The ways to select seeds.
    Scs {
        /// Game-theoretic matching.
        Gtm = "gtm",
    }
}

impl SelectSeeds for Scs {
    fn select_seeds(&self, context: &Context<'_>) -> Ranked {
        match self {
            Self::Gtm(gtm) => gtm.select_seeds(context),
        }
    }
}
