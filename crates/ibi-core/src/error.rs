//! What can be wrong with the input. Finding nothing is not an error, see [`crate::StopReason`].

use crate::stop::StopReason;

/// Why a call was refused. Every message is one line that names the argument, the place and what is allowed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A cloud has fewer points than a pose needs.
    #[error("{argument} has {len} points; at least 3 are needed")]
    TooFewPoints {
        /// `src` or `tgt`.
        argument: Argument,
        /// Number of points given.
        len: usize,
    },
    /// A coordinate is NaN, infinite, or so large that its square is.
    #[error("{argument}[{row}] is [{}, {}, {}]; coordinates must be finite and below 1e100", value[0], value[1], value[2])]
    NotFinite {
        /// The array.
        argument: Argument,
        /// First offending row.
        row: usize,
        /// The row.
        value: [f64; 3],
    },
    /// A normal has no direction.
    #[error("{argument}[{row}] has length 0; a normal must have a direction")]
    ZeroNormal {
        /// `src_normals` or `tgt_normals`.
        argument: Argument,
        /// First offending row.
        row: usize,
    },
    /// Two arrays that belong together differ in length.
    #[error("{argument} has {len} rows; it must have one for each of the {expected} rows of {of}")]
    LengthMismatch {
        /// The array.
        argument: Argument,
        /// Its length.
        len: usize,
        /// The array it belongs to.
        of: Argument,
        /// The length of that.
        expected: usize,
    },
    /// Normals were given for one cloud only.
    #[error("{given} is given but {missing} is not; give normals for both clouds or for neither")]
    NormalsOfOneCloud {
        /// The array that was given.
        given: Argument,
        /// The array that was not.
        missing: Argument,
    },
    /// A local reference frame is no rotation.
    #[error("{argument}[{row}] is no rotation; its rows must be orthonormal to 1e-3 and right-handed")]
    NotARotation {
        /// `src_frames` or `tgt_frames`.
        argument: Argument,
        /// First offending row.
        row: usize,
    },
    /// Frames were given for one cloud only.
    #[error("{given} is given but {missing} is not; give frames for both clouds or for neither")]
    FramesOfOneCloud {
        /// The array that was given.
        given: Argument,
        /// The array that was not.
        missing: Argument,
    },
    /// A correspondence points outside of a cloud.
    #[error("corr[{row}, {column}] is {index}; {} has rows 0 to {}", if *column == 0 { "src" } else { "tgt" }, len.saturating_sub(1))]
    IndexOutOfRange {
        /// First offending correspondence.
        row: usize,
        /// 0 for the source index, 1 for the target index.
        column: usize,
        /// The index.
        index: i64,
        /// Number of points of that cloud.
        len: usize,
    },
    /// A similarity is NaN or infinite.
    #[error("similarity[{row}] is {value}; it must be finite")]
    Similarity {
        /// First offending row.
        row: usize,
        /// Its value.
        value: f64,
    },
    /// The seed selection cannot do without an argument that was not given.
    #[error(
        "{argument} is not given, and the seed selection of params.scs needs it; give it, or take another variant"
    )]
    Missing {
        /// The argument.
        argument: Argument,
    },
    /// All points of a cloud coincide, so no length scale can be taken from it.
    #[error("all points of {argument} coincide; a resolution cannot be estimated from it")]
    NoExtent {
        /// `src` or `tgt`.
        argument: Argument,
    },
    /// A cloud lies so far from the origin that its coordinates cannot tell its points apart well enough.
    #[error(
        "the points of {argument} are {spacing:.3e} apart and its coordinates about {distance:.3e}, where numbers are {step:.3e} apart; subtract an offset"
    )]
    TooFarOff {
        /// `src` or `tgt`.
        argument: Argument,
        /// The largest of the coordinates of its middle.
        distance: f64,
        /// What lies between that and the next number.
        step: f64,
        /// Mean distance of a point to its nearest other one; a thousandth of it is allowed.
        spacing: f64,
    },
    /// One cloud is smaller than the gaps between the points of the other: most likely metres against
    /// millimetres.
    #[error(
        "{small} is {extent:.3e} across but the points of {large} are {spacing:.3e} apart; are both in the same unit?"
    )]
    DifferentUnits {
        /// The cloud that is too small.
        small: Argument,
        /// Its extent (diagonal of the bounding box).
        extent: f64,
        /// The other cloud.
        large: Argument,
        /// Mean nearest-neighbour distance of the other.
        spacing: f64,
    },
    /// A limit struck, or the run was cancelled, before its first round: [`crate::Registrar::register`] makes an empty result
    /// of it.
    #[error("ended while it was prepared: {reason}")]
    Interrupted {
        /// Which limit, or that it was cancelled.
        reason: StopReason,
    },
    /// More correspondences, or points, than 32-bit ids can name.
    #[error("{argument} has {len} rows; at most {} are supported", u32::MAX)]
    TooMany {
        /// The array.
        argument: Argument,
        /// Its length.
        len: usize,
    },
    /// A parameter is out of its range.
    #[error("params.{name} is {value}; it must be {allowed}")]
    Param {
        /// Path of the parameter, e.g. `scs.n_gtm`.
        name: &'static str,
        /// The value given.
        value: f64,
        /// What is allowed.
        allowed: &'static str,
    },
    /// The system refused to start the threads.
    #[error("the thread pool could not be started: {reason}")]
    ThreadPool {
        /// The system's words.
        reason: String,
    },
}

/// The arguments of a registration, by the names that users know.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Argument {
    /// The source (model) cloud.
    Src,
    /// The target (scene) cloud.
    Tgt,
    /// The correspondences.
    Corr,
    /// Normals of the source.
    SrcNormals,
    /// Normals of the target.
    TgtNormals,
    /// Local reference frames of the source.
    SrcFrames,
    /// Local reference frames of the target.
    TgtFrames,
    /// A similarity for each correspondence.
    Similarity,
    /// Where the depth camera stood.
    Viewpoint,
    /// What it measured.
    Measured,
}

impl std::fmt::Display for Argument {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Src => "src",
            Self::Tgt => "tgt",
            Self::Corr => "corr",
            Self::SrcNormals => "src_normals",
            Self::TgtNormals => "tgt_normals",
            Self::SrcFrames => "src_frames",
            Self::TgtFrames => "tgt_frames",
            Self::Similarity => "similarity",
            Self::Viewpoint => "viewpoint",
            Self::Measured => "viewpoint.points",
        })
    }
}
