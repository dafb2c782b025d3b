//! `Model`: from a mesh and a scan to poses, what is told and refused on the way, and how it ends.

use std::sync::Arc;
use std::time::Instant;

use ibi_core::detection::{
    Detect, Detection, DetectionError, Doubt, FromMesh, Measured, MeshSymmetries, Model, Models, Origin, Roi,
    Run,
};
use ibi_core::nalgebra::{Isometry3, Point3, Vector3};
use ibi_core::{CancelToken, Cloud, Error, Interrupt, Objection, Params, Phase, Round, StopReason};
use ibi_testkit::Rng;
use ibi_testkit::shapes::{self, Solid};

fn model(solid: &Solid) -> Model {
    Model::from_mesh(&solid.vertices, &solid.faces, &FromMesh::default()).unwrap()
}

/// Copies of a model, each turned at random, side by side.
fn placed(count: usize, apart: f64, seed: u64) -> Vec<Isometry3<f64>> {
    let mut rng = Rng::new(seed);
    (0..count).map(|i| rng.pose_at(Vector3::new(apart * i as f64, 0.0, 0.0))).collect()
}

type Rows = (Vec<Point3<f64>>, Vec<Vector3<f64>>);

fn scene(model: &Model, poses: &[Isometry3<f64>]) -> Rows {
    let rows = || model.points().iter().zip(model.normals().unwrap());
    poses.iter().flat_map(|pose| rows().map(move |(p, n)| (pose * p, pose * n))).unzip()
}

/// What of it faces a camera; the parts do not hide each other.
fn seen((points, normals): Rows, eye: &Point3<f64>) -> Rows {
    let faces = |(p, n): &(Point3<f64>, Vector3<f64>)| (eye - p).normalize().dot(n) > 0.2;
    points.into_iter().zip(normals).filter(faces).unzip()
}

/// How many of the poses are found, each by one.
fn num_right(found: &Detection, model: &Model, truth: &[Isometry3<f64>]) -> usize {
    let off = |a: &Isometry3<f64>, b: &Isometry3<f64>| {
        model.points().iter().map(|p| (a * p - b * p).norm()).fold(0.0, f64::max)
    };
    let is_found = |truth: &&Isometry3<f64>| {
        let hits = found
            .registration
            .poses
            .iter()
            .filter(|pose| off(&pose.target_from_source, truth) < model.voxel());
        hits.count() == 1
    };
    truth.iter().filter(is_found).count()
}

#[test]
fn every_instance_is_found_in_a_scene_seen_from_all_sides() {
    let part = model(&shapes::lopsided());
    let truth = placed(3, 5.0, 1);
    let (points, normals) = scene(&part, &truth);
    let found = part.detect(&Cloud::new(&points).with_normals(normals), &Detect::default()).unwrap();
    assert_eq!(found.registration.poses.len(), 3);
    assert_eq!(num_right(&found, &part, &truth), 3);
    assert_eq!(found.doubts().count(), 0);
    assert_eq!(found.params, Params::many_views());
    assert!(
        found.registration.poses.iter().all(|pose| pose.measures.is_some()),
        "looked at from places that see it"
    );
}

#[test]
fn every_instance_is_found_in_the_scan_of_one_camera() {
    let part = model(&shapes::lopsided());
    let (truth, eye) = (placed(3, 5.0, 2), Point3::new(4.0, 2.0, 40.0));
    let (points, _) = seen(scene(&part, &truth), &eye);
    for num_threads in [1, 2] {
        let run = Run { num_threads: Some(num_threads), ..Run::default() };
        let options = Detect { run, ..Detect::default() };
        let found = part.detect(&Cloud::new(&points).with_viewpoint(eye), &options).unwrap();
        assert_eq!(num_right(&found, &part, &truth), 3);
        assert_eq!(found.registration.poses.len(), 3);
        assert_eq!(found.params, Params::single_view());
        let scan = found.scan.unwrap();
        assert_eq!(found.registration.labels.len(), scan.matches.rows.len());
        assert_eq!(scan.matches.rows.len(), 4 * scan.points.len());
    }
}

#[test]
fn a_model_has_the_points_of_its_outer_surface() {
    // A box, and a smaller one within.
    let solid = shapes::cuboid([3.0, 2.0, 1.0]);
    let hollow = solid.clone().with(&shapes::cuboid([1.0, 0.7, 0.5]), Vector3::zeros());
    let part = model(&hollow);
    assert!(part.points().len() >= 700);
    assert!(
        part.points().iter().all(|p| p.coords.abs().component_div(&Vector3::new(1.5, 1.0, 0.5)).max() > 0.8)
    );
    let diagonal = Vector3::new(3.0_f64, 2.0, 1.0).norm();
    assert!((0.999 * diagonal / 48.0..=1.001 * diagonal / 24.0).contains(&part.voxel()));
    assert_eq!(part.origin(), Origin::Mesh { voxel: part.voxel(), is_given: false });
    // Faces that are wound the other way are turned.
    let turned: Vec<_> = solid.faces.iter().map(|&[a, b, c]| [a, c, b]).collect();
    let turned = Model::from_mesh(&solid.vertices, &turned, &FromMesh::default()).unwrap();
    let outwards =
        turned.points().iter().zip(turned.normals().unwrap()).filter(|(p, n)| p.coords.dot(n) > 0.0);
    assert!(outwards.count() as f64 > 0.98 * turned.points().len() as f64);
}

#[test]
fn symmetries_are_found_where_they_are_asked_for() {
    let solid = shapes::cuboid([3.0, 2.0, 1.0]);
    let options = FromMesh { symmetries: MeshSymmetries::Find, ..FromMesh::default() };
    let part = Model::from_mesh(&solid.vertices, &solid.faces, &options).unwrap();
    assert_eq!(part.symmetries().discrete().len(), 4);
    assert_eq!(model(&solid).symmetries().discrete().len(), 1);
}

#[test]
fn what_cannot_be_a_model_is_refused() {
    let Solid { vertices, faces } = shapes::cuboid([1.0; 3]);
    for voxel in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let options = FromMesh { voxel: Some(voxel), ..FromMesh::default() };
        let error = Model::from_mesh(&vertices, &faces, &options).unwrap_err();
        assert!(
            error.to_string().starts_with("voxel is ") && error.to_string().ends_with("above 0 and finite")
        );
    }
    let refused = |faces: &[[usize; 3]]| {
        Model::from_mesh(&vertices, faces, &FromMesh::default()).unwrap_err().to_string()
    };
    assert!(refused(&[[0, 1, 99]]).starts_with("faces[0, 2] is 99"));
    assert_eq!(refused(&[[0, 0, 0]]), "the faces of the mesh have no area");
    assert_eq!(refused(&[]), "the faces of the mesh have no area");
}

#[test]
fn what_cannot_be_a_scan_is_refused_and_what_holds_nothing_is_empty() {
    let part = model(&shapes::lopsided());
    let eye = Point3::new(0.0, 0.0, 40.0);
    let (points, normals) = scene(&part, &placed(1, 0.0, 1));
    let detect = |scan: Cloud<'_>| part.detect(&scan, &Detect::default());
    assert_eq!(detect(Cloud::new(&points)).unwrap_err(), DetectionError::NoSide);
    let bare = Model::from_cloud(&Cloud::from(part.points().to_vec())).unwrap();
    assert_eq!(bare.detect(&Cloud::new(&points), &Detect::default()).unwrap_err(), DetectionError::NoNormals);
    let few = detect(Cloud::new(&points).with_normals(vec![Vector3::z(); 7])).unwrap_err();
    assert!(matches!(few, DetectionError::Input(Error::LengthMismatch { len: 7, .. })));
    let zeros = detect(Cloud::new(&points).with_normals(vec![Vector3::zeros(); points.len()])).unwrap_err();
    assert_eq!(zeros, DetectionError::MostNormalsMissing { num_missing: points.len(), len: points.len() });
    let bad = Detect { params: Some(Params { t_s: 0, ..Params::default() }), ..Detect::default() };
    let error = part.detect(&Cloud::new(&points).with_normals(normals), &bad).unwrap_err();
    assert!(matches!(error, DetectionError::Input(Error::Param { name: "t_s", .. })));

    let large: Vec<_> = points.iter().map(|p| p * 1e4).collect();
    let error = detect(Cloud::new(&large).with_viewpoint(eye)).unwrap_err();
    assert!(matches!(error, DetectionError::DifferentUnits { .. }), "{error}");
    let unchecked = Detect { check_units: false, ..Detect::default() };
    assert!(
        part.detect(&Cloud::new(&large).with_viewpoint(eye), &unchecked)
            .unwrap()
            .registration
            .poses
            .is_empty()
    );

    for (points, doubts) in [
        (vec![], vec![Doubt::FewPoints { num_points: 0 }]),
        (
            vec![Point3::new(f64::NAN, 0.0, 0.0); 5],
            vec![Doubt::NotFinite { num_dropped: 5, num_given: 5 }, Doubt::FewPoints { num_points: 0 }],
        ),
        (vec![Point3::new(1.0, 2.0, 3.0); 9], vec![Doubt::Nothing]),
    ] {
        let found = detect(Cloud::new(&points).with_viewpoint(eye)).unwrap();
        assert_eq!(found.doubts().cloned().collect::<Vec<_>>(), doubts);
        let few = StopReason::FewCorrespondences { value: 0, threshold: 3 };
        assert_eq!(found.registration.stop_reason, few);
        assert_eq!(found.registration.resolution, part.source().spacing);
    }
}

#[test]
fn a_point_without_a_normal_takes_that_of_the_nearest() {
    let points: Vec<_> = [0.0, 1.0, 3.0, f64::NAN, 4.5].map(|x| Point3::new(x, 0.0, 0.0)).to_vec();
    let normals = [Vector3::x(), Vector3::zeros(), Vector3::y(), Vector3::z(), Vector3::repeat(f64::NAN)];
    let measured = Measured::of(&points, Some(&normals)).unwrap();
    assert_eq!((measured.points.len(), measured.num_dropped, measured.num_without_normal), (4, 1, 2));
    let expected = [Vector3::x(), Vector3::x(), Vector3::y(), Vector3::y()];
    assert_eq!(measured.normals.unwrap(), expected);
}

/// A part upon a table, from above.
fn on_a_table(part: &Model) -> (Vec<Point3<f64>>, Point3<f64>) {
    let eye = Point3::new(2.0, 1.0, 40.0);
    let (mut points, _) = seen(scene(part, &placed(2, 5.0, 3)), &eye);
    for i in -60..120 {
        points.extend((-60..60).map(|j| Point3::new(0.1 * f64::from(i), 0.1 * f64::from(j), -2.5)));
    }
    (points, eye)
}

#[test]
fn a_face_is_taken_away_where_it_is_larger_than_all_of_the_parts() {
    let part = model(&shapes::cuboid([3.0, 2.0, 1.0]));
    let eye = Point3::new(0.0, -30.0, 10.0);
    let parts = seen(scene(&part, &placed(2, 5.0, 3)), &eye).0;
    let kept = |[wide, high]: [f64; 2], remove_plane| {
        // Upright behind the parts, which are the most of the scan; what is behind it makes it no table.
        let steps = |length: f64| (0..=(length / 0.1) as i32).map(|i| 0.1 * f64::from(i));
        let wall = steps(wide).flat_map(|x| steps(high).map(move |z| Point3::new(x, 4.0, z)));
        let behind = parts.iter().map(|p| p + Vector3::new(0.0, 12.0, 0.0));
        let points: Vec<_> = parts.iter().copied().chain(wall).chain(behind).collect();
        let scan = Cloud::new(&points).with_viewpoint(eye);
        let options = Detect { remove_plane, ..Detect::default() };
        let matched = part.correspond(&scan, &options, &Interrupt::never()).unwrap();
        let (wall, others): (Vec<_>, Vec<_>) =
            matched.points.into_iter().partition(|p| (p.y - 4.0).abs() < 0.05);
        (wall.len(), others.len())
    };
    for size in [[9.0, 2.0], [3.0, 5.0]] {
        let (all, of_parts) = kept(size, Some(false));
        let (left, of_parts_left) = kept(size, None);
        assert!(all > 100 && left * 10 < all, "{size:?}: {left} of {all}");
        assert_eq!(of_parts_left, of_parts);
    }
    assert_eq!(kept([3.2, 2.2], None), kept([3.2, 2.2], Some(false)));
}

#[test]
fn a_table_is_taken_away() {
    let part = model(&shapes::lopsided());
    let (points, eye) = on_a_table(&part);
    let scan = Cloud::new(&points).with_viewpoint(eye);
    let lowest = |remove_plane| {
        let options = Detect { remove_plane, ..Detect::default() };
        let matched = part.correspond(&scan, &options, &Interrupt::never()).unwrap();
        matched.points.iter().map(|p| p.z).fold(f64::INFINITY, f64::min)
    };
    assert!(lowest(None) > -2.4 && lowest(Some(true)) > -2.4);
    assert!(lowest(Some(false)) < -2.4);
    assert_eq!(part.detect(&scan, &Detect::default()).unwrap().registration.poses.len(), 2);
}

#[test]
fn a_coarse_scan_is_matched_at_what_it_can_carry_and_another_unit_is_told_of() {
    let solid = shapes::lopsided();
    let options = FromMesh { voxel: Some(0.08), ..FromMesh::default() };
    let fine = Model::from_mesh(&solid.vertices, &solid.faces, &options).unwrap();
    let (points, normals) = scene(&model(&solid), &placed(2, 5.0, 4));
    let found = fine.detect(&Cloud::new(&points).with_normals(normals), &Detect::default()).unwrap();
    assert_eq!(found.registration.poses.len(), 2);
    let voxel = found.scan.as_ref().unwrap().voxel;
    assert!(voxel > 1.15 * fine.voxel());
    assert_eq!(found.params.resolution, Some(voxel / 1.25));
    let doubts: Vec<String> = found.doubts().map(Doubt::to_string).collect();
    assert_eq!(doubts.len(), 1);
    assert!(
        doubts[0].starts_with("the scan is coarser than the voxel of 0.08 that the model was given; 0.1")
    );

    let part = model(&solid);
    let (points, eye) = on_a_table(&part);
    let inches: Vec<_> = points.iter().map(|p| p / 25.4).collect();
    let scan = Cloud::new(&inches).with_viewpoint(eye / 25.4);
    let found = part.detect(&scan, &Detect::default()).unwrap();
    let last = found.doubts().last().unwrap();
    assert!(
        matches!(last, Doubt::OtherUnit { factors, .. } if (factors[0] * 25.4 - 1.0).abs() < 1e-9),
        "{last}"
    );
    assert!(last.to_string().contains("1/25.4"));
}

#[test]
fn the_sides_of_a_scan_and_of_a_model_are_judged() {
    let part = model(&shapes::lopsided());
    let (points, eye) = on_a_table(&part);
    let doubts = |part: &Model, scan: &Cloud<'_>| {
        part.correspond(scan, &Detect::default(), &Interrupt::never()).unwrap().doubts
    };
    let scan = |eye| Cloud::new(&points).with_viewpoint(eye);
    assert_eq!(doubts(&part, &scan(eye)), []);
    assert_eq!(doubts(&part, &scan(Point3::new(2.0, 1.0, -40.0))), [Doubt::BehindPlane]);
    assert!(matches!(doubts(&part, &scan(Point3::new(8.0, 0.0, 3.0)))[..], [Doubt::Hidden { .. }]));
    let away = scan(eye).with_normals(vec![-Vector3::z(); points.len()]);
    assert!(matches!(doubts(&part, &away)[..], [Doubt::NormalsAway { share }] if share > 0.9));

    let cloud = |sign: f64| {
        let normals = part.normals().unwrap().iter().map(|n| sign * n).collect();
        Model::from_cloud(&Cloud::from(part.points().to_vec()).with_normals(normals)).unwrap()
    };
    assert_eq!(doubts(&cloud(1.0), &scan(eye)), []);
    assert!(matches!(doubts(&cloud(-1.0), &scan(eye))[..], [Doubt::NormalsInward { share }] if share > 0.9));
}

// ------------------------------------------------------------------------------------------------------ its end

#[test]
fn matching_ends_wherever_it_is_asked_to() {
    let solid = shapes::lopsided();
    let part = model(&solid);
    let (points, eye) = on_a_table(&part);
    let scan = Cloud::new(&points).with_viewpoint(eye);
    let fresh = || {
        Model::from_cloud(&Cloud::from(part.points().to_vec()).with_normals(part.normals().unwrap().to_vec()))
    };
    let unlimited = Interrupt::after_asks(usize::MAX);
    assert!(fresh().unwrap().correspond(&scan, &Detect::default(), &unlimited).is_ok());
    let most = unlimited.num_asked();
    assert!(most > 20);
    for asks in (0..most).step_by(most.div_ceil(40)).chain([most - 1]) {
        let ended = fresh().unwrap().correspond(&scan, &Detect::default(), &Interrupt::after_asks(asks));
        assert!(ended.is_err_and(|error| error.is_interrupted()), "after {asks} of {most}");
    }
}

#[test]
fn a_detection_ends_in_each_phase_and_is_then_empty_or_what_was_found() {
    let solid = shapes::lopsided();
    let part = model(&solid);
    let (points, eye) = on_a_table(&part);
    let scan = Cloud::new(&points).with_viewpoint(eye);
    for wanted in
        [Phase::Thin, Phase::Plane, Phase::Normals, Phase::Fpfh, Phase::Match, Phase::Prepare, Phase::Select]
    {
        let cancel = CancelToken::default();
        let token = cancel.clone();
        let watcher = Arc::new(move |phase| {
            if phase == wanted {
                token.cancel();
            }
        });
        let run = Run { cancel, watcher: Some(watcher), ..Run::default() };
        let found = part.detect(&scan, &Detect { run, ..Detect::default() }).unwrap();
        assert_eq!(found.registration.stop_reason, StopReason::Cancelled, "{wanted:?}");
        assert!(found.registration.poses.is_empty());
    }
    let cancel = CancelToken::default();
    cancel.cancel();
    let options = FromMesh { run: Run { cancel, ..Run::default() }, ..FromMesh::default() };
    assert!(Model::from_mesh(&solid.vertices, &solid.faces, &options).unwrap_err().is_interrupted());
}

#[test]
fn time_counts_from_the_call() {
    let part = model(&shapes::lopsided());
    let (points, eye) = on_a_table(&part);
    let scan = Cloud::new(&points).with_viewpoint(eye);
    // In the phase all time goes by, if it has not done so before.
    for (phase, timeout_s) in [(Phase::Thin, 0.0), (Phase::Match, 0.3), (Phase::Select, 0.3)] {
        let start = Instant::now();
        let watcher = Arc::new(move |begins| {
            while begins == phase && start.elapsed().as_secs_f64() < timeout_s {
                std::thread::yield_now();
            }
        });
        let params = Params { timeout_s: Some(timeout_s), ..Params::single_view() };
        let run = Run { watcher: Some(watcher), ..Run::default() };
        let found = part.detect(&scan, &Detect { params: Some(params), run, ..Detect::default() }).unwrap();
        let StopReason::Timeout { value, threshold } = found.registration.stop_reason else {
            panic!("{phase:?}")
        };
        assert!(threshold == timeout_s && value >= timeout_s, "{phase:?}: {value}");
        assert_eq!(found.params.timeout_s, Some(timeout_s));
    }
}

fn named(parts: &[(&str, &Arc<Model>)]) -> Models {
    Models::new(parts.iter().map(|&(name, model)| (name.to_owned(), Arc::clone(model))).collect()).unwrap()
}

/// Two parts, where each is, what a camera sees of them, and where it is.
type Mixed = ([Arc<Model>; 2], [Vec<Isometry3<f64>>; 2], Vec<Point3<f64>>, Point3<f64>);

/// A lopsided box twice and a tee once, far apart.
fn mixed() -> Mixed {
    let parts = [shapes::lopsided(), shapes::tee()].map(|solid| Arc::new(model(&solid)));
    let places = placed(3, 5.0, 3);
    let truth = [places[..2].to_vec(), places[2..].to_vec()];
    let eye = Point3::new(4.0, 2.0, 40.0);
    let points = (0..2).flat_map(|i| seen(scene(&parts[i], &truth[i]), &eye).0).collect();
    (parts, truth, points, eye)
}

#[test]
fn several_models_are_found_together() {
    let (parts, truth, points, eye) = mixed();
    // The box alone fits into nothing of its own: it is a part of the lopsided one.
    let plain = Arc::new(model(&shapes::cuboid([3.0, 2.0, 1.0])));
    let models = named(&[("plain", &plain), ("lopsided", &parts[0]), ("tee", &parts[1])]);
    assert_eq!(models.names().collect::<Vec<_>>(), ["plain", "lopsided", "tee"]);
    let scan = Cloud::new(&points).with_viewpoint(eye);
    let alone = plain.detect(&scan, &Detect::default()).unwrap();
    assert!(!alone.registration.poses.is_empty());
    let mut before = None;
    for num_threads in [1, 2] {
        let options =
            Detect { run: Run { num_threads: Some(num_threads), ..Run::default() }, ..Detect::default() };
        let found = models.detect(&scan, &options).unwrap();
        assert_eq!(num_right(&found.parts[1], &parts[0], &truth[0]), 2);
        // The tee looks the same after half a turn.
        let tees = &found.parts[2].registration.poses;
        let centre = |pose: &Isometry3<f64>| pose * parts[1].source().centre;
        assert_eq!(tees.len(), 1);
        assert!((centre(&tees[0].target_from_source) - centre(&truth[1][0])).norm() < parts[1].voxel());
        let plain = &found.parts[0].registration;
        let outdone = plain.rejected.iter().filter(|rejected| rejected.objection == Objection::Outdone);
        assert_eq!(outdone.count() + plain.poses.len(), alone.registration.poses.len());
        assert!(plain.poses.is_empty() && plain.labels.iter().all(Option::is_none));
        let scores: Vec<f64> = found
            .ranking
            .iter()
            .map(|&[part, pose]| found.parts[part].registration.poses[pose].score)
            .collect();
        assert!(scores.is_sorted_by(|a, b| a >= b));
        let poses: Vec<_> = found
            .parts
            .iter()
            .flat_map(|part| part.registration.poses.iter().map(|pose| (pose.target_from_source, pose.score)))
            .collect();
        assert_eq!(found.ranking.len(), poses.len());
        assert_eq!(*before.get_or_insert(poses.clone()), poses);
    }
}

#[test]
fn a_set_of_one_model_finds_what_the_model_finds() {
    let (parts, _, points, eye) = mixed();
    let scan = Cloud::new(&points).with_viewpoint(eye);
    let alone = parts[0].detect(&scan, &Detect::default()).unwrap();
    let found = named(&[("one", &parts[0])]).detect(&scan, &Detect::default()).unwrap();
    let poses = |of: &Detection| -> Vec<_> {
        of.registration
            .poses
            .iter()
            .map(|pose| (pose.target_from_source, pose.score, pose.inliers.clone()))
            .collect()
    };
    assert_eq!(poses(&found.parts[0]), poses(&alone));
    assert_eq!(found.parts[0].registration.labels, alone.registration.labels);
    assert_eq!(found.stop_reason, alone.registration.stop_reason);
}

#[test]
fn a_set_of_models_ends_as_one_does() {
    let (parts, _, points, eye) = mixed();
    let models = named(&[("lopsided", &parts[0]), ("tee", &parts[1])]);
    let scan = Cloud::new(&points).with_viewpoint(eye);
    let params = Params { timeout_s: Some(0.0), ..Params::single_view() };
    let found = models.detect(&scan, &Detect { params: Some(params), ..Detect::default() }).unwrap();
    assert!(matches!(found.stop_reason, StopReason::Timeout { threshold: 0.0, .. }));
    assert!(found.ranking.is_empty() && found.parts.len() == 2);
    let mut num_rounds = 0;
    let mut once = |_: &Round| {
        num_rounds += 1;
        std::ops::ControlFlow::Break(())
    };
    let set_up = |_, registrar, _: &ibi_core::detection::MatchedScan| registrar;
    let found = models.detect_with(&scan, &Detect::default(), set_up, &mut once).unwrap();
    assert_eq!((num_rounds, found.stop_reason), (1, StopReason::Cancelled));
    let cancel = CancelToken::default();
    cancel.cancel();
    let run = Run { cancel, ..Run::default() };
    let found = models.detect(&scan, &Detect { run, ..Detect::default() }).unwrap();
    assert_eq!(found.stop_reason, StopReason::Cancelled);

    assert_eq!(Models::new(Vec::new()).unwrap_err(), DetectionError::NoModels);
    let twice = vec![("a".to_owned(), parts[0].clone()), ("a".to_owned(), parts[1].clone())];
    assert!(matches!(Models::new(twice).unwrap_err(), DetectionError::SameName { first: 0, second: 1, .. }));
    let bare = Arc::new(Model::from_cloud(&Cloud::from(parts[0].points().to_vec())).unwrap());
    let mixed = named(&[("a", &parts[0]), ("b", &bare)]);
    assert_eq!(mixed.detect(&scan, &Detect::default()).unwrap_err(), DetectionError::NoNormals);
}

#[test]
fn only_a_region_is_looked_into() {
    let (parts, truth, points, eye) = mixed();
    let scan = || Cloud::new(&points).with_viewpoint(eye);
    let middle = truth[0][1] * Point3::origin();
    let reach = Vector3::repeat(2.2);
    let roi = Roi::between(middle - reach, middle + reach);
    let found = parts[0].detect(&scan(), &Detect { roi: Some(roi), ..Detect::default() }).unwrap();
    assert_eq!(num_right(&found, &parts[0], &truth[0][1..]), 1);
    assert_eq!(found.registration.poses.len(), 1);
    // As if the rest had been cut off, and were still known to have been measured.
    let inside: Vec<_> = points.iter().copied().filter(|p| roi.contains(p)).collect();
    let cut = Cloud::new(&inside).with_viewpoint(eye).with_measured(&points[..]);
    let cut = parts[0].detect(&cut, &Detect::default()).unwrap();
    assert_eq!(found.registration.poses[0].measures, cut.registration.poses[0].measures);
    assert_eq!(found.scan.unwrap().points, cut.scan.unwrap().points);

    // Or as if the rest were there always.
    let rest: Vec<_> = points.iter().copied().filter(|p| !roi.contains(p)).collect();
    let with_nan = rest.iter().copied().chain([Point3::new(f64::NAN, 0.0, 0.0)]).collect();
    let options = Detect { background: Some(with_nan), ..Detect::default() };
    let found = parts[0].detect(&scan(), &options).unwrap();
    assert_eq!((found.registration.poses.len(), num_right(&found, &parts[0], &truth[0][1..])), (1, 1));
    let scan_of_it = found.scan.unwrap();
    let far = |p: &Point3<f64>| rest.iter().map(|q| (p - q).norm()).fold(f64::INFINITY, f64::min);
    assert!(scan_of_it.background.iter().all(|p| far(p) < 2.0 * scan_of_it.voxel));
    assert!(scan_of_it.background.len() > scan_of_it.points.len());
    let options = Detect { background: Some(points.clone()), ..Detect::default() };
    let nothing = parts[0].detect(&scan(), &options).unwrap();
    assert_eq!(nothing.doubts().cloned().collect::<Vec<_>>(), [Doubt::Nothing]);
    let options = Detect { background: Some(Vec::new()), ..Detect::default() };
    assert_eq!(parts[0].detect(&scan(), &options).unwrap_err(), DetectionError::NoBackground);

    let far = Some(Roi::between(middle + 50.0 * reach, middle + 51.0 * reach));
    let nothing = parts[0].detect(&scan(), &Detect { roi: far, ..Detect::default() }).unwrap();
    let doubts: Vec<_> = nothing.doubts().cloned().collect();
    assert_eq!(doubts, [Doubt::FewInRoi { num_points: 0, num_given: points.len() }]);
    for (size, axis) in [([1.0, 0.0, 1.0], 1), ([1.0, 1.0, f64::NAN], 2), ([-1.0, 1.0, 1.0], 0)] {
        let roi = Some(Roi { target_from_box: Isometry3::identity(), size: Vector3::from(size) });
        let error = parts[0].detect(&scan(), &Detect { roi, ..Detect::default() }).unwrap_err();
        assert!(error.to_string().starts_with(&format!("roi: its side {axis} is ")));
    }
    let roi = Some(Roi { target_from_box: Isometry3::translation(0.0, f64::NAN, 0.0), size: reach });
    let error = parts[0].detect(&scan(), &Detect { roi, ..Detect::default() }).unwrap_err();
    assert_eq!(error, DetectionError::RoiPlace);
}
