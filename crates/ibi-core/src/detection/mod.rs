//! From a mesh and a scan to poses, with nothing to choose: the steps of [`crate::features`] with lengths that follow from
//! the part, and the [`crate::Registrar`] behind them.
//!
//! | file | what |
//! |---|---|
//! | `surface` | [`Model::from_mesh`]: points on the outer surface of a mesh, one a voxel |
//! | `model` | [`Model`]: a source that was prepared and described once, for any number of scans |
//! | `scan` | a scan, thinned to what it can carry, without its table |
//! | `detect` | [`Model::correspond`] matches both, [`Model::detect`] registers as well |
//! | `models` | [`Models`]: several kinds of parts together, whose poses are `rivals` |
//! | `shared` | what is worked out once for all models that are looked for in a scan |
//! | `roi` | [`Roi`]: a box to look into |
//! | `doubts` | [`Doubt`]: what the result is to be mistrusted for |
//!
//! The constants were chosen on ray-cast piles, tuning half of `benchmarks/piles.py`, and on the seven scans of
//! `benchmarks/detect.py`.

mod bodies;
mod detect;
mod doubts;
mod error;
mod extent;
mod faces;
mod model;
mod models;
mod rivals;
mod roi;
mod scan;
mod shared;
mod sides;
mod standpoints;
mod surface;
mod twins;

pub use detect::{Detect, Detection, MatchedScan};
pub use doubts::Doubt;
pub use error::DetectionError;
pub use model::{Model, Origin};
pub use models::{Detections, Models};
pub use roi::Roi;
pub use scan::Measured;
pub use surface::{FromMesh, MeshSymmetries};

use crate::interrupt::{CancelToken, Interrupt, Watcher};
use crate::registrar::Registrar;

/// Points that were thinned to a voxel are so much nearer than a voxel, on average.
const VOXELS_PER_SPACING: f64 = 1.25;

/// How a call is run, and how it is ended from outside.
#[derive(Clone, Default)]
pub struct Run {
    /// As in [`crate::Registrar::num_threads`].
    pub num_threads: Option<usize>,
    /// Ends the call, from any thread.
    pub cancel: CancelToken,
    /// Is told each phase as it begins.
    pub watcher: Option<Watcher>,
}

impl Run {
    /// A registrar that is run, and ended, so.
    #[must_use]
    pub fn registrar<'a>(&self, registrar: Registrar<'a>) -> Registrar<'a> {
        let mut registrar = registrar.cancel_token(self.cancel.clone());
        if let Some(num_threads) = self.num_threads {
            registrar = registrar.num_threads(num_threads);
        }
        match &self.watcher {
            Some(watcher) => registrar.watcher(watcher.clone()),
            None => registrar,
        }
    }

    fn interrupt(&self) -> Interrupt {
        let interrupt = Interrupt::from(self.cancel.clone());
        match &self.watcher {
            Some(watcher) => interrupt.with_watcher(watcher.clone()),
            None => interrupt,
        }
    }
}

impl std::fmt::Debug for Run {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Run").field("num_threads", &self.num_threads).finish_non_exhaustive()
    }
}
