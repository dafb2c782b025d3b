//! What accepted instances explain of the scene, and is therefore not free for others.

use nalgebra::Isometry3;

use crate::params::Params;
use crate::scene::Scene;
use crate::state::Found;

/// Which scene points accepted instances explain. It is worked out when asked: most poses meet no other, and then
/// there is nothing to work out.
#[derive(Debug, Clone, Copy)]
pub struct Claims<'a> {
    scene: &'a Scene<'a>,
    /// `d_op` in pr.
    distance_pr: f64,
    found: &'a [Found],
    /// An instance against all others: its is what it is nearest to.
    defendant: Option<usize>,
}

impl<'a> Claims<'a> {
    /// What is not free any more: the claims of all.
    pub(crate) fn new(scene: &'a Scene<'a>, params: &Params, found: &'a [Found]) -> Self {
        Self { scene, distance_pr: params.d_op_pr, found, defendant: None }
    }

    /// What others explain better than the instance does; of equals the one found first.
    pub(crate) fn against(self, instance: usize) -> Self {
        Self { defendant: Some(instance), ..self }
    }

    /// The poses of the instances that claim, in the order they were found.
    pub fn poses(&self) -> impl Iterator<Item = &'a Isometry3<f64>> + use<'a> {
        let Self { found, defendant, .. } = *self;
        (0..found.len()).filter(move |&at| Some(at) != defendant).map(|at| found[at].pose())
    }

    /// Whether an accepted instance explains a row of the target. For many rows near one pose ask [`Self::near`].
    #[must_use]
    pub fn contains(&self, row: u32) -> bool {
        self.of(|_| true).contain(&[row])[0]
    }

    /// The claims that matter for target points within 2 `d_op` of the source as a pose has moved it.
    #[must_use]
    pub fn near(&self, target_from_source: &Isometry3<f64>) -> NearClaims<'a> {
        let source = self.scene.source;
        let reach = 2.0 * source.radius + 3.0 * self.distance_pr * self.scene.resolution;
        let centre = target_from_source * source.centre;
        self.of(|other| (other * source.centre - centre).norm() <= reach)
    }

    fn of(&self, is_near: impl Fn(&Isometry3<f64>) -> bool) -> NearClaims<'a> {
        let Self { found, defendant, .. } = *self;
        let is_claimant = |&at: &usize| defendant != Some(at) && is_near(found[at].pose());
        NearClaims { claims: *self, near: (0..found.len()).filter(is_claimant).collect() }
    }

    /// Of `rows` of the target, each given with a key, those that an instance explains, and how far they are from it.
    fn explained_by(
        &self,
        instance: usize,
        rows: impl Iterator<Item = (usize, u32)>,
    ) -> impl Iterator<Item = (usize, f64)> {
        let points = rows.map(|(key, row)| (key, self.scene.target.points[row as usize]));
        let explained = self.scene.nearest_source(self.distance_pr, self.found[instance].pose(), points);
        explained.into_iter().map(|(key, _, gap)| (key, gap))
    }
}

/// [`Claims`] of the instances that can have to do with the target points near a pose.
#[derive(Debug)]
pub struct NearClaims<'a> {
    claims: Claims<'a>,
    near: Vec<usize>,
}

impl NearClaims<'_> {
    /// Which of `rows` of the target one of the instances explains.
    #[must_use]
    pub fn contain(&self, rows: &[u32]) -> Vec<bool> {
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
