//! SCS, seed correspondence selection: alive correspondences -> `C_s`, few and highly consistent.

mod gtm;
mod hough3d;
mod local_gtm;
mod nnsr;

pub use gtm::Gtm;
pub use hough3d::Hough3d;
pub use local_gtm::LocalGtm;
pub use nnsr::Nnsr;

use super::{Context, Ranked, SelectSeeds, variants};
use crate::error::Argument;

variants! {
    /// The ways to select seeds.
    Scs {
        /// Game-theoretic matching.
        Gtm = "gtm",
        /// Game-theoretic matching in one neighbourhood at a time.
        LocalGtm = "local_gtm",
        /// The most distinctive matches.
        Nnsr = "nnsr",
        /// Votes for the centroid of the source.
        Hough3d = "hough3d",
    }
}

impl SelectSeeds for Scs {
    fn select_seeds(&self, context: &Context<'_>) -> Ranked {
        match self {
            Self::Gtm(gtm) => gtm.select_seeds(context),
            Self::LocalGtm(local_gtm) => local_gtm.select_seeds(context),
            Self::Nnsr(nnsr) => nnsr.select_seeds(context),
            Self::Hough3d(hough3d) => hough3d.select_seeds(context),
        }
    }

    fn needs(&self) -> Option<Argument> {
        match self {
            Self::Nnsr(nnsr) => nnsr.needs(),
            Self::Gtm(_) | Self::LocalGtm(_) | Self::Hough3d(_) => None,
        }
    }
}
