//! The spread of points.

use nalgebra::{Matrix3, Vector3};

/// The direction of least spread of a symmetric matrix; `None` where there is no spread at all.
///
/// The roots of the characteristic polynomial in closed form (Smith 1961). Where the two least are nearly one, as for
/// points on a line, it loses digits, and the iteration takes over: ten times as slow.
pub(crate) fn least_axis(spread: &Matrix3<f64>) -> Option<Vector3<f64>> {
    let size = spread.amax();
    if size <= 0.0 {
        return None;
    }
    let a = spread / size;
    let mean = a.trace() / 3.0;
    let off = a - Matrix3::from_diagonal_element(mean);
    let width = (off.norm_squared() / 6.0).sqrt();
    if width > 0.0 {
        let turn = (0.5 * (off / width).determinant()).clamp(-1.0, 1.0).acos() / 3.0;
        let least = mean + 2.0 * width * (turn + std::f64::consts::TAU / 3.0).cos();
        let rest = a - Matrix3::from_diagonal_element(least);
        let [x, y, z] = [0, 1, 2].map(|c| rest.column(c).into_owned());
        // Each is across two columns, and so across all; its length is the area that they span.
        let across = [x.cross(&y), y.cross(&z), z.cross(&x)];
        let areas = across.map(|v| v.norm());
        let best = (0..3).fold(0, |best, k| if areas[k] > areas[best] { k } else { best });
        if areas[best] > 1e-3 * width * width {
            return Some(across[best] / areas[best]);
        }
    }
    let eigen = a.symmetric_eigen();
    eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned().try_normalize(0.0)
}
