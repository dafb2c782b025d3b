//! Points that were given twice: they would pass for a scan that is finer, and less noisy, than it is.

use std::collections::HashSet;

use nalgebra::Point3;

use super::extent::extent;

/// Points nearer than this to each other, in diagonals of the box around the bulk of them, are one: far less than the spacing of any camera.
const NEAR: f64 = 1e-4;

/// A cell of so many is looked into, chosen by its place, so that all of its points are; where fewer than so many of a hundred of its points
/// are twins, there are none.
const CELLS: u64 = 16;
const FEW_PERCENT: usize = 1;

/// The rows of the first of each few points that coincide, or nearly do; `None` where hardly any do.
///
/// # Complexity
/// O(points).
pub(super) fn distinct(points: &[Point3<f64>]) -> Option<Vec<usize>> {
    let (&first, cell) = (points.first()?, NEAR * extent(points));
    if !(cell > 0.0 && cell.is_finite()) {
        return None;
    }
    // A cast saturates: far strays are one.
    let cell_of = |row: usize, shift: f64| -> [i64; 3] {
        (points[row] - first).map(|along| (along / cell + shift).floor() as i64).into()
    };
    let some: Vec<_> = (0..points.len())
        .map(|row| cell_of(row, 0.25))
        .filter(|cell| mixed(cell).is_multiple_of(CELLS))
        .collect();
    let num_cells = some.iter().collect::<HashSet<_>>().len();
    if 100 * (some.len() - num_cells) <= FEW_PERCENT * some.len() {
        return None;
    }
    // Twice, on lattices half a cell apart: twins may lie on both sides of the border of one.
    let mut rows: Vec<usize> = (0..points.len()).collect();
    for shift in [0.25, 0.75] {
        let mut seen = HashSet::with_capacity(rows.len());
        rows.retain(|&row| seen.insert(cell_of(row, shift)));
    }
    Some(rows)
}

/// A number for a cell, of which all bits depend on its place.
fn mixed(cell: &[i64; 3]) -> u64 {
    let mixed = cell
        .iter()
        .fold(0_u64, |sum, &at| (sum ^ at as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29));
    mixed ^ (mixed >> 32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::rng::Rng;

    fn cloud(len: usize) -> Vec<Point3<f64>> {
        let mut rng = Rng::new(3, 0, 0);
        let mut at = || f64::from(rng.below(1 << 20) as u32) / f64::from(1 << 20);
        (0..len).map(|_| Point3::new(at() - 0.5, at() - 0.5, 0.0)).collect()
    }

    #[test]
    fn of_each_place_the_first_point_stays() {
        let points = cloud(5000);
        assert_eq!(distinct(&points), None);
        for shift in [0.0, 1e-6] {
            for share in [1, 2, 10] {
                let twins = points.iter().step_by(share).map(|p| p + nalgebra::Vector3::repeat(shift));
                let both: Vec<_> = points.iter().copied().chain(twins).collect();
                let kept = distinct(&both).unwrap_or_default();
                // Some lie as near to each other by chance, and some across both borders.
                let most = points.len() + if shift > 0.0 { points.len() / 50 } else { 0 };
                assert!((points.len() - 20..=most).contains(&kept.len()), "{shift} {share}: {}", kept.len());
                assert!(kept.is_sorted());
            }
        }
    }

    #[test]
    fn what_has_no_extent_has_no_twins() {
        assert_eq!(distinct(&[]), None);
        assert_eq!(distinct(&[Point3::origin(); 9]), None);
    }
}
