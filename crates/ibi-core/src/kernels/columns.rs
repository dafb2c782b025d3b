//! Correspondences as columns of `f32`: the layout that the vector units want.

use nalgebra::{Point3, Vector3};

/// How many values a kernel treats side by side. Sums are taken per lane and then over the lanes in order, so
/// that they vectorise without the compiler having to reassociate, and the bits stay the same.
const LANES: usize = 16;

/// Point pairs (p_i, q_i), one column per coordinate, each side centred on its mean, in multiples of a unit
/// length (the resolution, so that every kernel threshold is the parameter in `_pr` itself).
///
/// Both come before rounding to `f32`: scenes far from the origin (georeferenced scans) or in odd units lose
/// nothing. The error of a coordinate is at most 6e-8 of the scene's extent.
#[derive(Debug, Clone)]
pub struct Columns {
    /// Source coordinates x, y, z: (p - source centre) / unit.
    pub p: [Vec<f32>; 3],
    /// Target coordinates x, y, z: (q - target centre) / unit.
    pub q: [Vec<f32>; 3],
    /// What was subtracted, in data units: (source centre, target centre).
    pub centres: (Vector3<f64>, Vector3<f64>),
    /// The unit length, in data units.
    pub unit: f64,
}

impl Columns {
    /// Columns of the pairs `(source[i], target[i])` in multiples of `unit`.
    #[must_use]
    pub fn new(source: &[Point3<f64>], target: &[Point3<f64>], unit: f64) -> Self {
        let (cp, cq) = (mean(source), mean(target));
        Self { p: columns(source, cp, unit), q: columns(target, cq, unit), centres: (cp, cq), unit }
    }

    /// Number of pairs.
    #[must_use]
    pub fn len(&self) -> usize {
        self.p[0].len()
    }

    /// Whether there is no pair.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The pairs `ids`, in that order, in the same frame.
    #[must_use]
    pub fn gather(&self, ids: &[u32]) -> Self {
        let pick = |c: &Vec<f32>| ids.iter().map(|&i| c[i as usize]).collect();
        Self { p: self.p.each_ref().map(pick), q: self.q.each_ref().map(pick), ..*self }
    }

    /// The pair i: (p, q).
    #[must_use]
    pub fn pair(&self, i: usize) -> ([f32; 3], [f32; 3]) {
        (self.p.each_ref().map(|c| c[i]), self.q.each_ref().map(|c| c[i]))
    }

    /// `out[i] = f(p_i, q_i)`.
    #[inline(always)]
    #[allow(clippy::inline_always)] // `f` must be seen through to vectorise
    pub(crate) fn map_into(&self, out: &mut [f32], f: impl Fn([f32; 3], [f32; 3]) -> f32) {
        let n = out.len();
        // Slices of one known length spare the loop its bounds checks.
        let [px, py, pz] = self.p.each_ref().map(|c| &c[..n]);
        let [qx, qy, qz] = self.q.each_ref().map(|c| &c[..n]);
        for i in 0..n {
            out[i] = f([px[i], py[i], pz[i]], [qx[i], qy[i], qz[i]]);
        }
    }

    /// The sum of f(p_i, q_i).
    #[inline(always)]
    #[allow(clippy::inline_always)] // `f` must be seen through to vectorise
    pub(crate) fn sum(&self, f: impl Fn([f32; 3], [f32; 3]) -> f32) -> f32 {
        let [px, py, pz] = self.p.each_ref().map(|c| c.as_chunks::<LANES>().0);
        let [qx, qy, qz] = self.q.each_ref().map(|c| c.as_chunks::<LANES>().0);
        let mut lanes = [0.0; LANES];
        for c in 0..px.len() {
            let (px, py, pz, qx, qy, qz) = (&px[c], &py[c], &pz[c], &qx[c], &qy[c], &qz[c]);
            for k in 0..LANES {
                lanes[k] += f([px[k], py[k], pz[k]], [qx[k], qy[k], qz[k]]);
            }
        }
        let tail = (px.len() * LANES..self.len()).map(|i| {
            let (p, q) = self.pair(i);
            f(p, q)
        });
        lanes.iter().sum::<f32>() + tail.sum::<f32>()
    }
}

/// The dot product of two slices of one length.
pub(crate) fn dot(a: &[f32], b: &[f32]) -> f32 {
    let ((a, a_tail), (b, b_tail)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    let mut lanes = [0.0; LANES];
    for (a, b) in a.iter().zip(b) {
        for k in 0..LANES {
            lanes[k] += a[k] * b[k];
        }
    }
    let tail = a_tail.iter().zip(b_tail).map(|(a, b)| a * b);
    lanes.iter().sum::<f32>() + tail.sum::<f32>()
}

fn mean(points: &[Point3<f64>]) -> Vector3<f64> {
    points.iter().map(|p| p.coords).sum::<Vector3<f64>>() / points.len().max(1) as f64
}

fn columns(points: &[Point3<f64>], centre: Vector3<f64>, unit: f64) -> [Vec<f32>; 3] {
    [0, 1, 2].map(|axis| points.iter().map(|p| ((p[axis] - centre[axis]) / unit) as f32).collect())
}
