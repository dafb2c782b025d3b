//! The features once more, in `f64`, written as their definitions read.

use std::collections::BTreeMap;
use std::f64::consts::PI;

use nalgebra::{Matrix3, Point3, Vector3};

/// Rows of the points in each voxel, by voxel.
#[must_use]
pub fn voxels(points: &[Point3<f64>], voxel: f64) -> BTreeMap<[i64; 3], Vec<usize>> {
    let low = points.iter().fold(Point3::from([f64::INFINITY; 3]), |low, p| low.inf(p));
    let mut voxels: BTreeMap<[i64; 3], Vec<usize>> = BTreeMap::new();
    for (row, p) in points.iter().enumerate() {
        let key = [0, 1, 2].map(|k| ((p[k] - (low[k] - 0.5 * voxel)) / voxel).floor() as i64);
        voxels.entry(key).or_default().push(row);
    }
    voxels
}

/// Rows nearer than `radius` to the point `row`, itself first, then the nearest, of equally near ones the lower row; no
/// more than `most`.
#[must_use]
pub fn neighbors(points: &[Point3<f64>], row: usize, radius: f64, most: usize) -> Vec<usize> {
    let dist_sq = |other: usize| (points[other] - points[row]).norm_squared();
    let mut near: Vec<usize> = (0..points.len()).filter(|&other| dist_sq(other) < radius * radius).collect();
    near.sort_by(|&a, &b| {
        dist_sq(a).total_cmp(&dist_sq(b)).then((a != row).cmp(&(b != row))).then(a.cmp(&b))
    });
    near.truncate(most);
    near
}

/// The covariance of points.
#[must_use]
pub fn spread(points: &[Point3<f64>], rows: &[usize]) -> Matrix3<f64> {
    let n = rows.len() as f64;
    let mean = rows.iter().map(|&row| points[row].coords).sum::<Vector3<f64>>() / n;
    rows.iter()
        .map(|&row| (points[row].coords - mean) * (points[row].coords - mean).transpose())
        .sum::<Matrix3<f64>>()
        / n
}

/// The bins of the three angles of two oriented points (Rusu et al. 2009).
#[must_use]
pub fn bins(p: (Point3<f64>, Vector3<f64>), q: (Point3<f64>, Vector3<f64>)) -> [usize; 3] {
    let d = q.0 - p.0;
    let length = d.norm();
    if length == 0.0 {
        return [5; 3];
    }
    let (a, b) = (p.1.dot(&d) / length, q.1.dot(&d) / length);
    let (s, t, d, phi) = if a.abs() < b.abs() { (q.1, p.1, -d, -b) } else { (p.1, q.1, d, a) };
    let v = d.cross(&s);
    if v.norm() == 0.0 {
        return [5; 3];
    }
    let v = v.normalize();
    let w = s.cross(&v);
    let theta = w.dot(&t).atan2(s.dot(&t));
    let bin = |share: f64| ((11.0 * share).floor().max(0.0) as usize).min(10);
    [bin((theta + PI) / (2.0 * PI)), bin(0.5 * (v.dot(&t) + 1.0)), bin(0.5 * (phi + 1.0))]
}

/// FPFH of every point, as Open3D has it.
#[must_use]
pub fn fpfh(points: &[Point3<f64>], normals: &[Vector3<f64>], radius: f64, most: usize) -> Vec<[f64; 33]> {
    let around: Vec<Vec<usize>> = (0..points.len()).map(|row| neighbors(points, row, radius, most)).collect();
    let own = |row: usize| {
        let mut histogram = [0.0; 33];
        let others = &around[row][1..];
        for &other in others {
            for (angle, bin) in
                bins((points[row], normals[row]), (points[other], normals[other])).iter().enumerate()
            {
                histogram[11 * angle + bin] += 100.0 / others.len() as f64;
            }
        }
        histogram
    };
    let own: Vec<[f64; 33]> = (0..points.len()).map(own).collect();
    let whole = |row: usize| {
        let (mut sum, mut weights) = ([0.0; 33], 0.0);
        for &other in &around[row] {
            let dist_sq = (points[other] - points[row]).norm_squared();
            if dist_sq > 0.0 {
                weights += 1.0 / dist_sq;
                (0..33).for_each(|k| sum[k] += own[other][k] / dist_sq);
            }
        }
        std::array::from_fn(|k| own[row][k] + if weights > 0.0 { sum[k] / weights } else { 0.0 })
    };
    (0..points.len()).map(whole).collect()
}

/// For each target row its `k + 1` nearest source rows and their distances, of equally near ones the lower row first.
#[must_use]
pub fn nearest_rows(source: &[Vec<f32>], target: &[Vec<f32>], k: usize) -> Vec<Vec<(usize, f64)>> {
    let distance = |a: &[f32], b: &[f32]| {
        a.iter().zip(b).map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2)).sum::<f64>().sqrt()
    };
    let nearest = |t: &Vec<f32>| {
        let mut all: Vec<(usize, f64)> = source.iter().map(|s| distance(s, t)).enumerate().collect();
        all.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        all.truncate(k + 1);
        all
    };
    target.iter().map(nearest).collect()
}
