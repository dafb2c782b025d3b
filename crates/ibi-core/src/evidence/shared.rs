//! How much of its error a measured point shares with those around it.
//!
//! Points of a depth camera are not independent: stereo matching blurs over some pixels, and what a model is wrong by is the same all over
//! a face. So a thousand points tell less than a thousand times as much as one; how much less is read off what they lie off
//! the surfaces of poses: of pairs of them, by how far apart their rays are.

use nalgebra::{Point3, Vector3};

use crate::kernels::nearby::Nearby;

/// Lags that are told apart, in spacings of the rays; what is farther apart shares nothing, it is taken.
pub const LAGS: usize = 12;

/// A measured point on a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Off {
    /// Unit vector to it from its eye, over the spacing of the eye's rays: neighbours are about 1 apart.
    pub ray: Point3<f64>,
    /// Normal of the surface.
    pub normal: Vector3<f64>,
    /// How far it lies off, weighed.
    pub gap: f64,
}

/// Sums over pairs of points, by lag.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Pairs {
    /// Points.
    pub num: f64,
    /// Sum of squares of what they lie off.
    pub square: f64,
    /// Sums over pairs, both ways, on one face: of the products of what they lie off; of 1; of the lag.
    pub products: [f64; LAGS],
    /// See `products`.
    pub nums: [f64; LAGS],
    /// See `products`.
    pub lags: [f64; LAGS],
    /// Sums over all pairs, both ways, of the cosine between their normals.
    pub cosines: [f64; LAGS],
}

/// Cosine between two normals of one face.
const SAME_FACE: f64 = 0.9;

/// Pairs that are looked at, about: of more points every so many-th is held against all.
const MOST_PAIRS: usize = 1 << 21;

/// Rays within the largest lag.
const AROUND: usize = 452;

/// Sums over the pairs of points that rays of one eye have measured on one model.
#[must_use]
pub fn pairs(points: &[Off]) -> Pairs {
    let mut pairs = Pairs {
        num: points.len() as f64,
        square: points.iter().map(|off| off.gap * off.gap).sum(),
        ..Pairs::default()
    };
    let rays: Vec<Point3<f64>> = points.iter().map(|off| off.ray).collect();
    let reach = LAGS as f64;
    let nearby = Nearby::new(&rays, reach);
    let every = (points.len() * AROUND).div_ceil(MOST_PAIRS).max(1);
    for (i, off) in points.iter().enumerate().step_by(every) {
        let mut rows: Vec<u32> = nearby.within(&off.ray, reach).collect();
        rows.sort_unstable();
        for row in rows {
            let other = &points[row as usize];
            let lag = (off.ray - other.ray).norm();
            if row as usize == i || lag >= reach {
                continue;
            }
            let (bin, cosine) = (lag as usize, off.normal.dot(&other.normal));
            let each = every as f64;
            pairs.cosines[bin] += each * cosine;
            if cosine > SAME_FACE {
                pairs.products[bin] += each * off.gap * other.gap;
                pairs.nums[bin] += each;
                pairs.lags[bin] += each * lag;
            }
        }
    }
    pairs
}

impl Pairs {
    /// Both together.
    #[must_use]
    pub fn and(&self, other: &Self) -> Self {
        let sum = |a: &[f64; LAGS], b: &[f64; LAGS]| std::array::from_fn(|k| a[k] + b[k]);
        Self {
            num: self.num + other.num,
            square: self.square + other.square,
            products: sum(&self.products, &other.products),
            nums: sum(&self.nums, &other.nums),
            lags: sum(&self.lags, &other.lags),
            cosines: sum(&self.cosines, &other.cosines),
        }
    }

    /// Of how many points the errors are one, on average, where they are correlated so: 1 where each has its own.
    #[must_use]
    pub fn sharing(&self, correlation: &Correlation) -> f64 {
        let lag = |k: usize| if self.nums[k] > 0.0 { self.lags[k] / self.nums[k] } else { k as f64 + 0.5 };
        let shared = |k: usize| correlation.at(lag(k)) * self.cosines[k];
        (1.0 + (0..LAGS).map(shared).sum::<f64>() / self.num.max(1.0)).max(1.0)
    }
}

/// How errors of points are correlated: `share` exp(-lag^2 / 2 `reach`^2).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Correlation {
    /// 0 to 1.
    pub share: f64,
    /// In spacings of the rays.
    pub reach: f64,
}

/// Reaches that are tried, in quarters of a spacing.
const REACHES: std::ops::Range<u32> = 2..17;

impl Correlation {
    /// That which fits best to pairs of points. A pose was fitted to them, which took as much from all lags: that is left out.
    #[must_use]
    pub fn of(pairs: &Pairs) -> Self {
        let mut best = (f64::INFINITY, Self::default());
        let mean_sq = pairs.square / pairs.num.max(1.0);
        let seen: Vec<[f64; 3]> = (0..LAGS)
            .filter(|&k| pairs.nums[k] > 0.0 && mean_sq > 0.0)
            .map(|k| [pairs.lags[k], pairs.products[k] / mean_sq, pairs.nums[k]])
            .map(|[lags, products, num]| [lags / num, products / num, num])
            .collect();
        let total: f64 = seen.iter().map(|[_, _, num]| num).sum();
        for reach in REACHES.map(|quarters| 0.25 * f64::from(quarters)) {
            let bell = |lag: f64| (-0.5 * (lag / reach).powi(2)).exp();
            let mean = |of: &dyn Fn(f64, f64) -> f64| {
                seen.iter().map(|&[lag, value, num]| num * of(lag, value)).sum::<f64>() / total
            };
            let (x, y) = (mean(&|lag, _| bell(lag)), mean(&|_, value| value));
            let xx = mean(&|lag, _| (bell(lag) - x).powi(2));
            let xy = mean(&|lag, value| (bell(lag) - x) * (value - y));
            let free = if xx > 0.0 { xy / xx } else { 0.0 };
            // Nothing is taken away by what is not there: without an offset above 0.
            let share = if y - free * x > 0.0 {
                mean(&|lag, value| bell(lag) * value) / mean(&|lag, _| bell(lag).powi(2))
            } else {
                free
            };
            let share = share.clamp(0.0, 1.0);
            let offset = (y - share * x).min(0.0);
            let off = mean(&|lag, value| (value - share * bell(lag) - offset).powi(2));
            if off < best.0 {
                best = (off, Self { share, reach });
            }
        }
        best.1
    }

    /// Of two points whose rays are so far apart.
    #[must_use]
    pub fn at(&self, lag: f64) -> f64 {
        if self.share > 0.0 { self.share * (-0.5 * (lag / self.reach).powi(2)).exp() } else { 0.0 }
    }
}
