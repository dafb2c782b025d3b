//! What the doors of registration and of features have to look for.

use nalgebra::Vector3;

/// Above this a square is no longer finite in `f64`, whatever it is multiplied with.
pub(crate) const MAX_COORDINATE: f64 = 1e100;

/// The first of `rows` that is NaN, infinite, or so large that its square is: where it is, and the row.
pub(crate) fn first_not_finite(rows: impl IntoIterator<Item = Vector3<f64>>) -> Option<(usize, [f64; 3])> {
    let bad = |v: &Vector3<f64>| !v.iter().all(|x| x.abs() < MAX_COORDINATE); // catches NaN too
    rows.into_iter().enumerate().find(|(_, v)| bad(v)).map(|(row, v)| (row, v.into()))
}

/// Finite vectors at length 1; else the row of the first that has no direction.
pub(crate) fn unit_vectors(rows: &[Vector3<f64>]) -> Result<Vec<Vector3<f64>>, usize> {
    rows.iter().enumerate().map(|(row, v)| v.try_normalize(0.0).ok_or(row)).collect()
}
