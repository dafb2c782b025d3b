//! CE, correspondence enhancement: `C_s` -> `C_d`, more correspondences that agree with the seeds, ranked.

mod off;
mod voting;

pub use off::Off;
pub use voting::Voting;

use super::{Context, Enhance, Ranked, variants};

variants! {
    /// The ways to enhance the seeds.
    Ce {
        /// The seeds vote on all alive correspondences.
        Voting = "voting",
        /// The seeds are all there is.
        Off = "off",
    }
}

impl Enhance for Ce {
    fn enhance(&self, context: &Context<'_>, seeds: &Ranked) -> Ranked {
        match self {
            Self::Voting(voting) => voting.enhance(context, seeds),
            Self::Off(off) => off.enhance(context, seeds),
        }
    }
}
