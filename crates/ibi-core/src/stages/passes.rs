//! What passes between the stages.

use nalgebra::Isometry3;

/// Correspondences with a score each (finite, >= 0), best first, ties by the lower id.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Ranked {
    ids: Vec<u32>,
    scores: Vec<f32>,
}

impl Ranked {
    /// Ranks `(id, score)` pairs; the ids must differ.
    #[must_use]
    pub fn new(scored: Vec<(u32, f32)>) -> Self {
        Self::best_of(scored, usize::MAX)
    }

    /// Ranks the best `n` of `(id, score)` pairs; the ids must differ.
    #[must_use]
    pub fn best_of(mut scored: Vec<(u32, f32)>, n: usize) -> Self {
        let order = |a: &(u32, f32), b: &(u32, f32)| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0));
        if n < scored.len() {
            scored.select_nth_unstable_by(n, order);
            scored.truncate(n);
        }
        scored.sort_unstable_by(order);
        let (ids, scores) = scored.into_iter().unzip();
        Self { ids, scores }
    }

    /// The ids, best first.
    #[must_use]
    pub fn ids(&self) -> &[u32] {
        &self.ids
    }

    /// The scores, in the order of [`Self::ids`].
    #[must_use]
    pub fn scores(&self) -> &[f32] {
        &self.scores
    }

    /// How many there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }
}

/// A pose that was estimated but not validated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hypothesis {
    /// Moves source points onto the target; data units.
    pub target_from_source: Isometry3<f64>,
    /// What its stage ranked it by; MAE (Eq. 7-8) in every variant here.
    pub score: f64,
}

/// What a transformation estimation came to.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Estimate {
    /// The best hypothesis; `None` if every sample was degenerate.
    pub hypothesis: Option<Hypothesis>,
    /// Samples drawn.
    pub num_samples: u32,
    /// Samples skipped because their points were too near to one line.
    pub num_degenerate: u32,
    /// Whether a limit of the stage ended its search early: there may be better samples than those tried.
    pub capped: bool,
}

/// A measured value against its threshold.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct Verdict {
    /// What was measured.
    pub value: f64,
    /// What it must exceed.
    pub threshold: f64,
}

impl Verdict {
    /// Accepted exactly if the value exceeds the threshold.
    #[must_use]
    pub fn accepted(&self) -> bool {
        self.value > self.threshold
    }
}
