//! Local reference frames: three axes at a point of a cloud that turn with the cloud, from its neighbourhood alone.

use nalgebra::{Matrix3, Point3, Vector3};

use super::nearby::Nearby;
use super::par;

/// Neighbours without which there is no frame: fewer lie on one plane.
const MIN_NEIGHBORS: usize = 4;

/// Two eigenvalues must differ by more than this part of the largest. Else any direction between the two axes would do.
const MIN_GAP: f64 = 1e-6;

/// Points that one thread takes at a time.
const GRAIN: usize = 64;

/// The frame at `centre`, its axes as rows, right-handed: the eigenvectors of the covariance about `centre`, in which a
/// neighbour at the distance d weighs `radius` - d, from the largest eigenvalue (x) to the smallest (z). The signs of x and
/// z are those to which most neighbours lie, of as many on either side the ones that weigh more; y = z x x. (Tombari, Salti &
/// Di Stefano 2010, SHOT.)
///
/// `None` for fewer than four neighbours, or if no direction is special.
#[must_use]
pub fn frame(
    centre: &Point3<f64>,
    neighbors: impl Iterator<Item = Point3<f64>> + Clone,
    radius: f64,
) -> Option<Matrix3<f64>> {
    // The point itself, and what coincides with it, lies in no direction.
    let around = neighbors.map(|point| point - centre).filter_map(|d| {
        let distance = d.norm();
        (distance > 0.0 && distance < radius).then_some((d, radius - distance))
    });
    let (mut n, mut covariance) = (0, Matrix3::zeros());
    for (d, weight) in around.clone() {
        n += 1;
        covariance += weight * d * d.transpose();
    }
    if n < MIN_NEIGHBORS {
        return None;
    }
    let eigen = covariance.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let [most, middle, least] = order.map(|i| eigen.eigenvalues[i]);
    if (most - middle).min(middle - least) <= MIN_GAP * most {
        return None;
    }
    let [x, z] = [order[0], order[2]].map(|i| {
        let axis: Vector3<f64> = eigen.eigenvectors.column(i).into_owned();
        let (mut side, mut pull) = (0, 0.0);
        for (d, weight) in around.clone() {
            let along = axis.dot(&d);
            side += if along >= 0.0 { 1 } else { -1 };
            pull += weight * along;
        }
        if side < 0 || (side == 0 && pull < 0.0) { -axis } else { axis }
    });
    let frame = Matrix3::from_rows(&[x.transpose(), z.cross(&x).transpose(), z.transpose()]);
    frame.iter().all(|value| value.is_finite()).then_some(frame)
}

/// The frames at the points `rows` of a cloud, which `nearby` was made from; `radius` in the unit of the points.
///
/// # Complexity
/// For each row the points within the radius of it.
#[must_use]
pub fn frames(
    points: &[Point3<f64>],
    nearby: &Nearby,
    rows: &[u32],
    radius: f64,
    interrupted: impl Fn() -> bool + Sync,
) -> Vec<Option<Matrix3<f64>>> {
    par::map(rows.len(), GRAIN, |at| {
        if interrupted() {
            return None;
        }
        let centre = &points[rows[at] as usize];
        // Read more than once, and dearly found.
        let around: Vec<Point3<f64>> =
            nearby.within(centre, radius).map(|row| points[row as usize]).collect();
        frame(centre, around.iter().copied(), radius)
    })
}
