//! A run between two rounds: what is alive, what was found, what happened.

use std::ops::ControlFlow;
use std::sync::{Arc, OnceLock};
use std::time::Instant;

use nalgebra::Isometry3;

use crate::correspondence::{Alive, PointPairs};
use crate::interrupt::Interrupt;
use crate::kernels::graph::Graph;
use crate::kernels::overlap::overlap;
use crate::kernels::par::Pool;
use crate::params::Params;
use crate::registration::{Pose, Registration, Round, StopReason, Timings};
use crate::scene::Scene;
use crate::stages::{Context, Hypothesis};

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
    pub(crate) barred: Vec<bool>,
    pub(crate) claimed: Vec<bool>,
    pub(crate) graph: OnceLock<Graph>,
    pub(crate) interrupt: Interrupt,
}

/// An accepted pose and its round.
#[derive(Debug, Clone, Copy)]
struct Found {
    target_from_source: Isometry3<f64>,
    round: u32,
}

impl<'a> Problem<'a> {
    pub(crate) fn new(scene: Scene<'a>, pairs: PointPairs, interrupt: Interrupt) -> Self {
        let (alive, barred) = (Alive::all(&pairs), vec![false; pairs.len()]);
        let claimed = vec![false; scene.target.points.len()];
        Self { scene, pairs, alive, barred, claimed, graph: OnceLock::new(), interrupt }
    }

    /// Takes `ids` out of what is alive; returns how many of them were.
    fn remove(&mut self, ids: &[u32]) -> u32 {
        if let Some(graph) = self.graph.get_mut() {
            graph.remove(ids);
        }
        self.alive.remove(ids, &self.pairs) as u32
    }

    /// Claims the target points within `d_op` of the accepted model.
    fn claim(&mut self, params: &Params, target_from_source: &Isometry3<f64>) {
        let explained = self.scene.explained(params, target_from_source, &self.scene.target.points);
        for (claimed, explained) in self.claimed.iter_mut().zip(explained) {
            *claimed |= explained;
        }
    }

    /// Bars `ids` from leading; returns how many were not barred before.
    fn bar(&mut self, ids: &[u32]) -> u32 {
        ids.iter().map(|&id| u32::from(!std::mem::replace(&mut self.barred[id as usize], true))).sum()
    }

    pub(crate) fn context<'c>(&'c self, params: &'c Params, round: usize) -> Context<'c> {
        Context {
            scene: &self.scene,
            pairs: &self.pairs,
            alive: &self.alive,
            params,
            round: round as u32,
            barred: &self.barred,
            claimed: &self.claimed,
            graph: &self.graph,
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
        let rejections = self.rounds.iter().rev().take_while(|round| !round.accepted()).count() as u32;
        if let Some(threshold) = params.max_rejections.filter(|&limit| rejections >= limit) {
            return ControlFlow::Break(StopReason::MaxRejections { value: rejections, threshold });
        }
        self.problem.interrupt.check()
    }

    /// Books a round: keeps its pose if it was accepted, removes and bars correspondences.
    pub(crate) fn conclude(
        &mut self,
        params: &Params,
        mut round: Round,
        accepted: Option<Hypothesis>,
        removed: &[u32],
        barred: &[u32],
    ) -> ControlFlow<StopReason, Round> {
        let problem = &mut self.problem;
        round.num_removed = problem.remove(removed);
        round.num_barred = problem.bar(barred);
        if let Some(hypothesis) = accepted {
            let target_from_source = hypothesis.target_from_source;
            problem.claim(params, &target_from_source);
            self.found.push(Found { target_from_source, round: round.index });
        }
        self.rounds.push(round.clone());
        if round.num_removed + round.num_barred == 0 {
            return ControlFlow::Break(StopReason::Stalled);
        }
        ControlFlow::Continue(round)
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
    let overlap = overlap(&scene.places(params, &pose));
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
