//! The last polish, and how well it says that a pose is known.

use ibi_core::evidence::polish::{
    FEW, Faces, Hold, Measured, Polished, information, loss, polish, touches, weight,
};
use ibi_core::evidence::shared::{Correlation, LAGS, Off, Pairs, pairs};
use ibi_core::evidence::slip::{covariance, motion_between, moved};
use ibi_core::kernels::nearby::Nearby;
use ibi_core::nalgebra::{Isometry3, Matrix6, Point3, Vector3, Vector6};
use ibi_testkit::strategies::{points, rigid_motions};
use ibi_testkit::{Rng, evidence as naive};
use proptest::prelude::*;

const SPACING: f64 = 0.1;
const NOISE: f64 = 0.02;
const EYE: [f64; 3] = [10.0, 11.0, 12.0];

/// Three faces of a box of 2 x 1.6 x 1.2 that meet in a corner: points and normals.
fn corner(step: f64) -> (Vec<Point3<f64>>, Vec<Vector3<f64>>) {
    let half = [1.0, 0.8, 0.6];
    let (mut points, mut normals) = (Vec::new(), Vec::new());
    for axis in 0..3 {
        let [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
        let count = |k: usize| (2.0 * half[k] / step).round() as usize;
        for i in 0..count(u) {
            for j in 0..count(v) {
                let mut p = Point3::origin();
                p[axis] = half[axis];
                (p[u], p[v]) = ((i as f64 + 0.5) * step - half[u], (j as f64 + 0.5) * step - half[v]);
                points.push(p);
                normals.push(Vector3::ith(axis, 1.0));
            }
        }
    }
    (points, normals)
}

fn measured(at: Point3<f64>) -> Measured {
    Measured { at, to_eye: (Point3::from(EYE) - at).normalize() }
}

/// The corner as it is measured where `truth` has moved it, but for its edges: there noise decides which face is nearest.
fn scan(truth: &Isometry3<f64>, rng: &mut Rng) -> Vec<Measured> {
    let (points, normals) = corner(0.073);
    let inner = |(p, n): &(&Point3<f64>, &Vector3<f64>)| {
        (0..3).all(|k| n[k] > 0.5 || p[k].abs() < [1.0, 0.8, 0.6][k] - 0.12)
    };
    let noisy =
        points.iter().zip(&normals).filter(inner).map(|(p, n)| truth * (p + n * (NOISE * rng.normal())));
    noisy.map(measured).collect()
}

fn hold() -> Hold {
    let information = Matrix6::zeros();
    Hold { centre: Point3::origin(), size: 1.4, information, across: 0.3, most: 0.5, noise: 0.0 }
}

fn random_motion(rng: &mut Rng, size: f64) -> Vector6<f64> {
    Vector6::from_fn(|_, _| size * rng.normal())
}

struct Model(Vec<Point3<f64>>, Vec<Vector3<f64>>, Nearby);

impl Model {
    fn new() -> Self {
        let (points, normals) = corner(SPACING);
        let nearby = Nearby::new(&points, 1.0);
        Self(points, normals, nearby)
    }

    fn faces(&self) -> Faces<'_> {
        Faces { points: &self.0, normals: &self.1, nearby: &self.2, spacing: SPACING }
    }
}

proptest! {
    #[test]
    fn what_touches_is_what_the_definition_says(
        model in points(3..60), cloud in points(1..60), turn in rigid_motions(1.0), pose in rigid_motions(0.5), across in 0.1..2.0_f64,
    ) {
        let normals = vec![turn * Vector3::z(); model.len()];
        let nearby = Nearby::new(&model, 4.0);
        let faces = Faces { points: &model, normals: &normals, nearby: &nearby, spacing: 1.0 };
        let cloud: Vec<Measured> = cloud.into_iter().map(measured).collect();
        let found = touches(&faces, &cloud, &pose, across);
        for (ray, touch) in cloud.iter().zip(found) {
            let (gap, margin) = naive::touch((&model, &normals), (&ray.at, &ray.to_eye), &pose, across, 1.0, 0.25);
            prop_assume!(margin > 1e-5);
            prop_assert_eq!(gap.is_some(), touch.is_some());
            if let (Some(gap), Some(touch)) = (gap, touch) {
                prop_assert!((gap - touch.gap).abs() < 1e-9);
            }
        }
    }
}

#[test]
fn a_pose_comes_to_where_the_points_want_it_and_never_to_a_worse_one() {
    let (model, mut rng) = (Model::new(), Rng::new(1));
    for _ in 0..50 {
        let truth = moved(&random_motion(&mut rng, 0.1), &Point3::origin(), &Isometry3::identity());
        let mut cloud = scan(&truth, &mut rng);
        // A plane that goes on beyond a rim, and what lies about.
        cloud.extend((0..300).map(|k| measured(truth * Point3::new(1.1 + 0.002 * f64::from(k), 0.0, 0.6))));
        let start = moved(&random_motion(&mut rng, 0.03), &Point3::origin(), &truth);
        let found = polish(&model.faces(), &cloud, &start, &hold()).unwrap();
        let off = motion_between(&found.target_from_source, &truth, &(truth * Point3::origin()));
        assert!(off.amax() < 0.02, "{off}");
        let loss = |pose| loss(&touches(&model.faces(), &cloud, pose, 0.3), found.cutoff);
        assert!(loss(&found.target_from_source) <= loss(&start));
    }
}

#[test]
fn it_is_bounded_and_wants_points() {
    let (model, mut rng) = (Model::new(), Rng::new(2));
    let truth = Isometry3::identity();
    let cloud = scan(&truth, &mut rng);
    let start = Isometry3::translation(0.1, 0.0, 0.0);
    let tight = Hold { most: 0.03, ..hold() };
    let found = polish(&model.faces(), &cloud, &start, &tight).unwrap();
    assert!((found.target_from_source.translation.vector - start.translation.vector).norm() <= 0.03);
    assert!(polish(&model.faces(), &cloud[..FEW - 1], &start, &hold()).is_none());
    let far = Isometry3::translation(5.0, 0.0, 0.0);
    assert!(polish(&model.faces(), &cloud, &far, &hold()).is_none());
}

/// One face says nothing of slides along it: what holds it there is handed in.
#[test]
fn what_the_planes_do_not_tell_stays() {
    let (model, mut rng) = (Model::new(), Rng::new(3));
    let cloud: Vec<Measured> =
        scan(&Isometry3::identity(), &mut rng).into_iter().filter(|ray| ray.at.z > 0.55).collect();
    let start = Isometry3::translation(0.02, -0.03, 0.05);
    let information = Matrix6::from_diagonal(&Vector6::new(0.0, 0.0, 1e6, 1e6, 1e6, 0.0));
    let found =
        polish(&model.faces(), &cloud, &start, &Hold { information, ..hold() }).unwrap().target_from_source;
    let shift = found.translation.vector;
    assert!((shift.xy() - start.translation.vector.xy()).norm() < 2e-3 && shift.z.abs() < 5e-3, "{shift}");
}

/// 200 times: the mean square distance from the truth, in deviations, is that of six normal numbers.
#[test]
fn the_covariance_is_what_poses_are_off_by() {
    let (model, mut rng) = (Model::new(), Rng::new(4));
    let centre = Point3::origin();
    let mut sum = 0.0;
    for _ in 0..200 {
        let truth = moved(&random_motion(&mut rng, 0.1), &centre, &Isometry3::identity());
        let cloud = scan(&truth, &mut rng);
        let start = moved(&random_motion(&mut rng, 0.02), &(truth * centre), &truth);
        let found = polish(&model.faces(), &cloud, &start, &hold()).unwrap();
        let at = found.target_from_source * centre;
        let known = covariance(&information(&cloud, &found, &at), 1.4);
        let off = motion_between(&found.target_from_source, &truth, &at);
        sum += (known.try_inverse().unwrap() * off).dot(&off);
    }
    let mean = sum / 200.0;
    assert!((mean - 6.0).abs() < 0.6, "{mean}");
}

#[test]
fn nothing_counts_beyond_the_cutoff() {
    assert_eq!([weight(0.0, 2.0), weight(2.0, 2.0), weight(-3.0, 2.0)], [1.0, 0.0, 0.0]);
    let nothing = Polished { target_from_source: Isometry3::identity(), touches: vec![None; 9], cutoff: 1.0 };
    assert_eq!(information(&[], &nothing, &Point3::origin()), Matrix6::zeros());
    assert!((loss(&nothing.touches, 1.0) - 1.0).abs() < 1e-12);
}

/// An image of errors half of which is blurred over `reach` / sqrt 2 pixels.
fn image(share: f64, reach: f64, rng: &mut Rng) -> Vec<Off> {
    const SIDE: usize = 70;
    let kernel = |d: f64| (-0.5 * (d * std::f64::consts::SQRT_2 / reach).powi(2)).exp();
    let far = (2.5 * reach).ceil() as usize;
    let wide = SIDE + 2 * far;
    let blur = |row: &[f64]| -> Vec<f64> {
        let weights: Vec<f64> = (0..=2 * far).map(|k| kernel(k as f64 - far as f64)).collect();
        let norm = weights.iter().map(|w| w * w).sum::<f64>().sqrt();
        (0..row.len() - 2 * far)
            .map(|at| weights.iter().zip(&row[at..]).map(|(w, x)| w * x).sum::<f64>() / norm)
            .collect()
    };
    let white: Vec<Vec<f64>> = (0..wide).map(|_| (0..wide).map(|_| rng.normal()).collect()).collect();
    let rows: Vec<Vec<f64>> = white.iter().map(|row| blur(row)).collect();
    let columns: Vec<Vec<f64>> =
        (0..SIDE).map(|x| blur(&rows.iter().map(|row| row[x]).collect::<Vec<_>>())).collect();
    let mut offs = Vec::new();
    for (x, column) in columns.iter().enumerate() {
        for (y, shared) in column.iter().enumerate() {
            let gap = share.sqrt() * shared + (1.0 - share).sqrt() * rng.normal();
            offs.push(Off { ray: Point3::new(x as f64, y as f64, 800.0), normal: Vector3::z(), gap });
        }
    }
    offs
}

#[test]
fn how_errors_are_shared_is_read_off_them() {
    for (share, reach) in [(0.0, 2.0), (0.5, 2.8), (0.5, 1.5), (0.9, 2.0)] {
        let mut rng = Rng::new(5);
        let all =
            (0..6).map(|_| pairs(&image(share, reach, &mut rng))).fold(Pairs::default(), |a, b| a.and(&b));
        let found = Correlation::of(&all);
        // In an endless plane: 1 + share * 2 pi reach^2; an image ends.
        let expected = 1.0 + share * std::f64::consts::TAU * reach * reach;
        let sharing = all.sharing(&found);
        assert!(
            (sharing / expected - 1.0).abs() < 0.2,
            "{share}, {reach}: {found:?}, {sharing} of {expected}"
        );
    }
    assert_eq!(Correlation::of(&Pairs::default()).at(1.0), 0.0);
    assert_eq!(Pairs::default().sharing(&Correlation { share: 1.0, reach: 2.0 }), 1.0);
}

#[test]
fn sums_over_pairs_are_those_of_each_with_each_other() {
    let mut rng = Rng::new(6);
    let offs: Vec<Off> = image(0.3, 1.5, &mut rng).into_iter().take(300).collect();
    let found = pairs(&offs);
    let mut expected = [0.0; LAGS];
    for a in &offs {
        for b in &offs {
            let lag = (a.ray - b.ray).norm();
            if lag > 0.0 && lag < LAGS as f64 {
                expected[lag as usize] += a.gap * b.gap;
            }
        }
    }
    for (product, expected) in found.products.iter().zip(expected) {
        assert!((product - expected).abs() < 1e-9);
    }
}
