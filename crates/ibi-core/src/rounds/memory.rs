//! Remembering what became of poses: many seeds lead to one and the same.

use nalgebra::Isometry3;

use super::judge::{Judge, Judged};
use crate::registration::Timings;
use crate::scene::Scene;
use crate::stages::{Context, Hypothesis};

/// A pose at a first glance that is so near to one that has been judged will end up there. In a scan, in which thousands of
/// rounds look at the same few faces, a wider circle pays.
const SAME_PR: f64 = 0.5;
const SAME_PR_ONE_SIDED: f64 = 2.0;

/// The estimated poses since an instance was last found, and what became of each.
#[derive(Debug, Default)]
pub(crate) struct Tried(Vec<(Isometry3<f64>, Judged)>);

impl Tried {
    /// What became of `pose`, if it has been tried.
    fn get(&self, pose: &Isometry3<f64>) -> Option<Judged> {
        self.0.iter().find(|(tried, _)| tried == pose).map(|&(_, judged)| judged)
    }

    /// What became of the first that ended up where the pose `rough` is at a first glance.
    pub(super) fn near(&self, scene: &Scene<'_>, rough: &Isometry3<f64>) -> Option<Judged> {
        let same_pr = if scene.is_one_sided() { SAME_PR_ONE_SIDED } else { SAME_PR };
        let is_same = |judged: &Judged| {
            let shift = scene.source.displacement(rough, &judged.hypothesis.target_from_source);
            shift < same_pr * scene.resolution
        };
        self.0.iter().map(|&(_, judged)| judged).find(is_same)
    }

    pub(super) fn add(&mut self, pose: &Isometry3<f64>, judged: Judged) {
        if self.get(pose).is_none() {
            self.0.push((*pose, judged));
        }
    }
}

/// Judges what has not been tried before. `tried` is `None` where a verdict may depend on more than the pose.
pub(super) struct Remembering<'a> {
    pub(super) tried: Option<&'a Tried>,
    pub(super) judge: &'a dyn Judge,
}

impl Judge for Remembering<'_> {
    fn judge(&self, context: &Context<'_>, raw: &Hypothesis, timings: &mut Timings) -> Option<Judged> {
        let before = self.tried.and_then(|tried| tried.get(&raw.target_from_source));
        before.or_else(|| self.judge.judge(context, raw, timings))
    }
}
