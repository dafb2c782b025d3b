//! The score of one scene.

use super::{Criterion, Matching, MetricsError, assignment, rotation_error_rad, translation_error};
use crate::interrupt::{Interrupt, Phase};
use crate::kernels::par;
use crate::pace::Pace;
use crate::symmetries::Symmetries;
use nalgebra::Isometry3;

/// The truth a prediction is held against.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct PoseMatch {
    /// Row of the truth.
    pub truth: usize,
    /// Rotation error, rad.
    pub rotation_error_rad: f64,
    /// Translation error, in the unit of the data.
    pub translation_error: f64,
    /// What the matching went by: the Frobenius distance, or ADD-S where that is the criterion.
    pub distance: f64,
    /// Whether the criterion is met.
    pub is_hit: bool,
}

/// How well the poses of one scene were found. Rates are fractions in \[0, 1\].
///
/// With K true and M predicted poses, recall is the true poses hit over K, precision the predictions that
/// hit over M, F1 their harmonic mean. What would be 0/0:
///
/// | | recall | precision | F1 |
/// |---|---|---|---|
/// | K > 0, M = 0: everything missed | 0 | 0 | 0 |
/// | K = 0, M > 0: nothing to miss, everything wrong | 1 | 0 | 0 |
/// | K = 0, M = 0: rightly silent | 1 | 1 | 1 |
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct SceneScore {
    /// The family of this score.
    pub matching: Matching,
    /// K.
    pub num_truth: usize,
    /// M.
    pub num_predicted: usize,
    /// True poses that some prediction hits.
    pub num_truth_hit: usize,
    /// Predictions that hit; one to one the same number.
    pub num_predicted_hit: usize,
    /// Found of what is there.
    pub recall: f64,
    /// Right of what was said.
    pub precision: f64,
    /// Their harmonic mean, 0 if either is 0.
    pub f1: f64,
    /// For each prediction the truth it is held against: one to one its assigned truth, `None` if left
    /// over; else the nearest truth it hits, or the nearest of all if it hits none, `None` only if K = 0.
    pub matches: Vec<Option<PoseMatch>>,
}

impl SceneScore {
    /// The score that follows from counts alone, with no list of matches.
    ///
    /// # Errors
    ///
    /// [`MetricsError::ImpossibleCounts`] if more poses hit than there are, if only one side has hits, or
    /// if, one to one, the two sides differ.
    ///
    /// # Examples
    ///
    /// ```
    /// use ibi_core::metrics::{Matching, SceneScore};
    ///
    /// // 4 instances, 5 predictions of which 2 hit: 2/4, 2/5, and 2 * 2 / (4 + 5).
    /// let score = SceneScore::from_counts(Matching::OneToOne, 4, 5, 2, 2)?;
    /// assert_eq!((score.recall, score.precision), (0.5, 0.4));
    /// assert!((score.f1 - 4.0 / 9.0).abs() < 1e-15);
    /// # Ok::<(), ibi_core::metrics::MetricsError>(())
    /// ```
    pub fn from_counts(
        matching: Matching,
        num_truth: usize,
        num_predicted: usize,
        num_truth_hit: usize,
        num_predicted_hit: usize,
    ) -> Result<Self, MetricsError> {
        let possible = num_truth_hit <= num_truth
            && num_predicted_hit <= num_predicted
            && (num_truth_hit == 0) == (num_predicted_hit == 0)
            && (matching == Matching::Any || num_truth_hit == num_predicted_hit);
        if !possible {
            return Err(MetricsError::ImpossibleCounts);
        }
        Ok(Self::new(matching, num_truth, num_predicted, num_truth_hit, num_predicted_hit))
    }

    fn new(
        matching: Matching,
        num_truth: usize,
        num_predicted: usize,
        num_truth_hit: usize,
        num_predicted_hit: usize,
    ) -> Self {
        let recall = recall(num_truth_hit, num_truth);
        let precision = match (num_predicted, num_truth) {
            (0, 0) => 1.0,
            (0, _) => 0.0,
            _ => num_predicted_hit as f64 / num_predicted as f64,
        };
        let f1 = harmonic_mean(recall, precision);
        let matches = Vec::new();
        Self {
            matching,
            num_truth,
            num_predicted,
            num_truth_hit,
            num_predicted_hit,
            recall,
            precision,
            f1,
            matches,
        }
    }
}

/// Scores the poses predicted for one scene against the true ones.
///
/// # Complexity
///
/// One distance per pair (for ADD-S, n questions to a tree each), then one to one an assignment,
/// O(min^2 max) in the two numbers of poses.
///
/// # Errors
///
/// [`MetricsError::Interrupted`].
///
/// # Examples
///
/// See the [module](super).
pub fn score_scene(
    predicted: &[Isometry3<f64>],
    truth: &[Isometry3<f64>],
    matching: Matching,
    criterion: &Criterion<'_>,
    interrupt: &Interrupt,
) -> Result<SceneScore, MetricsError> {
    score_scene_modulo(predicted, truth, matching, criterion, &Symmetries::none(), interrupt)
}

/// [`score_scene`] of a model that looks the same from several sides: against each truth a prediction counts as the pose
/// nearest to it of those that look like it ([`Symmetries::nearest`]). ADD-S sees to this by itself: of it only the
/// errors of the [`PoseMatch`] change.
///
/// # Errors
///
/// [`MetricsError::Interrupted`].
pub fn score_scene_modulo(
    predicted: &[Isometry3<f64>],
    truth: &[Isometry3<f64>],
    matching: Matching,
    criterion: &Criterion<'_>,
    symmetries: &Symmetries,
    interrupt: &Interrupt,
) -> Result<SceneScore, MetricsError> {
    if !interrupt.enter(Phase::Metrics) {
        return Err(MetricsError::Interrupted);
    }
    let seen = |row: usize, col: usize| match criterion {
        Criterion::AddS { .. } => predicted[row],
        Criterion::Pose(_) => symmetries.nearest(&predicted[row], &truth[col]),
    };
    let distance = distances(predicted.len(), truth.len(), interrupt, |row, col| {
        criterion.distance(&seen(row, col), &truth[col], interrupt)
    })?;
    let reach = if distance.is_empty() { 0.0 } else { criterion.reach(interrupt)? };
    let is_hit = |row: usize, col: usize| {
        criterion.is_hit(&seen(row, col), &truth[col], distance[row * truth.len() + col], reach)
    };
    let partners: Vec<Option<usize>> = match matching {
        Matching::OneToOne => assignment(&distance, predicted.len(), truth.len(), interrupt)?,
        Matching::Any => {
            let key = |row: usize, col: usize| (!is_hit(row, col), distance[row * truth.len() + col]);
            let nearer = |row: usize, a: usize, b: usize| {
                let ((a_misses, a_distance), (b_misses, b_distance)) = (key(row, a), key(row, b));
                a_misses.cmp(&b_misses).then(a_distance.total_cmp(&b_distance))
            };
            let nearest = |row: usize| {
                let is_asked = !interrupt.is_set();
                (0..truth.len()).filter(|_| is_asked).min_by(|&a, &b| nearer(row, a, b))
            };
            par::map(predicted.len(), 1, nearest)
        }
    };
    let matches: Vec<Option<PoseMatch>> = partners
        .iter()
        .enumerate()
        .map(|(row, partner)| {
            partner.map(|col| {
                let nearest = symmetries.nearest(&predicted[row], &truth[col]);
                PoseMatch {
                    truth: col,
                    rotation_error_rad: rotation_error_rad(&nearest, &truth[col]),
                    translation_error: translation_error(&nearest, &truth[col]),
                    distance: distance[row * truth.len() + col],
                    is_hit: is_hit(row, col),
                }
            })
        })
        .collect();

    if interrupt.is_set() {
        return Err(MetricsError::Interrupted);
    }
    let num_predicted_hit = matches.iter().flatten().filter(|m| m.is_hit).count();
    let num_truth_hit = match matching {
        Matching::OneToOne => num_predicted_hit,
        // Not from the list: one prediction may hit several truths, of which it names the nearest.
        Matching::Any => {
            let mut pace = Pace::new(interrupt);
            let mut is_found = |col: usize| {
                !pace.is_over(PAIR * predicted.len()) && (0..predicted.len()).any(|row| is_hit(row, col))
            };
            (0..truth.len()).filter(|&col| is_found(col)).count()
        }
    };
    if interrupt.is_set() {
        return Err(MetricsError::Interrupted);
    }
    let score = SceneScore::new(matching, truth.len(), predicted.len(), num_truth_hit, num_predicted_hit);
    Ok(SceneScore { matches, ..score })
}

/// The work of one pair, in the units of [`Pace`].
const PAIR: usize = 16;

/// Row-major, one row per prediction: `distance(row, column)`.
pub(super) fn distances(
    rows: usize,
    cols: usize,
    interrupt: &Interrupt,
    distance: impl Fn(usize, usize) -> Result<f64, MetricsError> + Sync + Send,
) -> Result<Vec<f64>, MetricsError> {
    let rows = par::map(rows, 1, |row| {
        let mut pace = Pace::new(interrupt);
        let each = |col| if pace.is_over(PAIR) { Err(MetricsError::Interrupted) } else { distance(row, col) };
        (0..cols).map(each).collect::<Result<Vec<f64>, _>>()
    });
    Ok(rows.into_iter().collect::<Result<Vec<_>, _>>()?.concat())
}

/// 1 where there was nothing to find.
pub(super) fn recall(num_hit: usize, num_truth: usize) -> f64 {
    if num_truth == 0 { 1.0 } else { num_hit as f64 / num_truth as f64 }
}

pub(super) fn harmonic_mean(a: f64, b: f64) -> f64 {
    if a + b > 0.0 { 2.0 * a * b / (a + b) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::super::{Model, PoseThresholds};
    use super::*;
    use nalgebra::{Point3, Vector3};
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

    fn at(x: f64) -> Isometry3<f64> {
        Isometry3::translation(x, 0.0, 0.0)
    }

    /// (truth hit, predicted hit, recall, precision, F1).
    fn summary(score: &SceneScore) -> (usize, usize, f64, f64, f64) {
        (score.num_truth_hit, score.num_predicted_hit, score.recall, score.precision, score.f1)
    }

    fn partners(score: &SceneScore) -> Vec<Option<usize>> {
        score.matches.iter().map(|m| m.map(|m| m.truth)).collect()
    }

    #[test]
    fn duplicates_are_false_positives_or_free() {
        // Truth at 0 and 10; 0 is found three times, 10 never.
        let (predicted, truth) = ([at(0.2), at(0.1), at(0.3)], [at(0.0), at(10.0)]);
        // Assigned: two of the three, of least sum. 0.1 -> 0 with 0.3 -> 10 is 0.1 + 9.7 = 9.8, with
        // 0.2 -> 10 it is 9.9; 0.2 -> 0 with 0.3 -> 10 is 9.9. R = 1/2, P = 1/3, F1 = 2 * 1 / (2 + 3).
        let strict = score_scene(&predicted, &truth, Matching::OneToOne, &ECC);
        assert_eq!(partners(&strict), [None, Some(0), Some(1)]);
        assert_eq!(summary(&strict), (1, 1, 0.5, 1.0 / 3.0, 0.4));
        // R = 1/2, P = 3/3, F1 = 2 * 0.5 / 1.5.
        let lenient = score_scene(&predicted, &truth, Matching::Any, &ECC);
        assert_eq!(partners(&lenient), [Some(0); 3]);
        assert_eq!(summary(&lenient), (1, 3, 0.5, 1.0, 1.0 / 1.5));
    }

    #[test]
    fn pairs_are_assigned_before_the_threshold() {
        // Truth at 0 and 1. The prediction at 0.4 hits 0, and 1 is out of its reach (0.6 >= 0.5); the one at
        // -0.6 hits nothing. But 0.4 -> 0 with -0.6 -> 1 costs 0.4 + 1.6 = 2.0, and 0.4 -> 1 with -0.6 -> 0
        // only 0.6 + 0.6 = 1.2: the hit is assigned away. That is the metric, not a fault in it.
        let (predicted, truth) = ([at(0.4), at(-0.6)], [at(0.0), at(1.0)]);
        let strict = score_scene(&predicted, &truth, Matching::OneToOne, &ECC);
        assert_eq!(partners(&strict), [Some(1), Some(0)]);
        assert_eq!(summary(&strict), (0, 0, 0.0, 0.0, 0.0));
        let lenient = score_scene(&predicted, &truth, Matching::Any, &ECC);
        assert_eq!(summary(&lenient), (1, 1, 0.5, 0.5, 0.5));
    }

    #[test]
    fn thresholds_are_strict_and_both_count() {
        let truth = [Isometry3::identity()];
        let is_hit = |predicted: Isometry3<f64>| {
            score_scene(&[predicted], &truth, Matching::OneToOne, &ECC).num_truth_hit == 1
        };
        assert!(is_hit(at(0.499)) && !is_hit(at(0.5)));
        let turned = |deg: f64| Isometry3::rotation(Vector3::y() * deg.to_radians());
        assert!(is_hit(turned(19.99)) && !is_hit(turned(20.01)));
        assert!(!is_hit(at(0.6) * turned(1.0)) && !is_hit(at(0.1) * turned(21.0)));
    }

    #[test]
    fn one_prediction_can_hit_several_truths_of_any() {
        // 0.3 apart, both within 0.5 of the prediction, which names the nearer, at 0.1.
        let score = score_scene(&[at(0.2)], &[at(0.0), at(0.3)], Matching::Any, &ECC);
        assert_eq!(summary(&score), (2, 1, 1.0, 1.0, 1.0));
        assert_eq!(partners(&score), [Some(1)]);
    }

    #[test]
    fn a_truth_that_is_hit_comes_before_a_nearer_one_that_is_not() {
        // Frobenius distances: 25 deg off in place is sqrt(8) sin(12.5 deg) = 0.612, no hit. 19 deg off and
        // 0.45 away is sqrt(8 sin^2(9.5 deg) + 0.2025) = 0.6485, a hit though farther.
        let turned = |deg: f64| Isometry3::rotation(Vector3::z() * deg.to_radians());
        let truth = [turned(25.0), at(0.45) * turned(19.0)];
        let score = score_scene(&[Isometry3::identity()], &truth, Matching::Any, &ECC);
        let found = score.matches[0].unwrap();
        assert!(found.is_hit && found.truth == 1);
        assert!((found.rotation_error_rad.to_degrees() - 19.0).abs() < 1e-12);
        assert!((found.translation_error - 0.45).abs() < 1e-15);
        assert!((found.distance - 0.6485).abs() < 1e-4);
        // One to one goes by the distance alone.
        let strict = score_scene(&[Isometry3::identity()], &truth, Matching::OneToOne, &ECC);
        assert_eq!((partners(&strict), strict.num_truth_hit), (vec![Some(0)], 0));
    }

    #[test]
    fn where_there_is_nothing() {
        for matching in Matching::ALL {
            let score = |predicted: &[_], truth: &[_]| score_scene(predicted, truth, matching, &ECC);
            assert_eq!(summary(&score(&[], &[at(0.0)])), (0, 0, 0.0, 0.0, 0.0));
            assert_eq!(summary(&score(&[at(0.0)], &[])), (0, 0, 1.0, 0.0, 0.0));
            assert_eq!(summary(&score(&[], &[])), (0, 0, 1.0, 1.0, 1.0));
            assert_eq!(score(&[at(0.0)], &[]).matches, [None]);
        }
    }

    #[test]
    fn a_symmetric_part_is_found_by_add_s_only() {
        // A stick from -1 to 1, flipped: every pose error is at its worst, and nobody could tell.
        let stick = Model::new(vec![Point3::new(-1.0, 0.0, 0.0), Point3::new(1.0, 0.0, 0.0)]).unwrap();
        let add_s = Criterion::AddS { model: &stick, diameter_fraction: 0.1 };
        let (predicted, truth) = ([at(5.0) * Isometry3::rotation(Vector3::z() * PI)], [at(5.0)]);
        for matching in Matching::ALL {
            assert_eq!(summary(&score_scene(&predicted, &truth, matching, &ECC)), (0, 0, 0.0, 0.0, 0.0));
            assert_eq!(summary(&score_scene(&predicted, &truth, matching, &add_s)), (1, 1, 1.0, 1.0, 1.0));
            // 0.1 of the diameter 2 is 0.2: sideways, both ends are off by the shift.
            let shifted = |y: f64| [Isometry3::translation(5.0, y, 0.0)];
            assert_eq!(score_scene(&shifted(0.19), &truth, matching, &add_s).num_truth_hit, 1);
            assert_eq!(score_scene(&shifted(0.21), &truth, matching, &add_s).num_truth_hit, 0);
        }
    }

    #[test]
    fn counts_must_fit() {
        use Matching::{Any, OneToOne};
        for (matching, k, m, k_hit, m_hit) in [
            (OneToOne, 1, 2, 2, 2),
            (Any, 2, 1, 2, 2),
            (OneToOne, 3, 3, 2, 1),
            (Any, 3, 3, 2, 0),
            (Any, 3, 3, 0, 1),
        ] {
            let score = SceneScore::from_counts(matching, k, m, k_hit, m_hit);
            assert_eq!(score, Err(MetricsError::ImpossibleCounts));
        }
        assert!(SceneScore::from_counts(Any, 3, 3, 2, 1).is_ok());
    }
}
