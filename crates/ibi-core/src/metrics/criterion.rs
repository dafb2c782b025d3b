//! What counts as a hit, and among which pairs.

use super::{MetricsError, Model, frobenius_distance, rotation_error_rad, translation_error};
use crate::interrupt::Interrupt;
use nalgebra::Isometry3;
use std::fmt;

/// The part of the diameter below which an ADD-S counts as a hit (Hinterstoisser et al., ACCV 2012).
pub const ADD_S_DIAMETER_FRACTION: f64 = 0.1;

/// Which pairs of prediction and truth are asked for a hit. Scores of the two families do not compare.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "snake_case"))]
pub enum Matching {
    /// Each prediction with at most one truth and the other way round, by the assignment of least total
    /// distance *before* any threshold (ECC, IBI). A duplicate is a false positive, and a prediction that is
    /// assigned elsewhere for the sake of the total is lost even if it would have hit.
    OneToOne,
    /// Every prediction with every truth: a truth counts once hit, a prediction once it hits, duplicates
    /// are free (`PointCLM`, MIRETR, 3DFMNet).
    Any,
}

impl Matching {
    /// Every variant.
    pub const ALL: [Self; 2] = [Self::OneToOne, Self::Any];

    /// Its name in Python, in files and in tables.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::OneToOne => "one_to_one",
            Self::Any => "any",
        }
    }
}

impl fmt::Display for Matching {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A pose hits if both its errors are *below* these.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct PoseThresholds {
    /// Upper bound of the rotation error, rad.
    pub rotation_rad: f64,
    /// Upper bound of the translation error, in the unit of the data.
    pub translation: f64,
}

impl PoseThresholds {
    fn from_deg(rotation_deg: f64, translation: f64) -> Self {
        Self { rotation_rad: rotation_deg.to_radians(), translation }
    }

    /// 20 deg and 0.5 data units: model radii on unit-sphere models, metres on scans. ECC (Tang & Zou,
    /// "Multi-instance point cloud registration by efficient correspondence clustering", CVPR 2022) and IBI.
    #[must_use]
    pub fn ecc() -> Self {
        Self::from_deg(20.0, 0.5)
    }

    /// 15 deg and 0.1 m, on real scans in metres. `PointCLM` (Yuan et al., ECCV 2022).
    #[must_use]
    pub fn pointclm_scan() -> Self {
        Self::from_deg(15.0, 0.1)
    }

    /// 15 deg and 4 voxels of the size the clouds were downsampled to. `PointCLM` and after it MIRETR.
    #[must_use]
    pub fn pointclm_voxels(voxel: f64) -> Self {
        Self::from_deg(15.0, 4.0 * voxel)
    }

    /// 5 deg and one point resolution: whether a pose can be used as it is. Ours, from no paper.
    #[must_use]
    pub fn strict(resolution: f64) -> Self {
        Self::from_deg(5.0, resolution)
    }
}

/// What makes a pair of prediction and truth a hit.
#[derive(Debug, Clone, Copy)]
pub enum Criterion<'m> {
    /// Rotation and translation error below thresholds. Pairs are assigned by [`frobenius_distance`].
    Pose(PoseThresholds),
    /// ADD-S below a part of the diameter, for parts with symmetry. Pairs are assigned by ADD-S.
    AddS {
        /// The model the poses are of.
        model: &'m Model,
        /// The part of its diameter, by custom [`ADD_S_DIAMETER_FRACTION`].
        diameter_fraction: f64,
    },
}

impl Criterion<'_> {
    /// How far apart a pair is: what the assignment minimises the sum of.
    pub(super) fn distance(
        &self,
        predicted: &Isometry3<f64>,
        truth: &Isometry3<f64>,
        interrupt: &Interrupt,
    ) -> Result<f64, MetricsError> {
        match self {
            Self::Pose(_) => Ok(frobenius_distance(predicted, truth)),
            Self::AddS { model, .. } => model.add_s(predicted, truth, interrupt),
        }
    }

    /// The distance below which a pair may be a hit; infinite where more than the distance is asked.
    pub(super) fn reach(&self, interrupt: &Interrupt) -> Result<f64, MetricsError> {
        match self {
            Self::Pose(_) => Ok(f64::INFINITY),
            Self::AddS { model, diameter_fraction } => Ok(diameter_fraction * model.diameter(interrupt)?),
        }
    }

    /// Whether a pair is a hit, its distance and [`Self::reach`] being known.
    pub(super) fn is_hit(
        &self,
        predicted: &Isometry3<f64>,
        truth: &Isometry3<f64>,
        distance: f64,
        reach: f64,
    ) -> bool {
        match self {
            Self::Pose(below) => {
                rotation_error_rad(predicted, truth) < below.rotation_rad
                    && translation_error(predicted, truth) < below.translation
            }
            Self::AddS { .. } => distance < reach,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thresholds_are_those_of_the_papers() {
        let deg_and_translation = |t: PoseThresholds| (t.rotation_rad.to_degrees().round(), t.translation);
        assert_eq!(deg_and_translation(PoseThresholds::ecc()), (20.0, 0.5));
        assert_eq!(deg_and_translation(PoseThresholds::pointclm_scan()), (15.0, 0.1));
        assert_eq!(deg_and_translation(PoseThresholds::pointclm_voxels(0.25)), (15.0, 1.0));
        assert_eq!(deg_and_translation(PoseThresholds::strict(0.02)), (5.0, 0.02));
    }

    #[test]
    fn names_are_distinct() {
        assert_eq!(Matching::ALL.map(Matching::name), ["one_to_one", "any"]);
    }
}
