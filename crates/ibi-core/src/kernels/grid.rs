//! A uniform grid over points: which ones can be near a place.

use std::ops::Range;

use super::columns::min_max;
use super::simd::simd;

/// Points sorted by cell, so that the points of a column of cells stand together.
#[derive(Debug)]
pub struct Grid {
    low: [f32; 3],
    /// 1 / width of a cell, per axis.
    inv_cell: [f32; 3],
    /// Cells per axis, two or more.
    shape: [usize; 3],
    /// The last cell of each axis.
    last: [f32; 3],
    /// Start of each cell in `order`, plus the end; of a sparse grid of each cell of `occupied`.
    starts: Vec<u32>,
    /// Of a sparse grid the cells that hold points, ascending; else nothing.
    occupied: Vec<usize>,
    order: Vec<u32>,
}

/// Cells at most: as many as four times the points, or this many. Beyond it cells grow: first along z, where the points of
/// a column stand together anyhow and a few more cost nothing, then on all axes.
const MIN_CELLS: usize = 1 << 12;
const CELLS_PER_POINT: usize = 4;

/// Where that has made the cells more than so much wider and a point shares its cell with more than so many others, on
/// average, only the cells that hold points are kept, and searched for: clusters that lie far apart.
const MOST_WIDENED: f32 = 2.0;
const MOST_SHARED: usize = 1024;
const SHARING_SAMPLE: usize = 256;

/// So many points are looked at while a cell of a sparse grid is searched for.
const POINTS_PER_SEARCH: usize = 128;

/// Cells per axis of a sparse grid at most: then a number of 64 bits names each.
const MAX_PER_SPARSE_AXIS: usize = 1 << 21;

/// Least width of a cell: a place far from the points is still a finite number of cells away.
const MIN_CELL: f32 = 1e-15;

/// Cells per axis at most: `f32` tells no more apart, and [`nearest_whole`] takes no more.
const MAX_PER_AXIS: usize = 1 << 22;

/// The part of a sorted sample that is cut off at either end before the box is taken, and how much of its width is
/// then added on each side.
const TAIL: usize = 50;
const MARGIN: f32 = 0.25;
const SAMPLE: usize = 1000;

impl Grid {
    /// Sorts `points` into cells of at least `cell`; where there would be too many, longer ones.
    ///
    /// The cells cover the box that holds nearly all of a sample of the points. What lies outside counts to the cells
    /// on the rim, so that one stray point a kilometre away does not make all others share a cell.
    ///
    /// # Complexity
    /// O(n) time, O(n log n) for clusters that lie far apart; 4 bytes a point and at most 16 a point (or 16 KiB) for the cells.
    #[must_use]
    pub fn new(points: &[Vec<f32>; 3], cell: f32) -> Self {
        Self::in_box(points, points.each_ref().map(|axis| bulk(axis)), cell)
    }

    /// The same where the [`bulk`] of each axis is known.
    pub(crate) fn in_box(points: &[Vec<f32>; 3], bounds: [(f32, f32); 3], cell: f32) -> Self {
        Self::in_box_until(points, bounds, cell, &|| false)
            .unwrap_or_else(|| unreachable!("nobody interrupts"))
    }

    /// The same; `None` once `interrupted` says so.
    pub(crate) fn in_box_until(
        points: &[Vec<f32>; 3],
        bounds: [(f32, f32); 3],
        cell: f32,
        interrupted: &dyn Fn() -> bool,
    ) -> Option<Self> {
        let grid = Self::dense(points, bounds, cell, interrupted)?;
        let widened = cell * grid.inv_cell.iter().fold(f32::INFINITY, |least, &inv| least.min(inv));
        let is_sparse = widened * MOST_WIDENED < 1.0 && grid.sharing(points) > MOST_SHARED;
        Some(if is_sparse { Self::sparse(points, bounds, cell) } else { grid })
    }

    /// With how many others a point shares its cell, on average over some of `points`, those of the grid.
    pub(crate) fn sharing(&self, points: &[Vec<f32>; 3]) -> usize {
        let step = self.order.len().div_ceil(SHARING_SAMPLE).max(1);
        let some = (0..self.order.len()).step_by(step);
        let num = some.len().max(1);
        let len = |i: usize| {
            let cell = self.index(self.cell(points.each_ref().map(|axis| axis[i])));
            self.run(cell, cell + 1).len()
        };
        some.map(len).sum::<usize>() / num
    }

    /// Whether all cells are known, and not only those that hold points.
    pub(crate) fn is_dense(&self) -> bool {
        self.occupied.is_empty()
    }

    /// How far a place is from the box that holds the bulk of the points.
    pub(crate) fn distance_to_box(&self, place: [f32; 3]) -> f32 {
        let gaps = [0, 1, 2].map(|axis| {
            let width = self.shape[axis] as f32 / self.inv_cell[axis];
            (self.low[axis] - place[axis]).max(place[axis] - self.low[axis] - width).max(0.0)
        });
        gaps.iter().map(|gap| gap * gap).sum::<f32>().sqrt()
    }

    /// A grid that knows where each cell begins.
    fn dense(
        points: &[Vec<f32>; 3],
        bounds: [(f32, f32); 3],
        cell: f32,
        interrupted: &dyn Fn() -> bool,
    ) -> Option<Self> {
        let n = points[0].len();
        let max_cells = (CELLS_PER_POINT * n).max(MIN_CELLS);
        let widest = bounds.iter().map(|(low, high)| high - low).fold(0.0, f32::max);
        let mut cell = cell.max(widest / max_cells.min(MAX_PER_AXIS) as f32).max(MIN_CELL);
        let num = |axis: usize, cell: f32| (((bounds[axis].1 - bounds[axis].0) / cell) as usize + 1).max(2);
        while num(0, cell).checked_mul(num(1, cell)).is_none_or(|columns| columns > max_cells / 2) {
            cell *= 1.1;
        }
        let shape = [num(0, cell), num(1, cell)];
        let height = max_cells / (shape[0] * shape[1]);
        // A little more, for rounding.
        let cell_z = cell.max((bounds[2].1 - bounds[2].0) / height as f32 * 1.0001);
        let mut grid = Self {
            low: bounds.map(|(low, _)| low),
            inv_cell: [cell, cell, cell_z].map(|cell| 1.0 / cell),
            shape: [shape[0], shape[1], num(2, cell_z).min(height)],
            last: [0.0; 3],
            starts: Vec::new(),
            occupied: Vec::new(),
            order: Vec::new(),
        };
        grid.last = grid.shape.map(|num| (num - 1) as f32);
        let [x, y, z] = points.each_ref().map(|axis| &axis[..n]);
        let mut cells = vec![0_u32; n];
        let (cells_mut, of) = (&mut cells[..], &grid);
        simd(
            #[inline(always)]
            move || {
                for (i, cell) in cells_mut.iter_mut().enumerate() {
                    *cell = of.index(of.cell([x[i], y[i], z[i]])) as u32;
                }
            },
        );
        let pairs = (0_u32..).zip(cells.iter().map(|&cell| cell as usize));
        (grid.starts, grid.order) = buckets_until(grid.shape.iter().product(), pairs, interrupted)?;
        Some(grid)
    }

    /// A grid that knows of no cell but those that hold points. They are as wide as can be wished, or nearly so.
    fn sparse(points: &[Vec<f32>; 3], bounds: [(f32, f32); 3], cell: f32) -> Self {
        let widest = bounds.iter().map(|(low, high)| high - low).fold(0.0, f32::max);
        let cell = cell.max(widest / (MAX_PER_SPARSE_AXIS - 1) as f32 * 1.0001).max(MIN_CELL);
        let shape =
            bounds.map(|(low, high)| (((high - low) / cell) as usize + 1).clamp(2, MAX_PER_SPARSE_AXIS));
        let mut grid = Self {
            low: bounds.map(|(low, _)| low),
            inv_cell: [1.0 / cell; 3],
            shape,
            last: shape.map(|num| (num - 1) as f32),
            starts: Vec::new(),
            occupied: Vec::new(),
            order: Vec::new(),
        };
        let [x, y, z] = points;
        let mut sorted: Vec<(usize, u32)> =
            (0..x.len()).map(|i| (grid.index(grid.cell([x[i], y[i], z[i]])), i as u32)).collect();
        sorted.sort_unstable();
        for (at, &(cell, _)) in (0..).zip(&sorted) {
            if grid.occupied.last() != Some(&cell) {
                grid.occupied.push(cell);
                grid.starts.push(at);
            }
        }
        grid.starts.push(sorted.len() as u32);
        grid.order = sorted.into_iter().map(|(_, i)| i).collect();
        grid
    }

    /// The places of the order from where one cell begins to where another one does, or would.
    #[inline(always)]
    #[allow(clippy::inline_always)] // in the head of inner loops
    fn run(&self, first: usize, end: usize) -> Range<usize> {
        if self.occupied.is_empty() {
            self.starts[first] as usize..self.starts[end] as usize
        } else {
            self.sparse_run(first, end)
        }
    }

    #[cold]
    #[inline(never)]
    fn sparse_run(&self, first: usize, end: usize) -> Range<usize> {
        let start = |cell| self.starts[self.occupied.partition_point(|&other| other < cell)] as usize;
        start(first)..start(end)
    }

    /// Whether so many columns are more than are worth looking for one by one, of those that hold points.
    fn are_too_many(&self, low: [usize; 3], high: [usize; 3]) -> bool {
        !self.is_dense() && columns(low, high) > self.occupied.len()
    }

    /// Whether all points are looked at in less time than so many columns are looked for.
    fn are_slower_than_all(&self, low: [usize; 3], high: [usize; 3]) -> bool {
        !self.is_dense() && columns(low, high) > self.order.len() / POINTS_PER_SEARCH
    }

    /// The points, by cell; within a cell in their own order.
    #[must_use]
    pub fn order(&self) -> &[u32] {
        &self.order
    }

    /// Width of a cell on the axis where it is least.
    #[must_use]
    pub fn cell_size(&self) -> f32 {
        1.0 / self.inv_cell[0]
    }

    /// Ranges of [`Self::order`], ascending, that hold every point within `radius` of `place`, and others.
    pub fn around(&self, place: [f32; 3], radius: f32) -> impl Iterator<Item = Range<usize>> + '_ {
        let (radius, low, high) = self.ball(place, radius);
        let all = self.are_slower_than_all(low, high).then_some(0..self.order.len());
        let columns = if all.is_some() { 0..0 } else { low[0]..high[0] + 1 };
        let columns = columns.flat_map(move |x| {
            let dx = self.gap(0, x, place[0]);
            (low[1]..=high[1]).filter_map(move |y| self.column([x, y], dx, place, radius))
        });
        all.into_iter().chain(columns)
    }

    /// Hands the ranges of [`Self::around`] to `look`. A loop and no iterator, where many ask for many.
    #[inline(always)]
    #[allow(clippy::inline_always)] // the head of an inner loop
    pub(crate) fn each_around(&self, place: [f32; 3], radius: f32, mut look: impl FnMut(Range<usize>)) {
        let (radius, low, high) = self.ball(place, radius);
        if self.are_slower_than_all(low, high) {
            return look(0..self.order.len());
        }
        for x in low[0]..=high[0] {
            let dx = self.gap(0, x, place[0]);
            for y in low[1]..=high[1] {
                if let Some(run) = self.column([x, y], dx, place, radius) {
                    look(run);
                }
            }
        }
    }

    /// The radius, the first and the last cell of a ball. A little more than was asked for: rounding must not lose a point
    /// at its very end.
    #[inline]
    fn ball(&self, place: [f32; 3], radius: f32) -> (f32, [usize; 3], [usize; 3]) {
        let radius = radius + 1e-4 * radius + 1e-6 * place.iter().fold(0.0, |a: f32, x| a.max(x.abs()));
        (radius, self.cell(place.map(|x| x - radius)), self.cell(place.map(|x| x + radius)))
    }

    /// The part of a column of cells that a ball meets, `dx` away from it on the first axis.
    #[inline]
    fn column(&self, [x, y]: [usize; 2], dx: f32, place: [f32; 3], radius: f32) -> Option<Range<usize>> {
        let dy = self.gap(1, y, place[1]);
        let left = radius * radius - dx * dx - dy * dy;
        if left < 0.0 {
            return None;
        }
        let (reach, row) = (left.sqrt(), self.index([x, y, 0]));
        let (first, last) = (self.along(2, place[2] - reach), self.along(2, place[2] + reach));
        Some(self.run(row + first, row + last + 1))
    }

    /// For each cell that holds points: its range of [`Self::order`], and, ascending, those that hold every point within
    /// `radius` of any of its points, and others. Cells follow each other in the order.
    pub fn neighborhoods(&self, radius: f32) -> impl Iterator<Item = (Range<usize>, Vec<Range<usize>>)> + '_ {
        let [_, ny, nz] = self.shape;
        // A little more, for rounding.
        let radius = radius * 1.001;
        (0..self.starts.len() - 1).filter_map(move |at| {
            let home = self.starts[at] as usize..self.starts[at + 1] as usize;
            let index = self.occupied.get(at).copied().unwrap_or(at);
            let cell = [index / nz / ny, index / nz % ny, index % nz];
            (!home.is_empty()).then(|| (home, self.around_cell(cell, radius)))
        })
    }

    /// As [`Self::neighborhoods`] for one cell.
    fn around_cell(&self, [x, y, z]: [usize; 3], radius: f32) -> Vec<Range<usize>> {
        let [wide, _, high] = self.inv_cell.map(|inv_cell| radius * inv_cell); // in cells
        let most = wide.ceil() as usize;
        let window = |c: usize, axis: usize| c.saturating_sub(most)..=(c + most).min(self.shape[axis] - 1);
        // Between two cells lie all those that separate them.
        let gap = |a: usize, b: usize| a.abs_diff(b).saturating_sub(1) as f32;
        let [low, high_of] =
            [0, 1].map(|end| [x, y, z].map(|c| if end == 0 { c.saturating_sub(most) } else { c + most }));
        if self.are_too_many(low, high_of) {
            return std::iter::once(0..self.order.len()).collect();
        }
        let mut runs = Vec::with_capacity(window(x, 0).count() * window(y, 1).count());
        for other_x in window(x, 0) {
            for other_y in window(y, 1) {
                let left = wide * wide - gap(x, other_x).powi(2) - gap(y, other_y).powi(2);
                if left < 0.0 {
                    continue;
                }
                let reach = (left.sqrt() / wide * high) as usize + 1;
                let row = self.index([other_x, other_y, 0]);
                let (first, last) = (z.saturating_sub(reach), (z + reach).min(self.shape[2] - 1));
                let run = self.run(row + first, row + last + 1);
                if !run.is_empty() {
                    runs.push(run);
                }
            }
        }
        runs
    }

    /// Ranges of [`Self::order`] that hold every point within half a cell (a little less) of `place`: of each axis two
    /// neighbouring cells. Only where [`Self::is_dense`].
    #[inline(always)]
    #[allow(clippy::inline_always)] // the head of an inner loop
    pub(crate) fn block(&self, place: [f32; 3]) -> [Range<usize>; 4] {
        let first = |axis: usize| {
            let at = (place[axis] - self.low[axis]) * self.inv_cell[axis];
            nearest_whole(at - 1.0, self.last[axis] - 1.0)
        };
        let corner = self.index([first(0), first(1), first(2)]);
        let (next_x, next_y) = (self.shape[1] * self.shape[2], self.shape[2]);
        let run = |at: usize| self.starts[at] as usize..self.starts[at + 2] as usize;
        [run(corner), run(corner + next_y), run(corner + next_x), run(corner + next_x + next_y)]
    }

    /// Hands ranges of [`Self::order`] to `look` that hold every point within a cell (a little less) of `place`: of each
    /// axis three neighbouring cells. Only where [`Self::is_dense`].
    #[inline(always)]
    #[allow(clippy::inline_always)] // the head of an inner loop
    pub(crate) fn each_of_wide_block(&self, place: [f32; 3], mut look: impl FnMut(Range<usize>)) {
        let [x, y, z] = self.cell(place);
        let end = |axis: usize, at: usize| (at + 2).min(self.shape[axis]);
        let (first, last) = (z.saturating_sub(1), end(2, z));
        for x in x.saturating_sub(1)..end(0, x) {
            for y in y.saturating_sub(1)..end(1, y) {
                let row = self.index([x, y, 0]);
                look(self.starts[row + first] as usize..self.starts[row + last] as usize);
            }
        }
    }

    /// How far `x` is from the cells `c` of an axis: 0 within, and beyond the rim, whose cells have no end.
    fn gap(&self, axis: usize, c: usize, x: f32) -> f32 {
        let at = (x - self.low[axis]) * self.inv_cell[axis];
        let below = if c > 0 { c as f32 - at } else { 0.0 };
        let above = if c + 1 < self.shape[axis] { at - (c + 1) as f32 } else { 0.0 };
        // Rounding of the cell of a point and of this gap may differ.
        (below.max(above) - 1e-3).max(0.0) / self.inv_cell[axis]
    }

    #[inline(always)]
    #[allow(clippy::inline_always)] // the body of a loop that must vectorise
    fn cell(&self, p: [f32; 3]) -> [usize; 3] {
        [self.along(0, p[0]), self.along(1, p[1]), self.along(2, p[2])]
    }

    #[inline(always)]
    #[allow(clippy::inline_always)] // as above
    fn along(&self, axis: usize, x: f32) -> usize {
        nearest_whole((x - self.low[axis]) * self.inv_cell[axis] - 0.5, self.last[axis])
    }

    #[inline(always)]
    #[allow(clippy::inline_always)] // as above
    fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (x * self.shape[1] + y) * self.shape[2] + z
    }
}

/// How many columns of cells there are from one cell to another.
fn columns(low: [usize; 3], high: [usize; 3]) -> usize {
    (high[0] - low[0] + 1).saturating_mul(high[1] - low[1] + 1)
}

/// The whole number nearest to `x` among those from 0 to `last`, below 2^23. A cast, which has to mind every float there
/// is, takes five times as long; here the sum has no room for a fraction, and ends in the bits of the whole number.
#[inline(always)]
#[allow(clippy::inline_always)] // as above
fn nearest_whole(x: f32, last: f32) -> usize {
    const WHOLE: f32 = (1 << 23) as f32;
    let x = if x > 0.0 { x } else { 0.0 };
    let x = if x < last { x } else { last };
    ((x + WHOLE).to_bits() & 0x007f_ffff) as usize
}

/// The interval that holds the bulk of the values.
pub(crate) fn bulk(values: &[f32]) -> (f32, f32) {
    let (least, most) = min_max(values);
    if least > most {
        return (0.0, 0.0);
    }
    let mut sample: Vec<f32> = values.iter().copied().step_by(values.len().div_ceil(SAMPLE)).collect();
    let cut = sample.len() / TAIL;
    let last = sample.len() - 1 - cut;
    let (below, &mut high, _) = sample.select_nth_unstable_by(last, f32::total_cmp);
    let low = if cut < last { *below.select_nth_unstable_by(cut, f32::total_cmp).1 } else { high };
    let margin = MARGIN * (high - low);
    ((low - margin).max(least), (high + margin).min(most))
}

/// Sorts (item, bucket) pairs by bucket: where each bucket starts, plus the end, and the items in this order.
pub(crate) fn buckets(
    count: usize,
    pairs: impl Iterator<Item = (u32, usize)> + Clone,
) -> (Vec<u32>, Vec<u32>) {
    buckets_until(count, pairs, &|| false).unwrap_or_else(|| unreachable!("nobody interrupts"))
}

/// The same; `None` once `interrupted` says so.
fn buckets_until(
    count: usize,
    pairs: impl Iterator<Item = (u32, usize)> + Clone,
    interrupted: &dyn Fn() -> bool,
) -> Option<(Vec<u32>, Vec<u32>)> {
    // Two places on, so that what counts where the next item of a bucket goes ends as the start of the bucket after it.
    let mut starts = vec![0_u32; count + 2];
    for_each_until(pairs.clone(), interrupted, |(_, bucket)| starts[bucket + 2] += 1)?;
    let mut sum = 0;
    for start in &mut starts {
        sum += *start;
        *start = sum;
    }
    let mut items = vec![0; sum as usize];
    for_each_until(pairs, interrupted, |(item, bucket)| {
        let next = &mut starts[bucket + 1];
        items[*next as usize] = item;
        *next += 1;
    })?;
    starts.pop();
    Some((starts, items))
}

/// Calls `look` on each of `items`, and asks now and then whether to go on; `None` if not.
fn for_each_until<T>(
    mut items: impl Iterator<Item = T>,
    interrupted: &dyn Fn() -> bool,
    mut look: impl FnMut(T),
) -> Option<()> {
    const RUN: usize = 1 << 18;
    let mut num = RUN;
    while num == RUN {
        if interrupted() {
            return None;
        }
        num = items.by_ref().take(RUN).fold(0, |num, item| {
            look(item);
            num + 1
        });
    }
    Some(())
}
