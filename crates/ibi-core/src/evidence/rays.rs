//! What one eye measured, at full resolution: points by the direction in which they were seen.

use nalgebra::{Point3, Vector3};

use crate::kernels::grid::buckets;

/// Points by the direction in which an eye saw them, all around it: six images, one to each side of a cube.
#[derive(Debug)]
pub struct Rays {
    eye: Point3<f64>,
    spacing: f64,
    sides: Vec<Side>,
}

/// Rays in one sixth of all directions and a little beyond: those of which one coordinate, of one sign, is the largest.
#[derive(Debug, Default)]
struct Side {
    /// On the screen at distance 1: the other two coordinates over the largest one.
    low: [f64; 2],
    inv_cell: f64,
    shape: [usize; 2],
    /// Where each cell's points begin.
    starts: Vec<u32>,
    /// From the eye to the points, cell by cell.
    ends: Vec<Vector3<f64>>,
    rows: Vec<u32>,
}

/// Least cosine between the normal of a point and the way to the eye: what is seen from its edge is measured badly or not at all.
pub const MIN_FACING_COS: f64 = 0.15;

/// Whether a surface is turned towards an eye enough to be measured.
#[must_use]
pub fn faces(eye: &Point3<f64>, at: &Point3<f64>, normal: &Vector3<f64>) -> bool {
    let to_eye = eye - at;
    normal.dot(&to_eye) > MIN_FACING_COS * to_eye.norm()
}

/// The widest angle about a direction in which rays are looked for, radians: for what is wider, it is too near.
pub const MAX_ANGLE: f64 = 0.1;

/// Width of a cell in spacings of the rays: a question looks at few cells, and at few points in each.
const CELL_SPACINGS: f64 = 1.5;

/// Cells on a side at most.
const MAX_CELLS: f64 = 2048.0;

/// Rays whose nearest is looked up to know how far apart they are.
const SAMPLE: usize = 512;

impl Rays {
    /// Of all points that an eye measured. `None` if there are not two that lie in different directions.
    ///
    /// # Complexity
    /// O(points).
    #[must_use]
    pub fn new(eye: Point3<f64>, points: &[Point3<f64>]) -> Option<Self> {
        let ends: Vec<Vector3<f64>> = points.iter().map(|p| p - eye).collect();
        let mut of_side = vec![Vec::new(); 6];
        for (row, end) in (0..).zip(&ends) {
            if end.norm_squared() > 0.0 {
                for (side, rows) in of_side.iter_mut().enumerate() {
                    if on_screen(side, end).is_some_and(|at| at[0].abs().max(at[1].abs()) <= 1.0 + margin()) {
                        rows.push(row);
                    }
                }
            }
        }
        let fullest = (0..6).max_by_key(|&side| of_side[side].len())?;
        let rough = Side::new(fullest, &ends, &of_side[fullest], None);
        let spacing = rough.spacing(fullest)?;
        let sides = (0..6).map(|side| Side::new(side, &ends, &of_side[side], Some(CELL_SPACINGS * spacing)));
        Some(Self { eye, spacing, sides: sides.collect() })
    }

    /// Where the eye is.
    #[must_use]
    pub fn eye(&self) -> &Point3<f64> {
        &self.eye
    }

    /// All measured points, by row.
    #[must_use]
    pub fn all(&self) -> Vec<Point3<f64>> {
        let of_side =
            |side: &Side| side.rows.iter().copied().zip(side.ends.iter().copied()).collect::<Vec<_>>();
        let mut all: Vec<(u32, Vector3<f64>)> = self.sides.iter().flat_map(of_side).collect();
        all.sort_unstable_by_key(|&(row, _)| row);
        // Those at the edge of a side are in both.
        all.dedup_by_key(|&mut (row, _)| row);
        all.into_iter().map(|(_, end)| self.eye + end).collect()
    }

    /// The angle between neighbouring rays, radians: the median over rays of that to the nearest one.
    #[must_use]
    pub fn spacing(&self) -> f64 {
        self.spacing
    }

    /// Tells `found(end, row)` of each measured point in a direction within `angle` (radians, at most [`MAX_ANGLE`]) of the
    /// one to `at`; `end` is the way to it from the eye. In no particular order.
    pub fn each_near(&self, at: &Point3<f64>, angle: f64, mut found: impl FnMut(&Vector3<f64>, u32)) {
        let to = at - self.eye;
        let range_sq = to.norm_squared();
        if range_sq == 0.0 {
            return;
        }
        let largest = to.iamax();
        let side = 2 * largest + usize::from(to[largest] < 0.0);
        let Some(place) = on_screen(side, &to) else { return };
        let tan = angle.clamp(0.0, MAX_ANGLE).tan();
        // The cosine of the angle, squared, without leaving the squares.
        let least = range_sq / (1.0 + tan * tan);
        self.sides[side].each_around(&place, reach(&place, tan), |end, row| {
            let along = end.dot(&to);
            if along > 0.0 && along * along >= least * end.norm_squared() {
                found(end, row);
            }
        });
    }
}

/// Rows of the points that an eye may have measured, of a scan that was fused from what many did: those that face it and have
/// nothing of the scan before them. `normals` are towards the eyes that saw the points, and `spacing` is how far apart the points lie.
///
/// A point hides what lies behind it within 0.75 spacings of the line of sight, unless it lies in the same surface.
///
/// # Complexity
/// O(points), times those behind each.
#[must_use]
pub fn visible(
    eye: &Point3<f64>,
    points: &[Point3<f64>],
    normals: &[Vector3<f64>],
    spacing: f64,
) -> Vec<u32> {
    let faces = |row: &u32| faces(eye, &points[*row as usize], &normals[*row as usize]);
    let rows: Vec<u32> = (0..points.len() as u32).filter(faces).collect();
    let facing: Vec<Point3<f64>> = rows.iter().map(|&row| points[row as usize]).collect();
    let Some(rays) = Rays::new(*eye, &facing) else { return rows };
    let mut is_hidden = vec![false; rows.len()];
    for point in &facing {
        let to = point - eye;
        let range = to.norm();
        rays.each_near(point, (COVERS * spacing / range).atan(), |end, row| {
            let before = to - end;
            let normal = &normals[rows[row as usize] as usize];
            if end.norm() > range + spacing && before.dot(normal) > RISE * before.norm() {
                is_hidden[row as usize] = true;
            }
        });
    }
    rows.into_iter().zip(is_hidden).filter_map(|(row, is_hidden)| (!is_hidden).then_some(row)).collect()
}

/// How far aside of a line of sight a point hides what is behind it, in spacings, and the least share of the distance by which it
/// rises above the tangent plane of what it hides.
const COVERS: f64 = 0.75;
const RISE: f64 = 0.25;

/// How far beyond its own sixth of the directions a side knows rays, so that a question is asked of one side only.
fn margin() -> f64 {
    reach(&[1.0, 1.0], MAX_ANGLE.tan())
}

/// How far from a place on the screen a direction may lie that is an angle of that tangent off.
fn reach(place: &[f64; 2], tan: f64) -> f64 {
    let aside_sq = place[0] * place[0] + place[1] * place[1];
    (1.0 + aside_sq) * tan / (1.0 - aside_sq.sqrt() * tan)
}

/// Where a way from the eye meets the screen of a side; `None` if it leads away from it.
fn on_screen(side: usize, way: &Vector3<f64>) -> Option<[f64; 2]> {
    let axis = side / 2;
    let ahead = if side.is_multiple_of(2) { way[axis] } else { -way[axis] };
    (ahead > 0.0).then(|| [way[(axis + 1) % 3] / ahead, way[(axis + 2) % 3] / ahead])
}

impl Side {
    /// Of rows of the `ends`; with cells as wide as they would be if one point were in each, or as given.
    fn new(side: usize, ends: &[Vector3<f64>], rows: &[u32], cell: Option<f64>) -> Self {
        let places: Vec<[f64; 2]> =
            rows.iter().map(|&row| on_screen(side, &ends[row as usize]).unwrap_or_default()).collect();
        let Some(&first) = places.first() else { return Self::default() };
        let (mut low, mut high) = (first, first);
        for place in &places {
            for k in 0..2 {
                (low[k], high[k]) = (low[k].min(place[k]), high[k].max(place[k]));
            }
        }
        let size = [high[0] - low[0], high[1] - low[1]];
        let filled = (size[0] * size[1] / rows.len() as f64).sqrt();
        let cell = cell.unwrap_or(filled).max(size[0].max(size[1]) / MAX_CELLS).max(1e-9);
        let inv_cell = 1.0 / cell;
        let shape = size.map(|size| (size * inv_cell) as usize + 1);
        let cell_of = |place: &[f64; 2]| {
            let [x, y] = [0, 1].map(|k| ((place[k] - low[k]) * inv_cell) as usize);
            x.min(shape[0] - 1) * shape[1] + y.min(shape[1] - 1)
        };
        let keyed = rows.iter().copied().zip(places.iter().map(cell_of));
        let (starts, rows) = buckets(shape[0] * shape[1], keyed);
        let ends = rows.iter().map(|&row| ends[row as usize]).collect();
        Self { low, inv_cell, shape, starts, ends, rows }
    }

    /// Tells of all points in the cells within `reach` of a place.
    fn each_around(&self, place: &[f64; 2], reach: f64, mut found: impl FnMut(&Vector3<f64>, u32)) {
        if self.rows.is_empty() {
            return;
        }
        let (mut first, mut last) = ([0; 2], [0; 2]);
        for k in 0..2 {
            let [low, high] = [place[k] - reach, place[k] + reach].map(|x| (x - self.low[k]) * self.inv_cell);
            if high < 0.0 || low >= self.shape[k] as f64 {
                return;
            }
            (first[k], last[k]) = (low.max(0.0) as usize, (high as usize).min(self.shape[k] - 1));
        }
        for column in first[0]..=last[0] {
            let [from, to] = [first[1], last[1] + 1].map(|cell| column * self.shape[1] + cell);
            let run = self.starts[from] as usize..self.starts[to] as usize;
            for (end, &row) in self.ends[run.clone()].iter().zip(&self.rows[run]) {
                found(end, row);
            }
        }
    }

    /// The median over some of the rays of the angle to the nearest one in another direction.
    fn spacing(&self, side: usize) -> Option<f64> {
        let step = self.ends.len().div_ceil(SAMPLE).max(1);
        let mut nearest: Vec<f64> =
            (0..self.ends.len()).step_by(step).filter_map(|at| self.nearest(side, at)).collect();
        let middle = nearest.len() / 2;
        (!nearest.is_empty()).then(|| *nearest.select_nth_unstable_by(middle, f64::total_cmp).1)
    }

    /// The angle from a ray to the nearest one in another direction.
    fn nearest(&self, side: usize, at: usize) -> Option<f64> {
        let own = &self.ends[at];
        let place = on_screen(side, own)?;
        let widest = self.shape[0].max(self.shape[1]);
        let mut cells = 1;
        loop {
            let reach = cells as f64 / self.inv_cell;
            let mut least = f64::INFINITY;
            self.each_around(&place, reach, |end, _| {
                let sin = own.cross(end).norm() / (own.norm() * end.norm());
                if sin > SAME_RAY {
                    least = least.min(sin.min(1.0).asin());
                }
            });
            // What lies that near on the screen lies nearer in angle.
            if least <= reach / (1.0 + place[0] * place[0] + place[1] * place[1]) || cells > widest {
                return least.is_finite().then_some(least);
            }
            cells *= 2;
        }
    }
}

/// Points in directions that differ by less, radians, lie on one ray.
const SAME_RAY: f64 = 1e-6;
