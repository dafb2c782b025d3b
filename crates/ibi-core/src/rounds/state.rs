//! A run between two rounds: what is alive, what was found, what happened; and when it ends.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::Instant;

use nalgebra::Isometry3;

use super::ahead::Ahead;
use super::candidates::Contest;
use super::instances::Instances;
use super::judge::Judged;
use super::memory::Tried;
use super::problem::Problem;
use super::stages::{Asked, Stages};
use crate::grace::Grace;
use crate::kernels::par::{self, Pool};
use crate::params::{Params, Removal};
use crate::registration::{Round, Timings};
use crate::scene::Alive;
use crate::stages::{Context, Estimate, Ranked};
use crate::stop::StopReason;

/// Fewest correspondences that fix a pose.
const MIN_CORRESPONDENCES: u32 = 3;

/// After so many rounds in a row that came to nothing, a first look is over.
const FIRST_REJECTIONS: u32 = 4;

/// A run that has begun: made by [`crate::Registrar::begin`], moved on by [`crate::Registrar::step`].
#[derive(Debug)]
pub struct State<'a> {
    pub(crate) problem: Problem<'a>,
    pub(crate) pool: Arc<Pool>,
    pub(super) rounds: Vec<Round>,
    pub(super) timings: Timings,
    pub(super) start: Instant,
    pub(super) contest: Contest,
    pub(crate) instances: Instances,
    pub(super) tried: Tried,
    pub(super) ahead: Ahead,
    /// Rounds that had been played when a hypothesis last passed validation, or an instance was last found.
    pub(super) last_passed_at: u32,
}

/// What the stages made of a round.
#[derive(Debug)]
pub(crate) struct Play {
    pub(crate) seeds: Ranked,
    pub(crate) dense: Ranked,
    pub(crate) estimate: Estimate,
    pub(crate) judged: Option<Judged>,
}

impl<'a> State<'a> {
    pub(crate) fn new(problem: Problem<'a>, pool: Arc<Pool>, start: Instant) -> Self {
        Self {
            problem,
            pool,
            rounds: Vec::new(),
            timings: Timings { prepare_s: start.elapsed().as_secs_f64(), ..Timings::default() },
            start,
            contest: Contest::default(),
            instances: Instances::default(),
            tried: Tried::default(),
            ahead: Ahead::default(),
            last_passed_at: 0,
        }
    }

    /// The poses accepted so far, in the order they were found.
    pub fn poses(&self) -> impl Iterator<Item = Isometry3<f64>> + '_ {
        self.instances.poses().iter().copied()
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

    pub(super) fn num_rounds(&self) -> u32 {
        self.rounds.len() as u32
    }

    pub(super) fn num_found(&self) -> u32 {
        self.instances.len() as u32
    }

    /// What a stage sees in `round`.
    pub(super) fn context<'c>(&'c self, params: &'c Params, round: u32) -> Context<'c> {
        self.problem.context(params, round, self.instances.poses())
    }

    /// The seeds of the next round. Breaks if no further round may be played, or too few are found.
    pub(crate) fn select_seeds(&mut self, stages: &Stages<'_>) -> ControlFlow<StopReason, Ranked> {
        loop {
            match self.try_select_seeds(stages) {
                // Candidates that still wait may free the way for further ones.
                ControlFlow::Break(reason) if reason.is_dry() && self.settle_now(stages) > 0 => {}
                flow => return flow,
            }
        }
    }

    fn try_select_seeds(&mut self, stages: &Stages<'_>) -> ControlFlow<StopReason, Ranked> {
        self.check_limits(stages.params)?;
        let ahead = self.ahead.take();
        let round = self.num_rounds();
        let context = self.context(stages.params, round);
        let select = || stages.select_seeds(&context);
        let (seeds, timings) = match ahead {
            Some(selected) => selected,
            // The first selection builds the graph, and leaves a second thread idle in between.
            None if round == 0 && !stages.has_own_scs => par::join(select, || context.chance()).0,
            None => select(),
        };
        // At the latest now, and not at the end, when there may be no time for it.
        context.chance();
        self.problem.interrupt.check()?;
        self.timings.add(&timings);
        let (value, threshold) = (seeds.len() as u32, stages.params.t_s);
        if value >= threshold {
            ControlFlow::Continue(seeds)
        } else if self.end_first_look() {
            self.try_select_seeds(stages)
        } else {
            ControlFlow::Break(StopReason::FewSeeds { value, threshold })
        }
    }

    /// Plays a round whose seeds are selected, as `stages_in_order` has it; an idle thread selects those of the next one, or
    /// measures the instance found last.
    pub(crate) fn play(
        &mut self,
        stages: &Stages<'_>,
        seeds: Ranked,
        stages_in_order: impl FnOnce(&mut Asked<'_>, &Context<'_>, Ranked) -> Option<Play> + Send,
    ) -> ControlFlow<StopReason, Play> {
        let Self { problem, tried, instances, .. } = &*self;
        let round = self.num_rounds();
        let is_lean = self.rounds.last().is_some_and(|last| !last.accepted());
        let context = problem.context(stages.params, round, instances.poses());
        let mut asked = Asked { stages, tried, is_lean, timings: Timings::default() };
        let looks_ahead = is_lean && stages.may_look_ahead(problem);
        let barred = looks_ahead.then(|| problem.also_barred(seeds.ids()));
        let play = || stages_in_order(&mut asked, &context, seeds);
        let mut next = None;
        let played = if let Some(barred) = &barred {
            let context = problem.context(stages.params, round + 1, instances.poses());
            let context = Context { barred, ..context };
            let (played, selected) = par::join(play, || stages.select_seeds(&context));
            next = Some(selected);
            played
        } else if !is_lean
            && par::is_parallel()
            && let Some(found) = instances.last()
        {
            // After a success the next one is likely, and selecting ahead would be in vain.
            par::join(play, || found.overlap(&problem.scene)).0
        } else {
            play()
        };
        let timings = asked.timings;
        self.ahead.put(next);
        self.problem.interrupt.check()?;
        self.timings.add(&timings);
        // The stages answer with nothing only once the run is to end.
        played.map_or(ControlFlow::Break(StopReason::Cancelled), ControlFlow::Continue)
    }

    /// Books a round, removes or bars correspondences, enters the pose in the contest if it passed, and ends the contest where
    /// it is time. Breaks if the next round would be the same again.
    pub(crate) fn conclude(&mut self, stages: &Stages<'_>, play: Play) -> ControlFlow<StopReason, Round> {
        let verdict = play.judged.map(|judged| judged.verdict);
        self.book(stages, play);
        if verdict.is_some_and(|verdict| verdict.accepted() && stages.hv.is_sure(&verdict)) {
            self.accept_sure(stages);
        }
        if self.num_rejections() >= FIRST_REJECTIONS {
            self.end_first_look();
        }
        if self.contest.is_due(stages.params) {
            self.settle_now(stages);
        }
        let is_stalled = self.rounds.last().is_none_or(|round| round.num_removed + round.num_barred == 0);
        if is_stalled && self.settle_now(stages) == 0 {
            return ControlFlow::Break(StopReason::Stalled);
        }
        // As it is after the contest, if there was one.
        self.rounds.last().cloned().map_or(ControlFlow::Break(StopReason::Stalled), ControlFlow::Continue)
    }

    /// Books a round: removes or bars correspondences, enters the hypothesis for the contest if it passed.
    fn book(&mut self, stages: &Stages<'_>, play: Play) {
        let params = stages.params;
        let Play { seeds, dense, estimate, judged } = play;
        if let (Some(raw), Some(judged)) = (estimate.hypothesis, judged) {
            self.tried.add(&raw.target_from_source, judged);
        }
        let index = self.num_rounds();
        let num_alive = self.problem.alive.len() as u32;
        let passed = judged.filter(|judged| judged.verdict.accepted());
        if passed.is_some() {
            self.ahead.forget();
        }
        let (removed, barred) = match (params.removal, passed) {
            (Removal::Dense, _) => (dense.ids(), Vec::new()),
            (Removal::Inliers, None) => (&[][..], seeds.ids().to_vec()),
            // The seeds too: they may all lie outside of the pose that they led to.
            (Removal::Inliers, Some(Judged { hypothesis, .. })) => {
                let context = self.context(params, index);
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
            hypothesis_score: judged.map(|judged| judged.hypothesis.score),
            verdict: judged.map(|judged| judged.verdict),
            num_removed: self.problem.remove(removed),
            num_barred: self.problem.bar(&barred),
        });
        self.enter_contest(stages, passed);
    }

    /// Breaks if no further round may be played.
    fn check_limits(&self, params: &Params) -> ControlFlow<StopReason> {
        let alive = self.problem.alive.len() as u32;
        if alive < MIN_CORRESPONDENCES {
            let threshold = MIN_CORRESPONDENCES;
            return ControlFlow::Break(StopReason::FewCorrespondences { value: alive, threshold });
        }
        let (rounds, found) = (self.num_rounds(), self.num_found());
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

    /// Rounds since a hypothesis last passed validation, or an instance was last found.
    fn num_rejections(&self) -> u32 {
        self.num_rounds() - self.last_passed_at
    }

    /// Ends the first look, if there is one; returns whether there was.
    fn end_first_look(&mut self) -> bool {
        let ends = self.problem.end_first_look();
        if ends {
            self.ahead.forget();
            self.last_passed_at = self.num_rounds();
        }
        ends
    }

    /// [`Self::settle`] as long as the run goes on.
    fn settle_now(&mut self, stages: &Stages<'_>) -> u32 {
        let interrupt = self.problem.interrupt.clone();
        self.settle(stages, &mut Grace::none(&interrupt))
    }

    /// Makes an instance of the best candidate at once.
    fn accept_sure(&mut self, stages: &Stages<'_>) {
        let interrupt = self.problem.interrupt.clone();
        let mut grace = Grace::none(&interrupt);
        if self.measure_candidates(stages, &mut grace)
            && self.prove_candidates(stages, &mut grace)
            && self.turn_best(stages, &mut grace)
        {
            self.accept_best(stages, f64::NEG_INFINITY);
        }
    }
}
