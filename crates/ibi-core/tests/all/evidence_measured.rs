//! What speaks for a pose and against it, measured on all that was scanned.

use std::f64::consts::{PI, TAU};

use ibi_core::evidence::contour::{Contour, Overrun, Placed, Rim, Scan, contour, overrun, run_on};
use ibi_core::evidence::explained::{Reach, Shape, explained};
use ibi_core::evidence::noise::{noise_of_cloud, noise_of_rays, sharpness_of_edges, spacing_of_rays};
use ibi_core::evidence::odds::{Measures, company};
use ibi_core::evidence::rays::{MAX_ANGLE, MIN_FACING_COS, Rays, visible};
use ibi_core::evidence::seen::{Look, Seen, Tally, Tolerance, look, merge, sight};
use ibi_core::evidence::settle::{Steps, settle};
use ibi_core::evidence::slip::{
    FreeMotion, covariance, free_motions, information, losses, motion_between, moved, principal_motions,
    worth,
};
use ibi_core::kernels::nearby::Nearby;
use ibi_core::nalgebra::{Isometry3, Matrix6, Point3, Vector3, Vector6};
use ibi_testkit::strategies::{points, rigid_motions};
use ibi_testkit::{Rng, evidence as naive};
use proptest::prelude::*;

/// Points of a rectangle about `centre`, spanned by `u` and `v`, `step` apart.
fn sheet(centre: [f64; 3], u: [f64; 3], v: [f64; 3], step: f64) -> Vec<Point3<f64>> {
    let (centre, u, v) = (Point3::from(centre), Vector3::from(u), Vector3::from(v));
    let count = |way: &Vector3<f64>| ((2.0 * way.norm() / step).round() as usize).max(1);
    let (columns, rows) = (count(&u), count(&v));
    let part = |i: usize, n: usize| (2 * i + 1) as f64 / n as f64 - 1.0;
    let at = |i, j| centre + part(i, columns) * u + part(j, rows) * v;
    (0..columns).flat_map(|i| (0..rows).map(move |j| at(i, j))).collect()
}

/// A box about the origin: points of its six faces and their normals.
fn cuboid(half: [f64; 3], step: f64) -> (Vec<Point3<f64>>, Vec<Vector3<f64>>) {
    let (mut points, mut normals) = (Vec::new(), Vec::new());
    for axis in 0..3 {
        for sign in [-1.0, 1.0] {
            let [mut centre, mut u, mut v] = [[0.0; 3]; 3];
            (centre[axis], u[(axis + 1) % 3], v[(axis + 2) % 3]) =
                (sign * half[axis], half[(axis + 1) % 3], half[(axis + 2) % 3]);
            let face = sheet(centre, u, v, step);
            normals.extend(vec![sign * Vector3::ith(axis, 1.0); face.len()]);
            points.extend(face);
        }
    }
    (points, normals)
}

fn move_all(
    pose: &Isometry3<f64>,
    points: &[Point3<f64>],
    normals: &[Vector3<f64>],
) -> (Vec<Point3<f64>>, Vec<Vector3<f64>>) {
    (points.iter().map(|p| pose * p).collect(), normals.iter().map(|n| pose * n).collect())
}

/// What a camera at the origin that looks down z measures: the pixels of an image with rays `pixel` apart, each the depth that
/// `depth` gives for a ray (x, y, 1).
fn image(pixel: f64, half: f64, depth: impl Fn(f64, f64) -> Option<f64>) -> Vec<Point3<f64>> {
    let n = (half / pixel) as i32;
    let rays = (-n..=n).flat_map(|i| (-n..=n).map(move |j| (f64::from(i) * pixel, f64::from(j) * pixel)));
    rays.filter_map(|(x, y)| depth(x, y).map(|z| Point3::new(x * z, y * z, z))).collect()
}

/// The depth of a ray from the origin on a box that a pose has moved.
fn depth_of_box(pose: &Isometry3<f64>, half: [f64; 3], x: f64, y: f64) -> Option<f64> {
    let (from, way) = (pose.inverse() * Point3::origin(), pose.inverse() * Vector3::new(x, y, 1.0));
    let (mut enter, mut leave) = (0.0_f64, f64::INFINITY);
    for k in 0..3 {
        let [a, b] = [-half[k], half[k]].map(|side| (side - from[k]) / way[k]);
        (enter, leave) = (enter.max(a.min(b)), leave.min(a.max(b)));
    }
    (enter < leave).then_some(enter)
}

// ------------------------------------------------------------------------------------------------ rays

proptest! {
    /// Whatever way a ray looks, over the edges of the cube too, those around it are found.
    #[test]
    fn rays_near_a_direction_are_all_found(
        cloud in points(3..200), motion in rigid_motions(5.0), at in ibi_testkit::strategies::point(), angle in 1e-3..MAX_ANGLE,
    ) {
        let cloud: Vec<_> = cloud.iter().map(|p| motion * p).collect();
        let eye = Point3::new(0.1, 0.2, -0.3);
        let Some(rays) = Rays::new(eye, &cloud) else { return Ok(()) };
        let (expected, margin) = naive::rays_near(&eye, &cloud, &at, angle);
        prop_assume!(margin > 1e-9);
        let mut found = Vec::new();
        rays.each_near(&at, angle, |end, row| {
            assert_eq!(*end, cloud[row as usize] - eye);
            found.push(row);
        });
        found.sort_unstable();
        prop_assert_eq!(found, expected);
    }

    /// A regular image, turned any way.
    #[test]
    fn the_spacing_of_rays_is_that_of_the_image(motion in rigid_motions(9.0), pixel in 0.004..0.02_f64) {
        let scan = image(pixel, 0.3, |x, y| Some(2.0 + 0.3 * x - 0.2 * y));
        let scan: Vec<_> = scan.iter().map(|p| motion * p).collect();
        let spacing = Rays::new(motion * Point3::origin(), &scan).unwrap().spacing();
        // Rays aside are closer in angle: by cos^2 of it at most, where tan is 0.42.
        prop_assert!(spacing > 0.83 * pixel && spacing <= pixel, "{} of {}", spacing, pixel);
    }

    #[test]
    fn a_look_is_what_it_is_defined_to_be(
        cloud in points(20..300), at in ibi_testkit::strategies::point(), turn in rigid_motions(1.0), across in 0.01..2.0_f64, aside in 0.01..1.0_f64,
    ) {
        let (eye, normal) = (Point3::new(0.1, 0.2, -0.3), turn * Vector3::z());
        let Some(rays) = Rays::new(eye, &cloud) else { return Ok(()) };
        let angle = (1.5 * rays.spacing()).max(aside / (at - eye).norm()).min(MAX_ANGLE);
        let (rows, margin) = naive::rays_near(&eye, &cloud, &at, angle);
        prop_assume!(margin > 1e-9);
        let near: Vec<_> = rows.iter().map(|&row| cloud[row as usize]).collect();
        let (seen, gap) = naive::look(&near, &at, &normal, across, 3.0 * across);
        let found = look(&rays, &at, &normal, Tolerance { across, aside });
        prop_assert_eq!(format!("{:?}", found.seen), format!("{seen:?}"));
        prop_assert!((found.gap.abs() - gap.abs()).abs() < 1e-9, "{} and {}", found.gap, gap);
        let within = near.iter().filter(|p| normal.dot(&(*p - at)).abs() <= across).count();
        prop_assert!((found.share - within as f64 / near.len().max(1) as f64).abs() < 1e-12);
    }
}

#[test]
fn no_two_directions_are_no_image() {
    let eye = Point3::new(1.0, 2.0, 3.0);
    assert!(Rays::new(eye, &[]).is_none());
    assert!(Rays::new(eye, &[eye; 3]).is_none());
    let on_a_ray: Vec<_> = (1..5).map(|k| eye + f64::from(k) * Vector3::new(1.0, 1.0, 1.0)).collect();
    assert!(Rays::new(eye, &on_a_ray).is_none());
    assert!(Rays::new(eye, &[eye + Vector3::x(), eye - Vector3::x()]).is_none(), "opposite ways");
}

/// A wall, and a plate before it, both with points in all places, as of many eyes: one of them sees what is not behind the plate.
#[test]
fn an_eye_sees_what_nothing_is_before() {
    let step = 0.05;
    let wall = sheet([0.0, 0.0, 4.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0], step);
    let plate = sheet([0.0, 0.0, 2.0], [0.5, 0.0, 0.0], [0.0, 0.5, 0.0], step);
    let back = sheet([0.0, 0.0, 2.1], [0.5, 0.0, 0.0], [0.0, 0.5, 0.0], step);
    // Slanted, in one surface: nothing of it hides the rest.
    let ramp = sheet([3.0, 0.0, 4.0], [0.2, 0.0, 1.0], [0.0, 1.0, 0.0], step);
    let facing = Vector3::new(-1.0, 0.0, 0.2).normalize();
    let normals: Vec<_> =
        [(&wall, -Vector3::z()), (&plate, -Vector3::z()), (&back, Vector3::z()), (&ramp, facing)]
            .into_iter()
            .flat_map(|(sheet, normal)| vec![normal; sheet.len()])
            .collect();
    let ends = [wall.len(), wall.len() + plate.len(), wall.len() + plate.len() + back.len()];
    let points = [wall, plate, back, ramp].concat();
    let mut is_visible = vec![false; points.len()];
    for row in visible(&Point3::origin(), &points, &normals, step) {
        is_visible[row as usize] = true;
    }
    for (i, (point, &is_visible)) in points.iter().zip(&is_visible).enumerate() {
        let aside = point.x.abs().max(point.y.abs()) / point.z;
        match () {
            () if i >= ends[2] => {
                let cos = -normals[i].dot(&point.coords) / point.coords.norm();
                assert_eq!(is_visible, cos > MIN_FACING_COS, "the ramp at {point}");
            }
            () if i >= ends[1] => assert!(!is_visible, "the back"),
            () if i >= ends[0] => assert!(is_visible, "the plate"),
            () if aside < 0.24 => assert!(!is_visible, "the wall behind the plate at {point}"),
            () if aside > 0.28 => assert!(is_visible, "the wall beside the plate at {point}"),
            () => {}
        }
    }
}

// ------------------------------------------------------------------------------------------------ seen

/// A wall at depth 4 with a hole in it at x < -0.6, a plate before it at depth 2.
fn wall_and_plate() -> Vec<Point3<f64>> {
    image(0.01, 0.8, |x, y| match () {
        () if x < -0.6 => None,
        () if x.abs().max(y.abs()) < 0.25 => Some(2.0),
        () => Some(4.0),
    })
}

#[test]
fn what_was_measured_tells_of_each_point() {
    let rays = Rays::new(Point3::origin(), &wall_and_plate()).unwrap();
    let tolerance = Tolerance { across: 0.1, aside: 0.0 };
    let towards = -Vector3::z();
    let seen = |x: f64, y: f64, z: f64| look(&rays, &Point3::new(x * z, y * z, z), &towards, tolerance);
    for (place, expected) in [
        ([0.0, 0.0, 2.0], Seen::Supported),
        ([0.5, 0.0, 4.0], Seen::Supported),
        ([0.1, 0.1, 2.05], Seen::Supported),
        ([0.1, 0.1, 1.5], Seen::Contradicted),
        ([0.5, 0.3, 2.0], Seen::Contradicted),
        ([0.1, 0.1, 2.2], Seen::Buried),
        ([0.1, 0.1, 3.5], Seen::Hidden),
        ([-0.7, 0.0, 3.0], Seen::Unknown),
        ([0.25, 0.0, 3.0], Seen::Unknown),
    ] {
        assert_eq!(seen(place[0], place[1], place[2]).seen, expected, "{place:?}");
    }
    assert!((seen(0.1, 0.1, 2.05).gap - 0.05).abs() < 1e-9, "the plate is that far in front");
    // A slanted surface is held against rays beside its point in its own plane: a coarse image tells as well.
    let slanted = image(0.04, 0.5, |x, _| Some(3.0 / (1.0 + 2.0 * x)));
    let rays = Rays::new(Point3::origin(), &slanted).unwrap();
    let normal = -Vector3::new(2.0, 0.0, 1.0).normalize();
    let z = 3.0 / (1.0 + 2.0 * 0.11);
    let Look { seen, gap, .. } =
        look(&rays, &Point3::new(0.11 * z, 0.0, z), &normal, Tolerance { across: 1e-6, aside: 0.0 });
    assert_eq!(seen, Seen::Supported);
    assert!(gap.abs() < 1e-9);
}

#[test]
fn points_that_are_turned_away_or_hidden_are_not_asked_for() {
    let rays = Rays::new(Point3::origin(), &wall_and_plate()).unwrap();
    let tolerance = Tolerance { across: 0.1, aside: 0.02 };
    let at = Point3::new(0.0, 0.0, 2.0);
    let edge_on = Vector3::new(1.0, 0.0, -0.1).normalize();
    let normals = [-Vector3::z(), Vector3::z(), edge_on, -Vector3::z()];
    let all = sight(&rays, &[at; 4], &normals, &[false, false, false, true], 1, tolerance);
    let seen: Vec<_> = all.iter().map(|look| look.seen).collect();
    assert_eq!(seen, [Seen::Supported, Seen::Away, Seen::Away, Seen::Away]);
    let tally = Tally::of(&all);
    assert_eq!(tally, Tally { supported: 1, away: 3, ..Tally::default() });
    assert_eq!(tally.known(), 1);
}

#[test]
fn of_several_eyes_the_one_that_knows_most_is_believed() {
    use Seen::{Away, Buried, Contradicted, Hidden, Supported, Unknown};
    for (one, another, both) in [
        (Away, Hidden, Hidden),
        (Hidden, Unknown, Hidden),
        (Hidden, Contradicted, Contradicted),
        (Contradicted, Supported, Supported),
        (Buried, Contradicted, Contradicted),
    ] {
        for (a, b) in [(one, another), (another, one)] {
            let mut all = [Look::of(a)];
            merge(&mut all, &[Look::of(b)]);
            assert_eq!(all[0].seen, both, "{a:?} and {b:?}");
        }
    }
    let at = |gap| Look { gap, ..Look::of(Supported) };
    let mut all = [at(0.3)];
    merge(&mut all, &[at(-0.1)]);
    assert_eq!(all, [at(-0.1)], "that which it lies nearest to");
}

// ------------------------------------------------------------------------------------------------ contour

#[test]
fn the_rim_of_a_box_runs_along_its_edges() {
    let (half, step) = ([2.0, 1.0, 0.5], 0.1);
    let (points, normals) = cuboid(half, step);
    let rim = Rim::new(&points, &normals, 2.0 * step, 0.0);
    let mut has_rim = vec![false; points.len()];
    for (&row, offset) in rim.rows.iter().zip(&rim.offsets) {
        let (p, n) = (points[row as usize], normals[row as usize]);
        has_rim[row as usize] = true;
        assert!(offset.dot(&n).abs() < 1e-12 && (offset.norm() - 2.0 * step).abs() < 1e-12);
        let place = p + offset;
        assert!((0..3).any(|k| place[k].abs() > half[k] + 0.5 * step), "{place} is beyond the box");
    }
    for ((p, n), has_rim) in points.iter().zip(&normals).zip(has_rim) {
        let within =
            (0..3).filter(|&k| n[k] == 0.0).map(|k| half[k] - p[k].abs()).fold(f64::INFINITY, f64::min);
        if within < step {
            assert!(has_rim, "{p} is at an edge");
        }
        assert!(!has_rim || within < 2.0 * step, "{p} is far from any edge");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    /// On any cloud, the rim is what its definition says.
    #[test]
    fn a_rim_is_what_it_is_defined_to_be(cloud in points(5..60), turn in rigid_motions(1.0), reach in 0.2..3.0_f64) {
        let normals: Vec<_> = (0..cloud.len()).map(|i| turn * Vector3::ith(i % 3, 1.0)).collect();
        let rim = Rim::new(&cloud, &normals, reach, 0.7 * reach);
        for (&row, offset) in rim.rows.iter().zip(&rim.offsets) {
            let place = cloud[row as usize] + offset;
            // A hair of rounding either way.
            prop_assert!(naive::is_beyond(&cloud, &normals, &place, (0.7 - 1e-5) * reach, (0.15 + 1e-5) * reach) || is_tie(&cloud, &place, reach));
        }
    }
}

/// Whether the two nearest points are as near as each other.
fn is_tie(cloud: &[Point3<f64>], place: &Point3<f64>, reach: f64) -> bool {
    let mut far: Vec<f64> = cloud.iter().map(|p| (p - place).norm()).collect();
    far.sort_by(f64::total_cmp);
    far[1] - far[0] < 1e-5 * reach
}

#[test]
fn an_inner_crease_is_no_end() {
    // Two walls that meet in the corner of a room: beyond the crease lies the inside of the other.
    let step = 0.1;
    let floor = sheet([1.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], step);
    let wall = sheet([0.0, 1.0, 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], step);
    let normals: Vec<_> =
        floor.iter().map(|_| Vector3::z()).chain(wall.iter().map(|_| Vector3::x())).collect();
    let points: Vec<_> = floor.into_iter().chain(wall).collect();
    let rim = Rim::new(&points, &normals, 2.0 * step, 0.0);
    assert!(!rim.rows.is_empty());
    for (&row, offset) in rim.rows.iter().zip(&rim.offsets) {
        let place = points[row as usize] + offset;
        assert!(place.x > 2.0 || !(0.0..=2.0).contains(&place.y) || place.z > 2.0, "{place}");
    }
}

/// A box of 2 x 1.2 x 0.6 whose top faces a camera at depth 10, before a wall at depth 14; or a larger one behind the same top.
fn box_before_a_wall(half: [f64; 3]) -> (Isometry3<f64>, Vec<Point3<f64>>) {
    let pose = Isometry3::translation(0.0, 0.0, 10.0 + half[2]);
    let scan = image(0.004, 0.25, |x, y| depth_of_box(&pose, half, x, y).or(Some(14.0)));
    (pose, scan)
}

/// A scan whose normals face the eye: all surfaces here are seen from the front.
struct Seeing {
    scan: Vec<Point3<f64>>,
    normals: Vec<Vector3<f64>>,
    nearby: Nearby,
    rays: Rays,
}

/// How far apart the points of the models are here.
const STEP: f64 = 0.1;

const TOLERANCE: Tolerance = Tolerance { across: 0.03, aside: 0.03 };

impl Seeing {
    fn new(scan: Vec<Point3<f64>>) -> Self {
        let normals = vec![-Vector3::z(); scan.len()];
        let (nearby, rays) = (Nearby::new(&scan, 3.0 * STEP), Rays::new(Point3::origin(), &scan).unwrap());
        Self { scan, normals, nearby, rays }
    }

    fn scan(&self) -> Scan<'_> {
        Scan { points: &self.scan, normals: &self.normals, nearby: &self.nearby }
    }
}

/// A box as a model.
struct Model {
    points: Vec<Point3<f64>>,
    normals: Vec<Vector3<f64>>,
    nearby: Nearby,
    rim: Rim,
    half: [f64; 3],
}

/// A model in a pose, and what the eye says of it.
struct Posed {
    pose: Isometry3<f64>,
    points: Vec<Point3<f64>>,
    normals: Vec<Vector3<f64>>,
    sight: Vec<Look>,
}

impl Posed {
    fn placed(&self) -> Placed<'_> {
        Placed {
            target_from_source: &self.pose,
            points: &self.points,
            normals: &self.normals,
            sight: &self.sight,
        }
    }
}

impl Model {
    fn new(half: [f64; 3]) -> Self {
        let (points, normals) = cuboid(half, STEP);
        let (nearby, rim) = (Nearby::new(&points, 3.0 * STEP), Rim::new(&points, &normals, 2.0 * STEP, 0.0));
        Self { points, normals, nearby, rim, half }
    }

    fn posed(&self, pose: &Isometry3<f64>, seeing: &Seeing) -> Posed {
        let (points, normals) = move_all(pose, &self.points, &self.normals);
        let sight = sight(&seeing.rays, &points, &normals, &[], 1, TOLERANCE);
        Posed { pose: *pose, points, normals, sight }
    }

    /// With rays, and without.
    fn contours(&self, pose: &Isometry3<f64>, seeing: &Seeing) -> [Contour; 2] {
        let posed = self.posed(pose, seeing);
        [&[&seeing.rays][..], &[]]
            .map(|rays| contour(&self.rim, seeing.scan(), rays, posed.placed(), TOLERANCE, STEP))
    }

    fn overrun(&self, pose: &Isometry3<f64>, seeing: &Seeing) -> Overrun {
        let posed = self.posed(pose, seeing);
        let ball = (&Point3::origin(), Vector3::from(self.half).norm());
        overrun(&self.nearby, ball, seeing.scan(), posed.placed(), TOLERANCE.across, STEP)
    }

    /// As a verdict would have it.
    fn worth(&self, pose: &Isometry3<f64>, seeing: &Seeing) -> f64 {
        let posed = self.posed(pose, seeing);
        let run_on = run_on(&self.rim, &[&seeing.rays], posed.placed(), TOLERANCE);
        let can_be_seen = |row: &&u32| posed.sight[**row as usize].seen != Seen::Away;
        let num_ends = self.rim.rows.iter().filter(can_be_seen).count() as u32;
        worth(&posed.sight, run_on, num_ends, TOLERANCE.across)
    }

    fn motions(&self, pose: &Isometry3<f64>, seeing: &Seeing) -> [(Vector6<f64>, f64); 6] {
        let posed = self.posed(pose, seeing);
        let supported = |i: &usize| posed.sight[*i].seen == Seen::Supported;
        let (points, normals): (Vec<_>, Vec<_>) =
            (0..self.points.len()).filter(supported).map(|i| (posed.points[i], posed.normals[i])).unzip();
        let held = information(&points, &normals, &(pose * Point3::origin()), 1.0);
        principal_motions(&(held / points.len().max(1) as f64), 1.0)
    }
}

#[test]
fn a_face_that_ends_where_the_part_does_is_told_from_one_that_runs_on() {
    let half = [1.0, 0.6, 0.3];
    let (pose, scan) = box_before_a_wall(half);
    let seeing = Seeing::new(scan);
    let model = Model::new(half);
    for contour in model.contours(&pose, &seeing) {
        assert!(contour.runs_on == 0 && contour.ends > 50, "{contour:?}");
    }
    assert!(run_on(&model.rim, &[&seeing.rays], model.posed(&pose, &seeing).placed(), TOLERANCE) < 1e-12);
    let Overrun { beyond, on } = model.overrun(&pose, &seeing);
    assert!(beyond == 0 && on > 500, "{beyond} of {on}");
    // On the wall all sides run on.
    let on_wall = Isometry3::translation(-2.2, 2.2, 14.0 + half[2]);
    for contour in model.contours(&on_wall, &seeing) {
        assert!(contour.ends == 0 && contour.runs_on > 50, "{contour:?}");
    }
    let run_on = run_on(&model.rim, &[&seeing.rays], model.posed(&on_wall, &seeing).placed(), TOLERANCE);
    let [of_rays, _] = model.contours(&on_wall, &seeing);
    assert!((run_on - f64::from(of_rays.runs_on)).abs() < 1e-9, "all rays end there");
    let Overrun { beyond, on } = model.overrun(&on_wall, &seeing);
    // A ring around a face of 20 by 12 voxels: from 0.75 of a voxel beyond the edge, where the sides no longer hold it, to 1.9.
    let expected = f64::from(on) * (23.8 * 15.8 - 21.5 * 13.5) / (21.5 * 13.5);
    assert!((f64::from(beyond) / expected - 1.0).abs() < 0.15, "{beyond}, not {expected}");
    // A part of 0.7 times the size, in a corner of the true one: two of four sides run on.
    let small = half.map(|x| 0.7 * x);
    let in_corner = Isometry3::translation(half[0] - small[0], half[1] - small[1], 10.0 + small[2]);
    let model = Model::new(small);
    for Contour { runs_on, ends, .. } in model.contours(&in_corner, &seeing) {
        let share = f64::from(runs_on) / f64::from(runs_on + ends);
        assert!((share - 0.5).abs() < 0.1, "{share}");
    }
    assert!(10 * model.overrun(&in_corner, &seeing).beyond > model.overrun(&in_corner, &seeing).on);
}

#[test]
fn what_is_before_the_place_beyond_a_face_tells_nothing() {
    // A nearer wall hides all that is right of the middle, the right end of the box among it.
    let half = [1.0, 0.6, 0.3];
    let (pose, scan) = box_before_a_wall(half);
    let in_front = scan.into_iter().map(|p| if p.x > 0.0 { p * (8.0 / p.z) } else { p }).collect();
    let seeing = Seeing::new(in_front);
    let [of_rays, without] = Model::new(half).contours(&pose, &seeing);
    assert_eq!((of_rays.runs_on, without.runs_on), (0, 0));
    assert!(of_rays.ends > 20 && of_rays.unknown > 0, "{of_rays:?}");
    assert_eq!(without.ends, of_rays.ends + of_rays.unknown, "without rays it is not told apart");
}

// ------------------------------------------------------------------------------------------------ slip

proptest! {
    #[test]
    fn information_is_what_small_motions_change(cloud in points(1..30), turn in rigid_motions(3.0), noise in 0.1..5.0_f64) {
        let normals: Vec<_> = (0..cloud.len()).map(|i| turn * Vector3::ith(i % 3, 1.0)).collect();
        let centre = turn * Point3::origin();
        let found = information(&cloud, &normals, &centre, noise);
        let expected = naive::information(&cloud, &normals, &centre, noise);
        prop_assert!((found - expected).amax() < 1e-6 * (1.0 + expected.amax()));
        prop_assert_eq!(found, found.transpose());
    }

    #[test]
    fn a_motion_and_its_way_back(start in rigid_motions(5.0), w in prop::array::uniform3(-0.5..0.5_f64), t in prop::array::uniform3(-2.0..2.0_f64), c in rigid_motions(9.0)) {
        let centre = c * Point3::origin();
        let motion = Vector6::new(w[0], w[1], w[2], t[0], t[1], t[2]);
        let there = moved(&motion, &centre, &start);
        prop_assert!((motion_between(&start, &there, &centre) - motion).amax() < 1e-9);
        // The centre itself only shifts.
        let carried = there * (start.inverse() * centre);
        prop_assert!((carried - centre - Vector3::from(t)).amax() < 1e-9);
    }

    /// The covariance is that of the pose, whatever unit the data are in and however it lies in the scene.
    #[test]
    fn covariance_moves_with_the_scene(motion in rigid_motions(20.0)) {
        let (points, normals) = cuboid([1.0, 0.6, 0.3], 0.2);
        let of = |points: &[Point3<f64>], normals: &[Vector3<f64>], centre: &Point3<f64>| {
            covariance(&information(points, normals, centre, 0.05), 1.0)
        };
        let here = of(&points, &normals, &Point3::origin());
        let (there_points, there_normals) = move_all(&motion, &points, &normals);
        let there = of(&there_points, &there_normals, &(motion * Point3::origin()));
        let mut turn = Matrix6::zeros();
        let r = *motion.rotation.to_rotation_matrix().matrix();
        turn.fixed_view_mut::<3, 3>(0, 0).copy_from(&r);
        turn.fixed_view_mut::<3, 3>(3, 3).copy_from(&r);
        prop_assert!((turn * here * turn.transpose() - there).amax() < 1e-9 * here.amax());
    }
}

/// 200 noisy scans of three faces of a box, each with the pose fitted to it: how far it is off, in units of what the covariance
/// says, must follow chi-square with six degrees of freedom.
#[test]
fn poses_are_off_by_what_the_covariance_says() {
    let (noise, mut rng) = (0.02, Rng::new(7));
    let (points, normals) = cuboid([1.0, 0.6, 0.3], 0.15);
    let rows: Vec<usize> = (0..points.len()).filter(|&i| normals[i].iter().all(|&x| x > -0.5)).collect();
    let (points, normals): (Vec<_>, Vec<_>) = rows.iter().map(|&i| (points[i], normals[i])).unzip();
    let truth = rng.pose_at(Vector3::new(3.0, -2.0, 8.0));
    let centre = truth * Point3::origin();
    let mut sum = 0.0;
    for _ in 0..200 {
        let scan: Vec<Point3<f64>> =
            points.iter().zip(&normals).map(|(p, n)| truth * (p + rng.normal() * noise * n)).collect();
        // Point-to-plane to its end, from a pose nearby: each measured point against the plane of its face.
        let mut pose = moved(&(0.01 * Vector6::from_fn(|_, _| rng.normal())), &centre, &truth);
        for _ in 0..5 {
            let (on, of) = move_all(&pose, &points, &normals);
            let mut gradient = Vector6::zeros();
            for ((s, p), n) in scan.iter().zip(&on).zip(&of) {
                let turn = (s - centre).cross(n);
                gradient += n.dot(&(s - p)) * Vector6::new(turn.x, turn.y, turn.z, n.x, n.y, n.z);
            }
            let step = information(&scan, &of, &centre, 1.0).cholesky().unwrap().solve(&gradient);
            pose = moved(&step, &centre, &pose);
        }
        let (on, of) = move_all(&pose, &points, &normals);
        let covariance = covariance(&information(&on, &of, &centre, noise), 2.0);
        let off = motion_between(&pose, &truth, &centre);
        sum += off.dot(&covariance.cholesky().unwrap().solve(&off));
    }
    let mean = sum / 200.0;
    assert!((mean - 6.0).abs() < 0.6, "{mean}");
}

fn free_of(points: &[Point3<f64>], normals: &[Vector3<f64>], centre: Point3<f64>) -> Vec<FreeMotion> {
    free_motions(&information(points, normals, &centre, 0.01), &centre, 1.0, 0.1)
}

#[test]
fn what_nothing_holds_is_named() {
    let motion = Rng::new(3).pose_at(Vector3::new(-4.0, 5.0, 6.0));
    let centre = motion * Point3::new(0.1, -0.2, 0.3);

    let plane = sheet([0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], 0.1);
    let normals = vec![Vector3::z(); plane.len()];
    let (points, normals) = move_all(&motion, &plane, &normals);
    let free = free_of(&points, &normals, centre);
    let axis = motion * Vector3::z();
    assert_eq!(free.len(), 3, "{free:?}");
    for (k, motion) in free.iter().enumerate() {
        match motion {
            FreeMotion::Slide { along } => assert!(k < 2 && along.dot(&axis).abs() < 1e-6),
            FreeMotion::Turn { about, pitch, .. } => {
                assert!(k == 2 && about.dot(&axis).abs() > 1.0 - 1e-6 && pitch.abs() < 1e-6);
            }
        }
    }

    let round: Vec<(Point3<f64>, Vector3<f64>)> = (0..600)
        .map(|i| {
            let (angle, z) = (f64::from(i % 40) * TAU / 40.0, f64::from(i / 40) * 0.1);
            (
                Point3::new(0.5 * angle.cos(), 0.5 * angle.sin(), z),
                Vector3::new(angle.cos(), angle.sin(), 0.0),
            )
        })
        .collect();
    let (tube, tube_normals): (Vec<_>, Vec<_>) = round.into_iter().unzip();
    let (points, normals) = move_all(&motion, &tube, &tube_normals);
    let free = free_of(&points, &normals, centre);
    assert_eq!(free.len(), 2, "{free:?}");
    assert!(
        matches!(free[0], FreeMotion::Slide { along } if along.dot(&axis).abs() > 1.0 - 1e-6),
        "{free:?}"
    );
    let FreeMotion::Turn { about, through, pitch } = free[1] else { panic!("{free:?}") };
    assert!(about.dot(&axis).abs() > 1.0 - 1e-6 && pitch.abs() < 1e-6);
    // Its axis is the tube's.
    assert!((through - motion * Point3::origin()).cross(&axis).norm() < 1e-6, "{through}");

    let ball: Vec<Vector3<f64>> = (0..500)
        .map(|i| {
            let z = 1.0 - (2.0 * f64::from(i) + 1.0) / 500.0;
            let (sin, cos) = (PI * (3.0 - 5.0_f64.sqrt()) * f64::from(i)).sin_cos();
            Vector3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z)
        })
        .collect();
    let points: Vec<_> = ball.iter().map(|n| motion * Point3::from(0.7 * n)).collect();
    let normals: Vec<_> = ball.iter().map(|n| motion * n).collect();
    let free = free_of(&points, &normals, centre);
    assert_eq!(free.len(), 3, "{free:?}");
    for motion_of in &free {
        let FreeMotion::Turn { about, through, .. } = motion_of else { panic!("{free:?}") };
        assert!(
            (motion * Point3::origin() - through).cross(about).norm() < 1e-6,
            "through the middle: {free:?}"
        );
    }

    let (corner, corner_normals) = cuboid([1.0, 0.6, 0.3], 0.1);
    let (points, normals) = move_all(&motion, &corner, &corner_normals);
    assert_eq!(free_of(&points, &normals, centre), []);
    assert_eq!(free_of(&[], &[], centre).len(), 6, "nothing was seen");
}

#[test]
fn principal_motions_come_least_held_first() {
    let (points, normals) = cuboid([1.0, 0.6, 0.3], 0.1);
    let information = information(&points, &normals, &Point3::origin(), 0.05);
    let all = principal_motions(&information, 2.0);
    for pair in all.windows(2) {
        assert!(pair[0].1 >= pair[1].1);
    }
    for (motion, deviation) in all {
        // Along each the inverse information is the square of its deviation.
        let held = (motion.transpose() * information * motion)[0];
        assert!((held * deviation * deviation - 1.0).abs() < 1e-9);
    }
    let nothing = covariance(&Matrix6::zeros(), 3.0);
    assert!(
        (nothing[(5, 5)] - 9.0).abs() < 1e-9 && (nothing[(0, 0)] - 1.0).abs() < 1e-9,
        "as wide as the part"
    );
}

// ------------------------------------------------------------------------------------------------ settle

#[test]
fn a_pose_that_slid_along_a_face_finds_back() {
    let half = [1.0, 0.6, 0.3];
    let (truth, scan) = box_before_a_wall(half);
    let (seeing, model) = (Seeing::new(scan), Model::new(half));
    let value = |pose: &Isometry3<f64>| model.worth(pose, &seeing);
    let motions = |pose: &Isometry3<f64>| {
        model.motions(pose, &seeing).map(|(motion, deviation)| (motion, 1.0 / deviation)).to_vec()
    };
    let shifted =
        |pose: &Isometry3<f64>, motion: &Vector6<f64>| moved(motion, &(pose * Point3::origin()), pose);
    let steps = Steps { first: 0.2, least: 0.02, across: 0.02, rounds: 20 };
    for slide in [[0.3, 0.0, 0.0], [-0.2, 0.25, 0.0], [0.1, -0.3, 0.01]] {
        let start = Isometry3::translation(slide[0], slide[1], slide[2]) * truth;
        let (found, worth) = settle(&start, steps, motions, shifted, value);
        let off = (found.translation.vector - truth.translation.vector).norm();
        assert!(off < 0.08 && worth > value(&start), "{off} after {slide:?}");
    }
    // Where nothing is better, nothing moves.
    let (stays, worth) = settle(&truth, steps, motions, shifted, |_| 1.0);
    assert_eq!((stays, worth), (truth, 1.0));
}

#[test]
fn a_pose_that_may_slide_loses_nothing() {
    let half = [1.0, 0.6, 0.3];
    let (truth, scan) = box_before_a_wall(half);
    let (seeing, model) = (Seeing::new(scan), Model::new(half));
    let on_wall = Isometry3::translation(-2.2, 2.2, 14.0 + half[2]);
    let of = |pose: &Isometry3<f64>| {
        let motions = model.motions(pose, &seeing);
        let ball = (&(pose * Point3::origin()), 1.0);
        losses(pose, &motions, ball, 0.15, model.worth(pose, &seeing), |pose| model.worth(pose, &seeing))
    };
    let (at_truth, at_wall) = (of(&truth), of(&on_wall));
    assert!(at_truth.iter().all(|&loss| loss > 0.05), "{at_truth:?}");
    assert!(at_wall.iter().all(|&loss| loss < 0.02), "{at_wall:?}");
}

#[test]
fn a_pose_is_worth_what_is_seen_of_it() {
    use Seen::{Away, Buried, Contradicted, Hidden, Supported, Unknown};
    let all = |seen: &[Seen]| seen.iter().map(|&seen| Look::of(seen)).collect::<Vec<_>>();
    let is = |a: f64, b: f64| assert!((a - b).abs() < 1e-12, "{a}, not {b}");
    is(worth(&all(&[Supported, Supported, Away]), 0.0, 9, 0.1), 1.0);
    is(worth(&all(&[Supported, Hidden, Unknown, Away]), 0.0, 9, 0.1), 1.0 / 3.0);
    is(worth(&all(&[Supported, Contradicted, Buried]), 0.0, 9, 0.1), -1.0 / 3.0);
    let off = [0.1, -0.05].map(|gap| Look { gap, ..Look::of(Supported) });
    is(worth(&off, 3.0, 12, 0.1), -0.25 - 0.25 * 0.25);
    is(worth(&[], 0.0, 0, 0.1), 0.0);
}

// ------------------------------------------------------------------------------------------------ odds

#[test]
fn what_speaks_for_a_pose_raises_its_odds() {
    let good = Measures {
        tally: Tally { supported: 300, contradicted: 5, ..Tally::default() },
        contour: Contour { runs_on: 4, ends: 60, unknown: 10 },
        overrun: Overrun { beyond: 2, on: 250 },
        losses: [0.1, 0.2, 0.3],
        noise: 0.05,
        blur: 0.02,
        edges: None,
        is_fused: false,
        closeness: 0.9,
        evidence: 3.0,
        company: 0.0,
    };
    let bad = [
        Measures { tally: Tally { contradicted: 80, ..good.tally }, ..good },
        Measures { contour: Contour { runs_on: 40, ..good.contour }, ..good },
        Measures { overrun: Overrun { beyond: 40, ..good.overrun }, ..good },
        Measures { losses: [0.0, 0.0, 0.0], ..good },
        Measures { closeness: 0.5, ..good },
    ];
    for worse in bad {
        assert!(worse.log_odds() < good.log_odds(), "{worse:?}");
        let [worse_still, coarse] = [worse, good].map(coarse);
        assert!(worse_still.log_odds() < coarse.log_odds(), "coarse {worse:?}");
        // How close the thinned clouds lie told nothing more in fused scans.
        let [worse, good] = [worse, good].map(|one| Measures { is_fused: true, ..one });
        assert!(worse.log_odds() < good.log_odds() || worse.closeness < good.closeness, "fused {worse:?}");
    }
    // Of what is hidden less is held; the unknown speaks neither way.
    let hidden = Measures { tally: Tally { hidden: 500, ..good.tally }, ..good };
    assert!(hidden.log_odds() < good.log_odds());
    let unknown = Measures { tally: Tally { unknown: 99, away: 400, ..good.tally }, ..good };
    assert_eq!(unknown.log_odds(), good.log_odds());
    assert_eq!(Measures::default().objections(), [0.0; 3]);
    let more = Measures { contour: Contour { unknown: 99, ..good.contour }, ..good };
    assert_eq!(more.log_odds(), good.log_odds());
}

/// As if the scan were coarse, with sharp edges.
fn coarse(of: Measures) -> Measures {
    Measures { blur: 0.5, edges: Some(0.7), ..of }
}

#[test]
fn sure_poses_speak_for_others_in_coarse_scans() {
    assert_eq!(company([].into_iter()), 0.0);
    let of = |num: usize, each: f64| company(vec![each; num].into_iter());
    assert!(0.0 < of(1, 0.5) && of(1, 0.5) < of(1, 1.0) && of(1, 1.0) < of(2, 1.0));
    assert_eq!(of(9, 1.0), of(99, 1.0));

    let poor = Measures {
        tally: Tally { supported: 30, contradicted: 30, ..Tally::default() },
        ..Measures::default()
    };
    let good = Measures {
        tally: Tally { supported: 300, ..Tally::default() },
        contour: Contour { ends: 90, ..Contour::default() },
        losses: [0.5, 0.8, 0.9],
        closeness: 1.0,
        ..Measures::default()
    };
    let [poor, good] = [poor, good].map(coarse);
    assert_eq!(poor.certainty(), 0.0);
    assert!(good.certainty() > 0.5, "{}", good.certainty());
    let among = good.among(0.5);
    assert!(among.log_odds() > good.log_odds() && among == good.found_among(0.5));
    assert_eq!(among.certainty(), good.certainty(), "company does not feed on itself");
    assert_eq!(among.among(0.0), good);
    let sharp = Measures { blur: 0.05, ..good };
    for other in [
        sharp,
        Measures { edges: Some(0.2), ..good },
        Measures { edges: None, ..good },
        Measures { is_fused: true, ..good },
    ] {
        assert_eq!(other.among(0.5), other, "{other:?}");
        // What was decided on by itself is more sure among others all the same, where it is seen well.
        assert_eq!(other.found_among(0.5).log_odds() > other.log_odds(), other == sharp, "{other:?}");
    }
}

// ------------------------------------------------------------------------------------------------ noise

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]
    #[test]
    fn noise_is_that_of_the_scan(sigma in 1e-4..0.01_f64, motion in rigid_motions(9.0), seed in 0..1000_u64) {
        // On a plane, aslant: z - 0.4 x = 3.
        let aslant = 1.16_f64.sqrt();
        let scan = image(0.008, 0.25, |x, y| Some((3.0 + rng_at(seed, x, y) * sigma * aslant) / (1.0 - 0.4 * x)));
        let scan: Vec<_> = scan.iter().map(|p| motion * p).collect();
        let rays = Rays::new(motion * Point3::origin(), &scan).unwrap();
        let found = noise_of_rays(&rays, &scan);
        prop_assert!((found / sigma - 1.0).abs() < 0.15, "{} of {}", found, sigma);
        let nearby = Nearby::new(&scan, 0.1);
        let found = noise_of_cloud(&scan, &nearby);
        prop_assert!((found / sigma - 1.0).abs() < 0.15, "{} of {}", found, sigma);
    }

    #[test]
    fn noise_is_the_median_of_what_it_is_defined_to_be(cloud in points(13..60)) {
        let nearby = Nearby::new(&cloud, 100.0);
        let mut all: Vec<f64> =
            cloud.iter().map(|point| naive::roughness(&cloud, |p| (p - point).norm_squared())).collect();
        all.sort_by(f64::total_cmp);
        let (found, expected) = (noise_of_cloud(&cloud, &nearby), all[all.len() / 2]);
        // Which of several points that are equally far count is not told by the definition.
        prop_assume!(!cloud.iter().any(|point| is_tie_at_12(&cloud, point)));
        prop_assert!((found - expected).abs() < 1e-6 * (1.0 + expected), "{} and {}", found, expected);
    }
}

#[test]
fn points_are_as_far_apart_as_pixels_that_measured_something() {
    let spacing = |is_there: fn(usize) -> bool| {
        let scan: Vec<_> = image(0.008, 0.25, |_, _| Some(3.0)).into_iter().enumerate().collect();
        let scan: Vec<_> = scan.into_iter().filter(|(at, _)| is_there(*at)).map(|(_, p)| p).collect();
        let rays = Rays::new(Point3::origin(), &scan).unwrap();
        spacing_of_rays(&rays, &scan, 0.2)
    };
    let is = |a: f64, b: f64| assert!((a / b - 1.0).abs() < 0.05, "{a}, not {b}");
    is(spacing(|_| true), 0.024);
    is(spacing(|at| at % 2 == 0), 0.024 * 2_f64.sqrt());
    let rays = Rays::new(Point3::origin(), &image(0.008, 0.25, |_, _| Some(3.0))).unwrap();
    assert_eq!(spacing_of_rays(&rays, &[], 0.2), f64::INFINITY);
}

/// A wall, and a step of 8 voxels before its right half that is as wide as `ramp` pixels.
fn stepped(ramp: f64) -> Vec<Point3<f64>> {
    image(PIXEL, 0.25, |x, _| Some(3.0 - 0.4 * ((x / PIXEL + 0.5) / ramp + 0.5).clamp(0.0, 1.0)))
}

const PIXEL: f64 = 0.008;

fn sharpness(scan: &[Point3<f64>], points: &[Point3<f64>]) -> Option<f64> {
    const VOXEL: f64 = 0.05;
    let rays = Rays::new(Point3::origin(), scan).unwrap();
    sharpness_of_edges(&rays, points, &Nearby::new(points, VOXEL), VOXEL)
}

#[test]
fn edges_are_as_sharp_as_a_step_is_narrow() {
    let [narrow, wide] = [1e-3, 6.0].map(stepped).map(|scan| sharpness(&scan, &scan).unwrap());
    assert!(narrow > 0.9 && wide < 0.35, "{narrow}, {wide}");
    // A flat wall has none.
    let wall = image(PIXEL, 0.25, |_, _| Some(3.0));
    assert_eq!(sharpness(&wall, &wall), None);
}

#[test]
fn what_parts_lie_on_does_not_make_their_edges_sharp() {
    let parts = stepped(6.0);
    let beyond = image(PIXEL, 0.5, |x, y| (x.abs().max(y.abs()) > 0.25).then_some(6.0));
    let together: Vec<_> = parts.iter().chain(&beyond).copied().collect();
    let [alone, whole] = [&parts, &together].map(|points| sharpness(&together, points).unwrap());
    assert!(alone < 0.45 && whole > alone, "{alone}, {whole}");
}

fn is_tie_at_12(cloud: &[Point3<f64>], point: &Point3<f64>) -> bool {
    let mut far: Vec<f64> = cloud.iter().map(|p| (p - point).norm_squared()).collect();
    far.sort_by(f64::total_cmp);
    far[12] - far[11] < 1e-9
}

#[test]
fn too_few_points_have_no_noise() {
    let few = sheet([0.0, 0.0, 3.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], 0.1);
    assert_eq!(noise_of_rays(&Rays::new(Point3::origin(), &few).unwrap(), &few), 0.0);
    assert_eq!(noise_of_cloud(&few, &Nearby::new(&few, 1.0)), 0.0);
    assert_eq!(noise_of_cloud(&[], &Nearby::new(&few, 1.0)), 0.0);
}

/// A number of its own for each ray.
fn rng_at(seed: u64, x: f64, y: f64) -> f64 {
    Rng::new(seed ^ x.to_bits().rotate_left(17) ^ y.to_bits()).normal()
}

#[test]
fn what_a_pose_explains_is_what_its_definition_says() {
    let (points, normals) = cuboid([3.0, 2.0, 0.2], 0.4);
    let shape = Shape { points: &points, normals: &normals };
    let reach = Reach { across: 0.3, aside: 0.5 };
    for seed in 0..20 {
        let mut rng = Rng::new(seed);
        let pose = rng.pose_at(Vector3::new(1.0, -2.0, 30.0));
        let scan: Vec<_> = (0..2000)
            .map(|_| pose * Point3::from([4.0, 3.0, 1.0].map(|half| half * (2.0 * rng.uniform() - 1.0))))
            .collect();
        for eyes in [vec![], vec![Point3::origin()], vec![Point3::origin(), Point3::new(0.0, 0.0, 60.0)]] {
            let found = explained(shape, &pose, &eyes, &scan, reach);
            let own = [reach.across, reach.aside];
            let oracle = naive::explained((&points, &normals), &pose, &eyes, MIN_FACING_COS, &scan, own);
            assert_eq!(found, oracle);
            assert!(found.len() > 20 && found.len() < 1500);
        }
    }
    let nothing = Shape { points: &[], normals: &[] };
    assert!(explained(nothing, &Isometry3::identity(), &[], &points, reach).is_empty());
}
