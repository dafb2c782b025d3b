//! Correspondences as columns of `f32`: the layout that the vector units want.

use std::ops::Range;

use nalgebra::{Isometry3, Matrix3, Point3, Vector3};

use super::simd::simd;

/// How many values a kernel treats side by side. Sums are taken per lane and then over the lanes in order, so
/// that they vectorise without the compiler having to reassociate, and the bits stay the same.
pub(crate) const LANES: usize = 16;

/// Point pairs (p_i, q_i), one column per coordinate, each side centred on its middle, in multiples of a unit
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
        let (cp, cq) = (middle(source), middle(target));
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

    /// A pose as it maps source columns to target columns: rotation and shift.
    pub(crate) fn frame(&self, target_from_source: &Isometry3<f64>) -> (Matrix3<f32>, Vector3<f32>) {
        let rotation = target_from_source.rotation.to_rotation_matrix();
        let (centre_p, centre_q) = self.centres;
        let shift = rotation * centre_p + target_from_source.translation.vector - centre_q;
        (rotation.matrix().cast(), (shift / self.unit).cast())
    }

    /// A place among the source columns, moved to the target columns.
    pub(crate) fn moved(&self, target_from_source: &Isometry3<f64>, place: [f32; 3]) -> [f32; 3] {
        let (rotation, shift) = self.frame(target_from_source);
        (rotation * Vector3::from(place) + shift).into()
    }

    /// `out[i] = f(p_i, q_i)`.
    #[inline(always)]
    #[allow(clippy::inline_always)] // `f` must be seen through to vectorise
    pub(crate) fn map_into(&self, out: &mut [f32], f: impl Fn([f32; 3], [f32; 3]) -> f32) {
        self.map_run_into(0..out.len(), out, f);
    }

    /// The same for the pairs of `run`, as long as `out`.
    #[inline(always)]
    #[allow(clippy::inline_always)]
    pub(crate) fn map_run_into(
        &self,
        run: Range<usize>,
        out: &mut [f32],
        f: impl Fn([f32; 3], [f32; 3]) -> f32,
    ) {
        // Slices of one known length spare the loop its bounds checks.
        let p = self.p.each_ref().map(|c| &c[run.clone()]);
        let q = self.q.each_ref().map(|c| &c[run.clone()]);
        simd(
            #[inline(always)]
            move || map_into(out, p, q, f),
        );
    }

    /// The sum of f(p_i, q_i).
    #[inline(always)]
    #[allow(clippy::inline_always)] // `f` must be seen through to vectorise
    pub(crate) fn sum(&self, f: impl Fn([f32; 3], [f32; 3]) -> f32 + Copy) -> f32 {
        let p = self.p.each_ref().map(|c| c.as_chunks::<LANES>().0);
        let q = self.q.each_ref().map(|c| c.as_chunks::<LANES>().0);
        let lanes = simd(
            #[inline(always)]
            move || lane_sums(p, q, f),
        );
        let tail = (p[0].len() * LANES..self.len()).map(|i| {
            let (p, q) = self.pair(i);
            f(p, q)
        });
        lanes.iter().sum::<f32>() + tail.sum::<f32>()
    }
}

// The loops are functions of their own: a closure's captures may alias for all that the compiler knows, and then it
// does not vectorise.

#[inline(always)]
#[allow(clippy::inline_always)]
fn map_into(out: &mut [f32], p: [&[f32]; 3], q: [&[f32]; 3], f: impl Fn([f32; 3], [f32; 3]) -> f32) {
    let n = out.len();
    let ([px, py, pz], [qx, qy, qz]) = (p.map(|c| &c[..n]), q.map(|c| &c[..n]));
    for i in 0..n {
        out[i] = f([px[i], py[i], pz[i]], [qx[i], qy[i], qz[i]]);
    }
}

#[inline(always)]
#[allow(clippy::inline_always)]
fn lane_sums(
    [px, py, pz]: [&[[f32; LANES]]; 3],
    [qx, qy, qz]: [&[[f32; LANES]]; 3],
    f: impl Fn([f32; 3], [f32; 3]) -> f32,
) -> [f32; LANES] {
    let mut lanes = [0.0; LANES];
    for c in 0..px.len() {
        let (px, py, pz, qx, qy, qz) = (&px[c], &py[c], &pz[c], &qx[c], &qy[c], &qz[c]);
        for k in 0..LANES {
            lanes[k] += f([px[k], py[k], pz[k]], [qx[k], qy[k], qz[k]]);
        }
    }
    lanes
}

/// The dot product of two slices of one length, a multiple of `LANES`. To be inlined into a `simd` block.
#[inline(always)]
#[allow(clippy::inline_always)]
pub(crate) fn dot(a: &[f32], b: &[f32]) -> f32 {
    let (a, b) = (a.as_chunks::<LANES>().0, b.as_chunks::<LANES>().0);
    let mut lanes = [0.0; LANES];
    for (a, b) in a.iter().zip(b) {
        for k in 0..LANES {
            lanes[k] += a[k] * b[k];
        }
    }
    lanes.iter().sum::<f32>()
}

/// The least and the greatest of finite values; the least is the greater if there are none.
pub(crate) fn min_max(values: &[f32]) -> (f32, f32) {
    simd(
        #[inline(always)]
        move || {
            let (mut low, mut high) = ([f32::INFINITY; LANES], [f32::NEG_INFINITY; LANES]);
            let (chunks, rest) = values.as_chunks::<LANES>();
            for values in chunks {
                for k in 0..LANES {
                    // Not `min`, which minds what is no number.
                    low[k] = if values[k] < low[k] { values[k] } else { low[k] };
                    high[k] = if values[k] > high[k] { values[k] } else { high[k] };
                }
            }
            let low = low.iter().chain(rest).fold(f32::INFINITY, |low, &x| low.min(x));
            let high = high.iter().chain(rest).fold(f32::NEG_INFINITY, |high, &x| high.max(x));
            (low, high)
        },
    )
}

/// The middle of a cloud: of each coordinate the median of a sample. Stray points do not move it.
pub(crate) fn middle(points: &[Point3<f64>]) -> Vector3<f64> {
    const SAMPLE: usize = 1000;
    let sample =
        |axis: usize| points.iter().step_by(points.len().div_ceil(SAMPLE).max(1)).map(move |p| p[axis]);
    [0, 1, 2]
        .map(|axis| {
            let mut values: Vec<f64> = sample(axis).collect();
            let half = values.len() / 2;
            if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(half, f64::total_cmp).1 }
        })
        .into()
}

/// The coordinates about `centre`, in multiples of `unit`.
pub(crate) fn columns(points: &[Point3<f64>], centre: Vector3<f64>, unit: f64) -> [Vec<f32>; 3] {
    /// So many points are read three times over while they are at hand.
    const RUN: usize = 2048;
    let mut columns = [0; 3].map(|_| Vec::with_capacity(points.len()));
    for run in points.chunks(RUN) {
        for (axis, column) in columns.iter_mut().enumerate() {
            column.extend(run.iter().map(|p| ((p[axis] - centre[axis]) / unit) as f32));
        }
    }
    columns
}
