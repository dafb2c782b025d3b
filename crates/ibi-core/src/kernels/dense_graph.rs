//! A graph of few nodes as a matrix: which members of `C_d` are compatible with each other, and how well.

use super::columns::dot;
use super::par;
use super::replicator::Payoffs;
use super::simd::simd;

/// Rows below which a matrix is not worth a second thread.
const GRAIN: usize = 32;

/// An undirected graph: the weight of each two nodes, 0 where no edge joins them, and the same rows as sets of bits.
#[derive(Debug, Clone)]
pub struct DenseGraph {
    weights: Payoffs,
    /// Bits in a row, in words of 64.
    words: usize,
    neighbors: Vec<u64>,
}

impl DenseGraph {
    /// Joins two nodes where their weight is at least `least` and more than 0. The weights are symmetric, their
    /// diagonal is 0.
    ///
    /// # Complexity
    /// O(n^2) time, n^2 / 8 bytes beside the weights.
    #[must_use]
    pub fn new(mut weights: Payoffs, least: f32) -> Self {
        weights.fill(GRAIN, |_, row| {
            for weight in row {
                *weight = if *weight >= least { *weight } else { 0.0 };
            }
        });
        let n = weights.len();
        let words = n.div_ceil(64);
        let mut neighbors = vec![0; n * words];
        for (i, bits) in neighbors.chunks_exact_mut(words.max(1)).enumerate() {
            for (j, &weight) in weights.row(i).iter().enumerate() {
                bits[j / 64] |= u64::from(weight > 0.0) << (j % 64);
            }
        }
        Self { weights, words, neighbors }
    }

    /// The same nodes with weights of second order: w2_ij = w_ij * sum over k of w_ik w_kj (Chen et al. 2022, SC2-PCR),
    /// and no edge below `share` of the largest of them.
    ///
    /// # Complexity
    /// O(n^3) time.
    #[must_use]
    pub fn second_order(&self, share: f32, interrupted: impl Fn() -> bool + Sync) -> Self {
        let first = &self.weights;
        let mut second = Payoffs::zeros(self.len());
        second.fill(GRAIN, |i, row| {
            if interrupted() {
                return;
            }
            simd(
                #[inline(always)]
                || {
                    for (j, (out, &weight)) in row.iter_mut().zip(first.row(i)).enumerate() {
                        if weight > 0.0 {
                            *out = weight * dot(first.padded_row(i), first.padded_row(j));
                        }
                    }
                },
            );
        });
        let rows = par::map(self.len(), GRAIN, |i| second.row(i).iter().copied().fold(0.0, f32::max));
        Self::new(second, share * rows.into_iter().fold(0.0, f32::max))
    }

    /// Number of nodes.
    #[must_use]
    pub fn len(&self) -> usize {
        self.weights.len()
    }

    /// Whether there is no node.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.weights.is_empty()
    }

    /// The weight of the edge from i to j; 0 without one.
    #[must_use]
    pub fn weight(&self, i: u32, j: u32) -> f32 {
        self.weights.row(i as usize)[j as usize]
    }

    /// The neighbours of a node: bit j % 64 of word j / 64.
    #[must_use]
    pub fn neighbors(&self, i: u32) -> &[u64] {
        &self.neighbors[i as usize * self.words..][..self.words]
    }
}

/// The members of a set of bits, ascending.
pub(crate) fn members(bits: &[u64]) -> impl Iterator<Item = u32> + '_ {
    bits.iter().enumerate().flat_map(|(word, &bits)| {
        let mut left = bits;
        std::iter::from_fn(move || {
            let bit = left.trailing_zeros();
            left &= left.wrapping_sub(1);
            (bit < 64).then_some(64 * word as u32 + bit)
        })
    })
}
