//! Each stage and each kernel by itself. Ids: `stage/variant/M`, `kernel/name/size`.
//!
//! One thread, so that figures of different machines and days can be compared.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "criterion's macros, and benches may panic"
)]

use std::hint::black_box;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use ibi_core::kernels::by_target::ByTarget;
use ibi_core::kernels::columns::Columns;
use ibi_core::kernels::compatibility::{self, Payoff, votes};
use ibi_core::kernels::graph::{EdgeTest, Graph};
use ibi_core::kernels::kabsch::rigid_fit;
use ibi_core::kernels::mae::mae;
use ibi_core::kernels::nearby::{Nearby, mean_spacing};
use ibi_core::kernels::neighbors::Neighbors;
use ibi_core::kernels::otsu::otsu;
use ibi_core::kernels::overlap::{Contact, Surface, overlap};
use ibi_core::kernels::replicator::{Payoffs, replicator};
use ibi_core::kernels::triplets::TopTriplets;
use ibi_core::nalgebra::{Point3, Vector3};
use ibi_core::stages::ce::Ce;
use ibi_core::stages::hv::Hv;
use ibi_core::stages::scs::{Gtm, Scs};
use ibi_core::stages::te::{Gsac, Te};
use ibi_core::stages::{Context, Enhance, EstimatePose, Ranked, SelectSeeds, Validate};
use ibi_core::{Cloud, Correspondences, Params, Registrar};
use ibi_testkit::scenes::{Recipe, Scene};

/// Sizes of published benchmarks lie in between.
const SIZES: [usize; 3] = [1000, 5000, 20_000];

/// The scene of all stage benches: five instances, half of the correspondences wrong.
fn scene(num_correspondences: usize) -> Scene {
    Recipe::sized(num_correspondences, 0.5, 5).build()
}

fn correspondences(scene: &Scene) -> Correspondences {
    Correspondences::from_rows(scene.rows.clone()).with_similarity(scene.similarity())
}

fn settings(c: &mut Criterion, name: &str, mut run: impl FnMut(&mut Group<'_>)) {
    let mut group = c.benchmark_group(name);
    group.sample_size(10).warm_up_time(Duration::from_millis(200));
    group.measurement_time(Duration::from_millis(800));
    run(&mut group);
    group.finish();
}

type Group<'a> = criterion::BenchmarkGroup<'a, criterion::measurement::WallTime>;

/// A seed selection that finds no seeds but runs `job` on the context of a real run: the only way to have one.
struct Probe<F>(F);

impl<F: Fn(&Context<'_>) + Send + Sync> SelectSeeds for Probe<F> {
    fn select_seeds(&self, context: &Context<'_>) -> Ranked {
        (self.0)(context);
        Ranked::default()
    }
}

/// Runs `job` once in the first round of a run on `scene`, and returns what it returns.
fn in_a_run<T: Send + 'static>(scene: &Scene, job: impl Fn(&Context<'_>) -> T + Send + Sync + 'static) -> T {
    let result = Arc::new(Mutex::new(None));
    let slot = Arc::clone(&result);
    Registrar::new(&Cloud::new(&scene.source))
        .unwrap()
        .params(Params { t_he_pr: 3.0, ..Params::paper_synthetic() })
        .num_threads(1)
        .with_scs(Probe(move |context: &Context<'_>| *slot.lock().unwrap() = Some(job(context))))
        .register(&Cloud::new(&scene.target), &correspondences(scene))
        .unwrap();
    result.lock().unwrap().take().expect("the probe was called")
}

/// Times `work(prepare(context))` at every size; preparing is not timed. `work` says whether its answer is good.
fn bench_stage<P: 'static>(
    group: &mut Group<'_>,
    variant: &str,
    prepare: impl Fn(&Context<'_>) -> P + Clone + Send + Sync + 'static,
    work: impl Fn(&Context<'_>, &P) -> bool + Clone + Send + Sync + 'static,
) {
    for size in SIZES {
        let scene = scene(size);
        group.bench_function(BenchmarkId::new(variant, size), |b| {
            b.iter_custom(|iterations| {
                let (prepare, work) = (prepare.clone(), work.clone());
                in_a_run(&scene, move |context| {
                    let prepared = prepare(context);
                    // Also warms what a run builds once and keeps.
                    assert!(work(context, &prepared), "the answer is wrong");
                    let start = Instant::now();
                    for _ in 0..iterations {
                        black_box(work(context, black_box(&prepared)));
                    }
                    start.elapsed()
                })
            });
        });
    }
}

fn seeds(context: &Context<'_>) -> Ranked {
    Gtm::default().select_seeds(context)
}

fn dense(context: &Context<'_>) -> Ranked {
    Ce::all()[0].enhance(context, &seeds(context))
}

/// Why: which selection scales to how many correspondences. A good answer has seeds.
fn scs(c: &mut Criterion) {
    settings(c, "scs", |group| {
        for scs in Scs::all() {
            let name = scs.name();
            bench_stage(group, name, |_| (), move |context, ()| scs.select_seeds(context).len() >= 5);
        }
        let ratio = Gtm { payoff: Payoff::Ratio, ..Gtm::default() };
        bench_stage(group, "gtm_ratio", |_| (), move |context, ()| ratio.select_seeds(context).len() >= 5);
    });
}

/// Why: the vote is the one step of the paper that touches seeds times all correspondences.
fn ce(c: &mut Criterion) {
    settings(c, "ce", |group| {
        for ce in Ce::all() {
            bench_stage(group, ce.name(), seeds, move |context, seeds| ce.enhance(context, seeds).len() >= 3);
        }
    });
}

/// Why: what a hypothesis costs, whichever way it is sampled. A good answer is a hypothesis.
fn te(c: &mut Criterion) {
    settings(c, "te", |group| {
        for te in Te::all() {
            bench_stage(group, te.name(), dense, move |context, dense| {
                te.estimate_pose(context, dense).hypothesis.is_some()
            });
        }
    });
}

/// Why: validation touches the clouds, not the correspondences; it decides the cost of a round of few.
fn hv(c: &mut Criterion) {
    settings(c, "hv", |group| {
        for hv in Hv::all() {
            let prepare = |context: &Context<'_>| {
                Gsac::default().estimate_pose(context, &dense(context)).hypothesis.unwrap()
            };
            bench_stage(group, hv.name(), prepare, move |context, hypothesis| {
                hv.validate(context, hypothesis).value > 0.0
            });
        }
    });
}

/// The kernel's matrix, never interrupted.
fn payoff_matrix(pairs: &Columns, payoff: Payoff, delta_r: f64) -> Payoffs {
    compatibility::payoff_matrix(pairs, payoff, delta_r, || false)
}

/// Why: a stage that gets slower is explained by one of these.
fn kernels(c: &mut Criterion) {
    let scene = scene(5000);
    let (source, target): (Vec<_>, Vec<_>) =
        scene.rows.iter().map(|&[s, t]| (scene.source[s], scene.target[t])).unzip();
    let pr = 0.1;
    let all = Columns::new(&source, &target, pr);
    let sample = all.gather(&(0..1024).collect::<Vec<_>>());
    let payoff = payoff_matrix(&sample, Payoff::Gaussian, 10.0);
    let population = replicator(&payoff, 20, || false).unwrap();
    let scores: Vec<f32> = (0..300).map(|i| 300.0 - i as f32).collect();
    let tree = Neighbors::new(&scene.target);
    let near = Nearby::new(&scene.target, 0.3);
    let pose = scene.truth[0];

    settings(c, "kernel", |group| {
        for kind in [Payoff::Gaussian, Payoff::Ratio] {
            let name = format!("payoff_matrix_{kind:?}").to_lowercase();
            let matrix = payoff_matrix(&sample, kind, 10.0);
            assert!((0..1024).all(|i| matrix.row(i).iter().all(|x| (0.0..=1.000_001).contains(x))));
            group.bench_function(BenchmarkId::new(name, 1024), |b| {
                b.iter(|| payoff_matrix(black_box(&sample), kind, 10.0));
            });
        }
        let voters = sample.gather(&(0..100).collect::<Vec<_>>());
        assert_eq!(votes(&all, &voters, 10.0).len(), 5000);
        group.bench_function("votes/5000x100", |b| b.iter(|| votes(black_box(&all), &voters, 10.0)));

        assert!((population.iter().sum::<f32>() - 1.0).abs() < 1e-4);
        group.bench_function("replicator/1024x20", |b| {
            b.iter(|| replicator(black_box(&payoff), 20, || false));
        });

        assert!(otsu(&population, 100).is_some());
        group.bench_function("otsu/1024", |b| b.iter(|| otsu(black_box(&population), 100)));

        assert_eq!(TopTriplets::new(&scores).take(100).count(), 100);
        group.bench_function("triplets/100_of_300", |b| {
            b.iter(|| TopTriplets::new(black_box(&scores)).take(100).map(|t| t[2]).sum::<usize>());
        });

        // The instance's own 500 pairs are exact and count 1 each.
        assert!(mae(&all, &pose, 3.0) >= 499.0);
        group.bench_function("mae/5000", |b| b.iter(|| mae(black_box(&all), black_box(&pose), 3.0)));

        let bare = |points| Surface { points, normals: None };
        let contact =
            Contact { distance: 0.15, min_normal_cos: 0.0, oriented: true, view: None, to_planes: false };
        let (model, whole) = (bare(&scene.source), bare(&scene.target));
        let share = || overlap(&model, &whole, &near, black_box(&pose), &contact);
        let full = share();
        assert!(full > 0.999, "{full}");
        group.bench_function(BenchmarkId::new("overlap", scene.source.len()), |b| {
            b.iter(share);
        });

        group.bench_function(BenchmarkId::new("neighbors_build", scene.target.len()), |b| {
            b.iter(|| Neighbors::new(black_box(&scene.target)));
        });
        assert_eq!(tree.nearest(&scene.target[7]).unwrap().0, 7);
        group.bench_function(BenchmarkId::new("neighbors_query", scene.target.len()), |b| {
            b.iter(|| tree.nearest(black_box(&source[0])));
        });

        group.bench_function(BenchmarkId::new("nearby_build", scene.target.len()), |b| {
            b.iter(|| Nearby::new(black_box(&scene.target), 0.3));
        });
        assert_eq!(near.nearest(&scene.target[7]), Some(7));
        // As in a run: many in a row, each elsewhere. Half of them have a neighbour within half of the reach.
        let queries = scene.target.iter().step_by(10).enumerate().map(|(i, p)| {
            let off = if i % 2 == 0 { 0.02 } else { 0.25 };
            p + Vector3::new(off, -off, off)
        });
        let queries: Vec<Point3<f64>> = queries.collect();
        group.bench_function(BenchmarkId::new("nearby_queries", queries.len()), |b| {
            b.iter(|| near.nearest_each(0.3, black_box(&queries)));
        });
        let spacing = mean_spacing(&scene.target);
        assert!(spacing > 0.0);
        group.bench_function(BenchmarkId::new("mean_spacing", scene.target.len()), |b| {
            b.iter(|| mean_spacing(black_box(&scene.target)));
        });

        let test = EdgeTest {
            tau: 0.9,
            min_length: 1.0,
            max_length: 30.0,
            normal_tolerance: 0.5,
            second_order: true,
            max_degree: 80,
            max_vicinity: u32::MAX,
        };
        let graph = || Graph::new(black_box(&all), None, &test, |_| true, || false);
        assert!(graph().len() > 1000);
        group.bench_function("graph/5000", |b| b.iter(graph));
        let by_target = ByTarget::new(&all);
        assert!(by_target.close_pairs(&pose, 1.5).len() >= 500);
        group.bench_function("close_pairs/5000", |b| b.iter(|| by_target.close_pairs(black_box(&pose), 1.5)));

        let triplet = [0, 40, 80].map(|i| (scene.source[i], pose * scene.source[i]));
        let fit = || rigid_fit(black_box(&triplet).iter().map(|(p, q)| (p, q)));
        assert!(fit().unwrap().rotation.angle_to(&pose.rotation) < 1e-6);
        group.bench_function("rigid_fit/3", |b| b.iter(fit));
    });
}

criterion_group!(benches, scs, ce, te, hv, kernels);
criterion_main!(benches);
