//! The sparse second-order compatibility graph over all correspondences.
//!
//! Two correspondences are joined if a rigid motion could move both: first order, r = | |p_i - p_j| - |q_i - q_j| |
//! below a bound. A wrong pair that is compatible with a right one by chance shares almost no third
//! correspondence with it, so each edge is weighed by what its ends have in common: second order (Chen et al.
//! 2022, SC2-PCR). No edge is longer than the model, which makes the graph local: cost grows with the scene.

use std::sync::atomic::{AtomicBool, Ordering};

use nalgebra::{Isometry3, Vector3};

use super::columns::Columns;
use super::grid::Grid;
use super::par;

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

/// Compressed rows: the neighbours of each correspondence, ascending, and the second-order weight of the edge;
/// which correspondences are alive, and the support of each: the sum of its weights to the alive ones.
#[derive(Debug, Default)]
pub struct Graph {
    starts: Vec<usize>,
    neighbors: Vec<u32>,
    weights: Vec<f32>,
    alive: Vec<bool>,
    support: Vec<f32>,
    /// Set through a shared reference, by one thread at a time: the stage that plays the neighbourhoods.
    futile: Vec<AtomicBool>,
}

impl Graph {
    /// Builds the graph of `pairs`.
    ///
    /// # Complexity
    /// Time: the pairs of target points within `max_length`, plus, for each edge, the neighbours of one end.
    /// Memory: 8 bytes an edge and direction.
    #[must_use]
    pub fn new(
        pairs: &Columns,
        normals: Option<&PairNormals>,
        test: &EdgeTest,
        interrupted: impl Fn() -> bool + Sync,
    ) -> Self {
        let mut graph = Self::first_order(pairs, normals, test, &interrupted);
        if test.second_order {
            graph.weights = graph.second_order(&interrupted);
        }
        graph.alive = vec![true; graph.len()];
        graph.futile = (0..graph.len()).map(|_| AtomicBool::new(false)).collect();
        graph.support = par::map(graph.len(), 64, |i| graph.supported(i as u32));
        graph
    }

    /// Takes `ids` out of what is alive. Touches their neighbours only.
    pub fn remove(&mut self, ids: &[u32]) {
        for &i in ids {
            self.alive[i as usize] = false;
        }
        let mut touched: Vec<u32> = ids.iter().flat_map(|&i| self.edges(i).0).copied().collect();
        touched.sort_unstable();
        touched.dedup();
        // Summed anew, not subtracted: rounding errors must not outlive what caused them.
        let support = par::map(touched.len(), 64, |t| self.supported(touched[t]));
        for (&i, support) in touched.iter().zip(support) {
            self.support[i as usize] = support;
            *self.futile[i as usize].get_mut() = false;
        }
    }

    /// Remembers that the neighbourhood of i came to nothing, until one of its members is removed.
    pub fn set_futile(&self, i: u32) {
        self.futile[i as usize].store(true, Ordering::Relaxed);
    }

    /// Whether the neighbourhood of i came to nothing and has not changed since.
    #[must_use]
    pub fn is_futile(&self, i: u32) -> bool {
        self.futile[i as usize].load(Ordering::Relaxed)
    }

    /// Whether i is alive.
    #[must_use]
    pub fn is_alive(&self, i: u32) -> bool {
        self.alive[i as usize]
    }

    /// The sum of the weights from i to its alive neighbours.
    #[must_use]
    pub fn support(&self, i: u32) -> f32 {
        self.support[i as usize]
    }

    fn supported(&self, i: u32) -> f32 {
        let (neighbors, weights) = self.edges(i);
        neighbors.iter().zip(weights).filter(|&(&j, _)| self.is_alive(j)).map(|(_, &w)| w).sum()
    }

    /// Number of correspondences.
    #[must_use]
    pub fn len(&self) -> usize {
        self.starts.len().saturating_sub(1)
    }

    /// Whether there is no correspondence.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Neighbours of i and the weights of the edges to them.
    #[must_use]
    pub fn edges(&self, i: u32) -> (&[u32], &[f32]) {
        let range = self.starts[i as usize]..self.starts[i as usize + 1];
        (&self.neighbors[range.clone()], &self.weights[range])
    }

    /// Edges weighed by w_ij = 1 - (r / tau)^2.
    fn first_order(
        pairs: &Columns,
        normals: Option<&PairNormals>,
        test: &EdgeTest,
        interrupted: &(impl Fn() -> bool + Sync),
    ) -> Self {
        let grid = Grid::new(&pairs.q, test.max_length);
        let sorted = pairs.gather(grid.order());
        let rows = par::map(pairs.len(), 16, |i| {
            let (p, q) = pairs.pair(i);
            let mut row = Vec::new();
            if interrupted() {
                return row;
            }
            for run in grid.around(q) {
                sorted.for_compatible(run, p, q, test, |at, weight| {
                    let j = grid.order()[at];
                    let fits = |n: &PairNormals| n.compatible(i, j as usize, pairs, test.normal_tolerance);
                    if normals.is_none_or(fits) {
                        row.push((j, weight));
                    }
                });
            }
            row.sort_unstable_by_key(|&(j, _)| j);
            row
        });
        let mut starts = vec![0];
        starts.extend(rows.iter().scan(0, |sum, row| {
            *sum += row.len();
            Some(*sum)
        }));
        let (neighbors, weights) = rows.into_iter().flatten().unzip();
        Self { starts, neighbors, weights, ..Self::default() }
    }

    /// w2_ij = w_ij * sum over k of w_ik w_kj, edge by edge.
    fn second_order(&self, interrupted: &(impl Fn() -> bool + Sync)) -> Vec<f32> {
        /// Rows that share one dense scratch row.
        const BLOCK: usize = 64;
        let n = self.len();
        let blocks = par::map(n.div_ceil(BLOCK), 1, |block| {
            let mut dense = vec![0.0_f32; n];
            let mut out = Vec::new();
            for i in block * BLOCK..((block + 1) * BLOCK).min(n) {
                let (neighbors, weights) = self.edges(i as u32);
                if interrupted() {
                    out.resize(out.len() + neighbors.len(), 0.0);
                    continue;
                }
                for (&k, &w) in neighbors.iter().zip(weights) {
                    dense[k as usize] = w;
                }
                for (&j, &w) in neighbors.iter().zip(weights) {
                    let (theirs, w_kj) = self.edges(j);
                    let common: f32 = theirs.iter().zip(w_kj).map(|(&k, &w)| dense[k as usize] * w).sum();
                    out.push(w * common);
                }
                for &k in neighbors {
                    dense[k as usize] = 0.0;
                }
            }
            out
        });
        blocks.into_iter().flatten().collect()
    }
}

impl Columns {
    /// Calls `found(at, weight)` for each pair `at` of `run` that is compatible with (p, q).
    fn for_compatible(
        &self,
        run: std::ops::Range<usize>,
        p: [f32; 3],
        q: [f32; 3],
        test: &EdgeTest,
        mut found: impl FnMut(usize, f32),
    ) {
        /// Weights computed at a time: few of them are positive, so they are looked through afterwards.
        const CHUNK: usize = 64;
        let inv_tau = 1.0 / test.tau;
        let mut weights = [0.0_f32; CHUNK];
        for start in run.clone().step_by(CHUNK) {
            let n = CHUNK.min(run.end - start);
            let [px, py, pz] = self.p.each_ref().map(|c| &c[start..start + n]);
            let [qx, qy, qz] = self.q.each_ref().map(|c| &c[start..start + n]);
            let out = &mut weights[..n];
            for i in 0..n {
                let a = norm(px[i] - p[0], py[i] - p[1], pz[i] - p[2]);
                let b = norm(qx[i] - q[0], qy[i] - q[1], qz[i] - q[2]);
                let u = (a - b) * inv_tau;
                let fine = a > test.min_length && b > test.min_length && b < test.max_length;
                out[i] = if fine { 1.0 - u * u } else { 0.0 };
            }
            for (i, &weight) in out.iter().enumerate() {
                if weight > 0.0 {
                    found(start + i, weight);
                }
            }
        }
    }
}

#[inline(always)]
#[allow(clippy::inline_always)] // the body of a loop that must vectorise
fn norm(x: f32, y: f32, z: f32) -> f32 {
    (x * x + y * y + z * z).sqrt()
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
    /// Without orientation their magnitudes must.
    fn compatible(&self, i: usize, j: usize, pairs: &Columns, tolerance: f32) -> bool {
        let side = |n: &[Vector3<f32>], c: &[Vec<f32>; 3]| {
            let d = Vector3::new(c[0][j] - c[0][i], c[1][j] - c[1][i], c[2][j] - c[2][i]).normalize();
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
