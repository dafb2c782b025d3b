//! The nearest point within a reach that is known beforehand: a grid whose cells are as wide.
//!
//! All questions in the rounds are of this kind. A kd-tree, which answers them at any distance, takes many times as
//! long: it walks down a path of branches that no processor foresees, where eight cells are read straight through.

use std::collections::HashSet;
use std::ops::Range;

use nalgebra::{Point3, Vector3};

use super::columns::{columns, middle, min_max};
use super::grid::{Grid, bulk};
use super::par;
use super::rng::Rng;
use super::simd::{Simd, WithSimd, bytemuck, dispatch, simd};

/// How many points are looked at side by side, at most.
const LANES: usize = 16;

/// A cloud, prepared for questions within one reach; ids are the rows of the cloud.
///
/// Distances are compared in `f32`, relative to the middle of the cloud and in multiples of the reach. Of two points
/// whose distances from the query differ by less than 2.5e-7 of the query's distance from the middle, either may be
/// taken for the nearest.
#[derive(Debug)]
pub struct Nearby {
    sorted: Sorted,
    /// With the points that coincide with another one, where there are so many that the first leaves them out.
    all: Option<Sorted>,
    /// With how many others a point shares its cell, with those, on average.
    sharing: usize,
    middle: Vector3<f64>,
    reach: f64,
    inv_reach: f64,
}

/// Where a point shares its cell with more than so many others, on average, cells are narrower than the reach, so that one in
/// the end shares it with no more than the second number. Within the usual reach lie some tens, or a thousand at
/// the ten times as wide reach of the paper's presets.
const MOST_SHARED: usize = 1 << 13;
const SHARED: usize = 64;

/// Cells are not narrower than this part of the cloud: `f32` tells no more places apart.
const LEAST_PART: f32 = 1e-6;

/// Points near a query that a sum is taken over, at most: of more every so many-th stands for all.
const MOST_SUMMED: usize = 1 << 14;

/// No point.
const NONE: u32 = u32::MAX;

impl Nearby {
    /// Prepares `points` for questions within `reach` (> 0).
    ///
    /// # Complexity
    /// O(n) time; 16 bytes a point and at most 16 a point for the cells.
    #[must_use]
    pub fn new(points: &[Point3<f64>], reach: f64) -> Self {
        Self::with_usual(points, reach, reach)
    }

    /// The same where most questions are within `usual`, which is no more than the reach.
    #[must_use]
    pub fn with_usual(points: &[Point3<f64>], reach: f64, usual: f64) -> Self {
        Self::until(points, reach, usual, || false).unwrap_or_else(|| unreachable!("nobody interrupts"))
    }

    /// The same; `None` once `interrupted` says so.
    pub(crate) fn until(
        points: &[Point3<f64>],
        reach: f64,
        usual: f64,
        interrupted: impl Fn() -> bool,
    ) -> Option<Self> {
        if interrupted() {
            return None;
        }
        let middle = middle(points);
        let rows = columns(points, middle, reach);
        let bounds = bounds(&rows);
        let grid = Grid::in_box_until(&rows, bounds, cell_of(reach, usual), &interrupted)?;
        let mut sharing = grid.sharing(&rows);
        let sorted = Sorted::until(&rows, grid, &interrupted)?;
        let mut nearby = Self { sorted, all: None, sharing, middle, reach, inv_reach: 1.0 / reach };
        if sharing > MOST_SHARED {
            let (distinct, kept) = distinct(&rows);
            let widest = bounds.iter().map(|(low, high)| high - low).fold(f32::MIN_POSITIVE, f32::max);
            let mut cell = cell_of(reach, usual).min(widest);
            let mut grid = None;
            while sharing > SHARED && cell > LEAST_PART * widest {
                // They may fill a volume or a surface, or lie in clusters: not too narrow at once.
                cell *= (SHARED as f32 / sharing as f32).cbrt().clamp(0.25, 0.8);
                let finer = Grid::in_box_until(&distinct, bounds, cell, &interrupted)?;
                sharing = finer.sharing(&distinct);
                grid = Some(finer);
            }
            if let Some(grid) = grid {
                let finer = Sorted::of(&distinct, grid, &kept, &interrupted)?;
                let all = std::mem::replace(&mut nearby.sorted, finer);
                nearby.all = (kept.len() < points.len()).then_some(all);
                if nearby.all.is_none() {
                    nearby.sharing = sharing;
                }
            }
        }
        (!interrupted()).then_some(nearby)
    }

    /// With the points that coincide.
    fn all(&self) -> &Sorted {
        self.all.as_ref().unwrap_or(&self.sorted)
    }

    /// The reach, in the unit of the points.
    #[must_use]
    pub fn reach(&self) -> f64 {
        self.reach
    }

    /// The row of the point nearest to `query`, if one lies within the reach.
    #[must_use]
    pub fn nearest(&self, query: &Point3<f64>) -> Option<u32> {
        self.nearest_each(self.reach, std::slice::from_ref(query))[0]
    }

    /// The row of the point nearest to each of `queries`, if one lies within `distance`, up to rounding; it is at most the
    /// reach. Within half the reach it is found in half the time.
    #[must_use]
    pub fn nearest_each(&self, distance: f64, queries: &[Point3<f64>]) -> Vec<Option<u32>> {
        dispatch(NearestEach { nearby: self, bound: self.radius(distance), queries })
    }

    /// Whether any point lies within `distance` of each of `queries`, up to rounding; it is at most the reach. Cheaper than
    /// [`Self::nearest_each`].
    #[must_use]
    pub fn any_within_each(&self, distance: f64, queries: &[Point3<f64>]) -> Vec<bool> {
        dispatch(AnyWithinEach { nearby: self, bound: self.radius(distance), queries })
    }

    /// Rows of the points within `distance` of `query`, up to rounding, in no particular order. The distance may exceed
    /// the reach.
    pub fn within(&self, query: &Point3<f64>, distance: f64) -> impl Iterator<Item = u32> + '_ {
        let (q, radius) = (self.local(query), self.radius(distance));
        let Sorted { grid, points, .. } = self.all();
        let [x, y, z] = points.each_ref().map(Vec::as_slice);
        grid.around(q, radius).flatten().filter_map(move |at| {
            let d = [x[at] - q[0], y[at] - q[1], z[at] - q[2]];
            (d[0] * d[0] + d[1] * d[1] + d[2] * d[2] <= radius * radius).then(|| grid.order()[at])
        })
    }

    /// For each of `queries` the sum of the `values`, one for each row, of [`Self::within`]; where that are more than
    /// 16,384 points or so, about the sum.
    #[must_use]
    pub fn sums_within(&self, distance: f64, queries: &[Point3<f64>], values: &[u32]) -> Vec<u32> {
        self.sums_within_until(distance, queries, values, || false)
    }

    /// [`Self::sums_within`] that asks `interrupted` from time to time; then sums may be 0.
    pub(crate) fn sums_within_until(
        &self,
        distance: f64,
        queries: &[Point3<f64>],
        values: &[u32],
        interrupted: impl Fn() -> bool + Sync + Send,
    ) -> Vec<u32> {
        /// Queries that one thread takes at a time.
        const GRAIN: usize = 512;
        let radius = self.radius(distance);
        let Sorted { grid, points, .. } = self.all();
        let total = values.iter().fold(0_u32, |sum, &value| sum.saturating_add(value));
        let is_crowded = self.may_hold(radius, MOST_SUMMED);
        let bounds = points.each_ref().map(|axis| min_max(&axis[..grid.order().len()]));
        let values: Vec<u32> = grid.order().iter().map(|&row| values[row as usize]).collect();
        let chunks = par::chunks(queries.len(), GRAIN, |run| {
            let mut sums = vec![0; run.len()];
            if interrupted() {
                return sums;
            }
            let (sums_mut, queries) = (&mut sums[..], &queries[run]);
            simd(
                #[inline(always)]
                || {
                    for (sum, query) in sums_mut.iter_mut().zip(queries) {
                        let q = self.local(query);
                        if is_crowded && self.crowding(q, radius) > MOST_SUMMED {
                            if interrupted() {
                                break;
                            }
                            let has_all = farthest(q, &bounds) < 0.999 * radius;
                            *sum = if has_all {
                                total
                            } else {
                                self.strided_sum(q, radius, MOST_SUMMED, |at| values[at])
                            };
                            continue;
                        }
                        grid.each_around(
                            q,
                            radius,
                            #[inline(always)]
                            |run| {
                                let [x, y, z] = points;
                                let points = [&x[run.clone()], &y[run.clone()], &z[run.clone()]];
                                *sum += sum_within(points, &values[run], q, radius * radius);
                            },
                        );
                    }
                },
            );
            sums
        });
        chunks.concat()
    }

    /// Whether more than so many points may lie in the cells around a place.
    fn may_hold(&self, radius: f32, most: usize) -> bool {
        let grid = &self.all().grid;
        let cells = (2.0 * radius / grid.cell_size() + 2.0).powi(3);
        cells * self.sharing as f32 > most as f32
    }

    /// Whether so many points may lie within `distance` of one that not all of them should be looked at for each.
    pub(crate) fn is_crowded(&self, distance: f64) -> bool {
        self.may_hold(self.radius(distance), MOST_SUMMED)
    }

    /// How many points the cells around a query hold.
    #[cold]
    fn crowding(&self, place: [f32; 3], radius: f32) -> usize {
        let mut num = 0;
        self.all().grid.each_around(place, radius, |run| num += run.len());
        num
    }

    /// About the sum of the `values`, one for each row, of [`Self::within`]: of more than `most` points in the cells around, every so many-th
    /// stands for all.
    pub(crate) fn sum_of_some(
        &self,
        query: &Point3<f64>,
        distance: f64,
        most: usize,
        value: impl Fn(u32) -> u32,
    ) -> u32 {
        let order = self.all().grid.order();
        self.strided_sum(self.local(query), self.radius(distance), most, |at| value(order[at]))
    }

    fn strided_sum(&self, place: [f32; 3], radius: f32, most: usize, value: impl Fn(usize) -> u32) -> u32 {
        let Sorted { grid, points, .. } = self.all();
        let step = self.crowding(place, radius).div_ceil(most).max(1);
        let (mut sum, mut skip) = (0_u32, 0);
        grid.each_around(place, radius, |run| {
            let mut at = run.start + skip;
            while at < run.end {
                let d = [0, 1, 2].map(|axis| points[axis][at] - place[axis]);
                let is_within = d[0] * d[0] + d[1] * d[1] + d[2] * d[2] <= radius * radius;
                sum = sum.saturating_add(if is_within { value(at) } else { 0 });
                at += step;
            }
            skip = at - run.end;
        });
        sum.saturating_mul(step as u32)
    }

    /// A distance in the unit of the columns, and a little more, for rounding.
    fn radius(&self, distance: f64) -> f32 {
        (distance * self.inv_reach * (1.0 + 1e-6)) as f32
    }

    #[inline(always)]
    #[allow(clippy::inline_always)] // the head of an inner loop
    fn local(&self, query: &Point3<f64>) -> [f32; 3] {
        let axis = |axis: usize| ((query[axis] - self.middle[axis]) * self.inv_reach) as f32;
        [axis(0), axis(1), axis(2)]
    }

    #[inline(always)]
    #[allow(clippy::inline_always)] // the body of the loop above
    fn row<S: Simd>(
        &self,
        simd: S,
        columns: SortedColumns<'_>,
        query: &Point3<f64>,
        bound: f32,
    ) -> Option<u32> {
        let q = self.local(query);
        let grid = &self.sorted.grid;
        let mut search = Search::new(simd, columns, q, bound * bound);
        for run in grid.block(q) {
            search.look::<false>(run, NONE);
        }
        // Most points of a pose that is right end here: they have a neighbour within half a cell.
        let row = search.row_within(columns.seen); // all that is searched for lies within `bound`
        if bound <= columns.seen || row.is_some() {
            return row;
        }
        grid.each_of_wide_block(
            q,
            #[inline(always)]
            |run| search.look::<false>(run, NONE),
        );
        search.row_within(f32::INFINITY)
    }

    /// Whether the cells around a place hold what lies within `bound` of it, and are known to the grid one and all. All is made
    /// for that.
    fn is_simple(&self, bound: f32) -> bool {
        self.sorted.grid.is_dense() && bound <= 2.0 * SEEN * self.sorted.grid.cell_size()
    }

    /// [`Self::row`] where that is not so.
    #[inline(always)]
    #[allow(clippy::inline_always)] // compiled for the vector units of `simd`
    fn far_row<S: Simd>(&self, simd: S, query: &Point3<f64>, bound: f32) -> Option<u32> {
        let q = self.local(query);
        let grid = &self.sorted.grid;
        let mut search = Search::new(simd, self.sorted.columns(), q, bound * bound);
        let mut radius = SEEN * grid.cell_size() + grid.distance_to_box(q);
        loop {
            grid.each_around(
                q,
                radius.min(bound),
                #[inline(always)]
                |run| search.look::<false>(run, NONE),
            );
            if let Some(row) = search.row_within(if radius >= bound { f32::INFINITY } else { radius }) {
                return Some(row);
            }
            if radius >= bound {
                return None;
            }
            radius *= 2.0;
        }
    }
}

/// The box around the bulk of some points.
fn bounds(rows: &[Vec<f32>; 3]) -> [(f32, f32); 3] {
    rows.each_ref().map(|axis| bulk(axis))
}

/// How wide cells are, in reaches: a cell and its neighbours hold what is usual, and the blocks of two cells an axis half
/// of it for sure.
fn cell_of(reach: f64, usual: f64) -> f32 {
    1.005 * (usual / reach) as f32
}

/// The distance from a place to the farthest corner of a box.
fn farthest(place: [f32; 3], bounds: &[(f32, f32); 3]) -> f32 {
    let far = [0, 1, 2].map(|axis| (place[axis] - bounds[axis].0).max(bounds[axis].1 - place[axis]));
    far.iter().map(|far| far * far).sum::<f32>().sqrt()
}

/// The columns without the points that coincide with one before them, and the rows of those that are left.
fn distinct(rows: &[Vec<f32>; 3]) -> ([Vec<f32>; 3], Vec<u32>) {
    let key = |row: u32| rows.each_ref().map(|axis| axis[row as usize].to_bits());
    let mut sorted: Vec<u32> = (0..rows[0].len() as u32).collect();
    sorted.sort_unstable_by_key(|&row| (key(row), row));
    sorted.dedup_by_key(|row| key(*row));
    sorted.sort_unstable();
    (rows.each_ref().map(|axis| sorted.iter().map(|&row| axis[row as usize]).collect()), sorted)
}

/// The loop of [`Nearby::any_within_each`].
struct AnyWithinEach<'a> {
    nearby: &'a Nearby,
    bound: f32,
    queries: &'a [Point3<f64>],
}

impl WithSimd for AnyWithinEach<'_> {
    type Output = Vec<bool>;

    #[inline(always)]
    #[allow(clippy::inline_always)] // compiled for the vector units of `simd`
    fn with_simd<S: Simd>(self, simd: S) -> Self::Output {
        let Self { nearby, bound, queries } = self;
        let grid = &nearby.sorted.grid;
        let columns = nearby.sorted.columns();
        let mut any = Vec::with_capacity(queries.len());
        if !nearby.is_simple(bound) {
            any.extend(queries.iter().map(|query| nearby.far_row(simd, query, bound).is_some()));
            return any;
        }
        for query in queries {
            let q = nearby.local(query);
            let mut search = Search::new(simd, columns, q, bound * bound);
            for run in grid.block(q) {
                search.look::<false>(run, NONE);
            }
            if bound > columns.seen && !search.has_found(bound) {
                grid.each_of_wide_block(
                    q,
                    #[inline(always)]
                    |run| search.look::<false>(run, NONE),
                );
            }
            any.push(search.has_found(bound));
        }
        any
    }
}

/// The sum of the values of the points within a radius of `place`.
#[inline(always)]
#[allow(clippy::inline_always)] // compiled for the vector units at hand
fn sum_within([x, y, z]: [&[f32]; 3], values: &[u32], place: [f32; 3], radius_sq: f32) -> u32 {
    let n = values.len();
    let (x, y, z) = (&x[..n], &y[..n], &z[..n]);
    let mut sum = 0;
    for i in 0..n {
        let d = [x[i] - place[0], y[i] - place[1], z[i] - place[2]];
        sum += if d[0] * d[0] + d[1] * d[1] + d[2] * d[2] <= radius_sq { values[i] } else { 0 };
    }
    sum
}

/// The loop of [`Nearby::nearest_each`].
struct NearestEach<'a> {
    nearby: &'a Nearby,
    bound: f32,
    queries: &'a [Point3<f64>],
}

impl WithSimd for NearestEach<'_> {
    type Output = Vec<Option<u32>>;

    #[inline(always)]
    #[allow(clippy::inline_always)] // compiled for the vector units of `simd`
    fn with_simd<S: Simd>(self, simd: S) -> Self::Output {
        let mut rows = vec![None; self.queries.len()];
        let columns = self.nearby.sorted.columns();
        if !self.nearby.is_simple(self.bound) {
            for (row, query) in rows.iter_mut().zip(self.queries) {
                *row = self.nearby.far_row(simd, query, self.bound);
            }
            return rows;
        }
        for (row, query) in rows.iter_mut().zip(self.queries) {
            *row = self.nearby.row(simd, columns, query, self.bound);
        }
        rows
    }
}

/// How far apart the points of a cloud are: the mean distance from a point to its nearest *distinct* other point.
///
/// [`mean_spacing`] to the bit, unless
///
/// - more than `FEW_TWINS` of the points have a twin: one nearer than the points of a straight line could be, were they
///   as many and as far spread, by a factor of `TWIN`. Then one of each set of twins counts.
/// - points that lie more than `STRAY` times the median off would more than double it: far pixels of a depth camera.
///   They do not count.
///
/// 0 if all points coincide.
///
/// # Complexity
/// As [`mean_spacing`]; with twins twice that, and O(n) memory.
#[must_use]
pub fn spacing(points: &[Point3<f64>]) -> f64 {
    spacing_until(points, || false).unwrap_or_default()
}

/// [`spacing`]; `None` once `interrupted` says so.
pub(crate) fn spacing_until(
    points: &[Point3<f64>],
    interrupted: impl Fn() -> bool + Sync + Send,
) -> Option<f64> {
    let (all, size) = nearest_distances(points, &interrupted)?;
    // No cloud that hangs together has its points nearer than this: a curve is longer, a surface wider.
    let on_a_line = size / points.len() as f64;
    let have_twins = |distances: &[f64]| {
        let twins = distances.iter().filter(|&&distance| distance <= on_a_line / TWIN).count();
        twins as f64 > FEW_TWINS * distances.len() as f64
    };
    if !have_twins(&all) {
        return Some(mean_without_strays(all));
    }
    let copies = one_of_each(points, |p| [0, 1, 2].map(|axis| (p[axis] + 0.0).to_bits()));
    let (distances, _) = nearest_distances(&copies, &interrupted)?;
    let cell = on_a_line * (MERGED / TWIN);
    if have_twins(&distances) && cell > 0.0 {
        let middle = middle(points);
        // A cast saturates: far strays are one.
        let cell_of = |p: &Point3<f64>, shift: f64| {
            [0, 1, 2].map(|axis| ((p[axis] - middle[axis]) / cell + shift).floor() as i64)
        };
        // Twice, on lattices half a cell apart: a face of the part may lie in the border of one.
        let merged = one_of_each(&copies, |p| cell_of(p, 0.25));
        let merged = one_of_each(&merged, |p| cell_of(p, 0.75));
        let spacing = mean_without_strays(nearest_distances(&merged, &interrupted)?.0);
        // Else they are no twins: small, dense bodies that are far apart.
        if merged.len() >= copies.len() / MOST_TWINS && spacing >= GAP * cell {
            return Some(spacing);
        }
    }
    Some(mean_without_strays(distances))
}

/// Twins are nearer than points on a straight line by this factor. Of points at random on a line less than
/// [`FEW_TWINS`] are so near to each other; of those on a surface next to none.
const TWIN: f64 = 256.0;

/// Share of points that may have a twin: their spacing counts all the same, as it changes the mean by no more.
const FEW_TWINS: f64 = 0.05;

/// How wide the cells are that twins are merged in, in distances at which points are twins: few pairs lie astride.
const MERGED: f64 = 16.0;

/// The least spacing of merged points, in such cells. On a line of twins it is 32.
const GAP: f64 = 8.0;

/// So many points that nearly coincide, on average, are taken for one; of points that do any number.
const MOST_TWINS: usize = 8;

/// In medians: a point whose nearest is farther away is a stray one.
const STRAY: f64 = 32.0;

/// The first of the points with each key, in their order.
fn one_of_each<K: Eq + std::hash::Hash>(
    points: &[Point3<f64>],
    key: impl Fn(&Point3<f64>) -> K,
) -> Vec<Point3<f64>> {
    let mut seen = HashSet::with_capacity(points.len());
    points.iter().filter(|p| seen.insert(key(p))).copied().collect()
}

/// The mean of the distances, without those far above the median if they would more than double it; 0 if there are none.
fn mean_without_strays(mut distances: Vec<f64>) -> f64 {
    let mean = |distances: &[f64]| {
        if distances.is_empty() { 0.0 } else { distances.iter().sum::<f64>() / distances.len() as f64 }
    };
    let of_all = mean(&distances);
    let half = distances.len() / 2;
    let mut sorted = distances.clone();
    if sorted.is_empty() {
        return of_all;
    }
    let most = STRAY * *sorted.select_nth_unstable_by(half, f64::total_cmp).1;
    distances.retain(|&distance| distance <= most);
    let of_most = mean(&distances);
    if of_all > 2.0 * of_most { of_most } else { of_all }
}

/// The mean distance from a point to its nearest other point; 0 for fewer than two points. Points that coincide are 0
/// apart. Of more than 8192 points so many are asked, drawn at random but always the same ones: then the
/// mean is good to a hundredth.
///
/// # Complexity
/// O(n) for points that fill a surface or a volume.
#[must_use]
pub fn mean_spacing(points: &[Point3<f64>]) -> f64 {
    nearest_distances(points, || false).map_or(0.0, |(distances, _)| mean(&distances))
}

fn mean(distances: &[f64]) -> f64 {
    if distances.is_empty() { 0.0 } else { distances.iter().sum::<f64>() / distances.len() as f64 }
}

/// What [`mean_spacing`] is the mean of, none for fewer than two points; and the diagonal of the box around the bulk of
/// the points. `None` once `interrupted` says so.
fn nearest_distances(
    points: &[Point3<f64>],
    interrupted: impl Fn() -> bool + Sync + Send,
) -> Option<(Vec<f64>, f64)> {
    let n = points.len();
    if n < 2 {
        return Some((Vec::new(), 0.0));
    }
    let middle = middle(points);
    let unit = points.iter().map(|p| (p.coords - middle).amax()).fold(0.0, f64::max).max(f64::MIN_POSITIVE);
    let rows = columns(points, middle, unit);
    // About as many cells as points fill a volume. Most clouds are surfaces: then cells are crowded, and a few
    // questions tell how much finer they should be.
    let bounds = bounds(&rows);
    let widest = bounds.iter().fold(0.0, |widest: f32, (low, high)| widest.max(high - low));
    let size = unit * Vector3::from(bounds.map(|(low, high)| f64::from(high - low))).norm();
    let sorted = |cell| {
        let grid = Grid::in_box_until(&rows, bounds, cell, &interrupted)?;
        Sorted::until(&rows, grid, &interrupted).filter(|_| !interrupted())
    };
    let coarse = sorted(widest / (n as f32 / POINTS_PER_CELL).cbrt())?;
    let mut guess = coarse.spacings(None, points, &coarse.strata(GUESS_SAMPLE), &interrupted)?;
    guess.sort_unstable_by(f64::total_cmp);
    // The median: a few far points must not make the cells of all others wide.
    let cell = CELL_PER_SPACING * (guess[guess.len() / 2] / unit) as f32;
    // Where most points coincide with another one it is 0, and tells nothing.
    let distances = if 0.0 < cell && cell < 0.7 * coarse.grid.cell_size() {
        let fine = sorted(cell)?;
        fine.spacings(Some(&coarse), points, &fine.strata(SPACING_SAMPLE), &interrupted)?
    } else {
        coarse.spacings(None, points, &coarse.strata(SPACING_SAMPLE), &interrupted)?
    };
    Some((distances, size))
}

/// About how many points a cell of the first grid would hold if they filled a volume.
const POINTS_PER_CELL: f32 = 2.0;

/// How wide a cell of the second grid is: most points have their nearest within half of it.
const CELL_PER_SPACING: f32 = 3.0;

/// How many points stand for a cloud when its spacing is measured, and when it is guessed.
const SPACING_SAMPLE: usize = 8192;
const GUESS_SAMPLE: usize = 64;

/// Coordinates that one thread puts into the order of a grid at a time.
const GATHER_GRAIN: usize = 1 << 16;

/// Points that one thread asks at a time.
const SPACING_GRAIN: usize = 128;

/// Columns in the order of a grid over them, with `LANES` points at infinity at the end.
#[derive(Debug)]
struct Sorted {
    grid: Grid,
    points: [Vec<f32>; 3],
    /// The row of each.
    rows: Vec<u32>,
}

impl Sorted {
    /// `None` once `interrupted` says so.
    fn until(rows: &[Vec<f32>; 3], grid: Grid, interrupted: &dyn Fn() -> bool) -> Option<Self> {
        let points = Self::columns_of(rows, &grid, interrupted)?;
        let rows = grid.order().iter().copied().chain([NONE; LANES]).collect();
        Some(Self { grid, points, rows })
    }

    /// The same of columns whose rows are `ids`, ascending.
    fn of(rows: &[Vec<f32>; 3], grid: Grid, ids: &[u32], interrupted: &dyn Fn() -> bool) -> Option<Self> {
        let points = Self::columns_of(rows, &grid, interrupted)?;
        let rows = grid.order().iter().map(|&row| ids[row as usize]).chain([NONE; LANES]).collect();
        Some(Self { grid, points, rows })
    }

    fn columns_of(
        rows: &[Vec<f32>; 3],
        grid: &Grid,
        interrupted: &dyn Fn() -> bool,
    ) -> Option<[Vec<f32>; 3]> {
        let order = grid.order();
        let axis = |axis: &[f32]| {
            let at = |i: usize| order.get(i).map_or(f32::INFINITY, |&row| axis[row as usize]);
            (!interrupted()).then(|| par::map(order.len() + LANES, GATHER_GRAIN, at))
        };
        let [x, y, z] = rows;
        Some([axis(x)?, axis(y)?, axis(z)?])
    }

    #[inline]
    fn columns(&self) -> SortedColumns<'_> {
        let n = self.rows.len();
        SortedColumns {
            points: self.points.each_ref().map(|axis| &axis[..n]),
            rows: &self.rows,
            seen: SEEN * self.grid.cell_size(),
        }
    }

    /// One position of each of `count` equal stretches of the order, drawn at random; all if there are no more.
    fn strata(&self, count: usize) -> Vec<u32> {
        let n = self.grid.order().len();
        if n <= count {
            return (0..n as u32).collect();
        }
        let mut rng = Rng::new(0, 0, 0);
        let start = |stratum: usize| stratum * n / count;
        (0..count).map(|i| (start(i) + rng.below(start(i + 1) - start(i))) as u32).collect()
    }

    /// The distance, in the unit of `rows`, of each of the points at `positions` of the order to its nearest other point.
    /// `rows` are the points that the columns were made from, as they were given. A point whose cells hold no other is
    /// looked up in the `coarser` columns, if there are any.
    fn spacings(
        &self,
        coarser: Option<&Self>,
        rows: &[Point3<f64>],
        positions: &[u32],
        interrupted: &(impl Fn() -> bool + Sync + Send),
    ) -> Option<Vec<f64>> {
        let chunks = par::chunks(positions.len(), SPACING_GRAIN, |run| {
            let of = Spacings { sorted: self, coarser, rows, positions: &positions[run] };
            (!interrupted()).then(|| dispatch(of))
        });
        Some(chunks.into_iter().collect::<Option<Vec<_>>>()?.concat())
    }

    /// The row of the point nearest to that at `place`, which is itself `row`, if there is one in the cells around.
    #[inline(always)]
    #[allow(clippy::inline_always)] // the body of the loop below
    fn near_other<S: Simd>(
        &self,
        simd: S,
        columns: SortedColumns<'_>,
        place: [f32; 3],
        row: u32,
    ) -> Option<u32> {
        if !self.grid.is_dense() {
            return Some(self.nearest_other(simd, place, row));
        }
        let mut search = Search::new(simd, columns, place, f32::INFINITY);
        for run in self.grid.block(place) {
            search.look::<true>(run, row);
        }
        let other = search.row_within(columns.seen);
        if other.is_some() {
            return other;
        }
        self.grid.each_of_wide_block(
            place,
            #[inline(always)]
            |run| search.look::<true>(run, row),
        );
        search.row_within(2.0 * columns.seen)
    }

    /// The row of the point nearest to that at `place`, which is itself `row`, of two or more.
    #[inline(always)]
    #[allow(clippy::inline_always)] // as above
    fn nearest_other<S: Simd>(&self, simd: S, place: [f32; 3], row: u32) -> u32 {
        let mut search = Search::new(simd, self.columns(), place, f32::INFINITY);
        let mut radius = 0.5 * self.grid.cell_size();
        loop {
            for run in self.grid.around(place, radius) {
                search.look::<true>(run, row);
            }
            // No columns are wider than 4 of their units.
            if let Some(other) = search.row_within(if radius > 4.0 { f32::INFINITY } else { radius }) {
                return other;
            }
            radius *= 2.0;
        }
    }
}

/// The loop of [`Sorted::spacings`].
struct Spacings<'a> {
    sorted: &'a Sorted,
    coarser: Option<&'a Sorted>,
    rows: &'a [Point3<f64>],
    positions: &'a [u32],
}

impl WithSimd for Spacings<'_> {
    type Output = Vec<f64>;

    #[inline(always)]
    #[allow(clippy::inline_always)] // compiled for the vector units of `simd`
    fn with_simd<S: Simd>(self, simd: S) -> Vec<f64> {
        let sorted = self.sorted;
        let (columns, coarser) = (sorted.columns(), self.coarser.unwrap_or(sorted));
        let mut spacings = Vec::with_capacity(self.positions.len());
        for &at in self.positions {
            let row = sorted.rows[at as usize];
            let place = sorted.points.each_ref().map(|axis| axis[at as usize]);
            let other = match sorted.near_other(simd, columns, place, row) {
                Some(other) => other,
                None => coarser.nearest_other(simd, place, row),
            };
            spacings.push((self.rows[row as usize] - self.rows[other as usize]).norm());
        }
        spacings
    }
}

/// After so many points of a run a search asks whether it can end.
const LONG: usize = 1 << 10;

/// What [`Grid::block`] holds for sure, in cells: half a one, less what rounding may cost.
const SEEN: f32 = 0.499;

/// The columns of [`Sorted`], all of one length for the compiler to see.
#[derive(Clone, Copy)]
struct SortedColumns<'a> {
    points: [&'a [f32]; 3],
    rows: &'a [u32],
    /// What [`Grid::block`] holds for sure.
    seen: f32,
}

/// A search for the point nearest to a place: the best so far, lane by lane.
struct Search<'a, S: Simd> {
    simd: S,
    columns: SortedColumns<'a>,
    place: [S::f32s; 3],
    dist_sq: S::f32s,
    row: S::u32s,
}

impl<'a, S: Simd> Search<'a, S> {
    #[inline(always)]
    #[allow(clippy::inline_always)]
    fn new(simd: S, columns: SortedColumns<'a>, place: [f32; 3], within_sq: f32) -> Self {
        Self {
            simd,
            columns,
            place: [simd.splat_f32s(place[0]), simd.splat_f32s(place[1]), simd.splat_f32s(place[2])],
            dist_sq: simd.splat_f32s(within_sq),
            row: simd.splat_u32s(NONE),
        }
    }

    /// Looks at the points of `run`, and at a few beyond its end: other points of the cloud, which do no harm. With
    /// `SKIP` not at the row `skip`.
    #[inline(always)]
    #[allow(clippy::inline_always)] // the inner loop of every search
    fn look<const SKIP: bool>(&mut self, run: Range<usize>, skip: u32) {
        let simd = self.simd;
        let mut start = run.start;
        // Once in any case: most runs are short, and then no branch has to be guessed.
        loop {
            for _ in 0..LANES / S::F32_LANES {
                let lanes = start..start + S::F32_LANES;
                let gap_sq = |axis: usize| {
                    let x = S::as_simd_f32s(&self.columns.points[axis][lanes.clone()]).0[0];
                    let gap = simd.sub_f32s(x, self.place[axis]);
                    simd.mul_f32s(gap, gap)
                };
                let dist_sq = simd.add_f32s(simd.add_f32s(gap_sq(0), gap_sq(1)), gap_sq(2));
                let row = S::as_simd_u32s(&self.columns.rows[lanes]).0[0];
                let mut nearer = simd.less_than_f32s(dist_sq, self.dist_sq);
                if SKIP {
                    let other = simd.not_m32s(simd.equal_u32s(row, simd.splat_u32s(skip)));
                    nearer = simd.and_m32s(nearer, other);
                }
                self.dist_sq = simd.select_f32s(nearer, dist_sq, self.dist_sq);
                self.row = simd.select_u32s(nearer, row, self.row);
                start += S::F32_LANES;
            }
            if start >= run.end {
                return;
            }
            // None is nearer than one that coincides: where so many do, the rest need not be looked at.
            if SKIP && (start - run.start).is_multiple_of(LONG) && simd.reduce_min_f32s(self.dist_sq) == 0.0 {
                return;
            }
        }
    }

    /// Whether a point nearer than the bound that the search began with was found.
    #[inline(always)]
    #[allow(clippy::inline_always)]
    fn has_found(&self, bound: f32) -> bool {
        self.simd.reduce_min_f32s(self.dist_sq) < bound * bound
    }

    /// The row of the nearest of all lanes, if that is within `distance`.
    #[inline(always)]
    #[allow(clippy::inline_always)]
    fn row_within(&self, distance: f32) -> Option<u32> {
        let simd = self.simd;
        let least = simd.reduce_min_f32s(self.dist_sq);
        // Lanes that saw nothing hold the bound that they began with, and are the least only if none saw anything. To look
        // for the first lane that is the least would be to guess a branch for each.
        let is_least = simd.equal_f32s(self.dist_sq, simd.splat_f32s(least));
        let rows = simd.select_u32s(is_least, self.row, simd.splat_u32s(NONE));
        let rows: &[u32] = bytemuck::cast_slice(std::slice::from_ref(&rows));
        let row = rows.iter().fold(NONE, |least, &row| least.min(row));
        (row != NONE && least <= distance * distance).then_some(row)
    }
}
