//! What can be wrong with the input of a feature.

/// Why a feature was not computed. Every message is one line that names the argument, the place and what is allowed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FeatureError {
    /// A coordinate is NaN, infinite, or so large that its square is.
    #[error("{argument}[{row}] is [{}, {}, {}]; coordinates must be finite and below 1e100", value[0], value[1], value[2])]
    NotFinite {
        /// The array.
        argument: &'static str,
        /// First offending row.
        row: usize,
        /// The row.
        value: [f64; 3],
    },
    /// A normal has no direction.
    #[error("{argument}[{row}] has length 0; a normal must have a direction")]
    ZeroNormal {
        /// The array.
        argument: &'static str,
        /// First offending row.
        row: usize,
    },
    /// Two arrays that belong together differ in length.
    #[error("{argument} has {len} rows; it must have one for each of the {expected} rows of {of}")]
    LengthMismatch {
        /// The array.
        argument: &'static str,
        /// Its length.
        len: usize,
        /// The array it belongs to.
        of: &'static str,
        /// The length of that.
        expected: usize,
    },
    /// More rows than 32-bit ids can name.
    #[error("{argument} has {len} rows; at most {} are supported", u32::MAX)]
    TooMany {
        /// The array.
        argument: &'static str,
        /// Its length.
        len: usize,
    },
    /// A row that is not one of the cloud's.
    #[error("{argument}[{at}] is {row}; {of} has rows 0 to {}", len.saturating_sub(1))]
    RowOutOfRange {
        /// The array.
        argument: &'static str,
        /// Where in it.
        at: usize,
        /// The row that it names.
        row: i64,
        /// The array that has no such row.
        of: &'static str,
        /// The length of that.
        len: usize,
    },
    /// A face has a corner that is not a vertex.
    #[error("faces[{row}, {column}] is {index}; vertices has rows 0 to {}", len.saturating_sub(1))]
    FaceIndex {
        /// First offending face.
        row: usize,
        /// Its first offending corner.
        column: usize,
        /// The vertex that it names.
        index: i64,
        /// Number of vertices.
        len: usize,
    },
    /// A mesh without a surface to draw points from.
    #[error("the faces of the mesh have no area")]
    NoArea,
    /// More points than fit into memory.
    #[error("about {count} points are asked for; at most {most} are drawn")]
    TooManySamples {
        /// So many, or more.
        count: usize,
        /// What is allowed.
        most: usize,
    },
    /// A number of a descriptor is NaN, infinite, or so large that sums of its square are.
    #[error("{argument}[{row}, {column}] is {value}; descriptors must be finite and below 1e15")]
    Descriptor {
        /// The array.
        argument: &'static str,
        /// First offending row.
        row: usize,
        /// Its first offending column.
        column: usize,
        /// The number.
        value: f32,
    },
    /// Descriptors of two kinds.
    #[error("src_feat has {src} columns and tgt_feat has {tgt}; they must be of one kind")]
    DimMismatch {
        /// Numbers of a row of the source.
        src: usize,
        /// Numbers of a row of the target.
        tgt: usize,
    },
    /// A number is out of its range.
    #[error("{argument} is {value}; it must be {allowed}")]
    Setting {
        /// The argument.
        argument: &'static str,
        /// The value given.
        value: f64,
        /// What is allowed.
        allowed: &'static str,
    },
    /// Voxels so small that they cannot be counted.
    #[error(
        "voxel is {voxel:e} and the points are {extent:e} across; at most {most} voxels fit along an axis"
    )]
    VoxelTooSmall {
        /// The width given.
        voxel: f64,
        /// The longest side of the bounding box.
        extent: f64,
        /// How many voxels are allowed along an axis.
        most: u64,
    },
    /// The caller's [`crate::Interrupt`] was set.
    #[error("interrupted")]
    Interrupted,
}
