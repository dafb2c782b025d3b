//! Which side of a surface is seen: what contradicts a viewpoint, or normals.

use nalgebra::{Point3, Vector3};

use crate::interrupt::Interrupt;
use crate::kernels::par;
use crate::kernels::sight::{across, direction};

/// A normal is clearly turned away from the eye.
const AWAY_COS: f64 = -0.2;

/// Width of a pixel, and how far behind others a point is hidden for sure, in voxels.
const PIXEL_VOXELS: f64 = 2.0;
const BEHIND_VOXELS: f64 = 4.0;

/// Directions that a model is looked at from, from how many of them a point must be seen to count, and how aslant.
const NUM_VIEWS: usize = 48;
const FEW_VIEWS: u32 = 2;
const VIEW_COS: f64 = 0.3;

/// Share of the points whose normals clearly face away from the eye.
pub(super) fn facing_away(points: &[Point3<f64>], normals: &[Vector3<f64>], eye: &Point3<f64>) -> f64 {
    let is_away = |(p, normal): &(&Point3<f64>, &Vector3<f64>)| {
        let way = eye - *p;
        way.dot(normal) < AWAY_COS * way.norm().max(1e-300)
    };
    share(points.iter().zip(normals).filter(is_away).count(), points.len())
}

/// Share of the points that others hide from the eye, of those that lie amidst others as it sees them.
///
/// A point is hidden if all nine pixels around it show something that is nearer by more than slant explains.
pub(super) fn hidden(points: &[Point3<f64>], eye: &Point3<f64>, voxel: f64) -> f64 {
    let ways: Vec<(Vector3<f64>, f64)> =
        points.iter().map(|p| (p - eye, (p - eye).norm())).filter(|way| way.1 > 0.0).collect();
    if ways.len() < 3 {
        return 0.0;
    }
    let mean = ways.iter().map(|(way, depth)| way / *depth).sum::<Vector3<f64>>();
    let Some(ahead) = mean.try_normalize(0.0) else { return 0.0 };
    let [right, up] = across(&ahead);
    let angle = PIXEL_VOXELS * voxel / median(ways.iter().map(|way| way.1).collect());
    let pixel = |(way, depth): &(Vector3<f64>, f64)| {
        let column = way.dot(&right).atan2(way.dot(&ahead));
        let row = (way.dot(&up) / depth).clamp(-1.0, 1.0).asin();
        [column, row].map(|at| (at / angle).floor() as i64)
    };
    let mut shown: Vec<([i64; 2], f64)> = ways.iter().map(|way| (pixel(way), way.1)).collect();
    shown.sort_unstable_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    // The nearest of each pixel.
    let mut nearest = shown.clone();
    nearest.dedup_by_key(|shown| shown.0);
    let depth_at =
        |pixel: [i64; 2]| nearest.binary_search_by_key(&pixel, |shown| shown.0).ok().map(|at| nearest[at].1);
    let front = |pixel: [i64; 2]| {
        let around = (0..9)
            .map(|i| depth_at([pixel[0].saturating_add(i / 3 - 1), pixel[1].saturating_add(i % 3 - 1)]));
        around.collect::<Option<Vec<f64>>>().map(|depths| depths.into_iter().fold(0.0, f64::max))
    };
    let (mut num_judged, mut num_behind) = (0, 0);
    for of_pixel in shown.chunk_by(|a, b| a.0 == b.0) {
        if let Some(front) = front(of_pixel[0].0) {
            num_judged += of_pixel.len();
            num_behind += of_pixel.iter().filter(|(_, depth)| *depth > front + BEHIND_VOXELS * voxel).count();
        }
    }
    share(num_behind, num_judged)
}

/// Share of the points that are seen from outside from their backs only, of those that are seen. `None` if interrupted.
pub(super) fn inward(
    points: &[Point3<f64>],
    normals: &[Vector3<f64>],
    spacing: f64,
    interrupt: &Interrupt,
) -> Option<f64> {
    let views = par::map(NUM_VIEWS, 1, |view| {
        if interrupt.is_set() {
            Vec::new()
        } else {
            nearest_rows(points, &direction(view, NUM_VIEWS), 2.0 * spacing)
        }
    });
    if interrupt.is_set() {
        return None;
    }
    let (mut fronts, mut backs) = (vec![0_u32; points.len()], vec![0_u32; points.len()]);
    for (view, rows) in views.into_iter().enumerate() {
        let to_eye = direction(view, NUM_VIEWS);
        for row in rows {
            let cos = normals[row].dot(&to_eye);
            fronts[row] += u32::from(cos > VIEW_COS);
            backs[row] += u32::from(cos < -VIEW_COS);
        }
    }
    let seen: Vec<_> =
        fronts.into_iter().zip(backs).filter(|(front, back)| front + back >= FEW_VIEWS).collect();
    Some(share(seen.iter().filter(|(front, back)| *back > 4 * front).count(), seen.len()))
}

/// The row that each pixel shows of a cloud seen from far off, in the direction `to_eye`.
fn nearest_rows(points: &[Point3<f64>], to_eye: &Vector3<f64>, pixel: f64) -> Vec<usize> {
    let axes = across(to_eye);
    let place = |p: &Point3<f64>| axes.map(|axis| (axis.dot(&p.coords) / pixel).floor() as i64);
    let mut shown: Vec<([i64; 2], f64, usize)> =
        points.iter().enumerate().map(|(row, p)| (place(p), -to_eye.dot(&p.coords), row)).collect();
    shown.sort_unstable_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2)));
    shown.dedup_by_key(|shown| shown.0);
    shown.into_iter().map(|(_, _, row)| row).collect()
}

/// 0 of none.
fn share(count: usize, of: usize) -> f64 {
    if of == 0 { 0.0 } else { count as f64 / of as f64 }
}

/// Of at least one number.
fn median(mut values: Vec<f64>) -> f64 {
    let half = values.len() / 2;
    *values.select_nth_unstable_by(half, f64::total_cmp).1
}
