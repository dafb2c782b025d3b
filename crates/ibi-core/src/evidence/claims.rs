//! What accepted instances explain of the scene, and is therefore not free for others.

use nalgebra::{Isometry3, Point3};

use super::ledger::Ledger;
use crate::scene::Scene;

/// Which scene points accepted instances explain. It is worked out when asked: most poses meet no other, and then
/// there is nothing to work out.
#[derive(Debug, Clone, Copy)]
pub struct Claims<'a> {
    scene: &'a Scene<'a>,
    /// Of the instances, in the order they were found.
    poses: &'a [Isometry3<f64>],
    /// An instance against all others: its is what it is nearest to.
    defendant: Option<usize>,
    /// Who explains what, where that was worked out for all beforehand, and who competes no more.
    ledger: Option<&'a Ledger<'a>>,
}

impl<'a> Claims<'a> {
    /// What is not free any more: the claims of all.
    pub(crate) fn new(scene: &'a Scene<'a>, poses: &'a [Isometry3<f64>]) -> Self {
        Self { scene, poses, defendant: None, ledger: None }
    }

    /// What others of the ledger explain better than the instance does; of equals the one found first.
    pub(crate) fn against(self, instance: usize, ledger: &'a Ledger<'a>) -> Self {
        Self { defendant: Some(instance), ledger: Some(ledger), ..self }
    }

    /// The poses of the instances that claim, in the order they were found.
    pub fn poses(&self) -> impl Iterator<Item = &'a Isometry3<f64>> + use<'a> {
        let claims = *self;
        let poses = claims.poses.iter().enumerate();
        poses.filter(move |&(at, _)| claims.is_claimant(at)).map(|(_, pose)| pose)
    }

    /// Whether an accepted instance explains a row of the target. For many rows near one pose ask [`Self::near`].
    #[must_use]
    pub fn contains(&self, row: u32) -> bool {
        self.of(None).contain(&[row])[0]
    }

    /// The claims that matter for target points within 2 `d_op` of the source as a pose has moved it.
    #[must_use]
    pub fn near(&self, target_from_source: &Isometry3<f64>) -> NearClaims<'a> {
        self.of(Some(target_from_source * self.scene.source.centre))
    }

    fn of(&self, centre: Option<Point3<f64>>) -> NearClaims<'a> {
        let near = (0..self.poses.len()).filter(|&at| {
            let is_near = |centre| are_near(self.scene, &self.poses[at], centre);
            self.is_claimant(at) && centre.as_ref().is_none_or(is_near)
        });
        NearClaims { claims: *self, centre, near: near.collect() }
    }

    fn is_claimant(&self, instance: usize) -> bool {
        self.defendant != Some(instance) && self.ledger.is_none_or(|ledger| ledger.holds(instance))
    }

    /// Of `rows` of the target, each given with a key, those that an instance explains, and how far they are from it.
    fn explained_by(
        &self,
        instance: usize,
        rows: impl Iterator<Item = (usize, u32)>,
    ) -> impl Iterator<Item = (usize, f64)> {
        let points = rows.map(|(key, row)| (key, self.scene.target.points[row as usize]));
        let explained =
            self.scene.nearest_source(self.scene.tolerances.d_op_pr, &self.poses[instance], points);
        explained.into_iter().map(|(key, _, gap)| (key, gap))
    }
}

/// Whether a pose can explain target points within 2 `d_op` of the source where another one has moved its centre to `centre`.
pub(crate) fn are_near(scene: &Scene<'_>, pose: &Isometry3<f64>, centre: &Point3<f64>) -> bool {
    let reach = 2.0 * scene.source.radius + 3.0 * scene.tolerances.d_op_pr * scene.resolution;
    (pose * scene.source.centre - centre).norm() <= reach
}

/// [`Claims`] of the instances that can have to do with the target points near a pose.
#[derive(Debug)]
pub struct NearClaims<'a> {
    claims: Claims<'a>,
    /// Where the pose has moved the centre of the source to; `None`: all instances count.
    centre: Option<Point3<f64>>,
    near: Vec<usize>,
}

impl NearClaims<'_> {
    /// Which of `rows` of the target one of the instances explains.
    #[must_use]
    pub fn contain(&self, rows: &[u32]) -> Vec<bool> {
        let Claims { scene, poses, defendant, ledger } = self.claims;
        let Some(ledger) = ledger.filter(|_| !self.near.is_empty()) else { return self.worked_out(rows) };
        let is_near = |instance: usize| {
            self.centre.as_ref().is_none_or(|centre| are_near(scene, &poses[instance], centre))
        };
        let known: Vec<Option<bool>> =
            rows.iter().map(|&row| ledger.is_claimed(row, defendant, is_near)).collect();
        let unknown: Vec<u32> =
            rows.iter().zip(&known).filter(|(_, known)| known.is_none()).map(|(&row, _)| row).collect();
        if unknown.is_empty() {
            return known.into_iter().flatten().collect();
        }
        let mut worked_out = self.worked_out(&unknown).into_iter();
        known.into_iter().map(|known| known.or_else(|| worked_out.next()).unwrap_or_default()).collect()
    }

    /// The same by asking each instance.
    fn worked_out(&self, rows: &[u32]) -> Vec<bool> {
        let claims = &self.claims;
        let keyed = || rows.iter().copied().enumerate();
        // The best claim to each row: how far it is from the instance, and from which.
        let mut best: Vec<Option<(f64, usize)>> = vec![None; rows.len()];
        for &instance in &self.near {
            for (at, gap) in claims.explained_by(instance, keyed()) {
                let claim = (gap, instance);
                best[at] = Some(best[at].map_or(claim, |best| if claim < best { claim } else { best }));
            }
        }
        let mut is_claimed: Vec<bool> = best.iter().map(Option::is_some).collect();
        if let Some(instance) = claims.defendant {
            let disputed = keyed().filter(|&(at, _)| best[at].is_some());
            for (at, gap) in claims.explained_by(instance, disputed) {
                is_claimed[at] = best[at] < Some((gap, instance));
            }
        }
        is_claimed
    }

    /// Whether no instance is near.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.near.is_empty()
    }
}
