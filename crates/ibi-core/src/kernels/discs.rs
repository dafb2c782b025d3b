//! A tree of flat discs: a smooth surface is made of such.
//!
//! What bounds distances to and between boxes is too large by their size, where with discs it is by its square. So of
//! points that are all about as far away, as those of a ball are from its middle and from far outside, few are looked at.

use std::ops::Range;

use nalgebra::{Matrix3, Point3, Vector3};

use super::par;
use super::spread::least_axis;
use crate::interrupt::Interrupt;

/// By so many reaches a disc is made larger, for rounding.
const ROUNDING: f64 = 1e-14;

/// Points of a leaf.
pub(crate) const LEAF: usize = 16;

/// Points by which the middle and the axis of a disc are chosen, at most.
const SAMPLE: usize = 64;

/// Below this a thread builds a disc with all below it.
const SERIAL: usize = 1 << 12;

/// Points within a flat cylinder.
#[derive(Debug)]
pub(crate) struct Disc {
    centre: Point3<f64>,
    /// The axis, half the length and the radius of the cylinder.
    axis: Vector3<f64>,
    half: f64,
    radius: f64,
    /// No point is farther from the centre.
    pub(crate) reach: f64,
    pub(crate) run: Range<usize>,
    /// Two, unless it is a leaf.
    pub(crate) parts: Option<Box<[Disc; 2]>>,
}

impl Disc {
    /// Of `items`, each of which is a point and which begin at `start` of all; sorts them. `None` if interrupted.
    pub(crate) fn new<T: Copy + Send>(
        items: &mut [T],
        start: usize,
        point: &(impl Fn(&T) -> Point3<f64> + Sync),
        interrupt: &Interrupt,
    ) -> Option<Self> {
        if items.len() >= SERIAL && interrupt.is_set() {
            return None;
        }
        // A sample: any middle and any axis will do.
        let stride = items.len().div_ceil(SAMPLE).max(1);
        let first = items.first().map_or_else(Point3::origin, point);
        let sample = || items.iter().step_by(stride).map(|item| point(item) - first);
        let mean = sample().sum::<Vector3<f64>>() / items.len().div_ceil(stride) as f64;
        let centre = first + mean;
        let spread: Matrix3<f64> = sample().map(|offset| (offset - mean) * (offset - mean).transpose()).sum();
        let axis = least_axis(&spread).unwrap_or_else(Vector3::z);
        let (mut half, mut radius_sq, mut reach_sq) = (0.0_f64, 0.0_f64, 0.0_f64);
        for item in items.iter() {
            let offset = point(item) - centre;
            let along = offset.dot(&axis);
            half = half.max(along.abs());
            radius_sq = radius_sq.max((offset - axis * along).norm_squared());
            reach_sq = reach_sq.max(offset.norm_squared());
        }
        let reach = reach_sq.sqrt();
        let mut disc = Self {
            centre,
            axis,
            half: half + ROUNDING * reach,
            radius: radius_sq.sqrt() + ROUNDING * reach,
            reach,
            run: start..start + items.len(),
            parts: None,
        };
        if items.len() <= LEAF || reach == 0.0 {
            return Some(disc);
        }
        let widest = spread.diagonal().imax();
        let middle = items.len() / 2;
        items.select_nth_unstable_by(middle, |a, b| point(a)[widest].total_cmp(&point(b)[widest]));
        let is_large = items.len() >= SERIAL;
        let (low, high) = items.split_at_mut(middle);
        let mut low = || Self::new(low, start, point, interrupt);
        let mut high = || Self::new(high, start + middle, point, interrupt);
        let (low, high) = if is_large { par::join(low, high) } else { (low(), high()) };
        disc.parts = Some(Box::new([low?, high?]));
        Some(disc)
    }

    /// The squared distance of a place from the cylinder; no point is nearer, whatever was rounded.
    fn gap_sq(&self, place: &Point3<f64>) -> f64 {
        let offset = place - self.centre;
        let along = offset.dot(&self.axis);
        let aside = (offset - self.axis * along).norm();
        let (along, aside) = ((along.abs() - self.half).max(0.0), (aside - self.radius).max(0.0));
        (along * along + aside * aside) * (1.0 - 1e-12)
    }

    /// How far a point of it may lie from its centre along a direction of length 1.
    fn along(&self, direction: &Vector3<f64>) -> f64 {
        let cos = self.axis.dot(direction).abs().min(1.0);
        (self.half * cos + self.radius * (1.0 - cos * cos).sqrt()).min(self.reach)
    }

    /// No pair of points of two discs is farther apart, but for rounding.
    pub(crate) fn bound(&self, other: &Self) -> f64 {
        let between = other.centre - self.centre;
        let apart = between.norm();
        let around = self.reach + other.reach;
        if apart <= around {
            return apart + around;
        }
        let direction = between / apart;
        (apart + self.along(&direction) + other.along(&direction)).hypot(around).min(apart + around)
    }

    /// Pairs of smaller discs that hold the same pairs of points; this one if there are none.
    pub(crate) fn halves<'a>(&'a self, other: &'a Self) -> Vec<(&'a Self, &'a Self)> {
        if std::ptr::eq(self, other) {
            return match &self.parts {
                Some(parts) => vec![(&parts[0], &parts[0]), (&parts[0], &parts[1]), (&parts[1], &parts[1])],
                None => vec![(self, other)],
            };
        }
        let halve_self = other.parts.is_none() || self.reach >= other.reach;
        match (&self.parts, &other.parts) {
            (Some(parts), _) if halve_self => parts.iter().map(|part| (part, other)).collect(),
            (_, Some(parts)) => parts.iter().map(|part| (self, part)).collect(),
            _ => vec![(self, other)],
        }
    }
}

/// A cloud, for questions about the nearest of its points.
#[derive(Debug)]
pub(crate) struct Discs {
    /// In the order of the tree, with their rows.
    points: Vec<(Point3<f64>, u32)>,
    root: Disc,
}

impl Discs {
    /// `None` if interrupted.
    pub(crate) fn new(points: &[Point3<f64>], interrupt: &Interrupt) -> Option<Self> {
        let mut points: Vec<(Point3<f64>, u32)> = points.iter().copied().zip(0..).collect();
        let root = Disc::new(&mut points, 0, &|item: &(Point3<f64>, u32)| item.0, interrupt)?;
        Some(Self { points, root })
    }

    /// The points and their rows; what lies together is together.
    pub(crate) fn points(&self) -> &[(Point3<f64>, u32)] {
        &self.points
    }

    /// The squared distance of a place from the nearest point, and where in the order that is. It is looked for from that at
    /// `near` on: the answer of a place nearby saves most of the work.
    pub(crate) fn nearest(&self, place: &Point3<f64>, near: usize) -> (f64, usize) {
        let mut best = ((self.points[near].0 - place).norm_squared(), near);
        self.look(&self.root, place, &mut best);
        best
    }

    fn look(&self, disc: &Disc, place: &Point3<f64>, best: &mut (f64, usize)) {
        let Some(parts) = &disc.parts else {
            // Of points that coincide one stands for all.
            let end = if disc.reach == 0.0 { disc.run.start + 1 } else { disc.run.end };
            let run = disc.run.start..end;
            for (at, (point, _)) in run.clone().zip(&self.points[run]) {
                let dist_sq = (point - place).norm_squared();
                if dist_sq < best.0 {
                    *best = (dist_sq, at);
                }
            }
            return;
        };
        let gaps_sq = [0, 1].map(|k| parts[k].gap_sq(place));
        let first = usize::from(gaps_sq[1] < gaps_sq[0]);
        for k in [first, 1 - first] {
            if gaps_sq[k] < best.0 {
                self.look(&parts[k], place, best);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::rng::Rng;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        // Balls, planes, lines, volumes, all at one place, far from the origin; asked from near and from far.
        #[test]
        fn the_nearest_of_all(seed: u64, count in 1..600_usize, kind in 0..6_u32, far in prop::sample::select(vec![0.01, 1.0, 1e3])) {
            let mut rng = Rng::new(seed, 0, 0);
            let mut inside = || Vector3::from([0; 3].map(|_: u32| 2.0 * rng.unit() - 1.0));
            let points: Vec<Point3<f64>> = (0..count).map(|_| {
                let x = inside();
                Point3::from(match kind {
                    0 => x.try_normalize(1e-3).unwrap_or_else(Vector3::x),
                    1 => Vector3::new(x.x, x.y, 0.0),
                    2 => Vector3::new(x.x, 0.0, 0.0),
                    3 => Vector3::zeros(),
                    4 => x.add_scalar(1e6),
                    _ => x,
                })
            }).collect();
            let discs = Discs::new(&points, &Interrupt::never());
            prop_assert!(discs.is_some());
            let Some(discs) = discs else { return Ok(()) };
            let mut near = 0;
            for k in 0..30 {
                let place = points[k % count] + far * inside();
                let least = points.iter().map(|p| (p - place).norm_squared()).fold(f64::INFINITY, f64::min);
                let (dist_sq, at) = discs.nearest(&place, near);
                near = at;
                prop_assert_eq!(dist_sq.to_bits(), least.to_bits());
                let (point, row) = discs.points()[at];
                prop_assert_eq!(point, points[row as usize]);
            }
        }
    }
}
