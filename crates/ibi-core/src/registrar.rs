//! The loop: `step` is one round in the paper's order, `run` repeats it.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::Instant;

use nalgebra::Isometry3;

use crate::cloud::{Cloud, PreparedCloud, check_points};
use crate::correspondence::{Correspondences, PointPairs};
use crate::error::{Argument, Error};
use crate::finish::{self, Grace};
use crate::interrupt::{CancelToken, Interrupt, Phase, Watcher};
use crate::joint::{joint_check, supports};
use crate::kernels::graph::Graph;
use crate::kernels::par::{self, Pool};
use crate::params::{Params, Refine, Removal};
use crate::registration::{Registration, Round, StopReason, Timings};
use crate::scene::{Clouds, Detail, Scene};
use crate::stages::{Context, Enhance, EstimatePose, Hypothesis, Polished, Ranked, SelectSeeds, Validate};
use crate::state::{Judged, Play, Problem, State, Tried};

/// A contest accepts nothing below this share of its best value.
const CONTEST_MARGIN: f64 = 0.8;

/// A pose with an MAE of so much is looked at closely at once.
const MANY_INLIERS: f64 = 10.0;

/// After so many rounds in a row that came to nothing, a first look is over.
const FIRST_REJECTIONS: u32 = 4;

/// Poses that move no point farther apart than this are as good as each other.
const NEGLIGIBLE_PR: f64 = 0.3;

/// A pose at a first glance that is so near to one that has been judged will end up there. In a scan, in which thousands of
/// rounds look at the same few faces, a wider circle pays.
const SAME_PR: f64 = 0.5;
const SAME_PR_ONE_SIDED: f64 = 2.0;

/// A prepared source, the parameters and the four stages; registers the source to any number of targets.
///
/// # Examples
/// ```
/// use ibi_core::{Cloud, Correspondences, Params, Registrar, stages::ce};
///
/// // A source of 60 points, and a target that holds it twice, 5 to the right and 5 to the left.
/// let source: Vec<[f64; 3]> =
///     (0..60).map(f64::from).map(|i| [(i * 0.7).sin(), (i * 1.3).cos(), (i * 2.9).sin()]).collect();
/// let moved = |dx: f64| source.iter().map(move |[x, y, z]| [x + dx, *y, *z]);
/// let target: Vec<[f64; 3]> = moved(5.0).chain(moved(-5.0)).collect();
/// // All of the first instance is matched, and two thirds of the second.
/// let rows = (0..100).map(|row| [row % 60, row]).collect();
///
/// // A round removes the n_vot best-voted correspondences, so they should be about as many as one instance has.
/// let params = Params { ce: ce::Voting { n_vot: 50 }.into(), ..Params::default() };
/// let found = Registrar::new(&Cloud::from(source.clone()))?
///     .params(params)
///     .register(&Cloud::from(target), &Correspondences::from_rows(rows))?;
///
/// let mut x: Vec<f64> = found.poses.iter().map(|pose| pose.target_from_source.translation.x.round()).collect();
/// x.sort_by(f64::total_cmp);
/// assert_eq!(x, [-5.0, 5.0]);
/// # Ok::<(), ibi_core::Error>(())
/// ```
pub struct Registrar<'a> {
    source: Arc<PreparedCloud<'a>>,
    params: Params,
    scs: Option<Box<dyn SelectSeeds>>,
    ce: Option<Box<dyn Enhance>>,
    te: Option<Box<dyn EstimatePose>>,
    hv: Option<Box<dyn Validate>>,
    num_threads: Option<usize>,
    cancel: CancelToken,
    watcher: Option<Watcher>,
}

impl<'a> Registrar<'a> {
    /// Checks and prepares the source, with default parameters.
    ///
    /// # Errors
    /// If the source has fewer than three points, or one that is not finite, or all at one place, or normals
    /// that do not fit it.
    pub fn new(source: &Cloud<'a>) -> Result<Self, Error> {
        Ok(Self::of(Arc::new(PreparedCloud::source(source)?)))
    }

    /// For a source that was prepared before, with default parameters: many registrars may share one.
    #[must_use]
    pub fn of(source: Arc<PreparedCloud<'a>>) -> Self {
        Self {
            source,
            params: Params::default(),
            scs: None,
            ce: None,
            te: None,
            hv: None,
            num_threads: None,
            cancel: CancelToken::default(),
            watcher: None,
        }
    }

    /// Sets the parameters; they are checked when a run begins.
    #[must_use]
    pub fn params(mut self, params: Params) -> Self {
        self.params = params;
        self
    }

    /// Threads per run. Default: as many as the process may use. The result does not depend on it. Four for each core (or
    /// eight) are started at most, and those of no more than the cores are kept for the next run that wants as many.
    #[must_use]
    pub fn num_threads(mut self, num_threads: usize) -> Self {
        self.num_threads = Some(num_threads);
        self
    }

    /// A token that cancels the runs from another thread.
    #[must_use]
    pub fn cancel_token(mut self, token: CancelToken) -> Self {
        self.cancel = token;
        self
    }

    /// Is told each phase of the runs as it begins.
    #[must_use]
    pub fn watcher(mut self, watcher: Watcher) -> Self {
        self.watcher = Some(watcher);
        self
    }

    /// Puts a seed selection of your own in the place of `params.scs`.
    #[must_use]
    pub fn with_scs(mut self, scs: impl SelectSeeds + 'static) -> Self {
        self.scs = Some(Box::new(scs));
        self
    }

    /// Puts an enhancement of your own in the place of `params.ce`.
    #[must_use]
    pub fn with_ce(mut self, ce: impl Enhance + 'static) -> Self {
        self.ce = Some(Box::new(ce));
        self
    }

    /// Puts an estimation of your own in the place of `params.te`.
    #[must_use]
    pub fn with_te(mut self, te: impl EstimatePose + 'static) -> Self {
        self.te = Some(Box::new(te));
        self
    }

    /// Puts a validation of your own in the place of `params.hv`.
    #[must_use]
    pub fn with_hv(mut self, hv: impl Validate + 'static) -> Self {
        self.hv = Some(Box::new(hv));
        self
    }

    /// Finds all instances of the source in `target`: [`Self::begin`], [`Self::run`], [`Self::finish`].
    ///
    /// # Errors
    /// Those of [`Self::begin`]. Finding nothing is no error: see [`Registration::stop_reason`].
    pub fn register(
        &self,
        target: &Cloud<'_>,
        correspondences: &Correspondences,
    ) -> Result<Registration, Error> {
        self.register_observed(target, correspondences, &mut ())
    }

    /// [`Self::register`] with an observer that sees every round and may end the run.
    ///
    /// # Errors
    /// Those of [`Self::begin`].
    pub fn register_observed(
        &self,
        target: &Cloud<'_>,
        correspondences: &Correspondences,
        observer: &mut dyn Observer,
    ) -> Result<Registration, Error> {
        let start = Instant::now();
        let pool = Arc::new(Pool::new(self.num_threads)?);
        // Once and not for each step: to hand a job to other threads takes its time.
        pool.install(|| {
            let mut state = match self.begin_on(&pool, target, correspondences) {
                Ok(state) => state,
                Err(Error::Interrupted { reason }) => {
                    let resolution = self.params.resolution.unwrap_or_default();
                    return Ok(Registration::empty(correspondences.len(), reason, start, resolution));
                }
                Err(error) => return Err(error),
            };
            let stop_reason = self.run(&mut state, observer);
            Ok(self.finish(state, stop_reason))
        })
    }

    /// Checks parameters and input, builds what all rounds share.
    ///
    /// # Errors
    /// If a parameter is out of range; if the seed selection needs an argument that is not given; if the target is as
    /// bad as a source may be (see [`Self::new`]); if a correspondence points outside of a cloud; if only one cloud has
    /// normals or frames; if the clouds cannot be in the same unit; if the threads cannot be started.
    /// [`Error::Interrupted`] if a limit strikes or the run is cancelled meanwhile.
    pub fn begin<'s>(
        &'s self,
        target: &Cloud<'s>,
        correspondences: &Correspondences,
    ) -> Result<State<'s>, Error> {
        self.begin_on(&Arc::new(Pool::new(self.num_threads)?), target, correspondences)
    }

    fn begin_on<'s>(
        &'s self,
        pool: &Arc<Pool>,
        target: &Cloud<'s>,
        correspondences: &Correspondences,
    ) -> Result<State<'s>, Error> {
        let start = Instant::now();
        let mut interrupt = Interrupt::new(self.cancel.clone(), start, self.params.timeout_s);
        if let Some(watcher) = &self.watcher {
            interrupt = interrupt.with_watcher(Arc::clone(watcher));
        }
        self.params.validate()?;
        if let Some(argument) = self.scs().needs()
            && !self.is_given(argument, target, correspondences)
        {
            return Err(Error::Missing { argument });
        }
        let (scene, pairs) = pool.install(|| {
            interrupt.begin(Phase::Prepare);
            let prepared = PreparedCloud::new(
                target,
                Argument::Tgt,
                Argument::TgtNormals,
                Argument::TgtFrames,
                &interrupt,
            )?;
            let measured = target.measured.as_deref();
            if let Some(points) = measured {
                check_points(points, Argument::Measured)?;
            }
            let clouds = Clouds::new(&self.source, prepared, &self.params)?;
            let (near, pairs) = par::join(
                || clouds.near(&self.params, &interrupt),
                || PointPairs::new(correspondences, &clouds, self.params.oriented_normals, &interrupt),
            );
            let pairs = pairs?;
            let scene = Scene::new(clouds, near?, measured, &self.params, &interrupt)?;
            Ok::<_, Error>((scene, pairs))
        })?;
        Ok(State::new(Problem::new(scene, pairs, interrupt), Arc::clone(pool), start))
    }

    /// Whether an optional argument is there; the others always are.
    fn is_given(&self, argument: Argument, target: &Cloud<'_>, correspondences: &Correspondences) -> bool {
        match argument {
            Argument::SrcNormals => self.source.normals.is_some(),
            Argument::TgtNormals => target.normals.is_some(),
            Argument::SrcFrames => self.source.frames.is_some(),
            Argument::TgtFrames => target.frames.is_some(),
            Argument::Similarity => correspondences.has_similarity(),
            Argument::Viewpoint => target.viewpoint.is_some(),
            Argument::Measured => target.measured.is_some(),
            Argument::Src | Argument::Tgt | Argument::Corr => true,
        }
    }

    /// Plays rounds until one of them ends the run, or the observer does.
    pub fn run(&self, state: &mut State<'_>, observer: &mut dyn Observer) -> StopReason {
        let pool = Arc::clone(&state.pool);
        pool.install(|| {
            loop {
                match self.step(state) {
                    ControlFlow::Break(reason) => return reason,
                    ControlFlow::Continue(round) if observer.on_round(&round).is_break() => {
                        return StopReason::Cancelled;
                    }
                    ControlFlow::Continue(_) => {}
                }
            }
        })
    }

    /// Plays one round: SCS -> CE -> TE -> HV, then removal. Breaks with the reason if the run is over.
    pub fn step(&self, state: &mut State<'_>) -> ControlFlow<StopReason, Round> {
        let pool = Arc::clone(&state.pool);
        pool.install(|| {
            loop {
                let played = state.rounds.len();
                let flow = self.round(state);
                // Where the rounds run dry, candidates still waiting may free the way for further ones.
                match flow {
                    ControlFlow::Break(reason)
                        if reason.is_dry()
                            && self.settle(state, &mut Grace::none(&state.problem.interrupt.clone())) > 0 => {
                    }
                    flow => return flow,
                }
                // A round that was played to its end is reported, although it would have ended the run.
                if let Some(round) = state.rounds.get(played) {
                    return ControlFlow::Continue(round.clone());
                }
            }
        })
    }

    fn round(&self, state: &mut State<'_>) -> ControlFlow<StopReason, Round> {
        state.check_limits(&self.params)?;
        let play = self.play(state);
        state.problem.interrupt.check()?;
        state.timings.add(&play.timings);
        if play.seeds.len() < self.params.t_s as usize {
            if state.end_first_look() {
                return self.round(state);
            }
            let (value, threshold) = (play.seeds.len() as u32, self.params.t_s);
            return ControlFlow::Break(StopReason::FewSeeds { value, threshold });
        }
        let verdict = state.conclude(&self.params, play);
        if verdict.is_some_and(|verdict| verdict.accepted() && self.hv().is_sure(&verdict)) {
            let interrupt = state.problem.interrupt.clone();
            let mut grace = Grace::none(&interrupt);
            if state.measure_candidates(&self.params, self.hv(), &mut grace)
                && state.turn_best(&self.params, self.hv(), &mut grace)
            {
                state.accept_best(&self.params, f64::NEG_INFINITY);
            }
        }
        if state.num_rejections() >= FIRST_REJECTIONS {
            state.end_first_look();
        }
        if state.rounds_since_settling >= self.params.n_contest {
            self.settle(state, &mut Grace::none(&state.problem.interrupt.clone()));
        }
        state.last_round()
    }

    /// What the stages make of the next round. Where a second thread is idle it selects the seeds of the round after it at
    /// the same time, as they will be if this one comes to nothing: most do, and else they are selected again.
    fn play(&self, state: &mut State<'_>) -> Play {
        let ahead = state.ahead.take();
        let State { problem, tried, found, .. } = &*state;
        let round = state.rounds.len();
        let context = problem.context(&self.params, round, found);
        let select = || self.select(&context);
        let (seeds, timings) = match ahead {
            Some(selected) => selected,
            // The first selection builds the graph, and leaves a second thread idle in between.
            None if round == 0 && self.scs.is_none() => par::join(select, || context.chance()).0,
            None => select(),
        };
        // At the latest now, and not at the end, when there may be no time for it.
        context.chance();
        let is_lean = state.rounds.last().is_some_and(|last| !last.accepted());
        if !is_lean || !self.selects_ahead(problem) || seeds.len() < self.params.t_s as usize {
            let play = || self.play_seeds(&context, tried, is_lean, seeds, timings);
            // After a success the next one is likely, and selecting ahead would be in vain: an idle thread had better measure
            // what was found.
            return match found.last().filter(|_| !is_lean && par::is_parallel()) {
                Some(found) => par::join(play, || found.overlap(&problem.scene, &self.params)).0,
                None => play(),
            };
        }
        let barred = problem.also_barred(seeds.ids());
        let (play, next) = par::join(
            || self.play_seeds(&context, tried, is_lean, seeds, timings),
            || self.select(&Context { barred: &barred, ..problem.context(&self.params, round + 1, found) }),
        );
        state.ahead = Some(next);
        play
    }

    /// SCS, and how long it took.
    fn select(&self, context: &Context<'_>) -> (Ranked, Timings) {
        let mut timings = Timings::default();
        if !context.interrupt.enter(Phase::Select) {
            return (Ranked::default(), timings);
        }
        let seeds = timed(&mut timings.scs_s, || self.scs().select_seeds(context));
        (seeds, timings)
    }

    /// Whether the seeds of a round may be selected before the one before it is concluded. Not with stages of the user's,
    /// which may count their rounds; nor if a round removes correspondences whatever comes of it; nor at a first look, which
    /// the number of neighbourhoods that come to nothing brings to its end.
    fn selects_ahead(&self, problem: &Problem<'_>) -> bool {
        let has_own_stage = self.scs.is_some() || self.ce.is_some() || self.te.is_some() || self.hv.is_some();
        let is_sample = problem.graph.get().is_some_and(Graph::is_sample);
        par::is_parallel() && !has_own_stage && self.params.removal == Removal::Inliers && !is_sample
    }

    /// CE -> TE -> HV. `is_lean`: whether the round before came to nothing.
    fn play_seeds(
        &self,
        context: &Context<'_>,
        tried: &Tried,
        is_lean: bool,
        seeds: Ranked,
        mut timings: Timings,
    ) -> Play {
        if seeds.len() < self.params.t_s as usize || !context.interrupt.enter(Phase::Enhance) {
            return Play { seeds, timings, ..Play::default() };
        }
        let dense = timed(&mut timings.ce_s, || self.ce().enhance(context, &seeds));
        if !context.interrupt.enter(Phase::Estimate) {
            return Play { seeds, timings, ..Play::default() };
        }
        let estimate = timed(&mut timings.te_s, || self.te().estimate_pose(context, &dense));
        let judged = estimate.hypothesis.map(|raw| {
            let before = self.known(context.scene, tried, &raw, None);
            before.or_else(|| self.judge(context, tried, is_lean, raw, &mut timings))
        });
        let judged = judged.flatten();
        Play { seeds, dense, estimate, judged, timings }
    }

    /// What became of a hypothesis that was tried before, or of one that ended up where it is at a first glance, `rough`:
    /// many seeds lead to one and the same pose.
    fn known(
        &self,
        scene: &Scene<'_>,
        tried: &Tried,
        raw: &Hypothesis,
        rough: Option<&Isometry3<f64>>,
    ) -> Option<Judged> {
        if !self.hv().is_repeatable() {
            return None;
        }
        let same_pr = if scene.is_one_sided(&self.params) { SAME_PR_ONE_SIDED } else { SAME_PR };
        let is_same = |a: &Isometry3<f64>, b: &Isometry3<f64>| {
            scene.source.displacement(a, b) < same_pr * scene.resolution
        };
        let same = tried.get(&raw.target_from_source);
        same.or_else(|| rough.and_then(|rough| tried.next_to(rough, is_same)))
    }

    /// Polishes a hypothesis and validates it. Neither is done to the end where a rough polish, of one that has few inliers
    /// or where the scene is seen from one side, shows it to be known; or where a glance shows it to be hopeless, which is
    /// not expected after a success. `None` once the run was interrupted.
    fn judge(
        &self,
        context: &Context<'_>,
        tried: &Tried,
        is_lean: bool,
        raw: Hypothesis,
        timings: &mut Timings,
    ) -> Option<Judged> {
        let Timings { refine_s, hv_s, .. } = timings;
        let scene = context.scene;
        let is_one_sided = scene.is_one_sided(context.params);
        let is_poor = raw.score < MANY_INLIERS || is_one_sided;
        if self.params.refine != Refine::None && !context.interrupt.enter(Phase::Polish) {
            return None;
        }
        let polished = if is_poor { timed(refine_s, || context.polished(Detail::Glance, raw)) } else { None };
        let supported = polished.and_then(Polished::if_supported);
        let glanced = supported.unwrap_or(raw);
        // In a scan clouds fit almost anywhere: what has lost its correspondences there might as well be elsewhere.
        let rough = (supported.is_some() || !is_one_sided).then_some(glanced.target_from_source);
        if let Some(known) = self.known(scene, tried, &raw, rough.as_ref()) {
            return Some(known);
        }
        let fitted = polished.filter(|_| !is_one_sided).map_or(glanced, |polished| polished.hypothesis);
        if is_lean && let Some(verdict) = timed(hv_s, || self.hv().glance(context, &fitted)) {
            return Some(Judged { hypothesis: glanced, verdict });
        }
        let hypothesis = timed(refine_s, || context.refined(Detail::Look, glanced)).unwrap_or(raw);
        if !context.interrupt.enter(Phase::Validate) {
            return None;
        }
        let verdict = timed(hv_s, || self.hv().validate(context, &hypothesis));
        // The clouds of a cluttered scene may draw a good pose away.
        let shift = scene.source.displacement(&raw.target_from_source, &hypothesis.target_from_source);
        if verdict.accepted() && shift > NEGLIGIBLE_PR * scene.resolution {
            let before = timed(hv_s, || self.hv().validate(context, &raw));
            if before.value > verdict.value {
                return Some(Judged { hypothesis: raw, verdict: before });
            }
        }
        Some(Judged { hypothesis, verdict })
    }

    /// Ends a contest: of the hypotheses that passed validation, the one with the best value becomes an
    /// instance and claims its scene points; the others are measured again on what is left, and so on. Those far
    /// below the best stay for the next contest, in which a better pose of the same instance may turn up. So do all once
    /// there is no time for it.
    fn settle(&self, state: &mut State<'_>, grace: &mut Grace<'_>) -> u32 {
        state.problem.interrupt.begin(Phase::Contest);
        let start = Instant::now();
        let mut best_value = None;
        let mut num_accepted = 0;
        while self.params.max_instances.is_none_or(|limit| state.num_found() < limit) {
            let has_time = grace.allows(state.num_candidates() + 1);
            if !has_time || !state.measure_candidates(&self.params, self.hv(), grace) {
                break;
            }
            let least = best_value.map_or(f64::NEG_INFINITY, |value: f64| CONTEST_MARGIN * value);
            if !state.turn_best(&self.params, self.hv(), grace) {
                break;
            }
            let Some(value) = state.accept_best(&self.params, least) else { break };
            best_value = best_value.or(Some(value));
            num_accepted += 1;
        }
        state.rounds_since_settling = 0;
        state.timings.hv_s += start.elapsed().as_secs_f64();
        num_accepted
    }

    /// Turns what a run has found into its result: the contest is settled, the poses are checked and ranked.
    ///
    /// Of a run that was ended from outside, by now or in the course of this, a bounded part of that is still done, in the
    /// order in which the poses were found, and enough for some hundred of them: a pose for which it does not suffice is left
    /// out, as nothing can be said for it. If it is ended in the course of this, the stop reason is that.
    #[must_use]
    pub fn finish(&self, mut state: State<'_>, stop_reason: StopReason) -> Registration {
        let pool = Arc::clone(&state.pool);
        pool.install(|| {
            let interrupt = state.problem.interrupt.clone();
            let mut grace = Grace::new(&interrupt, finish::CONTEST, stop_reason.is_from_outside());
            while self.settle(&mut state, &mut grace) > 0 {}
            let mut grace = Grace::new(&interrupt, finish::CHECK, grace.is_over());
            let State { problem, found, .. } = &mut state;
            let supports = if self.params.joint_check {
                joint_check(problem, &self.params, self.hv(), found, &mut grace)
            } else {
                supports(problem, &self.params, found, &mut grace)
            };
            let mut grace = Grace::new(&interrupt, finish::RANK, grace.is_over());
            state.into_registration(&self.params, stop_reason, &supports, &mut grace)
        })
    }

    fn scs(&self) -> &dyn SelectSeeds {
        self.scs.as_deref().unwrap_or(&self.params.scs)
    }

    fn ce(&self) -> &dyn Enhance {
        self.ce.as_deref().unwrap_or(&self.params.ce)
    }

    fn te(&self) -> &dyn EstimatePose {
        self.te.as_deref().unwrap_or(&self.params.te)
    }

    fn hv(&self) -> &dyn Validate {
        self.hv.as_deref().unwrap_or(&self.params.hv)
    }
}

impl std::fmt::Debug for Registrar<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Registrar").field("params", &self.params).finish_non_exhaustive()
    }
}

/// Sees every round of a run; may end it. Any `FnMut(&Round) -> ControlFlow<()>` is one.
pub trait Observer: Send {
    /// Called after each round; `Break` ends the run, which keeps what it has found.
    fn on_round(&mut self, round: &Round) -> ControlFlow<()>;
}

/// Watches nothing.
impl Observer for () {
    fn on_round(&mut self, _round: &Round) -> ControlFlow<()> {
        ControlFlow::Continue(())
    }
}

impl<F: FnMut(&Round) -> ControlFlow<()> + Send> Observer for F {
    fn on_round(&mut self, round: &Round) -> ControlFlow<()> {
        self(round)
    }
}

/// Runs `job` and adds its seconds to `total_s`.
fn timed<T>(total_s: &mut f64, job: impl FnOnce() -> T) -> T {
    let start = Instant::now();
    let result = job();
    *total_s += start.elapsed().as_secs_f64();
    result
}
