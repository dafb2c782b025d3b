//! Who waits for the end of a contest, and who was given up.

use nalgebra::Isometry3;

use crate::evidence::Proof;
use crate::params::Params;
use crate::registration::Rejected;
use crate::stages::Hypothesis;

/// Who competes, and since when.
#[derive(Debug, Default)]
pub(crate) struct Contest {
    pub(super) candidates: Vec<Candidate>,
    /// What passed, and failed when it was looked at closely: with each where it passed; what is told of is where that settled.
    pub(super) rejected: Vec<(Isometry3<f64>, Rejected)>,
    pub(super) num_rounds: u32,
}

/// A hypothesis that passed validation and waits for the end of the contest.
#[derive(Debug, Clone, Copy)]
pub(super) struct Candidate {
    pub(super) hypothesis: Hypothesis,
    pub(super) value: f64,
    pub(super) round: u32,
    /// How many instances had claimed their points when it was measured.
    pub(super) measured_at: u32,
    /// What a close look has found, if there was one.
    pub(super) proof: Option<Proof>,
}

impl Contest {
    /// Whether it has lasted long enough.
    pub(super) fn is_due(&self, params: &Params) -> bool {
        self.num_rounds >= params.n_contest
    }

    /// The row of the best candidate; of equals that of the earliest round.
    pub(super) fn best(&self) -> Option<usize> {
        let order = |a: &Candidate, b: &Candidate| a.value.total_cmp(&b.value).then(b.round.cmp(&a.round));
        self.candidates.iter().enumerate().max_by(|(_, a), (_, b)| order(a, b)).map(|(at, _)| at)
    }
}
