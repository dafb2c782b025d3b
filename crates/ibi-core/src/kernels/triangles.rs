//! The triangles of largest weight in a graph, without listing all of them.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::dense_graph::{DenseGraph, members};

/// What a search for triangles came to.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Triangles {
    /// Ascending nodes of each, largest sum of weights first; of equals the one whose heaviest edge comes first, the
    /// lower nodes first.
    pub heaviest: Vec<[u32; 3]>,
    /// Triangles that were heavy enough and refused.
    pub num_refused: u32,
    /// Whether `max_seen` ended the search: there may be heavier triangles.
    pub capped: bool,
}

/// The `wanted` triangles of the largest sum of weights among those that `keep` keeps.
///
/// Each triangle is found at its heaviest edge, and the heaviest edges come first. So none that is still to come weighs
/// more than three times the edge at hand, and the search ends once that is no more than the lightest of those
/// kept. At most `max_seen` triangles are looked at. `interrupted` is asked before each edge.
///
/// # Complexity
/// O(n^2 + `max_seen` log `wanted`) time at worst; memory 12 bytes an edge and 24 for each triangle wanted.
pub fn heaviest_triangles(
    graph: &DenseGraph,
    wanted: usize,
    max_seen: usize,
    mut keep: impl FnMut([u32; 3]) -> bool,
    interrupted: impl Fn() -> bool,
) -> Triangles {
    let mut found = Triangles::default();
    let mut heap = Heaviest { heap: BinaryHeap::new(), wanted };
    let mut num_seen = 0;
    let mut edges = edges(graph);
    'search: while let Some(edge) = edges.pop() {
        let (bits, Reverse(i), Reverse(j)) = edge;
        let weight = f32::from_bits(bits);
        let bound = (weight + weight + weight).to_bits();
        if !heap.has_room_for(bound) || interrupted() {
            break;
        }
        let common: Vec<u64> =
            graph.neighbors(i).iter().zip(graph.neighbors(j)).map(|(a, b)| a & b).collect();
        for k in members(&common) {
            let (ik, jk) = (edge_key(graph, i, k), edge_key(graph, j, k));
            if ik > edge || jk > edge {
                continue;
            }
            if num_seen == max_seen {
                found.capped = heap.has_room_for(bound);
                break 'search;
            }
            num_seen += 1;
            // In one order, so that rounding is monotone: no sum exceeds the bound above.
            let sum = (weight + f32::from_bits(ik.0.max(jk.0))) + f32::from_bits(ik.0.min(jk.0));
            if !heap.has_room_for(sum.to_bits()) {
                continue;
            }
            let mut triangle = [i, j, k];
            triangle.sort_unstable();
            if keep(triangle) {
                heap.push((sum.to_bits(), Reverse(num_seen), triangle));
            } else {
                found.num_refused += 1;
            }
        }
    }
    found.heaviest = heap.sorted();
    found
}

/// The heaviest triangles so far, the lightest on top, of equals the later one. Weights are not negative: their bits
/// order them.
struct Heaviest {
    heap: BinaryHeap<Reverse<Found>>,
    wanted: usize,
}

/// The sum of the weights, and when it was found.
type Found = (u32, Reverse<usize>, [u32; 3]);

impl Heaviest {
    fn has_room_for(&self, sum: u32) -> bool {
        self.heap.len() < self.wanted
            || self.heap.peek().is_some_and(|Reverse((lightest, ..))| sum > *lightest)
    }

    fn push(&mut self, triangle: Found) {
        if self.heap.len() == self.wanted {
            self.heap.pop();
        }
        self.heap.push(Reverse(triangle));
    }

    fn sorted(self) -> Vec<[u32; 3]> {
        self.heap.into_sorted_vec().into_iter().map(|Reverse((.., triangle))| triangle).collect()
    }
}

/// Orders edges: by weight, and of equals the lower nodes are the greater.
type Edge = (u32, Reverse<u32>, Reverse<u32>);

fn edge_key(graph: &DenseGraph, i: u32, j: u32) -> Edge {
    (graph.weight(i, j).to_bits(), Reverse(i.min(j)), Reverse(i.max(j)))
}

/// All edges, as a heap: most searches end after a few, and need not sort the rest.
fn edges(graph: &DenseGraph) -> BinaryHeap<Edge> {
    let nodes = 0..graph.len() as u32;
    let later = |i: u32| members(graph.neighbors(i)).filter(move |&j| j > i);
    nodes.flat_map(|i| later(i).map(move |j| edge_key(graph, i, j))).collect::<Vec<_>>().into()
}
