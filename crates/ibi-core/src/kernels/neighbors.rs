//! Nearest neighbours. The only file that names `kiddo`.
//!
//! `ImmutableKdTree` and not `KdTree`: flat CAD faces put hundreds of points on one axis value, where the
//! mutable tree panics once a leaf overflows. kiddo's squared-Euclidean metric returns squared distances,
//! so every distance that leaves this file is called `dist_sq`.

use std::num::NonZero;

use kiddo::SquaredEuclidean;
use kiddo::immutable::float::kdtree::ImmutableKdTree;
use nalgebra::Point3;

use super::par;

/// A kd-tree over a cloud; ids are the rows of the cloud it was built from.
pub struct Neighbors {
    // kiddo cannot build a tree of no points, hence the option.
    tree: Option<ImmutableKdTree<f64, u32, 3, 32>>,
}

impl Neighbors {
    /// Builds the tree. O(n log n).
    #[must_use]
    pub fn new(points: &[Point3<f64>]) -> Self {
        let rows: Vec<[f64; 3]> = points.iter().map(|p| p.coords.into()).collect();
        Self { tree: (!rows.is_empty()).then(|| ImmutableKdTree::new_from_slice(&rows)) }
    }

    /// The nearest point: its row and squared distance. `None` for an empty cloud.
    #[must_use]
    pub fn nearest(&self, query: &Point3<f64>) -> Option<(u32, f64)> {
        let hit = self.tree.as_ref()?.nearest_one::<SquaredEuclidean>(&query.coords.into());
        Some((hit.item, hit.distance))
    }

    /// Rows of the points within `distance` of the query, in no particular order.
    pub fn within(&self, query: &Point3<f64>, distance: f64) -> impl Iterator<Item = u32> + use<> {
        let hits = self
            .tree
            .as_ref()
            .map(|tree| tree.within_unsorted::<SquaredEuclidean>(&query.coords.into(), distance * distance));
        hits.into_iter().flatten().map(|hit| hit.item)
    }

    /// Mean distance from a point of `points` (those the tree was built from) to its nearest other point; 0
    /// for fewer than two points. Points that coincide are 0 apart.
    #[must_use]
    pub fn mean_spacing(&self, points: &[Point3<f64>]) -> f64 {
        const TWO: NonZero<usize> = NonZero::<usize>::MIN.saturating_add(1);
        let Some(tree) = &self.tree else { return 0.0 };
        let spacing = par::map(points.len(), 256, |i| {
            // The nearest is the point itself, or one at the same place.
            let hits = tree.nearest_n::<SquaredEuclidean>(&points[i].coords.into(), TWO);
            hits.get(1).map_or(0.0, |hit| hit.distance.sqrt())
        });
        spacing.iter().sum::<f64>() / points.len() as f64
    }
}

impl std::fmt::Debug for Neighbors {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Neighbors").finish_non_exhaustive()
    }
}
