//! A run between two rounds: what is alive, what was found, what happened.

use std::ops::ControlFlow;
use std::sync::{Arc, OnceLock};
use std::time::Instant;

use nalgebra::Isometry3;

use crate::claims::Claims;
use crate::cloud::PROBE_POINTS;
use crate::correspondence::{Alive, PointPairs};
use crate::finish::Grace;
use crate::interrupt::{Interrupt, Phase};
use crate::kernels::evidence::Support;
use crate::kernels::graph::Graph;
use crate::kernels::par::Pool;
use crate::params::{Params, Refine, Removal};
use crate::registration::{Pose, Registration, Round, StopReason, Timings};
use crate::scene::{Detail, Scene};
use crate::stages::{Chance, Context, Estimate, Hypothesis, LOOK_NEAR, Ranked, Validate, Verdict};

/// Fewest correspondences that fix a pose.
const MIN_CORRESPONDENCES: u32 = 3;

/// How many of the turned poses are looked at closely.
const NUM_TURNS: usize = 4;

/// A run that has begun: made by [`crate::Registrar::begin`], moved on by [`crate::Registrar::step`].
#[derive(Debug)]
pub struct State<'a> {
    pub(crate) problem: Problem<'a>,
    pub(crate) rounds: Vec<Round>,
    pub(crate) timings: Timings,
    pub(crate) pool: Arc<Pool>,
    pub(crate) rounds_since_settling: u32,
    pub(crate) tried: Tried,
    /// The seeds of the next round, selected beforehand; nothing has changed since but what a round that comes to nothing
    /// changes.
    pub(crate) ahead: Option<(Ranked, Timings)>,
    candidates: Vec<Candidate>,
    pub(crate) found: Vec<Found>,
    /// Rounds that had been played when a hypothesis last passed validation, or an instance was last found.
    last_passed_at: u32,
    start: Instant,
}

/// What the stages look at.
#[derive(Debug)]
pub(crate) struct Problem<'a> {
    pub(crate) scene: Scene<'a>,
    pub(crate) pairs: PointPairs,
    pub(crate) alive: Alive,
    pub(crate) barred: Vec<bool>,
    pub(crate) graph: OnceLock<Graph>,
    pub(crate) is_first_look: bool,
    pub(crate) votes: OnceLock<Vec<Option<[f32; 3]>>>,
    pub(crate) chance: OnceLock<Chance>,
    pub(crate) interrupt: Interrupt,
}

/// A hypothesis that passed validation and waits for the end of the contest.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    hypothesis: Hypothesis,
    value: f64,
    round: u32,
    /// How many instances had claimed their points when it was measured.
    measured_at: u32,
}

/// What the stages made of a round.
#[derive(Debug, Default)]
pub(crate) struct Play {
    pub(crate) seeds: Ranked,
    pub(crate) dense: Ranked,
    pub(crate) estimate: Estimate,
    pub(crate) judged: Option<Judged>,
    pub(crate) timings: Timings,
}

/// What became of an estimated pose.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Judged {
    /// As it was judged, polished or not.
    pub(crate) hypothesis: Hypothesis,
    pub(crate) verdict: Verdict,
}

/// The estimated poses since an instance was last found, and what became of each.
#[derive(Debug, Default)]
pub(crate) struct Tried(Vec<(Isometry3<f64>, Judged)>);

impl Tried {
    /// What became of `pose`, if it has been tried.
    pub(crate) fn get(&self, pose: &Isometry3<f64>) -> Option<Judged> {
        self.0.iter().find(|(tried, _)| tried == pose).map(|&(_, judged)| judged)
    }

    /// What became of the first that ended up where the pose `rough` is at a first glance, as `is_same` has it.
    pub(crate) fn next_to(
        &self,
        rough: &Isometry3<f64>,
        is_same: impl Fn(&Isometry3<f64>, &Isometry3<f64>) -> bool,
    ) -> Option<Judged> {
        let mut judged = self.0.iter().map(|&(_, judged)| judged);
        judged.find(|judged| is_same(rough, &judged.hypothesis.target_from_source))
    }

    fn add(&mut self, pose: &Isometry3<f64>, judged: Judged) {
        if self.get(pose).is_none() {
            self.0.push((*pose, judged));
        }
    }
}

/// An accepted pose and its round.
#[derive(Debug)]
pub(crate) struct Found {
    pub(crate) hypothesis: Hypothesis,
    pub(crate) round: u32,
    overlap: OnceLock<f64>,
}

impl Found {
    pub(crate) fn pose(&self) -> &Isometry3<f64> {
        &self.hypothesis.target_from_source
    }

    /// Share of the source that lies on the target; measured when first asked for.
    pub(crate) fn overlap(&self, scene: &Scene<'_>, params: &Params) -> f64 {
        *self.overlap.get_or_init(|| scene.overlap(params, self.pose()))
    }
}

impl<'a> Problem<'a> {
    pub(crate) fn new(scene: Scene<'a>, pairs: PointPairs, interrupt: Interrupt) -> Self {
        let (alive, barred) = (Alive::all(&pairs), vec![false; pairs.len()]);
        Self {
            scene,
            pairs,
            alive,
            barred,
            graph: OnceLock::new(),
            is_first_look: true,
            votes: OnceLock::new(),
            chance: OnceLock::new(),
            interrupt,
        }
    }

    /// Whether two poses of the source can have to do with the same target points.
    pub(crate) fn are_near(&self, params: &Params, a: &Isometry3<f64>, b: &Isometry3<f64>) -> bool {
        let source = self.scene.source;
        let reach = 2.0 * (params.d_op_pr + params.d_op_pr.max(params.t_he_pr)) * self.scene.resolution;
        (a * source.centre - b * source.centre).norm() < source.extent + reach
    }

    /// About how many points are looked at for a close look at a pose.
    pub(crate) fn cost_of_look(&self, params: &Params) -> usize {
        let num_source = self.scene.source.points.len();
        let num_looked_at =
            if self.scene.is_one_sided(params) { num_source } else { num_source.min(PROBE_POINTS) };
        num_looked_at + LOOK_NEAR + self.pairs.len() / 16
    }

    /// The same for a verdict.
    pub(crate) fn cost_of(&self, params: &Params, hv: &dyn Validate) -> usize {
        let is_by_look = hv.verdict_of(&Support::default()).is_some();
        self.cost_of_look(params) + if is_by_look { 0 } else { self.scene.source.points.len() }
    }

    /// Takes `ids` out of what is alive; returns how many of them were.
    fn remove(&mut self, ids: &[u32]) -> u32 {
        if let Some(graph) = self.graph.get_mut() {
            graph.remove(ids);
        }
        self.alive.remove(ids) as u32
    }

    /// What is barred from leading once `ids` are too.
    pub(crate) fn also_barred(&self, ids: &[u32]) -> Vec<bool> {
        let mut barred = self.barred.clone();
        for &id in ids {
            barred[id as usize] = true;
        }
        barred
    }

    /// Bars `ids` from leading; returns how many were not barred before.
    fn bar(&mut self, ids: &[u32]) -> u32 {
        ids.iter().map(|&id| u32::from(!std::mem::replace(&mut self.barred[id as usize], true))).sum()
    }

    pub(crate) fn context<'c>(&'c self, params: &'c Params, round: usize, found: &'c [Found]) -> Context<'c> {
        self.context_of(params, round, &self.alive, found)
    }

    /// A context with other correspondences alive.
    pub(crate) fn context_of<'c>(
        &'c self,
        params: &'c Params,
        round: usize,
        alive: &'c Alive,
        found: &'c [Found],
    ) -> Context<'c> {
        Context {
            scene: &self.scene,
            pairs: &self.pairs,
            alive,
            params,
            round: round as u32,
            barred: &self.barred,
            claims: Claims::new(&self.scene, params, found),
            graph: &self.graph,
            is_first_look: self.is_first_look,
            votes: &self.votes,
            chance: &self.chance,
            interrupt: &self.interrupt,
        }
    }
}

impl<'a> State<'a> {
    pub(crate) fn new(problem: Problem<'a>, pool: Arc<Pool>, start: Instant) -> Self {
        let timings = Timings { prepare_s: start.elapsed().as_secs_f64(), ..Timings::default() };
        Self {
            problem,
            rounds: Vec::new(),
            timings,
            pool,
            rounds_since_settling: 0,
            tried: Tried::default(),
            ahead: None,
            candidates: Vec::new(),
            found: Vec::new(),
            last_passed_at: 0,
            start,
        }
    }

    /// Ends the first look, if there is one; returns whether there was.
    pub(crate) fn end_first_look(&mut self) -> bool {
        let Problem { graph, is_first_look, .. } = &mut self.problem;
        let ends = *is_first_look && graph.get().is_some_and(Graph::is_sample);
        if ends {
            (*graph, *is_first_look) = (OnceLock::new(), false);
            self.ahead = None;
            self.last_passed_at = self.rounds.len() as u32;
        }
        ends
    }

    /// Rounds since a hypothesis last passed validation, or an instance was last found.
    pub(crate) fn num_rejections(&self) -> u32 {
        self.rounds.len() as u32 - self.last_passed_at
    }

    /// The poses accepted so far, in the order they were found.
    pub fn poses(&self) -> impl Iterator<Item = Isometry3<f64>> + '_ {
        self.found.iter().map(|found| found.hypothesis.target_from_source)
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
        let alive = self.problem.alive.len() as u32;
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
        let rejections = self.num_rejections();
        if let Some(threshold) = params.max_rejections.filter(|&limit| rejections >= limit) {
            return ControlFlow::Break(StopReason::MaxRejections { value: rejections, threshold });
        }
        self.problem.interrupt.check()
    }

    /// Hypotheses that wait for the end of the contest.
    pub(crate) fn num_candidates(&self) -> usize {
        self.candidates.len()
    }

    pub(crate) fn num_found(&self) -> u32 {
        self.found.len() as u32
    }

    /// Books a round: removes or bars correspondences, enters the hypothesis for the contest if it passed; returns its
    /// verdict.
    pub(crate) fn conclude(&mut self, params: &Params, play: Play) -> Option<Verdict> {
        let Play { seeds, dense, estimate, judged, .. } = play;
        if let (Some(raw), Some(judged)) = (estimate.hypothesis, judged) {
            self.tried.add(&raw.target_from_source, judged);
        }
        let (hypothesis, verdict) = judged.map(|judged| (judged.hypothesis, judged.verdict)).unzip();
        let index = self.rounds.len() as u32;
        let num_alive = self.problem.alive.len() as u32;
        let passed = hypothesis.filter(|_| verdict.is_some_and(|verdict: Verdict| verdict.accepted()));
        if passed.is_some() {
            self.ahead = None;
        }
        let (removed, barred) = match (params.removal, passed) {
            (Removal::Dense, _) => (dense.ids(), Vec::new()),
            (Removal::Inliers, None) => (&[][..], seeds.ids().to_vec()),
            // The seeds too: they may all lie outside of the pose that they led to.
            (Removal::Inliers, Some(hypothesis)) => {
                let context = self.problem.context(params, index as usize, &self.found);
                let inliers = context.inliers(&hypothesis.target_from_source, 2.0 * params.t_he_pr);
                (&[][..], [seeds.ids(), &inliers].concat())
            }
        };
        self.rounds.push(Round {
            index,
            num_alive,
            num_seeds: seeds.len() as u32,
            num_dense: dense.len() as u32,
            num_samples: estimate.num_samples,
            num_degenerate: estimate.num_degenerate,
            capped: estimate.capped,
            hypothesis_score: hypothesis.map(|h| h.score),
            verdict,
            num_removed: self.problem.remove(removed),
            num_barred: self.problem.bar(&barred),
        });
        self.rounds_since_settling += 1;
        if let (Some(hypothesis), Some(verdict)) = (passed, verdict) {
            let measured_at = self.num_found();
            self.enter(params, Candidate { hypothesis, value: verdict.value, round: index, measured_at });
        }
        verdict
    }

    /// Enters a candidate for the contest. Of two that are the same pose the better one stays; only one that is
    /// new counts as a success.
    fn enter(&mut self, params: &Params, candidate: Candidate) {
        let scene = &self.problem.scene;
        let same = 2.0 * params.t_he_pr * scene.resolution;
        let is_same = |other: &&mut Candidate| {
            let [a, b] = [&candidate, &**other].map(|c| &c.hypothesis.target_from_source);
            scene.source.displacement(a, b) < same
        };
        match self.candidates.iter_mut().find(is_same) {
            Some(other) if other.value < candidate.value => *other = candidate,
            Some(_) => {}
            None => {
                self.last_passed_at = candidate.round + 1;
                self.candidates.push(candidate);
            }
        }
    }

    /// The round just booked, as it is after the contest, if there was one.
    pub(crate) fn last_round(&self) -> ControlFlow<StopReason, Round> {
        match self.rounds.last() {
            Some(round) if round.num_removed + round.num_barred > 0 => ControlFlow::Continue(round.clone()),
            _ => ControlFlow::Break(StopReason::Stalled),
        }
    }

    /// Validates again the candidates near which an instance has claimed points since they were measured; drops
    /// those that fail. Whether there was time for all of them.
    pub(crate) fn measure_candidates(
        &mut self,
        params: &Params,
        hv: &dyn Validate,
        grace: &mut Grace<'_>,
    ) -> bool {
        let now = self.num_found();
        let cost = self.problem.cost_of(params, hv);
        let mut is_complete = true;
        let mut candidates = std::mem::take(&mut self.candidates);
        candidates.retain_mut(|candidate| {
            let since = &self.found[candidate.measured_at as usize..];
            let pose = &candidate.hypothesis.target_from_source;
            if since.iter().any(|found| self.problem.are_near(params, pose, found.pose())) {
                is_complete = is_complete && grace.allows(cost);
                if !is_complete {
                    return true;
                }
                let context = self.problem.context(params, candidate.round as usize, &self.found);
                let verdict = hv.validate(&context, &candidate.hypothesis);
                (candidate.value, candidate.measured_at) = (verdict.value, now);
                return verdict.accepted();
            }
            true
        });
        self.candidates = candidates;
        is_complete
    }

    /// The row of the best candidate; of equals that of the earliest round.
    fn best(&self) -> Option<usize> {
        let order = |a: &Candidate, b: &Candidate| a.value.total_cmp(&b.value).then(b.round.cmp(&a.round));
        self.candidates.iter().enumerate().max_by(|(_, a), (_, b)| order(a, b)).map(|(at, _)| at)
    }

    /// Turns the best candidate about if it fits better that way ([`Refine::IcpTurns`]). Whether there was time for it.
    pub(crate) fn turn_best(&mut self, params: &Params, hv: &dyn Validate, grace: &mut Grace<'_>) -> bool {
        let scene = &self.problem.scene;
        if params.refine != Refine::IcpTurns || !scene.is_one_sided(params) {
            return true;
        }
        let Some(at) = self.best() else { return true };
        let Candidate { hypothesis, value, round, .. } = self.candidates[at];
        let context = self.problem.context(params, round as usize, &self.found);
        let turns = scene.source.turns();
        let cost = self.problem.cost_of_look(params);
        let glances = grace.map(
            turns.len(),
            |_| 2 * cost,
            |i| {
                let pose = scene.icp(params, Detail::Glance, &(hypothesis.target_from_source * turns[i]));
                let claims = context.claims.near(&pose);
                (scene.fit(params, Detail::Glance, &pose, |rows| claims.contain(rows)).share, pose)
            },
        );
        let Some(mut glances) = glances.into_iter().collect::<Option<Vec<_>>>() else { return false };
        glances.sort_by(|(a, _), (b, _)| b.total_cmp(a));
        let mut best = (value, hypothesis);
        for (_, pose) in &glances[..NUM_TURNS] {
            if !grace.allows(8 * cost) {
                return false;
            }
            let target_from_source = scene.icp(params, Detail::Look, pose);
            let turned = Hypothesis { target_from_source, ..hypothesis };
            let verdict = hv.validate(&context, &turned);
            if verdict.value > best.0 {
                best = (verdict.value, turned);
            }
        }
        let candidate = &mut self.candidates[at];
        (candidate.value, candidate.hypothesis) = best;
        true
    }

    /// Makes an instance of the best candidate, the earlier of equals, if its value is at least `least`; returns
    /// the value.
    pub(crate) fn accept_best(&mut self, params: &Params, least: f64) -> Option<f64> {
        let at = self.best()?;
        if self.candidates[at].value < least {
            return None;
        }
        let Candidate { hypothesis, value, round, .. } = self.candidates.remove(at);
        let target_from_source = hypothesis.target_from_source;
        if params.removal == Removal::Inliers {
            let spent = self.problem.context(params, round as usize, &self.found).spent(&target_from_source);
            let num_removed = self.problem.remove(&spent);
            if let Some(last) = self.rounds.last_mut() {
                last.num_removed += num_removed;
            }
        }
        self.tried = Tried::default();
        self.ahead = None;
        self.found.push(Found { hypothesis, round, overlap: OnceLock::new() });
        self.last_passed_at = self.rounds.len() as u32;
        Some(value)
    }

    /// The result: poses measured and ranked, correspondences labelled. `supports` tells what speaks for each instance. Those
    /// for which there is no time are left out.
    pub(crate) fn into_registration(
        mut self,
        params: &Params,
        stop_reason: StopReason,
        supports: &[Support],
        grace: &mut Grace<'_>,
    ) -> Registration {
        self.problem.interrupt.begin(Phase::Rank);
        let cost = |at: usize| {
            let overlap = if self.found[at].overlap.get().is_some() {
                0
            } else {
                self.problem.scene.source.points.len()
            };
            overlap + self.problem.pairs.len() / 16 + 1
        };
        let measured = grace
            .map(self.found.len(), cost, |at| measure(&self.problem, params, &self.found[at], &supports[at]));
        let mut measured: Vec<(Pose, Vec<f64>)> = measured.into_iter().flatten().collect();
        // Stable: equals stay in the order in which they were found.
        measured.sort_by(|(a, _), (b, _)| b.score.total_cmp(&a.score));
        drop_duplicates(&self.problem.scene, &mut measured, grace);
        let labels = labels(&measured, self.problem.pairs.len());
        self.timings.total_s = self.start.elapsed().as_secs_f64();
        let stop_reason = match self.problem.interrupt.check() {
            ControlFlow::Break(reason) if !stop_reason.is_from_outside() => reason,
            _ => stop_reason,
        };
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
fn measure(problem: &Problem<'_>, params: &Params, found: &Found, support: &Support) -> (Pose, Vec<f64>) {
    let pose = *found.pose();
    let (scene, pairs) = (&problem.scene, &problem.pairs);
    let t_he = params.t_he_pr * scene.resolution;
    // Found in single precision, decided in double.
    let mut close = pairs.by_target.close_pairs(&pose, 1.01 * params.t_he_pr);
    close.sort_unstable();
    let (inliers, residuals_sq): (Vec<u32>, Vec<f64>) = close
        .iter()
        .map(|&id| (id, (pose * pairs.source[id as usize] - pairs.target[id as usize]).norm_squared()))
        .filter(|&(_, residual_sq)| residual_sq < t_he * t_he)
        .unzip();
    let mean_sq = residuals_sq.iter().sum::<f64>() / residuals_sq.len().max(1) as f64;
    let pose = Pose {
        target_from_source: pose,
        score: support.score(),
        overlap: found.overlap(scene, params),
        closeness: support.closeness(),
        back_fit: support.back_fit,
        evidence: support.evidence(),
        inlier_rmse: mean_sq.sqrt(),
        inliers,
        round: found.round,
    };
    (pose, residuals_sq)
}

/// Drops what differs from a better pose by a declared symmetry alone; nothing where none is declared.
///
/// Once the run is ended and the time for this is over, the poses of the least scores go, whether they are duplicates or not.
fn drop_duplicates(scene: &Scene<'_>, measured: &mut Vec<(Pose, Vec<f64>)>, grace: &mut Grace<'_>) {
    if scene.source.symmetries.is_none() {
        return;
    }
    let mut kept: Vec<Isometry3<f64>> = Vec::new();
    measured.retain(|(Pose { target_from_source: pose, .. }, _)| {
        let is_new =
            grace.allows(kept.len()) && kept.iter().all(|other| !scene.source.look_the_same(pose, other));
        if is_new {
            kept.push(*pose);
        }
        is_new
    });
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
