//! Triangles and cliques of small graphs against their naive twins; what the stages built on them make of a scene, and
//! that they say so when a limit cut them off.

use std::collections::BTreeSet;

use ibi_core::kernels::cliques::{Cliques, Limits, heaviest_cliques};
use ibi_core::kernels::dense_graph::DenseGraph;
use ibi_core::kernels::replicator::Payoffs;
use ibi_core::kernels::triangles::{Triangles, heaviest_triangles};
use ibi_core::stages::ce::Voting;
use ibi_core::stages::te::{Mac, SacCot, Te};
use ibi_core::{Cloud, Correspondences, Params, Registrar, Registration};
use ibi_testkit::naive;
use ibi_testkit::scenes::{Recipe, Scene};
use ibi_testkit::strategies::payoffs;
use proptest::prelude::*;

const UNLIMITED: Limits = Limits { max_cliques: usize::MAX, max_steps: usize::MAX };

fn graph(n: usize, weights: &[f32]) -> DenseGraph {
    DenseGraph::new(Payoffs::from_rows(n, weights), 0.0)
}

/// Every two nodes joined with a weight of 1, but those for which `apart` holds.
fn unweighted(n: usize, apart: impl Fn(usize, usize) -> bool) -> Vec<f32> {
    let weight = |i: usize, j: usize| if i == j || apart(i, j) { 0.0 } else { 1.0 };
    (0..n * n).map(|k| weight(k / n, k % n)).collect()
}

fn triangles(graph: &DenseGraph, wanted: usize, max_seen: usize) -> Triangles {
    heaviest_triangles(graph, wanted, max_seen, |_| true, || false)
}

fn cliques(graph: &DenseGraph, limits: Limits) -> Cliques {
    heaviest_cliques(graph, limits, || false)
}

proptest! {
    #[test]
    fn a_graph_has_the_edges_that_reach_the_threshold((n, weights) in payoffs(1..90), least in 0.0..1.0_f32) {
        let graph = DenseGraph::new(Payoffs::from_rows(n, &weights), least);
        for (i, j) in (0..n).flat_map(|i| (0..n).map(move |j| (i, j))) {
            let weight = weights[i * n + j];
            let kept = if weight >= least { weight } else { 0.0 };
            prop_assert_eq!(graph.weight(i as u32, j as u32), kept);
            prop_assert_eq!(graph.neighbors(i as u32)[j / 64] >> (j % 64) & 1 == 1, kept > 0.0);
        }
    }

    #[test]
    fn second_order_is_its_twin((n, weights) in payoffs(1..40), share in 0.0..1.0_f32) {
        let fast = graph(n, &weights).second_order(share, || false);
        let slow = naive::second_order(&weights, n);
        let least = f64::from(share) * slow.iter().copied().fold(0.0, f64::max);
        for (k, &slow) in slow.iter().enumerate() {
            let fast = f64::from(fast.weight((k / n) as u32, (k % n) as u32));
            // Within rounding of the threshold either will do.
            let near = |expected: f64| (fast - expected).abs() <= 1e-5 * expected.max(1.0);
            let is_right = if slow >= least { near(slow) } else { fast == 0.0 };
            prop_assert!(is_right || (slow - least).abs() < 1e-4, "{fast} {slow}");
        }
    }

    #[test]
    fn triangles_are_the_heaviest_of_all((n, weights) in payoffs(1..14), wanted in 1..60_usize) {
        let keep = |t: [u32; 3]| t.iter().sum::<u32>() % 3 != 0;
        let found = heaviest_triangles(&graph(n, &weights), wanted, usize::MAX, keep, || false);
        let mut all = naive::triangles(&weights, n);
        all.retain(|&(triangle, _)| keep(triangle));
        let sum = |t: &[u32; 3]| all.iter().find(|(other, _)| other == t).map(|&(_, sum)| sum);
        // Each is one that may be kept, and none comes twice.
        let sums: Vec<f64> = found.heaviest.iter().filter_map(sum).collect();
        prop_assert_eq!(found.heaviest.iter().collect::<BTreeSet<_>>().len(), sums.len());
        let mut expected: Vec<f64> = all.iter().map(|&(_, sum)| sum).collect();
        expected.sort_by(|a, b| b.total_cmp(a));
        expected.truncate(wanted);
        prop_assert_eq!(sums.len(), expected.len());
        prop_assert!(sums.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-5), "{:?} {:?}", sums, expected);
        prop_assert!(!found.capped);
    }

    #[test]
    fn triangles_of_a_capped_search_are_triangles((n, weights) in payoffs(1..14), max_seen in 1..40_usize) {
        let graph = graph(n, &weights);
        let found = triangles(&graph, 1000, max_seen);
        let all = naive::triangles(&weights, n);
        prop_assert!(found.heaviest.iter().all(|t| all.iter().any(|(other, _)| other == t)));
        prop_assert_eq!(found.heaviest.len(), all.len().min(max_seen));
        prop_assert_eq!(found.capped, all.len() > max_seen);
    }

    #[test]
    fn cliques_are_for_each_node_the_heaviest_of_all((n, weights) in payoffs(1..12)) {
        let found = cliques(&graph(n, &weights), UNLIMITED);
        let all = naive::maximal_cliques(&weights, n);
        prop_assert_eq!(found.num_seen, all.len());
        prop_assert!(!found.capped);
        let weight = |clique: &Vec<u32>| naive::clique_weight(&weights, n, clique);
        prop_assert!(found.heaviest.iter().all(|clique| all.contains(clique)));
        prop_assert!(found.heaviest.is_sorted_by(|a, b| weight(a) >= weight(b) - 1e-9 && a != b));
        let mut wanted = BTreeSet::new();
        for node in 0..n as u32 {
            let best = |cliques: &[Vec<u32>]| {
                let holding = cliques.iter().filter(|clique| clique.contains(&node));
                holding.cloned().max_by(|a, b| weight(a).total_cmp(&weight(b)))
            };
            let (fast, slow) = (best(&found.heaviest), best(&all));
            prop_assert_eq!(fast.as_ref().map(weight), slow.as_ref().map(weight));
            wanted.extend(fast);
        }
        prop_assert!(found.heaviest.iter().all(|clique| wanted.contains(clique)), "one that no node asked for");
    }

    #[test]
    fn cliques_of_a_capped_search_are_maximal(
        (n, weights) in payoffs(1..12), max_cliques in 1..6_usize, max_steps in 1..40_usize,
    ) {
        let found = cliques(&graph(n, &weights), Limits { max_cliques, max_steps });
        let all = naive::maximal_cliques(&weights, n);
        prop_assert!(found.heaviest.iter().all(|clique| all.contains(clique)));
        prop_assert!(found.num_seen <= max_cliques);
        prop_assert!(found.capped || found.num_seen == all.len());
    }
}

#[test]
fn equal_triangles_come_in_lexicographic_order() {
    let found = triangles(&graph(6, &unweighted(6, |_, _| false)), 7, usize::MAX);
    let expected = [[0, 1, 2], [0, 1, 3], [0, 1, 4], [0, 1, 5], [0, 2, 3], [0, 2, 4], [0, 2, 5]];
    assert_eq!(found.heaviest, expected);
}

#[test]
fn a_dense_graph_needs_few_looks_at_triangles_and_one_clique() {
    // 3,921,225 triangles.
    let complete = graph(287, &unweighted(287, |_, _| false));
    let found = triangles(&complete, 100, 100);
    assert!(found.heaviest.len() == 100 && !found.capped);
    let found = cliques(&complete, Limits { max_cliques: 1, max_steps: 1000 });
    assert_eq!(found.num_seen, 1);
    assert_eq!(found.heaviest, [(0..287).collect::<Vec<u32>>()]);
}

/// Groups of three that are joined to all but each other: 3^20 maximal cliques, as many as 60 nodes can have.
#[test]
fn a_graph_full_of_cliques_is_cut_off_and_no_node_is_left_without_one() {
    let weights = unweighted(60, |i, j| i / 3 == j / 3);
    let found = cliques(&graph(60, &weights), Limits { max_cliques: 300, max_steps: 6000 });
    assert!(found.capped && found.num_seen <= 300);
    for clique in &found.heaviest {
        // One of each group.
        let groups: Vec<u32> = clique.iter().map(|node| node / 3).collect();
        assert_eq!(groups, (0..20).collect::<Vec<u32>>());
    }
    let held: BTreeSet<u32> = found.heaviest.iter().flatten().copied().collect();
    assert!(held.len() > 50, "{} of 60 nodes have a clique", held.len());
}

#[test]
fn searches_end_when_interrupted() {
    let weights = unweighted(60, |i, j| i / 3 == j / 3);
    let graph = graph(60, &weights);
    assert!(heaviest_triangles(&graph, 10, usize::MAX, |_| true, || true).heaviest.is_empty());
    assert!(heaviest_cliques(&graph, UNLIMITED, || true).num_seen < 1000);
}

// --------------------------------------------------------------------------------------------------- the stages

fn run(scene: &Scene, te: impl Into<Te>, n_vot: u32) -> Registration {
    let params = Params { te: te.into(), ce: Voting { n_vot }.into(), ..Params::paper_synthetic() };
    Registrar::new(&Cloud::new(&scene.source))
        .unwrap()
        .params(Params { t_he_pr: 1.0, d_op_pr: 0.5, ..params })
        .num_threads(1)
        .register(&Cloud::new(&scene.target), &Correspondences::from_rows(scene.rows.clone()))
        .unwrap()
}

fn hits(scene: &Scene, result: &Registration) -> usize {
    let poses: Vec<_> = result.poses.iter().map(|pose| pose.target_from_source).collect();
    scene.hits(&poses, 0.1, 0.1)
}

#[test]
fn both_stages_find_the_instances_of_easy_scenes() {
    for te in [Te::from(SacCot::default()), Mac::default().into()] {
        let mut found = 0;
        for seed in 0..4 {
            let scene = Recipe { seed, true_pairs: 80, ..Recipe::default() }.build();
            let result = run(&scene, te.clone(), 60);
            found += hits(&scene, &result);
        }
        assert!(found >= 7, "{}: {found} of 8", te.name());
    }
}

#[test]
fn a_round_says_that_a_limit_was_hit() {
    let scene = Recipe { true_pairs: 80, ..Recipe::default() }.build();
    let is_capped = |te: Te| run(&scene, te, 200).rounds[0].capped;
    assert!(is_capped(SacCot { max_triangles: 3, ..SacCot::default() }.into()));
    assert!(is_capped(Mac { max_cliques: 1, t_sog: 0.0, ..Mac::default() }.into()));
    assert!(is_capped(Mac { max_steps: 1, t_sog: 0.0, ..Mac::default() }.into()));
    // More members of C_d than a graph may have as nodes.
    let large = Recipe { num_points: 800, true_pairs: 800, ..Recipe::default() }.build();
    let is_capped = |n_vot| run(&large, SacCot::default(), n_vot).rounds[0].capped;
    assert!(is_capped(1025) && !is_capped(300));
}
