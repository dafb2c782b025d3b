//! Nearest neighbours at any distance. The only file that names `kiddo`.
//!
//! What the rounds ask again and again is asked of [`super::nearby`], within a reach.
//!
//! `ImmutableKdTree` and not `KdTree`: flat CAD faces put hundreds of points on one axis value, where the
//! mutable tree panics once a leaf overflows. kiddo's squared-Euclidean metric returns squared distances,
//! so every distance that leaves this file is called `dist_sq`.

use kiddo::SquaredEuclidean;
use kiddo::immutable::float::kdtree::ImmutableKdTree;
use nalgebra::Point3;

use super::par;
use crate::interrupt::Interrupt;

/// Points of a tree at most. Building one cannot be interrupted, so a larger cloud has several, side by side.
const MOST: usize = 1 << 17;

/// A kd-tree over a cloud; ids are the rows of the cloud it was built from.
pub struct Neighbors {
    // kiddo cannot build a tree of no points: then there is none.
    parts: Vec<Part>,
}

/// The points of a box.
struct Part {
    low: [f64; 3],
    high: [f64; 3],
    /// The row of each, unless these are all.
    rows: Option<Vec<u32>>,
    tree: ImmutableKdTree<f64, u32, 3, 32>,
}

impl Neighbors {
    /// Builds the tree. O(n log n).
    #[must_use]
    pub fn new(points: &[Point3<f64>]) -> Self {
        Self::until(points, &Interrupt::never()).unwrap_or(Self { parts: Vec::new() })
    }

    /// The same; `None` if interrupted.
    #[must_use]
    pub fn until(points: &[Point3<f64>], interrupt: &Interrupt) -> Option<Self> {
        let mut runs = vec![(0..points.len() as u32).collect::<Vec<_>>()];
        while runs.iter().any(|rows| rows.len() > MOST) {
            let halved = par::map(runs.len(), 1, |i| {
                if interrupt.is_set() { Vec::new() } else { halved(points, runs[i].clone()) }
            });
            if interrupt.is_set() {
                return None;
            }
            runs = halved.concat();
        }
        let is_one = runs.len() == 1;
        let parts = par::map(runs.len(), 1, |i| {
            if interrupt.is_set() || runs[i].is_empty() {
                return None;
            }
            let of: Vec<[f64; 3]> = runs[i].iter().map(|&row| points[row as usize].coords.into()).collect();
            let bound = |least: fn(f64, f64) -> f64, first| {
                [0, 1, 2].map(|axis| of.iter().fold(first, |bound, p| least(bound, p[axis])))
            };
            Some(Part {
                low: bound(f64::min, f64::INFINITY),
                high: bound(f64::max, f64::NEG_INFINITY),
                rows: (!is_one).then(|| runs[i].clone()),
                tree: ImmutableKdTree::new_from_slice(&of),
            })
        });
        (!interrupt.is_set()).then(|| Self { parts: parts.into_iter().flatten().collect() })
    }

    /// The nearest point: its row and squared distance. `None` for an empty cloud.
    #[must_use]
    pub fn nearest(&self, query: &Point3<f64>) -> Option<(u32, f64)> {
        let query = query.coords.into();
        if let [part] = self.parts.as_slice() {
            return Some(part.nearest(&query));
        }
        // The part nearest to the query first, which leaves few of the others.
        let gaps_sq = self.parts.iter().map(|part| part.gap_sq(&query));
        let (first, _) = gaps_sq.enumerate().min_by(|a, b| a.1.total_cmp(&b.1))?;
        let mut best = self.parts[first].nearest(&query);
        for (at, part) in self.parts.iter().enumerate() {
            if at != first && part.gap_sq(&query) < best.1 {
                let other = part.nearest(&query);
                if other.1 < best.1 {
                    best = other;
                }
            }
        }
        Some(best)
    }
}

impl Part {
    fn nearest(&self, query: &[f64; 3]) -> (u32, f64) {
        let hit = self.tree.nearest_one::<SquaredEuclidean>(query);
        (self.rows.as_ref().map_or(hit.item, |rows| rows[hit.item as usize]), hit.distance)
    }

    /// The squared distance of a place from the box.
    fn gap_sq(&self, query: &[f64; 3]) -> f64 {
        let gap = |axis: usize| (self.low[axis] - query[axis]).max(query[axis] - self.high[axis]).max(0.0);
        (0..3).map(|axis| gap(axis) * gap(axis)).sum()
    }
}

/// Rows of a large part, as two: on either side of the middle of the axis on which they spread most.
fn halved(points: &[Point3<f64>], mut rows: Vec<u32>) -> Vec<Vec<u32>> {
    if rows.len() <= MOST {
        return vec![rows];
    }
    let first = points[rows[0] as usize];
    let of = |row: &u32| points[*row as usize];
    let (low, high) = rows.iter().map(of).fold((first, first), |(low, high), p| (low.inf(&p), high.sup(&p)));
    let axis = (high - low).imax();
    let middle = rows.len() / 2;
    rows.select_nth_unstable_by(middle, |&a, &b| {
        points[a as usize][axis].total_cmp(&points[b as usize][axis]).then(a.cmp(&b))
    });
    let rest = rows.split_off(middle);
    vec![rows, rest]
}

impl std::fmt::Debug for Neighbors {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Neighbors").finish_non_exhaustive()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests may panic")]
mod tests {
    use super::*;
    use crate::kernels::rng::Rng;

    // Several trees answer as one comparison with all points does.
    #[test]
    fn a_large_cloud_in_parts() {
        let mut rng = Rng::new(1, 0, 0);
        let mut point = |half: f64| Point3::from([0; 3].map(|_: u32| half * (rng.unit() - 0.5)));
        let cloud: Vec<_> =
            (0..2 * MOST + 100).map(|row| point(if row % 3 == 0 { 1e-3 } else { 1.0 })).collect();
        let tree = Neighbors::new(&cloud);
        assert!(tree.parts.len() > 2);
        for _ in 0..100 {
            let query = point(1.5);
            let least = cloud.iter().map(|p| (p - query).norm_squared()).fold(f64::INFINITY, f64::min);
            let (row, dist_sq) = tree.nearest(&query).unwrap();
            assert!((dist_sq - least).abs() <= 1e-15 * (1.0 + least));
            assert!(((cloud[row as usize] - query).norm_squared() - dist_sq).abs() <= 1e-15);
        }
    }
}
