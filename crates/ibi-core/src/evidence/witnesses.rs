//! Who can speak for a pose: the correspondences that are left, and the scene points that are free.

use nalgebra::Isometry3;

use super::chance::Chance;
use super::claims::Claims;
use super::support::Support;
use crate::detail::Detail;
use crate::scene::{Alive, PointPairs, Scene};

/// Correspondences near a pose that are looked at for a glance, and for more.
const GLANCE_NEAR: usize = 128;
pub(crate) const LOOK_NEAR: usize = 1024;

/// The clouds, the correspondences that count, and what is claimed.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Witnesses<'a> {
    pub(crate) scene: &'a Scene<'a>,
    pub(crate) pairs: &'a PointPairs,
    pub(crate) alive: &'a Alive,
    pub(crate) claims: Claims<'a>,
}

/// Correspondences near a pose: the id of each, the row of the source point nearest to its target point, and their
/// distance; and how many each of them stands for.
struct Near {
    found: Vec<(u32, u32, f64)>,
    step: u32,
}

impl Witnesses<'_> {
    fn length(&self, length_pr: f64) -> f64 {
        length_pr * self.scene.resolution
    }

    /// Alive correspondences with |T p - q| below `distance_pr`, in no order; with normals that count, those of both points
    /// must agree as well.
    pub(crate) fn inliers(&self, target_from_source: &Isometry3<f64>, distance_pr: f64) -> Vec<u32> {
        let mut inliers = self.pairs.by_target.close_pairs(target_from_source, distance_pr);
        inliers.retain(|&id| self.alive.contains(id) && self.normals_agree(id, target_from_source));
        inliers
    }

    /// Alive correspondences that an accepted pose uses up: its inliers within 2 `t_he`, and those, right or
    /// wrong, whose target point it explains. Ascending.
    pub(crate) fn spent(&self, target_from_source: &Isometry3<f64>) -> Vec<u32> {
        let tolerances = &self.scene.tolerances;
        let mut spent = self.inliers(target_from_source, 2.0 * tolerances.t_he_pr);
        let explained = self.near(usize::MAX, tolerances.d_op_pr, target_from_source).found;
        spent.extend(explained.into_iter().map(|(id, ..)| id));
        spent.sort_unstable();
        spent.dedup();
        spent
    }

    /// Alive correspondences whose target point lies within `distance_pr` of the moved source, each with the row of the
    /// nearest source point and the distance in data units. Of more than `most` around only every so many-th.
    fn near(&self, most: usize, distance_pr: f64, target_from_source: &Isometry3<f64>) -> Near {
        let mut ids = self.around(distance_pr, target_from_source);
        ids.retain(|&id| self.alive.contains(id));
        let step = ids.len().div_ceil(most).max(1);
        let targets = ids.iter().step_by(step).map(|&id| (id, self.pairs.target[id as usize]));
        let found = self.scene.nearest_source(distance_pr, target_from_source, targets);
        Near { found, step: step as u32 }
    }

    /// Correspondences whose target point lies within `distance_pr` of the ball around the moved source.
    pub(crate) fn around(&self, distance_pr: f64, target_from_source: &Isometry3<f64>) -> Vec<u32> {
        let source = self.scene.source;
        let radius = source.radius + self.length(distance_pr);
        self.pairs.by_target.within(&(target_from_source * source.centre), radius)
    }

    /// What speaks for a pose: the alive correspondences, and the scene points, if `exclusive` only those that no
    /// accepted instance has claimed.
    pub(crate) fn support(
        &self,
        chance: &Chance,
        detail: Detail,
        target_from_source: &Isometry3<f64>,
        exclusive: bool,
    ) -> Support {
        let tolerances = &self.scene.tolerances;
        let reach_pr = 2.0 * tolerances.d_op_pr;
        let (reach, d_op) = (self.length(reach_pr), self.length(tolerances.d_op_pr));
        let t_he = self.length(tolerances.t_he_pr);
        let most = match detail {
            Detail::Glance => GLANCE_NEAR,
            Detail::Look => LOOK_NEAR,
        };
        let Near { found: near, step } = self.near(most, reach_pr, target_from_source);
        let back_fit = near.iter().map(|&(_, _, distance)| 1.0 - distance / reach).sum::<f64>();
        let explained = near.iter().filter(|&&(_, _, distance)| distance <= d_op);
        let expected: f64 =
            explained.clone().map(|&(_, row, _)| f64::from(chance.agreement[row as usize])).sum();
        let num_explained = explained.clone().count();
        let num_agreeing = if step > 1 {
            // The agreeing ones are found by themselves.
            self.inliers(target_from_source, tolerances.t_he_pr.min(tolerances.d_op_pr)).len()
        } else {
            let agrees = |&&(id, ..): &&(u32, u32, f64)| {
                let (p, q) = (self.pairs.source[id as usize], self.pairs.target[id as usize]);
                let is_close = (target_from_source * p - q).norm_squared() < t_he * t_he;
                is_close && self.normals_agree(id, target_from_source)
            };
            explained.filter(agrees).count()
        };
        let claims = self.claims.near(target_from_source);
        let are_claimed =
            |rows: &[u32]| if exclusive { claims.contain(rows) } else { vec![false; rows.len()] };
        let fit = self.scene.fit(detail, target_from_source, are_claimed);
        Support {
            num_explained: (num_explained as u32 * step).max(num_agreeing as u32),
            num_agreeing: num_agreeing as u32,
            chance: expected / num_explained.max(1) as f64,
            fit: fit.mean,
            explained: fit.share,
            back_fit: back_fit / near.len().max(1) as f64,
            chance_fit: chance.fit,
            best_fit: chance.best_fit,
            one_sided: self.scene.is_one_sided(),
        }
    }

    fn normals_agree(&self, id: u32, target_from_source: &Isometry3<f64>) -> bool {
        match (&self.pairs.normals, self.scene.tolerances.min_normal_cos) {
            (Some(normals), Some(min_cos)) => normals.agree(id, target_from_source, min_cos),
            _ => true,
        }
    }
}
