//! The other points of a cloud within one radius of each of its points.
//!
//! Not [`crate::kernels::nearby`], which wants the nearest alone: here every one counts, so each is written down. Whether
//! a point is within the radius is told in `f64`, from the coordinates as they came.

use std::ops::Range;

use nalgebra::Point3;

use super::FeatureError;
use super::door::check_length;
use crate::interrupt::Interrupt;
use crate::kernels::columns::{columns, middle};
use crate::kernels::grid::Grid;
use crate::kernels::par;
use crate::kernels::simd::simd;
use crate::pace::Pace;

/// Which points count as the neighbours of a point (Open3D's hybrid search): the nearest `max_neighbors` nearer than
/// `radius`. The point itself is one of them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Neighborhood {
    /// Data units; above 0.
    pub radius: f64,
    /// The point itself counts.
    pub max_neighbors: usize,
}

impl Neighborhood {
    pub(super) fn check(&self, least: usize, allowed: &'static str) -> Result<(), FeatureError> {
        check_length("radius", self.radius)?;
        if self.max_neighbors < least {
            let value = self.max_neighbors as f64;
            return Err(FeatureError::Setting { argument: "max_neighbors", value, allowed });
        }
        Ok(())
    }
}

/// How many points are looked at side by side.
const LANES: usize = 8;

/// Points that one thread takes at a time.
const GRAIN: usize = 256;

/// The same where a step is a look into memory.
const GATHER: usize = 1 << 14;

/// Where the cells within the radius hold so many times as many points as may count, the nearest are looked for within
/// less, such that the cells hold about so many times as many, and then within twice as much.
const CROWDED: f64 = 64.0;
const FEW: f64 = 8.0;

/// Points by which that is told, and how often it is narrowed at most.
const SAMPLE: usize = 64;
const MOST_NARROWINGS: usize = 16;

/// Cells for each radius. Smaller ones fit the ball better and are more to walk through.
const CELLS_PER_RADIUS: f64 = 1.5;

/// A cloud in the order of its cells. A *place* is a position in that order.
pub(super) struct Around {
    grid: Grid,
    /// Coordinates by place, with `LANES` points at infinity at the end.
    points: [Vec<f64>; 3],
    /// The same, one after the other, for those that count.
    rows: Vec<[f64; 3]>,
    /// The same relative to the middle, in reaches: where the grid has them.
    local: Vec<[f32; 3]>,
    neighborhood: Neighborhood,
    /// How far is looked at first: the radius, or less where that holds far more points than may count.
    reach: f64,
}

/// The neighbours of one point.
#[derive(Default)]
pub(super) struct Others {
    place: Vec<u32>,
    dist_sq: Vec<f64>,
    len: usize,
    /// Among so many points they were found.
    looked_at: usize,
    radius_sq: f64,
    /// Those among which the cut falls.
    doubtful: Vec<(f64, u32, u32)>,
}

impl Others {
    pub(super) fn places(&self) -> &[u32] {
        &self.place[..self.len]
    }

    pub(super) fn dist_sq(&self) -> &[f64] {
        &self.dist_sq[..self.len]
    }

    pub(super) fn radius_sq(&self) -> f64 {
        self.radius_sq
    }

    fn push(&mut self, place: u32, dist_sq: f64, counts: bool) {
        self.place[self.len] = place;
        self.dist_sq[self.len] = dist_sq;
        self.len += usize::from(counts);
    }
}

impl Around {
    /// `Interrupted` is its only error.
    pub(super) fn new(
        points: &[Point3<f64>],
        neighborhood: Neighborhood,
        interrupt: &Interrupt,
    ) -> Result<Self, FeatureError> {
        let mut around = Self::within(points, neighborhood, neighborhood.radius, interrupt)?;
        for _ in 0..MOST_NARROWINGS {
            let Some(reach) = around.narrower() else { break };
            around = Self::within(points, neighborhood, reach, interrupt)?;
        }
        Ok(around)
    }

    /// For questions that go as far as `reach` at first.
    fn within(
        points: &[Point3<f64>],
        neighborhood: Neighborhood,
        reach: f64,
        interrupt: &Interrupt,
    ) -> Result<Self, FeatureError> {
        // Each step takes tens of milliseconds for millions of points.
        let proceed = || if interrupt.is_set() { Err(FeatureError::Interrupted) } else { Ok(()) };
        let rows = columns(points, middle(points), reach);
        proceed()?;
        let grid = Grid::new(&rows, (1.0 / CELLS_PER_RADIUS) as f32);
        proceed()?;
        let order = grid.order();
        let sorted = par::chunks(order.len(), GATHER, |run| {
            order[run].iter().map(|&row| points[row as usize].coords.into()).collect::<Vec<[f64; 3]>>()
        });
        let sorted = sorted.concat();
        proceed()?;
        let far = [f64::INFINITY; LANES];
        let columns = [0, 1, 2].map(|axis| sorted.iter().map(|p| p[axis]).chain(far).collect());
        proceed()?;
        let local = |&row: &u32| rows.each_ref().map(|axis| axis[row as usize]);
        let local = par::chunks(order.len(), GATHER, |run| order[run].iter().map(local).collect::<Vec<_>>());
        Ok(Self { points: columns, local: local.concat(), rows: sorted, grid, neighborhood, reach })
    }

    /// A reach within which there should be a few times as many points as may count, if there are far more within the one at
    /// hand.
    fn narrower(&self) -> Option<f64> {
        let n = self.local.len();
        let mut counts: Vec<usize> = self
            .local
            .iter()
            .step_by(n.div_ceil(SAMPLE).max(1))
            .map(|&place| self.grid.around(place, 1.0).map(|run| run.len()).sum())
            .collect();
        if counts.is_empty() {
            return None;
        }
        let half = counts.len() / 2;
        let count = *counts.select_nth_unstable(half).1 as f64;
        let most = self.neighborhood.max_neighbors as f64;
        // As on a surface; in a volume it is less than could be, and then is doubled.
        (count > CROWDED * most).then(|| self.reach * (FEW * most / count).sqrt())
    }

    /// The rows of the cloud by place.
    pub(super) fn order(&self) -> &[u32] {
        self.grid.order()
    }

    /// Where a place lies.
    #[inline]
    pub(super) fn point(&self, place: usize) -> [f64; 3] {
        self.rows[place]
    }

    pub(super) fn inv_radius(&self) -> f64 {
        1.0 / self.neighborhood.radius
    }

    /// What `each(place, neighbours)` makes of all `places`, in their order.
    ///
    /// `each` is compiled for the vector units at hand if it is inlined.
    pub(super) fn map<T: Send, S: Default>(
        &self,
        places: &[u32],
        interrupt: &Interrupt,
        each: impl Fn(usize, &Others, &mut S) -> T + Sync + Send,
    ) -> Result<Vec<T>, FeatureError> {
        let parts = par::chunks(places.len(), GRAIN, |run| {
            if interrupt.is_set() {
                return Vec::new();
            }
            let (mut others, mut scratch) = (Others::default(), S::default());
            let mut pace = Pace::new(interrupt);
            let places = &places[run];
            let mut answers = Vec::with_capacity(places.len());
            // A loop: `collect` would not be seen through, and so not be compiled for the vector units.
            simd(
                #[inline(always)]
                || {
                    for &place in places {
                        self.find(place as usize, &mut others);
                        // A neighbourhood may be all of the cloud.
                        if pace.is_over(others.looked_at) {
                            return;
                        }
                        answers.push(each(place as usize, &others, &mut scratch));
                    }
                },
            );
            answers
        });
        if interrupt.is_set() {
            return Err(FeatureError::Interrupted);
        }
        Ok(parts.into_iter().flatten().collect())
    }

    /// The neighbours of a place but itself.
    #[inline(always)]
    #[allow(clippy::inline_always)] // the body of the loop above
    fn find(&self, place: usize, others: &mut Others) {
        let Neighborhood { radius, max_neighbors } = self.neighborhood;
        let most = max_neighbors - 1;
        let mut within = self.reach;
        others.looked_at = 0;
        loop {
            others.len = 0;
            others.radius_sq = within * within;
            self.grid.each_around(
                self.local[place],
                (within / self.reach) as f32,
                #[inline(always)]
                |run| self.look(place, run, others),
            );
            if others.len >= most || within >= radius {
                break;
            }
            within = (2.0 * within).min(radius);
        }
        if others.len > most {
            self.keep_nearest(most, others);
        }
        others.radius_sq = radius * radius;
    }

    #[inline(always)]
    #[allow(clippy::inline_always, clippy::needless_bitwise_bool)] // an inner loop without branches
    fn look(&self, place: usize, run: Range<usize>, others: &mut Others) {
        others.looked_at += run.len();
        let room = others.len + run.len() + LANES;
        if others.place.len() < room {
            others.place.resize(2 * room, 0);
            others.dist_sq.resize(2 * room, 0.0);
        }
        let [px, py, pz] = self.points.each_ref().map(Vec::as_slice);
        let (q, radius_sq) = (self.rows[place], others.radius_sq);
        let (places, dists_sq) = (others.place.as_mut_slice(), others.dist_sq.as_mut_slice());
        let mut len = others.len;
        for start in run.clone().step_by(LANES) {
            let (x, y, z) = (&px[start..start + LANES], &py[start..start + LANES], &pz[start..start + LANES]);
            let mut dist_sq = [0.0; LANES];
            for k in 0..LANES {
                let d = [x[k] - q[0], y[k] - q[1], z[k] - q[2]];
                dist_sq[k] = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
            }
            // A window of which the compiler knows the width, so that no index needs a check; and no branch, as about
            // half of the points count, in no order that a processor could foresee.
            let (places, dists_sq) = (&mut places[len..len + LANES], &mut dists_sq[len..len + LANES]);
            let mut found = 0;
            for (k, &dist_sq) in dist_sq.iter().enumerate() {
                let at = start + k;
                places[found % LANES] = at as u32;
                dists_sq[found % LANES] = dist_sq;
                // What lies beyond the end of the run comes up in another one.
                found += usize::from((dist_sq < radius_sq) & (at < run.end) & (at != place));
            }
            len += found;
        }
        others.len = len;
    }

    /// Drops all but the nearest; of equally near ones those of lower rows stay.
    ///
    /// A histogram finds the cut: on a surface as many points lie in each ring of equal area. Sorting takes five times
    /// as long.
    fn keep_nearest(&self, most: usize, others: &mut Others) {
        const RINGS: usize = 64;
        let to_ring = RINGS as f64 / others.radius_sq;
        let ring = |dist_sq: f64| ((dist_sq * to_ring) as usize).min(RINGS - 1);
        let mut counts = [0; RINGS];
        others.dist_sq().iter().for_each(|&d| counts[ring(d)] += 1);
        let (mut cut, mut within) = (0, 0);
        while within + counts[cut] <= most {
            within += counts[cut];
            cut += 1;
        }
        others.doubtful.clear();
        let found = others.len;
        others.len = 0;
        for i in 0..found {
            let (place, dist_sq) = (others.place[i], others.dist_sq[i]);
            let ring = ring(dist_sq);
            if ring == cut {
                others.doubtful.push((dist_sq, self.order()[place as usize], place));
            }
            others.push(place, dist_sq, ring < cut);
        }
        let mut doubtful = std::mem::take(&mut others.doubtful);
        doubtful.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        for &(dist_sq, _, place) in &doubtful[..most - within] {
            others.push(place, dist_sq, true);
        }
        others.doubtful = doubtful;
    }
}
