//! `nnsr`: its seeds against a plain sort, on similarities of any scale; no seed leads twice.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};

use crate::mock::Mock;
use ibi_core::stages::hv::InlierCount;
use ibi_core::stages::scs::Nnsr;
use ibi_core::stages::{Context, Ranked, SelectSeeds};
use ibi_core::{Cloud, Correspondences, Params, Registrar, Removal, StopReason};
use ibi_testkit::scenes::{Recipe, Scene};

/// The seeds of every round of a run, which accepts nothing, with what was free to be one: alive and not barred.
fn seeds(scene: &Scene, similarity: &[f64], nnsr: &Nnsr, removal: Removal) -> Vec<(Ranked, Vec<u32>)> {
    let seen = Arc::new(Mutex::new(Vec::new()));
    let (log, stage) = (Arc::clone(&seen), nnsr.clone());
    let hv = InlierCount { t_inliers: 100_000 }.into();
    let params = Params { removal, hv, ..Params::paper_synthetic() };
    let result = Registrar::new(&Cloud::new(&scene.source))
        .unwrap()
        .params(params)
        .num_threads(1)
        .with_scs(Mock(move |context: &Context<'_>| {
            let seeds = stage.select_seeds(context);
            let free = context.alive.ids().iter().copied().filter(|&id| !context.barred[id as usize]);
            log.lock().unwrap().push((seeds.clone(), free.collect()));
            seeds
        }))
        .register(
            &Cloud::new(&scene.target),
            &Correspondences::from_rows(scene.rows.clone()).with_similarity(similarity.to_vec()),
        )
        .unwrap();
    let is_dry = matches!(
        result.stop_reason,
        StopReason::FewSeeds { .. } | StopReason::FewCorrespondences { .. } | StopReason::Stalled
    );
    assert!(is_dry, "{}", result.stop_reason);
    Arc::try_unwrap(seen).unwrap().into_inner().unwrap()
}

fn similarities(scene: &Scene) -> [Vec<f64>; 4] {
    let plain = scene.similarity();
    let scaled = |scale: f64, shift: f64| plain.iter().map(|s| s * scale + shift).collect();
    let extreme = plain.iter().map(|&s| if s > 0.5 { f64::MAX } else { f64::MIN }).collect();
    [scaled(1.0, 0.0), scaled(1e-9, -3.0), vec![-7.0; plain.len()], extreme]
}

#[test]
fn seeds_are_the_first_of_a_sorted_list() {
    let scene = Recipe::default().build();
    for similarity in similarities(&scene) {
        for n_nnsr in [3, 20, 10_000] {
            for removal in [Removal::Dense, Removal::Inliers] {
                for (seeds, mut free) in self::seeds(&scene, &similarity, &Nnsr { n_nnsr }, removal) {
                    let of = |id: u32| similarity[id as usize];
                    free.sort_by(|a, b| of(*b).total_cmp(&of(*a)).then(a.cmp(b)));
                    free.truncate(n_nnsr as usize);
                    assert_eq!(seeds.ids(), free);
                    assert!(seeds.scores().iter().all(|score| (0.0..=1.0).contains(score)));
                }
            }
        }
    }
}

#[test]
fn no_seed_leads_twice() {
    let scene = Recipe::default().build();
    let rounds = seeds(&scene, &scene.similarity(), &Nnsr::default(), Removal::Inliers);
    assert!(rounds.len() > 5);
    let mut led = BTreeSet::new();
    assert!(rounds.iter().flat_map(|(seeds, _)| seeds.ids()).all(|&id| led.insert(id)));
}
