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
    /// What passed, and failed when it was looked at closely.
    pub(super) given_up: Vec<GivenUp>,
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

/// A candidate that failed when it was looked at closely.
#[derive(Debug, Clone, Copy)]
pub(super) struct GivenUp {
    /// Where it passed validation.
    pub(super) passed: Isometry3<f64>,
    /// Where it settled.
    pub(super) candidate: Candidate,
    pub(super) proof: Proof,
    /// Whether it was taken up again, since others of its kind were found.
    pub(super) is_recalled: bool,
}

impl GivenUp {
    /// What is told of it, among all that was found; nothing if it was taken up again.
    pub(super) fn told(&self, company: f64) -> Option<Rejected> {
        let measures = self.proof.among(company).measures;
        (!self.is_recalled).then(|| Rejected {
            target_from_source: self.candidate.hypothesis.target_from_source,
            score: measures.score(),
            objection: measures.objection(),
            measures: Some(measures),
            round: self.candidate.round,
        })
    }
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
