//! What accepted instances explain of the scene, and is therefore not free for others.

use nalgebra::{Isometry3, Point3, Rotation3, Vector3};

use crate::params::Params;
use crate::scene::Scene;
use crate::state::Found;

/// Which scene points accepted instances explain. It is worked out when asked: most poses meet no other, and then
/// there is nothing to work out.
#[derive(Debug, Clone, Copy)]
pub struct Claims<'a> {
    scene: &'a Scene<'a>,
    /// `d_op` in data units.
    distance: f64,
    found: &'a [Found],
    /// An instance against all others: its is what it is nearest to.
    defendant: Option<usize>,
}

impl<'a> Claims<'a> {
    /// What is not free any more: the claims of all.
    pub(crate) fn new(scene: &'a Scene<'a>, params: &Params, found: &'a [Found]) -> Self {
        Self { scene, distance: params.d_op_pr * scene.resolution, found, defendant: None }
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
        self.of(|_| true).contains(row)
    }

    /// The claims that matter for target points within 2 `d_op` of the source as a pose has moved it.
    #[must_use]
    pub fn near(&self, target_from_source: &Isometry3<f64>) -> NearClaims<'a> {
        let source = self.scene.source;
        let reach = 2.0 * source.radius + 3.0 * self.distance;
        let centre = target_from_source * source.centre;
        self.of(|other| (other * source.centre - centre).norm() <= reach)
    }

    fn of(&self, is_near: impl Fn(&Isometry3<f64>) -> bool) -> NearClaims<'a> {
        let claimant = |instance: usize| {
            let pose = self.found[instance].pose();
            (self.defendant != Some(instance) && is_near(pose))
                .then(|| Claimant::new(self.scene, instance, pose))
        };
        let near: Vec<Claimant> = (0..self.found.len()).filter_map(claimant).collect();
        let defendant = self.defendant.filter(|_| !near.is_empty());
        let defendant = defendant.map(|at| Claimant::new(self.scene, at, self.found[at].pose()));
        NearClaims { scene: self.scene, distance: self.distance, near, defendant }
    }
}

/// [`Claims`] of the instances that can have to do with the target points near a pose.
#[derive(Debug)]
pub struct NearClaims<'a> {
    scene: &'a Scene<'a>,
    distance: f64,
    near: Vec<Claimant>,
    defendant: Option<Claimant>,
}

impl NearClaims<'_> {
    /// Whether one of the instances explains a row of the target.
    #[must_use]
    pub fn contains(&self, row: u32) -> bool {
        let point = &self.scene.target.points[row as usize];
        let gap =
            |claimant: &Claimant| Some((claimant.gap(self.scene, point, self.distance)?, claimant.instance));
        let is_better = |claim: (f64, usize)| match self.defendant.as_ref().and_then(gap) {
            Some(own) => claim < own,
            None => true,
        };
        self.near.iter().filter_map(gap).any(is_better)
    }

    /// Whether no instance is near.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.near.is_empty()
    }
}

/// An accepted pose, ready to tell how far a target point is from it.
#[derive(Debug)]
struct Claimant {
    instance: usize,
    /// Of the source, as the pose has moved it.
    centre: Point3<f64>,
    rotation_back: Rotation3<f64>,
    shift_back: Vector3<f64>,
}

impl Claimant {
    fn new(scene: &Scene<'_>, instance: usize, target_from_source: &Isometry3<f64>) -> Self {
        let back = target_from_source.inverse();
        Self {
            instance,
            centre: target_from_source * scene.source.centre,
            rotation_back: back.rotation.to_rotation_matrix(),
            shift_back: back.translation.vector,
        }
    }

    /// How far `point` is from the nearest point of the moved source, data units; `None` beyond `distance`, which is at
    /// most 2 `d_op`.
    fn gap(&self, scene: &Scene<'_>, point: &Point3<f64>, distance: f64) -> Option<f64> {
        let radius = scene.source.radius + distance;
        if (point - self.centre).norm_squared() > radius * radius {
            return None;
        }
        let moved = self.rotation_back * point + self.shift_back;
        let row = scene.near_source.nearest_within(&moved, distance)?;
        Some((moved - scene.source.points[row as usize]).norm()).filter(|&gap| gap <= distance)
    }
}
