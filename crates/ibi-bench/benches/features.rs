//! The features by themselves, on one thread. Ids: `feature/name/points`.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "criterion's macros, and benches may panic"
)]

use std::hint::black_box;
use std::time::Duration;

use criterion::{Criterion, criterion_group, criterion_main};
use ibi_core::Interrupt;
use ibi_core::features::{
    Descriptors, FPFH_DIM, Matching, Neighborhood, estimate_normals, fpfh, match_features, voxel_downsample,
};
use ibi_core::nalgebra::{Point3, Vector3};
use ibi_testkit::Rng;

/// As many as a depth scan has after thinning.
const POINTS: usize = 30_000;

/// About 85 points around each.
const RADIUS: f64 = 0.07;

/// A wavy, noisy sheet of 2 x 2 and a ball of radius 0.4.
fn cloud(count: usize) -> (Vec<Point3<f64>>, Vec<Vector3<f64>>) {
    let mut rng = Rng::new(1);
    let mut point = |i: usize| {
        let (point, normal) = if i.is_multiple_of(2) {
            let (x, y) = (rng.between(-1.0, 1.0), rng.between(-1.0, 1.0));
            let slopes = [-0.4 * (4.0 * x).cos() * (3.0 * y).cos(), 0.3 * (4.0 * x).sin() * (3.0 * y).sin()];
            let z = 0.1 * (4.0 * x).sin() * (3.0 * y).cos();
            (Point3::new(x, y, z), Vector3::new(slopes[0], slopes[1], 1.0).normalize())
        } else {
            let out = rng.normal_vector().normalize();
            (Point3::new(0.0, 0.0, 0.5) + 0.4 * out, out)
        };
        (point + 0.005 * rng.normal_vector(), normal)
    };
    (0..count).map(&mut point).unzip()
}

/// Why: these are most of the time from a scan to its poses, where correspondences are not given.
fn features(c: &mut Criterion) {
    let (points, normals) = cloud(POINTS);
    let never = Interrupt::never();
    let around = Neighborhood { radius: RADIUS, max_neighbors: 150 };
    let mut group = c.benchmark_group("feature");
    group.sample_size(10).warm_up_time(Duration::from_millis(200));
    group.measurement_time(Duration::from_millis(800));

    let thin = voxel_downsample(&points, Some(&normals), 0.02, &Interrupt::never()).unwrap();
    assert!(thin.points.len() > 1000);
    group.bench_function(format!("voxel_downsample/{POINTS}"), |b| {
        b.iter(|| voxel_downsample(black_box(&points), Some(&normals), 0.02, &Interrupt::never()));
    });
    let few = Neighborhood { radius: 0.045, max_neighbors: 30 };
    let found = estimate_normals(&points, few, None, &never).unwrap();
    assert!(found.iter().zip(&normals).filter(|(a, b)| a.dot(b).abs() > 0.9).count() > POINTS / 2);
    group.bench_function(format!("estimate_normals/{POINTS}"), |b| {
        b.iter(|| estimate_normals(black_box(&points), few, None, &never));
    });
    let described = fpfh(&points, &normals, around, None, &never).unwrap();
    assert!(described.iter().all(|row| (row.iter().sum::<f32>() - 600.0).abs() < 0.1));
    group.bench_function(format!("fpfh/{POINTS}"), |b| {
        b.iter(|| fpfh(black_box(&points), &normals, around, None, &never));
    });
    for sources in [2000, 5000] {
        let (model, model_normals) = cloud(sources);
        let wide = Neighborhood { radius: 0.15, max_neighbors: 150 };
        let model = fpfh(&model, &model_normals, wide, None, &never).unwrap();
        let [model, scene] = [&model, &described].map(|rows| rows.as_flattened());
        let rows = |values| Descriptors { values, dim: FPFH_DIM };
        let join =
            || match_features(rows(model), rows(scene), Matching { k: 2, ..Matching::default() }, &never);
        assert_eq!(join().unwrap().rows.len(), 2 * POINTS);
        group.bench_function(format!("match/{sources}x{POINTS}"), |b| b.iter(join));
    }
    group.finish();
}

criterion_group!(benches, features);
criterion_main!(benches);
