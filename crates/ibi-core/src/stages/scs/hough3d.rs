use nalgebra::{Matrix3, Point3, Vector3};

use crate::error::Error;
use crate::kernels::frames::frames;
use crate::kernels::hough::peak;
use crate::kernels::nearby::Nearby;
use crate::ranges::positive;
use crate::scene::PreparedCloud;
use crate::stages::{Context, Ranked, SelectSeeds};

/// `hough3d`: each correspondence votes for where the centroid of the source lies in the target, by the local reference
/// frames at its two points; the voters of the cell with the most votes are the seeds (Tombari & Di Stefano 2010).
///
/// Frames that are not given are computed from the clouds, once a run, at the points that correspondences use. Memory: 16
/// bytes a correspondence, and up to 300 each while a round counts.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(default, deny_unknown_fields)
)]
pub struct Hough3d {
    /// Width of a cell of the accumulator, in pr. > 0.
    pub bin_pr: f64,
    /// Radius of the neighbourhood that a frame is computed from, in pr. > 0.
    pub frame_radius_pr: f64,
}

impl Default for Hough3d {
    fn default() -> Self {
        Self { bin_pr: 2.0, frame_radius_pr: 6.0 }
    }
}

impl Hough3d {
    pub(super) fn check(&self) -> Result<(), Error> {
        positive("scs.bin_pr", self.bin_pr)?;
        positive("scs.frame_radius_pr", self.frame_radius_pr)
    }

    /// Where each correspondence puts the centroid of the source, in the frame and unit of the columns; `None` where one of
    /// its points has no frame.
    fn votes(&self, context: &Context<'_>) -> Vec<Option<[f32; 3]>> {
        let (pairs, scene) = (context.pairs, context.scene);
        let radius = context.length(self.frame_radius_pr);
        let interrupted = || context.interrupt.is_set();
        let source = frames_at(scene.source, &scene.near_source, &pairs.source_rows, radius, interrupted);
        let target = frames_at(&scene.target, &scene.near_target, &pairs.target_rows, radius, interrupted);
        let sum: Vector3<f64> = scene.source.points.iter().map(|p| p.coords).sum();
        let centroid = Point3::from(sum / scene.source.points.len() as f64);
        let (_, centre_q) = pairs.columns.centres;
        let vote = |id: usize| {
            let (from, to) = (source[id]?, target[id]?);
            // The axes are rows: `from` brings the vector into the frame, and the transpose of `to` out of the other.
            let moved = pairs.target[id] + to.transpose() * (from * (centroid - pairs.source[id]));
            Some(((moved.coords - centre_q) / pairs.columns.unit).cast::<f32>().into())
        };
        (0..pairs.len()).map(vote).collect()
    }
}

/// The frame at each of `rows` of a cloud: that which was given, or one that is computed, once for each point.
fn frames_at(
    cloud: &PreparedCloud<'_>,
    nearby: &Nearby,
    rows: &[u32],
    radius: f64,
    interrupted: impl Fn() -> bool + Sync,
) -> Vec<Option<Matrix3<f64>>> {
    if let Some(frames) = &cloud.frames {
        return rows.iter().map(|&row| Some(frames[row as usize])).collect();
    }
    let mut used = rows.to_vec();
    used.sort_unstable();
    used.dedup();
    let frames = frames(&cloud.points, nearby, &used, radius, interrupted);
    rows.iter().map(|row| frames[used.binary_search(row).ok()?]).collect()
}

impl SelectSeeds for Hough3d {
    fn select_seeds(&self, context: &Context<'_>) -> Ranked {
        let all = context.votes.get_or_init(|| self.votes(context));
        let free = context.alive.ids().iter().copied().filter(|&id| !context.barred[id as usize]);
        let votes: Vec<(u32, [f32; 3])> = free.filter_map(|id| Some((id, all[id as usize]?))).collect();
        Ranked::new(peak(&votes, self.bin_pr as f32, || context.interrupt.is_set()))
    }
}
