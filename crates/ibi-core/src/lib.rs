//! Multi-instance 3D registration: the 6-DoF pose of *every* copy of a model in a scene, from putative point
//! correspondences most of which are wrong.
//!
//! One loop, four stages, one instance at a time (Cao et al., "Instance by Instance: An Iterative Framework
//! for Multi-instance 3D Registration"):
//!
//! | stage | turns | into |
//! |---|---|---|
//! | **SCS** seed correspondence selection | the alive correspondences | `C_s`: few, highly consistent |
//! | **CE** correspondence enhancement | `C_s` voting on all alive | `C_d`: dense, ranked by votes |
//! | **TE** transformation estimation | `C_d` | one pose hypothesis |
//! | **HV** hypothesis validation | the pose and both clouds | accepted or rejected |
//!
//! Then correspondences are removed and the next round begins, until the seeds run dry. [`Registrar`] is the
//! loop; each stage is a trait in [`stages`] and an enum of named variants in [`Params`].
//!
//! Where correspondences are not given, [`features`] makes them from a mesh and a scan, and [`detection::Model`] goes all
//! the way from these to the poses.
//!
//! All lengths in [`Params`] are multiples of the resolution `pr`, so the unit of the data does not matter.
//! The same input and seed give the same bits, for any number of threads.
//!
//! With the feature `rayon` (default) kernels run on a thread pool of the registrar's own; `serde` makes
//! parameters and results plain data.

mod checks;
mod detail;
pub mod detection;
mod error;
#[cfg(feature = "internals")]
pub mod evidence;
#[cfg(not(feature = "internals"))]
#[allow(dead_code, unused_imports, unreachable_pub, reason = "public with the feature `internals`")]
mod evidence;
pub mod features;
mod grace;
mod interrupt;
#[cfg(feature = "internals")]
pub mod kernels;
#[cfg(not(feature = "internals"))]
#[allow(dead_code, unused_imports, unreachable_pub, reason = "public with the feature `internals`")]
mod kernels;
pub mod metrics;
mod pace;
mod params;
mod ranges;
mod registrar;
mod registration;
#[cfg_attr(
    not(feature = "internals"),
    allow(unreachable_pub, reason = "public with the feature `internals`")
)]
mod rounds;
mod scene;
pub mod stages;
mod stop;
mod symmetries;

pub use detail::Detail;
pub use error::{Argument, Error};
pub use evidence::{Contour, FreeMotion, Measures, Objection, Overrun, Support, Tally};
pub use interrupt::{CancelToken, Interrupt, Phase, Watcher};
pub use kernels::par::Pool;
pub use nalgebra;
pub use params::{Params, Refine, Removal};
pub use registrar::{Observer, Registrar};
pub use registration::{Pose, Registration, Rejected, Round, Timings};
#[cfg(feature = "internals")]
pub use rounds::Shortcuts;
pub use rounds::State;
pub use scene::{Alive, Cloud, Correspondences, PointPairs, PreparedCloud, Scene, Tolerances};
pub use stages::{Claims, NearClaims};
pub use stop::StopReason;
pub use symmetries::{Axis, BOP_STEP, FindSymmetries, Symmetries, SymmetryError, Turning, find_symmetries};
