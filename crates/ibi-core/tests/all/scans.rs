//! What scans bring along: points twice, far pixels, offsets. The spacing that all is measured by minds none of them,
//! and where numbers are too coarse a cloud is refused.

use ibi_core::kernels::nearby::{mean_spacing, spacing};
use ibi_core::nalgebra::{Point3, Vector3};
use ibi_core::stages::ce::Voting;
use ibi_core::{Argument, Cloud, Correspondences, Error, Params, Registrar};
use ibi_testkit::Rng;
use ibi_testkit::scenes::{Recipe, asymmetric_model};
use ibi_testkit::strategies::points;
use proptest::prelude::*;

/// Points at random that fill a segment, a sphere or a box; some with two faces on planes of the axes.
fn cloud(kind: u8, n: usize, seed: u64) -> Vec<Point3<f64>> {
    let mut rng = Rng::new(seed);
    let mut point = |i: usize| match kind {
        0 => Point3::from(Vector3::new(1.0, 2.0, -0.5) * rng.uniform()),
        1 => Point3::from(rng.normal_vector().normalize() * 3.0),
        2 => Point3::from(rng.in_box(1.0)),
        _ => {
            let p = rng.in_box(1.0);
            Point3::new(p.x, p.y, if i.is_multiple_of(3) { 0.5 } else { 0.0 })
        }
    };
    (0..n).map(&mut point).collect()
}

/// The cloud and `share` of its rows again, each up to `off` away, anywhere between the others.
fn with_twins(cloud: &[Point3<f64>], share: f64, off: f64, times: usize, seed: u64) -> Vec<Point3<f64>> {
    let mut rng = Rng::new(seed);
    let mut all = cloud.to_vec();
    for _ in 1..times {
        for p in cloud.iter().take((share * cloud.len() as f64) as usize) {
            all.push(p + rng.in_box(off));
        }
    }
    rng.shuffle(&mut all);
    all
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn spacing_is_the_mean_to_the_bit_where_points_have_no_twins(kind in 0..4_u8, n in 50..1000_usize, seed: u64) {
        // On a line chance makes a pair now and then; of many points its share is small.
        let cloud = if kind == 0 { cloud(0, 10 * n, seed) } else { cloud(kind, n, seed) };
        prop_assert_eq!(spacing(&cloud).to_bits(), mean_spacing(&cloud).to_bits());
    }

    #[test]
    fn spacing_minds_no_twins(
        kind in 1..4_u8, n in 300..1000_usize, seed: u64, share in prop::sample::select(vec![0.5, 0.8, 1.0]),
        off in prop::sample::select(vec![0.0, 1e-9, 1e-6]), times in 2..5_usize, unit in -6..7_i32,
    ) {
        let unit = 10_f64.powi(unit);
        let cloud: Vec<_> = cloud(kind, n, seed).iter().map(|p| p * unit).collect();
        let expected = mean_spacing(&cloud);
        let found = spacing(&with_twins(&cloud, share, off * expected, times, seed));
        prop_assert!((found / expected - 1.0).abs() < 0.01, "{found}, not {expected}");
    }

    #[test]
    fn spacing_minds_no_stray_points(kind in 1..4_u8, n in 300..1000_usize, seed: u64, far in 4.0..9.0_f64) {
        let mut cloud = cloud(kind, n, seed);
        let expected = mean_spacing(&cloud);
        let far = 10_f64.powf(far);
        // Single precision of what is far off is coarse near by: a kernel's bound, not the rule's.
        prop_assume!(far * 1e-6 < expected);
        cloud.extend((0..5).map(|i| Point3::new(far, f64::from(i) * 0.1 * far, -far)));
        let found = spacing(&cloud);
        prop_assert!((found / expected - 1.0).abs() < 0.01, "{found}, not {expected}");
    }

    // Dense bodies far apart are no twins, however far.
    #[test]
    fn bodies_far_apart_keep_their_spacing(n in 200..1000_usize, seed: u64, gap in 1.0..7.0_f64) {
        let body = cloud(1, n, seed);
        let there = Vector3::new(10_f64.powf(gap), 0.0, 0.0);
        let both: Vec<_> = body.iter().copied().chain(body.iter().map(|p| p + there)).collect();
        let expected = mean_spacing(&both);
        prop_assert!((spacing(&both) / expected - 1.0).abs() < 0.05);
    }

    #[test]
    fn spacing_is_above_0_unless_all_points_coincide(cloud in points(0..60), times in 1..4_usize) {
        let all = with_twins(&cloud, 1.0, 0.0, times, 1);
        let coincide = all.iter().all(|p| p == &all[0]);
        prop_assert_eq!(spacing(&all) > 0.0, !coincide);
    }

    // Both sides of the bound: a thousandth of a spacing.
    #[test]
    fn a_cloud_is_refused_where_numbers_are_too_coarse(exponent in 0..18_i32, mantissa in 1.0..2.0_f64, seed: u64, axis in 0..3_usize) {
        let distance: f64 = 10_f64.powi(exponent) * mantissa;
        let mut offset = Vector3::zeros();
        offset[axis] = -distance;
        let points: Vec<_> = cloud(1, 300, seed).iter().map(|p| p + offset).collect();
        let step = distance.next_up() - distance;
        let here = spacing(&points);
        // A cloud on both sides of a power of two may be either.
        prop_assume!(!(0.4..2.5).contains(&(step / (1e-3 * here))));
        match Registrar::new(&Cloud::from(points)) {
            Ok(_) => prop_assert!(step < 1e-3 * here),
            Err(Error::TooFarOff { argument, distance: far, step: held, spacing }) => {
                prop_assert!(step > 1e-3 * here);
                prop_assert_eq!(argument, Argument::Src);
                prop_assert!((far / distance - 1.0).abs() < 1e-6 && held > 1e-3 * spacing);
            }
            // So far off that all of it is one point.
            Err(Error::NoExtent { .. }) => prop_assert!(step > 1.0),
            Err(error) => prop_assert!(false, "{error}"),
        }
    }
}

#[test]
fn the_message_of_a_far_cloud_has_the_numbers() {
    let scene = Recipe::default().build();
    let far = scene.target.iter().map(|p| p + Vector3::new(0.0, 1e14, 0.0)).collect::<Vec<_>>();
    let error = Registrar::new(&Cloud::from(scene.source))
        .unwrap()
        .register(&Cloud::from(far), &Correspondences::from_rows(scene.rows))
        .unwrap_err();
    let message = error.to_string();
    assert!(matches!(error, Error::TooFarOff { argument: Argument::Tgt, .. }), "{message}");
    assert!(
        message.starts_with("the points of tgt are ") && message.contains("1.000e14, where numbers are 1.56")
    );
    assert!(!message.contains('\n'));
}

// A stray point may be held as coarsely as it likes.
#[test]
fn one_far_point_is_no_reason_to_refuse() {
    let mut points = asymmetric_model(200);
    points.push(Point3::new(1e14, 0.0, 0.0));
    assert!(Registrar::new(&Cloud::from(points)).is_ok());
}

#[test]
fn instances_are_found_in_clouds_given_twice() {
    let scene = Recipe { true_pairs: 80, ..Recipe::default() }.build();
    let params = Params { t_he_pr: 3.0, ce: Voting { n_vot: 60 }.into(), ..Params::paper_synthetic() };
    let num_found = |source: Vec<Point3<f64>>, target: Vec<Point3<f64>>| {
        let registrar = Registrar::new(&Cloud::from(source)).unwrap().params(params.clone());
        let rows = Correspondences::from_rows(scene.rows.clone());
        registrar.register(&Cloud::from(target), &rows).unwrap().poses.len()
    };
    let expected = num_found(scene.source.clone(), scene.target.clone());
    assert!(expected > 0);
    for off in [0.0, 1e-6] {
        // Rows keep their numbers: the twins come after.
        let mut rng = Rng::new(3);
        let mut twice = |points: &[Point3<f64>]| {
            let twins = points.iter().map(|p| p + rng.in_box(off));
            points.iter().copied().chain(twins).collect::<Vec<_>>()
        };
        let (source, target) = (twice(&scene.source), twice(&scene.target));
        assert_eq!(num_found(scene.source.clone(), target.clone()), expected, "target, {off}");
        assert_eq!(num_found(source.clone(), scene.target.clone()), expected, "source, {off}");
        assert_eq!(num_found(source, target), expected, "both, {off}");
    }
}
