//! Why nothing is looked for.

use super::doubts::general;
use crate::error::Error;
use crate::features::FeatureError;
use crate::symmetries::SymmetryError;

/// Why a model was not made, or a scan refused. Every message is one line that names the argument and what is allowed. A scan
/// that holds nothing is no error.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum DetectionError {
    /// A cloud or a parameter that a registration refuses.
    #[error(transparent)]
    Input(#[from] Error),
    /// A mesh or a length that a feature refuses.
    #[error(transparent)]
    Feature(#[from] FeatureError),
    /// Symmetries could not be looked for.
    #[error(transparent)]
    Symmetry(#[from] SymmetryError),
    /// All faces look into the mesh.
    #[error("faces: none is seen from outside")]
    NoneOutside,
    /// A model of points alone.
    #[error("src_normals: detection needs them; give them, or make the model of a mesh")]
    NoNormals,
    /// Neither a viewpoint nor normals of the scan.
    #[error(
        "viewpoint: give it (the camera's place, [0, 0, 0] in most scans) or tgt_normals: descriptors have to know which side of a surface is the outer one"
    )]
    NoSide,
    /// So many points have no normal that those of the others tell nothing about them.
    #[error("tgt_normals: {num_missing} of {len} are 0 or not finite; leave tgt_normals out")]
    MostNormalsMissing {
        /// How many.
        num_missing: usize,
        /// Of how many.
        len: usize,
    },
    /// A set of models without any.
    #[error("models: there is none; give at least one")]
    NoModels,
    /// Two models of one name.
    #[error("names: {name:?} is that of model {first} and of model {second}; each has one of its own")]
    SameName {
        /// The name.
        name: String,
        /// Index of a model.
        first: usize,
        /// Index of another one.
        second: usize,
    },
    /// A box of no size.
    #[error("roi: its side {axis} is {size} long; it must be above 0 and finite")]
    RoiSize {
        /// 0, 1 or 2.
        axis: usize,
        /// Data units.
        size: f64,
    },
    /// A box that is nowhere.
    #[error("roi: its place must be finite")]
    RoiPlace,
    /// A voxel that would take more points than fit into memory.
    #[error(
        "voxel: at {} about {count} points of the mesh would be drawn; at most {most} are; give a larger one",
        general(*voxel, 3)
    )]
    VoxelTooFine {
        /// As it was given, or as it follows from the size of the mesh.
        voxel: f64,
        /// So many, or more.
        count: usize,
        /// What is allowed.
        most: usize,
    },
    /// A background without a point.
    #[error("background: it holds no point")]
    NoBackground,
    /// The scan cannot be in the unit of the model.
    #[error(
        "tgt: the scene is {} across and the model {}; are they in the same unit? (Metres for millimetres are a factor of 1000; check_units off takes them as they are.)",
        general(*scene, 3), general(*model, 3)
    )]
    DifferentUnits {
        /// Diagonal of the box around all points of the scan but a few far ones.
        scene: f64,
        /// Diameter of the model.
        model: f64,
    },
}

impl DetectionError {
    /// Whether it is no more than that the call was ended from outside.
    #[must_use]
    pub fn is_interrupted(&self) -> bool {
        matches!(
            self,
            Self::Input(Error::Interrupted { .. })
                | Self::Feature(FeatureError::Interrupted)
                | Self::Symmetry(SymmetryError::Interrupted)
        )
    }
}
