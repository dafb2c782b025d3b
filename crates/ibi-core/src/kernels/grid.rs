//! A uniform grid over points: which ones can be near a place.

use std::ops::Range;

/// Points sorted by cell, so that the points of a column of cells stand together.
#[derive(Debug)]
pub struct Grid {
    origin: [f32; 3],
    inv_cell: f32,
    shape: [usize; 3],
    /// Start of each cell in `order`, plus the end.
    starts: Vec<u32>,
    order: Vec<u32>,
}

/// Cells per axis at most; beyond it cells grow. Bounds the memory to 4 * 64^3 bytes = 1 MiB.
const MAX_CELLS: f32 = 64.0;

impl Grid {
    /// Sorts `points` into cells at least `radius` wide.
    #[must_use]
    pub fn new(points: &[Vec<f32>; 3], radius: f32) -> Self {
        let bounds = points.each_ref().map(|c| {
            c.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(lo, hi), &x| (lo.min(x), hi.max(x)))
        });
        let widest = bounds.iter().map(|(lo, hi)| hi - lo).fold(0.0, f32::max);
        // A little wider than the radius, so that rounding cannot push a neighbour two cells away.
        let cell = (radius * 1.001).max(widest / MAX_CELLS).max(f32::MIN_POSITIVE);
        let origin = bounds.map(|(lo, _)| lo);
        let inv_cell = 1.0 / cell;
        let shape = bounds.map(|(lo, hi)| if hi >= lo { ((hi - lo) * inv_cell) as usize + 1 } else { 1 });
        let n = points[0].len();
        let mut grid = Self { origin, inv_cell, shape, starts: Vec::new(), order: Vec::new() };
        let cells: Vec<usize> =
            (0..n).map(|i| grid.index(grid.cell(points.each_ref().map(|c| c[i])))).collect();
        let mut starts = vec![0_u32; shape.iter().product::<usize>() + 1];
        for &cell in &cells {
            starts[cell + 1] += 1;
        }
        for c in 1..starts.len() {
            starts[c] += starts[c - 1];
        }
        let mut next = starts.clone();
        let mut order = vec![0; n];
        for (i, &cell) in cells.iter().enumerate() {
            order[next[cell] as usize] = i as u32;
            next[cell] += 1;
        }
        (grid.starts, grid.order) = (starts, order);
        grid
    }

    /// The points, by cell; within a cell in their own order.
    #[must_use]
    pub fn order(&self) -> &[u32] {
        &self.order
    }

    /// Ranges of [`Self::order`] that hold every point within the radius of `place` (a point of the grid).
    pub fn around(&self, place: [f32; 3]) -> impl Iterator<Item = Range<usize>> + '_ {
        let [x, y, z] = self.cell(place);
        let near = |c: usize, axis: usize| c.saturating_sub(1)..=(c + 1).min(self.shape[axis] - 1);
        near(x, 0).flat_map(move |x| near(y, 1).map(move |y| (x, y))).map(move |(x, y)| {
            let (first, last) = (z.saturating_sub(1), (z + 1).min(self.shape[2] - 1));
            self.starts[self.index([x, y, first])] as usize
                ..self.starts[self.index([x, y, last]) + 1] as usize
        })
    }

    fn cell(&self, p: [f32; 3]) -> [usize; 3] {
        [0, 1, 2]
            .map(|axis| (((p[axis] - self.origin[axis]) * self.inv_cell) as usize).min(self.shape[axis] - 1))
    }

    fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (x * self.shape[1] + y) * self.shape[2] + z
    }
}
