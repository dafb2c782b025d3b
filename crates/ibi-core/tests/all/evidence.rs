//! What speaks for a pose: the support of its correspondences against chance, and how closely the clouds fit.

use crate::oriented::{Oriented, clouds, seen_from};
use ibi_core::Support;
use ibi_core::kernels::nearby::Nearby;
use ibi_core::kernels::overlap::{Contact, chance_fit, fit, overlap, places};
use ibi_core::kernels::par::Pool;
use ibi_core::kernels::rng::Rng;
use ibi_core::nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use ibi_testkit::naive;
use ibi_testkit::strategies::{point, rigid_motions};
use proptest::prelude::*;

// ----------------------------------------------------------------------------------------------------- support

fn support(num_explained: u32, num_agreeing: u32, chance: f64) -> Support {
    Support { num_explained, num_agreeing, chance, ..Support::default() }
}

fn evidence(n: u32, k: u32, p: f64) -> f64 {
    support(n, k, p).evidence()
}

/// n, k <= n, and p; also where next to nothing is left to chance.
fn counts() -> impl Strategy<Value = (u32, u32, f64)> {
    let n = prop_oneof![1..10_u32, 1..3000_u32];
    let p = prop_oneof![0.0..1.0, (-8.0..0.0_f64).prop_map(|e| 10_f64.powf(e))]
        .prop_map(|p: f64| p.clamp(1e-8, 0.999));
    (n, p).prop_flat_map(|(n, p)| (Just(n), 0..=n, Just(p)))
}

proptest! {
    // Between Hoeffding's bound of the tail and the least its largest term can be (Robbins 1955): apart from
    // rounding the evidence is too small by at most half the logarithm of 8 n (k/n) (1 - k/n).
    #[test]
    fn evidence_is_a_close_bound_of_the_binomial_tail((n, k, p) in counts()) {
        let (bound, exact) = (evidence(n, k, p), naive::binomial_surprise(n, k, p));
        let rounding = 1e-9 * (1.0 + exact);
        prop_assert!(bound <= exact + rounding, "{bound} {exact}");
        let (n, k) = (f64::from(n), f64::from(k));
        if k > p * n {
            let slack = 0.5 * (8.0 * k * (n - k) / n).max(1.0).log10();
            prop_assert!(exact <= bound + slack + rounding, "{bound} {exact} {slack}");
        } else {
            prop_assert_eq!(bound, 0.0);
        }
    }

    #[test]
    fn evidence_grows_with_the_agreeing_and_with_what_chance_cannot((n, k, p) in counts(), less in 0.0..1.0) {
        let here = evidence(n, k, p);
        prop_assert!(here >= 0.0 && here.is_finite());
        if k < n {
            prop_assert!(evidence(n, k + 1, p) >= here);
            // One more that is explained and does not agree takes nothing away but evidence.
            prop_assert!(evidence(n + 1, k, p) <= here * (1.0 + 1e-12));
        }
        prop_assert!(evidence(n, k, p * less) >= here);
        // All counts twice: the same share is twice as unlikely.
        prop_assert!((evidence(2 * n, 2 * k, p) - 2.0 * here).abs() <= 1e-9 * (1.0 + here));
    }

    #[test]
    fn scores_are_probabilities_that_grow_with_all_that_speaks_for_a_pose(
        (n, k, chance) in counts(), shares in prop::array::uniform3(0.0..=1.0), one_sided: bool,
    ) {
        let [fit, back_fit, chance_fit] = shares;
        let here = Support { fit, back_fit, chance_fit: 0.9 * chance_fit, one_sided, ..support(n, k, chance) };
        prop_assert!((0.0..=1.0).contains(&here.score()) && here.log_odds().is_finite());
        let odds = here.log_odds().exp();
        prop_assert!((here.score() - odds / (1.0 + odds)).abs() < 1e-12);
        prop_assert!(here.closeness() <= 1.0);
        for better in [
            Support { num_agreeing: n, ..here },
            Support { fit: 0.5 * (fit + 1.0), ..here },
            Support { back_fit: 0.5 * (back_fit + 1.0), ..here },
        ] {
            prop_assert!(better.log_odds() >= here.log_odds());
        }
    }
}

#[test]
fn nothing_speaks_for_a_pose_that_nothing_agrees_with() {
    for chance in [0.0, 1e-12, 0.5, 1.0] {
        for (n, k) in [(0, 0), (1, 0), (1000, 0)] {
            assert_eq!(evidence(n, k, chance), 0.0);
        }
    }
    // Chance explains everything; or nothing, and then a single one says a lot, but not without end.
    assert!(evidence(1000, 1000, 1.0) < 1e-6);
    assert!((8.9..9.1).contains(&evidence(1, 1, 0.0)));
    let nothing = Support::default();
    assert!(nothing.score() < 1e-9 && nothing.closeness() == 0.0);
    let all = Support { fit: 1.0, back_fit: 1.0, ..support(200, 200, 0.01) };
    assert!(all.score() > 0.999 && all.closeness() == 1.0);
    // As close as by chance is not close; a target that any pose fits tells nothing.
    assert_eq!(Support { fit: 0.3, chance_fit: 0.3, ..all }.closeness(), 0.0);
    assert!(Support { fit: 1.0, chance_fit: 1.0, ..all }.score().is_finite());
}

// --------------------------------------------------------------------------------------------------------- fit

impl Oriented {
    /// The first `kept`, and all of `other`.
    fn joined(&self, kept: usize, other: &Self) -> Self {
        let kept = kept.min(self.points.len());
        Self {
            points: [&self.points[..kept], &other.points].concat(),
            normals: [&self.normals[..kept], &other.normals].concat(),
        }
    }

    /// Every normal whose turn it is points the other way.
    fn flipped(&self, flips: &[bool]) -> Self {
        let flip = |(n, &flip): (&Vector3<f64>, &bool)| if flip { -n } else { *n };
        Self { normals: self.normals.iter().zip(flips.iter().cycle()).map(flip).collect(), ..self.clone() }
    }

    fn naive(&self, with_normals: bool) -> naive::Surface<'_> {
        (&self.points, with_normals.then_some(&self.normals))
    }
}

fn contact(distance: f64, oriented: bool) -> Contact<'static> {
    Contact { distance, min_normal_cos: 0.3, oriented, view: None, to_planes: false }
}

/// The fit of `source` to `target`, with normals if they are to count.
fn fit_of(
    source: &Oriented,
    target: &Oriented,
    pose: &Isometry3<f64>,
    contact: &Contact<'_>,
    claimed: Option<&[bool]>,
    with_normals: bool,
) -> f64 {
    let near = Nearby::new(&target.points, contact.distance);
    let are_claimed =
        |rows: &[u32]| rows.iter().map(|&row| claimed.is_some_and(|claimed| claimed[row as usize])).collect();
    fit(&source.surface(with_normals), &target.surface(with_normals), &near, pose, contact, are_claimed).mean
}

proptest! {
    #[test]
    fn fit_is_its_twin(
        source in clouds(0..40), others in clouds(0..40), pose in rigid_motions(5.0), kept in 0..40_usize,
        reach in 0.05..5.0, flags in prop::collection::vec(any::<bool>(), 80), oriented: bool,
        motion in rigid_motions(100.0),
    ) {
        // Part of the source lies on the target, some of it upside down; part of the target is claimed.
        let target = source.moved(&pose).flipped(&flags[40..]).joined(kept, &others);
        let claimed = &flags[..target.points.len()];
        let contact = contact(reach, oriented);
        for with_normals in [false, true] {
            let (least, most) = naive::fit(
                source.naive(with_normals), target.naive(with_normals), claimed, &pose, reach,
                (contact.min_normal_cos, oriented),
            );
            let value = fit_of(&source, &target, &pose, &contact, Some(claimed), with_normals);
            prop_assert!((least - 1e-9..=most + 1e-9).contains(&value), "{least} {value} {most}");
            prop_assert!((0.0..=1.0).contains(&value));
            let moved = fit_of(
                &source, &target.moved(&motion), &(motion * pose), &contact, Some(claimed), with_normals,
            );
            prop_assert!((least - 1e-9..=most + 1e-9).contains(&moved), "{least} {moved} {most}");
            // Nothing claimed is as good as no claims, and claims take away only.
            let free = fit_of(&source, &target, &pose, &contact, None, with_normals);
            let none = vec![false; target.points.len()];
            prop_assert_eq!(free, fit_of(&source, &target, &pose, &contact, Some(&none), with_normals));
            prop_assert!(free >= value);
            let all = vec![true; target.points.len()];
            prop_assert_eq!(fit_of(&source, &target, &pose, &contact, Some(&all), with_normals), 0.0);
            // A slope below a step.
            let near = Nearby::new(&target.points, reach);
            let share = overlap(
                &source.surface(with_normals), &target.surface(with_normals), &near, &pose, &contact,
            );
            prop_assert!(free <= share + 1e-12);
        }
    }

    #[test]
    fn fit_of_a_cloud_to_itself_is_perfect_whatever_the_frame(
        cloud in clouds(1..60), motion in rigid_motions(100.0), reach in 0.05..5.0,
    ) {
        let there = cloud.moved(&motion);
        let value = fit_of(&cloud, &there, &motion, &contact(reach, true), None, false);
        prop_assert!((1.0 - value).abs() < 1e-9 / reach, "{value}");
    }

    #[test]
    fn without_orientation_the_signs_of_normals_mean_nothing(
        source in clouds(1..40), others in clouds(0..20), pose in rigid_motions(5.0),
        one in prop::collection::vec(any::<bool>(), 40), other in prop::collection::vec(any::<bool>(), 60),
        viewpoint in prop::option::of(point()), seed: u64,
    ) {
        let target = source.moved(&pose).joined(30, &others);
        let (back, forth) = (source.flipped(&one), target.flipped(&other));
        let near = Nearby::new(&target.points, 1.0);
        let unoriented = Contact { view: viewpoint.map(seen_from), ..contact(1.0, false) };
        let ask = |source: &Oriented, target: &Oriented, contact: &Contact| {
            let (from, to) = (source.surface(true), target.surface(true));
            (
                places(&from, &to, &near, &pose, contact),
                fit(&from, &to, &near, &pose, contact, |rows| vec![false; rows.len()]).mean.to_bits(),
                chance_fit(&from, &to, &near, contact, Rng::new(seed, 0, 0), 50).to_bits(),
            )
        };
        let plain = ask(&source, &target, &unoriented);
        for (source, target) in [(&back, &target), (&source, &forth), (&back, &forth)] {
            prop_assert_eq!(ask(source, target, &unoriented), plain.clone());
        }
        // Nor is anything hidden: sides are what orientation tells.
        prop_assert_eq!(ask(&source, &target, &Contact { view: None, ..unoriented }), plain);
    }
}

#[test]
fn fit_falls_with_the_distance_and_ends_at_the_reach() {
    let cloud = Oriented::model(300);
    let perfect = fit_of(&cloud, &cloud, &Isometry3::identity(), &contact(0.3, true), None, true);
    assert_eq!(perfect, 1.0);
    let at = |x: f64| {
        let (one, origin) = (vec![Point3::new(x, 0.0, 0.0)], vec![Point3::origin()]);
        let up = vec![Vector3::z()];
        let (source, target) =
            (Oriented { points: one, normals: up.clone() }, Oriented { points: origin, normals: up });
        fit_of(&source, &target, &Isometry3::identity(), &contact(2.0, true), None, true)
    };
    assert_eq!([0.0, 0.5, 1.0, 1.5, 2.0, 2.5].map(at), [1.0, 0.75, 0.5, 0.25, 0.0, 0.0]);
    // Upside down it fits only if nobody knows what is up.
    let flipped = cloud.flipped(&[true]);
    let upside_down =
        |oriented| fit_of(&cloud, &flipped, &Isometry3::identity(), &contact(0.3, oriented), None, true);
    assert_eq!((upside_down(true), upside_down(false)), (0.0, 1.0));
    // Nothing at all.
    let nothing = Oriented::default();
    let to = |source, target| fit_of(source, target, &Isometry3::identity(), &contact(0.3, true), None, true);
    assert_eq!((to(&nothing, &cloud), to(&cloud, &nothing)), (0.0, 0.0));
}

#[test]
fn fit_looks_at_what_the_viewpoint_sees() {
    let source = Oriented {
        points: vec![Point3::origin(), Point3::new(5.0, 0.0, 0.0), Point3::new(9.0, 0.0, 0.0)],
        normals: vec![Vector3::z(), -Vector3::z(), Vector3::z()],
    };
    let target = Oriented { points: vec![Point3::origin()], normals: vec![Vector3::z()] };
    let fit_from = |z: f64, oriented| {
        let contact = Contact { view: Some(seen_from(Point3::new(0.0, 0.0, z))), ..contact(1.0, oriented) };
        fit_of(&source, &target, &Isometry3::identity(), &contact, None, true)
    };
    // From above two of three are seen and one of them fits; from below the other one only.
    assert_eq!((fit_from(99.0, true), fit_from(-99.0, true)), (0.5, 0.0));
    assert_eq!((fit_from(99.0, false), fit_from(-99.0, false)), (1.0 / 3.0, 1.0 / 3.0));
}

// -------------------------------------------------------------------------------------------------- chance fit

/// `chance_fit` by its definition, with random numbers of our own.
fn naive_chance_fit(source: &Oriented, target: &Oriented, contact: &Contact<'_>, samples: usize) -> f64 {
    let mut rng = ibi_testkit::Rng::new(99);
    let one = |_| {
        let [i, about] = [(); 2].map(|()| rng.below(source.points.len()));
        let turn = rng.pose_at(Vector3::zeros()).rotation;
        let onto = target.points[rng.below(target.points.len())];
        let pose = Isometry3::from_parts((onto - turn * source.points[about]).into(), turn);
        let only = (&source.points[i..=i], Some(&source.normals[i..=i]));
        let free = vec![false; target.points.len()];
        let normals = (contact.min_normal_cos, contact.oriented);
        naive::fit(only, target.naive(true), &free, &pose, contact.distance, normals).0
    };
    (0..samples).map(one).sum::<f64>() / samples as f64
}

#[test]
fn chance_fit_is_its_twin_and_the_same_for_any_number_of_threads() {
    let source = Oriented::model(60);
    let pose = Isometry3::translation(2.5, 0.3, -0.2);
    let target = source.joined(60, &source.moved(&pose));
    let near = Nearby::new(&target.points, 1.5);
    for (reach, oriented) in [(0.5, true), (0.5, false), (1.5, true)] {
        // A viewpoint says nothing about a pose that is not known.
        let contact = Contact { view: Some(seen_from(Point3::origin())), ..contact(reach, oriented) };
        let ask = |samples| {
            let rng = Rng::new(3, 0, 3);
            chance_fit(&source.surface(true), &target.surface(true), &near, &contact, rng, samples)
        };
        let (value, twin) = (ask(20_000), naive_chance_fit(&source, &target, &contact, 5000));
        // Both are means of values in 0..=1: four standard errors of the smaller sample are at most 0.028.
        assert!((value - twin).abs() < 0.028, "{reach} {oriented}: {value} {twin}");
        assert!((0.02..0.9).contains(&value), "{value} says little");
        // Fewer samples, as in a run, are good to a few hundredths.
        assert!((ask(1000) - value).abs() < 0.06);
        for num_threads in [1, 2, 7] {
            let pool = Pool::new(Some(num_threads)).unwrap();
            assert_eq!(pool.install(|| ask(1000)).to_bits(), ask(1000).to_bits());
            let fit = || fit_of(&source, &target, &pose, &contact, None, true).to_bits();
            assert_eq!(pool.install(fit), fit());
        }
        assert_eq!(ask(0), 0.0);
    }
}

// ------------------------------------------------------------------------------------- what these are made from

// The mean of n unit vectors in random directions is about 1 / sqrt(n) long, 0.007; the seeds are fixed.
#[test]
fn rotations_are_uniform() {
    let mut rng = Rng::new(42, 0, 0);
    let rotations: Vec<UnitQuaternion<f64>> = (0..20_000).map(|_| rng.rotation()).collect();
    let n = rotations.len() as f64;
    for axis in [Vector3::x(), Vector3::y(), Vector3::z(), Vector3::new(0.6, 0.0, -0.8)] {
        let turned: Vec<Vector3<f64>> = rotations.iter().map(|r| r * axis).collect();
        let mean = turned.iter().sum::<Vector3<f64>>() / n;
        assert!(mean.norm() < 0.025, "{mean}");
        // As spread along each axis: a third of the square; and within slices of equal height, the same number
        // (Archimedes). 43.8 is exceeded with probability 0.001 at 19 degrees of freedom.
        for along in 0..3 {
            let square = turned.iter().map(|v| v[along].powi(2)).sum::<f64>() / n;
            assert!((square - 1.0 / 3.0).abs() < 0.01, "{square}");
            let mut counts = [0_u32; 20];
            for v in &turned {
                counts[(((v[along] + 1.0) * 10.0) as usize).min(19)] += 1;
            }
            let chi_square: f64 =
                counts.iter().map(|&c| (f64::from(c) - n / 20.0).powi(2) / (n / 20.0)).sum();
            assert!(chi_square < 43.8, "{chi_square}");
        }
    }
    // Angles too: a uniform rotation turns by less than a with probability (a - sin a) / pi.
    let below = rotations.iter().filter(|r| r.angle() < 2.0).count() as f64 / n;
    assert!((below - (2.0 - 2.0_f64.sin()) / std::f64::consts::PI).abs() < 0.015, "{below}");
    assert!(rotations.iter().all(|r| (r.norm() - 1.0).abs() < 1e-12));
    // And so are the numbers they are made from.
    let draws: Vec<f64> = (0..20_000).map(|_| rng.unit()).collect();
    assert!(draws.iter().all(|x| (0.0..1.0).contains(x)));
    assert!((draws.iter().sum::<f64>() / n - 0.5).abs() < 0.01);
}
