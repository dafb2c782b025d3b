//! The four stages: what each is asked, what it answers, and what passes between them.
//!
//! Each stage is an open trait, for a type of your own, and a closed enum of the variants that parameter files
//! can name. The enum implements the trait by asking the variant it holds.

pub mod ce;
pub mod hv;
pub mod scs;
pub mod te;

use std::sync::OnceLock;

use nalgebra::Isometry3;

use crate::claims::Claims;
use crate::correspondence::{Alive, PointPairs};
use crate::error::Argument;
use crate::interrupt::{Interrupt, Phase};
use crate::kernels::evidence::Support;
use crate::kernels::graph::Graph;
use crate::kernels::rng::Rng;
use crate::params::{Params, Refine};
use crate::scene::{Detail, Scene};

/// SCS: picks from the alive correspondences a few that are highly consistent with each other.
pub trait SelectSeeds: Send + Sync {
    /// The seeds `C_s`; empty when there are none.
    fn select_seeds(&self, context: &Context<'_>) -> Ranked;

    /// An optional argument of the registration without which this selection cannot do; a run that lacks it is refused
    /// at its begin. By default there is none.
    fn needs(&self) -> Option<Argument> {
        None
    }
}

/// CE: gathers the alive correspondences that agree with the seeds.
pub trait Enhance: Send + Sync {
    /// The dense correspondences `C_d`, best first.
    fn enhance(&self, context: &Context<'_>, seeds: &Ranked) -> Ranked;
}

/// TE: estimates one pose from the dense correspondences.
pub trait EstimatePose: Send + Sync {
    /// The best hypothesis found, and how many were tried.
    fn estimate_pose(&self, context: &Context<'_>, dense: &Ranked) -> Estimate;
}

/// HV: holds the pose against the two clouds.
pub trait Validate: Send + Sync {
    /// Accepted or rejected, with the measured value. Asked again at the end of a contest, also after the run was
    /// interrupted: unlike the other stages it must then still answer truly.
    fn validate(&self, context: &Context<'_>, hypothesis: &Hypothesis) -> Verdict;

    /// A verdict at a first glance, on a hypothesis that was polished only roughly: a rejection, if no closer look could
    /// change it. By default there is none.
    fn glance(&self, context: &Context<'_>, hypothesis: &Hypothesis) -> Option<Verdict> {
        let _ = (context, hypothesis);
        None
    }

    /// The verdict that [`Self::validate`] would come to where [`Context::support`] of a close look, with claimed scene points
    /// left out, is `support`. `None`, which is the default, if more must be known.
    fn verdict_of(&self, support: &Support) -> Option<Verdict> {
        let _ = support;
        None
    }

    /// Whether the verdict depends on nothing but the pose, what is alive and what is claimed. Then a hypothesis that ends
    /// up where another one was judged is not judged again. By default it may depend on more.
    fn is_repeatable(&self) -> bool {
        false
    }

    /// Whether an accepted hypothesis is good enough to become an instance at once, without waiting for the end of the
    /// contest. By default none is.
    fn is_sure(&self, verdict: &Verdict) -> bool {
        let _ = verdict;
        false
    }
}

/// What a stage sees of the run: the input, what is alive, the parameters, the round.
#[derive(Debug, Clone, Copy)]
pub struct Context<'a> {
    /// The two clouds and the resolution.
    pub scene: &'a Scene<'a>,
    /// All correspondences, by id.
    pub pairs: &'a PointPairs,
    /// Those that no round has removed yet.
    pub alive: &'a Alive,
    /// The parameters of the run, already checked.
    pub params: &'a Params,
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
        let mut inliers = self.unsorted_inliers(target_from_source, distance_pr);
        inliers.sort_unstable();
        inliers
    }

    fn unsorted_inliers(&self, target_from_source: &Isometry3<f64>, distance_pr: f64) -> Vec<u32> {
        let mut inliers = self.pairs.by_target.close_pairs(target_from_source, distance_pr);
        inliers.retain(|&id| self.alive.contains(id) && self.normals_agree(id, target_from_source));
        inliers
    }

    /// The MAE of a pose over the alive correspondences (Eq. 7-8), of which only those near it are looked at.
    #[must_use]
    pub fn mae(&self, target_from_source: &Isometry3<f64>) -> f64 {
        let inliers = self.inliers(target_from_source, self.params.t_he_pr);
        let t_he = self.length(self.params.t_he_pr);
        let pairs = self.pairs.pairs(inliers);
        pairs.map(|(p, q)| (1.0 - (target_from_source * p - q).norm() / t_he).max(0.0)).sum()
    }

    /// Alive correspondences that an accepted pose uses up: its inliers within 2 `t_he`, and those, right or
    /// wrong, whose target point it explains.
    #[must_use]
    pub fn spent(&self, target_from_source: &Isometry3<f64>) -> Vec<u32> {
        let mut spent = self.unsorted_inliers(target_from_source, 2.0 * self.params.t_he_pr);
        spent.extend(
            self.near(usize::MAX, self.params.d_op_pr, target_from_source)
                .found
                .into_iter()
                .map(|(id, ..)| id),
        );
        spent.sort_unstable();
        spent.dedup();
        spent
    }

    /// Alive correspondences whose target point lies within `distance_pr` of the moved source, each with the row of the
    /// nearest source point and the distance in data units. Of more than `most` around only every so many-th.
    fn near(&self, most: usize, distance_pr: f64, target_from_source: &Isometry3<f64>) -> Near {
        let scene = self.scene;
        let mut ids = self.around(distance_pr, target_from_source);
        ids.retain(|&id| self.alive.contains(id));
        let step = ids.len().div_ceil(most).max(1);
        let targets = ids.iter().step_by(step).map(|&id| (id, self.pairs.target[id as usize]));
        Near { found: scene.nearest_source(distance_pr, target_from_source, targets), step: step as u32 }
    }

    /// Correspondences whose target point lies within `distance_pr` of the ball around the moved source.
    pub(crate) fn around(&self, distance_pr: f64, target_from_source: &Isometry3<f64>) -> Vec<u32> {
        let source = self.scene.source;
        let radius = source.radius + self.length(distance_pr);
        self.pairs.by_target.within(&(target_from_source * source.centre), radius)
    }

    /// What speaks for a pose: the alive correspondences, and the scene points, if `exclusive` only those that no
    /// accepted instance has claimed.
    #[must_use]
    pub fn support(&self, detail: Detail, target_from_source: &Isometry3<f64>, exclusive: bool) -> Support {
        let chance = self.chance();
        let reach_pr = 2.0 * self.params.d_op_pr;
        let (reach, d_op) = (self.length(reach_pr), self.length(self.params.d_op_pr));
        let t_he = self.length(self.params.t_he_pr);
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
            self.unsorted_inliers(target_from_source, self.params.t_he_pr.min(self.params.d_op_pr)).len()
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
        let fit = self.scene.fit(self.params, detail, target_from_source, are_claimed);
        Support {
            num_explained: (num_explained as u32 * step).max(num_agreeing as u32),
            num_agreeing: num_agreeing as u32,
            chance: expected / num_explained.max(1) as f64,
            fit: fit.mean,
            explained: fit.share,
            back_fit: back_fit / near.len().max(1) as f64,
            chance_fit: chance.fit,
            best_fit: chance.best_fit,
            one_sided: self.scene.is_one_sided(self.params),
        }
    }

    /// What chance brings, measured when first asked for. Not to be asked first from within a parallel map: the
    /// measurement is one itself, and a thread that waits in it may take up another that waits for it.
    pub(crate) fn chance(&self) -> &Chance {
        self.chance.get_or_init(|| {
            let interrupt = self.interrupt;
            if !interrupt.enter(Phase::Chance) {
                return Chance::default();
            }
            let agreement = self.pairs.chances(self.scene, self.params, interrupt);
            if interrupt.is_set() {
                return Chance::default();
            }
            let [fit, best_fit] = [self.scene.chance_fit(self.params), self.scene.best_fit(self.params)];
            Chance { agreement, fit, best_fit }
        })
    }

    fn normals_agree(&self, id: u32, target_from_source: &Isometry3<f64>) -> bool {
        match (&self.pairs.normals, self.params.min_normal_cos) {
            (Some(normals), Some(min_cos)) => normals.agree(id, target_from_source, min_cos),
            _ => true,
        }
    }

    /// The hypothesis polished on the clouds. `None` if the parameters do not want it, or if it has carried the pose
    /// away from its correspondences, so that fewer than `t_s` alive ones still agree: the clouds alone fit flat
    /// faces almost anywhere.
    #[must_use]
    pub fn refined(&self, detail: Detail, hypothesis: Hypothesis) -> Option<Hypothesis> {
        self.polished(detail, hypothesis).and_then(Polished::if_supported)
    }

    /// The same, whether the correspondences still agree or not.
    pub(crate) fn polished(&self, detail: Detail, hypothesis: Hypothesis) -> Option<Polished> {
        let target_from_source = match self.params.refine {
            Refine::None => return None,
            Refine::Icp | Refine::IcpTurns => {
                self.scene.icp(self.params, detail, &hypothesis.target_from_source)
            }
        };
        let support = self.unsorted_inliers(&target_from_source, self.params.t_he_pr).len();
        let is_supported = support >= self.params.t_s as usize;
        Some(Polished { hypothesis: Hypothesis { target_from_source, ..hypothesis }, is_supported })
    }

    /// The random stream of `stage` in this round, and no other's.
    #[must_use]
    pub fn rng(&self, stage: Stage) -> Rng {
        Rng::new(self.params.seed, self.round, stage as u32)
    }
}

/// A hypothesis polished on the clouds, and whether enough correspondences still agree with it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Polished {
    pub(crate) hypothesis: Hypothesis,
    is_supported: bool,
}

impl Polished {
    pub(crate) fn if_supported(self) -> Option<Hypothesis> {
        self.is_supported.then_some(self.hypothesis)
    }
}

/// Correspondences near a pose: the id of each, the row of the source point nearest to its target point, and their
/// distance; and how many each of them stands for.
struct Near {
    found: Vec<(u32, u32, f64)>,
    step: u32,
}

/// Correspondences near a pose that are looked at for a glance, and for more.
const GLANCE_NEAR: usize = 128;
pub(crate) const LOOK_NEAR: usize = 1024;

/// What chance brings in a scene. Nothing is to be read from it once the run was interrupted before it was measured: then no
/// instance was found.
#[derive(Debug, Default)]
pub(crate) struct Chance {
    /// For each source point the share of all correspondences that would agree with it.
    agreement: Vec<f32>,
    /// The fit of a pose somewhere on the target.
    fit: f64,
    /// The fit of the target to itself.
    best_fit: f64,
}

/// The stages, as keys of random streams.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Stage {
    Scs,
    Ce,
    Te,
    Hv,
}

/// Correspondences with a score each (finite, >= 0), best first, ties by the lower id.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Ranked {
    ids: Vec<u32>,
    scores: Vec<f32>,
}

impl Ranked {
    /// Ranks `(id, score)` pairs; the ids must differ.
    #[must_use]
    pub fn new(scored: Vec<(u32, f32)>) -> Self {
        Self::best_of(scored, usize::MAX)
    }

    /// Ranks the best `n` of `(id, score)` pairs; the ids must differ.
    #[must_use]
    pub fn best_of(mut scored: Vec<(u32, f32)>, n: usize) -> Self {
        let order = |a: &(u32, f32), b: &(u32, f32)| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0));
        if n < scored.len() {
            scored.select_nth_unstable_by(n, order);
            scored.truncate(n);
        }
        scored.sort_unstable_by(order);
        let (ids, scores) = scored.into_iter().unzip();
        Self { ids, scores }
    }

    /// The ids, best first.
    #[must_use]
    pub fn ids(&self) -> &[u32] {
        &self.ids
    }

    /// The scores, in the order of [`Self::ids`].
    #[must_use]
    pub fn scores(&self) -> &[f32] {
        &self.scores
    }

    /// How many there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }
}

/// A pose that was estimated but not validated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hypothesis {
    /// Moves source points onto the target; data units.
    pub target_from_source: Isometry3<f64>,
    /// What its stage ranked it by; MAE (Eq. 7-8) in every variant here.
    pub score: f64,
}

/// What a transformation estimation came to.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Estimate {
    /// The best hypothesis; `None` if every sample was degenerate.
    pub hypothesis: Option<Hypothesis>,
    /// Samples drawn.
    pub num_samples: u32,
    /// Samples skipped because their points were too near to one line.
    pub num_degenerate: u32,
    /// Whether a limit of the stage ended its search early: there may be better samples than those tried.
    pub capped: bool,
}

/// A measured value against its threshold.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct Verdict {
    /// What was measured.
    pub value: f64,
    /// What it must exceed.
    pub threshold: f64,
}

impl Verdict {
    /// Accepted exactly if the value exceeds the threshold.
    #[must_use]
    pub fn accepted(&self) -> bool {
        self.value > self.threshold
    }
}

/// Declares the closed set of a stage's variants: the enum, its names, its defaults, its range checks.
macro_rules! variants {
    ($(#[$doc:meta])* $name:ident { $($(#[$vdoc:meta])* $variant:ident = $word:literal,)+ }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq)]
        #[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
        #[cfg_attr(feature = "serde", serde(tag = "variant"))]
        #[non_exhaustive]
        pub enum $name {
            $($(#[$vdoc])* #[cfg_attr(feature = "serde", serde(rename = $word))] $variant($variant),)+
        }

        $(impl From<$variant> for $name {
            fn from(params: $variant) -> Self {
                Self::$variant(params)
            }
        })+

        impl $name {
            /// Every variant with its default parameters; what conformance tests and benches run over.
            #[must_use]
            pub fn all() -> Vec<Self> {
                vec![$(Self::$variant($variant::default()),)+]
            }

            /// The word that names the variant in parameter files, tables and Python.
            #[must_use]
            pub fn name(&self) -> &'static str {
                match self { $(Self::$variant(_) => $word,)+ }
            }

            pub(crate) fn check(&self) -> Result<(), $crate::Error> {
                match self { $(Self::$variant(params) => params.check(),)+ }
            }
        }
    };
}
pub(crate) use variants;
