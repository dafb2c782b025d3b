//! How good a set of predicted poses is: pose errors, one-to-one assignment, and the scores of the field.
//!
//! Two families of scores are in use and their numbers cannot be compared, so each result carries its
//! [`Matching`] and [`mean_score`] refuses to mix them:
//!
//! | | [`Matching::OneToOne`] | [`Matching::Any`] |
//! |---|---|---|
//! | used by | ECC, IBI | `PointCLM`, MIRETR, 3DFMNet |
//! | pairs | one optimal assignment, *before* any threshold | every prediction with every truth |
//! | duplicates | false positives | free |
//! | MHF1 | mean of the scenes' F1 | harmonic mean of MHR and MHP |
//!
//! A pose is an [`Isometry3`](nalgebra::Isometry3) and reads `target_from_source`: it moves the model into
//! the scene. Poses and points are finite by contract; nothing here looks for NaN again.
//! What can take long takes an [`Interrupt`], and runs on the pool that it is called in.
//!
//! # Examples
//!
//! ```
//! use ibi_core::Interrupt;
//! use ibi_core::metrics::{Criterion, Matching, PoseThresholds, score_scene};
//! use nalgebra::Isometry3;
//!
//! let truth = [Isometry3::translation(0.0, 0.0, 0.0), Isometry3::translation(5.0, 0.0, 0.0)];
//! let predicted = [Isometry3::translation(0.1, 0.0, 0.0), Isometry3::translation(0.2, 0.0, 0.0)];
//! let never = Interrupt::never();
//! let ecc = Criterion::Pose(PoseThresholds::ecc());
//!
//! // The second prediction repeats the first: a false positive here ...
//! let strict = score_scene(&predicted, &truth, Matching::OneToOne, &ecc, &never)?;
//! assert_eq!((strict.recall, strict.precision), (0.5, 0.5));
//! // ... and free here.
//! let lenient = score_scene(&predicted, &truth, Matching::Any, &ecc, &never)?;
//! assert_eq!((lenient.recall, lenient.precision), (0.5, 1.0));
//! # Ok::<(), ibi_core::metrics::MetricsError>(())
//! ```

#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::float_cmp, reason = "tests may panic, and compare what is exact")
)]

mod assignment;
mod criterion;
#[cfg(test)]
mod laws;
mod mean_score;
mod model;
mod mssd_recall;
mod pose_error;
mod scene_score;
#[cfg(test)]
pub(crate) mod strategies;

use nalgebra::Point3;

use crate::interrupt::Interrupt;

pub use assignment::assignment;
pub use criterion::{ADD_S_DIAMETER_FRACTION, Criterion, Matching, PoseThresholds};
pub use mean_score::{MeanScore, mean_score};
pub use model::Model;
pub use mssd_recall::{MSSD_DIAMETER_FRACTIONS, MssdRecall, mssd_recall};
pub use pose_error::{frobenius_distance, rotation_error_rad, translation_error};
pub use scene_score::{PoseMatch, SceneScore, score_scene, score_scene_modulo};

/// The largest distance between two points of a cloud; 0 for fewer than two points. Exact but for 1e-14 of it where very many
/// points are about equally far from the middle.
///
/// The unit in which ADD-S and MSSD thresholds are given.
///
/// # Errors
/// [`MetricsError::Interrupted`].
///
/// # Examples
/// ```
/// use ibi_core::Interrupt;
/// use ibi_core::metrics::diameter;
/// use nalgebra::Point3;
///
/// let box_corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 2.0, 0.0], [1.0, 2.0, 2.0]].map(Point3::from);
/// assert_eq!(diameter(&box_corners, &Interrupt::never())?, 3.0);
/// # Ok::<(), ibi_core::metrics::MetricsError>(())
/// ```
pub fn diameter(points: &[Point3<f64>], interrupt: &Interrupt) -> Result<f64, MetricsError> {
    crate::kernels::diameter::diameter(points, interrupt).ok_or(MetricsError::Interrupted)
}

/// Why a metric has no value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum MetricsError {
    /// A model needs at least one point: a mean or a maximum over none has no value.
    #[error("the model has no points")]
    EmptyModel,
    /// A coordinate of a model point is NaN, infinite or beyond 1e150, where squares of distances end.
    #[error("model point {index} is not finite, or beyond 1e150")]
    NonFinitePoint {
        /// Row of the first such point.
        index: usize,
    },
    /// A mean over no scenes has no value.
    #[error("no scenes to average")]
    NoScenes,
    /// Scores of the two families have no common mean.
    #[error("scene {index} is scored with {found}, the scenes before it with {expected}")]
    MixedMatching {
        /// Row of the first scene that differs from scene 0.
        index: usize,
        /// The matching of scene 0.
        expected: Matching,
        /// The matching of scene `index`.
        found: Matching,
    },
    /// The caller's token or clock has ended it.
    #[error("interrupted")]
    Interrupted,
    /// The hits do not fit the poses they are counted among, or, one to one, each other.
    #[error("more hits than poses, or hits that do not come in pairs")]
    ImpossibleCounts,
}
