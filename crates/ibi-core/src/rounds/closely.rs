//! Looking at a hypothesis as closely as can be.

use super::stages::Stages;
use crate::evidence::Proof;
use crate::stages::{Context, Hypothesis, Verdict};

/// A hypothesis looked at as closely as can be.
pub(super) struct Looked {
    pub(super) hypothesis: Hypothesis,
    pub(super) verdict: Verdict,
    pub(super) proof: Option<Proof>,
}

impl Stages<'_> {
    /// The hypothesis settled and judged on all that was measured, and by the company it is in, or, where there is no more than the clouds,
    /// validated on those.
    pub(super) fn look_closely(
        &self,
        context: &Context<'_>,
        hypothesis: &Hypothesis,
        company: f64,
    ) -> Looked {
        if self.looks_closely()
            && let Some(proof) = context.proof(&hypothesis.target_from_source)
            && let proof = proof.among(company)
            && let Some(verdict) = self.verdict_of(&proof)
        {
            let hypothesis = Hypothesis { target_from_source: proof.target_from_source, ..*hypothesis };
            return Looked { hypothesis, verdict, proof: Some(proof) };
        }
        Looked { hypothesis: *hypothesis, verdict: self.hv.validate(context, hypothesis), proof: None }
    }

    pub(super) fn verdict_of(&self, proof: &Proof) -> Option<Verdict> {
        self.hv.verdict_of_closeup(proof.measures.log_odds(), proof.explained)
    }

    pub(super) fn looks_closely(&self) -> bool {
        self.hv.verdict_of_closeup(0.0, 0.0).is_some()
    }
}
