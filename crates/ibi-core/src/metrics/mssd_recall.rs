//! MSSD recall, the score of the BOP challenge.

use super::scene_score::{distances, recall};
use super::{Matching, MetricsError, Model, assignment};
use crate::interrupt::{Interrupt, Phase};
use crate::symmetries::Symmetries;
use nalgebra::Isometry3;

/// The parts of the diameter at which MSSD recall is taken (Hodan et al., "BOP challenge 2020").
pub const MSSD_DIAMETER_FRACTIONS: [f64; 10] = [0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5];

/// MSSD recall of one scene, after the BOP challenge.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct MssdRecall {
    /// The recall at each of [`MSSD_DIAMETER_FRACTIONS`].
    pub recalls: [f64; 10],
    /// Their mean, BOP's average recall.
    pub average: f64,
}

/// The part of the true poses found with an MSSD below 0.05, 0.10 .. 0.50 of the model's diameter.
///
/// `symmetries` as in [`Model::mssd`]. One to one, predictions are assigned by MSSD before any threshold.
/// BOP instead lets predictions choose in the order of their confidence, which poses do not carry here.
///
/// # Complexity
///
/// One MSSD per pair, then as [`score_scene`](super::score_scene).
///
/// # Errors
///
/// [`MetricsError::Interrupted`].
///
/// # Examples
///
/// ```
/// use ibi_core::{Interrupt, Symmetries};
/// use ibi_core::metrics::{Matching, Model, mssd_recall};
/// use nalgebra::{Isometry3, Point3};
///
/// let model = Model::new(vec![Point3::new(-0.5, 0.0, 0.0), Point3::new(0.5, 0.0, 0.0)])?;
/// // Off by 0.22 of the diameter: missed at 0.05 .. 0.20, found at the six thresholds 0.25 .. 0.50.
/// let predicted = [Isometry3::translation(0.22, 0.0, 0.0)];
/// let (truth, none) = ([Isometry3::identity()], Symmetries::none());
/// let recall = mssd_recall(&model, &predicted, &truth, &none, Matching::OneToOne, &Interrupt::never())?;
/// assert!((recall.average - 0.6).abs() < 1e-12);
/// # Ok::<(), ibi_core::metrics::MetricsError>(())
/// ```
pub fn mssd_recall(
    model: &Model,
    predicted: &[Isometry3<f64>],
    truth: &[Isometry3<f64>],
    symmetries: &Symmetries,
    matching: Matching,
    interrupt: &Interrupt,
) -> Result<MssdRecall, MetricsError> {
    if !interrupt.enter(Phase::Metrics) {
        return Err(MetricsError::Interrupted);
    }
    let mssd = distances(predicted.len(), truth.len(), interrupt, |row, col| {
        model.mssd(&predicted[row], &truth[col], symmetries, interrupt)
    })?;
    let diameter = model.diameter(interrupt)?;
    // The error at which each truth is found, infinite if by nothing.
    let mut found_at = vec![f64::INFINITY; truth.len()];
    match matching {
        Matching::OneToOne => {
            for (row, partner) in
                assignment(&mssd, predicted.len(), truth.len(), interrupt)?.into_iter().enumerate()
            {
                if let Some(col) = partner {
                    found_at[col] = mssd[row * truth.len() + col];
                }
            }
        }
        Matching::Any => {
            for (pair, &error) in mssd.iter().enumerate() {
                let col = pair % truth.len();
                found_at[col] = found_at[col].min(error);
            }
        }
    }
    let recalls = MSSD_DIAMETER_FRACTIONS.map(|fraction| {
        let below = fraction * diameter;
        recall(found_at.iter().filter(|&&error| error < below).count(), truth.len())
    });
    Ok(MssdRecall { recalls, average: recalls.iter().sum::<f64>() / recalls.len() as f64 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Point3, Vector3};
    use std::f64::consts::PI;

    /// Along x, of diameter 1, so that a shift is its own MSSD as a part of the diameter.
    fn stick() -> Model {
        Model::new(vec![Point3::new(-0.5, 0.0, 0.0), Point3::new(0.5, 0.0, 0.0)]).unwrap()
    }

    fn mssd_recall(
        model: &Model,
        predicted: &[Isometry3<f64>],
        truth: &[Isometry3<f64>],
        symmetries: &Symmetries,
        matching: Matching,
    ) -> MssdRecall {
        super::mssd_recall(model, predicted, truth, symmetries, matching, &Interrupt::never()).unwrap()
    }

    fn at(x: f64) -> Isometry3<f64> {
        Isometry3::translation(x, 0.0, 0.0)
    }

    #[test]
    fn recall_rises_with_the_threshold() {
        // Errors 0.07, 0.42 and 3: found from 0.10 on (9 thresholds), from 0.45 on (2), never.
        // Recalls 0, then seven of 1/3, then two of 2/3: (7 + 2 * 2) / 3 / 10 = 11/30.
        let (predicted, truth) = ([at(0.07), at(10.42), at(23.0)], [at(0.0), at(10.0), at(20.0)]);
        for matching in Matching::ALL {
            let found = mssd_recall(&stick(), &predicted, &truth, &Symmetries::none(), matching);
            let thirds = found.recalls.map(|recall| (recall * 3.0).round());
            assert_eq!(thirds, [0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 2.0, 2.0]);
            assert!((found.average - 11.0 / 30.0).abs() < 1e-12);
        }
    }

    #[test]
    fn a_declared_symmetry_forgives_a_flip() {
        let flip = Isometry3::rotation(Vector3::z() * PI);
        let recall = |symmetries: &[_]| {
            let symmetries = &Symmetries::new(symmetries, &[]).unwrap();
            mssd_recall(&stick(), &[flip], &[Isometry3::identity()], symmetries, Matching::OneToOne).average
        };
        assert_eq!((recall(&[]), recall(&[flip])), (0.0, 1.0));
    }

    #[test]
    fn one_prediction_serves_two_truths_only_of_any() {
        // 0.201 and 0.099 from the truths. One to one it finds the nearer, from 0.10 on: nine halves of ten.
        let recall = |matching| {
            mssd_recall(&stick(), &[at(0.201)], &[at(0.0), at(0.3)], &Symmetries::none(), matching).average
        };
        assert!((recall(Matching::OneToOne) - 0.45).abs() < 1e-12);
        // Else the other too, from 0.25 on: six halves more.
        assert!((recall(Matching::Any) - 0.75).abs() < 1e-12);
    }

    #[test]
    fn where_there_is_nothing() {
        let model = stick();
        for matching in Matching::ALL {
            assert_eq!(mssd_recall(&model, &[], &[at(0.0)], &Symmetries::none(), matching).average, 0.0);
            assert_eq!(mssd_recall(&model, &[at(0.0)], &[], &Symmetries::none(), matching).average, 1.0);
        }
    }
}
