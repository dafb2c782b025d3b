//! The result of a run: poses measured and ranked, correspondences labelled.

use std::ops::ControlFlow;

use nalgebra::Isometry3;

use super::instances::Instances;
use super::problem::Problem;
use super::state::State;
use crate::evidence::Support;
use crate::grace::Grace;
use crate::interrupt::Phase;
use crate::registration::{MAX_REJECTED, Pose, Registration};
use crate::scene::Scene;
use crate::stop::StopReason;

impl State<'_> {
    /// The result: `supports` tells what speaks for each instance. Those for which there is no time are left out.
    pub(crate) fn into_registration(
        mut self,
        stop_reason: StopReason,
        supports: &[Support],
        grace: &mut Grace<'_>,
    ) -> Registration {
        let Problem { scene, pairs, interrupt, .. } = &self.problem;
        interrupt.begin(Phase::Rank);
        let cost = |at: usize| {
            let overlap = if self.instances[at].has_overlap() { 0 } else { scene.source.points.len() };
            overlap + pairs.len() / 16 + 1
        };
        let measured = grace
            .map(self.instances.len(), cost, |at| measure(&self.problem, &self.instances, at, &supports[at]));
        let mut measured: Vec<(Pose, Vec<f64>)> = measured.into_iter().flatten().collect();
        // Stable: equals stay in the order in which they were found.
        measured.sort_by(|(a, _), (b, _)| b.score.total_cmp(&a.score));
        drop_duplicates(scene, &mut measured, grace);
        let labels = labels(&measured, pairs.len());
        self.timings.total_s = self.start.elapsed().as_secs_f64();
        let stop_reason = match interrupt.check() {
            ControlFlow::Break(reason) if !stop_reason.is_from_outside() => reason,
            _ => stop_reason,
        };
        let company = self.instances.company();
        let mut rejected: Vec<_> =
            self.contest.given_up.iter().filter_map(|given_up| given_up.told(company)).collect();
        rejected.sort_by(|a, b| b.score.total_cmp(&a.score));
        rejected.truncate(MAX_REJECTED);
        Registration {
            rejected,
            poses: measured.into_iter().map(|(pose, _)| pose).collect(),
            labels,
            rounds: self.rounds,
            stop_reason,
            timings: self.timings,
            resolution: scene.resolution,
        }
    }
}

/// A pose with its quality measures, and the squared residual of each of its inliers.
fn measure(problem: &Problem<'_>, instances: &Instances, at: usize, support: &Support) -> (Pose, Vec<f64>) {
    let (instance, proof) = (&instances[at], instances.proof_among_others(at));
    let pose = *instance.pose();
    let (scene, pairs) = (&problem.scene, &problem.pairs);
    let t_he_pr = scene.tolerances.t_he_pr;
    let t_he = t_he_pr * scene.resolution;
    // Found in single precision, decided in double.
    let mut close = pairs.by_target.close_pairs(&pose, 1.01 * t_he_pr);
    close.sort_unstable();
    let (inliers, residuals_sq): (Vec<u32>, Vec<f64>) = close
        .iter()
        .map(|&id| (id, (pose * pairs.source[id as usize] - pairs.target[id as usize]).norm_squared()))
        .filter(|&(_, residual_sq)| residual_sq < t_he * t_he)
        .unzip();
    let mean_sq = residuals_sq.iter().sum::<f64>() / residuals_sq.len().max(1) as f64;
    let pose = Pose {
        target_from_source: pose,
        score: proof.map_or_else(|| support.score(), |proof| proof.measures.score()),
        overlap: instance.overlap(scene),
        closeness: support.closeness(),
        back_fit: support.back_fit,
        evidence: support.evidence(),
        inlier_rmse: mean_sq.sqrt(),
        inliers,
        round: instance.round,
        measures: proof.map(|proof| proof.measures),
        centre: pose * scene.source.centre,
        covariance: instance.known.as_ref().map(|known| known.covariance),
        free_motions: instance.known.as_ref().map(|known| known.free_motions.clone()).unwrap_or_default(),
    };
    (pose, residuals_sq)
}

/// Drops what differs from a better pose by a declared symmetry alone; nothing where none is declared.
///
/// Once the run is ended and the time for this is over, the poses of the least scores go, whether they are duplicates or not.
fn drop_duplicates(scene: &Scene<'_>, measured: &mut Vec<(Pose, Vec<f64>)>, grace: &mut Grace<'_>) {
    if scene.source.symmetries.is_none() {
        return;
    }
    let mut kept: Vec<Isometry3<f64>> = Vec::new();
    measured.retain(|(Pose { target_from_source: pose, .. }, _)| {
        let is_new =
            grace.allows(kept.len()) && kept.iter().all(|other| !scene.source.look_the_same(pose, other));
        if is_new {
            kept.push(*pose);
        }
        is_new
    });
}

/// For each correspondence the pose of which it is the closest inlier; the better-ranked one of equals.
fn labels(measured: &[(Pose, Vec<f64>)], num_correspondences: usize) -> Vec<Option<u32>> {
    let mut closest = vec![(f64::INFINITY, None); num_correspondences];
    for (label, (pose, residuals_sq)) in (0_u32..).zip(measured) {
        for (&id, &residual_sq) in pose.inliers.iter().zip(residuals_sq) {
            let best = &mut closest[id as usize];
            if residual_sq < best.0 {
                *best = (residual_sq, Some(label));
            }
        }
    }
    closest.into_iter().map(|(_, label)| label).collect()
}
