//! Scenes with truth, from a seed, and the hard cases that every variant has to survive.

use std::f64::consts::{PI, TAU};

use nalgebra::{Isometry3, Point3, Vector3};

use crate::Rng;

/// What a registration is given, and what it should find.
#[derive(Debug, Clone)]
pub struct Scene {
    /// What test output calls it.
    pub name: &'static str,
    /// The source (model) cloud.
    pub source: Vec<Point3<f64>>,
    /// The target (scene) cloud.
    pub target: Vec<Point3<f64>>,
    /// Correspondences: [source row, target row].
    pub rows: Vec<[usize; 2]>,
    /// The poses of the instances, `target_from_source`.
    pub truth: Vec<Isometry3<f64>>,
    /// For each correspondence the instance it is true for.
    pub labels: Vec<Option<usize>>,
}

/// The recipe of a scene. Lengths are in units of the model, which is about 2 across.
#[derive(Debug, Clone, Copy)]
pub struct Recipe {
    /// What test output calls it.
    pub name: &'static str,
    /// Key of everything random.
    pub seed: u64,
    /// Points of the model.
    pub num_points: usize,
    /// K, the number of instances.
    pub num_instances: usize,
    /// True correspondences of each instance; at most `num_points`.
    pub true_pairs: usize,
    /// Wrong correspondences.
    pub num_outliers: usize,
    /// Target points that belong to no instance: a floor.
    pub num_clutter: usize,
    /// Standard deviation of each target coordinate.
    pub jitter: f64,
}

impl Default for Recipe {
    /// Small, clean and easy: two instances of 100 points, half of 200 correspondences true.
    fn default() -> Self {
        Self {
            name: "easy",
            seed: 1,
            num_points: 100,
            num_instances: 2,
            true_pairs: 50,
            num_outliers: 100,
            num_clutter: 50,
            jitter: 0.0,
        }
    }
}

impl Recipe {
    /// A recipe with the given sizes: `num_correspondences` of which the share `outlier_ratio` is wrong and the
    /// rest is spread evenly over the instances. Clean points; for benches.
    #[must_use]
    pub fn sized(num_correspondences: usize, outlier_ratio: f64, num_instances: usize) -> Self {
        let num_true = (num_correspondences as f64 * (1.0 - outlier_ratio)) as usize;
        let true_pairs = num_true / num_instances;
        Self {
            name: "sized",
            num_points: true_pairs.max(500),
            num_instances,
            true_pairs,
            num_outliers: num_correspondences - true_pairs * num_instances,
            num_clutter: 200,
            ..Self::default()
        }
    }

    /// Builds the scene.
    #[must_use]
    pub fn build(self) -> Scene {
        let mut rng = Rng::new(self.seed);
        let source = asymmetric_model(self.num_points);
        let truth = scattered_poses(self.num_instances, &mut rng);
        let mut target = Vec::new();
        for pose in &truth {
            for point in &source {
                target.push(pose * point + rng.normal_vector() * self.jitter);
            }
        }
        target.extend(floor(self.num_clutter, room(self.num_instances), self.num_points));

        let sizes = [self.num_points, target.len(), self.num_instances];
        let (rows, labels) = matched(sizes, self.true_pairs, self.num_outliers, &mut rng);
        Scene { name: self.name, source, target, rows, truth, labels }
    }
}

impl Scene {
    /// Exact instances of `source` at `truth`, wherever that is, with `true_pairs` correspondences each and as many
    /// wrong ones in all as true ones.
    #[must_use]
    pub fn placed(
        name: &'static str,
        source: Vec<Point3<f64>>,
        truth: Vec<Isometry3<f64>>,
        true_pairs: usize,
    ) -> Self {
        let target: Vec<_> = truth.iter().flat_map(|pose| source.iter().map(move |p| pose * p)).collect();
        let sizes = [source.len(), target.len(), truth.len()];
        let (rows, labels) = matched(sizes, true_pairs, true_pairs * truth.len(), &mut Rng::new(5));
        Self { name, source, target, rows, truth, labels }
    }

    /// Instances of a symmetric shape without anything to tell its ends from each other: the source point of each
    /// true correspondence is any of those that symmetry makes equal.
    #[must_use]
    pub fn symmetric(name: &'static str, shape: &Symmetric, num_instances: usize, true_pairs: usize) -> Self {
        let truth = scattered_poses(num_instances, &mut Rng::new(6));
        let mut scene = Self::placed(name, shape.points.clone(), truth, true_pairs);
        let mut rng = Rng::new(7);
        for (row, _) in scene.rows.iter_mut().zip(&scene.labels).filter(|(_, label)| label.is_some()) {
            let turned = shape.symmetries[rng.below(shape.symmetries.len())] * shape.points[row[0]];
            let off = |i: &usize| (shape.points[*i] - turned).norm_squared();
            row[0] = (0..shape.points.len()).min_by(|i, j| off(i).total_cmp(&off(j))).unwrap_or(row[0]);
        }
        scene
    }

    /// The same scene with its target moved.
    #[must_use]
    pub fn with_target_moved(mut self, motion: &Isometry3<f64>) -> Self {
        self.target.iter_mut().for_each(|q| *q = motion * *q);
        self.truth.iter_mut().for_each(|pose| *pose = motion * *pose);
        self
    }

    /// The same scene in another unit of length.
    #[must_use]
    pub fn scaled(mut self, factor: f64) -> Self {
        self.source.iter_mut().chain(&mut self.target).for_each(|p| p.coords *= factor);
        self.truth.iter_mut().for_each(|pose| pose.translation.vector *= factor);
        self
    }

    /// The same scene with both clouds shifted by `offset` along each axis.
    #[must_use]
    pub fn offset(mut self, offset: f64) -> Self {
        let shift = Vector3::repeat(offset);
        self.source.iter_mut().chain(&mut self.target).for_each(|p| p.coords += shift);
        let there = Isometry3::translation(offset, offset, offset);
        self.truth.iter_mut().for_each(|pose| *pose = there * *pose * there.inverse());
        self
    }

    /// The same scene with its correspondences in another order.
    #[must_use]
    pub fn shuffled(mut self, seed: u64) -> Self {
        let mut order: Vec<usize> = (0..self.rows.len()).collect();
        Rng::new(seed).shuffle(&mut order);
        self.rows = order.iter().map(|&i| self.rows[i]).collect();
        self.labels = order.iter().map(|&i| self.labels[i]).collect();
        self
    }

    /// The same scene under another name.
    #[must_use]
    pub fn named(self, name: &'static str) -> Self {
        Self { name, ..self }
    }

    /// A similarity for each correspondence: those of true pairs are larger on average, and many are equal.
    #[must_use]
    pub fn similarity(&self) -> Vec<f64> {
        let mut rng = Rng::new(8);
        let similarity =
            |label: &Option<usize>| (rng.below(50) + if label.is_some() { 30 } else { 0 }) as f64;
        self.labels.iter().map(similarity).map(|step| step / 80.0).collect()
    }

    /// How many true poses have one of `found` within `rotation_rad` and `distance`.
    #[must_use]
    pub fn hits(&self, found: &[Isometry3<f64>], rotation_rad: f64, distance: f64) -> usize {
        let close = |truth: &Isometry3<f64>, pose: &Isometry3<f64>| {
            truth.rotation.angle_to(&pose.rotation) < rotation_rad
                && (truth.translation.vector - pose.translation.vector).norm() < distance
        };
        self.truth.iter().filter(|truth| found.iter().any(|pose| close(truth, pose))).count()
    }
}

/// [source row, target row] of each correspondence, and the instance it is true for.
type Matched = (Vec<[usize; 2]>, Vec<Option<usize>>);

/// Correspondences of a target that begins with all points of each instance; the sizes are those of the source, of
/// the target, and the number of instances.
fn matched(sizes: [usize; 3], true_pairs: usize, num_outliers: usize, rng: &mut Rng) -> Matched {
    let [num_source, num_target, num_instances] = sizes;
    let mut labelled: Vec<([usize; 2], Option<usize>)> = Vec::new();
    for instance in 0..num_instances {
        let mut points: Vec<usize> = (0..num_source).collect();
        rng.shuffle(&mut points);
        for &point in &points[..true_pairs] {
            labelled.push(([point, instance * num_source + point], Some(instance)));
        }
    }
    for _ in 0..num_outliers {
        let (point, row) = (rng.below(num_source), rng.below(num_target));
        // By chance it may be right after all.
        let right = row < num_instances * num_source && row % num_source == point;
        labelled.push(([point, row], right.then(|| row / num_source)));
    }
    // Nothing may depend on true pairs coming first.
    rng.shuffle(&mut labelled);
    labelled.into_iter().unzip()
}

/// A cloud and the motions that map it onto itself, the identity among them.
#[derive(Debug, Clone)]
pub struct Symmetric {
    /// The points.
    pub points: Vec<Point3<f64>>,
    /// The motions.
    pub symmetries: Vec<Isometry3<f64>>,
}

/// Turns about z by multiples of 1 / `n` of a full one, each also followed by half a turn about x.
fn dihedral(n: usize) -> Vec<Isometry3<f64>> {
    let turn = |k: usize| Isometry3::rotation(Vector3::z() * (TAU * k as f64 / n as f64));
    let over = Isometry3::rotation(Vector3::x() * PI);
    (0..n).flat_map(|k| [turn(k), over * turn(k)]).collect()
}

/// A torus about z, 2.4 across: 24 circles of 8 points.
#[must_use]
pub fn torus() -> Symmetric {
    let point = |i: usize| {
        let (around, (sin, cos)) = (TAU * (i / 8) as f64 / 24.0, (TAU * (i % 8) as f64 / 8.0).sin_cos());
        Isometry3::rotation(Vector3::z() * around) * Point3::new(0.85 + 0.35 * cos, 0.0, 0.35 * sin)
    };
    Symmetric { points: (0..24 * 8).map(point).collect(), symmetries: dihedral(24) }
}

/// A cylinder about z, 1.2 across and 2 high, with its lids: rings of 16 points.
#[must_use]
pub fn cylinder() -> Symmetric {
    let lids = [-1.0, 1.0].into_iter().flat_map(|z| [0.15, 0.375].map(|radius| (radius, z)));
    let rings: Vec<(f64, f64)> = (0..9).map(|k| (0.6, 0.25 * f64::from(k) - 1.0)).chain(lids).collect();
    let point = |(radius, z): (f64, f64), k: usize| {
        let (sin, cos) = (TAU * k as f64 / 16.0).sin_cos();
        Point3::new(radius * cos, radius * sin, z)
    };
    let points = rings.into_iter().flat_map(|ring| (0..16).map(move |k| point(ring, k))).collect();
    Symmetric { points, symmetries: dihedral(16) }
}

/// The surface of a box of 2 x 1.2 x 0.8, in a grid of 0.2.
#[must_use]
pub fn cuboid() -> Symmetric {
    let size = [10, 6, 4];
    let is_outside = |k: [i32; 3]| (0..3).any(|axis| k[axis] == 0 || k[axis] == size[axis]);
    let all = (0..11 * 7 * 5).map(|i| [i / 35, i / 5 % 7, i % 5]).filter(|&k| is_outside(k));
    let middle = Vector3::new(1.0, 0.6, 0.4);
    let points = all.map(|k| Point3::from(Vector3::from(k.map(|k| 0.2 * f64::from(k))) - middle)).collect();
    Symmetric { points, symmetries: dihedral(2) }
}

/// A closed surface without any symmetry, about 2 across: evenly spread directions (Fibonacci lattice), with
/// bumps of incommensurate frequency and three different half axes.
#[must_use]
pub fn asymmetric_model(num_points: usize) -> Vec<Point3<f64>> {
    const GOLDEN_ANGLE_RAD: f64 = 2.399_963_229_728_653;
    let point = |i: usize| {
        let z = 1.0 - (2.0 * i as f64 + 1.0) / num_points as f64;
        let (sin, cos) = (GOLDEN_ANGLE_RAD * i as f64).sin_cos();
        let ring = (1.0 - z * z).sqrt();
        let direction = Vector3::new(ring * cos, ring * sin, z);
        let bumps = 1.0 + 0.25 * (3.0 * direction.x + 1.0).sin() + 0.2 * (4.0 * direction.y + 2.0 * z).cos();
        Point3::from(bumps * direction.component_mul(&Vector3::new(1.0, 0.75, 0.5)))
    };
    (0..num_points).map(point).collect()
}

/// A wavy floor under the instances, sampled about as densely as they are: sparse clutter would coarsen the
/// resolution, which is a mean over all points, and with it every threshold.
fn floor(num_clutter: usize, half: f64, num_points: usize) -> impl Iterator<Item = Point3<f64>> {
    let (step, width) = (2.3 / (num_points as f64).sqrt(), (num_clutter as f64).sqrt().ceil() as usize);
    (0..num_clutter).map(move |i| {
        let (x, y) = ((i % width) as f64 * step - half, (i / width) as f64 * step - half);
        Point3::new(x, y, 0.3 * (2.0 * x).sin() * (1.3 * y).cos() - half - 2.0)
    })
}

/// Half the side of a box that holds `n` instances with room between them.
fn room(n: usize) -> f64 {
    3.0 * (n as f64).cbrt()
}

/// Poses whose models do not touch.
fn scattered_poses(n: usize, rng: &mut Rng) -> Vec<Isometry3<f64>> {
    let mut poses: Vec<Isometry3<f64>> = Vec::new();
    while poses.len() < n {
        let place = rng.in_box(room(n));
        if poses.iter().all(|pose| (pose.translation.vector - place).norm() > 3.0) {
            poses.push(rng.pose_at(place));
        }
    }
    poses
}

/// Inputs that are legal and awkward. Every variant must come to an end on each, without a panic; where
/// `truth` is not empty it can be found.
#[must_use]
pub fn hard_cases() -> Vec<Scene> {
    let easy = || Recipe::default().build();
    let keep = |name, mut scene: Scene, rows: usize| {
        scene.rows.truncate(rows);
        scene.labels.truncate(rows);
        Scene { name, truth: Vec::new(), ..scene }
    };
    let one_pair = Scene { rows: vec![[3, 3]; 200], labels: vec![None; 200], ..easy() };
    let mut repeated = Recipe { true_pairs: 30, num_outliers: 60, ..Recipe::default() }.build();
    repeated.rows = [&repeated.rows[..], &repeated.rows[..], &repeated.rows[..]].concat();
    repeated.labels = [&repeated.labels[..], &repeated.labels[..], &repeated.labels[..]].concat();
    let one_source = Scene { rows: (0..200).map(|row| [7, row]).collect(), ..easy() };
    let one_target = Scene { rows: (0..200).map(|row| [row % 100, 7]).collect(), ..easy() };

    vec![
        keep("no correspondences", easy(), 0),
        keep("two correspondences", easy(), 2),
        keep("three correspondences", easy(), 3),
        keep("one pair 200 times", one_pair, 200),
        keep("one source point", one_source, 200),
        keep("one target point", one_target, 200),
        repeated.named("each correspondence three times"),
        Recipe { name: "only outliers", true_pairs: 0, num_outliers: 200, ..Recipe::default() }.build(),
        Recipe { name: "no outliers", num_outliers: 0, ..Recipe::default() }.build(),
        keep("collinear source", copied("", (0..80).map(on_a_line).collect()), 200),
        copied("coplanar source", (0..80).map(on_a_plane).collect()),
        copied("flat CAD face", cad_part()),
        keep("many identical points", copied("", identical_points()), 200),
        keep("a source of three points", copied("", asymmetric_model(3)), 200),
        easy().offset(1e6).named("offset 1e6"),
        easy().scaled(1e-3).named("scale 1e-3"),
        easy().scaled(1e3).named("scale 1e3"),
    ]
}

/// Two moved copies of `source`, every point of both matched.
fn copied(name: &'static str, source: Vec<Point3<f64>>) -> Scene {
    let mut rng = Rng::new(7);
    let truth = scattered_poses(2, &mut rng);
    let target = truth.iter().flat_map(|pose| source.iter().map(move |p| pose * p)).collect();
    let n = source.len();
    let rows = (0..2 * n).map(|row| [row % n, row]).collect();
    let labels = (0..2 * n).map(|row| Some(row / n)).collect();
    Scene { name, source, target, rows, truth, labels }
}

fn on_a_line(i: usize) -> Point3<f64> {
    let along = (i * i) as f64 / 1600.0; // uneven steps: no shift of the line maps it onto itself
    Point3::from(Vector3::new(0.3, -0.5, 0.8) * along)
}

fn on_a_plane(i: usize) -> Point3<f64> {
    let (angle, radius) = (i as f64 * 2.4, (i as f64 / 20.0).sqrt());
    Point3::new(radius * angle.cos() * 1.5 + 0.01 * (i % 7) as f64, radius * angle.sin(), 0.0)
}

/// A plate with a step: a hundred points with exactly z = 0, and one axis value shared by many elsewhere.
fn cad_part() -> Vec<Point3<f64>> {
    let grid = |nx: usize, ny: usize, z: f64| {
        (0..nx * ny).map(move |i| Point3::new((i % nx) as f64 * 0.1, (i / nx) as f64 * 0.1, z))
    };
    grid(14, 8, 0.0).chain(grid(6, 3, 0.5)).chain(grid(3, 8, 0.9)).collect()
}

/// 40 different points and 60 at one place.
fn identical_points() -> Vec<Point3<f64>> {
    let mut points = asymmetric_model(40);
    points.resize(100, Point3::new(0.1, 0.2, 0.3));
    points
}
