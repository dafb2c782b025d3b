//! The loop: `step` is one round in the paper's order, `run` repeats it.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::Instant;

use crate::error::{Argument, Error};
use crate::evidence::Closeup;
use crate::grace::{self, Grace};
use crate::interrupt::{CancelToken, Interrupt, Phase, Watcher};
use crate::kernels::par::{self, Pool};
use crate::params::Params;
use crate::registration::{Registration, Round};
use crate::rounds::{Play, Problem, Shortcuts, Stages, State};
use crate::scene::{Cloud, Clouds, Correspondences, PointPairs, PreparedCloud, Scene};
use crate::stages::{Enhance, EstimatePose, SelectSeeds, Validate};
use crate::stop::StopReason;

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
    shortcuts: Shortcuts,
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
            shortcuts: Shortcuts::default(),
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

    /// Which shortcuts the runs take; all by default.
    #[cfg(feature = "internals")]
    #[must_use]
    pub fn shortcuts(mut self, shortcuts: Shortcuts) -> Self {
        self.shortcuts = shortcuts;
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
        if let Some(argument) = self.stages().scs.needs()
            && !self.is_given(argument, target, correspondences)
        {
            return Err(Error::Missing { argument });
        }
        let (scene, pairs, closeup) = pool.install(|| {
            interrupt.begin(Phase::Prepare);
            let prepared = PreparedCloud::new(
                target,
                Argument::Tgt,
                Argument::TgtNormals,
                Argument::TgtFrames,
                &interrupt,
            )?;
            let clouds = Clouds::new(&self.source, prepared, self.params.resolution)?;
            let tolerances = self.params.tolerances();
            let (near, pairs) = par::join(
                || clouds.near(&tolerances, &interrupt),
                || PointPairs::new(correspondences, &clouds, self.params.oriented_normals, &interrupt),
            );
            let pairs = pairs?;
            let scene = Scene::new(clouds, near?, &target.measured, tolerances, &interrupt)?;
            // Where nothing more was measured than the target there is nothing more to look at.
            let is_more = !target.measured.parts.is_empty() || scene.eyes.len() > 1;
            let closeup = is_more.then(|| Closeup::new(&scene, &target.measured, &interrupt)).flatten();
            Ok::<_, Error>((scene, pairs, closeup))
        })?;
        Ok(State::new(Problem::new(scene, pairs, closeup, interrupt), Arc::clone(pool), start))
    }

    /// Whether an optional argument is there; the others always are.
    fn is_given(&self, argument: Argument, target: &Cloud<'_>, correspondences: &Correspondences) -> bool {
        match argument {
            Argument::SrcNormals => self.source.normals.is_some(),
            Argument::TgtNormals => target.normals.is_some(),
            Argument::SrcFrames => self.source.frames.is_some(),
            Argument::TgtFrames => target.frames.is_some(),
            Argument::Similarity => correspondences.has_similarity(),
            Argument::Viewpoint => !target.viewpoints.is_empty(),
            Argument::Measured => !target.measured.parts.is_empty(),
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

    /// Plays one round of the paper's loop: SCS -> CE -> TE -> HV, then removal. Breaks with the reason if the run is over.
    pub fn step(&self, state: &mut State<'_>) -> ControlFlow<StopReason, Round> {
        let (pool, stages) = (Arc::clone(&state.pool), self.stages());
        pool.install(|| {
            // SCS: the seeds C_s, few alive correspondences that are highly consistent with each other (Eq. 1 to 5).
            let seeds = state.select_seeds(&stages)?;
            let play = state.play(&stages, seeds, |stage, context, seeds| {
                // CE: the dense C_d, the alive correspondences that the seeds vote for (Eq. 6).
                let dense = stage.enhance(context, &seeds)?;
                // TE: of the poses that C_d suggests the one with the highest MAE (Eq. 7, 8).
                let estimate = stage.estimate_pose(context, &dense)?;
                // HV: that pose held against both clouds (Eq. 9).
                let judged = stage.validate(context, &estimate);
                Some(Play { seeds, dense, estimate, judged })
            })?;
            // Removal: of C_d, or of what an accepted pose explains; then the next instance.
            state.conclude(&stages, play)
        })
    }

    /// Turns what a run has found into its result: the contest is settled, the poses are checked and ranked.
    ///
    /// Of a run that was ended from outside, by now or in the course of this, a bounded part of that is still done, in the
    /// order in which the poses were found, and enough for some hundred of them: a pose for which it does not suffice is left
    /// out, as nothing can be said for it. If it is ended in the course of this, the stop reason is that.
    #[must_use]
    pub fn finish(&self, mut state: State<'_>, stop_reason: StopReason) -> Registration {
        let (pool, stages) = (Arc::clone(&state.pool), self.stages());
        pool.install(|| {
            let interrupt = state.problem.interrupt.clone();
            let mut grace = Grace::new(&interrupt, grace::CONTEST, stop_reason.is_from_outside());
            while state.settle(&stages, &mut grace) > 0 {}
            let mut grace = Grace::new(&interrupt, grace::CHECK, grace.is_over());
            let supports = state.supports(&stages, &mut grace);
            let mut grace = Grace::new(&interrupt, grace::POLISH, grace.is_over());
            state.polish_lastly(&mut grace);
            let mut grace = Grace::new(&interrupt, grace::RANK, grace.is_over());
            state.into_registration(stop_reason, &supports, &mut grace)
        })
    }

    /// The stages of the parameters, but where the user has put one of their own.
    fn stages(&self) -> Stages<'_> {
        let Self { params, scs, ce, te, hv, .. } = self;
        Stages {
            scs: scs.as_deref().unwrap_or(&params.scs),
            ce: ce.as_deref().unwrap_or(&params.ce),
            te: te.as_deref().unwrap_or(&params.te),
            hv: hv.as_deref().unwrap_or(&params.hv),
            has_own_scs: scs.is_some(),
            has_own: scs.is_some() || ce.is_some() || te.is_some() || hv.is_some(),
            params,
            shortcuts: self.shortcuts,
        }
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
