//! All tests of the public face, a module for each topic: one binary, as each would link the whole crate again. What
//! needs a process of its own is a file beside this folder.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::float_cmp,
    clippy::panic,
    reason = "tests may panic, and compare what is exact"
)]

mod by_target;
mod conformance;
mod contest;
mod default_preset;
mod dense_graph;
mod detection;
mod errors;
mod evidence;
mod evidence_measured;
mod features;
mod floors;
// Parameters in the golden files are JSON.
#[cfg(feature = "serde")]
mod golden;
mod graph;
mod hough3d;
mod joint;
mod kernels;
mod limits;
mod limits_geometry;
mod mock;
mod nearby;
mod nnsr;
mod oriented;
#[cfg(feature = "serde")]
mod params;
mod polish;
mod refinement;
mod scans;
mod sight;
mod symmetries;
mod the_loop;
mod thinning;
