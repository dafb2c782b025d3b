//! The nearest of many descriptors, exactly.
//!
//! Distances in 33 dimensions and more give a tree little to leave out on its way down, and each step down is a branch.
//! Here the rows are sorted into leaves of sixteen like ones, each within a ball. All balls are looked at, which is a
//! sixteenth of the work, and then the rows of those that can hold something nearer, sixteen side by side.

use std::ops::Range;

use super::{Descriptors, FeatureError};
use crate::interrupt::Interrupt;
use crate::kernels::par;
use crate::kernels::simd::simd;

/// Rows of a leaf, and what is treated side by side.
const LANES: usize = 16;

/// No more rows than this are sorted by one thread alone.
const SERIAL: usize = 4096;

/// Sixteen columns side by side, a vector for each dimension.
type Block = Vec<[f32; LANES]>;

/// Descriptors, sorted into leaves.
pub(super) struct Leaves<'a> {
    rows: Descriptors<'a>,
    /// The dimensions, those of most spread first: what is far is soon seen to be.
    axes: Vec<u32>,
    /// The row in each lane of each leaf; the last leaf may be short.
    order: Vec<u32>,
    /// The rows of each leaf as columns; infinity where it is short.
    columns: Block,
    /// The middles of each sixteen leaves.
    middles: Block,
    /// The radius of the ball of each leaf; whole blocks.
    radii: Vec<f32>,
    /// How much a sum of squares in `f32` may be off, relative.
    rounding: f32,
}

/// A row and its squared distance. The nearest first, of equally near ones that of the lower row.
pub(super) type Hit = (f64, u32);

/// What a thread needs beside the leaves.
#[derive(Default)]
struct Search {
    /// The query in the order of the axes.
    query: Vec<f32>,
    bounds: Vec<f32>,
    hits: Vec<Hit>,
}

impl<'a> Leaves<'a> {
    /// Large tables take seconds, hence the token.
    pub(super) fn new(rows: Descriptors<'a>, interrupt: &Interrupt) -> Result<Self, FeatureError> {
        let dim = rows.dim;
        let mut order: Vec<u32> = (0..rows.len() as u32).collect();
        let variances = variances(&rows, &order);
        let mut axes: Vec<u32> = (0..dim as u32).collect();
        axes.sort_by(|&a, &b| variances[b as usize].total_cmp(&variances[a as usize]));
        split(&rows, &mut order, interrupt);
        let count = order.len().div_ceil(LANES);
        let (mut centres, mut radii) = (Vec::new(), Vec::new());
        for leaf in order.chunks(LANES) {
            if interrupt.is_set() {
                return Err(FeatureError::Interrupted);
            }
            let mean = |d: usize| leaf.iter().map(|&row| f64::from(rows.row(row)[d])).sum::<f64>();
            let centre: Vec<f32> = (0..dim).map(|d| (mean(d) / leaf.len() as f64) as f32).collect();
            let farthest = leaf.iter().map(|&row| dist_sq(rows.row(row), &centre)).fold(0.0, f64::max);
            // Rounded up.
            radii.push((farthest.sqrt() * (1.0 + 1e-6)) as f32);
            centres.push(centre);
        }
        let columns = blocks(count, &axes, |at| order.get(at).map(|&row| rows.row(row)));
        let middles = blocks(count.div_ceil(LANES), &axes, |at| centres.get(at).map(Vec::as_slice));
        radii.resize(count.next_multiple_of(LANES), 0.0);
        // A difference, its square and each of `dim` sums are rounded once.
        let rounding = 2.0 * (dim as f32 + 4.0) * 0.5 * f32::EPSILON;
        Ok(Self { rows, axes, order, columns, middles, radii, rounding })
    }

    /// Tells `found` for each of the `queries` the `want` nearest rows, or all if there are no more; of those before the
    /// call was interrupted.
    pub(super) fn nearest(
        &self,
        queries: &Descriptors<'_>,
        run: Range<usize>,
        want: usize,
        interrupt: &Interrupt,
        mut found: impl FnMut(usize, &[Hit]),
    ) {
        let mut search = Search::default();
        simd(
            #[inline(always)]
            || {
                for query in run {
                    // One may take a millisecond.
                    if interrupt.is_set() {
                        return;
                    }
                    self.query(queries.row(query as u32), want, &mut search);
                    found(query, &search.hits);
                }
            },
        );
    }

    #[inline(always)]
    #[allow(clippy::inline_always)] // the body of the loop above
    fn query(&self, query: &[f32], want: usize, search: &mut Search) {
        let dim = self.rows.dim;
        let Search { query: sorted, bounds, hits } = search;
        hits.clear();
        sorted.clear();
        sorted.extend(self.axes.iter().map(|&axis| query[axis as usize]));
        bounds.resize(self.radii.len(), 0.0);
        // Lane by lane, as one after the other each would wait for the one before.
        let (mut first, mut nearest) = ([0; LANES], [f32::INFINITY; LANES]);
        for (block, bounds) in (0_u32..).zip(bounds.chunks_exact_mut(LANES)) {
            let at = block as usize;
            let to_middle = distances(sorted, &self.middles[at * dim..(at + 1) * dim]);
            let radii = &self.radii[at * LANES..(at + 1) * LANES];
            for k in 0..LANES {
                // No row of the leaf is nearer, whatever was rounded.
                let gap = (to_middle[k].sqrt() * (1.0 - self.rounding) - radii[k]).max(0.0);
                bounds[k] = gap * gap * (1.0 - self.rounding);
                let is_nearer = to_middle[k] < nearest[k];
                nearest[k] = if is_nearer { to_middle[k] } else { nearest[k] };
                first[k] = if is_nearer { block } else { first[k] };
            }
        }
        let leaves = self.order.len().div_ceil(LANES);
        let lane = (1..LANES).fold(0, |best, k| if nearest[k] < nearest[best] { k } else { best });
        let first = first[lane] as usize * LANES + lane;
        if first < leaves {
            self.look(query, sorted, first, want, hits);
        }
        let mut limit = self.limit(hits, want);
        for (leaf, &bound) in bounds[..leaves].iter().enumerate() {
            if bound <= limit && leaf != first {
                self.look(query, sorted, leaf, want, hits);
                limit = self.limit(hits, want);
            }
        }
    }

    /// A squared distance in `f32` beyond this is of no interest, whatever was rounded.
    #[inline(always)]
    #[allow(clippy::inline_always)]
    fn limit(&self, hits: &[Hit], want: usize) -> f32 {
        let worst = if hits.len() < want { f64::INFINITY } else { hits[want - 1].0 };
        worst as f32 * (1.0 + 2.0 * self.rounding)
    }

    #[inline(always)]
    #[allow(clippy::inline_always)]
    fn look(&self, query: &[f32], sorted: &[f32], leaf: usize, want: usize, hits: &mut Vec<Hit>) {
        let dim = self.rows.dim;
        let limit = self.limit(hits, want);
        let block = &self.columns[leaf * dim..(leaf + 1) * dim];
        let Some(near) = distances_within(sorted, block, limit) else { return };
        let rows = &self.order[leaf * LANES..self.order.len().min((leaf + 1) * LANES)];
        for (&row, &about) in rows.iter().zip(&near) {
            if about <= limit {
                insert((dist_sq(query, self.rows.row(row)), row), want, hits);
            }
        }
    }
}

#[inline(never)] // rare
fn insert(hit: Hit, want: usize, hits: &mut Vec<Hit>) {
    let at = hits.partition_point(|other| (other.0, other.1) < hit);
    if at < want {
        hits.truncate(want - 1);
        hits.insert(at, hit);
    }
}

/// Squared distances from a row to sixteen columns.
#[inline(always)]
#[allow(clippy::inline_always)]
fn distances(query: &[f32], block: &[[f32; LANES]]) -> [f32; LANES] {
    let mut sums = [0.0; LANES];
    for (&x, column) in query.iter().zip(block) {
        for k in 0..LANES {
            let d = x - column[k];
            sums[k] += d * d;
        }
    }
    sums
}

/// The same; `None` as soon as all are seen to be above the limit.
#[inline(always)]
#[allow(clippy::inline_always, clippy::needless_bitwise_bool)] // without branches
fn distances_within(query: &[f32], block: &[[f32; LANES]], limit: f32) -> Option<[f32; LANES]> {
    /// Dimensions between two looks at the sums.
    const STRIDE: usize = 8;
    let mut sums = [0.0; LANES];
    for (query, block) in query.chunks(STRIDE).zip(block.chunks(STRIDE)) {
        let part = distances(query, block);
        let mut is_any_near = false;
        for k in 0..LANES {
            sums[k] += part[k];
            is_any_near |= sums[k] <= limit;
        }
        if !is_any_near {
            return None;
        }
    }
    Some(sums)
}

/// The squared distance of two rows of `f32`, which has no rounding worth a name.
fn dist_sq(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2)).sum()
}

/// Rows as columns, with the axes in their order; infinity where there is no row.
fn blocks<'r>(count: usize, axes: &[u32], row: impl Fn(usize) -> Option<&'r [f32]>) -> Block {
    let mut columns = vec![[f32::INFINITY; LANES]; count * axes.len()];
    for (block, columns) in columns.chunks_exact_mut(axes.len()).enumerate() {
        for lane in 0..LANES {
            let Some(row) = row(block * LANES + lane) else { break };
            for (column, &axis) in columns.iter_mut().zip(axes) {
                column[lane] = row[axis as usize];
            }
        }
    }
    columns
}

/// Sorts rows so that each `LANES` of them are alike: halves them by the dimension of most spread, and again.
fn split(rows: &Descriptors<'_>, order: &mut [u32], interrupt: &Interrupt) {
    if order.len() <= LANES || interrupt.is_set() {
        return;
    }
    let axis = widest(rows, order);
    // Whole leaves on the left.
    let half = (order.len().div_ceil(LANES) / 2) * LANES;
    let value = |row: u32| rows.row(row)[axis];
    order.select_nth_unstable_by(half, |&a, &b| value(a).total_cmp(&value(b)).then(a.cmp(&b)));
    let is_large = order.len() > SERIAL;
    let (low, high) = order.split_at_mut(half);
    let mut low = || split(rows, low, interrupt);
    let mut high = || split(rows, high, interrupt);
    if is_large {
        par::join(low, high);
    } else {
        low();
        high();
    }
}

/// The dimension of the largest variance.
fn widest(rows: &Descriptors<'_>, order: &[u32]) -> usize {
    let variances = variances(rows, order);
    (1..rows.dim).fold(0, |best, d| if variances[d] > variances[best] { d } else { best })
}

/// The variance of each dimension in a sample, up to a factor.
fn variances(rows: &Descriptors<'_>, order: &[u32]) -> Vec<f64> {
    const SAMPLE: usize = 256;
    let (mut sums, mut squares) = (vec![0.0; rows.dim], vec![0.0; rows.dim]);
    let mut n = 0.0;
    for &row in order.iter().step_by(order.len().div_ceil(SAMPLE).max(1)) {
        n += 1.0;
        for (d, &x) in rows.row(row).iter().enumerate() {
            sums[d] += f64::from(x);
            squares[d] += f64::from(x).powi(2);
        }
    }
    (0..rows.dim).map(|d| squares[d] - sums[d] * sums[d] / f64::max(n, 1.0)).collect()
}
