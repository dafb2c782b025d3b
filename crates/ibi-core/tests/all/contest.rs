//! Contests: hypotheses that passed validation wait for `n_contest` rounds, then the best become instances. With
//! mocks first, then with the single-view preset.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use crate::mock::{Mock, long_enough};
use ibi_core::nalgebra::{Isometry3, Point3, Vector3};
use ibi_core::stages::te::Gsac;
use ibi_core::stages::{Context, Estimate, Hypothesis, Ranked, Validate, Verdict};
use ibi_core::{
    CancelToken, Cloud, Correspondences, Params, Refine, Registrar, Registration, Removal, Round, State,
    StopReason,
};
use ibi_testkit::scenes::asymmetric_model;
use ibi_testkit::{Rng, naive};

/// The model is 10 points in a row, 1 apart; the scene is 100. Placed at x, it explains rows x to x + 9.
const MODEL: usize = 10;
const M: usize = 100;

fn row_of_points(n: usize) -> Vec<Point3<f64>> {
    (0..n).map(|i| Point3::new(i as f64, 0.0, 0.0)).collect()
}

fn correspondences() -> Correspondences {
    Correspondences::from_rows((0..M).map(|i| [i % MODEL, i]).collect())
}

fn first_alive(context: &Context<'_>, n: usize) -> Ranked {
    Ranked::new(context.alive.ids().iter().take(n).map(|&id| (id, 1.0)).collect())
}

fn base() -> Params {
    Params { d_op_pr: 0.1, t_he_pr: 1.0, t_s: 3, ..Params::paper_synthetic() }
}

fn contest(n_contest: u32) -> Params {
    Params { n_contest, ..base() }
}

/// One hypothesis a round: where the model is placed, and how good that is. None is good after the last.
type Plan = &'static [(usize, f64)];

const THRESHOLD: f64 = 0.3;

/// Plays `plan`; the value of a hypothesis is its quality times the share of its ten scene points that nobody
/// has claimed. Five correspondences go in each round.
fn planned(plan: Plan, params: Params) -> Registrar<'static> {
    let at = |plan: Plan, round: u32| plan.get(round as usize).copied().unwrap_or((0, 0.0));
    Registrar::new(&Cloud::from(row_of_points(MODEL)))
        .unwrap()
        .params(params)
        .num_threads(1)
        .with_scs(Mock(|context: &Context<'_>| first_alive(context, 5)))
        .with_ce(Mock(|_: &Context<'_>, seeds: &Ranked| seeds.clone()))
        .with_te(Mock(move |context: &Context<'_>, _: &Ranked| {
            let x = at(plan, context.round).0 as f64;
            let hypothesis =
                Hypothesis { target_from_source: Isometry3::translation(x, 0.0, 0.0), score: 1.0 };
            Estimate { hypothesis: Some(hypothesis), num_samples: 1, num_degenerate: 0, capped: false }
        }))
        .with_hv(Mock(move |context: &Context<'_>, hypothesis: &Hypothesis| {
            // Measured again, it is still the hypothesis of its own round.
            let (x, quality) = at(plan, context.round);
            assert_eq!(hypothesis.target_from_source.translation.x, x as f64);
            let free = (x as u32..(x + MODEL) as u32).filter(|&row| !context.claims.contains(row)).count();
            Verdict { value: quality * free as f64 / MODEL as f64, threshold: THRESHOLD }
        }))
}

fn register(registrar: &Registrar<'_>) -> Registration {
    registrar.register(&Cloud::from(row_of_points(M)), &correspondences()).unwrap()
}

/// Where the instances found so far are, in the order in which they were found.
fn places(state: &State<'_>) -> Vec<usize> {
    state.poses().map(|pose| pose.translation.x as usize).collect()
}

/// The same of a result, by place.
fn sorted_places(result: &Registration) -> Vec<usize> {
    let mut places: Vec<_> =
        result.poses.iter().map(|pose| pose.target_from_source.translation.x as usize).collect();
    places.sort_unstable();
    places
}

/// The instances found after each round.
fn history(plan: Plan, params: Params) -> Vec<Vec<usize>> {
    let registrar = planned(plan, params);
    let mut state = registrar.begin(&Cloud::from(row_of_points(M)), &correspondences()).unwrap();
    let mut history = Vec::new();
    while let ControlFlow::Continue(_) = registrar.step(&mut state) {
        history.push(places(&state));
    }
    history
}

#[test]
fn the_best_of_a_contest_is_the_first_instance() {
    let plan: Plan = &[(0, 0.9), (20, 0.85), (40, 1.0), (60, 0.95)];
    let history = history(plan, contest(4));
    assert_eq!(history[..3], [const { Vec::<usize>::new() }; 3], "nothing before the end of the contest");
    assert_eq!(history[3], [40, 60, 0, 20]);
    assert_eq!(history.last().unwrap().len(), 4);
    // Found in the order of their values, but each by its own round.
    let result = register(&planned(plan, contest(4)));
    let by_round: Vec<_> =
        result.poses.iter().map(|p| (p.target_from_source.translation.x as usize / 20, p.round)).collect();
    assert!(by_round.iter().all(|&(place, round)| place == round as usize), "{by_round:?}");
}

#[test]
fn of_equals_the_earlier_is_first() {
    let plan: Plan = &[(60, 0.9), (0, 0.9), (30, 0.9)];
    assert_eq!(history(plan, contest(3))[2], [60, 0, 30]);
}

#[test]
fn what_an_instance_claims_supports_no_other_candidate() {
    // 0 shares half of its points with 5, the best, and falls to 0.25; 20 shares none.
    let plan: Plan = &[(0, 0.5), (5, 1.0), (20, 0.9)];
    let found = history(plan, contest(3));
    assert_eq!((&found[2], found.last().unwrap()), (&vec![5, 20], &vec![5, 20]));
    // 37 shares three points with 30 and falls to 0.69: too little now, enough for the end.
    let plan: Plan = &[(37, 0.99), (30, 1.0), (60, 0.8)];
    let found = history(plan, contest(3));
    assert_eq!((&found[2], &found[5]), (&vec![30, 60], &vec![30, 60, 37]));
}

#[test]
fn candidates_far_below_the_best_wait_for_the_next_contest() {
    // 0.8 of the best is enough, less is not.
    let plan: Plan = &[(0, 0.79), (20, 1.0), (40, 0.8), (60, 0.0), (80, 0.0), (70, 0.0)];
    let found = history(plan, contest(3));
    assert_eq!(found[2], [20, 40]);
    assert_eq!((&found[4], &found[5]), (&vec![20, 40], &vec![20, 40, 0]));
    // A better pose of the same instance turns up in time.
    let plan: Plan = &[(1, 0.6), (20, 1.0), (40, 1.0), (60, 0.0), (0, 0.9), (70, 0.0)];
    let found = history(plan, contest(3));
    assert_eq!((&found[2], &found[5]), (&vec![20, 40], &vec![20, 40, 0]));
    assert_eq!(found.last().unwrap(), &[20, 40, 0]);
}

#[test]
fn a_contest_keeps_to_max_instances() {
    let plan: Plan = &[(0, 0.9), (20, 0.85), (40, 1.0), (60, 0.95)];
    for limit in 0..4 {
        let params = Params { max_instances: Some(limit), ..contest(4) };
        let result = register(&planned(plan, params));
        assert_eq!(result.stop_reason, StopReason::MaxInstances { value: limit, threshold: limit });
        let best = [vec![], vec![40], vec![40, 60], vec![0, 40, 60]];
        assert_eq!(sorted_places(&result), best[limit as usize]);
    }
    // Also where the last contest is settled by the end of the run.
    for (n_contest, max_rounds) in [(100, Some(4)), (100, None)] {
        let params = Params { max_instances: Some(2), max_rounds, ..contest(n_contest) };
        assert_eq!(sorted_places(&register(&planned(plan, params))), [40, 60]);
    }
}

// -------------------------------------------------------------------------------------- the sure, the hopeless

/// Validates as planned; what exceeds `sure` does not wait, and what falls short of `hopeless` is seen at a glance.
struct Knowing {
    plan: Plan,
    sure: f64,
    hopeless: f64,
    looks: Arc<AtomicU32>,
}

impl Validate for Knowing {
    fn validate(&self, context: &Context<'_>, _: &Hypothesis) -> Verdict {
        self.looks.fetch_add(1, Ordering::Relaxed);
        self.verdict(context)
    }

    fn glance(&self, context: &Context<'_>, _: &Hypothesis) -> Option<Verdict> {
        Some(self.verdict(context)).filter(|verdict| verdict.value < self.hopeless)
    }

    fn is_sure(&self, verdict: &Verdict) -> bool {
        verdict.value > self.sure
    }
}

impl Knowing {
    fn verdict(&self, context: &Context<'_>) -> Verdict {
        let (x, quality) = self.plan.get(context.round as usize).copied().unwrap_or((0, 0.0));
        let free = (x as u32..(x + MODEL) as u32).filter(|&row| !context.claims.contains(row)).count();
        Verdict { value: quality * free as f64 / MODEL as f64, threshold: THRESHOLD }
    }
}

#[test]
fn a_sure_hypothesis_does_not_wait_for_the_end_of_the_contest() {
    let plan: Plan = &[(0, 0.5), (20, 0.95), (40, 0.6), (1, 0.7), (60, 0.92), (80, 0.0)];
    let knowing = Knowing { plan, sure: 0.9, hopeless: 0.0, looks: Arc::default() };
    let registrar = planned(plan, contest(5)).with_hv(knowing);
    let mut state = registrar.begin(&Cloud::from(row_of_points(M)), &correspondences()).unwrap();
    let mut history = Vec::new();
    while let ControlFlow::Continue(_) = registrar.step(&mut state) {
        history.push(places(&state));
    }
    assert_eq!(history[..4], [vec![], vec![20], vec![20], vec![20]]);
    // The contest goes on without it, and has its own best first: 1, which takes nine points from 0.
    assert_eq!(history[4], [20, 60, 1, 40]);
}

#[test]
fn what_is_hopeless_at_a_glance_is_not_looked_at() {
    // Polished in place, so that there is something to glance at. Two are worth a look; the first and those that follow
    // them get one anyhow, as a success is expected there.
    let plan: Plan = &[(0, 0.1), (20, 0.8), (40, 0.1), (60, 0.1), (80, 0.1), (0, 0.9), (80, 0.1), (60, 0.1)];
    let looks = |hopeless: f64| {
        let looks = Arc::new(AtomicU32::new(0));
        let knowing = Knowing { plan, sure: 2.0, hopeless, looks: Arc::clone(&looks) };
        let params = Params { refine: Refine::Icp, max_rounds: Some(8), removal: Removal::Dense, ..base() };
        let result = register(&planned(plan, params).with_hv(knowing));
        let verdicts: Vec<_> = result.rounds.iter().map(|round| round.verdict.unwrap().value).collect();
        assert_eq!(verdicts, plan.iter().map(|&(_, quality)| quality).collect::<Vec<_>>());
        assert_eq!(sorted_places(&result), [0, 20]);
        looks.load(Ordering::Relaxed)
    };
    assert_eq!((looks(0.0), looks(0.2)), (8, 5));
}

// ------------------------------------------------------------------- nothing that waits is lost when a run ends

const WAITING: Plan = &[(0, 0.9), (20, 1.0), (40, 0.85)];
const ALL: [usize; 3] = [0, 20, 40];

/// A contest that no run lives to see the end of.
fn endless() -> Params {
    contest(u32::MAX)
}

#[test]
fn nothing_is_lost_when_the_rounds_run_dry() {
    let dry_seeds = planned(WAITING, endless())
        .with_scs(Mock(|context: &Context<'_>| first_alive(context, if context.round < 3 { 5 } else { 2 })));
    let result = register(&dry_seeds);
    assert_eq!(result.stop_reason, StopReason::FewSeeds { value: 2, threshold: 3 });
    assert_eq!(sorted_places(&result), ALL);

    let few = planned(WAITING, endless()).with_scs(Mock(|context: &Context<'_>| first_alive(context, 33)));
    let result = register(&few);
    assert_eq!(result.stop_reason, StopReason::FewCorrespondences { value: 1, threshold: 3 });
    assert_eq!((result.rounds.len(), sorted_places(&result)), (3, ALL.to_vec()));

    // What passes is no rejection, and what was only waiting is none either: the count begins anew after the third
    // round, and once more when the instances are found after the sixth.
    let result = register(&planned(WAITING, Params { max_rejections: Some(3), ..endless() }));
    assert_eq!(result.stop_reason, StopReason::MaxRejections { value: 3, threshold: 3 });
    assert_eq!((result.rounds.len(), sorted_places(&result)), (9, ALL.to_vec()));

    // The same five seeds for ever: every round after the first removes nothing.
    let stalled = planned(WAITING, endless())
        .with_scs(Mock(|_: &Context<'_>| Ranked::new((0..5).map(|id| (id, 1.0)).collect())));
    let result = register(&stalled);
    assert_eq!(result.stop_reason, StopReason::Stalled);
    assert_eq!(sorted_places(&result), ALL);
}

#[test]
fn candidates_far_below_the_best_are_found_when_the_rounds_run_dry() {
    let plan: Plan = &[(0, 0.4), (20, 1.0), (40, 0.6), (60, 0.7)];
    let result = register(&planned(plan, endless()));
    assert_eq!(result.stop_reason, StopReason::FewCorrespondences { value: 0, threshold: 3 });
    assert_eq!(sorted_places(&result), [0, 20, 40, 60]);
}

#[test]
fn nothing_is_lost_at_max_rounds() {
    let result = register(&planned(WAITING, Params { max_rounds: Some(3), ..endless() }));
    assert_eq!(result.stop_reason, StopReason::MaxRounds { value: 3, threshold: 3 });
    assert_eq!(sorted_places(&result), ALL);
}

#[test]
fn nothing_is_lost_at_a_timeout() {
    // The fourth round outlasts the timeout and is thrown away.
    let result = long_enough(3, |timeout_s, reached| {
        let waits = move |context: &Context<'_>, seeds: &Ranked| {
            reached(context.round);
            while context.round == 3 && !context.interrupt.is_set() {
                std::thread::yield_now();
            }
            seeds.clone()
        };
        register(&planned(WAITING, Params { timeout_s: Some(timeout_s), ..endless() }).with_ce(Mock(waits)))
    });
    assert!(matches!(result.stop_reason, StopReason::Timeout { .. }), "{}", result.stop_reason);
    assert_eq!((result.rounds.len(), sorted_places(&result)), (3, ALL.to_vec()));
}

#[test]
fn nothing_is_lost_when_somebody_ends_the_run() {
    let (target, rows) = (Cloud::from(row_of_points(M)), correspondences());
    let mut observer = |round: &Round| {
        if round.index == 2 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let by_observer = planned(WAITING, endless()).register_observed(&target, &rows, &mut observer).unwrap();
    let token = CancelToken::default();
    let inside = token.clone();
    let by_token = register(&planned(WAITING, endless()).cancel_token(token).with_ce(Mock(
        move |context: &Context<'_>, seeds: &Ranked| {
            if context.round == 3 {
                inside.cancel();
            }
            seeds.clone()
        },
    )));
    for result in [by_observer, by_token] {
        assert_eq!(result.stop_reason, StopReason::Cancelled);
        assert_eq!((result.rounds.len(), sorted_places(&result)), (3, ALL.to_vec()));
    }
}

#[test]
fn what_waits_is_found_by_whoever_steps_and_finishes() {
    let registrar = planned(WAITING, endless());
    let mut state = registrar.begin(&Cloud::from(row_of_points(M)), &correspondences()).unwrap();
    for _ in 0..3 {
        assert!(registrar.step(&mut state).is_continue());
    }
    assert!(places(&state).is_empty());
    assert_eq!(sorted_places(&registrar.finish(state, StopReason::Cancelled)), ALL);
}

#[test]
fn contests_of_one_round_accept_at_once() {
    // In the order of the rounds, whatever the values; what was claimed before counts at first sight.
    let plan: Plan = &[(0, 0.5), (5, 1.0), (3, 1.0), (20, 0.35), (40, 0.3), (60, 1.0)];
    let found = history(plan, contest(1));
    let expected: [&[usize]; 6] = [&[0], &[0, 5], &[0, 5], &[0, 5, 20], &[0, 5, 20], &[0, 5, 20, 60]];
    assert_eq!(found[..6], expected);
    let result = register(&planned(plan, contest(1)));
    let accepted = result.rounds.iter().filter(|round| round.accepted()).count();
    assert_eq!(accepted, result.poses.len());
}

#[test]
fn an_instance_uses_up_its_inliers_when_its_contest_ends() {
    let params = Params { removal: Removal::Inliers, t_he_pr: 0.4, max_rounds: Some(4), ..contest(2) };
    let plan: Plan = &[(0, 0.9), (20, 1.0), (50, 0.9), (80, 0.0)];
    let registrar = planned(plan, params).with_scs(Mock(|context: &Context<'_>| {
        let free = context.alive.ids().iter().filter(|&&id| !context.barred[id as usize]);
        Ranked::new(free.take(5).map(|&id| (id, 1.0)).collect())
    }));
    let result = register(&registrar);
    let booked: Vec<_> =
        result.rounds.iter().map(|round| (round.num_removed, round.num_barred, round.num_alive)).collect();
    // Ten correspondences end on the points of each instance: two, then one, at the end of their contests. From their
    // round on they may not lead, nor may the five seeds of a round, which in the first are among the ten.
    assert_eq!(booked, [(0, 10, 100), (20, 15, 100), (0, 15, 80), (10, 5, 80)]);
}

#[test]
fn of_two_candidates_that_are_the_same_pose_the_better_one_stays() {
    // Poses below 2 t_he apart are the same. 0 and 10 share no scene point, so that both would hold.
    let plan: Plan = &[(0, 0.9), (10, 1.0), (50, 0.8), (40, 0.7)];
    let found = |t_he_pr| {
        let result = register(&planned(plan, Params { t_he_pr, max_rounds: Some(4), ..contest(4) }));
        assert!(result.rounds.iter().all(Round::accepted));
        let mut found: Vec<_> =
            result.poses.iter().map(|p| (p.target_from_source.translation.x as usize, p.round)).collect();
        found.sort_unstable();
        found
    };
    assert_eq!(found(4.99), [(0, 0), (10, 1), (40, 3), (50, 2)]);
    assert_eq!(found(5.01), [(10, 1), (50, 2)]);
}

#[test]
fn the_same_pose_again_is_no_success() {
    // The last round that brings something new is the second; the better pose of the third is still the same.
    let plan: Plan = &[(0, 0.8), (50, 0.8), (1, 1.0), (51, 0.7)];
    let rounds = |t_he_pr| {
        let params = Params { t_he_pr, max_rejections: Some(5), ..endless() };
        let result = register(&planned(plan, params));
        assert_eq!(result.stop_reason, StopReason::MaxRejections { value: 5, threshold: 5 });
        (result.rounds.len(), sorted_places(&result))
    };
    // Dry after five rounds more, settled, and dry for good after another five.
    assert_eq!(rounds(1.0), (2 + 5 + 5, vec![1, 50]));
    // Else all four would be entered, although the other two then fall to what is claimed.
    assert_eq!(rounds(0.4), (4 + 5 + 5, vec![1, 50]));
}

// ------------------------------------------------------------------------------------------------ single view

/// Instances of a shape before a depth camera at the origin, which sees their near sides only.
struct View {
    source: Vec<Point3<f64>>,
    source_normals: Vec<Vector3<f64>>,
    target: Vec<Point3<f64>>,
    target_normals: Vec<Vector3<f64>>,
    rows: Vec<[usize; 2]>,
    truth: Vec<Isometry3<f64>>,
}

impl View {
    /// Four instances side by side, each with 40 true correspondences, among 240 wrong ones.
    fn new() -> Self {
        let mut rng = Rng::new(12);
        let source = asymmetric_model(600);
        let source_normals = naive::outward_normals(&source);
        let places = [(-2.0, -2.0), (2.0, -2.0), (-2.0, 2.0), (2.0, 2.0)];
        let truth: Vec<_> = places.map(|(x, y)| rng.pose_at(Vector3::new(x, y, 12.0))).into();
        let (mut target, mut target_normals, mut rows) = (Vec::new(), Vec::new(), Vec::new());
        for pose in &truth {
            let mut seen = Vec::new();
            for (i, (p, n)) in source.iter().zip(&source_normals).enumerate() {
                let (p, n) = (pose * p, pose * n);
                if n.dot(&p.coords) < 0.0 {
                    seen.push([i, target.len()]);
                    target.push(p);
                    target_normals.push(n);
                }
            }
            rng.shuffle(&mut seen);
            rows.extend(&seen[..40]);
        }
        rows.extend((0..240).map(|_| [rng.below(source.len()), rng.below(target.len())]));
        rng.shuffle(&mut rows);
        Self { source, source_normals, target, target_normals, rows, truth }
    }

    fn register(&self, params: Params, num_threads: usize) -> Registration {
        let source = Cloud::new(&self.source).with_normals(self.source_normals.clone());
        let target = Cloud::new(&self.target)
            .with_normals(self.target_normals.clone())
            .with_viewpoint(Point3::origin());
        let registrar = Registrar::new(&source).unwrap().params(params).num_threads(num_threads);
        registrar.register(&target, &Correspondences::from_rows(self.rows.clone())).unwrap()
    }
}

/// Everything in a result that may not depend on the number of threads.
fn fingerprint(result: &Registration) -> impl PartialEq + std::fmt::Debug {
    let bits = |pose: &ibi_core::Pose| {
        (pose.target_from_source.to_homogeneous().map(f64::to_bits), pose.score.to_bits(), pose.round)
    };
    let poses: Vec<_> = result.poses.iter().map(bits).collect();
    (poses, result.labels.clone(), result.rounds.clone(), result.stop_reason)
}

fn check_single_view(params: &Params) {
    let view = View::new();
    let result = view.register(params.clone(), 1);
    let close = |pose: &&ibi_core::Pose, truth: &Isometry3<f64>| {
        let off = truth.inverse() * pose.target_from_source;
        off.rotation.angle() < 0.01 && off.translation.vector.norm() < 0.01
    };
    for truth in &view.truth {
        let hits = result.poses.iter().filter(|pose| close(pose, truth)).count();
        assert_eq!(hits, 1, "{truth}: {:?}", result.poses);
    }
    assert_eq!(result.poses.len(), view.truth.len(), "nothing else: {:?}", result.poses);
    // All that is visible is there.
    assert!(result.poses.iter().all(|pose| pose.overlap > 0.95));
    for num_threads in [2, 7] {
        assert_eq!(fingerprint(&view.register(params.clone(), num_threads)), fingerprint(&result));
    }
}

#[test]
fn single_view_finds_every_instance_whatever_the_threads() {
    check_single_view(&Params::single_view());
}

#[test]
fn single_view_with_gsac_finds_every_instance_whatever_the_threads() {
    check_single_view(&Params { te: Gsac::default().into(), ..Params::single_view() });
}

/// The default preset, told that normals are oriented, judges by what the camera sees.
#[test]
fn default_with_oriented_normals_finds_every_instance_whatever_the_threads() {
    check_single_view(&Params { oriented_normals: true, ..Params::default() });
}

#[test]
fn finish_accepts_every_candidate_that_still_passes() {
    // The last is far below the best, so that one settling leaves it for a contest that never comes.
    let plan: Plan = &[(0, 0.4), (20, 1.0), (40, 0.6), (60, 0.7)];
    let result = register(&planned(plan, Params { max_rounds: Some(4), ..endless() }));
    assert_eq!(sorted_places(&result), [0, 20, 40, 60]);
}
