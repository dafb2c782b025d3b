//! What a camera can see of a model, what it saw of the scene, and what follows for a pose.

use std::f64::consts::PI;

use ibi_core::kernels::nearby::Nearby;
use ibi_core::kernels::overlap::{Contact, Place, Surface, fit, overlap_of, own_fit, places, visible};
use ibi_core::kernels::rng::Rng;
use ibi_core::kernels::sight::{Eye, OwnShadow, RangeImage, Sight, View};
use ibi_core::nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use ibi_core::stages::hv::{Evidence, Hv};
use ibi_core::stages::{Context, Estimate, EstimatePose, Hypothesis, Ranked};
use ibi_core::{Cloud, Correspondences, Params, Refine, Registrar};
use ibi_testkit::strategies::rigid_motions;
use proptest::prelude::*;

/// Points of a rectangle in a plane of constant z, `step` apart.
fn sheet([x0, x1]: [f64; 2], [y0, y1]: [f64; 2], z: f64, step: f64) -> Vec<Point3<f64>> {
    let count = |low: f64, high: f64| ((high - low) / step).round() as usize;
    let (columns, rows) = (count(x0, x1), count(y0, y1));
    let at = |i: usize, j: usize| Point3::new(x0 + (i as f64 + 0.5) * step, y0 + (j as f64 + 0.5) * step, z);
    (0..columns).flat_map(|i| (0..rows).map(move |j| at(i, j))).collect()
}

/// Points of a ball about `centre`, and their normals.
fn ball(centre: Point3<f64>, radius: f64, count: usize) -> (Vec<Point3<f64>>, Vec<Vector3<f64>>) {
    let normal = |i: usize| {
        let z = 1.0 - (2 * i + 1) as f64 / count as f64;
        let (sin, cos) = (PI * (3.0 - 5.0_f64.sqrt()) * i as f64).sin_cos();
        Vector3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z)
    };
    let normals: Vec<_> = (0..count).map(normal).collect();
    (normals.iter().map(|n| centre + radius * n).collect(), normals)
}

// ------------------------------------------------------------------------------------------------ range image

proptest! {
    /// A wall at z = 4 and a plate before it, from the origin: what is where is known without an image.
    #[test]
    fn a_range_image_knows_what_is_before_and_what_behind(
        x in -0.8..0.8_f64, y in -0.8..0.8_f64, z in 1.0..8.0_f64, motion in rigid_motions(100.0), thinned in 1..3_usize,
    ) {
        let wall = sheet([-4.0, 4.0], [-4.0, 4.0], 4.0, 0.04);
        let plate = sheet([-0.5, 0.5], [-0.5, 0.5], 2.0, 0.02);
        let is_seen = |p: &Point3<f64>| p.x.abs().max(p.y.abs()) > 0.25 * p.z;
        let scan: Vec<_> = wall.into_iter().filter(is_seen).chain(plate).step_by(thinned).map(|p| motion * p).collect();
        let image = RangeImage::new(motion * Point3::origin(), &scan, 0.02).unwrap();
        let seen = image.sight(&(motion * Point3::new(x * z, y * z, z)), 0.1);
        // The plate covers tangents up to 0.25; edges are blurred by two pixels each way, and those may lie diagonally.
        let aside = x.abs().max(y.abs());
        let (blur, slant) = (0.1, (1.0 + x * x + y * y).sqrt());
        let surface = if aside < 0.25 - blur { 2.0 } else if aside > 0.25 + blur && aside < 1.0 - blur { 4.0 } else { return Ok(()) };
        let before = (surface - z) * slant;
        // The range differs across those pixels, the more so the more they are seen aslant.
        let across = surface * (x.abs() + y.abs()) / slant * blur;
        if (before.abs() - 0.1).abs() < across + 0.01 { return Ok(()) }
        let expected = if before > 0.1 { Sight::Through } else if before < -0.1 { Sight::Hidden } else { Sight::Open };
        prop_assert_eq!(seen, expected);
    }
}

#[test]
fn where_nothing_was_measured_nothing_is_known() {
    let scan = sheet([-0.5, 0.5], [-0.5, 0.5], 2.0, 0.02);
    let image = RangeImage::new(Point3::origin(), &scan, 0.02).unwrap();
    for [x, y, z] in [[2.0, 0.0, 2.0], [0.0, -3.0, 9.0], [0.0, 0.0, -2.0], [0.0, 0.0, 0.0], [1e9, 0.0, 1.0]] {
        assert_eq!(image.sight(&Point3::new(x, y, z), 0.1), Sight::Open);
    }
    // A hole proves nothing either: the sensor may have lost what is there.
    let with_hole: Vec<_> = scan.into_iter().filter(|p| p.coords.xy().norm() > 0.2).collect();
    let image = RangeImage::new(Point3::origin(), &with_hole, 0.02).unwrap();
    assert_eq!(image.sight(&Point3::new(0.0, 0.0, 1.0), 0.1), Sight::Open);
    assert_eq!(image.sight(&Point3::new(0.2, 0.0, 1.0), 0.1), Sight::Through);
    assert!(RangeImage::new(Point3::origin(), &[], 0.1).is_none());
    assert!(RangeImage::new(Point3::origin(), &[Point3::origin(); 3], 0.1).is_none());
    // One point, and points on a line of sight, are images, too.
    for z in [1, 5] {
        let points: Vec<_> = (1..=z).map(|z| Point3::new(0.0, 0.0, f64::from(z))).collect();
        let image = RangeImage::new(Point3::origin(), &points, 0.1).unwrap();
        assert_eq!(image.sight(&Point3::new(0.0, 0.0, 9.0), 0.1), Sight::Hidden);
    }
}

// ------------------------------------------------------------------------------------------------- own shadow

#[test]
fn a_ball_hides_nothing_of_itself() {
    let (points, normals) = ball(Point3::new(5.0, -3.0, 2.0), 1.0, 1500);
    let shadow = OwnShadow::new(&points, &normals, 0.08);
    for eye in [[90.0, 0.0, 0.0], [0.0, 70.0, -50.0], [-30.0, -40.0, 60.0]] {
        let hidden = shadow.from(&Point3::from(eye), &Isometry3::identity());
        // Within one known direction of the outline a few lie behind their neighbours.
        let num_hidden = hidden.iter().filter(|&&hidden| hidden).count();
        assert!(num_hidden < points.len() / 50, "{num_hidden}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(20))]
    /// A plate above a floor throws its shadow along the line of sight, wherever the pose puts both.
    #[test]
    fn a_plate_hides_the_floor_behind_it(pose in rigid_motions(50.0), x in -0.5..0.5_f64, y in -0.5..0.5_f64) {
        let step = 0.05;
        let floor = sheet([-1.6, 1.6], [-1.6, 1.6], 0.0, step);
        let plate = sheet([-0.5, 0.5], [-0.5, 0.5], 1.0, step);
        let num_floor = floor.len();
        let points: Vec<_> = floor.into_iter().chain(plate).collect();
        let normals = vec![Vector3::z(); points.len()];
        let shadow = OwnShadow::new(&points, &normals, step);
        let eye = pose * Point3::new(1000.0 * x, 1000.0 * y, 1000.0);
        let hidden = shadow.from(&eye, &pose);
        prop_assert!(!hidden[num_floor..].contains(&true), "the plate is above all");
        for (point, &is_hidden) in points[..num_floor].iter().zip(hidden) {
            // Where the line of sight meets the height of the plate.
            let aside = (point.x + x).abs().max((point.y + y).abs());
            // Directions are known to 10 degrees: that far the shadow may be off.
            if aside < 0.5 - 0.25 { prop_assert!(is_hidden, "{point}"); }
            if aside > 0.5 + 0.3 { prop_assert!(!is_hidden, "{point}"); }
        }
        // Some of the points keep their shadows.
        let rows: Vec<u32> = (0..points.len() as u32).step_by(7).collect();
        let some = shadow.on(&rows);
        let picked: Vec<bool> = rows.iter().map(|&row| hidden[row as usize]).collect();
        prop_assert_eq!(some.from(&eye, &pose), &picked[..]);
    }
}

// ------------------------------------------------------------------------------------------------- what counts

/// A camera at the origin looks down z at a wall, z = 4; the source is a sheet that faces it.
struct Scene {
    source: Vec<Point3<f64>>,
    source_normals: Vec<Vector3<f64>>,
    wall: Vec<Point3<f64>>,
    wall_normals: Vec<Vector3<f64>>,
    eyes: [Eye; 1],
}

impl Scene {
    fn new() -> Self {
        let source = sheet([-0.5, 0.5], [-0.5, 0.5], 0.0, 0.1);
        let wall = sheet([-4.0, 4.0], [-4.0, 4.0], 4.0, 0.04);
        let measured = RangeImage::new(Point3::origin(), &wall, 0.02);
        Self {
            source_normals: vec![-Vector3::z(); source.len()],
            wall_normals: vec![-Vector3::z(); wall.len()],
            source,
            wall,
            eyes: [Eye { place: Point3::origin(), measured }],
        }
    }

    fn source(&self) -> Surface<'_> {
        Surface { points: &self.source, normals: Some(&self.source_normals) }
    }

    fn wall(&self) -> Surface<'_> {
        Surface { points: &self.wall, normals: Some(&self.wall_normals) }
    }

    fn contact(&self) -> Contact<'_> {
        let view = Some(View { eyes: &self.eyes, own: None });
        Contact { distance: 0.1, min_normal_cos: 0.5, oriented: true, view, to_planes: true }
    }
}

#[test]
fn what_one_of_several_cameras_sees_is_seen() {
    let scene = Scene::new();
    let near = Nearby::new(&scene.wall, 0.1);
    let behind = || Eye::at(Point3::new(0.0, 0.0, 9.0));
    let blocked = || {
        let sheet = sheet([-4.0, 4.0], [-4.0, 4.0], 1.0, 0.04);
        let place = Point3::new(0.3, 0.0, 0.0);
        Eye { place, measured: RangeImage::new(place, &sheet, 0.02) }
    };
    let front =
        || Eye { place: Point3::origin(), measured: RangeImage::new(Point3::origin(), &scene.wall, 0.02) };
    let num_of = |eyes: &[Eye], z: f64, wanted: fn(&Place) -> bool| {
        let contact = Contact { view: Some(View { eyes, own: None }), ..scene.contact() };
        let pose = Isometry3::translation(0.0, 0.0, z);
        places(&scene.source(), &scene.wall(), &near, &pose, &contact).iter().filter(|p| wanted(p)).count()
    };
    let all = scene.source.len();
    let is_hidden: fn(&Place) -> bool = |place| *place == Place::Hidden;
    // On the wall: from behind it faces away, and something is in the way of the other.
    assert_eq!(num_of(&[behind()], 4.0, is_hidden), all);
    assert_eq!(num_of(&[blocked()], 4.0, is_hidden), all);
    assert_eq!(num_of(&[behind(), blocked()], 4.0, is_hidden), all);
    for eyes in [[front(), blocked()], [blocked(), front()], [behind(), front()]] {
        assert_eq!(num_of(&eyes, 4.0, |place| matches!(place, Place::On(_))), all);
        // In the open one looks through it, and nobody sees it.
        assert_eq!(num_of(&eyes, 2.0, |place| *place == Place::Through), all);
    }
    // Of many the nearest is asked.
    let far = |x: f64| Eye::at(Point3::new(x, 0.0, -50.0));
    let many = [far(0.0), far(1.0), behind(), far(2.0), far(3.0)];
    assert_eq!(num_of(&many, 4.0, is_hidden), all);
    assert_eq!(num_of(&many[..4], 4.0, is_hidden), 0);
}

#[test]
fn a_pose_in_free_space_is_contradicted_and_one_behind_the_wall_is_hidden() {
    let scene = Scene::new();
    let near = Nearby::new(&scene.wall, 0.1);
    let at = |z: f64| {
        let pose = Isometry3::translation(0.0, 0.0, z);
        places(&scene.source(), &scene.wall(), &near, &pose, &scene.contact())
    };
    assert!(at(4.0).iter().all(|place| matches!(place, Place::On(_))));
    assert!(at(3.0).iter().all(|&place| place == Place::Through));
    assert!(at(5.0).iter().all(|&place| place == Place::Hidden));
    // What is contradicted counts, what is hidden does not.
    assert_eq!((overlap_of(&at(4.0)), overlap_of(&at(3.0)), overlap_of(&at(5.0))), (1.0, 0.0, 0.0));
    let rows = |z: f64, limit| {
        let (view, pose) = (scene.contact().view.unwrap(), Isometry3::translation(0.0, 0.0, z));
        visible(&scene.source(), &view, &pose, 0.1, limit)
    };
    assert_eq!((rows(4.0, 1000).len(), rows(3.0, 1000).len(), rows(5.0, 1000).len()), (100, 100, 0));
    assert_eq!(rows(4.0, 30).len(), 25);
}

#[test]
fn across_the_surface_a_fit_does_not_see_how_the_scan_is_sampled() {
    let scene = Scene::new();
    let near = Nearby::new(&scene.wall, 0.1);
    let at = |x: f64, z: f64| {
        let pose = Isometry3::translation(x, 0.0, z);
        fit(&scene.source(), &scene.wall(), &near, &pose, &scene.contact(), |rows| vec![false; rows.len()])
    };
    for x in [0.0, 0.007, 0.02] {
        assert!((at(x, 4.0).mean - 1.0).abs() < 1e-12);
    }
    // Half of the reach across is the end.
    assert!((at(0.0, 4.02).mean - 0.6).abs() < 1e-9 && at(0.0, 4.06).mean == 0.0);
    assert!((at(0.0, 4.0).share - 1.0).abs() < 1e-12);
    // Of a source of which half faces away, half is explained.
    let half: Vec<_> = (0..100).map(|i| if i % 2 == 0 { Vector3::z() } else { -Vector3::z() }).collect();
    let source = Surface { points: &scene.source, normals: Some(&half) };
    let found = fit(
        &source,
        &scene.wall(),
        &near,
        &Isometry3::translation(0.0, 0.0, 4.0),
        &scene.contact(),
        |rows| vec![false; rows.len()],
    );
    assert!((found.mean - 1.0).abs() < 1e-12 && (found.share - 0.5).abs() < 1e-12);
}

#[test]
fn a_noisy_scan_fits_itself_less() {
    let scene = Scene::new();
    let mut rng = ibi_testkit::Rng::new(3);
    let fit_with = |noise: f64, rng: &mut ibi_testkit::Rng| {
        let points: Vec<_> = scene.wall.iter().map(|p| p + Vector3::z() * (noise * rng.normal())).collect();
        let (near, surface) =
            (Nearby::new(&points, 0.1), Surface { points: &points, normals: Some(&scene.wall_normals) });
        own_fit(&surface, &near, &scene.contact(), Rng::new(0, 0, 0), 1000)
    };
    assert_eq!(fit_with(0.0, &mut rng), 1.0);
    // The mean of |a - b| for two normal deviates of sigma 0.01 is 2 * 0.01 / sqrt(pi), against half of the reach; of
    // several neighbours the nearest is one with less.
    let of_any = 1.0 - 0.02 / PI.sqrt() / 0.05;
    let found = fit_with(0.01, &mut rng);
    assert!(of_any < found && found < 0.95, "{found}");
    let nothing = Surface { points: &scene.wall[..1], normals: Some(&scene.wall_normals[..1]) };
    let near = Nearby::new(nothing.points, 0.1);
    assert_eq!(own_fit(&nothing, &near, &scene.contact(), Rng::new(0, 0, 0), 10), 1.0);
}

// ------------------------------------------------------------------------------------------------------- turns

/// A wedge: a box whose top slopes, so that it has no symmetry; its outer points and normals.
fn wedge() -> (Vec<Point3<f64>>, Vec<Vector3<f64>>) {
    let step = 0.1;
    let (mut points, mut normals) = (Vec::new(), Vec::new());
    let mut add = |p: Point3<f64>, n: Vector3<f64>| {
        points.push(p);
        normals.push(n.normalize());
    };
    let height = |x: f64| 0.6 + 0.3 * x;
    for p in sheet([-1.0, 1.0], [-0.7, 0.7], 0.0, step) {
        add(Point3::new(p.x, p.y, -0.5), -Vector3::z());
        add(Point3::new(p.x, p.y, height(p.x)), Vector3::new(-0.3, 0.0, 1.0));
    }
    for side in [-1.0, 1.0] {
        for p in sheet([-1.0, 1.0], [-0.5, 0.9], 0.0, step).into_iter().filter(|p| p.y < height(p.x)) {
            add(Point3::new(p.x, 0.7 * side, p.y), side * Vector3::y());
        }
        for p in sheet([-0.7, 0.7], [-0.5, 0.9], 0.0, step).into_iter().filter(|p| p.y < height(side)) {
            add(Point3::new(side, p.x, p.y), side * Vector3::x());
        }
    }
    (points, normals)
}

/// Always the same hypothesis.
struct Always(Isometry3<f64>);

impl EstimatePose for Always {
    fn estimate_pose(&self, _context: &Context<'_>, _dense: &Ranked) -> Estimate {
        let hypothesis = Hypothesis { target_from_source: self.0, score: 50.0 };
        Estimate { hypothesis: Some(hypothesis), ..Estimate::default() }
    }
}

#[test]
fn a_part_found_the_wrong_way_round_is_turned() {
    let (points, normals) = wedge();
    let truth = Isometry3::new(Vector3::new(0.3, -0.2, 9.0), Vector3::new(2.1, 0.5, -0.4));
    let eye = Point3::origin();
    let scan: Vec<usize> = (0..points.len())
        .filter(|&i| {
            (truth * normals[i]).dot(&(eye - truth * points[i])) > 0.2 * (truth * points[i]).coords.norm()
        })
        .collect();
    let target: Vec<_> = scan.iter().map(|&i| truth * points[i]).collect();
    let target_normals: Vec<_> = scan.iter().map(|&i| truth * normals[i]).collect();
    let pairs: Vec<_> = scan.iter().enumerate().map(|(row, &i)| [i, row]).collect();
    let wrong = truth * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), PI);
    let found = |refine| {
        let hv: Hv = Evidence { t_score: 0.0, ..Evidence::default() }.into();
        let params = Params { refine, hv, max_instances: Some(1), n_contest: 1, ..Params::single_view() };
        let source = Cloud::new(&points).with_normals(normals.clone());
        let target = Cloud::new(&target).with_normals(target_normals.clone()).with_viewpoint(eye);
        let registrar = Registrar::new(&source).unwrap().params(params).with_te(Always(wrong));
        let correspondences = Correspondences::from_rows(pairs.clone());
        registrar.register(&target, &correspondences).unwrap().poses[0].target_from_source
    };
    let off = |pose: Isometry3<f64>| pose.rotation.angle_to(&truth.rotation).to_degrees();
    assert!(off(found(Refine::Icp)) > 90.0);
    assert!(off(found(Refine::IcpTurns)) < 2.0, "{}", off(found(Refine::IcpTurns)));
}
