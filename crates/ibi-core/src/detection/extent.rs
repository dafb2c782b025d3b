//! How large a cloud is, a few far points left out.

use nalgebra::Point3;

/// Share of the points on either end of an axis that do not count: far pixels. Told by so many points.
const TAIL: f64 = 0.01;
const MANY: usize = 20_000;

/// Diagonal of the box around all points but a few far ones; 0 without points.
pub(super) fn extent(points: &[Point3<f64>]) -> f64 {
    let sides = [0, 1, 2].map(|axis| {
        let mut values: Vec<f64> = points.iter().step_by(1 + points.len() / MANY).map(|p| p[axis]).collect();
        values.sort_unstable_by(f64::total_cmp);
        quantile(&values, 1.0 - TAIL) - quantile(&values, TAIL)
    });
    sides.map(|side| side * side).iter().sum::<f64>().sqrt()
}

/// Of sorted values, between the two next to it; 0 of none.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else { return 0.0 };
    let at = share * last as f64;
    let (low, high) = (sorted[at as usize], sorted[last.min(at as usize + 1)]);
    low + (high - low) * at.fract()
}
