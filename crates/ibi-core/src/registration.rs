//! What a run says about itself.

use std::time::Instant;

use nalgebra::{Isometry3, Matrix6, Point3};

use crate::evidence::{FreeMotion, Measures, Objection};
use crate::stages::Verdict;
use crate::stop::StopReason;

/// The instances found, and how the run came to them.
#[derive(Debug, Clone)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct Registration {
    /// The instances, best score first.
    pub poses: Vec<Pose>,
    /// For each correspondence the instance (index into `poses`) it fits best with a residual below `t_he`.
    pub labels: Vec<Option<u32>>,
    /// What passed validation and failed when it was looked at close up, or beside poses of other models, best score first; at most
    /// 100.
    pub rejected: Vec<Rejected>,
    /// One entry per round that was played to its end.
    pub rounds: Vec<Round>,
    /// Why the run ended.
    pub stop_reason: StopReason,
    /// Where the time went.
    pub timings: Timings,
    /// pr, in data units; 0 where the run was ended before it was known.
    pub resolution: f64,
}

impl Registration {
    /// The result of a run that was ended before its first round.
    pub(crate) fn empty(
        num_correspondences: usize,
        stop_reason: StopReason,
        start: Instant,
        resolution: f64,
    ) -> Self {
        let total_s = start.elapsed().as_secs_f64();
        Self {
            poses: Vec::new(),
            rejected: Vec::new(),
            labels: vec![None; num_correspondences],
            rounds: Vec::new(),
            stop_reason,
            timings: Timings { prepare_s: total_s, total_s, ..Timings::default() },
            resolution,
        }
    }
}

/// Rejected poses that are told of.
pub(crate) const MAX_REJECTED: usize = 100;

impl Registration {
    /// Rejects poses that better ones of other models outdo; no correspondence is theirs any more.
    pub(crate) fn drop_outdone(&mut self, is_outdone: &[bool]) {
        if !is_outdone.contains(&true) {
            return;
        }
        let mut kept = 0..;
        let new: Vec<Option<u32>> =
            is_outdone.iter().map(|&is_outdone| if is_outdone { None } else { kept.next() }).collect();
        for label in &mut self.labels {
            *label = label.and_then(|label| new[label as usize]);
        }
        let mut of = new.iter();
        let outdone = self.poses.extract_if(.., |_| of.next().is_some_and(Option::is_none));
        self.rejected.extend(outdone.map(|pose| Rejected {
            target_from_source: pose.target_from_source,
            score: pose.score,
            objection: Objection::Outdone,
            measures: pose.measures,
            round: pose.round,
        }));
        self.rejected.sort_by(|a, b| b.score.total_cmp(&a.score));
        self.rejected.truncate(MAX_REJECTED);
    }
}

/// One instance.
#[derive(Debug, Clone)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct Pose {
    /// Moves source points onto this instance; data units.
    pub target_from_source: Isometry3<f64>,
    /// The probability that the pose is right, by `evidence`, `closeness` and `back_fit`; what poses are ranked by.
    pub score: f64,
    /// Share of source points within `d_op` of a target point, 0 to 1.
    pub overlap: f64,
    /// How much closer the source lies to the target than chance would have it: 0 as by chance, 1 for a perfect fit. In
    /// a scene seen from one side 1 is as close as its own points lie to each other on average, and it may be more. See [`crate::Support::closeness`].
    pub closeness: f64,
    /// Mean over the correspondences whose target point lies within 2 `d_op` of this instance, and of no other
    /// pose, of 1 - d / 2 `d_op`, d being that distance, 0 to 1.
    pub back_fit: f64,
    /// -log10 of the chance that as many correspondences would agree if they knew nothing of their targets.
    pub evidence: f64,
    /// Root mean square residual of the inliers, data units; 0 without inliers.
    pub inlier_rmse: f64,
    /// Ids of all correspondences with a residual below `t_he`, ascending. An id may be an inlier of several
    /// poses.
    pub inliers: Vec<u32>,
    /// The round that found it.
    pub round: u32,
    /// What was measured of it close up, if it was: where a scene is seen from one side and judged by
    /// [`crate::stages::hv::Evidence`]. Then the score is theirs.
    pub measures: Option<Measures>,
    /// c, the centre of the source's bounding box where the pose puts it; target's frame, data units.
    pub centre: Point3<f64>,
    /// How far the pose may be off, where all that a camera measured was handed in and a last polish was made on it; else `None`.
    ///
    /// Of a small motion in the target's frame about [`Self::centre`] (a *left* perturbation): the true pose is
    /// x -> c + exp(\[w\]) (x - c) + t after this one. In this order: w_x, w_y, w_z (radians), t_x, t_y, t_z (data units).
    /// It is for a pose that is right, and says nothing of whether it is: that is what `score` is for.
    ///
    /// From the planes of the measured points that the pose explains, with what they lie off and how much of that neighbours
    /// share, as measured on all poses of the run; and from the ends of faces, which are known to 0.15 voxels. What nothing
    /// holds is known to within the size of the part. Not in it: what is the same over a whole scan, as a wrong scale.
    pub covariance: Option<Matrix6<f64>>,
    /// The motions that nothing holds, slides first: those whose standard deviation exceeds a voxel, at a point as far from the
    /// centre as the source reaches. Empty where all are held, and where there is no covariance.
    pub free_motions: Vec<FreeMotion>,
}

/// A pose that was given up.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct Rejected {
    /// Moved source points to where it was; data units.
    pub target_from_source: Isometry3<f64>,
    /// The probability that it is right.
    pub score: f64,
    /// What speaks most against it.
    pub objection: Objection,
    /// What was measured of it close up, if it was.
    pub measures: Option<Measures>,
    /// The round that found it.
    pub round: u32,
}

/// One round: one pass through the four stages.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct Round {
    /// Number of the round, from 0.
    pub index: u32,
    /// Correspondences alive at its start.
    pub num_alive: u32,
    /// `N_s`, seeds found.
    pub num_seeds: u32,
    /// Size of `C_d`.
    pub num_dense: u32,
    /// Samples drawn by the transformation estimation.
    pub num_samples: u32,
    /// Those of them skipped as degenerate.
    pub num_degenerate: u32,
    /// Whether a limit ended the search for samples early, such as `max_triangles` of `sac_cot`: there may be better ones.
    pub capped: bool,
    /// Score of the hypothesis; `None` if there was none.
    pub hypothesis_score: Option<f64>,
    /// What validation measured; `None` if there was no hypothesis.
    pub verdict: Option<Verdict>,
    /// Correspondences removed at its end.
    pub num_removed: u32,
    /// Correspondences barred at its end from leading a seed selection.
    pub num_barred: u32,
}

impl Round {
    /// Whether the hypothesis passed validation.
    #[must_use]
    pub fn accepted(&self) -> bool {
        self.verdict.is_some_and(|verdict| verdict.accepted())
    }
}

/// Seconds of wall time. Where the seeds of a round are selected while the one before it is played, the stages count the
/// seconds of both.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct Timings {
    /// Checking the target and the correspondences, grids, resolution.
    pub prepare_s: f64,
    /// Seed correspondence selection, all rounds.
    pub scs_s: f64,
    /// Correspondence enhancement, all rounds.
    pub ce_s: f64,
    /// Transformation estimation, all rounds.
    pub te_s: f64,
    /// Refinement of the hypotheses, all rounds.
    pub refine_s: f64,
    /// Hypothesis validation, all rounds.
    pub hv_s: f64,
    /// Everything from `begin` to the result.
    pub total_s: f64,
}

impl Timings {
    pub(crate) fn add(&mut self, other: &Self) {
        self.prepare_s += other.prepare_s;
        self.scs_s += other.scs_s;
        self.ce_s += other.ce_s;
        self.te_s += other.te_s;
        self.refine_s += other.refine_s;
        self.hv_s += other.hv_s;
        self.total_s += other.total_s;
    }
}
