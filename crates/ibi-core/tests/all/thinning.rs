//! The compatibility graph where correspondences have too many neighbours: which become nodes, and that the graph is
//! the definition's on those that do.

use std::collections::HashSet;

use ibi_core::kernels::columns::Columns;
use ibi_core::kernels::graph::{EdgeTest, Graph, PairNormals};
use ibi_core::kernels::par::Pool;
use ibi_core::nalgebra::{Point3, Vector3};
use ibi_testkit::Rng;
use ibi_testkit::naive::{self, Pair};
use ibi_testkit::strategies::correspondences;
use proptest::prelude::*;

/// Lengths this close to a bound may fall on either side of it.
const UNDECIDED: f64 = 1e-4;

/// A degree is estimated from a sample of 128 of the vicinity: good to a fifth, so that twice or half of it would be
/// three standard deviations off.
const LOOSE: f64 = 2.0;

const MAX_DEGREE: u32 = 80;

fn columns(pairs: &[Pair]) -> Columns {
    let (source, target): (Vec<_>, Vec<_>) = pairs.iter().copied().unzip();
    Columns::new(&source, &target, 1.0)
}

fn edge_test(test: &naive::EdgeTest, max_degree: u32) -> EdgeTest {
    EdgeTest {
        tau: test.tau as f32,
        min_length: test.min_length as f32,
        max_length: test.max_length as f32,
        normal_tolerance: test.normal_tolerance as f32,
        second_order: true,
        max_degree,
        max_vicinity: u32::MAX,
    }
}

fn graph_of(pairs: &[Pair], test: &naive::EdgeTest, max_degree: u32) -> Graph {
    Graph::new(&columns(pairs), None, &edge_test(test, max_degree), |_| true, || false)
}

/// For the models below, which are 2 wide: nothing of a copy is too far for an edge, and next to nothing too near.
const TEST: naive::EdgeTest =
    naive::EdgeTest { tau: 0.05, min_length: 0.01, max_length: 2.1, normal_tolerance: 0.1 };

/// `n` exact copies of points in a ball of radius 1, moved to `place`: all are compatible with all.
fn clique(n: usize, place: [f64; 3], rng: &mut Rng) -> Vec<Pair> {
    let pose = rng.pose_at(Vector3::from(place));
    let point = |rng: &mut Rng| Point3::from(rng.normal_vector().normalize() * rng.uniform().cbrt());
    (0..n).map(|_| point(rng)).map(|p| (p, pose * p)).collect()
}

/// `n` pairs of points in balls of radius 1, the target's around `place`, that have nothing to do with each other.
fn noise(n: usize, place: [f64; 3], rng: &mut Rng) -> Vec<Pair> {
    let others = clique(n, [0.0; 3], rng);
    let place = Vector3::from(place);
    clique(n, [0.0; 3], rng).into_iter().zip(others).map(|((p, _), (_, q))| (p, q + place)).collect()
}

/// The correspondences that have become nodes, by node. `node` and `id` must be each other's inverse.
fn nodes(graph: &Graph, num_pairs: usize) -> Vec<u32> {
    let ids: Vec<u32> = (0..graph.len() as u32).map(|node| graph.id(node)).collect();
    assert!(ids.iter().zip(0..).all(|(&id, node)| graph.node(id) == Some(node)));
    let with_node = (0..num_pairs as u32).filter(|&id| graph.node(id).is_some());
    assert_eq!(with_node.count(), ids.len());
    ids
}

/// How many of the correspondences in `range` have become nodes.
fn num_kept(graph: &Graph, range: std::ops::Range<usize>) -> usize {
    range.filter(|&id| graph.node(id as u32).is_some()).count()
}

fn assert_about(count: usize, expected: u32) {
    let (count, expected) = (count as f64, f64::from(expected));
    assert!((expected / LOOSE..=expected * LOOSE).contains(&count), "{count}, not about {expected}");
}

/// Holds the graph against the definition on those correspondences that have become nodes.
fn check_graph(graph: &Graph, pairs: &[Pair], test: &naive::EdgeTest) {
    let kept: Vec<Pair> = nodes(graph, pairs.len()).into_iter().map(|id| pairs[id as usize]).collect();
    let n = kept.len();
    let mut joined = vec![false; n * n];
    for i in 0..n {
        let (neighbors, weights) = graph.edges(i as u32);
        assert_eq!(neighbors.len(), weights.len());
        assert!(neighbors.windows(2).all(|w| w[0] < w[1]), "not ascending, or twice: {neighbors:?}");
        for &j in neighbors {
            joined[i * n + j as usize] = true;
        }
    }
    let weight: Vec<f64> = (0..n * n)
        .map(|at| if joined[at] { naive::edge_weight(&kept[at / n], &kept[at % n], test.tau) } else { 0.0 })
        .collect();
    for i in 0..n {
        for j in 0..n {
            let is_edge = joined[i * n + j];
            assert_eq!(is_edge, joined[j * n + i]);
            let (a, b) = (&kept[i], &kept[j]);
            let margin = naive::edge_margin(a, b, test);
            assert!(!is_edge || (a.0 != b.0 && a.1 != b.1), "{i} {j} share a point");
            assert!(margin.abs() <= UNDECIDED || is_edge == (margin > 0.0), "{i} {j} {margin}");
        }
        // The weights follow from the edges, whichever way the undecided ones went.
        let (neighbors, weights) = graph.edges(i as u32);
        let mut support = 0.0;
        for (&j, &w2) in neighbors.iter().zip(weights) {
            let j = j as usize;
            let common: f64 = (0..n).map(|k| weight[i * n + k] * weight[j * n + k]).sum();
            let expected = weight[i * n + j] * common;
            let error = (1.0 + neighbors.len() as f64) * (UNDECIDED / test.tau + 1e-6);
            assert!((f64::from(w2) - expected).abs() <= error, "{i} {j} {w2} {expected}");
            support += f64::from(w2);
        }
        assert!((f64::from(graph.support(i as u32)) - support).abs() <= 1e-5 * (1.0 + support), "{i}");
        assert!(graph.is_alive(i as u32));
    }
}

/// Edges of all nodes, each counted at both ends.
fn num_ends(graph: &Graph) -> usize {
    (0..graph.len() as u32).map(|node| graph.edges(node).0.len()).sum()
}

/// The correspondence of each node, its neighbours, and the bits of the weights and the support.
fn bits(graph: &Graph) -> Vec<(u32, Vec<u32>, Vec<u32>, u32)> {
    let row = |node| {
        let (neighbors, weights) = graph.edges(node);
        let weights = weights.iter().map(|w| w.to_bits()).collect();
        (graph.id(node), neighbors.to_vec(), weights, graph.support(node).to_bits())
    };
    (0..graph.len() as u32).map(row).collect()
}

proptest! {
    // Whatever the cap leaves, the graph is that of the definition; and without one it leaves all.
    #[test]
    fn a_thinned_graph_is_its_twin_on_the_nodes(
        pairs in correspondences(0..120), tau in 0.3..5.0, max_length in 2.0..40.0, max_degree in 1..40_u32,
    ) {
        let test = naive::EdgeTest { tau, min_length: 0.1, max_length, normal_tolerance: 0.3 };
        let thinned = graph_of(&pairs, &test, max_degree);
        check_graph(&thinned, &pairs, &test);
        let whole = graph_of(&pairs, &test, u32::MAX);
        prop_assert_eq!(whole.len(), pairs.len());
        check_graph(&whole, &pairs, &test);
        // Up to twice the cap in reach of all of them, none of them can have too many.
        if pairs.len() <= 2 * max_degree as usize {
            prop_assert_eq!(bits(&thinned), bits(&whole));
        }
        // Both stand in the order of one grid.
        let mut order = (0..whole.len() as u32).map(|node| whole.id(node));
        prop_assert!((0..thinned.len() as u32).all(|node| order.any(|id| id == thinned.id(node))));
    }

    // Where the vicinity is small enough to be asked as a whole, degrees are exact: none below the cap is lost.
    #[test]
    fn none_below_the_cap_is_lost(
        pairs in correspondences(0..120), tau in 0.3..5.0, max_length in 2.0..40.0, max_degree in 1..40_u32,
    ) {
        let test = naive::EdgeTest { tau, min_length: 0.1, max_length, normal_tolerance: 0.3 };
        let (whole, thinned) = (graph_of(&pairs, &test, u32::MAX), graph_of(&pairs, &test, max_degree));
        for node in 0..whole.len() as u32 {
            let degree = whole.edges(node).0.len();
            prop_assert!(degree > max_degree as usize || thinned.node(whole.id(node)).is_some(), "{degree}");
        }
    }
}

#[test]
fn without_a_cap_all_become_nodes() {
    let mut rng = Rng::new(1);
    let pairs = [clique(400, [0.0; 3], &mut rng), noise(200, [5.0, 0.0, 0.0], &mut rng)].concat();
    let graph = graph_of(&pairs, &TEST, u32::MAX);
    assert_eq!(graph.len(), 600);
    check_graph(&graph, &pairs, &TEST);
    // The test can tell a clique: thinning it is what the cap is for.
    assert!(num_ends(&graph) > 390 * 400);
    assert_eq!(bits(&graph), bits(&graph_of(&pairs, &TEST, 400)));
}

#[test]
fn a_clique_keeps_about_as_many_as_the_cap() {
    let mut rng = Rng::new(2);
    let pairs = clique(1500, [3.0, -1.0, 2.0], &mut rng);
    for max_degree in [8, 20, MAX_DEGREE, 300] {
        let graph = graph_of(&pairs, &TEST, max_degree);
        assert_about(graph.len(), max_degree);
        check_graph(&graph, &pairs, &TEST);
        // Without the clique's nearest neighbours every node is joined to every other.
        assert!(num_ends(&graph) > graph.len() * (graph.len() - 1) * 9 / 10);
    }
    // The nodes are spread as the clique is: no octant of the target is left out.
    let graph = graph_of(&pairs, &TEST, MAX_DEGREE);
    let octant = |id: usize| {
        let q = pairs[id].1 - Point3::new(3.0, -1.0, 2.0);
        usize::from(q.x > 0.0) + 2 * usize::from(q.y > 0.0) + 4 * usize::from(q.z > 0.0)
    };
    let mut per_octant = [0; 8];
    for id in nodes(&graph, 1500) {
        per_octant[octant(id as usize)] += 1;
    }
    assert!(per_octant.iter().all(|&num| (3..=25).contains(&num)), "{per_octant:?}, not about 10 each");
}

#[test]
fn cliques_far_apart_keep_their_own_shares() {
    let mut rng = Rng::new(3);
    let (large, small) = (clique(1500, [0.0; 3], &mut rng), clique(500, [20.0, 0.0, 0.0], &mut rng));
    // The third is below the cap, if not by much.
    let tiny = clique(70, [0.0, 20.0, 0.0], &mut rng);
    let mut pairs: Vec<(Pair, usize)> = Vec::new();
    for (part, clique) in [large, small, tiny].into_iter().enumerate() {
        pairs.extend(clique.into_iter().map(|pair| (pair, part)));
    }
    rng.shuffle(&mut pairs);
    let (pairs, parts): (Vec<Pair>, Vec<usize>) = pairs.into_iter().unzip();
    let graph = graph_of(&pairs, &TEST, MAX_DEGREE);
    let mut kept = [0; 3];
    for id in nodes(&graph, pairs.len()) {
        kept[parts[id as usize]] += 1;
    }
    assert_about(kept[0], MAX_DEGREE);
    assert_about(kept[1], MAX_DEGREE);
    assert_eq!(kept[2], 70);
    check_graph(&graph, &pairs, &TEST);
}

// A dense copy costs those elsewhere nothing, though they too have more than twice the cap in reach: few of these are
// compatible.
#[test]
fn a_sparse_part_loses_nothing() {
    let mut rng = Rng::new(4);
    let pairs = [noise(300, [0.0; 3], &mut rng), clique(1000, [20.0, 0.0, 0.0], &mut rng)].concat();
    let test = naive::EdgeTest { tau: 0.02, ..TEST };
    let whole = graph_of(&pairs, &test, u32::MAX);
    let most = (0..300).map(|id| whole.edges(whole.node(id).unwrap()).0.len()).max().unwrap();
    assert!((1..MAX_DEGREE as usize / 2).contains(&most), "few compatible ones, {most} at most");
    let graph = graph_of(&pairs, &test, MAX_DEGREE);
    assert_eq!(num_kept(&graph, 0..300), 300);
    assert_about(num_kept(&graph, 300..1300), MAX_DEGREE);
    // Among themselves they have the weights of the whole graph.
    for id in 0..300 {
        let [row, whole_row] = [&graph, &whole].map(|graph| {
            let (neighbors, weights) = graph.edges(graph.node(id).unwrap());
            let mut row: Vec<(u32, f32)> =
                neighbors.iter().map(|&node| graph.id(node)).zip(weights.iter().copied()).collect();
            row.sort_by_key(|&(id, _)| id);
            row
        });
        assert_eq!(row.len(), whole_row.len());
        let close =
            |((id, w), (id_2, w_2)): (&(u32, f32), &(u32, f32))| id == id_2 && (w - w_2).abs() <= 1e-5 * w;
        assert!(row.iter().zip(&whole_row).all(close));
    }
}

// Wrong pairs among the right ones do not take the place of these: degrees are each correspondence's own.
#[test]
fn wrong_pairs_among_a_clique_mostly_stay() {
    let mut rng = Rng::new(5);
    let mut pairs: Vec<(Pair, bool)> =
        clique(1000, [0.0; 3], &mut rng).into_iter().map(|p| (p, true)).collect();
    pairs.extend(noise(300, [0.0; 3], &mut rng).into_iter().map(|p| (p, false)));
    rng.shuffle(&mut pairs);
    let (pairs, right): (Vec<Pair>, Vec<bool>) = pairs.into_iter().unzip();
    let test = naive::EdgeTest { tau: 0.01, ..TEST };
    let graph = graph_of(&pairs, &test, MAX_DEGREE);
    let kept_right = nodes(&graph, 1300).into_iter().filter(|&id| right[id as usize]).count();
    assert_about(kept_right, MAX_DEGREE);
    assert!(graph.len() - kept_right > 270, "{} of 300 wrong pairs", graph.len() - kept_right);
    check_graph(&graph, &pairs, &test);
}

// Many to one: whoever shares its source or its target with all others has no neighbour, and is none too many.
#[test]
fn pairs_that_share_a_point_are_not_thinned() {
    let mut rng = Rng::new(6);
    let pairs = clique(500, [0.0; 3], &mut rng);
    let one = pairs[0];
    let (to_one, from_one): (Vec<Pair>, Vec<Pair>) =
        pairs.iter().map(|(p, q)| ((*p, one.1), (one.0, *q))).unzip();
    for pairs in [to_one, from_one, vec![one; 500]] {
        let graph = graph_of(&pairs, &TEST, 8);
        assert_eq!((graph.len(), num_ends(&graph)), (500, 0));
        check_graph(&graph, &pairs, &TEST);
    }
}

// What normals forbid is no neighbour.
#[test]
fn degrees_heed_the_normals() {
    let mut rng = Rng::new(7);
    let source = clique(600, [0.0; 3], &mut rng);
    let pose = rng.pose_at(Vector3::new(1.0, 2.0, 3.0));
    let pairs: Vec<Pair> = source.iter().map(|(p, _)| (*p, pose * p)).collect();
    let mut any = || rng.normal_vector().normalize();
    let normals: Vec<Vector3<f64>> = (0..600).map(|_| any()).collect();
    let wrong: Vec<Vector3<f32>> = (0..600).map(|_| any().cast()).collect();
    let turned = normals.iter().map(|n| (pose * n).cast()).collect();
    let normals: Vec<Vector3<f32>> = normals.iter().map(|n| n.cast()).collect();
    let ask = |target: Vec<Vector3<f32>>| {
        let normals = PairNormals { source: normals.clone(), target, oriented: true };
        Graph::new(&columns(&pairs), Some(&normals), &edge_test(&TEST, MAX_DEGREE), |_| true, || false)
    };
    assert_about(ask(turned).len(), MAX_DEGREE);
    assert_eq!(ask(wrong).len(), 600);
}

// What bounds time and memory, whatever the scene: full of copies, and copies upon copies.
#[test]
fn edges_are_bounded_by_the_cap() {
    let mut rng = Rng::new(8);
    let separate: Vec<Pair> =
        (0..10).flat_map(|i| clique(400, [f64::from(i) * 2.5, 0.0, 0.0], &mut rng)).collect();
    let model = clique(400, [0.0; 3], &mut rng);
    let overlapping: Vec<Pair> = (0..10)
        .flat_map(|_| {
            let place = rng.in_box(1.0);
            let pose = rng.pose_at(place);
            model.iter().map(move |(p, _)| (*p, pose * p)).collect::<Vec<_>>()
        })
        .collect();
    let nested = [clique(3000, [0.0; 3], &mut rng), noise(1000, [0.0; 3], &mut rng)].concat();
    for pairs in [separate, overlapping, nested] {
        for max_degree in [20, MAX_DEGREE] {
            let graph = graph_of(&pairs, &TEST, max_degree);
            let ends = num_ends(&graph);
            assert!(ends <= 2 * graph.len() * max_degree as usize, "{ends} for {} nodes", graph.len());
            let most = (0..graph.len() as u32).map(|node| graph.edges(node).0.len()).max().unwrap();
            assert!(most <= 4 * max_degree as usize, "{most} at one node");
        }
    }
}

#[test]
fn removal_from_a_thinned_graph_passes_over_what_is_no_node() {
    let mut rng = Rng::new(9);
    let pairs = clique(800, [0.0; 3], &mut rng);
    let mut graph = graph_of(&pairs, &TEST, MAX_DEGREE);
    let gone: Vec<u32> = (0..800).step_by(2).collect();
    graph.remove(&gone);
    let gone: HashSet<u32> = gone.into_iter().collect();
    let mut num_alive = 0;
    for node in 0..graph.len() as u32 {
        assert_eq!(graph.is_alive(node), !gone.contains(&graph.id(node)));
        num_alive += usize::from(graph.is_alive(node));
        let (neighbors, weights) = graph.edges(node);
        let alive = neighbors.iter().zip(weights).filter(|&(&j, _)| !gone.contains(&graph.id(j)));
        let sum: f64 = alive.map(|(_, &w)| f64::from(w)).sum();
        assert!((f64::from(graph.support(node)) - sum).abs() <= 1e-5 * (1.0 + sum), "{node}");
    }
    assert!((1..graph.len()).contains(&num_alive));
    graph.remove(&(0..800).collect::<Vec<_>>());
    assert!(graph.supports().iter().all(|&support| support.abs() < f32::MIN_POSITIVE));
}

#[test]
fn an_interrupted_graph_has_no_edges_whether_it_came_to_thinning_or_not() {
    let pairs = clique(1000, [0.0; 3], &mut Rng::new(10));
    let graph = Graph::new(&columns(&pairs), None, &edge_test(&TEST, MAX_DEGREE), |_| true, || true);
    assert_eq!((graph.len(), num_ends(&graph)), (1000, 0));
}

#[test]
fn a_thinned_graph_has_the_same_bits_for_any_number_of_threads() {
    let mut rng = Rng::new(11);
    let pairs = [
        clique(1500, [0.0; 3], &mut rng),
        clique(900, [3.0, 0.0, 0.0], &mut rng),
        noise(600, [1.5, 0.5, 0.0], &mut rng),
    ]
    .concat();
    let ask = || bits(&graph_of(&pairs, &TEST, MAX_DEGREE));
    let serial = ask();
    assert!(serial.len() < pairs.len() / 2, "thinned: {}", serial.len());
    assert!(serial.iter().map(|row| row.1.len()).sum::<usize>() > 5000, "a graph worth the name");
    for num_threads in [1, 2, 7] {
        assert!(Pool::new(Some(num_threads)).unwrap().install(ask) == serial, "{num_threads} threads");
    }
}

// Several candidates for each target point, listed one after the other as a matcher does: the right one is always the
// first, or always the last. A sample of every so many of them must not see the one kind only.
#[test]
fn the_rhythm_of_a_list_does_not_matter() {
    for (seed, right) in [(12, 0), (13, 1)] {
        let mut rng = Rng::new(seed);
        let (copies, sources) = (clique(1500, [0.0; 3], &mut rng), noise(1500, [0.0; 3], &mut rng));
        let pairs: Vec<Pair> = copies
            .into_iter()
            .zip(sources)
            .flat_map(
                |((p, q), (wrong, _))| if right == 0 { [(p, q), (wrong, q)] } else { [(wrong, q), (p, q)] },
            )
            .collect();
        let test = naive::EdgeTest { tau: 0.01, ..TEST };
        let graph = graph_of(&pairs, &test, MAX_DEGREE);
        assert_about((right..3000).step_by(2).filter(|&id| graph.node(id).is_some()).count(), MAX_DEGREE);
        assert!(num_ends(&graph) <= 2 * graph.len() * MAX_DEGREE as usize);
    }
}

fn nodes_ids(graph: &Graph) -> Vec<u32> {
    (0..graph.len() as u32).map(|node| graph.id(node)).collect()
}

proptest! {
    // Leaving out the dead is the same as never having had them.
    #[test]
    fn the_dead_are_no_nodes(pairs in correspondences(0..120), tau in 0.3..5.0, max_length in 2.0..40.0, every in 1..5_u32) {
        let test = naive::EdgeTest { tau, min_length: 0.1, max_length, normal_tolerance: 0.3 };
        let is_alive = |id: u32| !id.is_multiple_of(every);
        let columns = columns(&pairs);
        let graph = Graph::new(&columns, None, &edge_test(&test, u32::MAX), is_alive, || false);
        let mut ids = nodes_ids(&graph);
        ids.sort_unstable();
        prop_assert_eq!(&ids, &(0..pairs.len() as u32).filter(|&id| is_alive(id)).collect::<Vec<_>>());
        prop_assert!(!graph.is_sample());
        check_graph(&graph, &pairs, &test);
    }
}

#[test]
fn a_sample_leaves_about_as_many_in_the_vicinity_and_is_the_graph_of_its_nodes() {
    let mut rng = Rng::new(21);
    // A crowd and a few by themselves, far apart.
    let pairs = [clique(1500, [0.0; 3], &mut rng), clique(40, [50.0, 0.0, 0.0], &mut rng)].concat();
    let sampled = |max_vicinity| {
        let test = EdgeTest { max_vicinity, ..edge_test(&TEST, u32::MAX) };
        Graph::new(&columns(&pairs), None, &test, |_| true, || false)
    };
    for max_vicinity in [64, 256, 1000] {
        let graph = sampled(max_vicinity);
        assert!(graph.is_sample());
        check_graph(&graph, &pairs, &TEST);
        let ids = nodes_ids(&graph);
        assert_eq!(ids.iter().filter(|&&id| id >= 1500).count(), 40, "those by themselves are all kept");
        // All of the crowd lie around each of it, but for those at its rim.
        let num = ids.len() - 40;
        let expected = max_vicinity as usize;
        assert!((expected * 9 / 10..2 * expected).contains(&num), "{num} for {max_vicinity}");
    }
    let whole = sampled(1500);
    assert!(!whole.is_sample());
    assert_eq!(whole.len(), pairs.len());
}
