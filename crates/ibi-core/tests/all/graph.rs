//! The compatibility graph and the grid under it: naive twins, and the laws that hold whatever the data.

use std::collections::HashSet;

use ibi_core::kernels::columns::Columns;
use ibi_core::kernels::graph::{EdgeTest, Graph, PairNormals};
use ibi_core::kernels::grid::Grid;
use ibi_core::kernels::par::Pool;
use ibi_core::nalgebra::{Isometry3, Point3, Vector3};
use ibi_testkit::Rng;
use ibi_testkit::naive::{self, Pair};
use ibi_testkit::strategies::{correspondences, point, points, rigid_motions};
use proptest::prelude::*;

/// Lengths this close to a bound may fall on either side of it.
const UNDECIDED: f64 = 1e-4;

/// Source and target normals of correspondences.
type Normals = (Vec<Vector3<f64>>, Vec<Vector3<f64>>);

/// Normals whose signs mean something, and normals whose signs do not.
const ORIENTED: bool = true;
const UNORIENTED: bool = false;

fn columns(pairs: &[Pair], unit: f64) -> Columns {
    let (source, target): (Vec<_>, Vec<_>) = pairs.iter().copied().unzip();
    Columns::new(&source, &target, unit)
}

/// The graph of `pairs` as the kernel has it, columns being in multiples of `unit`.
fn graph_of(pairs: &[Pair], normals: Option<(&Normals, bool)>, test: &naive::EdgeTest, unit: f64) -> Graph {
    graph_with(pairs, normals, test, unit, true)
}

fn graph_with(
    pairs: &[Pair],
    normals: Option<(&Normals, bool)>,
    test: &naive::EdgeTest,
    unit: f64,
    second_order: bool,
) -> Graph {
    let cast = |normals: &[Vector3<f64>]| normals.iter().map(|n| n.cast::<f32>()).collect();
    let normals =
        normals.map(|((p, q), oriented)| PairNormals { source: cast(p), target: cast(q), oriented });
    let test = EdgeTest {
        tau: (test.tau / unit) as f32,
        min_length: (test.min_length / unit) as f32,
        max_length: (test.max_length / unit) as f32,
        normal_tolerance: test.normal_tolerance as f32,
        second_order,
        max_degree: u32::MAX,
        max_vicinity: u32::MAX,
    };
    Graph::new(&columns(pairs, unit), normals.as_ref(), &test, |_| true, || false)
}

/// By how much the angles of i and j pass, and how exactly `f32` knows it: the shorter the line between two
/// points, the less its direction is worth.
fn angle_margin(
    pairs: &[Pair],
    ((n, m), oriented): (&Normals, bool),
    (i, j): (usize, usize),
    tolerance: f64,
) -> (f64, f64) {
    let ((p, q), (p2, q2)) = (&pairs[i], &pairs[j]);
    let sides = [naive::angles((p, &n[i]), (p2, &n[j])), naive::angles((q, &m[i]), (q2, &m[j]))];
    let [here, there] = sides.map(|cos| if oriented { cos } else { cos.map(f64::abs) });
    let worst = here.iter().zip(there).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    (tolerance - worst, UNDECIDED + 1e-5 / (p - p2).norm().min((q - q2).norm()))
}

/// The node of a correspondence; every one is a node here.
fn node(graph: &Graph, id: u32) -> u32 {
    graph.node(id).unwrap()
}

/// The neighbours of a correspondence, ascending, and the weights of the edges to them.
fn edges(graph: &Graph, id: u32) -> (Vec<u32>, Vec<f32>) {
    let (neighbors, weights) = graph.edges(node(graph, id));
    assert_eq!(neighbors.len(), weights.len());
    assert!(neighbors.windows(2).all(|w| w[0] < w[1]), "not ascending, or twice: {neighbors:?}");
    let mut row: Vec<_> = neighbors.iter().map(|&node| graph.id(node)).zip(weights.iter().copied()).collect();
    row.sort_unstable_by_key(|&(id, _)| id);
    row.into_iter().unzip()
}

fn support(graph: &Graph, id: u32) -> f32 {
    graph.support(node(graph, id))
}

/// For each correspondence its neighbours, the bits of their weights, and those of its support.
fn bits(graph: &Graph) -> Vec<(Vec<u32>, Vec<u32>, u32)> {
    let row = |id| {
        let (neighbors, weights) = edges(graph, id);
        (neighbors, weights.iter().map(|w| w.to_bits()).collect(), support(graph, id).to_bits())
    };
    (0..graph.len() as u32).map(row).collect()
}

/// Holds `graph` against the definition, on `pairs` or on what a rigid motion made of them.
fn check_graph(graph: &Graph, pairs: &[Pair], normals: Option<(&Normals, bool)>, test: &naive::EdgeTest) {
    let n = pairs.len();
    assert_eq!((graph.len(), graph.is_empty()), (n, n == 0));
    let rows: Vec<HashSet<u32>> = (0..n as u32).map(|i| edges(graph, i).0.into_iter().collect()).collect();
    for i in 0..n {
        let (neighbors, weights) = edges(graph, i as u32);
        for j in 0..n {
            let joined = rows[i].contains(&(j as u32));
            assert_eq!(joined, rows[j].contains(&(i as u32)));
            let (a, b) = (&pairs[i], &pairs[j]);
            if a.0 == b.0 || a.1 == b.1 {
                assert!(!joined, "{i} {j} share a point");
                continue;
            }
            let margin = naive::edge_margin(a, b, test);
            let (turn, doubt) = normals.map_or((f64::INFINITY, 0.0), |normals| {
                angle_margin(pairs, normals, (i, j), test.normal_tolerance)
            });
            if margin > UNDECIDED && turn > doubt {
                assert!(joined, "{i} {j} {margin} {turn}");
            } else if margin < -UNDECIDED || turn < -doubt {
                assert!(!joined, "{i} {j} {margin} {turn}");
            }
        }
        // The weights follow from the edges, whichever way the undecided ones went.
        for (&j, &w2) in neighbors.iter().zip(&weights) {
            let j = j as usize;
            let weight = |a: usize, b: usize| naive::edge_weight(&pairs[a], &pairs[b], test.tau);
            let common: f64 =
                rows[i].intersection(&rows[j]).map(|&k| weight(i, k as usize) * weight(k as usize, j)).sum();
            let error = (1.0 + n as f64) * (UNDECIDED / test.tau + 1e-6);
            assert!((f64::from(w2) - weight(i, j) * common).abs() <= error, "{i} {j} {w2}");
            let (theirs, back) = edges(graph, j as u32);
            let back = back[theirs.binary_search(&(i as u32)).unwrap()];
            assert!((w2 - back).abs() <= 1e-5 * w2.abs(), "{i} {j}: {w2} one way, {back} the other");
        }
    }
    check_support(graph, &HashSet::new());
}

/// Every support is the sum of the weights to what is alive.
fn check_support(graph: &Graph, removed: &HashSet<u32>) {
    for i in 0..graph.len() as u32 {
        assert_eq!(graph.is_alive(node(graph, i)), !removed.contains(&i));
        let (neighbors, weights) = edges(graph, i);
        let alive = neighbors.iter().zip(&weights).filter(|(j, _)| !removed.contains(j));
        let sum: f64 = alive.map(|(_, &w)| f64::from(w)).sum();
        assert!((f64::from(support(graph, i)) - sum).abs() <= 1e-5 * (1.0 + sum), "{i}");
    }
}

fn tests() -> impl Strategy<Value = naive::EdgeTest> {
    let min_length = prop_oneof![Just(0.0), 0.1..3.0];
    (0.3..5.0, min_length, 2.0..40.0, 0.05..1.0).prop_map(|(tau, min_length, max_length, tolerance)| {
        naive::EdgeTest { tau, min_length, max_length, normal_tolerance: tolerance }
    })
}

/// Correspondences with normals: half of them turned with the pairs by one rotation, the others by any.
fn oriented(count: std::ops::Range<usize>) -> impl Strategy<Value = (Vec<Pair>, Normals)> {
    let draw = (point(), point(), rigid_motions(1.0), rigid_motions(1.0), any::<bool>());
    (rigid_motions(5.0), prop::collection::vec(draw, count)).prop_map(|(pose, draws)| {
        let one = |(p, q, n, m, right): (Point3<f64>, _, Isometry3<f64>, Isometry3<f64>, bool)| {
            let (n, m) = (n * Vector3::z(), m * Vector3::z());
            if right { ((p, pose * p), (n, pose * n)) } else { ((p, q), (n, m)) }
        };
        let (pairs, normals): (Vec<Pair>, Vec<_>) = draws.into_iter().map(one).unzip();
        (pairs, normals.into_iter().unzip())
    })
}

proptest! {
    #[test]
    fn graph_is_its_twin(pairs in correspondences(0..50), test in tests(), unit in 0.1..10.0) {
        check_graph(&graph_of(&pairs, None, &test, unit), &pairs, None, &test);
    }

    #[test]
    fn graph_with_normals_is_its_twin((pairs, normals) in oriented(0..50), test in tests()) {
        for oriented in [ORIENTED, UNORIENTED] {
            let normals = Some((&normals, oriented));
            check_graph(&graph_of(&pairs, normals, &test, 1.0), &pairs, normals, &test);
        }
    }

    #[test]
    fn the_signs_of_unoriented_normals_mean_nothing(
        (pairs, (n, m)) in oriented(0..50), test in tests(), one in prop::collection::vec(any::<bool>(), 50),
        other in prop::collection::vec(any::<bool>(), 50), pose in rigid_motions(1.0), min_cos in 0.0..1.0,
    ) {
        let flipped = |normals: &[Vector3<f64>], flips: &[bool]| -> Vec<_> {
            normals.iter().zip(flips).map(|(n, &flip)| if flip { -n } else { *n }).collect()
        };
        let (here, there) = ((n.clone(), m.clone()), (flipped(&n, &one), flipped(&m, &other)));
        let ask = |normals: &Normals| bits(&graph_of(&pairs, Some((normals, UNORIENTED)), &test, 1.0));
        prop_assert_eq!(ask(&here), ask(&there));

        let cast = |normals: &[Vector3<f64>]| normals.iter().map(|n| n.cast()).collect();
        let agreeing = |(n, m): &Normals, oriented| -> Vec<bool> {
            let normals = PairNormals { source: cast(n), target: cast(m), oriented };
            (0..n.len() as u32).map(|i| normals.agree(i, &pose, min_cos)).collect()
        };
        prop_assert_eq!(agreeing(&here, UNORIENTED), agreeing(&there, UNORIENTED));
        // Where signs count, what agrees one way does not the other.
        let either = agreeing(&here, UNORIENTED);
        let turned = (n.iter().map(|n| -n).collect(), m);
        for ((one, other), either) in agreeing(&here, ORIENTED).into_iter().zip(agreeing(&turned, ORIENTED)).zip(either) {
            prop_assert_eq!(one ^ other, either);
        }
    }

    #[test]
    fn without_second_order_an_edge_weighs_its_own_rigidity(
        (pairs, normals) in oriented(0..50), test in tests(), with_normals: bool,
    ) {
        let normals = with_normals.then_some((&normals, ORIENTED));
        let second = graph_of(&pairs, normals, &test, 1.0);
        let first = graph_with(&pairs, normals, &test, 1.0, false);
        for i in 0..pairs.len() {
            let (neighbors, weights) = edges(&first, i as u32);
            prop_assert_eq!(&neighbors, &edges(&second, i as u32).0);
            for (&j, &w) in neighbors.iter().zip(&weights) {
                let weight = naive::edge_weight(&pairs[i], &pairs[j as usize], test.tau);
                prop_assert!((f64::from(w) - weight).abs() <= UNDECIDED / test.tau + 1e-6, "{w} {weight}");
            }
        }
        check_support(&first, &HashSet::new());
    }

    #[test]
    fn graph_survives_rigid_motion_of_either_side(
        (pairs, (n, m)) in oriented(1..40), test in tests(),
        one in rigid_motions(1e3), other in rigid_motions(1e3),
    ) {
        let moved: Vec<Pair> = pairs.iter().map(|(p, q)| (one * p, other * q)).collect();
        let turned = (n.iter().map(|n| one * n).collect(), m.iter().map(|m| other * m).collect());
        for oriented in [ORIENTED, UNORIENTED] {
            let graph = graph_of(&moved, Some((&turned, oriented)), &test, 1.0);
            check_graph(&graph, &pairs, Some((&(n.clone(), m.clone()), oriented)), &test);
        }
        check_graph(&graph_of(&moved, None, &test, 1.0), &pairs, None, &test);
    }

    #[test]
    fn support_counts_the_alive(
        pairs in correspondences(1..50), test in tests(),
        removals in prop::collection::vec(prop::collection::vec(0..50_u32, 0..12), 1..5),
    ) {
        let mut graph = graph_of(&pairs, None, &test, 1.0);
        let mut removed = HashSet::new();
        for mut ids in removals {
            ids.retain(|&i| (i as usize) < pairs.len()); // some twice, some gone before
            graph.remove(&ids);
            removed.extend(ids);
            check_support(&graph, &removed);
        }
        graph.remove(&(0..pairs.len() as u32).collect::<Vec<_>>());
        prop_assert!((0..pairs.len() as u32).all(|i| !graph.is_alive(node(&graph, i)) && support(&graph, i) == 0.0));
    }
}

/// Pairs of an ordinary scene, true and wrong; its resolution is about 0.2.
fn scene_pairs() -> Vec<Pair> {
    let scene = ibi_testkit::scenes::Recipe { num_outliers: 300, ..Default::default() }.build();
    scene.rows.iter().map(|&[s, t]| (scene.source[s], scene.target[t])).collect()
}

const SCENE_TEST: naive::EdgeTest =
    naive::EdgeTest { tau: 0.2, min_length: 0.2, max_length: 2.7, normal_tolerance: 0.3 };

#[test]
fn true_correspondences_have_the_most_support() {
    let scene = ibi_testkit::scenes::Recipe { num_outliers: 300, ..Default::default() }.build();
    let graph = graph_of(&scene_pairs(), None, &SCENE_TEST, 0.2);
    let support = |right: bool| {
        let ids = (0..).zip(&scene.labels).filter(move |(_, label)| label.is_some() == right);
        ids.map(|(i, _)| support(&graph, i))
    };
    let least_true = support(true).fold(f32::INFINITY, f32::min);
    assert!(support(false).all(|wrong| wrong < least_true));
}

#[test]
fn graph_has_the_same_bits_for_any_number_of_threads() {
    let pairs = scene_pairs();
    let all = || {
        let mut graph = graph_of(&pairs, None, &SCENE_TEST, 0.2);
        let before = bits(&graph);
        graph.remove(&(0..pairs.len() as u32).step_by(3).collect::<Vec<_>>());
        (before, bits(&graph))
    };
    let serial = all();
    assert!(serial.0.iter().map(|row| row.0.len()).sum::<usize>() > 1000, "a graph worth the name");
    for num_threads in [1, 2, 7] {
        assert!(Pool::new(Some(num_threads)).unwrap().install(all) == serial);
    }
}

#[test]
fn an_interrupted_graph_is_empty_but_whole() {
    let test = EdgeTest {
        tau: 1.0,
        min_length: 1.0,
        max_length: 20.0,
        normal_tolerance: 0.3,
        second_order: true,
        max_degree: u32::MAX,
        max_vicinity: u32::MAX,
    };
    let graph = Graph::new(&columns(&scene_pairs(), 0.2), None, &test, |_| true, || true);
    assert_eq!(graph.len(), 400);
    assert!((0..400).all(|i| graph.edges(i).0.is_empty() && support(&graph, i) == 0.0));
}

// ------------------------------------------------------------------------------------------------------- grid

/// Every point within the radius of each point comes up around it, none twice.
fn check_grid(cloud: &[Point3<f64>], radius: f32) {
    let columns: [Vec<f32>; 3] = [0, 1, 2].map(|axis| cloud.iter().map(|p| p[axis] as f32).collect());
    let grid = Grid::new(&columns, radius);
    let at = |i: usize| columns.each_ref().map(|c| c[i]);
    let mut order = grid.order().to_vec();
    order.sort_unstable();
    assert!(order.into_iter().eq(0..cloud.len() as u32), "every point, once");
    for i in 0..cloud.len() {
        let here = Point3::from(at(i)).cast::<f64>();
        let runs: Vec<_> = grid.around(at(i), radius).collect();
        let mut near = HashSet::new();
        for run in runs {
            assert!(run.start <= run.end && run.end <= cloud.len(), "{run:?}");
            assert!(grid.order()[run].iter().all(|&j| near.insert(j)), "a point twice");
        }
        for j in 0..cloud.len() {
            let distance = (Point3::from(at(j)).cast::<f64>() - here).norm();
            assert!(distance > f64::from(radius) || near.contains(&(j as u32)), "{i} {j} {distance}");
        }
    }
}

proptest! {
    #[test]
    fn grid_yields_all_within_the_radius(cloud in points(0..150), radius in 0.001..30.0_f32) {
        check_grid(&cloud, radius);
    }
}

#[test]
fn grid_survives_degenerate_and_huge_clouds() {
    let lattice = |n: usize| (0..n * n).map(move |i| Point3::new((i % n) as f64, (i / n) as f64, 0.25));
    let line = |axis: usize| (0..200).map(move |i| Point3::from(Vector3::ith(axis, f64::from(i) * 0.37)));
    check_grid(&[], 1.0);
    check_grid(&[Point3::new(1.0, -2.0, 3.0)], 1.0);
    check_grid(&vec![Point3::new(1.0, -2.0, 3.0); 100], 1.0);
    check_grid(&lattice(15).collect::<Vec<_>>(), 1.0);
    check_grid(&lattice(15).map(|p| p.xzy()).collect::<Vec<_>>(), 2.0);
    (0..3).for_each(|axis| check_grid(&line(axis).collect::<Vec<_>>(), 1.0));
    // 1e4 radii across: (1e4)^3 cells of one radius would take 4 TB, so cells grow. Neighbours in clusters.
    let mut rng = Rng::new(3);
    let cloud: Vec<_> = (0..60)
        .flat_map(|_| {
            let centre = rng.in_box(5000.0);
            (0..5).map(|_| Point3::from(centre + rng.in_box(0.6))).collect::<Vec<_>>()
        })
        .collect();
    check_grid(&cloud, 1.0);
    check_grid(&cloud, 1e-30);
    check_grid(&cloud, 1e6);
}
