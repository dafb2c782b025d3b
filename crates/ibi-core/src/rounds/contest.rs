//! The contest: a pose that passed validation waits for better ones of the same instance before it becomes one.

use std::time::Instant;

use nalgebra::Isometry3;

use super::candidates::{Candidate, Contest, GivenUp};
use super::closely::Looked;
use super::judge::Judged;
use super::memory::Tried;
use super::stages::Stages;
use super::state::State;
use crate::grace::Grace;
use crate::interrupt::Phase;
use crate::params::Removal;
use crate::stages::Verdict;

/// A close look is worth so many others: it tries some tens of poses.
const PROOF_LOOKS: usize = 64;

/// A contest accepts nothing below this share of its best value.
const MARGIN: f64 = 0.8;

impl State<'_> {
    /// Enters the pose of the round just booked, if it passed. Of two that are the same pose the better one stays; only one
    /// that is new counts as a success.
    pub(super) fn enter_contest(&mut self, stages: &Stages<'_>, passed: Option<Judged>) {
        self.contest.num_rounds += 1;
        let Some(Judged { hypothesis, verdict }) = passed else { return };
        let (round, measured_at) = (self.num_rounds() - 1, self.num_found());
        let candidate = Candidate { hypothesis, value: verdict.value, round, measured_at, proof: None };
        let scene = &self.problem.scene;
        let same = 2.0 * scene.tolerances.t_he_pr * scene.resolution;
        let is_same = |other: &Isometry3<f64>| {
            scene.source.displacement(&candidate.hypothesis.target_from_source, other) < same
        };
        if self.contest.given_up.iter().any(|given_up| is_same(&given_up.passed)) {
            return;
        }
        let mut before = self.contest.candidates.iter_mut();
        match before.find(|other| is_same(&other.hypothesis.target_from_source)) {
            // What was looked at closely is better known.
            Some(other) if other.proof.is_none() && other.value < candidate.value => *other = candidate,
            Some(_) => {}
            None => {
                if !self.problem.has_closeup() || !stages.looks_closely() {
                    self.last_passed_at = self.num_rounds();
                }
                self.contest.candidates.push(candidate);
            }
        }
    }

    /// Ends a contest: of the hypotheses that passed validation, the one with the best value becomes an
    /// instance and claims its scene points; the others are measured again on what is left, and so on. Those far
    /// below the best stay for the next contest, in which a better pose of the same instance may turn up. So do all once
    /// there is no time for it. Returns how many became instances.
    pub(crate) fn settle(&mut self, stages: &Stages<'_>, grace: &mut Grace<'_>) -> u32 {
        self.problem.interrupt.begin(Phase::Contest);
        let start = Instant::now();
        let mut best_value = None;
        let mut num_accepted = 0;
        while stages.params.max_instances.is_none_or(|limit| self.num_found() < limit) {
            let has_time = grace.allows(self.contest.candidates.len() + 1);
            if !has_time || !self.measure_candidates(stages, grace) || !self.prove_candidates(stages, grace) {
                break;
            }
            let least = best_value.map_or(f64::NEG_INFINITY, |value: f64| MARGIN * value);
            if !self.turn_best(stages, grace) {
                break;
            }
            let Some(value) = self.accept_best(stages, least) else { break };
            best_value = best_value.or(Some(value));
            num_accepted += 1;
        }
        self.contest.num_rounds = 0;
        self.timings.hv_s += start.elapsed().as_secs_f64();
        num_accepted
    }

    /// Validates again the candidates near which an instance has claimed points since they were measured; drops
    /// those that fail. Whether there was time for all of them.
    pub(super) fn measure_candidates(&mut self, stages: &Stages<'_>, grace: &mut Grace<'_>) -> bool {
        let now = self.num_found();
        let cost = self.problem.cost_of(stages.hv);
        let mut is_complete = true;
        let mut candidates = std::mem::take(&mut self.contest.candidates);
        candidates.retain_mut(|candidate| {
            let since = &self.instances.poses()[candidate.measured_at as usize..];
            let pose = &candidate.hypothesis.target_from_source;
            if since.iter().any(|other| self.problem.are_near(pose, other)) {
                is_complete = is_complete && grace.allows(cost);
                if !is_complete {
                    return true;
                }
                let context = self.context(stages.params, candidate.round);
                let verdict = stages.hv.validate(&context, &candidate.hypothesis);
                candidate.measured_at = now;
                if candidate.proof.is_none() {
                    candidate.value = verdict.value;
                }
                return verdict.accepted();
            }
            true
        });
        self.contest.candidates = candidates;
        is_complete
    }

    /// Looks closely at the candidates that have not been looked at so, and drops those that fail. Whether there was time for all
    /// of them.
    pub(super) fn prove_candidates(&mut self, stages: &Stages<'_>, grace: &mut Grace<'_>) -> bool {
        if !self.problem.has_closeup() || !stages.looks_closely() {
            return true;
        }
        let new: Vec<Candidate> =
            self.contest.candidates.extract_if(.., |candidate| candidate.proof.is_none()).collect();
        let cost = PROOF_LOOKS * self.problem.cost_of_look();
        let company = self.instances.company();
        let looked = grace.map(
            new.len(),
            |_| cost,
            |i| stages.look_closely(&self.context(stages.params, new[i].round), &new[i].hypothesis, company),
        );
        let mut is_complete = true;
        for (candidate, looked) in new.into_iter().zip(looked) {
            match looked {
                None => {
                    is_complete = false;
                    self.contest.candidates.push(candidate);
                }
                Some(Looked { hypothesis, verdict, proof }) if verdict.accepted() => {
                    self.last_passed_at = self.last_passed_at.max(candidate.round + 1);
                    self.contest.candidates.push(Candidate {
                        hypothesis,
                        value: verdict.value,
                        proof,
                        ..candidate
                    });
                }
                // Only a close look rejects here, and it tells why.
                Some(Looked { hypothesis, proof, .. }) => {
                    let passed = candidate.hypothesis.target_from_source;
                    let candidate = Candidate { hypothesis, proof, ..candidate };
                    let given_up = |proof| GivenUp { passed, candidate, proof, is_recalled: false };
                    self.contest.given_up.extend(proof.map(given_up));
                }
            }
        }
        is_complete
    }

    /// Makes an instance of the best candidate, the earlier of equals, if its value is at least `least`; returns
    /// the value.
    pub(super) fn accept_best(&mut self, stages: &Stages<'_>, least: f64) -> Option<f64> {
        let params = stages.params;
        let at = self.contest.best()?;
        if self.contest.candidates[at].value < least {
            return None;
        }
        let Candidate { hypothesis, value, round, proof, .. } = self.contest.candidates.remove(at);
        if params.removal == Removal::Inliers {
            let spent = self.context(params, round).witnesses().spent(&hypothesis.target_from_source);
            let num_removed = self.problem.remove(&spent);
            if let Some(last) = self.rounds.last_mut() {
                last.num_removed += num_removed;
            }
        }
        self.tried = Tried::default();
        self.ahead.forget();
        self.instances.push(hypothesis, round, proof);
        self.last_passed_at = self.num_rounds();
        self.recall(stages);
        Some(value)
    }

    /// Makes candidates again of those that were given up and would not be in today's company.
    fn recall(&mut self, stages: &Stages<'_>) {
        if self.contest.given_up.is_empty() {
            return;
        }
        let company = self.instances.company();
        let Contest { given_up, candidates, .. } = &mut self.contest;
        for given_up in given_up.iter_mut().filter(|given_up| !given_up.is_recalled) {
            let proof = given_up.proof.among(company);
            if let Some(verdict) = stages.verdict_of(&proof).filter(Verdict::accepted) {
                given_up.is_recalled = true;
                // Of all that was found since nothing is known: an instance may have claimed its points.
                candidates.push(Candidate {
                    value: verdict.value,
                    measured_at: 0,
                    proof: Some(proof),
                    ..given_up.candidate
                });
            }
        }
    }
}
