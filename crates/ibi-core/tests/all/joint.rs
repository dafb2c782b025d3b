//! The joint check: at the end of a run all poses compete for the target, and those with too little of their own go.
//! With mocks first, then with the built-in validation.

use crate::mock::Mock;
use ibi_core::nalgebra::{Isometry3, Point3, Vector3};
use ibi_core::stages::ce::Voting;
use ibi_core::stages::hv::Evidence;
use ibi_core::stages::{Context, Estimate, Hypothesis, Ranked, Verdict};
use ibi_core::{Cloud, Correspondences, Params, Registrar, Registration, Removal};
use ibi_testkit::Rng;
use ibi_testkit::scenes::asymmetric_model;

/// The model is 10 points in a row, 1 apart; the scene is 100. Placed near x, it explains rows x to x + 9.
const MODEL: usize = 10;
const M: usize = 100;

fn row_of_points(n: usize) -> Vec<Point3<f64>> {
    (0..n).map(|i| Point3::new(i as f64, 0.0, 0.0)).collect()
}

/// One hypothesis a round: where the model is placed, and how good that is. None is good after the last.
type Plan = &'static [(f64, f64)];

const THRESHOLD: f64 = 0.3;

/// Plays `plan`, each hypothesis an instance as soon as it passes; its value is its quality times the share of its ten
/// scene points that are free. Five correspondences go in each round.
fn played(plan: Plan, joint_check: bool) -> Registration {
    // Nearer than half a step, so that a place between two points has one row for each point of the model.
    let params = Params { d_op_pr: 0.49, t_he_pr: 0.01, t_s: 3, joint_check, ..Params::paper_synthetic() };
    let registrar = Registrar::new(&Cloud::from(row_of_points(MODEL)))
        .unwrap()
        .params(params)
        .num_threads(1)
        .with_scs(Mock(|context: &Context<'_>| {
            Ranked::new(context.alive.ids().iter().take(5).map(|&id| (id, 1.0)).collect())
        }))
        .with_ce(Mock(|_: &Context<'_>, seeds: &Ranked| seeds.clone()))
        .with_te(Mock(move |context: &Context<'_>, _: &Ranked| {
            let hypothesis = plan.get(context.round as usize).map(|&(x, score)| Hypothesis {
                target_from_source: Isometry3::translation(x, 0.0, 0.0),
                score,
            });
            Estimate { hypothesis, num_samples: 1, num_degenerate: 0, capped: false }
        }))
        .with_hv(Mock(|context: &Context<'_>, hypothesis: &Hypothesis| {
            let x = hypothesis.target_from_source.translation.x.round() as usize;
            let near = context.claims.near(&hypothesis.target_from_source);
            let free = (x as u32..(x + MODEL) as u32).filter(|&row| !context.claims.contains(row)).count();
            let rows: Vec<u32> = (x as u32..(x + MODEL) as u32).filter(|&row| (row as usize) < M).collect();
            let one_by_one: Vec<bool> = rows.iter().map(|&row| context.claims.contains(row)).collect();
            assert_eq!(near.contain(&rows), one_by_one, "claims near {x}");
            Verdict { value: hypothesis.score * free as f64 / MODEL as f64, threshold: THRESHOLD }
        }));
    let rows = (0..M).map(|row| [row % MODEL, row]).collect();
    registrar.register(&Cloud::from(row_of_points(M)), &Correspondences::from_rows(rows)).unwrap()
}

/// Where the instances are, ascending.
fn places(plan: Plan, joint_check: bool) -> Vec<f64> {
    let result = played(plan, joint_check);
    let mut places: Vec<f64> =
        result.poses.iter().map(|pose| pose.target_from_source.translation.x).collect();
    places.sort_by(f64::total_cmp);
    places
}

/// What is found without the check, and with it.
fn assert_places(plan: Plan, without: &[f64], with: &[f64]) {
    assert_eq!(places(plan, false), without);
    assert_eq!(places(plan, true), with);
}

#[test]
fn a_wrong_early_pose_that_lives_on_what_right_later_ones_are_nearer_to_is_dropped() {
    // The first lies askew over the ends of two that come later, and half of each was left.
    assert_places(&[(5.4, 1.0), (0.0, 1.0), (10.0, 1.0)], &[0.0, 5.4, 10.0], &[0.0, 10.0]);
    // Between them it keeps what neither of them covers, which is enough, or is not.
    assert_places(&[(5.4, 1.0), (0.0, 1.0), (14.0, 1.0)], &[0.0, 5.4, 14.0], &[0.0, 5.4, 14.0]);
    assert_places(&[(5.4, 1.0), (0.0, 1.0), (13.0, 1.0)], &[0.0, 5.4, 13.0], &[0.0, 13.0]);
}

#[test]
fn touching_instances_stay() {
    assert_places(&[(0.0, 1.0), (9.0, 1.0), (18.0, 1.0)], &[0.0, 9.0, 18.0], &[0.0, 9.0, 18.0]);
    // Also where each has four points of ten in common with the next.
    assert_places(&[(0.0, 1.0), (6.0, 1.0), (12.0, 1.0)], &[0.0, 6.0, 12.0], &[0.0, 6.0, 12.0]);
}

#[test]
fn the_worst_goes_first_and_leaves_its_points_to_the_others() {
    // 0.3 owns five points, as 5.2 is nearer to the others, and 5.2 four of them, between its neighbours. Both fail,
    // but without the worse one the other has all it needs.
    assert_places(&[(0.3, 0.55), (5.2, 0.65), (9.1, 1.0)], &[0.3, 5.2, 9.1], &[0.3, 9.1]);
    // If that one passes, the other has to go.
    assert_places(&[(0.3, 0.55), (5.2, 0.8), (9.1, 1.0)], &[0.3, 5.2, 9.1], &[5.2, 9.1]);
}

#[test]
fn a_single_pose_has_nobody_to_compete_with() {
    assert_places(&[(3.0, 0.31)], &[3.0], &[3.0]);
    assert_places(&[], &[], &[]);
}

#[test]
fn of_duplicates_one_stays() {
    let source = asymmetric_model(200);
    let mut rng = Rng::new(3);
    let truth = [-2.0, 2.0].map(|x| rng.pose_at(Vector3::new(x, 0.0, 0.0)));
    let target: Vec<_> = truth.iter().flat_map(|pose| source.iter().map(move |p| pose * p)).collect();
    let rows: Vec<[usize; 2]> = (0..400).map(|row| [row % 200, row]).collect();
    // Neither claims nor contests keep an instance from being found in every second round.
    let nth = move |context: &Context<'_>, _: &Ranked| {
        let hypothesis = Hypothesis { target_from_source: truth[context.round as usize % 2], score: 1.0 };
        Estimate { hypothesis: Some(hypothesis), num_samples: 1, num_degenerate: 0, capped: false }
    };
    let found = |joint_check| {
        let params = Params {
            ce: Voting { n_vot: 30 }.into(),
            hv: Evidence { exclusive: false, ..Evidence::default() }.into(),
            removal: Removal::Dense,
            n_contest: 1,
            max_rounds: Some(6),
            joint_check,
            ..Params::default()
        };
        let registrar = Registrar::new(&Cloud::new(&source)).unwrap().params(params).with_te(Mock(nth));
        registrar.register(&Cloud::new(&target), &Correspondences::from_rows(rows.clone())).unwrap()
    };
    let (all, own) = (found(false), found(true));
    assert_eq!((all.poses.len(), own.poses.len()), (6, 2));
    let rounds: Vec<u32> = own.poses.iter().map(|pose| pose.round % 2).collect();
    assert!(rounds == [0, 1] || rounds == [1, 0], "one of each: {rounds:?}");
    for pose in &own.poses {
        assert!(pose.score > 0.9 && pose.closeness > 0.99 && pose.inliers.len() == 200, "{pose:?}");
    }
}
