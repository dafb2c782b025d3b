//! Where a scan may have been seen from, where nobody tells.

use nalgebra::{Point3, Vector3};

use crate::kernels::overlap::MIN_FACING_COS;
use crate::kernels::rng::Rng;
use crate::kernels::sight::spread;

/// Places that are tried, points of the scan that are asked how many of them each of these sees, how many of the places that see most
/// stay in the choice, and how many of those, far from each other, are taken.
const TRIED: usize = 400;
const ASKED: usize = 4000;
const BEST: usize = 100;
const TAKEN: usize = 12;

/// How far before the scan's surfaces they are tried, diameters of the model: from there a camera sees all of it, and it is likely that
/// there is nothing in the way.
const BEFORE: [f64; 2] = [0.7, 1.5];

/// Places in the open before the surfaces of a scan from which most of it faces them; `normals` are outward ones of length 1, and
/// `diameter` is the model's.
///
/// A scan that was fused from all sides does not tell where its cameras were. But where a part is missing, what is behind it was seen,
/// and that is as true of any place from which one looks there.
///
/// # Complexity
/// O(1): of points drawn from the scan.
pub(super) fn standpoints(
    points: &[Point3<f64>],
    normals: &[Vector3<f64>],
    diameter: f64,
) -> Vec<Point3<f64>> {
    if points.is_empty() {
        return Vec::new();
    }
    let mut rng = Rng::new(0, 0, 0);
    let places: Vec<Point3<f64>> = (0..TRIED)
        .map(|_| {
            let row = rng.below(points.len());
            points[row] + normals[row] * diameter * (BEFORE[0] + (BEFORE[1] - BEFORE[0]) * rng.unit())
        })
        .collect();
    let asked: Vec<usize> = (0..ASKED).map(|_| rng.below(points.len())).collect();
    let num_facing = |place: &Point3<f64>| {
        let faces = |&&row: &&usize| {
            let to_eye = place - points[row];
            normals[row].dot(&to_eye) > MIN_FACING_COS * to_eye.norm()
        };
        asked.iter().filter(faces).count()
    };
    let mut best: Vec<(usize, Point3<f64>)> =
        places.iter().map(|place| (num_facing(place), *place)).collect();
    // Stable: of equals the first.
    best.sort_by_key(|&(num, _)| std::cmp::Reverse(num));
    best.truncate(BEST);
    let far = |a: usize, b: usize| (best[a].1 - best[b].1).norm_squared();
    spread(0, TAKEN, best.len(), far).into_iter().map(|at| best[at].1).collect()
}
