//! From a mesh and a scan to correspondences: thinning, normals, descriptors, matching.
//!
//! What [`crate::Registrar`] wants is two clouds and putative correspondences. This is one way to them, so that a CAD
//! file and a depth scan suffice:
//!
//! | side | steps |
//! |---|---|
//! | model | [`sample_mesh`], [`outer_surface`], [`voxel_downsample`] |
//! | scene | [`voxel_downsample`], [`estimate_normals`], [`dominant_plane`] taken away |
//! | both | [`fpfh`], then [`match_features`] |
//!
//! In this crate and not in one beside it, because it lives on the private parts of the kernels: the grid, the vector
//! units, and the discipline of threads. Functions of arrays, each by itself; they run on the [`Pool`] that they are
//! called in, on one thread outside of any, and give the same bits on any number. Lengths are in the unit of the data.
//!
//! [`Pool`]: crate::kernels::par::Pool

mod around;
mod door;
mod error;
mod fpfh;
mod leaves;
mod matching;
mod mesh;
mod normals;
mod outer;
mod pairs;
mod plane;
mod voxel;

pub use around::Neighborhood;
pub use error::FeatureError;
pub use fpfh::{FPFH_DIM, fpfh};
pub use matching::{Descriptors, Matches, Matching, match_features};
pub use mesh::{Amount, Mesh, Sampled, sample_mesh};
pub use normals::estimate_normals;
pub use outer::{Views, outer_surface};
pub use plane::{Plane, PlaneSearch, dominant_plane};
pub use voxel::{Thinned, voxel_downsample};
