//! What chance brings in a scene, against which every pose is held.

use crate::interrupt::Interrupt;
use crate::kernels::graph::up_to_sign;
use crate::kernels::par;
use crate::kernels::rng::{Rng, Stage};
use crate::scene::{PointPairs, Scene, Tolerances};

/// What chance brings in a scene. Nothing is to be read from it once the run was interrupted before it was measured: then no
/// instance was found.
#[derive(Debug, Default)]
pub(crate) struct Chance {
    /// For each source point of a correspondence the share of all that would agree with it.
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

/// For each source point of a correspondence the share of those whose source point lies within `t_he` of it (and
/// agrees in its normal, where normals count): how likely a correspondence that knows nothing of its target
/// point would agree there. 0 for the other points, which nobody asks about.
fn agreement(scene: &Scene<'_>, pairs: &PointPairs, interrupt: &Interrupt) -> Vec<f32> {
    /// Points of like normals that are looked at around one, at most.
    const MOST_NEAR: usize = 1 << 12;
    let source = scene.source;
    let Tolerances { t_he_pr, min_normal_cos, oriented_normals, .. } = scene.tolerances;
    let t_he = t_he_pr * scene.resolution;
    let is_wide = scene.near_source.is_crowded(t_he);
    let mut uses = vec![0_u32; source.points.len()];
    for &row in &pairs.source_rows {
        uses[row as usize] += 1;
    }
    let near = if let Some((n, min_cos)) = source.normals.as_deref().zip(min_normal_cos) {
        par::map(source.points.len(), 512, |row| {
            if (row % 64 == 0 && interrupt.is_set()) || uses[row] == 0 {
                return 0;
            }
            let alike =
                |&other: &u32| up_to_sign(n[row].dot(&n[other as usize]), oriented_normals) >= min_cos;
            let near = || scene.near_source.within(&source.points[row], t_he);
            // Of more than so many every so many-th stands for all.
            let step = if is_wide { near().count().div_ceil(MOST_NEAR).max(1) } else { 1 };
            let near = near().step_by(step).filter(alike);
            near.map(|other| uses[other as usize]).sum::<u32>().saturating_mul(step as u32)
        })
    } else {
        scene.near_source.sums_within_until(t_he, &source.points, &uses, || interrupt.is_set())
    };
    near.into_iter().map(|num| num as f32 / pairs.len().max(1) as f32).collect()
}
