//! The few lengths and cosines by which points agree.

/// When points agree; made once of the parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tolerances {
    /// `t_he` of Eq. 8, in pr: the largest residual of an inlier.
    pub t_he_pr: f64,
    /// `d_op` in pr: the largest distance of overlapping points.
    pub d_op_pr: f64,
    /// Least cosine between the normals of points that agree; `None`: normals do not count.
    pub min_normal_cos: Option<f64>,
    /// Whether normals are oriented, or are compared up to sign.
    pub oriented_normals: bool,
}
