//! What must hold for the score of any scene: invariances, bounds, agreement of its parts.

use super::strategies::{isometries, points, scenes};
use super::{Criterion, Matching, Model, PoseThresholds, SceneScore};
use crate::interrupt::Interrupt;
use nalgebra::Isometry3;
use proptest::prelude::*;
use std::f64::consts::PI;

const ECC: Criterion<'_> = Criterion::Pose(PoseThresholds { rotation_rad: PI / 9.0, translation: 0.5 });

fn score_scene(
    predicted: &[Isometry3<f64>],
    truth: &[Isometry3<f64>],
    matching: Matching,
    criterion: &Criterion<'_>,
) -> SceneScore {
    super::score_scene(predicted, truth, matching, criterion, &Interrupt::never()).unwrap()
}

/// (truth hit, predicted hit, recall, precision, F1).
fn summary(score: &SceneScore) -> (usize, usize, f64, f64, f64) {
    (score.num_truth_hit, score.num_predicted_hit, score.recall, score.precision, score.f1)
}

proptest! {
    #[test]
    fn does_not_change_when_the_scene_moves((predicted, truth) in scenes(), motion in isometries()) {
        let moved = |poses: &[Isometry3<f64>]| poses.iter().map(|pose| motion * pose).collect::<Vec<_>>();
        for matching in Matching::ALL {
            let here = score_scene(&predicted, &truth, matching, &ECC);
            let there = score_scene(&moved(&predicted), &moved(&truth), matching, &ECC);
            prop_assert_eq!(summary(&here), summary(&there));
        }
    }

    // The model's frame may be chosen freely only for ADD-S: translation errors depend on its origin.
    #[test]
    fn add_s_does_not_change_with_the_frame_of_the_model(
        (predicted, truth) in scenes(),
        cloud in points(3..20),
        motion in isometries(),
    ) {
        let reframed = cloud.iter().map(|p| motion.inverse() * p).collect();
        let (model, reframed) = (Model::new(cloud).unwrap(), Model::new(reframed).unwrap());
        let after = |poses: &[Isometry3<f64>]| poses.iter().map(|pose| pose * motion).collect::<Vec<_>>();
        for matching in Matching::ALL {
            let criterion = |model| Criterion::AddS { model, diameter_fraction: 0.1 };
            let here = score_scene(&predicted, &truth, matching, &criterion(&model));
            let there = score_scene(&after(&predicted), &after(&truth), matching, &criterion(&reframed));
            prop_assert_eq!(summary(&here), summary(&there));
        }
    }

    #[test]
    fn does_not_depend_on_the_order_of_predictions((predicted, truth) in scenes(), by in 0..8_usize) {
        let mut turned = predicted.clone();
        turned.rotate_left(by.min(predicted.len()));
        turned.reverse();
        for matching in Matching::ALL {
            let (a, b) = (
                score_scene(&predicted, &truth, matching, &ECC),
                score_scene(&turned, &truth, matching, &ECC),
            );
            prop_assert_eq!(summary(&a), summary(&b));
        }
    }

    #[test]
    fn repeating_the_predictions_costs_precision_only_one_to_one((predicted, truth) in scenes()) {
        let twice = [predicted.as_slice(), predicted.as_slice()].concat();
        let score = |poses: &[_], matching| score_scene(poses, &truth, matching, &ECC);
        let (once_any, twice_any) = (score(&predicted, Matching::Any), score(&twice, Matching::Any));
        prop_assert_eq!(once_any.num_truth_hit, twice_any.num_truth_hit);
        prop_assert_eq!(once_any.precision, twice_any.precision);
        let twice_strict = score(&twice, Matching::OneToOne);
        prop_assert!(twice_strict.num_predicted_hit <= truth.len());
    }

    #[test]
    fn any_is_never_below_one_to_one((predicted, truth) in scenes()) {
        let strict = score_scene(&predicted, &truth, Matching::OneToOne, &ECC);
        let lenient = score_scene(&predicted, &truth, Matching::Any, &ECC);
        prop_assert!(lenient.num_truth_hit >= strict.num_truth_hit);
        prop_assert!(lenient.num_predicted_hit >= strict.num_predicted_hit);
    }

    #[test]
    fn the_truth_scores_one(truth in prop::collection::vec(isometries(), 0..6)) {
        for matching in Matching::ALL {
            let score = score_scene(&truth, &truth, matching, &ECC);
            prop_assert_eq!((score.recall, score.precision, score.f1), (1.0, 1.0, 1.0));
            prop_assert_eq!(score.matches.len(), truth.len());
        }
    }

    #[test]
    fn counts_and_score_agree((predicted, truth) in scenes()) {
        for matching in Matching::ALL {
            let score = score_scene(&predicted, &truth, matching, &ECC);
            let counted = SceneScore::from_counts(
                matching, truth.len(), predicted.len(), score.num_truth_hit, score.num_predicted_hit,
            );
            prop_assert_eq!(counted.map(|c| summary(&c)), Ok(summary(&score)));
        }
    }
}
