//! The mean score of a set of scenes.

use super::scene_score::harmonic_mean;
use super::{Matching, MetricsError, SceneScore};

/// Means over scenes. Fractions in \[0, 1\].
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct MeanScore {
    /// The family of these scores.
    pub matching: Matching,
    /// How many scenes were averaged, each with the same weight.
    pub num_scenes: usize,
    /// Mean hit recall: the mean of the scenes' recalls.
    pub mhr: f64,
    /// Mean hit precision: the mean of the scenes' precisions.
    pub mhp: f64,
    /// Mean hit F1: one to one the mean of the scenes' F1, else the harmonic mean of `mhr` and `mhp`.
    pub mhf1: f64,
}

/// The mean of the scores of several scenes of one family.
///
/// # Errors
///
/// [`MetricsError::NoScenes`] for an empty slice, [`MetricsError::MixedMatching`] if the scenes were not all
/// scored with the same matching.
///
/// # Examples
///
/// ```
/// use ibi_core::metrics::{Matching, SceneScore, mean_score};
///
/// // One perfect scene and one missed entirely: R, P and F1 are 1 and 0, whose means are all 0.5.
/// let found = SceneScore::from_counts(Matching::OneToOne, 2, 2, 2, 2)?;
/// let missed = SceneScore::from_counts(Matching::OneToOne, 3, 1, 0, 0)?;
/// let mean = mean_score(&[found, missed])?;
/// assert_eq!((mean.mhr, mean.mhp, mean.mhf1), (0.5, 0.5, 0.5));
/// # Ok::<(), ibi_core::metrics::MetricsError>(())
/// ```
pub fn mean_score(scenes: &[SceneScore]) -> Result<MeanScore, MetricsError> {
    let matching = scenes.first().ok_or(MetricsError::NoScenes)?.matching;
    if let Some((index, scene)) = scenes.iter().enumerate().find(|(_, scene)| scene.matching != matching) {
        return Err(MetricsError::MixedMatching { index, expected: matching, found: scene.matching });
    }
    let mean = |of: fn(&SceneScore) -> f64| scenes.iter().map(of).sum::<f64>() / scenes.len() as f64;
    let (mhr, mhp) = (mean(|scene| scene.recall), mean(|scene| scene.precision));
    let mhf1 = match matching {
        Matching::OneToOne => mean(|scene| scene.f1),
        Matching::Any => harmonic_mean(mhr, mhp),
    };
    Ok(MeanScore { matching, num_scenes: scenes.len(), mhr, mhp, mhf1 })
}

#[cfg(test)]
mod tests {
    use super::Matching::{Any, OneToOne};
    use super::*;

    fn scene(matching: Matching, counts: [usize; 4]) -> SceneScore {
        let [truth, predicted, truth_hit, predicted_hit] = counts;
        SceneScore::from_counts(matching, truth, predicted, truth_hit, predicted_hit).unwrap()
    }

    #[test]
    fn the_two_families_average_f1_differently() {
        // Scene 1: 1 of 4 found by 1 prediction: R 1/4, P 1, F1 2 * 1 / (4 + 1) = 2/5.
        // Scene 2: 2 of 2 found among 4 predictions: R 1, P 1/2, F1 2 * 2 / (2 + 4) = 2/3.
        // MHR = (1/4 + 1) / 2 = 5/8, MHP = (1 + 1/2) / 2 = 3/4.
        let counts = [[4, 1, 1, 1], [2, 4, 2, 2]];
        let one_to_one = mean_score(&counts.map(|c| scene(OneToOne, c))).unwrap();
        let any = mean_score(&counts.map(|c| scene(Any, c))).unwrap();
        assert_eq!((one_to_one.mhr, one_to_one.mhp, one_to_one.num_scenes), (0.625, 0.75, 2));
        assert_eq!((any.mhr, any.mhp, any.num_scenes), (0.625, 0.75, 2));
        // (2/5 + 2/3) / 2 = 8/15 against 2 * 5/8 * 3/4 / (5/8 + 3/4) = (15/16) / (11/8) = 15/22.
        assert!((one_to_one.mhf1 - 8.0 / 15.0).abs() < 1e-15);
        assert!((any.mhf1 - 15.0 / 22.0).abs() < 1e-15);
    }

    #[test]
    fn a_scene_with_no_prediction_counts_as_zero() {
        let scenes = [scene(OneToOne, [2, 2, 2, 2]), scene(OneToOne, [5, 0, 0, 0])];
        let mean = mean_score(&scenes).unwrap();
        assert_eq!((mean.mhr, mean.mhp, mean.mhf1), (0.5, 0.5, 0.5));
        let mean = mean_score(&[scene(Any, [5, 0, 0, 0])]).unwrap();
        assert_eq!((mean.mhr, mean.mhp, mean.mhf1), (0.0, 0.0, 0.0));
    }

    #[test]
    fn no_mean_of_nothing_or_of_both_families() {
        assert_eq!(mean_score(&[]), Err(MetricsError::NoScenes));
        let mixed = [scene(Any, [1, 1, 1, 1]), scene(Any, [1, 1, 1, 1]), scene(OneToOne, [1, 1, 1, 1])];
        let error = mean_score(&mixed).unwrap_err();
        assert_eq!(error, MetricsError::MixedMatching { index: 2, expected: Any, found: OneToOne });
        assert_eq!(error.to_string(), "scene 2 is scored with one_to_one, the scenes before it with any");
    }
}
