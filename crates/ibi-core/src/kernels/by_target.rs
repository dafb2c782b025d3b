//! Correspondences by the place of their target point: a pose concerns only those near it.

use std::ops::Range;

use nalgebra::{Isometry3, Point3};

use super::columns::{Columns, min_max};
use super::grid::Grid;
use super::mae::residual_sq;

/// Pairs in the order of a grid over their target points. Ids are the rows of the columns it was made from.
#[derive(Debug)]
pub struct ByTarget {
    grid: Grid,
    sorted: Columns,
    /// Ball around the source points: centre and radius, in the frame of the columns.
    source_ball: ([f32; 3], f32),
}

/// Cells of the grid along the diameter of the source points.
const CELLS_PER_DIAMETER: f32 = 4.0;

/// Residuals computed at a time.
const CHUNK: usize = 256;

impl ByTarget {
    /// Sorts `pairs`.
    ///
    /// # Complexity
    /// O(n) time, 28 bytes a pair and at most 16 a pair for the cells.
    #[must_use]
    pub fn new(pairs: &Columns) -> Self {
        let source_ball = ball(&pairs.p);
        let grid = Grid::new(&pairs.q, 2.0 * source_ball.1 / CELLS_PER_DIAMETER);
        let sorted = pairs.gather(grid.order());
        Self { grid, sorted, source_ball }
    }

    /// No two source points are farther apart than this; in the unit of the columns.
    #[must_use]
    pub fn source_diameter(&self) -> f32 {
        2.0 * self.source_ball.1
    }

    /// The pairs in the order of the grid; [`Self::id`] tells which is which.
    #[must_use]
    pub fn sorted(&self) -> &Columns {
        &self.sorted
    }

    /// The pair at a position of the order.
    #[must_use]
    pub fn id(&self, at: usize) -> u32 {
        self.grid.order()[at]
    }

    /// Positions that hold every pair whose target point lies within `radius` of `place`, and others; both in the frame
    /// of the columns.
    pub fn around(&self, place: [f32; 3], radius: f32) -> impl Iterator<Item = Range<usize>> + '_ {
        self.grid.around(place, radius).filter(|run| !run.is_empty())
    }

    /// Ids of the pairs whose target point lies within `radius` of `place`, both in the unit and frame of the target
    /// points as they were given, in the order of the grid.
    #[must_use]
    pub fn within(&self, place: &Point3<f64>, radius: f64) -> Vec<u32> {
        let Columns { centres: (_, centre_q), unit, .. } = self.sorted;
        let place: [f32; 3] = ((place.coords - centre_q) / unit).cast().into();
        // A little more, for rounding.
        let radius = (radius / unit * (1.0 + 1e-6)) as f32;
        self.below(self.around(place, radius), (radius * radius).next_up(), move |_, q| {
            let d = [q[0] - place[0], q[1] - place[1], q[2] - place[2]];
            d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        })
    }

    /// Positions that hold every pair whose target point lies within `distance` of some source point that the pose has
    /// moved, and others.
    pub fn near_pose(
        &self,
        target_from_source: &Isometry3<f64>,
        distance: f64,
    ) -> impl Iterator<Item = Range<usize>> + '_ {
        let (centre, radius) = self.source_ball;
        let moved = self.sorted.moved(target_from_source, centre);
        self.around(moved, radius + distance as f32)
    }

    /// Ids of the pairs with |T p - q| < `distance`, in no particular order; the distance in the unit of the columns.
    ///
    /// # Complexity
    /// The pairs near the pose.
    #[must_use]
    pub fn close_pairs(&self, target_from_source: &Isometry3<f64>, distance: f64) -> Vec<u32> {
        let residual_sq = residual_sq(&self.sorted, target_from_source);
        let distance_sq = (distance * distance) as f32;
        self.below(self.near_pose(target_from_source, distance), distance_sq, residual_sq)
    }

    /// Ids of the pairs at the positions `runs` of which `f` is less than `bound`.
    #[inline(always)]
    #[allow(clippy::inline_always)] // `f` must be seen through to vectorise
    fn below(
        &self,
        runs: impl Iterator<Item = Range<usize>>,
        bound: f32,
        f: impl Fn([f32; 3], [f32; 3]) -> f32 + Copy,
    ) -> Vec<u32> {
        let mut buffer = [0.0_f32; CHUNK];
        let mut ids = Vec::with_capacity(CHUNK);
        for run in runs {
            for start in run.clone().step_by(CHUNK) {
                let values = &mut buffer[..CHUNK.min(run.end - start)];
                self.sorted.map_run_into(start..start + values.len(), values, f);
                let hits = (start..).zip(&*values).filter(|&(_, &value)| value < bound);
                ids.extend(hits.map(|(at, _)| self.id(at)));
            }
        }
        ids
    }
}

/// A ball around points: the middle of their box, and the farthest point from it.
pub(crate) fn ball(points: &[Vec<f32>; 3]) -> ([f32; 3], f32) {
    if points[0].is_empty() {
        return ([0.0; 3], 0.0);
    }
    let middle = points.each_ref().map(|axis| {
        let (low, high) = min_max(axis);
        0.5 * (low + high)
    });
    let dist_sq = (0..points[0].len()).map(|i| {
        let d = [0, 1, 2].map(|axis| points[axis][i] - middle[axis]);
        d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    });
    // A little more, for rounding.
    (middle, 1.0001 * dist_sq.fold(0.0, f32::max).sqrt())
}
