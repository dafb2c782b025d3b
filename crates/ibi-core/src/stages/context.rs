//! What a stage sees of the run.

use std::sync::OnceLock;

use nalgebra::Isometry3;

use crate::detail::Detail;
use crate::evidence::{Chance, Claims, Closeup, Proof, Support, Witnesses};
use crate::interrupt::{Interrupt, Phase};
use crate::kernels::graph::Graph;
use crate::kernels::rng::{Rng, Stage};
use crate::scene::{Alive, PointPairs, Scene};

/// What a stage sees of the run: the input, what is alive, the parameters that stages share, the round.
#[derive(Debug, Clone, Copy)]
pub struct Context<'a> {
    /// The two clouds, the resolution, and when points of the two agree.
    pub scene: &'a Scene<'a>,
    /// All correspondences, by id.
    pub pairs: &'a PointPairs,
    /// Those that no round has removed yet.
    pub alive: &'a Alive,
    /// `delta_r` of Eq. 5, in pr.
    pub delta_r_pr: f64,
    /// `t_s`: fewer seeds than this are none.
    pub t_s: u32,
    /// Key of all random streams.
    pub seed: u64,
    /// Number of the round, from 0.
    pub round: u32,
    /// Whether a correspondence may not lead a seed selection (again), by id: with removal `inliers`, the seeds
    /// of all rounds before.
    pub barred: &'a [bool],
    /// Which scene points accepted instances explain.
    pub claims: Claims<'a>,
    /// The compatibility graph of the alive correspondences or, at a first look, of a part of them; built by the first
    /// stage that wants it.
    pub graph: &'a OnceLock<Graph>,
    /// Whether a part of the correspondences will do for the graph: once nothing more comes of it, one of all is wanted.
    pub is_first_look: bool,
    /// Where each correspondence puts the centroid of the source, in the frame of the columns, if anywhere; filled by the
    /// first stage that wants it.
    pub votes: &'a OnceLock<Vec<Option<[f32; 3]>>>,
    /// What chance brings in this scene.
    pub(crate) chance: &'a OnceLock<Chance>,
    /// What was measured in all, where the scene is seen from one side.
    pub(crate) closeup: Option<&'a Closeup>,
    /// Asked by long computations, which may then return anything: the round is thrown away.
    pub interrupt: &'a Interrupt,
}

impl Context<'_> {
    /// `length_pr` in data units.
    #[must_use]
    pub fn length(&self, length_pr: f64) -> f64 {
        length_pr * self.scene.resolution
    }

    /// Alive correspondences with |T p - q| below `distance_pr`, ascending; with normals that count, those of
    /// both points must agree as well.
    #[must_use]
    pub fn inliers(&self, target_from_source: &Isometry3<f64>, distance_pr: f64) -> Vec<u32> {
        let mut inliers = self.witnesses().inliers(target_from_source, distance_pr);
        inliers.sort_unstable();
        inliers
    }

    /// The MAE of a pose over the alive correspondences (Eq. 7-8), of which only those near it are looked at.
    #[must_use]
    pub fn mae(&self, target_from_source: &Isometry3<f64>) -> f64 {
        let t_he_pr = self.scene.tolerances.t_he_pr;
        let inliers = self.inliers(target_from_source, t_he_pr);
        let t_he = self.length(t_he_pr);
        let pairs = self.pairs.pairs(inliers);
        pairs.map(|(p, q)| (1.0 - (target_from_source * p - q).norm() / t_he).max(0.0)).sum()
    }

    /// What speaks for a pose: the alive correspondences, and the scene points, if `exclusive` only those that no
    /// accepted instance has claimed.
    #[must_use]
    pub fn support(&self, detail: Detail, target_from_source: &Isometry3<f64>, exclusive: bool) -> Support {
        self.witnesses().support(self.chance(), detail, target_from_source, exclusive)
    }

    /// The pose settled on all that was measured, and what speaks for it and against it there; `None` where there is no more to
    /// look at than the clouds.
    pub(crate) fn proof(&self, target_from_source: &Isometry3<f64>) -> Option<Proof> {
        let mut proof = self.closeup?.look(self.scene, target_from_source);
        let support = self.support(Detail::Look, &proof.target_from_source, true);
        (proof.measures.closeness, proof.measures.evidence) = (support.closeness(), support.evidence());
        Some(proof)
    }

    /// The random stream of `stage` in this round, and no other's.
    #[must_use]
    pub fn rng(&self, stage: Stage) -> Rng {
        Rng::new(self.seed, self.round, stage as u32)
    }

    pub(crate) fn witnesses(&self) -> Witnesses<'_> {
        let Self { scene, pairs, alive, claims, .. } = *self;
        Witnesses { scene, pairs, alive, claims }
    }

    /// What chance brings, measured when first asked for. Not to be asked first from within a parallel map: the
    /// measurement is one itself, and a thread that waits in it may take up another that waits for it.
    pub(crate) fn chance(&self) -> &Chance {
        self.chance.get_or_init(|| {
            if !self.interrupt.enter(Phase::Chance) {
                return Chance::default();
            }
            Chance::of(self.scene, self.pairs, self.seed, self.interrupt)
        })
    }
}
