//! Limits within a registration: whatever it is doing, it ends when it is told to, and what takes long on bad input is what it
//! would be if nobody had minded the time.
//!
//! A watcher is told each phase as it begins, and strikes at that very moment: nothing here depends on how fast the machine is.

use std::collections::HashSet;
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use ibi_core::kernels::columns::Columns;
use ibi_core::kernels::graph::{EdgeTest, Graph, MAX_CROWD};
use ibi_core::kernels::grid::Grid;
use ibi_core::kernels::nearby::Nearby;
use ibi_core::kernels::par::{Pool, most_threads};
use ibi_core::nalgebra::{Isometry3, Point3, Vector3};
use ibi_core::stages::ce::{Off, Voting};
use ibi_core::stages::hv::{Evidence, Hv, InlierCount, Overlap};
use ibi_core::stages::scs::LocalGtm;
use ibi_core::stages::te::Ransac;
use ibi_core::stages::{Context, Estimate, EstimatePose, Hypothesis, Ranked, SelectSeeds, Validate, Verdict};
use ibi_core::{
    CancelToken, Cloud, Correspondences, Error, Params, Phase, Refine, Registrar, Registration, Removal,
    Round, StopReason, Watcher,
};
use ibi_testkit::{Rng, naive};

// ---------------------------------------------------------------------------------------------- phases and inputs

/// What a run is given.
struct Input {
    name: &'static str,
    source: Vec<Point3<f64>>,
    target: Vec<Point3<f64>>,
    rows: Vec<[usize; 2]>,
    params: Params,
}

fn points(rng: &mut Rng, n: usize, half: f64) -> Vec<Point3<f64>> {
    (0..n).map(|_| Point3::from(rng.in_box(half))).collect()
}

fn random_rows(rng: &mut Rng, n: usize, num_source: usize, num_target: usize) -> Vec<[usize; 2]> {
    (0..n).map(|_| [rng.below(num_source), rng.below(num_target)]).collect()
}

/// Three instances, all of which are found, and wrong pairs.
fn usual(name: &'static str, params: Params) -> Input {
    let mut rng = Rng::new(1);
    let source = points(&mut rng, 300, 5.0);
    let poses = [0.0, 20.0, 40.0].map(|x| rng.pose_at(Vector3::new(x, 0.0, 0.0)));
    let target: Vec<_> = poses.iter().flat_map(|pose| source.iter().map(move |p| pose * p)).collect();
    let mut rows: Vec<[usize; 2]> = (0..900).step_by(2).map(|row| [row % 300, row]).collect();
    rows.extend(random_rows(&mut rng, 600, 300, 900));
    Input { name, source, target, rows, params }
}

/// Poses by the dozen on top of each other, none of which validation minds.
fn on_top(name: &'static str) -> Input {
    let mut rng = Rng::new(2);
    let source = points(&mut rng, 60, 5.0);
    let near = source.iter().map(|p| p + 0.3 * rng.normal_vector());
    let target: Vec<_> = source.iter().copied().chain(near).collect();
    let mut rows: Vec<[usize; 2]> = (0..200).map(|_| rng.below(120)).map(|row| [row % 60, row]).collect();
    rows.extend(random_rows(&mut rng, 200, 60, 120));
    let params = Params {
        scs: LocalGtm { first_look: None, ..LocalGtm::default() }.into(),
        ce: Voting { n_vot: 4 }.into(),
        hv: InlierCount { t_inliers: 1 }.into(),
        removal: Removal::Dense,
        n_contest: 1,
        max_rejections: None,
        ..Params::default()
    };
    Input { name, source, target, rows, params }
}

/// All correspondences in one place.
fn crowd(name: &'static str, place: fn(&mut Rng) -> [usize; 2]) -> Input {
    let mut rng = Rng::new(3);
    let (source, target) = (points(&mut rng, 500, 5.0), points(&mut rng, 3000, 20.0));
    let rows = (0..40_000).map(|_| place(&mut rng)).collect();
    Input { name, source, target, rows, params: Params::default() }
}

/// Two clusters, very far from each other.
fn far_apart() -> Input {
    let mut rng = Rng::new(4);
    let (source, mut target) = (points(&mut rng, 500, 5.0), points(&mut rng, 5000, 10.0));
    target[2500..].iter_mut().for_each(|p| *p += Vector3::repeat(1e6));
    let rows = random_rows(&mut rng, 20_000, 500, 5000);
    Input { name: "clusters far apart", source, target, rows, params: Params::default() }
}

/// What makes each phase of a registration long; `None` for what no registration does, or not by itself.
fn inputs(phase: Phase) -> Option<Vec<Input>> {
    let all_right = Params { scs: LocalGtm::default().into(), ..Params::paper_synthetic() };
    Some(match phase {
        Phase::Prepare => vec![usual("usual", Params::default()), far_apart()],
        Phase::Graph => vec![
            crowd("equal pairs", |_| [7, 7]),
            crowd("one source point", |rng| [7, rng.below(3000)]),
            crowd("few targets", |rng| [rng.below(500), rng.below(3)]),
            far_apart(),
        ],
        Phase::Select => vec![usual("usual", Params::default()), usual("gtm", Params::paper_synthetic())],
        Phase::Enhance => {
            vec![usual("huge n_vot", Params { ce: Voting { n_vot: u32::MAX }.into(), ..all_right })]
        }
        Phase::Estimate => {
            let ransac = Ransac { n_ransac: 100_000, ..Ransac::default() };
            vec![usual("many samples", Params { te: ransac.into(), ..all_right })]
        }
        Phase::Chance => vec![
            usual("huge t_he", Params { t_he_pr: 1e6, ..Params::default() }),
            usual("huge d_op", Params { d_op_pr: 1e6, ..Params::default() }),
        ],
        Phase::Polish | Phase::Validate | Phase::Contest => vec![usual("usual", Params::default())],
        Phase::JointCheck | Phase::Rank => vec![
            on_top("on top of each other"),
            usual("apart", Params { joint_check: false, ..Params::default() }),
        ],
        _ => return None,
    })
}

/// What belongs to features, metrics and the preparation of a single cloud.
const ELSEWHERE: [Phase; 12] = [
    Phase::Spacing,
    Phase::Diameter,
    Phase::Shadow,
    Phase::Thin,
    Phase::Normals,
    Phase::Fpfh,
    Phase::Match,
    Phase::Plane,
    Phase::SampleMesh,
    Phase::OuterSurface,
    Phase::Symmetries,
    Phase::Metrics,
];

/// What is done, within bounds, with what was found before a run was ended.
const FINISHING: [Phase; 3] = [Phase::Contest, Phase::JointCheck, Phase::Rank];

#[test]
fn every_phase_has_a_row() {
    for phase in Phase::ALL {
        assert_ne!(
            inputs(phase).is_some(),
            ELSEWHERE.contains(&phase),
            "{phase:?} is in both tables or in none"
        );
    }
}

/// How a run is told to end.
#[derive(Debug, Clone, Copy)]
enum Means {
    Token,
    Clock,
}

/// What came of a run that was told to end when `phase` began for the first time: the result, and the phases that began
/// afterwards. `None` if the phase did not begin in time.
fn ended_in(
    phase: Phase,
    input: &Input,
    num_threads: usize,
    timeout: Option<Duration>,
) -> Option<(Registration, Vec<Phase>)> {
    let token = CancelToken::default();
    let after: Arc<Mutex<Option<Vec<Phase>>>> = Arc::default();
    let (cancel, begun) = (token.clone(), Arc::clone(&after));
    let watcher: Watcher = Arc::new(move |now| {
        let mut begun = begun.lock().unwrap();
        if let Some(after) = &mut *begun {
            after.push(now);
        } else if now == phase {
            match timeout {
                None => cancel.cancel(),
                // All of it, from now on: then it is over in any case.
                Some(timeout) => std::thread::sleep(timeout),
            }
            *begun = Some(Vec::new());
        }
    });
    let params = Params { timeout_s: timeout.map(|timeout| timeout.as_secs_f64()), ..input.params.clone() };
    let registrar = Registrar::new(&Cloud::new(&input.source))
        .unwrap()
        .params(params)
        .num_threads(num_threads)
        .cancel_token(token)
        .watcher(watcher);
    let result =
        registrar.register(&Cloud::new(&input.target), &Correspondences::from_rows(input.rows.clone()));
    let after = after.lock().unwrap().take();
    after.map(|after| (result.unwrap(), after))
}

#[test]
fn a_run_ends_in_each_phase_by_each_means() {
    for phase in Phase::ALL {
        for input in inputs(phase).into_iter().flatten() {
            for num_threads in [1, 2] {
                for means in [Means::Token, Means::Clock] {
                    let what = format!("{phase:?}, {}, {num_threads} threads, {means:?}", input.name);
                    let (result, after) = match means {
                        Means::Token => ended_in(phase, &input, num_threads, None),
                        // As long as it takes to come so far.
                        Means::Clock => (0..12).find_map(|k| {
                            ended_in(phase, &input, num_threads, Some(Duration::from_millis(20 << k)))
                        }),
                    }
                    .unwrap_or_else(|| panic!("{what}: the phase did not begin"));
                    assert_ended(&result, &after, &input, num_threads, means, &what);
                }
            }
        }
    }
}

fn assert_ended(
    result: &Registration,
    after: &[Phase],
    input: &Input,
    num_threads: usize,
    means: Means,
    what: &str,
) {
    let is_right = match means {
        Means::Token => result.stop_reason == StopReason::Cancelled,
        Means::Clock => matches!(result.stop_reason, StopReason::Timeout { .. }),
    };
    assert!(is_right, "{what}: {}", result.stop_reason);
    let further = after.iter().filter(|phase| !FINISHING.contains(phase)).count();
    // Another thread may just have been about to begin one.
    assert!(further < num_threads, "{what}: {after:?}");
    assert_eq!(result.labels.len(), input.rows.len(), "{what}");
    for pose in &result.poses {
        assert!((0.0..=1.0).contains(&pose.score) && pose.closeness.is_finite(), "{what}: {pose:?}");
    }
}

#[test]
fn an_interrupted_preparation_is_an_empty_result_and_a_typed_error() {
    let input = usual("usual", Params::default());
    let (result, after) = ended_in(Phase::Prepare, &input, 1, None).unwrap();
    assert!(after.is_empty() && result.poses.is_empty() && result.rounds.is_empty());
    assert_eq!((result.resolution, &result.labels), (0.0, &vec![None; input.rows.len()]));
    let token = CancelToken::default();
    token.cancel();
    let registrar = Registrar::new(&Cloud::new(&input.source)).unwrap().cancel_token(token);
    let begun = registrar.begin(&Cloud::new(&input.target), &Correspondences::from_rows(input.rows));
    assert_eq!(begun.err(), Some(Error::Interrupted { reason: StopReason::Cancelled }));
}

#[test]
fn what_was_found_before_a_callback_ended_the_run_is_the_same_on_any_number_of_threads() {
    let inputs = [(usual("usual", Params::default()), 2), (on_top("on top of each other"), 12)];
    for (input, num_rounds) in inputs {
        let found = |num_threads: usize| {
            let registrar = Registrar::new(&Cloud::new(&input.source)).unwrap();
            let registrar = registrar.params(input.params.clone()).num_threads(num_threads);
            let mut until = |round: &Round| {
                if round.index + 1 < num_rounds { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
            };
            let rows = Correspondences::from_rows(input.rows.clone());
            registrar.register_observed(&Cloud::new(&input.target), &rows, &mut until).unwrap()
        };
        let serial = found(1);
        assert_eq!(
            (serial.stop_reason, serial.rounds.len()),
            (StopReason::Cancelled, num_rounds as usize),
            "{}",
            input.name
        );
        assert!(!serial.poses.is_empty(), "{}", input.name);
        assert_eq!(bits(&serial), bits(&found(2)), "{}", input.name);
    }
}

fn bits(result: &Registration) -> Vec<(Vec<u64>, u32)> {
    let numbers = |pose: &ibi_core::Pose| {
        let matrix = pose.target_from_source.to_homogeneous();
        let measured =
            [pose.score, pose.overlap, pose.closeness, pose.back_fit, pose.evidence, pose.inlier_rmse];
        matrix.iter().copied().chain(measured).map(f64::to_bits).collect()
    };
    result.poses.iter().map(|pose| (numbers(pose), pose.round)).collect()
}

// ------------------------------------------------------------------------------------------------- the joint check

/// One pose after the other, whatever the correspondences say.
struct Planned(Vec<Isometry3<f64>>);

impl SelectSeeds for Planned {
    fn select_seeds(&self, context: &Context<'_>) -> Ranked {
        if context.round as usize >= self.0.len() {
            return Ranked::default();
        }
        Ranked::new(context.alive.ids().iter().take(4).map(|&id| (id, 1.0)).collect())
    }
}

impl EstimatePose for Planned {
    fn estimate_pose(&self, context: &Context<'_>, _: &Ranked) -> Estimate {
        let target_from_source = self.0[context.round as usize];
        let hypothesis = Some(Hypothesis { target_from_source, score: 1.0 });
        Estimate { hypothesis, num_samples: 1, num_degenerate: 0, capped: false }
    }
}

const D_OP: f64 = 0.6;
const LEAST_FREE: f64 = 4.5;

/// Accepts a pose that has enough target points of its own. In the rounds all pass.
#[derive(Clone)]
struct Free {
    source: Vec<Point3<f64>>,
    target: Vec<Point3<f64>>,
    /// Rows of other target points, before those.
    num_before: usize,
    is_repeatable: bool,
    is_checking: Arc<AtomicBool>,
}

impl Free {
    /// How far each target point is from the moved source, if it is explained.
    fn gaps(&self, pose: &Isometry3<f64>) -> Vec<Option<f64>> {
        let gap = |q: &Point3<f64>| {
            let nearest = self.source.iter().map(|p| (pose * p - q).norm()).fold(f64::INFINITY, f64::min);
            (nearest <= D_OP).then_some(nearest)
        };
        self.target.iter().map(gap).collect()
    }
}

impl Validate for Free {
    fn validate(&self, context: &Context<'_>, hypothesis: &Hypothesis) -> Verdict {
        if !self.is_checking.load(Ordering::Relaxed) {
            return Verdict { value: 1.0, threshold: 0.0 };
        }
        let pose = &hypothesis.target_from_source;
        let explained = (self.num_before as u32..).zip(self.gaps(pose)).filter(|(_, gap)| gap.is_some());
        let rows: Vec<u32> = explained.map(|(row, _)| row).collect();
        let are_claimed = context.claims.near(pose).contain(&rows);
        for (&row, &is_claimed) in rows.iter().zip(&are_claimed) {
            assert_ne!(
                context.alive.contains(row),
                is_claimed,
                "the pair of row {row} is as free as its target"
            );
            assert_eq!(context.claims.contains(row), is_claimed);
        }
        let num_free = are_claimed.into_iter().filter(|&is_claimed| !is_claimed).count();
        Verdict { value: num_free as f64, threshold: LEAST_FREE }
    }

    fn is_repeatable(&self) -> bool {
        self.is_repeatable
    }
}

/// The poses that are left if each claims what it is nearest to, and the one with the fewest goes as long as it has too few:
/// every pose asked for every other, anew after each.
fn naive_survivors(free: &Free, poses: &[Isometry3<f64>]) -> Vec<u32> {
    let gaps: Vec<Vec<Option<f64>>> = poses.iter().map(|pose| free.gaps(pose)).collect();
    let mut left: Vec<usize> = (0..poses.len()).collect();
    loop {
        let own = |&at: &usize| {
            let is_nearest = |row: usize, gap: f64| {
                let others = left.iter().filter(|&&other| other != at);
                others.filter_map(|&other| Some((gaps[other][row]?, other))).all(|other| (gap, at) < other)
            };
            (0..free.target.len())
                .filter(|&row| gaps[at][row].is_some_and(|gap| is_nearest(row, gap)))
                .count()
        };
        let measured: Vec<usize> = left.iter().map(own).collect();
        let worst = measured.iter().enumerate().min_by_key(|&(_, num)| num);
        match worst {
            Some((at, &num)) if num as f64 <= LEAST_FREE && left.len() > 1 => left.remove(at),
            _ => return left.into_iter().map(|at| at as u32).collect(),
        };
    }
}

/// A scene of two instances, and poses that lie on top of each other there.
fn heaped(seed: u64, num_poses: usize, spread: f64) -> (Free, Vec<Isometry3<f64>>) {
    let mut rng = Rng::new(seed);
    let source = points(&mut rng, 40, 3.0);
    let truth = [0.0, 4.0].map(|x| rng.pose_at(Vector3::new(x, 0.0, 0.0)));
    let target = truth.iter().flat_map(|pose| source.iter().map(move |p| pose * p)).collect();
    let poses = (0..num_poses).map(|at| {
        let shift = Isometry3::new(spread * rng.normal_vector(), 0.1 * spread * rng.normal_vector());
        truth[at % 2] * shift
    });
    let poses: Vec<_> = poses.collect();
    let num_before = 4 * (num_poses + 1);
    (Free { source, target, num_before, is_repeatable: true, is_checking: Arc::default() }, poses)
}

/// All of `poses` accepted in this order, and then checked.
fn checked(free: &Free, poses: &[Isometry3<f64>], num_threads: usize) -> Registration {
    // Points far from all poses, for the seeds of the rounds.
    let far = (0..free.num_before).map(|i| Point3::new(1000.0 + i as f64, 0.0, 0.0));
    let target: Vec<_> = far.chain(free.target.iter().copied()).collect();
    let rows = (0..target.len()).map(|row| [row % free.source.len(), row]).collect();
    let params = Params {
        resolution: Some(1.0),
        d_op_pr: D_OP,
        t_he_pr: D_OP,
        ce: Off {}.into(),
        removal: Removal::Dense,
        n_contest: 1,
        refine: Refine::None,
        max_rejections: None,
        ..Params::default()
    };
    let is_checking = Arc::clone(&free.is_checking);
    is_checking.store(false, Ordering::Relaxed);
    let watcher: Watcher = Arc::new(move |phase| {
        if phase == Phase::JointCheck {
            is_checking.store(true, Ordering::Relaxed);
        }
    });
    Registrar::new(&Cloud::new(&free.source))
        .unwrap()
        .params(params)
        .num_threads(num_threads)
        .watcher(watcher)
        .with_scs(Planned(poses.to_vec()))
        .with_te(Planned(poses.to_vec()))
        .with_hv(free.clone())
        .register(&Cloud::new(&target), &Correspondences::from_rows(rows))
        .unwrap()
}

fn survivors(result: &Registration) -> Vec<u32> {
    let mut rounds: Vec<u32> = result.poses.iter().map(|pose| pose.round).collect();
    rounds.sort_unstable();
    rounds
}

#[test]
fn the_joint_check_is_its_twin() {
    let mut num_dropped = HashSet::new();
    // Of the last one there are more than the ledger keeps of a row.
    let heaps = (0..12).map(|seed| (seed, 5 + 3 * seed as usize, 0.05 + 0.05 * seed as f64));
    for (seed, num_poses, spread) in heaps.chain([(20, 300, 0.02)]) {
        let (free, poses) = heaped(seed, num_poses, spread);
        let result = checked(&free, &poses, 1);
        assert_eq!(survivors(&result), naive_survivors(&free, &poses), "seed {seed}");
        num_dropped.insert(poses.len() - result.poses.len());
        // Measured again where something may have changed, or in any case: it is the same.
        let every_time = Free { is_repeatable: false, ..free.clone() };
        assert_eq!(bits(&checked(&every_time, &poses, 1)), bits(&result), "seed {seed}");
        assert_eq!(bits(&checked(&free, &poses, 2)), bits(&result), "seed {seed}");
        // What was dropped has left no trace.
        let left: Vec<_> = survivors(&result).into_iter().map(|at| poses[at as usize]).collect();
        let alone = checked(&free, &left, 1);
        let numbers = |result| bits(result).into_iter().map(|(numbers, _)| numbers).collect::<Vec<_>>();
        assert_eq!(numbers(&alone), numbers(&result), "seed {seed}");
    }
    assert!(num_dropped.len() > 4, "{num_dropped:?}");
}

#[test]
fn built_in_validation_comes_to_the_same_however_many_were_dropped() {
    let hvs: [Hv; 3] = [
        Evidence { exclusive: false, ..Evidence::default() }.into(),
        InlierCount { t_inliers: 1 }.into(),
        Overlap { t_overlap: 0.2, exclusive: true }.into(),
    ];
    for hv in hvs {
        let input = Input { params: Params { hv, ..on_top("").params }, ..on_top("on top") };
        let all = register(&input, &input.params);
        let unchecked = register(&input, &Params { joint_check: false, ..input.params.clone() });
        assert!(unchecked.poses.len() >= all.poses.len() && !all.poses.is_empty(), "{:?}", input.params.hv);
        for num_threads in [2, 7] {
            let again = Registrar::new(&Cloud::new(&input.source)).unwrap().params(input.params.clone());
            let rows = Correspondences::from_rows(input.rows.clone());
            let again = again.num_threads(num_threads).register(&Cloud::new(&input.target), &rows).unwrap();
            assert_eq!(bits(&again), bits(&all), "{:?}", input.params.hv);
        }
    }
}

fn register(input: &Input, params: &Params) -> Registration {
    let registrar = Registrar::new(&Cloud::new(&input.source)).unwrap().params(params.clone()).num_threads(1);
    registrar.register(&Cloud::new(&input.target), &Correspondences::from_rows(input.rows.clone())).unwrap()
}

// --------------------------------------------------------------------------------------------- crowds and distances

fn edge_test(max_length: f32) -> EdgeTest {
    EdgeTest {
        tau: 0.5,
        min_length: 0.5,
        max_length,
        normal_tolerance: 0.3,
        second_order: true,
        max_degree: u32::MAX,
        max_vicinity: u32::MAX,
    }
}

#[test]
fn the_graph_of_a_crowded_cell_is_its_twin_on_any_number_of_threads() {
    let mut rng = Rng::new(5);
    let n = 1500;
    let (p, q) = (points(&mut rng, n, 10.0), points(&mut rng, n, 10.0));
    let pairs: Vec<_> = p.iter().copied().zip(q.iter().copied()).collect();
    let test = edge_test(40.0);
    let of = || Graph::new(&Columns::new(&p, &q, 1.0), None, &test, |_| true, || false);
    let serial = of();
    let twin = naive::EdgeTest { tau: 0.5, min_length: 0.5, max_length: 40.0, normal_tolerance: 0.3 };
    for i in 0..n {
        let (neighbors, _) = serial.edges(serial.node(i as u32).unwrap());
        let joined: HashSet<u32> = neighbors.iter().map(|&node| serial.id(node)).collect();
        for j in (0..n).filter(|&j| j != i) {
            let margin = naive::edge_margin(&pairs[i], &pairs[j], &twin);
            let is_joined = joined.contains(&(j as u32));
            assert!(margin.abs() < 1e-4 || is_joined == (margin > 0.0), "{i} and {j}: {margin}");
        }
    }
    let bits = |graph: &Graph| -> Vec<(Vec<u32>, Vec<u32>)> {
        let row =
            |node| (graph.edges(node).0.to_vec(), graph.edges(node).1.iter().map(|w| w.to_bits()).collect());
        (0..n as u32).map(row).collect()
    };
    for num_threads in [2, 7] {
        assert!(Pool::new(Some(num_threads)).unwrap().install(|| bits(&of())) == bits(&serial));
    }
}

#[test]
fn a_crowd_that_agrees_with_nobody_is_thinned_and_asks_often() {
    let most = MAX_CROWD as usize;
    let at = Point3::new(1.0, 2.0, 3.0);
    for n in [most, 4 * most] {
        let all = vec![at; n];
        let num_asked = AtomicUsize::new(0);
        let asks = || {
            num_asked.fetch_add(1, Ordering::Relaxed);
            false
        };
        let graph = Graph::new(&Columns::new(&all, &all, 1.0), None, &edge_test(10.0), |_| true, asks);
        // Up to the bound none is left out.
        let is_right =
            if n == most { graph.len() == n } else { graph.len() < n / 2 && graph.len() > most / 2 };
        assert!(is_right, "{} nodes of {n}", graph.len());
        assert!((0..graph.len() as u32).all(|node| graph.edges(node).0.is_empty()));
        // Half a billion pairs are looked at, no more than two million at a time.
        assert!(num_asked.into_inner() > 200);
    }
}

/// A cloud on which a grid of the cells that were asked for is too large, or too coarse.
fn hard_clouds() -> Vec<(&'static str, Vec<Point3<f64>>)> {
    let mut rng = Rng::new(6);
    let cluster = |rng: &mut Rng, at: Vector3<f64>| -> Vec<Point3<f64>> {
        points(rng, 2000, 5.0).into_iter().map(|p| p + at).collect()
    };
    let twins = [0.0, 1e5].map(|x| cluster(&mut rng, Vector3::repeat(x))).concat();
    let aside = [0.0, 1e5].map(|x| cluster(&mut rng, Vector3::new(0.0, x, -x))).concat();
    let many = (0..8).flat_map(|_| {
        let at = rng.in_box(1e5);
        cluster(&mut rng, at)
    });
    let many = many.collect();
    let mut copies = points(&mut rng, 3000, 5.0);
    let first = copies[0];
    copies.extend(vec![first; 12_000]);
    copies.extend(points(&mut rng, 1000, 5.0));
    vec![("two clusters", twins), ("aside", aside), ("many clusters", many), ("copies", copies)]
}

#[test]
fn far_clusters_share_no_cell() {
    for (name, cloud) in hard_clouds().into_iter().take(3) {
        let columns = [0, 1, 2].map(|axis| cloud.iter().map(|p| p[axis] as f32).collect::<Vec<f32>>());
        let grid = Grid::new(&columns, 1.0);
        let mut order = grid.order().to_vec();
        order.sort_unstable();
        assert!(order.into_iter().eq(0..cloud.len() as u32), "{name}: every point, once");
        let mut num_looked_at = 0;
        for i in (0..cloud.len()).step_by(7) {
            let here = columns.each_ref().map(|axis| axis[i]);
            let at = Point3::from(here).cast::<f64>();
            let near: HashSet<u32> =
                grid.around(here, 1.0).flatten().map(|place| grid.order()[place]).collect();
            num_looked_at += near.len();
            for row in (0..cloud.len()).filter(|&row| {
                let other = Point3::from(columns.each_ref().map(|axis| axis[row])).cast::<f64>();
                (other - at).norm() <= 1.0
            }) {
                assert!(near.contains(&(row as u32)), "{name}: {row} near {i}");
            }
        }
        // A cluster has ten cells an axis.
        assert!(num_looked_at < cloud.len() / 7 * 400, "{name}: {num_looked_at}");
        // Each cell with its surroundings, in the order of the cells.
        let mut end = 0;
        for (home, runs) in grid.neighborhoods(1.0) {
            assert_eq!(home.start, end);
            end = home.end;
            assert!(runs.iter().any(|run| run.start <= home.start && home.end <= run.end));
        }
        assert_eq!(end, cloud.len());
    }
}

#[test]
fn nearest_is_brute_force_in_hard_clouds_and_at_any_reach() {
    let mut rng = Rng::new(7);
    for (name, cloud) in hard_clouds() {
        for (reach, usual) in [(1.0, 1.0), (100.0, 100.0), (1e7, 1e7), (1e7, 1.0), (20.0, 2.0)] {
            let nearby = Nearby::with_usual(&cloud, reach, usual);
            for i in 0..60 {
                let far = if i % 3 == 0 { 1e4 } else { 2.0 };
                let query = cloud[rng.below(cloud.len())] + far * rng.normal_vector();
                let exact = naive::nearest_dist_sq(&cloud, &query).sqrt();
                // What `f32` tells apart so far from the middle, on each side.
                let slack = 1e-6 * query.coords.norm() + 1e-6 * 2e5 + 1e-6 * reach;
                for distance in [usual, reach] {
                    let found = nearby.nearest_each(distance, &[query])[0];
                    let any = nearby.any_within_each(distance, &[query])[0];
                    if exact < distance - slack {
                        let found = (cloud[found.expect(name) as usize] - query).norm();
                        assert!(found <= exact + 2.0 * slack, "{name}, {reach}: {found} for {exact}");
                        assert!(any, "{name}, {reach}");
                    } else if exact > distance + slack {
                        assert!(found.is_none() && !any, "{name}, {reach}, {distance}: nothing at {exact}");
                    }
                }
            }
        }
    }
}

#[test]
fn sums_are_brute_force_up_to_the_bound_and_near_it_beyond() {
    let mut rng = Rng::new(8);
    let cloud = points(&mut rng, 60_000, 1.0);
    let values: Vec<u32> = (0..cloud.len()).map(|_| rng.below(5) as u32).collect();
    let queries: Vec<_> = (0..20).map(|_| cloud[rng.below(cloud.len())]).collect();
    let exact = |query: &Point3<f64>, radius: f64| -> u32 {
        naive::within(&cloud, query, radius).into_iter().map(|row| values[row as usize]).sum()
    };
    // Some hundreds of points, some thousands, most of the cloud, all of it.
    for (reach, radius, is_exact) in [
        (0.2, 0.2, true),
        (0.2, 0.3, true),
        (5.0, 0.3, true),
        (1.0, 0.9, false),
        (100.0, 100.0, true),
        (0.1, 9.0, true),
    ] {
        let nearby = Nearby::new(&cloud, reach);
        for (query, sum) in queries.iter().zip(nearby.sums_within(radius, &queries, &values)) {
            let exact = exact(query, radius);
            let margin = if is_exact { 1e-4 } else { 0.05 };
            assert!(
                f64::from(sum.abs_diff(exact)) <= margin * f64::from(exact) + 1.0,
                "{radius} of {reach}: {sum} for {exact}"
            );
        }
    }
}

#[test]
fn no_more_threads_are_started_than_are_of_use() {
    let pool = Pool::new(Some(usize::MAX)).unwrap();
    assert!(pool.num_threads() <= most_threads());
    let input = usual("usual", Params::default());
    let with = |num_threads: usize| {
        let registrar = Registrar::new(&Cloud::new(&input.source)).unwrap().num_threads(num_threads);
        let rows = Correspondences::from_rows(input.rows.clone());
        registrar.register(&Cloud::new(&input.target), &rows).unwrap()
    };
    assert_eq!(bits(&with(65_535)), bits(&with(1)));
}
