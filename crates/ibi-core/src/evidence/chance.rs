//! What chance brings in a scene, against which every pose is held.

use std::ops::Range;

use nalgebra::Point3;

use crate::interrupt::Interrupt;
use crate::kernels::graph::up_to_sign;
use crate::kernels::nearby::Nearby;
use crate::kernels::par;
use crate::kernels::rng::{Rng, Stage};
use crate::scene::{PointPairs, Scene, Tolerances};

/// What chance brings in a scene. Nothing is to be read from it once the run was interrupted before it was measured: then no
/// instance was found.
#[derive(Debug, Default)]
pub(crate) struct Chance {
    /// For each source point the share of all correspondences that would agree with it.
    pub(super) agreement: Vec<f32>,
    /// The fit of a pose somewhere on the target.
    pub(super) fit: f64,
    /// The fit of the target to itself.
    pub(super) best_fit: f64,
}

impl Chance {
    /// Measures it; `seed` draws the poses.
    pub(crate) fn of(scene: &Scene<'_>, pairs: &PointPairs, seed: u64, interrupt: &Interrupt) -> Self {
        let agreement = agreement(scene, pairs, interrupt);
        if interrupt.is_set() {
            return Self::default();
        }
        let rng = |draw| Rng::new(seed, draw, Stage::Hv as u32);
        Self { agreement, fit: scene.chance_fit(rng(0)), best_fit: scene.best_fit(rng(1)) }
    }
}

/// For each source point the share of the correspondences whose source point lies within `t_he` of it (and
/// agrees in its normal, where normals count): how likely a correspondence that knows nothing of its target
/// point would agree there.
fn agreement(scene: &Scene<'_>, pairs: &PointPairs, interrupt: &Interrupt) -> Vec<f32> {
    let source = scene.source;
    let Tolerances { t_he_pr, min_normal_cos, oriented_normals, .. } = scene.tolerances;
    let t_he = t_he_pr * scene.resolution;
    let mut uses = vec![0_u32; source.points.len()];
    for &row in &pairs.source_rows {
        uses[row as usize] += 1;
    }
    let near = if let Some((normals, min_cos)) = source.normals.as_deref().zip(min_normal_cos) {
        let agree = |a: usize, b: usize| up_to_sign(normals[a].dot(&normals[b]), oriented_normals) >= min_cos;
        uses_around(&source.points, &uses, &scene.near_source, t_he, agree, interrupt)
    } else {
        scene.near_source.sums_within_until(t_he, &source.points, &uses, || interrupt.is_set())
    };
    near.into_iter().map(|num| num as f32 / pairs.len().max(1) as f32).collect()
}

/// For each point the uses of those within `t_he` that agree with it, `near` holds all; about so many where there are thousands. Fewer
/// numbers than points if interrupted.
fn uses_around(
    points: &[Point3<f64>],
    uses: &[u32],
    near: &Nearby,
    t_he: f64,
    agree: impl Fn(usize, usize) -> bool + Sync + Send,
    interrupt: &Interrupt,
) -> Vec<u32> {
    /// Points that are looked at around one, at most, and points that one thread asks about at a time.
    const MOST_NEAR: usize = 1 << 12;
    const GRAIN: usize = 64;
    /// Where less than one of so many is used, those are looked for alone.
    const FEW: usize = 8;
    let used: Vec<u32> = (0..).zip(uses).filter(|&(_, &num)| num > 0).map(|(row, _)| row).collect();
    let of_few = (FEW * used.len() < uses.len()).then(|| {
        let few: Vec<_> = used.iter().map(|&row| points[row as usize]).collect();
        Nearby::new(&few, t_he)
    });
    let near = of_few.as_ref().unwrap_or(near);
    let is_wide = near.is_crowded(t_he);
    let around = |row: usize| {
        let uses = |other: u32| {
            let other = if of_few.is_some() { used[other as usize] } else { other } as usize;
            if agree(row, other) { uses[other] } else { 0 }
        };
        if is_wide {
            near.sum_of_some(&points[row], t_he, MOST_NEAR, uses)
        } else {
            near.within(&points[row], t_he).map(uses).sum()
        }
    };
    let of_rows = |rows: Range<usize>| {
        if interrupt.is_set() { Vec::new() } else { rows.map(around).collect::<Vec<_>>() }
    };
    par::chunks(points.len(), GRAIN, of_rows).concat()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::rng::Rng;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        // Few points are used, or many; none of them has thousands around it.
        #[test]
        fn uses_around_are_those_of_their_definition(seed: u64, count in 1..600_usize, one_of in 1..40_usize) {
            let mut rng = Rng::new(seed, 0, 0);
            let points: Vec<Point3<f64>> =
                (0..count).map(|_| Point3::from([0; 3].map(|_: u32| rng.unit()))).collect();
            let mut uses: Vec<u32> =
                (0..count).map(|_| if rng.below(one_of) == 0 { rng.below(4) as u32 } else { 0 }).collect();
            uses[0] = 2;
            let agree = |a: usize, b: usize| !(a + b).is_multiple_of(3);
            let (t_he, never) = (0.2, Interrupt::never());
            let found = uses_around(&points, &uses, &Nearby::new(&points, t_he), t_he, agree, &never);
            for (a, found) in found.iter().enumerate() {
                // What is as far off as that, but for rounding, may count or not.
                let sum = |reach: f64| -> u32 {
                    (0..count).filter(|&b| (points[a] - points[b]).norm() <= reach && agree(a, b)).map(|b| uses[b]).sum()
                };
                prop_assert!((sum(t_he * (1.0 - 1e-5))..=sum(t_he * (1.0 + 1e-5))).contains(found));
            }
            prop_assert_eq!(found.len(), count);
        }
    }

    #[test]
    fn of_thousands_around_some_stand_for_all() {
        let mut rng = Rng::new(1, 0, 0);
        let points: Vec<Point3<f64>> =
            (0..17_000).map(|_| Point3::from([0; 3].map(|_: u32| rng.unit()))).collect();
        let uses: Vec<u32> = (0..17_000).map(|row| row % 3).collect();
        let never = Interrupt::never();
        let all = uses_around(&points, &uses, &Nearby::new(&points, 9.0), 9.0, |_, b| b % 2 == 0, &never);
        let sum: u32 = uses.iter().step_by(2).sum();
        assert!(all.iter().all(|&about| about.abs_diff(sum) < sum / 10), "{:?} of {sum}", &all[..9]);
    }
}
