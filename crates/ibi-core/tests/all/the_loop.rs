//! The loop itself, with stages that are mocks: what it calls, removes, records, and when it ends.

use std::ops::ControlFlow;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::channel;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use crate::mock::{Mock, long_enough};
use ibi_core::nalgebra::{Isometry3, Point3};
use ibi_core::stages::{Context, Estimate, Hypothesis, Ranked, Verdict};
use ibi_core::{
    CancelToken, Cloud, Correspondences, Params, Phase, Registrar, Registration, Removal, Round, StopReason,
};

/// After so long a test fails rather than hangs.
const WATCHDOG: Duration = Duration::from_secs(1200);

/// Not `Params::default()`, which may change.
fn base() -> Params {
    Params { t_he_pr: 3.0, ..Params::paper_synthetic() }
}

const M: usize = 100;

/// A row of points 1 apart; the target is the source itself.
fn line_cloud() -> Vec<Point3<f64>> {
    (0..M).map(|i| Point3::new(i as f64, 0.0, 0.0)).collect()
}

fn identity_rows() -> Correspondences {
    Correspondences::from_rows((0..M).map(|i| [i, i]).collect())
}

fn first_alive(context: &Context<'_>, n: usize) -> Ranked {
    Ranked::new(context.alive.ids().iter().take(n).map(|&id| (id, 1.0)).collect())
}

fn shifted(x: f64) -> Estimate {
    let hypothesis = Hypothesis { target_from_source: Isometry3::translation(x, 0.0, 0.0), score: 7.0 };
    Estimate { hypothesis: Some(hypothesis), num_samples: 5, num_degenerate: 2, capped: false }
}

const ACCEPT: Verdict = Verdict { value: 1.0, threshold: 0.5 };
const REJECT: Verdict = Verdict { value: 0.5, threshold: 0.5 }; // the threshold must be exceeded

/// Ten seeds, which are also the dense ones; the identity; accepted.
fn mocked() -> Registrar<'static> {
    Registrar::new(&Cloud::from(line_cloud()))
        .unwrap()
        .params(base())
        .num_threads(2)
        .with_scs(Mock(|context: &Context<'_>| first_alive(context, 10)))
        .with_ce(Mock(|_: &Context<'_>, seeds: &Ranked| seeds.clone()))
        .with_te(Mock(|_: &Context<'_>, _: &Ranked| shifted(0.0)))
        .with_hv(Mock(|_: &Context<'_>, _: &Hypothesis| ACCEPT))
}

fn register(registrar: &Registrar<'_>) -> Registration {
    registrar.register(&Cloud::from(line_cloud()), &identity_rows()).unwrap()
}

type Log = Arc<Mutex<Vec<&'static str>>>;

#[test]
fn stages_are_called_in_the_order_of_the_paper() {
    let log = Log::default();
    let note = |word| {
        let log = Arc::clone(&log);
        move || log.lock().unwrap().push(word)
    };
    let (scs, ce, te, hv) = (note("scs"), note("ce"), note("te"), note("hv"));
    let registrar = mocked()
        .params(Params { max_rounds: Some(2), ..base() })
        .with_scs(Mock(move |context: &Context<'_>| {
            scs();
            first_alive(context, 10)
        }))
        .with_ce(Mock(move |_: &Context<'_>, seeds: &Ranked| {
            ce();
            seeds.clone()
        }))
        .with_te(Mock(move |_: &Context<'_>, _: &Ranked| {
            te();
            shifted(0.0)
        }))
        .with_hv(Mock(move |_: &Context<'_>, _: &Hypothesis| {
            hv();
            ACCEPT
        }));
    register(&registrar);
    assert_eq!(*log.lock().unwrap(), ["scs", "ce", "te", "hv", "scs", "ce", "te", "hv"]);
}

#[test]
fn each_stage_is_handed_what_the_one_before_it_returned() {
    let registrar = mocked()
        .params(Params { max_rounds: Some(1), ..base() })
        .with_scs(Mock(|_: &Context<'_>| Ranked::new((10..20).map(|id| (id, 2.0)).collect())))
        .with_ce(Mock(|_: &Context<'_>, seeds: &Ranked| {
            assert_eq!(seeds.ids(), (10..20).collect::<Vec<_>>());
            Ranked::new((30..60).map(|id| (id, 3.0)).collect())
        }))
        .with_te(Mock(|_: &Context<'_>, dense: &Ranked| {
            assert_eq!(dense.ids(), (30..60).collect::<Vec<_>>());
            shifted(4.0)
        }))
        .with_hv(Mock(|_: &Context<'_>, hypothesis: &Hypothesis| {
            assert_eq!(Some(*hypothesis), shifted(4.0).hypothesis);
            ACCEPT
        }));
    let result = register(&registrar);
    assert_eq!(result.poses.len(), 1);
    assert_eq!(result.poses[0].target_from_source, Isometry3::translation(4.0, 0.0, 0.0));
}

#[test]
fn the_dense_correspondences_go_after_acceptance_and_after_rejection() {
    let registrar = mocked().with_hv(Mock(|context: &Context<'_>, _: &Hypothesis| {
        // Ten of the lowest ids went in each round before this one, whatever its verdict.
        let lowest = context.round * 10;
        assert_eq!(context.alive.ids(), (lowest..M as u32).collect::<Vec<_>>());
        if context.round.is_multiple_of(2) { ACCEPT } else { REJECT }
    }));
    let result = register(&registrar);
    assert_eq!(result.rounds.len(), 10);
    assert_eq!(result.poses.len(), 5);
    assert!(result.rounds.iter().all(|round| round.num_removed == 10));
    assert_eq!(result.stop_reason, StopReason::FewCorrespondences { value: 0, threshold: 3 });
}

#[test]
fn removal_of_inliers_takes_those_of_an_accepted_pose_and_bars_the_seeds() {
    let params = Params { removal: Removal::Inliers, t_he_pr: 1.0, ..base() };
    // Shifted by half a point all are inliers: the first acceptance takes them all.
    let all = mocked().params(params.clone()).with_te(Mock(|_: &Context<'_>, _: &Ranked| shifted(0.5)));
    let result = register(&all);
    assert_eq!((result.rounds[0].num_removed, result.rounds.len()), (100, 1));
    // Rejected: nothing goes, the ten seeds are barred, and when the same ten come again the run has stalled.
    let barred = Arc::new(Mutex::new(Vec::new()));
    let seen = Arc::clone(&barred);
    let rejected =
        mocked().params(params.clone()).with_hv(Mock(move |context: &Context<'_>, _: &Hypothesis| {
            seen.lock().unwrap().push(context.barred.iter().filter(|&&b| b).count());
            REJECT
        }));
    let result = register(&rejected);
    let booked: Vec<_> = result.rounds.iter().map(|round| (round.num_removed, round.num_barred)).collect();
    assert_eq!(booked, [(0, 10), (0, 0)]);
    assert_eq!(*barred.lock().unwrap(), [0, 10]);
    assert_eq!(result.stop_reason, StopReason::Stalled);
}

#[test]
fn ends_with_max_rejections_in_a_row() {
    let registrar = mocked().params(Params { max_rejections: Some(3), ..base() }).with_hv(Mock(
        |context: &Context<'_>, _: &Hypothesis| if context.round == 2 { ACCEPT } else { REJECT },
    ));
    let result = register(&registrar);
    assert_eq!(result.stop_reason, StopReason::MaxRejections { value: 3, threshold: 3 });
    assert_eq!((result.rounds.len(), result.poses.len()), (6, 1));
}

#[test]
fn without_a_hypothesis_nothing_is_validated_but_the_dense_correspondences_go() {
    let registrar = mocked()
        .with_te(Mock(|_: &Context<'_>, _: &Ranked| Estimate {
            num_samples: 9,
            num_degenerate: 9,
            capped: true,
            ..Estimate::default()
        }))
        .with_hv(Mock(|_: &Context<'_>, _: &Hypothesis| -> Verdict { unreachable!("nothing to validate") }));
    let result = register(&registrar);
    assert!(result.poses.is_empty() && result.labels.iter().all(Option::is_none));
    assert_eq!(result.rounds.len(), 10);
    for round in &result.rounds {
        assert_eq!((round.hypothesis_score, round.verdict, round.num_removed), (None, None, 10));
        assert_eq!((round.num_samples, round.num_degenerate, round.capped), (9, 9, true));
    }
}

#[test]
fn rounds_record_what_happened() {
    let registrar = mocked()
        .params(Params { max_rounds: Some(3), ..base() })
        .with_ce(Mock(|context: &Context<'_>, _: &Ranked| first_alive(context, 20)))
        .with_hv(Mock(
            |context: &Context<'_>, _: &Hypothesis| if context.round == 1 { ACCEPT } else { REJECT },
        ));
    let mut seen = Vec::new();
    let mut observer = |round: &Round| {
        seen.push(round.clone());
        ControlFlow::Continue(())
    };
    let result =
        registrar.register_observed(&Cloud::from(line_cloud()), &identity_rows(), &mut observer).unwrap();
    assert_eq!(seen, result.rounds);
    for (index, round) in (0..).zip(&seen) {
        assert_eq!(round.index, index);
        assert_eq!(round.num_alive, 100 - 20 * index);
        assert_eq!((round.num_seeds, round.num_dense, round.num_removed), (10, 20, 20));
        assert_eq!((round.num_samples, round.num_degenerate, round.capped), (5, 2, false));
        assert_eq!(round.hypothesis_score, Some(7.0));
        assert_eq!(round.verdict, Some(if index == 1 { ACCEPT } else { REJECT }));
        assert_eq!(round.accepted(), index == 1);
    }
    assert_eq!(result.poses.len(), 1);
    assert_eq!(result.poses[0].round, 1);
}

#[test]
fn ends_with_few_seeds() {
    let params = Params { t_s: 10, ..base() };
    let nine = mocked()
        .params(params.clone())
        .with_scs(Mock(|context: &Context<'_>| first_alive(context, if context.round == 0 { 10 } else { 9 })))
        .with_ce(Mock(|context: &Context<'_>, seeds: &Ranked| {
            assert_eq!(context.round, 0, "too few seeds must not be enhanced");
            seeds.clone()
        }));
    let result = register(&nine);
    assert_eq!(result.stop_reason, StopReason::FewSeeds { value: 9, threshold: 10 });
    // The selection that ended the run is no round; what was found before it stays.
    assert_eq!((result.rounds.len(), result.poses.len()), (1, 1));
    // Exactly t_s are enough: N_s < t_s ends a run.
    let result = register(&mocked().params(Params { max_rounds: Some(1), ..params }));
    assert_eq!(result.stop_reason, StopReason::MaxRounds { value: 1, threshold: 1 });
}

#[test]
fn ends_with_few_correspondences() {
    let all_but_2 = mocked().with_ce(Mock(|context: &Context<'_>, _: &Ranked| first_alive(context, M - 2)));
    let result = register(&all_but_2);
    assert_eq!(result.stop_reason, StopReason::FewCorrespondences { value: 2, threshold: 3 });
    assert_eq!(result.rounds.len(), 1);
    let none = mocked().register(&Cloud::from(line_cloud()), &Correspondences::from_rows(vec![])).unwrap();
    assert_eq!(none.stop_reason, StopReason::FewCorrespondences { value: 0, threshold: 3 });
    assert!(none.rounds.is_empty() && none.labels.is_empty());
}

#[test]
fn ends_with_max_rounds_and_max_instances() {
    for limit in [0, 1, 4] {
        let result = register(&mocked().params(Params { max_rounds: Some(limit), ..base() }));
        assert_eq!(result.stop_reason, StopReason::MaxRounds { value: limit, threshold: limit });
        assert_eq!(result.rounds.len(), limit as usize);

        let every_second = mocked().params(Params { max_instances: Some(limit), ..base() }).with_hv(Mock(
            |context: &Context<'_>, _: &Hypothesis| {
                if context.round % 2 == 1 { ACCEPT } else { REJECT }
            },
        ));
        let result = register(&every_second);
        assert_eq!(result.stop_reason, StopReason::MaxInstances { value: limit, threshold: limit });
        assert_eq!((result.poses.len(), result.rounds.len()), (limit as usize, 2 * limit as usize));
    }
}

#[test]
fn ends_with_timeout_and_throws_the_unfinished_round_away() {
    let (limit, result) = long_enough(1, |timeout_s, reached| {
        let slow = move |context: &Context<'_>, _: &Ranked| {
            reached(context.round);
            while context.round == 1 && !context.interrupt.is_set() {
                std::thread::yield_now();
            }
            shifted(0.0)
        };
        let params = Params { timeout_s: Some(timeout_s), ..base() };
        (timeout_s, register(&mocked().params(params).with_te(Mock(slow))))
    });
    let StopReason::Timeout { value, threshold } = result.stop_reason else {
        panic!("{}", result.stop_reason)
    };
    assert!(value >= limit, "{value}");
    assert_eq!(threshold, limit);
    assert_eq!((result.rounds.len(), result.poses.len()), (1, 1), "the slow round was not finished in time");

    let at_once = register(&mocked().params(Params { timeout_s: Some(0.0), ..base() }));
    assert!(matches!(at_once.stop_reason, StopReason::Timeout { threshold: 0.0, .. }));
    assert!(at_once.rounds.is_empty());
    let enough = register(&mocked().params(Params { timeout_s: Some(1e9), ..base() }));
    assert_eq!(enough.rounds.len(), 10);
}

#[test]
fn ends_when_the_observer_says_so_and_keeps_what_was_found() {
    let mut observer = |round: &Round| {
        if round.index == 2 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let result =
        mocked().register_observed(&Cloud::from(line_cloud()), &identity_rows(), &mut observer).unwrap();
    assert_eq!(result.stop_reason, StopReason::Cancelled);
    assert_eq!((result.rounds.len(), result.poses.len()), (3, 3));
}

#[test]
fn ends_when_another_thread_cancels_during_a_long_stage() {
    let token = CancelToken::default();
    let started = Arc::new(AtomicU32::new(0));
    let inside = Arc::clone(&started);
    let deadline = Instant::now() + WATCHDOG;
    let endless =
        mocked().cancel_token(token.clone()).with_te(Mock(move |context: &Context<'_>, _: &Ranked| {
            inside.fetch_add(1, Ordering::SeqCst);
            while context.round == 1 && !context.interrupt.is_set() {
                assert!(Instant::now() < deadline, "the token never arrived");
                std::thread::sleep(Duration::from_millis(1));
            }
            shifted(0.0)
        }));
    let result = std::thread::scope(|scope| {
        scope.spawn(|| {
            while started.load(Ordering::SeqCst) < 2 && Instant::now() < deadline {
                std::thread::sleep(Duration::from_millis(1));
            }
            token.cancel();
        });
        register(&endless)
    });
    assert_eq!(result.stop_reason, StopReason::Cancelled);
    // The hypothesis of the interrupted round would have been accepted; it is thrown away.
    assert_eq!((result.rounds.len(), result.poses.len()), (1, 1));
    // The token stays set: later runs end at once.
    assert!(token.is_cancelled());
    assert!(register(&endless).rounds.is_empty());
}

#[test]
fn built_in_stages_can_be_cancelled_too() {
    // 16384^2 payoffs over 4 billion generations: only the token ends this, once they have begun.
    let scene = ibi_testkit::scenes::Recipe::default().build();
    let token = CancelToken::default();
    let (begins, begun) = channel();
    let scs = ibi_core::stages::scs::Gtm { n_gtm: u32::MAX, ..Default::default() };
    let registrar = Registrar::new(&Cloud::new(&scene.source))
        .unwrap()
        .params(Params { scs: scs.into(), ..base() })
        .watcher(Arc::new(move |phase| _ = begins.send(phase)))
        .cancel_token(token.clone());
    let correspondences = Correspondences::from_rows(scene.rows.clone());
    let result = std::thread::scope(|scope| {
        scope.spawn(move || {
            while begun.recv_timeout(WATCHDOG).is_ok_and(|phase| phase != Phase::Select) {}
            token.cancel();
        });
        registrar.register(&Cloud::new(&scene.target), &correspondences).unwrap()
    });
    assert_eq!(result.stop_reason, StopReason::Cancelled);
}

#[test]
fn ends_when_a_round_removes_nothing() {
    let empty = mocked().with_ce(Mock(|_: &Context<'_>, _: &Ranked| Ranked::default()));
    let result = register(&empty);
    assert_eq!(result.stop_reason, StopReason::Stalled);
    assert_eq!((result.rounds.len(), result.rounds[0].num_removed), (1, 0));
    // Ids that are already gone do not count as removed.
    let stubborn = mocked()
        .with_ce(Mock(|_: &Context<'_>, _: &Ranked| Ranked::new((0..5).map(|id| (id, 1.0)).collect())));
    let result = register(&stubborn);
    assert_eq!(result.stop_reason, StopReason::Stalled);
    let removed: Vec<u32> = result.rounds.iter().map(|round| round.num_removed).collect();
    assert_eq!(removed, [5, 0]);
}

#[test]
fn poses_are_ranked_by_score_and_equals_keep_their_order() {
    // Shifted by k, 100 - k of the 100 points lie on the target; shifted by k and by -k, as many.
    let shifts = [30.0, 10.0, 0.0, -10.0, 20.0];
    let registrar = mocked()
        .params(Params { max_rounds: Some(5), d_op_pr: 0.1, ..base() })
        .with_te(Mock(move |context: &Context<'_>, _: &Ranked| shifted(shifts[context.round as usize])));
    let result = register(&registrar);
    let ranked: Vec<(f64, f64, u32)> = result
        .poses
        .iter()
        .map(|pose| (pose.target_from_source.translation.x, pose.overlap, pose.round))
        .collect();
    let expected = [(0.0, 1.0, 2), (10.0, 0.9, 1), (-10.0, 0.9, 3), (20.0, 0.8, 4), (30.0, 0.7, 0)];
    assert_eq!(ranked, expected);
    let scores: Vec<f64> = result.poses.iter().map(|pose| pose.score).collect();
    assert_eq!(scores[1].to_bits(), scores[2].to_bits());
    assert!(scores.iter().all(|score| (0.0..=1.0).contains(score)));
    assert!([(0, 1), (2, 3), (3, 4)].iter().all(|&(better, worse)| scores[better] > scores[worse]));
}

#[test]
fn labels_go_to_the_closest_pose_and_of_equals_to_the_better_ranked() {
    // Residuals of every correspondence: 0.5, 0.25, 0.25 and 5; t_he is 1.
    let shifts = [0.5, 0.25, -0.25, 5.0];
    let registrar = mocked()
        .params(Params { max_rounds: Some(4), t_he_pr: 1.0, d_op_pr: 0.3, ..base() })
        .with_te(Mock(move |context: &Context<'_>, _: &Ranked| shifted(shifts[context.round as usize])));
    let result = register(&registrar);
    let rounds: Vec<u32> = result.poses.iter().map(|pose| pose.round).collect();
    // By score: 3 puts all but five points exactly onto others, 1 and 2 all of them near, 0 none.
    assert_eq!(rounds, [3, 1, 2, 0]);
    assert!(result.labels.iter().all(|&label| label == Some(1)));
    let num_inliers: Vec<usize> = result.poses.iter().map(|pose| pose.inliers.len()).collect();
    assert_eq!(num_inliers, [0, M, M, M]);
    let rmse: Vec<f64> = result.poses.iter().map(|pose| pose.inlier_rmse).collect();
    assert_eq!(rmse, [0.0, 0.25, 0.25, 0.5]);
}

#[test]
fn begin_step_and_finish_make_a_run() {
    let scene = ibi_testkit::scenes::Recipe { true_pairs: 80, ..Default::default() }.build();
    let params = Params { ce: ibi_core::stages::ce::Voting { n_vot: 60 }.into(), ..base() };
    let registrar = Registrar::new(&Cloud::new(&scene.source)).unwrap().params(params);
    let (target, rows) = (Cloud::new(&scene.target), Correspondences::from_rows(scene.rows.clone()));
    let whole = registrar.register(&target, &rows).unwrap();
    assert!(!whole.poses.is_empty());

    let mut by_run = registrar.begin(&target, &rows).unwrap();
    let reason = registrar.run(&mut by_run, &mut ());
    let mut by_step = registrar.begin(&target, &rows).unwrap();
    let mut rounds = Vec::new();
    let last = loop {
        match registrar.step(&mut by_step) {
            ControlFlow::Continue(round) => rounds.push(round),
            ControlFlow::Break(reason) => break reason,
        }
        assert_eq!(by_step.rounds(), rounds);
        assert_eq!(by_step.poses().count(), rounds.iter().filter(|round| round.accepted()).count());
        let removed: u32 = rounds.iter().map(|round| round.num_removed).sum();
        assert_eq!(by_step.alive().ids().len(), scene.rows.len() - removed as usize);
    };
    assert_eq!((reason, last), (whole.stop_reason, whole.stop_reason));
    for part in [registrar.finish(by_run, reason), registrar.finish(by_step, last)] {
        assert_eq!((&part.rounds, &part.labels), (&whole.rounds, &whole.labels));
        let poses = |result: &Registration| -> Vec<_> {
            result.poses.iter().map(|pose| pose.target_from_source).collect()
        };
        assert_eq!(poses(&part), poses(&whole));
        assert_eq!(part.stop_reason, whole.stop_reason);
    }
}

#[test]
fn a_registrar_can_be_used_again_and_from_several_threads() {
    let registrar = mocked();
    let first = register(&registrar);
    let both: Vec<Registration> = std::thread::scope(|scope| {
        let runs: Vec<_> = (0..2).map(|_| scope.spawn(|| register(&registrar))).collect();
        runs.into_iter().map(|run| run.join().unwrap()).collect()
    });
    assert!(both.iter().all(|other| other.rounds == first.rounds && other.labels == first.labels));
}

#[test]
fn timings_add_up() {
    // What the enhancement takes, by its own clock.
    let spent = Arc::new(Mutex::new(Duration::ZERO));
    let own = Arc::clone(&spent);
    let registrar = mocked().params(Params { max_rounds: Some(2), ..base() }).with_ce(Mock(
        move |_: &Context<'_>, seeds: &Ranked| {
            let start = Instant::now();
            std::thread::sleep(Duration::from_millis(5));
            *own.lock().unwrap() += start.elapsed();
            seeds.clone()
        },
    ));
    let times = register(&registrar).timings;
    assert!(times.ce_s >= spent.lock().unwrap().as_secs_f64());
    let parts = times.prepare_s + times.scs_s + times.ce_s + times.te_s + times.hv_s;
    assert!(parts <= times.total_s);
}
