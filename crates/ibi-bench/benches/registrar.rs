//! Whole runs, as users see them: `preset/M/outlier ratio/K`. One thread, so that figures of different machines
//! and days can be compared, and one run at the end with as many as there are.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "criterion's macros, and benches may panic"
)]

use std::time::Duration;

use criterion::{Criterion, criterion_group, criterion_main};
use ibi_core::{Cloud, Correspondences, Params, Registrar, Registration};
use ibi_testkit::scenes::{Recipe, Scene};

fn presets() -> [(&'static str, Params); 2] {
    [("paper_synthetic", Params::paper_synthetic()), ("default", Params::default())]
}

fn run(registrar: &Registrar<'_>, scene: &Scene, rows: &Correspondences) -> Registration {
    registrar.register(&Cloud::new(&scene.target), rows).unwrap()
}

fn num_found(scene: &Scene, result: &Registration) -> usize {
    let poses: Vec<_> = result.poses.iter().map(|pose| pose.target_from_source).collect();
    scene.hits(&poses, 0.35, 0.5)
}

fn bench(
    c: &mut Criterion,
    preset: &str,
    params: Params,
    size: usize,
    outliers: f64,
    k: usize,
    threads: usize,
) {
    let scene = Recipe::sized(size, outliers, k).build();
    let rows = Correspondences::from_rows(scene.rows.clone());
    let registrar = Registrar::new(&Cloud::new(&scene.source)).unwrap().params(params).num_threads(threads);
    let found = num_found(&scene, &run(&registrar, &scene, &rows));
    // A round removes 300 correspondences whoever they belong to, so instances with fewer suffer.
    let enough = if size / 2 >= 300 * k && outliers <= 0.5 { k } else { 1 };
    assert!(found >= enough, "{preset} {size} {outliers} {k}: found {found}");

    let mut group =
        c.benchmark_group(if threads == 1 { preset.to_owned() } else { format!("{preset}_threads") });
    group.sample_size(10).warm_up_time(Duration::from_millis(200));
    group.measurement_time(Duration::from_secs(1));
    group.bench_function(format!("{size}/{outliers}/{k}"), |b| b.iter(|| run(&registrar, &scene, &rows)));
    group.finish();
}

/// Why: what grows with the number of correspondences, what with wrong ones, what with instances.
fn whole_runs(c: &mut Criterion) {
    for (preset, params) in presets() {
        for size in [1000, 5000, 20_000] {
            for outliers in [0.5, 0.9] {
                for k in [2, 8] {
                    bench(c, preset, params.clone(), size, outliers, k, 1);
                }
            }
        }
    }
}

/// Why: whether threads are worth their trouble; compare with the same id on one.
fn threads(c: &mut Criterion) {
    let all = std::thread::available_parallelism().map_or(2, Into::into);
    for (preset, params) in presets() {
        bench(c, preset, params, 5000, 0.5, 8, all.max(2));
    }
}

criterion_group!(benches, whole_runs, threads);
criterion_main!(benches);
