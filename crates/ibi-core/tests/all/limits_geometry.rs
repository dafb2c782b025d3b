//! Limits outside of the rounds: each phase ends when it is asked to, wherever it is; and what bounds its time is right.

use std::sync::{Arc, Mutex};

use ibi_core::features::{
    Amount, Descriptors, FeatureError, Matching, Mesh, Neighborhood, PlaneSearch, Views, dominant_plane,
    estimate_normals, fpfh, match_features, outer_surface, sample_mesh, voxel_downsample,
};
use ibi_core::kernels::par::Pool;
use ibi_core::kernels::sight::OwnShadow;
use ibi_core::metrics::{
    self, Criterion, MetricsError, Model, PoseThresholds, assignment, diameter, mssd_recall, score_scene,
};
use ibi_core::nalgebra::{Isometry3, Matrix3, Point3, Vector3};
use ibi_core::{
    CancelToken, Cloud, Error, FindSymmetries, Interrupt, Phase, PreparedCloud, Symmetries, SymmetryError,
    find_symmetries,
};
use ibi_testkit::Rng;
use ibi_testkit::features as naive;
use ibi_testkit::shapes::{self, Solid};
use proptest::prelude::*;

// --------------------------------------------------------------------------------------------------- interrupts

/// Whether a computation was interrupted; it succeeds otherwise.
type Job = Box<dyn Fn(&Interrupt) -> bool + Sync + Send>;

fn feature<T>(result: Result<T, FeatureError>) -> bool {
    match result {
        Err(FeatureError::Interrupted) => true,
        Err(error) => panic!("{error}"),
        Ok(_) => false,
    }
}

#[allow(clippy::needless_pass_by_value, reason = "as the one above")]
fn metric<T>(result: Result<T, MetricsError>) -> bool {
    match result {
        Err(MetricsError::Interrupted) => true,
        Err(error) => panic!("{error}"),
        Ok(_) => false,
    }
}

fn ball(count: usize) -> Vec<Point3<f64>> {
    let mut rng = Rng::new(5);
    (0..count).map(|_| Point3::from(rng.normal_vector().normalize())).collect()
}

fn normals(points: &[Point3<f64>]) -> Vec<Vector3<f64>> {
    points.iter().map(|p| p.coords).collect()
}

fn poses(count: usize) -> Vec<Isometry3<f64>> {
    let mut rng = Rng::new(6);
    (0..count)
        .map(|_| {
            let place = rng.in_box(2.0);
            rng.pose_at(place)
        })
        .collect()
}

/// What makes a phase long, under a name; nothing for those of a registration, which are of another table.
#[allow(clippy::too_many_lines, reason = "a table")]
fn jobs(phase: Phase) -> Vec<(&'static str, Job)> {
    let model = || Model::new(ball(3000)).unwrap();
    match phase {
        Phase::Diameter => vec![
            ("of a cloud of which few points are far out", {
                let cloud: Vec<_> = ball(100_000).iter().map(|p| Point3::new(p.x, p.y, 9.0 * p.z)).collect();
                Box::new(move |interrupt| metric(diameter(&cloud, interrupt)))
            }),
            ("of a ball", {
                let cloud = ball(20_000);
                Box::new(move |interrupt| metric(diameter(&cloud, interrupt)))
            }),
            ("of a ball of few points", {
                let cloud = ball(3000);
                Box::new(move |interrupt| metric(diameter(&cloud, interrupt)))
            }),
        ],
        Phase::Shadow => vec![
            ("of all points", {
                let cloud = ball(3000);
                Box::new(move |interrupt| {
                    OwnShadow::until(&cloud, &normals(&cloud), 0.03, interrupt).is_none()
                })
            }),
            ("of some of many points", {
                let cloud = ball(51_000);
                Box::new(move |interrupt| {
                    OwnShadow::until(&cloud, &normals(&cloud), 0.007, interrupt).is_none()
                })
            }),
            ("of points that are all in one cell", {
                let cloud = [vec![Point3::origin(); 3000], ball(10)].concat();
                let normals = vec![Vector3::x(); cloud.len()];
                Box::new(move |interrupt| OwnShadow::until(&cloud, &normals, 0.1, interrupt).is_none())
            }),
        ],
        Phase::Thin => vec![("of many points", {
            let cloud = ball(200_000);
            Box::new(move |interrupt| {
                feature(voxel_downsample(&cloud, Some(&normals(&cloud)), 0.02, interrupt))
            })
        })],
        Phase::Normals => vec![
            ("of many points", {
                let (cloud, around) = (ball(6000), Neighborhood { radius: 0.05, max_neighbors: 30 });
                Box::new(move |interrupt| feature(estimate_normals(&cloud, around, None, interrupt)))
            }),
            ("of points that are neighbours of all others", {
                let (cloud, around) = (ball(2000), Neighborhood { radius: 9.0, max_neighbors: 2000 });
                Box::new(move |interrupt| feature(estimate_normals(&cloud, around, None, interrupt)))
            }),
        ],
        Phase::Fpfh => vec![
            ("of many points", {
                let (cloud, around) = (ball(4000), Neighborhood { radius: 0.1, max_neighbors: 100 });
                Box::new(move |interrupt| feature(fpfh(&cloud, &normals(&cloud), around, None, interrupt)))
            }),
            ("of a few and all around them", {
                let (cloud, around) = (ball(4000), Neighborhood { radius: 0.1, max_neighbors: 100 });
                let rows: Vec<usize> = (0..1500).collect();
                Box::new(move |interrupt| {
                    feature(fpfh(&cloud, &normals(&cloud), around, Some(&rows), interrupt))
                })
            }),
        ],
        Phase::Match => vec![("of many rows", {
            let mut rng = Rng::new(1);
            let values: Vec<f32> = (0..8 * 3000).map(|_| rng.uniform() as f32).collect();
            Box::new(move |interrupt| {
                let rows = Descriptors { values: &values, dim: 8 };
                let matching = Matching { k: 2, mutual: true, max_ratio: None };
                feature(match_features(rows, rows, matching, interrupt))
            })
        })],
        Phase::Plane => vec![("of a table", {
            let cloud: Vec<_> = ball(50_000).iter().map(|p| Point3::new(p.x, p.y, 0.01 * p.z)).collect();
            let search = PlaneSearch { distance: 0.005, min_share: 0.1, seed: 0 };
            Box::new(move |interrupt| feature(dominant_plane(&cloud, &search, None, interrupt)))
        })],
        Phase::SampleMesh => [Amount::Count(3000), Amount::Spacing(0.05)]
            .into_iter()
            .map(|amount| -> (&'static str, Job) {
                let Solid { vertices, faces } = shapes::torus();
                let job = move |interrupt: &Interrupt| {
                    feature(sample_mesh(&Mesh { vertices: &vertices, faces: &faces }, amount, 0, interrupt))
                };
                ("of a torus", Box::new(job))
            })
            .collect(),
        Phase::OuterSurface => vec![("of a torus", {
            let Solid { vertices, faces } = shapes::torus();
            let mesh = Mesh { vertices: &vertices, faces: &faces };
            let sampled = sample_mesh(&mesh, Amount::Count(3000), 0, &Interrupt::never()).unwrap();
            Box::new(move |interrupt| {
                let mesh = Mesh { vertices: &vertices, faces: &faces };
                let (points, normals) = (&sampled.points, &sampled.normals);
                feature(outer_surface(points, normals, &mesh, &Views::default(), interrupt))
            })
        })],
        Phase::Symmetries => [shapes::cuboid([3.0, 2.0, 1.0]), shapes::prism(24, 1.0, 1.0)]
            .into_iter()
            .map(|Solid { vertices, faces }| -> (&'static str, Job) {
                let mesh = Mesh { vertices: &vertices, faces: &faces };
                let cloud = sample_mesh(&mesh, Amount::Count(500), 0, &Interrupt::never()).unwrap();
                let job = move |interrupt: &Interrupt| {
                    let found = find_symmetries(&cloud.points, None, FindSymmetries::default(), interrupt);
                    match found {
                        Err(SymmetryError::Interrupted) => true,
                        Err(error) => panic!("{error}"),
                        Ok(_) => false,
                    }
                };
                ("of a solid", Box::new(job))
            })
            .collect(),
        Phase::Metrics => vec![
            ("assignment", {
                // Each newcomer drives away those before it.
                let n = 150;
                let cost: Vec<f64> = (0..n * n).map(|k| ((k / n + 1) * (k % n + 1)) as f64).collect();
                Box::new(move |interrupt| metric(assignment(&cost, n, n, interrupt)))
            }),
            ("add_s", {
                let (model, [a, b]) = (Model::new(ball(9000)).unwrap(), [0, 1].map(|k| poses(2)[k]));
                Box::new(move |interrupt| metric(model.add_s(&a, &b, interrupt)))
            }),
            ("add_s by discs to be built", {
                let cloud = ball(140_000);
                let near = Isometry3::translation(1e-4, 0.0, 0.0);
                Box::new(move |interrupt| {
                    let model = Model::new(cloud.clone()).unwrap();
                    metric(model.add_s(&near, &Isometry3::identity(), interrupt))
                })
            }),
            ("mssd", {
                let turn = |angle: f64| Isometry3::rotation(Vector3::z() * angle);
                // Each is better than those before it, and has to be looked at to its end.
                let turns: Vec<_> = (1..400).map(|k| turn(1e-3 * f64::from(k))).collect();
                let (model, all) = (model(), Symmetries::new(&turns, &[]).unwrap());
                Box::new(move |interrupt| {
                    metric(model.mssd(&turn(1.0), &Isometry3::identity(), &all, interrupt))
                })
            }),
            ("score_scene by ADD-S", {
                let (model, poses) = (model(), poses(8));
                Box::new(move |interrupt| {
                    let criterion = Criterion::AddS { model: &model, diameter_fraction: 0.1 };
                    metric(score_scene(&poses, &poses, metrics::Matching::Any, &criterion, interrupt))
                })
            }),
            ("score_scene by thresholds", {
                let poses = poses(300);
                Box::new(move |interrupt| {
                    let criterion = Criterion::Pose(PoseThresholds::ecc());
                    metric(score_scene(&poses, &poses, metrics::Matching::OneToOne, &criterion, interrupt))
                })
            }),
            ("mssd_recall", {
                let (model, poses) = (model(), poses(10));
                Box::new(move |interrupt| {
                    let none = Symmetries::none();
                    let matching = metrics::Matching::OneToOne;
                    metric(mssd_recall(&model, &poses, &poses, &none, matching, interrupt))
                })
            }),
        ],
        Phase::Spacing => vec![("of many points", {
            let cloud = ball(30_000);
            Box::new(move |interrupt| match PreparedCloud::source_until(&Cloud::new(&cloud), interrupt) {
                Err(Error::Interrupted { .. }) => true,
                Err(error) => panic!("{error}"),
                Ok(_) => false,
            })
        })],
        Phase::Prepare
        | Phase::Graph
        | Phase::Select
        | Phase::Enhance
        | Phase::Estimate
        | Phase::Chance
        | Phase::Polish
        | Phase::Validate
        | Phase::Contest
        | Phase::JointCheck
        | Phase::Rank => Vec::new(),
        phase => panic!("{phase:?} is in no table"),
    }
}

/// Each computation of the table with its phase, on 1 and on 2 threads.
fn each_job(check: impl Fn(Phase, &str, &Job) + Sync) {
    for threads in [1, 2] {
        let pool = Pool::new(Some(threads)).unwrap();
        for phase in Phase::ALL {
            for (name, job) in jobs(phase) {
                pool.install(|| check(phase, name, &job));
            }
        }
    }
}

/// How often each asks at least, however small the inputs of the table are.
const LEAST_ASKS: usize = 4;

#[test]
fn each_computation_ends_wherever_it_is() {
    each_job(|phase, name, job| {
        // A model keeps what it has once worked out.
        assert!(!job(&Interrupt::never()), "{phase:?} {name}");
        let all = Interrupt::after_asks(usize::MAX);
        assert!(!job(&all), "{phase:?} {name}");
        let most = all.num_asked();
        assert!(most >= LEAST_ASKS, "{phase:?} {name} asks {most} times");
        for asks in [0, 1, most / 2, most - 1] {
            let interrupt = Interrupt::after_asks(asks);
            assert!(job(&interrupt), "{phase:?} {name}, {asks} of {most}");
        }
    });
}

#[test]
fn each_computation_ends_as_it_begins_and_begins_nothing_else() {
    each_job(|phase, name, job| {
        let (token, begun) = (CancelToken::default(), Arc::new(Mutex::new(Vec::new())));
        let (to_cancel, list) = (token.clone(), Arc::clone(&begun));
        let interrupt = Interrupt::from(token).with_watcher(Arc::new(move |begins| {
            list.lock().unwrap().push(begins);
            if begins == phase {
                to_cancel.cancel();
            }
        }));
        assert!(job(&interrupt), "{phase:?} {name}");
        assert_eq!(*begun.lock().unwrap(), [phase], "{name}");
    });
}

// ------------------------------------------------------------------------------------------------------- bounds

proptest! {
    #![proptest_config(ProptestConfig::with_cases(8))]

    /// A plate above a floor throws its shadow on it, although not each point is asked.
    #[test]
    fn many_points_take_the_shadows_of_some(x in -0.5..0.5_f64, y in -0.5..0.5_f64) {
        let step = 0.015;
        let sheet = |half: f64, z: f64| {
            let n = (2.0 * half / step) as usize;
            (0..n * n).map(move |k| {
                Point3::new((k / n) as f64 * step - half, (k % n) as f64 * step - half, z)
            })
        };
        let floor: Vec<_> = sheet(2.5, 0.0).collect();
        let num_floor = floor.len();
        let points: Vec<_> = floor.into_iter().chain(sheet(0.5, 1.0)).collect();
        prop_assert!(points.len() > 100_000);
        // The lower side of the plate, and of the floor, is hidden from nobody who sees it from below.
        let below: Vec<_> = points.iter().map(|p| p - Vector3::z() * 1e-3).collect();
        let normals = [vec![Vector3::z(); points.len()], vec![-Vector3::z(); points.len()]].concat();
        let both = [points.clone(), below].concat();
        let shadow = OwnShadow::new(&both, &normals, step);
        let hidden = shadow.from(&Point3::new(1000.0 * x, 1000.0 * y, 1000.0), &Isometry3::identity());
        prop_assert_eq!(hidden.len(), both.len());
        prop_assert!(!hidden[num_floor..].contains(&true), "the plate is above all, the rest faces away");
        for (point, &is_hidden) in points[..num_floor].iter().zip(hidden) {
            let aside = (point.x + x).abs().max((point.y + y).abs());
            // Directions are known to 10 degrees: that far the shadow may be off.
            if aside < 0.5 - 0.35 { prop_assert!(is_hidden, "{}", point); }
            if aside > 0.5 + 0.4 { prop_assert!(!is_hidden, "{}", point); }
        }
        let some: Vec<u32> = (0..both.len() as u32).step_by(977).collect();
        let on = shadow.on(&some);
        let of_some = on.from(&Point3::new(1000.0 * x, 1000.0 * y, 1000.0), &Isometry3::identity());
        prop_assert!(some.iter().zip(of_some).all(|(&row, &is)| hidden[row as usize] == is));
    }

    /// Far more neighbours within the radius than may count, in a volume, in clusters, with a few points far off: the nearest
    /// are those that count all the same.
    #[test]
    fn the_nearest_of_very_many_neighbors_count(seed: u64, radius in 5.0..1e4_f64, most in 8..20_usize) {
        let mut rng = Rng::new(seed);
        let points: Vec<Point3<f64>> = (0..2500)
            .map(|row| Point3::from(rng.in_box(1.0) * if row % 5 == 0 { 0.01 } else { 1.0 }))
            .chain((0..3).map(|k| Point3::new(f64::from(k), 50.0, 1000.0)))
            .collect();
        let around = Neighborhood { radius, max_neighbors: most };
        let found = estimate_normals(&points, around, None, &Interrupt::never()).unwrap();
        for row in (0..points.len()).step_by(50).chain(2500..2503) {
            let near = naive::neighbors(&points, row, radius, most);
            let eigen = naive::spread(&points, &near).symmetric_eigen();
            let mut values: Vec<f64> = eigen.eigenvalues.iter().copied().collect();
            values.sort_by(f64::total_cmp);
            // Where two directions are as good, either may be taken.
            if values[1] - values[0] > 1e-3 * values[2] {
                let least = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
                prop_assert!(found[row].dot(&least).abs() > 1.0 - 1e-6, "row {}", row);
            }
        }
    }

    /// Coordinates that no whole number can count: long, thin faces far off.
    #[test]
    fn needles_are_sampled(length in 0..99_i32, seed: u64, count in 1..50_usize) {
        let long = 10.0_f64.powi(length);
        let vertices = [[0.0, 0.0, 0.0], [long, 0.0, 0.0], [0.0, 1.0 / long, 0.0]].map(Point3::from);
        let vertices = vertices.map(|p| Point3::from(Matrix3::new(0.6, -0.8, 0.0, 0.8, 0.6, 0.0, 0.0, 0.0, 1.0) * p.coords));
        let mesh = Mesh { vertices: &vertices, faces: &[[0, 1, 2]] };
        let sampled = sample_mesh(&mesh, Amount::Count(count), seed, &Interrupt::never());
        // From some length on the area is lost in rounding.
        match sampled {
            Ok(sampled) => prop_assert_eq!(sampled.points.len(), count),
            Err(error) => prop_assert_eq!(error, FeatureError::NoArea),
        }
    }
}

/// Where the numbers cannot hold as many points as are wanted, they fall onto each other; and soon.
#[test]
fn a_mesh_far_off_is_sampled() {
    let vertices = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
        .map(|[x, y, z]| Point3::new(x + 1e15, y, z + 1e15));
    let mesh = Mesh { vertices: &vertices, faces: &[[0, 1, 2]] };
    let interrupt = Interrupt::after_asks(100_000);
    let sampled = sample_mesh(&mesh, Amount::Count(300), 0, &interrupt);
    assert_eq!(sampled.map(|sampled| sampled.points.len()), Ok(300));
}

/// A histogram has a sum of 200; 0 without neighbours; and 100 where those have no weight.
#[test]
fn what_a_histogram_sums_to() {
    let line = |x: f64| Point3::new(x, 0.0, 0.0);
    // Two at one place, two near each other, one alone.
    let points = [line(0.0), line(0.0), line(5.0), line(5.5), line(20.0)];
    let around = Neighborhood { radius: 1.0, max_neighbors: 10 };
    let found = fpfh(&points, &[Vector3::z(); 5], around, None, &Interrupt::never()).unwrap();
    let sums: Vec<[f32; 3]> =
        found.iter().map(|row| [0, 1, 2].map(|k| row[11 * k..11 * (k + 1)].iter().sum())).collect();
    assert_eq!(sums, [[100.0; 3], [100.0; 3], [200.0; 3], [200.0; 3], [0.0; 3]]);
}
