//! The mathematics of the method, free of stages: pure functions, each with a naive twin in the tests.
//!
//! Public with the feature `internals` only, for this crate's own tests and benches. Kernels trust their input (it was
//! checked at the door, see [`crate::Registrar::begin`]) and give the same bits for any number of threads.

pub mod by_target;
pub mod cliques;
pub mod columns;
pub mod compatibility;
pub mod dense_graph;
pub(crate) mod diameter;
pub(crate) mod discs;
pub mod frames;
pub mod graph;
pub mod grid;
pub mod hough;
pub mod icp;
pub mod kabsch;
pub mod mae;
pub mod nearby;
pub mod neighbors;
pub mod otsu;
pub mod overlap;
pub mod par;
pub mod replicator;
pub mod rng;
pub(crate) mod rotation;
pub mod sight;
pub(crate) mod simd;
pub(crate) mod sort;
pub(crate) mod spread;
pub mod triangles;
pub mod triplets;
