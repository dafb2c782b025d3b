//! A run between two rounds: what is alive, what was found, what happened.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::Instant;

use nalgebra::Isometry3;

use crate::correspondence::{Alive, PointPairs};
use crate::interrupt::Interrupt;
use crate::kernels::overlap::overlap;
use crate::kernels::par::Pool;
use crate::params::Params;
use crate::registration::{Pose, Registration, Round, StopReason, Timings};
use crate::scene::Scene;
use crate::stages::{Context, Estimate, Ranked, Verdict};

/// Fewest correspondences that fix a pose.
const MIN_CORRESPONDENCES: u32 = 3;

/// A run that has begun: made by [`crate::Registrar::begin`], moved on by [`crate::Registrar::step`].
#[derive(Debug)]
pub struct State<'a> {
    pub(crate) problem: Problem<'a>,
    pub(crate) rounds: Vec<Round>,
    pub(crate) timings: Timings,
    pub(crate) pool: Arc<Pool>,
    found: Vec<Found>,
    start: Instant,
}

/// What the stages look at.
#[derive(Debug)]
pub(crate) struct Problem<'a> {
    pub(crate) scene: Scene<'a>,
    pub(crate) pairs: PointPairs,
    pub(crate) alive: Alive,
    pub(crate) interrupt: Interrupt,
}

/// An accepted pose and its round.
#[derive(Debug, Clone, Copy)]
struct Found {
    target_from_source: Isometry3<f64>,
    round: u32,
}

impl Problem<'_> {
    pub(crate) fn context<'c>(&'c self, params: &'c Params, round: usize) -> Context<'c> {
        Context {
            scene: &self.scene,
            pairs: &self.pairs,
            alive: &self.alive,
            params,
            round: round as u32,
            interrupt: &self.interrupt,
        }
    }
}

impl<'a> State<'a> {
    pub(crate) fn new(problem: Problem<'a>, pool: Arc<Pool>, start: Instant) -> Self {
        let timings = Timings { prepare_s: start.elapsed().as_secs_f64(), ..Timings::default() };
        Self { problem, rounds: Vec::new(), timings, pool, found: Vec::new(), start }
    }

    /// The poses accepted so far, in the order they were found.
    pub fn poses(&self) -> impl Iterator<Item = Isometry3<f64>> + '_ {
        self.found.iter().map(|found| found.target_from_source)
    }

    /// The rounds played so far.
    #[must_use]
    pub fn rounds(&self) -> &[Round] {
        &self.rounds
    }

    /// The correspondences still alive.
    #[must_use]
    pub fn alive(&self) -> &Alive {
        &self.problem.alive
    }

    /// Breaks if no further round may be played.
    pub(crate) fn check_limits(&self, params: &Params) -> ControlFlow<StopReason> {
        let alive = self.problem.alive.ids().len() as u32;
        if alive < MIN_CORRESPONDENCES {
            let threshold = MIN_CORRESPONDENCES;
            return ControlFlow::Break(StopReason::FewCorrespondences { value: alive, threshold });
        }
        let (rounds, found) = (self.rounds.len() as u32, self.found.len() as u32);
        if let Some(threshold) = params.max_rounds.filter(|&limit| rounds >= limit) {
            return ControlFlow::Break(StopReason::MaxRounds { value: rounds, threshold });
        }
        if let Some(threshold) = params.max_instances.filter(|&limit| found >= limit) {
            return ControlFlow::Break(StopReason::MaxInstances { value: found, threshold });
        }
        self.problem.interrupt.check()
    }

    /// Books a round: keeps the pose if it was accepted, removes correspondences.
    pub(crate) fn conclude(
        &mut self,
        seeds: &Ranked,
        dense: &Ranked,
        estimate: &Estimate,
        verdict: Option<Verdict>,
        remove: &[u32],
    ) -> ControlFlow<StopReason, Round> {
        let num_alive = self.problem.alive.ids().len() as u32;
        let num_removed = self.problem.alive.remove(remove, &self.problem.pairs) as u32;
        let round = Round {
            index: self.rounds.len() as u32,
            num_alive,
            num_seeds: seeds.len() as u32,
            num_dense: dense.len() as u32,
            num_samples: estimate.num_samples,
            num_degenerate: estimate.num_degenerate,
            hypothesis_score: estimate.hypothesis.map(|h| h.score),
            verdict,
            num_removed,
        };
        if let Some(hypothesis) = estimate.hypothesis.filter(|_| round.accepted()) {
            let target_from_source = hypothesis.target_from_source;
            self.found.push(Found { target_from_source, round: round.index });
        }
        self.rounds.push(round.clone());
        if num_removed == 0 { ControlFlow::Break(StopReason::Stalled) } else { ControlFlow::Continue(round) }
    }

    /// The result: poses measured and ranked, correspondences labelled.
    pub(crate) fn into_registration(mut self, params: &Params, stop_reason: StopReason) -> Registration {
        let mut measured: Vec<(Pose, Vec<f64>)> =
            self.found.iter().map(|found| measure(&self.problem, params, found)).collect();
        // Stable: equals stay in the order in which they were found.
        measured.sort_by(|(a, _), (b, _)| b.score.total_cmp(&a.score));
        let labels = labels(&measured, self.problem.pairs.len());
        self.timings.total_s = self.start.elapsed().as_secs_f64();
        Registration {
            poses: measured.into_iter().map(|(pose, _)| pose).collect(),
            labels,
            rounds: self.rounds,
            stop_reason,
            timings: self.timings,
            resolution: self.problem.scene.resolution,
        }
    }
}

/// A pose with its quality measures, and the squared residual of each of its inliers.
fn measure(problem: &Problem<'_>, params: &Params, found: &Found) -> (Pose, Vec<f64>) {
    let pose = found.target_from_source;
    let (scene, pairs) = (&problem.scene, &problem.pairs);
    let t_he = params.t_he_pr * scene.resolution;
    let (inliers, residuals_sq): (Vec<u32>, Vec<f64>) = pairs
        .pairs(0..pairs.len() as u32)
        .zip(0_u32..)
        .map(|((p, q), id)| (id, (pose * p - q).norm_squared()))
        .filter(|&(_, residual_sq)| residual_sq < t_he * t_he)
        .unzip();
    let mean_sq = residuals_sq.iter().sum::<f64>() / residuals_sq.len().max(1) as f64;
    let d_op = params.d_op_pr * scene.resolution;
    let overlap = overlap(&scene.source.points, &scene.target.neighbors, &pose, d_op);
    let pose = Pose {
        target_from_source: pose,
        score: overlap,
        overlap,
        inlier_rmse: mean_sq.sqrt(),
        inliers,
        round: found.round,
    };
    (pose, residuals_sq)
}

/// For each correspondence the pose of which it is the closest inlier; the better-ranked one of equals.
fn labels(measured: &[(Pose, Vec<f64>)], num_correspondences: usize) -> Vec<Option<u32>> {
    let mut closest = vec![(f64::INFINITY, None); num_correspondences];
    for (label, (pose, residuals_sq)) in (0_u32..).zip(measured) {
        for (&id, &residual_sq) in pose.inliers.iter().zip(residuals_sq) {
            let best = &mut closest[id as usize];
            if residual_sq < best.0 {
                *best = (residual_sq, Some(label));
            }
        }
    }
    closest.into_iter().map(|(_, label)| label).collect()
}
