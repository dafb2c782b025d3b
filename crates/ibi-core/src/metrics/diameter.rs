//! The diameter of a cloud.

use nalgebra::{Point3, Vector3};

/// Slack of the pruning bound: rounding may make a sum of two radii fall short of the true bound by a few
/// units in the last place, and a pair must not be lost to that.
const ROUNDING: f64 = 1.0 + 1e-12;

/// The largest distance between two points of a cloud, exactly; 0 for fewer than two points.
///
/// The unit in which ADD-S and MSSD thresholds are given. The answer is the one a comparison of all pairs
/// would give; only pairs that cannot be the farthest are left out. About the centroid c,
/// |p - q| <= |p - c| + |q - c|, so with the points sorted by that radius a whole tail of pairs falls once
/// the sum is below a distance already seen. Two sweeps to the farthest point give such a distance, most
/// often the diameter itself, before the search begins.
///
/// # Complexity
///
/// O(n log n) for the elongated shapes most parts are; O(n^2) at worst, for points all about equally far
/// from the centroid, as on a sphere.
///
/// # Examples
///
/// ```
/// use ibi_core::metrics::diameter;
/// use nalgebra::Point3;
///
/// let box_corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 2.0, 0.0], [1.0, 2.0, 2.0]].map(Point3::from);
/// assert_eq!(diameter(&box_corners), 3.0);
/// ```
#[must_use]
pub fn diameter(points: &[Point3<f64>]) -> f64 {
    if points.len() < 2 {
        return 0.0;
    }
    let sum = points.iter().fold(Vector3::zeros(), |sum, p| sum + p.coords);
    let centroid = Point3::from(sum / points.len() as f64);
    let mut by_radius: Vec<(f64, Point3<f64>)> = points.iter().map(|p| ((p - centroid).norm(), *p)).collect();
    by_radius.sort_unstable_by(|a, b| b.0.total_cmp(&a.0));

    let (one_end, _) = farthest(points, &by_radius[0].1);
    let (_, mut longest) = farthest(points, &one_end);

    for (rank, (radius, p)) in by_radius.iter().enumerate() {
        let rest = &by_radius[rank + 1..];
        // Every pair still to come is shorter than the best of this point's.
        if rest.first().is_none_or(|(next, _)| (radius + next) * ROUNDING < longest) {
            break;
        }
        for (other_radius, q) in rest {
            if (radius + other_radius) * ROUNDING < longest {
                break;
            }
            longest = longest.max((p - q).norm());
        }
    }
    longest
}

/// The point farthest from `from` and its distance.
fn farthest(points: &[Point3<f64>], from: &Point3<f64>) -> (Point3<f64>, f64) {
    points.iter().fold((*from, 0.0), |best, p| {
        let distance = (p - from).norm();
        if distance > best.1 { (*p, distance) } else { best }
    })
}

#[cfg(test)]
mod tests {
    use super::super::strategies::{isometries, points};
    use super::*;
    use proptest::prelude::*;

    /// The naive twin.
    fn brute_force(points: &[Point3<f64>]) -> f64 {
        points.iter().flat_map(|p| points.iter().map(move |q| (p - q).norm())).fold(0.0, f64::max)
    }

    proptest! {
        #[test]
        fn equals_the_comparison_of_all_pairs(cloud in points(0..60)) {
            prop_assert_eq!(diameter(&cloud), brute_force(&cloud));
        }

        // On a sphere nothing can be pruned by radius: the worst case must be right too.
        #[test]
        fn equals_the_comparison_of_all_pairs_on_a_sphere(cloud in points(2..60), offset in -1e3..1e3) {
            let sphere: Vec<_> = cloud
                .iter()
                .filter_map(|p| p.coords.try_normalize(1e-3))
                .map(|n| Point3::from(n.add_scalar(offset)))
                .collect();
            prop_assert_eq!(diameter(&sphere), brute_force(&sphere));
        }

        #[test]
        fn does_not_change_under_a_rigid_motion(cloud in points(0..60), motion in isometries()) {
            let moved: Vec<_> = cloud.iter().map(|p| motion * p).collect();
            prop_assert!((diameter(&moved) - diameter(&cloud)).abs() < 1e-9);
        }
    }

    #[test]
    fn of_a_grid_with_many_equal_pairs() {
        // 3 x 4 x 5 unit cells: the four space diagonals are all sqrt(9 + 16 + 25) = sqrt(50).
        let grid: Vec<_> = (0..=3)
            .flat_map(|x| (0..=4).flat_map(move |y| (0..=5).map(move |z| Point3::new(x, y, z).cast::<f64>())))
            .collect();
        assert_eq!(diameter(&grid), 50.0_f64.sqrt());
    }

    #[test]
    fn of_almost_nothing() {
        assert_eq!(diameter(&[]), 0.0);
        assert_eq!(diameter(&[Point3::new(1.0, 2.0, 3.0)]), 0.0);
        assert_eq!(diameter(&[Point3::new(1.0, 2.0, 3.0); 5]), 0.0);
    }
}
