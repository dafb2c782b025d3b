//! Symmetries: as they are declared, and as they are found on shapes that have known ones.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use ibi_core::features::{Amount, Mesh, Sampled, sample_mesh};
use ibi_core::metrics::{Criterion, Matching, Model, PoseThresholds, rotation_error_rad, score_scene_modulo};
use ibi_core::nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use ibi_core::{
    Axis, Cloud, FindSymmetries, Interrupt, Registrar, Symmetries, SymmetryError, Turning, find_symmetries,
};
use ibi_testkit::naive::farthest_off;
use ibi_testkit::shapes::{self, Solid};
use ibi_testkit::strategies::rigid_motions;
use proptest::prelude::*;

const Z: Axis = Axis { direction: Vector3::new(0.0, 0.0, 1.0), point: Point3::new(0.0, 0.0, 0.0) };

/// Points about 1/25 of the diameter apart.
fn cloud(solid: &Solid, seed: u64) -> Sampled {
    let mesh = &Mesh { vertices: &solid.vertices, faces: &solid.faces };
    sample_mesh(mesh, Amount::Count(600), seed, &Interrupt::never()).unwrap()
}

fn found(cloud: &Sampled) -> Symmetries {
    find_symmetries(&cloud.points, Some(&cloud.normals), FindSymmetries::default(), &Interrupt::never())
        .unwrap()
}

/// Each shape with the number of its motions, and of its axes.
fn known() -> Vec<(&'static str, Solid, usize, usize)> {
    vec![
        ("tee", shapes::tee(), 2, 0),
        ("torus", shapes::torus(), 2, 1),
        ("can", shapes::prism(48, 0.5, 1.5), 2, 1),
        ("bottle", shapes::lathe(&[(0.0, 0.0), (0.5, 0.0), (0.5, 1.2), (0.2, 1.6), (0.0, 1.6)], 48), 1, 1),
        ("ball", shapes::ball(), 1, 3),
        ("box", shapes::cuboid([3.0, 2.0, 1.0]), 4, 0),
        ("square prism", shapes::cuboid([1.0, 1.0, 2.0]), 8, 0),
        ("cube", shapes::cuboid([1.0, 1.0, 1.0]), 24, 0),
        ("tetrahedron", shapes::tetrahedron(), 12, 0),
        ("triangle", shapes::prism(3, 1.0, 1.0), 6, 0),
        ("pentagon", shapes::prism(5, 1.0, 1.0), 10, 0),
        ("hexagon", shapes::prism(6, 1.0, 1.0), 12, 0),
        ("lopsided", shapes::lopsided(), 1, 0),
    ]
}

#[test]
fn finds_the_group_of_each_shape() {
    for (name, solid, motions, axes) in known() {
        for (seed, with_normals) in [(1, true), (2, false)] {
            if !with_normals && solid.faces.len() > 100 {
                continue; // it takes a second each
            }
            let cloud = cloud(&solid, seed);
            let normals = with_normals.then_some(&cloud.normals[..]);
            let found =
                find_symmetries(&cloud.points, normals, FindSymmetries::default(), &Interrupt::never())
                    .unwrap();
            let counts = (found.discrete().len(), found.continuous().len());
            assert_eq!(counts, (motions, axes), "{name}, with normals: {with_normals}");
            // Each of them maps the shape onto itself, as far as the points tell: nothing is farther off than their gaps.
            let size = Model::new(cloud.points.clone()).unwrap().diameter(&Interrupt::never()).unwrap();
            for motion in found.discretised(0.5).unwrap() {
                let off = farthest_off(&cloud.points, &motion) / size;
                assert!(off < 0.09, "{name}: off by {off}");
            }
        }
    }
}

#[test]
fn what_is_found_moves_with_the_model() {
    for (name, solid, ..) in known() {
        if !["tee", "can", "cube", "lopsided"].contains(&name) {
            continue; // it takes a second each
        }
        let cloud = cloud(&solid, 3);
        let motion = Isometry3::new(Vector3::new(5.0, -3.0, 8.0), Vector3::new(0.4, -1.1, 0.7));
        let moved = Sampled {
            points: cloud.points.iter().map(|p| motion * p).collect(),
            normals: cloud.normals.iter().map(|n| motion * n).collect(),
        };
        let (here, there) = (found(&cloud), found(&moved));
        assert_eq!(here.discrete().len(), there.discrete().len(), "{name}");
        for (a, b) in
            here.continuous().iter().zip(there.continuous()).filter(|_| here.continuous().len() == 1)
        {
            assert!((motion * a.direction).cross(&b.direction).norm() < 0.03, "{name}");
        }
        if here.turning() == &Turning::None {
            for a in here.discrete() {
                let conjugated = motion * a * motion.inverse();
                let is_near = |b: &&Isometry3<f64>| conjugated.rotation.angle_to(&b.rotation) < 0.05;
                assert!(there.discrete().iter().any(|b| is_near(&b)), "{name}");
            }
        }
    }
}

#[test]
fn what_is_found_is_a_group_to_rounding() {
    let group = found(&cloud(&shapes::cuboid([1.0, 1.0, 1.0]), 4));
    for a in group.discrete() {
        for b in group.discrete() {
            let product = a * b;
            let is_same = |c: &&Isometry3<f64>| (product.to_homogeneous() - c.to_homogeneous()).amax() < 1e-8;
            assert!(group.discrete().iter().any(|c| is_same(&c)));
        }
    }
}

#[test]
fn a_search_needs_points_and_a_tolerance() {
    let few = vec![Point3::origin(); 20];
    let error = find_symmetries(&few, None, FindSymmetries::default(), &Interrupt::never()).unwrap_err();
    assert_eq!(error.to_string(), "points has 1 rows that differ; at least 10 are needed");
    let error =
        find_symmetries(&few, None, FindSymmetries { tolerance: 0.5 }, &Interrupt::never()).unwrap_err();
    assert_eq!(error.to_string(), "tolerance is 0.5; it must be from 0.001 to 0.05 diameters");
    let mut bad = cloud(&shapes::tee(), 1).points;
    bad[7].y = f64::NAN;
    assert!(
        find_symmetries(&bad, None, FindSymmetries::default(), &Interrupt::never())
            .unwrap_err()
            .to_string()
            .contains("points[7]")
    );
    // Shapes of no volume, and of no area: an answer, and no panic.
    for flat in [Vector3::new(1.0, 1.0, 0.0), Vector3::new(1.0, 0.0, 0.0)] {
        let points: Vec<_> =
            cloud(&shapes::tee(), 1).points.iter().map(|p| p.coords.component_mul(&flat).into()).collect();
        assert!(find_symmetries(&points, None, FindSymmetries::default(), &Interrupt::never()).is_ok());
    }
}

#[test]
fn axes_that_meet_are_a_ball_and_others_are_refused() {
    let x = Axis { direction: Vector3::x() * 3.0, point: Point3::new(7.0, 2.0, 1.0) };
    let above = Axis { point: Point3::new(0.0, 2.0, 9.0), ..Z };
    let Turning::Any(centre) = *Symmetries::new(&[], &[x, above]).unwrap().turning() else { panic!() };
    assert!((centre - Point3::new(0.0, 2.0, 1.0)).norm() < 1e-12);
    assert_eq!(Symmetries::new(&[], &[x, Z]), Err(SymmetryError::Apart { row: 1 }));
    assert_eq!(Symmetries::new(&[], &[Z, Z]).unwrap().continuous(), [Z]);
    let beside = Axis { point: Point3::new(1.0, 0.0, 0.0), ..Z };
    assert_eq!(Symmetries::new(&[], &[Z, beside]), Err(SymmetryError::Apart { row: 1 }));
    let nowhere = Axis { direction: Vector3::zeros(), ..Z };
    assert_eq!(Symmetries::new(&[], &[nowhere]), Err(SymmetryError::NoDirection { row: 0 }));
    assert!(Symmetries::new(&[Isometry3::translation(f64::NAN, 0.0, 0.0)], &[]).is_err());
    assert!(Symmetries::new(&[Isometry3::identity()], &[]).unwrap().is_none());
}

#[test]
fn turns_are_listed_as_bop_lists_them() {
    let over = Isometry3::rotation(Vector3::x() * PI);
    let can = Symmetries::new(&[over], &[Z]).unwrap();
    // pi / 0.01 and no fewer: the step is 2 pi / 315, and half a diameter away that is 0.00997 diameters.
    let all = can.discretised(0.01).unwrap();
    assert_eq!(all.len(), 2 * 315);
    assert_eq!(all[0], Isometry3::identity());
    assert!((rotation_error_rad(&all[2], &all[0]) - TAU / 315.0).abs() < 1e-12);
    assert!(can.discretised(0.0).is_err() && can.discretised(f64::NAN).is_err());
}

/// Declared symmetries of each kind, about a middle that is not the origin.
fn declared() -> Vec<Symmetries> {
    let middle = Isometry3::new(Vector3::new(0.3, -0.2, 0.9), Vector3::new(1.0, 0.3, -0.4));
    let moved = |motion: Isometry3<f64>| middle * motion * middle.inverse();
    let axis = Axis { direction: middle * Vector3::z(), point: middle * Point3::origin() };
    let across = Axis { direction: middle * Vector3::x(), ..axis };
    let over = moved(Isometry3::rotation(Vector3::x() * PI));
    let quarters: Vec<_> =
        (1..4).map(|k| moved(Isometry3::rotation(Vector3::z() * (FRAC_PI_2 * f64::from(k))))).collect();
    [(&[][..], &[][..]), (&quarters, &[]), (&[], &[axis]), (&[over], &[axis]), (&[], &[axis, across])]
        .map(|(motions, axes)| Symmetries::new(motions, axes).unwrap())
        .to_vec()
}

proptest! {
    #[test]
    fn the_nearest_is_one_of_them_and_none_is_nearer(a in rigid_motions(3.0), b in rigid_motions(3.0)) {
        for symmetries in declared() {
            let nearest = symmetries.nearest(&a, &b);
            let error = rotation_error_rad(&nearest, &b);
            let all = symmetries.discretised(0.02).unwrap();
            let apart = |c: &Isometry3<f64>| (c.inverse() * nearest).to_homogeneous() - Isometry3::identity().to_homogeneous();
            // The naive twin: all that are listed, 0.04 rad apart.
            for motion in &all {
                prop_assert!(error <= rotation_error_rad(&(a * motion), &b) + 1e-9);
            }
            if let Turning::Any(centre) = symmetries.turning() {
                prop_assert!(error < 1e-9 && (a * centre - nearest * centre).norm() < 1e-9);
            } else {
                prop_assert!(all.iter().any(|motion| apart(&(a * motion)).amax() < 0.1));
            }
            // A pose that looks the same is as near.
            let again = symmetries.nearest(&(a * all[all.len() / 2]), &b);
            prop_assert!((rotation_error_rad(&again, &b) - error).abs() < 1e-6);
        }
    }

    #[test]
    fn errors_do_not_see_what_looks_the_same(truth in rigid_motions(3.0), pick in 0.0..1.0_f64) {
        let points = cloud(&shapes::tee(), 1).points;
        let model = Model::new(points[..50].to_vec()).unwrap();
        for symmetries in declared() {
            let all = symmetries.discretised(0.02).unwrap();
            let seen = truth * all[(pick * all.len() as f64) as usize];
            prop_assert!(model.mssd(&seen, &truth, &symmetries, &Interrupt::never()).unwrap() < 1e-6);
            let strict = Criterion::Pose(PoseThresholds::strict(1e-3));
            let score = score_scene_modulo(&[seen], &[truth], Matching::OneToOne, &strict, &symmetries, &Interrupt::never()).unwrap();
            prop_assert_eq!(score.num_truth_hit, 1);
        }
    }
}

#[test]
fn of_two_poses_that_look_the_same_the_better_stays() {
    use ibi_core::{Correspondences, Params, Removal, stages::ce, stages::hv};
    // A square of points about z with a spike, matched with itself and with itself turned.
    let turned = UnitQuaternion::from_scaled_axis(Vector3::z() * PI);
    let source: Vec<Point3<f64>> = (0..40)
        .map(f64::from)
        .map(|k| Point3::new(1.0 + (k * 0.7).sin(), (k * 1.3).cos(), (k * 2.9).sin()))
        .flat_map(|p| [p, turned * p])
        .collect();
    let target: Vec<Point3<f64>> = source.iter().map(|p| p + Vector3::new(9.0, 1.0, 2.0)).collect();
    let rows = (0..80).flat_map(|row| [[row, row], [row ^ 1, row]]).collect();
    let pairs = Correspondences::from_rows(rows);
    // As the paper removes duplicates: not at all.
    let params = Params {
        ce: ce::Voting { n_vot: 60 }.into(),
        hv: hv::None::default().into(),
        removal: Removal::Dense,
        ..Params::paper_synthetic()
    };
    let count = |symmetries: Symmetries| {
        let source = Cloud::new(&source).with_symmetries(symmetries);
        let registrar = Registrar::new(&source).unwrap().params(params.clone());
        registrar.register(&Cloud::new(&target), &pairs).unwrap().poses
    };
    let (with, without) = (
        count(Symmetries::new(&[Isometry3::rotation(Vector3::z() * PI)], &[]).unwrap()),
        count(Symmetries::none()),
    );
    assert!(without.len() > 1 && with.len() == 1, "{} without, {} with", without.len(), with.len());
    assert_eq!(with[0].target_from_source, without[0].target_from_source);
}
