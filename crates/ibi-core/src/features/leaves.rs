//! The nearest of many descriptors, exactly.
//!
//! Distances in 33 dimensions and more give a tree little to leave out on its way down, and each step down is a branch.
//! Here the rows are sorted into leaves of sixteen like ones, each within a ball. All balls are looked at, which is a
//! sixteenth of the work, and then the rows of those that can hold something nearer, sixteen side by side. Several queries
//! go through the leaves together, as a leaf that is fetched for one is then at hand for all.

use std::ops::Range;

use super::{Descriptors, FeatureError};
use crate::interrupt::Interrupt;
use crate::kernels::par;
use crate::kernels::simd::{Simd, WithSimd, bytemuck, dispatch};

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

/// Queries that go through the leaves together.
const TOGETHER: usize = 64;

/// Queries that are held against a leaf side by side: their sums stay in registers.
const TILE: usize = 4;

/// What a thread needs beside the leaves.
struct Search {
    /// The queries in the order of the axes, one behind the other.
    sorted: Vec<f32>,
    /// What no row of a leaf is nearer than, squared: the queries of each leaf side by side.
    bounds: Vec<[f32; TOGETHER]>,
    /// Beyond this a squared distance is of no interest to a query.
    limits: [f32; TOGETHER],
    /// The leaf that a query has looked at already.
    first: [u32; TOGETHER],
    hits: Vec<Vec<Hit>>,
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
        let mut search = Search {
            sorted: Vec::new(),
            bounds: vec![[0.0; TOGETHER]; self.radii.len()],
            limits: [0.0; TOGETHER],
            first: [0; TOGETHER],
            hits: vec![Vec::new(); TOGETHER],
        };
        for begin in run.clone().step_by(TOGETHER) {
            let some = begin..run.end.min(begin + TOGETHER);
            let is_whole = dispatch(Together {
                leaves: self,
                queries,
                some: some.clone(),
                want,
                interrupt,
                search: &mut search,
            });
            if !is_whole {
                return;
            }
            for (query, hits) in some.zip(&search.hits) {
                found(query, hits);
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

    /// Takes in what is near of a leaf, by the squared distances in `f32`.
    #[inline(always)]
    #[allow(clippy::inline_always)]
    fn take(
        &self,
        query: &[f32],
        leaf: usize,
        near: &[f32; LANES],
        limit: f32,
        want: usize,
        hits: &mut Vec<Hit>,
    ) {
        let rows = &self.order[leaf * LANES..self.order.len().min((leaf + 1) * LANES)];
        for (&row, &about) in rows.iter().zip(near) {
            if about <= limit {
                insert((dist_sq(query, self.rows.row(row)), row), want, hits);
            }
        }
    }
}

/// Some queries on their way through the leaves; whether they came to the end.
struct Together<'s, 'l, 'q> {
    leaves: &'s Leaves<'l>,
    queries: &'s Descriptors<'q>,
    some: Range<usize>,
    want: usize,
    interrupt: &'s Interrupt,
    search: &'s mut Search,
}

impl WithSimd for Together<'_, '_, '_> {
    type Output = bool;

    #[inline(always)]
    #[allow(clippy::inline_always)] // compiled for the vector units at hand
    fn with_simd<S: Simd>(self, simd: S) -> bool {
        let Self { leaves, queries, some, want, interrupt, search } = self;
        let (dim, num_leaves) = (leaves.rows.dim, leaves.order.len().div_ceil(LANES));
        let Search { sorted, bounds, limits, first, hits } = search;
        sorted.clear();
        for query in some.clone() {
            let row = queries.row(query as u32);
            sorted.extend(leaves.axes.iter().map(|&axis| row[axis as usize]));
        }
        for (at, query) in some.clone().enumerate() {
            if interrupt.is_set() {
                return false;
            }
            let mine = &sorted[at * dim..(at + 1) * dim];
            let nearest = leaves.bound(simd, mine, at, bounds);
            hits[at].clear();
            first[at] = nearest as u32;
            if nearest < num_leaves {
                let block = &leaves.columns[nearest * dim..(nearest + 1) * dim];
                let [near] = distances(simd, [mine], block);
                leaves.take(queries.row(query as u32), nearest, &near, f32::INFINITY, want, &mut hits[at]);
            }
            limits[at] = leaves.limit(&hits[at], want);
        }
        limits[some.len()..].fill(-1.0);
        let mut asking = [0; TOGETHER];
        for (leaf, bounds) in bounds[..num_leaves].iter().enumerate() {
            // One may take a few microseconds.
            if leaf % 64 == 0 && interrupt.is_set() {
                return false;
            }
            let mut count = 0;
            for at in 0..TOGETHER {
                asking[count] = at;
                count += usize::from(bounds[at] <= limits[at]);
            }
            let block = &leaves.columns[leaf * dim..(leaf + 1) * dim];
            for tile in asking[..count].chunks(TILE) {
                // A short tile asks for its last query again.
                let of_tile: [usize; TILE] = std::array::from_fn(|k| tile[k.min(tile.len() - 1)]);
                let mine = of_tile.map(|at| &sorted[at * dim..(at + 1) * dim]);
                let limit = of_tile.map(|at| limits[at]);
                let Some(near) = distances_within(simd, mine, block, limit) else { continue };
                for (&at, near) in tile.iter().zip(&near) {
                    if first[at] as usize != leaf {
                        let row = queries.row((some.start + at) as u32);
                        leaves.take(row, leaf, near, limits[at], want, &mut hits[at]);
                        limits[at] = leaves.limit(&hits[at], want);
                    }
                }
            }
        }
        true
    }
}

impl Leaves<'_> {
    /// Notes what no row of each leaf is nearer to a query than; returns the leaf whose middle is nearest.
    #[inline(always)]
    #[allow(clippy::inline_always)]
    fn bound<S: Simd>(&self, simd: S, sorted: &[f32], at: usize, bounds: &mut [[f32; TOGETHER]]) -> usize {
        let dim = self.rows.dim;
        // Lane by lane, as one after the other each would wait for the one before.
        let (mut first, mut nearest) = ([0; LANES], [f32::INFINITY; LANES]);
        for (block, bounds) in bounds.chunks_exact_mut(LANES).enumerate() {
            let [to_middle] = distances(simd, [sorted], &self.middles[block * dim..(block + 1) * dim]);
            let radii = &self.radii[block * LANES..(block + 1) * LANES];
            for k in 0..LANES {
                // No row of the leaf is nearer, whatever was rounded.
                let gap = (to_middle[k].sqrt() * (1.0 - self.rounding) - radii[k]).max(0.0);
                bounds[k][at] = gap * gap * (1.0 - self.rounding);
                let is_nearer = to_middle[k] < nearest[k];
                nearest[k] = if is_nearer { to_middle[k] } else { nearest[k] };
                first[k] = if is_nearer { block } else { first[k] };
            }
        }
        let lane = (1..LANES).fold(0, |best, k| if nearest[k] < nearest[best] { k } else { best });
        first[lane] * LANES + lane
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

/// Sums of a tile: sixteen lanes of each query, in as many vectors as they take; the others are not used.
type Sums<S, const N: usize> = [[<S as Simd>::f32s; LANES]; N];

/// Squared distances from some rows to sixteen columns.
#[inline(always)]
#[allow(clippy::inline_always)]
fn distances<S: Simd, const N: usize>(
    simd: S,
    queries: [&[f32]; N],
    block: &[[f32; LANES]],
) -> [[f32; LANES]; N] {
    let mut sums = [[simd.splat_f32s(0.0); LANES]; N];
    add(simd, &mut sums, queries, block);
    written::<S, N>(&sums)
}

/// The same; `None` as soon as all are seen to be above their limits.
#[inline(always)]
#[allow(clippy::inline_always)]
fn distances_within<S: Simd, const N: usize>(
    simd: S,
    queries: [&[f32]; N],
    block: &[[f32; LANES]],
    limits: [f32; N],
) -> Option<[[f32; LANES]; N]> {
    /// Dimensions between two looks at the sums.
    const STRIDE: usize = 8;
    let mut sums = [[simd.splat_f32s(0.0); LANES]; N];
    let limits = limits.map(|limit| simd.splat_f32s(limit));
    for begin in (0..block.len()).step_by(STRIDE) {
        let run = begin..block.len().min(begin + STRIDE);
        add(simd, &mut sums, queries.map(|query| &query[run.clone()]), &block[run]);
        let mut least = [simd.splat_f32s(f32::INFINITY); N];
        for (least, sums) in least.iter_mut().zip(&sums) {
            for sum in &sums[..LANES / S::F32_LANES] {
                *least = simd.min_f32s(*least, *sum);
            }
        }
        let mut is_any_near = simd.less_than_or_equal_f32s(least[0], limits[0]);
        for n in 1..N {
            is_any_near = simd.or_m32s(is_any_near, simd.less_than_or_equal_f32s(least[n], limits[n]));
        }
        if simd.first_true_m32s(is_any_near) == S::F32_LANES {
            return None;
        }
    }
    Some(written::<S, N>(&sums))
}

/// Adds the squares of some dimensions. Fused or not: what is rounded is looked at again.
#[inline(always)]
#[allow(clippy::inline_always)]
fn add<S: Simd, const N: usize>(
    simd: S,
    sums: &mut Sums<S, N>,
    queries: [&[f32]; N],
    block: &[[f32; LANES]],
) {
    let queries = queries.map(|query| &query[..block.len()]);
    for (d, column) in block.iter().enumerate() {
        let column: &[S::f32s] = bytemuck::cast_slice(column);
        for v in 0..LANES / S::F32_LANES {
            for n in 0..N {
                let off = simd.sub_f32s(simd.splat_f32s(queries[n][d]), column[v]);
                sums[n][v] = simd.mul_add_e_f32s(off, off, sums[n][v]);
            }
        }
    }
}

fn written<S: Simd, const N: usize>(sums: &Sums<S, N>) -> [[f32; LANES]; N] {
    let mut all = [[0.0; LANES]; N];
    for (all, sums) in all.iter_mut().zip(sums) {
        all.copy_from_slice(bytemuck::cast_slice(&sums[..LANES / S::F32_LANES]));
    }
    all
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
