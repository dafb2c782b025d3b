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
}

impl std::fmt::Debug for Neighbors {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Neighbors").finish_non_exhaustive()
    }
}
