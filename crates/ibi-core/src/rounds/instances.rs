//! The accepted poses.

use std::sync::OnceLock;

use nalgebra::Isometry3;

use crate::evidence::Proof;
use crate::scene::Scene;
use crate::stages::Hypothesis;

/// An accepted pose and its round.
#[derive(Debug)]
pub(crate) struct Instance {
    pub(crate) hypothesis: Hypothesis,
    pub(crate) round: u32,
    /// What a close look has found, if there was one.
    pub(crate) proof: Option<Proof>,
    overlap: OnceLock<f64>,
}

impl Instance {
    pub(crate) fn pose(&self) -> &Isometry3<f64> {
        &self.hypothesis.target_from_source
    }

    /// Share of the source that lies on the target; measured when first asked for.
    pub(crate) fn overlap(&self, scene: &Scene<'_>) -> f64 {
        *self.overlap.get_or_init(|| scene.overlap(self.pose()))
    }

    pub(crate) fn has_overlap(&self) -> bool {
        self.overlap.get().is_some()
    }
}

/// The accepted poses, in the order they were found.
#[derive(Debug, Default)]
pub(crate) struct Instances {
    all: Vec<Instance>,
    /// The pose of each, for those who want nothing else.
    poses: Vec<Isometry3<f64>>,
}

impl Instances {
    pub(crate) fn push(&mut self, hypothesis: Hypothesis, round: u32, proof: Option<Proof>) {
        self.poses.push(hypothesis.target_from_source);
        self.all.push(Instance { hypothesis, round, proof, overlap: OnceLock::new() });
    }

    pub(crate) fn poses(&self) -> &[Isometry3<f64>] {
        &self.poses
    }

    /// Keeps those for which there is something, and returns what.
    pub(crate) fn keep<T>(&mut self, kept: Vec<Option<T>>) -> Vec<T> {
        let is_kept =
            |kept: &[Option<T>]| kept.iter().map(Option::is_some).collect::<Vec<bool>>().into_iter();
        let (mut all, mut poses) = (is_kept(&kept), is_kept(&kept));
        self.all.retain(|_| all.next().unwrap_or_default());
        self.poses.retain(|_| poses.next().unwrap_or_default());
        kept.into_iter().flatten().collect()
    }
}

impl std::ops::Deref for Instances {
    type Target = [Instance];

    fn deref(&self) -> &[Instance] {
        &self.all
    }
}
