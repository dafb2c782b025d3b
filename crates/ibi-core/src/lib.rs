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
mod claims;
mod cloud;
mod correspondence;
pub mod detection;
mod error;
pub mod features;
mod finish;
mod interrupt;
mod joint;
pub mod kernels;
mod ledger;
pub mod metrics;
mod pace;
mod params;
mod registrar;
mod registration;
mod scene;
pub mod stages;
mod state;
mod symmetries;

pub use claims::{Claims, NearClaims};
pub use cloud::{Cloud, PreparedCloud};
pub use correspondence::{Alive, Correspondences, PointPairs};
pub use error::{Argument, Error};
pub use interrupt::{CancelToken, Interrupt, Phase, Watcher};
pub use nalgebra;
pub use params::{Params, Refine, Removal};
pub use registrar::{Observer, Registrar};
pub use registration::{Pose, Registration, Round, StopReason, Timings};
pub use scene::{Detail, Scene};
pub use state::State;
pub use symmetries::{Axis, BOP_STEP, FindSymmetries, Symmetries, SymmetryError, Turning, find_symmetries};
