//! The nearest point within a reach that is known beforehand: a grid whose cells are twice as wide.
//!
//! All questions in the rounds are of this kind. A kd-tree, which answers them at any distance, takes nine times as
//! long: it walks down a path of branches that no processor foresees, where eight cells are read straight through.

use std::ops::Range;

use nalgebra::{Point3, Vector3};

use super::columns::{columns, middle};
use super::grid::{Grid, bulk};
use super::par;
use super::rng::Rng;
use super::simd::simd;

/// How many points are looked at side by side.
const LANES: usize = 8;

/// A cloud, prepared for questions within one reach; ids are the rows of the cloud.
///
/// Distances are compared in `f32`, relative to the middle of the cloud and in multiples of the reach. Of two points
/// whose distances from the query differ by less than 2.5e-7 of the query's distance from the middle, either may be
/// taken for the nearest.
#[derive(Debug)]
pub struct Nearby {
    grid: Grid,
    /// Coordinates in the order of the grid, with `LANES` points at infinity at the end.
    points: [Vec<f32>; 3],
    middle: Vector3<f64>,
    reach: f64,
    inv_reach: f64,
}

/// No point.
const NONE: u32 = u32::MAX;

impl Nearby {
    /// Prepares `points` for questions within `reach` (> 0).
    ///
    /// # Complexity
    /// O(n) time; 16 bytes a point and at most 16 a point for the cells.
    #[must_use]
    pub fn new(points: &[Point3<f64>], reach: f64) -> Self {
        let middle = middle(points);
        let rows = columns(points, middle, reach);
        // The reach is 1. Two cells on each axis hold it, whichever side of its cell the query lies on.
        let grid = Grid::new(&rows, 2.001);
        let points = sorted(&grid, &rows);
        Self { grid, points, middle, reach, inv_reach: 1.0 / reach }
    }

    /// The reach, in the unit of the points.
    #[must_use]
    pub fn reach(&self) -> f64 {
        self.reach
    }

    /// The row of the point nearest to `query`, if one lies within the reach.
    #[must_use]
    pub fn nearest(&self, query: &Point3<f64>) -> Option<u32> {
        let mut nearest = None;
        self.nearest_each([((), *query)], |(), _, row| nearest = row);
        nearest
    }

    /// Tells `found(key, query, row)` of each `(key, query)` the row of the nearest point, if one lies within the reach.
    pub fn nearest_each<K>(
        &self,
        queries: impl IntoIterator<Item = (K, Point3<f64>)>,
        mut found: impl FnMut(K, &Point3<f64>, Option<u32>),
    ) {
        simd(
            #[inline(always)]
            || {
                for (key, query) in queries {
                    found(key, &query, self.row(&query));
                }
            },
        );
    }

    /// Rows of the points within `distance` of `query`, up to rounding, in no particular order. The distance may exceed
    /// the reach.
    pub fn within(&self, query: &Point3<f64>, distance: f64) -> impl Iterator<Item = u32> + '_ {
        let q = self.local(query);
        // A little more, for rounding.
        let radius = (distance / self.reach * (1.0 + 1e-6)) as f32;
        let [x, y, z] = self.points.each_ref().map(Vec::as_slice);
        self.grid.around(q, radius).flatten().filter_map(move |at| {
            let d = [x[at] - q[0], y[at] - q[1], z[at] - q[2]];
            (d[0] * d[0] + d[1] * d[1] + d[2] * d[2] <= radius * radius).then(|| self.grid.order()[at])
        })
    }

    fn local(&self, query: &Point3<f64>) -> [f32; 3] {
        [0, 1, 2].map(|axis| ((query[axis] - self.middle[axis]) * self.inv_reach) as f32)
    }

    #[inline(always)]
    #[allow(clippy::inline_always)] // the body of the loop above
    fn row(&self, query: &Point3<f64>) -> Option<u32> {
        let q = self.local(query);
        let mut best = Best::within(1.000_001);
        for run in self.grid.block(q) {
            best.look::<false>(&self.points, run, q, NONE);
        }
        best.first().map(|(at, _)| self.grid.order()[at])
    }
}

/// The mean distance from a point to its nearest other point; 0 for fewer than two points. Points that coincide are 0
/// apart. Of more than 8192 points so many are asked, drawn at random but always the same ones: then the
/// mean is good to a hundredth.
///
/// # Complexity
/// O(n) for points that fill a surface or a volume.
#[must_use]
pub fn mean_spacing(points: &[Point3<f64>]) -> f64 {
    let n = points.len();
    if n < 2 {
        return 0.0;
    }
    let middle = middle(points);
    let unit = points.iter().map(|p| (p.coords - middle).amax()).fold(0.0, f64::max).max(f64::MIN_POSITIVE);
    let rows = columns(points, middle, unit);
    // Some points in each cell that has any: where the cloud is a surface, a few dozen.
    let widest = rows
        .each_ref()
        .map(|axis| bulk(axis))
        .iter()
        .fold(0.0, |widest: f32, (low, high)| widest.max(high - low));
    let grid = Grid::new(&rows, widest / (n as f32 / POINTS_PER_CELL).cbrt());
    let sorted = sorted(&grid, &rows);
    let all: Vec<u32> = (0..n as u32).collect();
    let sample = Rng::new(0, 0, 0).sample(&all, SPACING_SAMPLE);
    // What lies in the cells around is seen in one look, as in `Nearby`; only what is farther off is searched for.
    let seen = 0.499 * grid.cell_size();
    let totals = par::chunks(sample.len(), SPACING_GRAIN, |run| {
        let mut total = 0.0;
        simd(
            #[inline(always)]
            || {
                for &at in &sample[run] {
                    let q = sorted.each_ref().map(|axis| axis[at as usize]);
                    let mut best = Best::within(f32::INFINITY);
                    for run in grid.block(q) {
                        best.look::<true>(&sorted, run, q, at);
                    }
                    let mut radius = seen;
                    let other = loop {
                        match best.first() {
                            // Nothing is farther off than twice the middle from the rim, on three axes.
                            Some((other, dist_sq)) if dist_sq <= radius * radius || radius > 4.0 => {
                                break other;
                            }
                            _ => radius *= 2.0,
                        }
                        for run in grid.around(q, radius) {
                            best.look::<true>(&sorted, run, q, at);
                        }
                    };
                    let [here, there] = [at as usize, other].map(|at| points[grid.order()[at] as usize]);
                    total += (here - there).norm();
                }
            },
        );
        total
    });
    totals.iter().sum::<f64>() / sample.len() as f64
}

/// About how many points a cell would hold if they filled a volume.
const POINTS_PER_CELL: f32 = 2.0;

/// How many points stand for a cloud when its spacing is measured.
const SPACING_SAMPLE: usize = 8192;

/// Points that one thread asks at a time.
const SPACING_GRAIN: usize = 1024;

/// Columns in the order of the grid, with `LANES` values at infinity at the end.
fn sorted(grid: &Grid, rows: &[Vec<f32>; 3]) -> [Vec<f32>; 3] {
    rows.each_ref().map(|axis| {
        let sorted = grid.order().iter().map(|&i| axis[i as usize]);
        sorted.chain([f32::INFINITY; LANES]).collect()
    })
}

/// The nearest point so far, lane by lane.
struct Best {
    dist_sq: [f32; LANES],
    at: [u32; LANES],
}

impl Best {
    #[inline(always)]
    #[allow(clippy::inline_always)]
    fn within(dist_sq: f32) -> Self {
        Self { dist_sq: [dist_sq; LANES], at: [NONE; LANES] }
    }

    /// Looks at the points of `run`, and at a few beyond its end: other points of the cloud, which do no harm. With
    /// `SKIP` not at `skip`.
    #[inline(always)]
    #[allow(clippy::inline_always, clippy::needless_bitwise_bool)] // the inner loop of every search, without branches
    fn look<const SKIP: bool>(&mut self, points: &[Vec<f32>; 3], run: Range<usize>, q: [f32; 3], skip: u32) {
        let [px, py, pz] = points.each_ref().map(Vec::as_slice);
        for start in run.step_by(LANES) {
            let (x, y, z) = (&px[start..start + LANES], &py[start..start + LANES], &pz[start..start + LANES]);
            for k in 0..LANES {
                let d = [x[k] - q[0], y[k] - q[1], z[k] - q[2]];
                let dist_sq = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
                let at = (start + k) as u32;
                let nearer = (dist_sq < self.dist_sq[k]) & (!SKIP | (at != skip));
                self.dist_sq[k] = if nearer { dist_sq } else { self.dist_sq[k] };
                self.at[k] = if nearer { at } else { self.at[k] };
            }
        }
    }

    /// The nearest of all lanes, its place in the order and squared distance.
    #[inline(always)]
    #[allow(clippy::inline_always)]
    fn first(&self) -> Option<(usize, f32)> {
        let least = self.dist_sq.iter().copied().fold(f32::INFINITY, f32::min);
        let lanes = self.dist_sq.iter().zip(&self.at);
        // Lanes that saw nothing hold the largest value and the bound that they began with.
        let at = lanes
            .map(|(&dist_sq, &at)| if dist_sq.to_bits() == least.to_bits() { at } else { NONE })
            .fold(NONE, u32::min);
        (at != NONE).then_some((at as usize, least))
    }
}
