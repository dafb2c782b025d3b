//! The sparse second-order compatibility graph over all correspondences.
//!
//! Two correspondences are joined if a rigid motion could move both: first order, r = | |p_i - p_j| - |q_i - q_j| |
//! below a bound. A wrong pair that is compatible with a right one by chance shares almost no third
//! correspondence with it, so each edge is weighed by what its ends have in common: second order (Chen et al.
//! 2022, SC2-PCR). No edge is longer than the model, which makes the graph local: cost grows with the scene.
//!
//! The nodes stand in the order of a grid over the target points, so that what is joined is near in memory too.

mod find;

use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering};

use nalgebra::{Isometry3, Vector3};

use super::columns::Columns;
use super::par;
pub use find::MAX_CROWD;
use find::{Finder, Places};

/// When two correspondences count as compatible. Lengths in the unit of the columns.
#[derive(Debug, Clone, Copy)]
pub struct EdgeTest {
    /// Largest rigidity r.
    pub tau: f32,
    /// Both lengths must exceed this: neighbours agree with each other whatever the pose.
    pub min_length: f32,
    /// Largest distance of the target points: the diameter of the model plus `tau`.
    pub max_length: f32,
    /// How far the three angles of a pair of oriented points may differ, in cosine.
    pub normal_tolerance: f32,
    /// Whether edges are weighed by what their ends have in common, or by their own rigidity alone.
    pub second_order: bool,
    /// Where correspondences have more neighbours than this, only so many of them become nodes that they have about as
    /// many. Bounds the time (a scene without outliers would be one clique) and the memory.
    pub max_degree: u32,
    /// Where more correspondences than this lie around one, about so many of them become nodes: enough for a first look.
    pub max_vicinity: u32,
}

/// Unit normals at the two points of each correspondence.
#[derive(Debug, Clone)]
pub struct PairNormals {
    /// At p_i.
    pub source: Vec<Vector3<f32>>,
    /// At q_i.
    pub target: Vec<Vector3<f32>>,
    /// Whether the sign of a normal means something (outwards, or towards the camera).
    pub oriented: bool,
}

/// Compressed rows: the neighbours of each node, ascending, and the second-order weight of the edge; which nodes are
/// alive, and the support of each: the sum of its weights to the alive ones.
#[derive(Debug, Default)]
pub struct Graph {
    /// The correspondence of each node.
    ids: Vec<u32>,
    /// The node of each correspondence, or `NONE`.
    nodes: Vec<u32>,
    starts: Vec<usize>,
    /// Where the later neighbours of each node begin.
    middles: Vec<usize>,
    neighbors: Vec<u32>,
    weights: Vec<f32>,
    alive: Vec<bool>,
    support: Vec<f32>,
    /// One more than the seeds that the neighbourhood of a node came to, if they were too few; else 0. Set through a
    /// shared reference, by one thread at a time: the stage that plays the neighbourhoods.
    futile: Vec<AtomicU32>,
    /// Whether some correspondences were left out because of `max_vicinity`.
    is_sample: bool,
}

/// No node.
const NONE: u32 = u32::MAX;

/// Cells of the grid along the longest edge.
const CELLS_PER_LENGTH: f32 = 2.0;

impl Graph {
    /// Builds the graph of those of `pairs` that are alive.
    ///
    /// # Complexity
    /// Time: the pairs of target points within `max_length`, plus, for each edge, the neighbours of one end.
    /// Memory: 8 bytes an edge and direction, of which there are at most about `max_degree` for each correspondence.
    #[must_use]
    pub fn new(
        pairs: &Columns,
        normals: Option<&PairNormals>,
        test: &EdgeTest,
        is_alive: impl Fn(u32) -> bool,
        interrupted: impl Fn() -> bool + Sync,
    ) -> Self {
        let places = Places::new(pairs, test.max_length, test.max_length / CELLS_PER_LENGTH);
        let places = places.filtered(is_alive);
        let num_alive = places.len();
        let places = places.sampled(test.max_vicinity);
        let is_sample = places.len() < num_alive;
        let (ids, mut edges) = Finder { places, normals, test }.find(&interrupted);
        if test.second_order {
            edges.weigh_by_common_neighbors(&interrupted);
        }
        if interrupted() {
            // All that comes is quick without edges.
            edges = Edges { starts: vec![0; edges.starts.len()], neighbors: Vec::new(), weights: Vec::new() };
        }
        let mut graph = edges.mirrored();
        graph.nodes = vec![NONE; pairs.len()];
        for (node, &id) in (0_u32..).zip(&ids) {
            graph.nodes[id as usize] = node;
        }
        graph.ids = ids;
        graph.is_sample = is_sample;
        graph.alive = vec![true; graph.len()];
        graph.futile = (0..graph.len()).map(|_| AtomicU32::new(0)).collect();
        graph.support = par::map(graph.len(), 1024, |node| graph.supported(node as u32));
        graph
    }

    /// Takes the correspondences `ids` out of what is alive. Touches their neighbours only.
    pub fn remove(&mut self, ids: &[u32]) {
        let nodes: Vec<u32> = ids.iter().filter_map(|&id| self.node(id)).collect();
        for &node in &nodes {
            self.alive[node as usize] = false;
        }
        let mut is_touched = vec![false; self.len()];
        for &node in nodes.iter().flat_map(|&node| self.edges(node).0) {
            is_touched[node as usize] = true;
        }
        let touched: Vec<u32> = (0..self.len() as u32).filter(|&node| is_touched[node as usize]).collect();
        // Summed anew, not subtracted: rounding errors must not outlive what caused them.
        let support = par::map(touched.len(), 1024, |t| self.supported(touched[t]));
        for (&node, support) in touched.iter().zip(support) {
            self.support[node as usize] = support;
            *self.futile[node as usize].get_mut() = 0;
        }
    }

    /// Remembers that the neighbourhood of a node came to too few seeds, until one of its members is removed.
    pub fn set_futile(&self, node: u32, num_seeds: u32) {
        self.futile[node as usize].store(num_seeds + 1, Ordering::Relaxed);
    }

    /// The seeds that the neighbourhood of a node came to, if they were too few and nothing has changed since.
    #[must_use]
    pub fn futile(&self, node: u32) -> Option<u32> {
        self.futile[node as usize].load(Ordering::Relaxed).checked_sub(1)
    }

    /// Whether a node is alive.
    #[must_use]
    pub fn is_alive(&self, node: u32) -> bool {
        self.alive[node as usize]
    }

    /// The sum of the weights from a node to its alive neighbours.
    #[must_use]
    pub fn support(&self, node: u32) -> f32 {
        self.support[node as usize]
    }

    /// The support of all nodes.
    #[must_use]
    pub fn supports(&self) -> &[f32] {
        &self.support
    }

    fn supported(&self, node: u32) -> f32 {
        let (neighbors, weights) = self.edges(node);
        // Not `sum`: that of nothing is -0, whose bits are more than those of any support.
        neighbors.iter().zip(weights).fold(0.0, |sum, (&j, &w)| if self.is_alive(j) { sum + w } else { sum })
    }

    /// Whether correspondences were left out because too many others lie around them.
    #[must_use]
    pub fn is_sample(&self) -> bool {
        self.is_sample
    }

    /// Number of nodes.
    #[must_use]
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// Whether there is no node.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }

    /// The correspondence of a node.
    #[must_use]
    pub fn id(&self, node: u32) -> u32 {
        self.ids[node as usize]
    }

    /// The node of a correspondence, if it has become one.
    #[must_use]
    pub fn node(&self, id: u32) -> Option<u32> {
        Some(self.nodes[id as usize]).filter(|&node| node != NONE)
    }

    /// Neighbours of a node and the weights of the edges to them.
    #[must_use]
    pub fn edges(&self, node: u32) -> (&[u32], &[f32]) {
        self.edges_of(self.starts[node as usize]..self.starts[node as usize + 1])
    }

    /// The same of its later neighbours.
    pub(crate) fn later_edges(&self, node: u32) -> (&[u32], &[f32]) {
        self.edges_of(self.middles[node as usize]..self.starts[node as usize + 1])
    }

    fn edges_of(&self, range: Range<usize>) -> (&[u32], &[f32]) {
        (&self.neighbors[range.clone()], &self.weights[range])
    }
}

/// Each edge once, at its lower node: rows of later neighbours, ascending.
struct Edges {
    starts: Vec<usize>,
    neighbors: Vec<u32>,
    weights: Vec<f32>,
}

impl Edges {
    fn len(&self) -> usize {
        self.starts.len() - 1
    }

    fn row(&self, i: usize) -> (Range<usize>, &[u32], &[f32]) {
        let range = self.starts[i]..self.starts[i + 1];
        (range.clone(), &self.neighbors[range.clone()], &self.weights[range])
    }

    /// Second order: w2_ij = w_ij * sum over k of w_ik w_kj.
    fn weigh_by_common_neighbors(&mut self, interrupted: &(impl Fn() -> bool + Sync)) {
        /// Steps of the inner loop that make a part worth its memory, and parts at most. They depend on the graph and
        /// not on the threads: so do the sums.
        const STEPS: usize = 1 << 20;
        const MAX_PARTS: usize = 8;
        let degree = |j: u32| self.starts[j as usize + 1] - self.starts[j as usize];
        let steps: Vec<usize> =
            (0..self.len()).map(|i| self.row(i).1.iter().map(|&j| degree(j)).sum()).collect();
        let total: usize = steps.iter().sum();
        let num_parts = total.div_ceil(STEPS).clamp(1, MAX_PARTS);
        let mut bounds = vec![0];
        let mut sum = 0;
        for (i, steps) in steps.iter().enumerate() {
            sum += steps;
            if sum * num_parts >= total * bounds.len() && bounds.len() < num_parts {
                bounds.push(i + 1);
            }
        }
        bounds.push(self.len());
        let parts =
            par::map(bounds.len() - 1, 1, |part| self.common(bounds[part]..bounds[part + 1], interrupted));
        for (at, weight) in self.weights.iter_mut().enumerate() {
            *weight *= parts.iter().map(|part| part[at]).sum::<f32>();
        }
    }

    /// For each edge the sum of w_ik w_kj over those common neighbours k that make a triangle with it whose lowest node
    /// is one of `lowest`. Each triangle is found once, at its lowest edge, and adds to all its three edges.
    fn common(&self, lowest: Range<usize>, interrupted: &impl Fn() -> bool) -> Vec<f32> {
        let mut common = vec![0.0_f32; self.neighbors.len()];
        // By k, for one i: w_ik, and the sum over j between i and k of w_ij w_jk. Side by side: what is read at random is
        // one place and not two.
        let mut third = vec![[0.0_f32; 2]; self.len()];
        for i in lowest {
            if interrupted() {
                return common;
            }
            let (range, neighbors, weights) = self.row(i);
            for (&k, &w) in neighbors.iter().zip(weights) {
                third[k as usize] = [w, 0.0];
            }
            for (at_ij, (&j, &w_ij)) in range.clone().zip(neighbors.iter().zip(weights)) {
                let (range, ks, w_jks) = self.row(j as usize);
                let mut sum = 0.0;
                for ((&k, &w_jk), common_jk) in ks.iter().zip(w_jks).zip(&mut common[range]) {
                    let [w_ik, between] = &mut third[k as usize];
                    sum += *w_ik * w_jk;
                    *common_jk += w_ij * *w_ik;
                    // Most k are no neighbours of i: a sum that nobody asks for costs less than a wrong guess.
                    *between += w_ij * w_jk;
                }
                common[at_ij] += sum;
            }
            for (at_ik, &k) in range.zip(neighbors) {
                common[at_ik] += third[k as usize][1];
                third[k as usize] = [0.0; 2];
            }
        }
        common
    }

    /// The graph with full rows. Nodes are visited in ascending order, so each row is filled from left to right, its
    /// lower half first.
    fn mirrored(&self) -> Graph {
        let mut degrees: Vec<usize> = self.starts.windows(2).map(|w| w[1] - w[0]).collect();
        for &j in &self.neighbors {
            degrees[j as usize] += 1;
        }
        let mut starts = Vec::with_capacity(degrees.len() + 1);
        starts.push(0);
        for degree in degrees {
            starts.push(starts[starts.len() - 1] + degree);
        }
        let num = 2 * self.neighbors.len();
        let (mut neighbors, mut weights) = (vec![0; num], vec![0.0; num]);
        // Where the next neighbour of each node goes; in the end, where its later ones begin.
        let mut next = starts.clone();
        for i in 0..self.len() {
            let (_, mine, w) = self.row(i);
            let at = next[i];
            neighbors[at..at + mine.len()].copy_from_slice(mine);
            weights[at..at + w.len()].copy_from_slice(w);
            for (&j, &w) in mine.iter().zip(w) {
                let at = &mut next[j as usize];
                (neighbors[*at], weights[*at]) = (i as u32, w);
                *at += 1;
            }
        }
        Graph { starts, middles: next, neighbors, weights, ..Graph::default() }
    }
}

impl PairNormals {
    /// Whether the cosine between the normal at p_i, turned by the pose, and that at q_i is at least `min_cos`.
    #[must_use]
    pub fn agree(&self, i: u32, target_from_source: &Isometry3<f64>, min_cos: f64) -> bool {
        let rotation = target_from_source.rotation.cast::<f32>();
        let cos = (rotation * self.source[i as usize]).dot(&self.target[i as usize]);
        up_to_sign(cos, self.oriented) >= min_cos as f32
    }

    /// Whether n_i.n_j, n_i.d and n_j.d agree on both sides, d being the unit vector from i to j: all that a
    /// rigid motion keeps of two oriented points beside their distance (Drost et al. 2010 use them as a feature).
    /// Without orientation their magnitudes must. The two are given by correspondence and by their rows in `pairs`.
    fn compatible(
        &self,
        (i, j): (usize, usize),
        (row_i, row_j): (usize, usize),
        pairs: &Columns,
        tolerance: f32,
    ) -> bool {
        let side = |n: &[Vector3<f32>], c: &[Vec<f32>; 3]| {
            let d = Vector3::from([0, 1, 2].map(|axis| c[axis][row_j] - c[axis][row_i])).normalize();
            [n[i].dot(&n[j]), n[i].dot(&d), n[j].dot(&d)].map(|cos| up_to_sign(cos, self.oriented))
        };
        let (p, q) = (side(&self.source, &pairs.p), side(&self.target, &pairs.q));
        p.iter().zip(q).all(|(a, b)| (a - b).abs() <= tolerance)
    }
}

/// A cosine between two normals, or its magnitude where their signs are arbitrary.
pub(crate) fn up_to_sign<T: nalgebra::RealField + Copy>(cos: T, oriented: bool) -> T {
    if oriented { cos } else { cos.abs() }
}
