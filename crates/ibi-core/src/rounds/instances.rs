//! The accepted poses.

use std::sync::OnceLock;

use nalgebra::Isometry3;

use crate::evidence::odds::company;
use crate::evidence::{Known, Proof};
use crate::scene::Scene;
use crate::stages::Hypothesis;

/// An accepted pose and its round.
#[derive(Debug)]
pub(crate) struct Instance {
    pub(crate) hypothesis: Hypothesis,
    pub(crate) round: u32,
    /// What a close look has found, if there was one.
    pub(crate) proof: Option<Proof>,
    /// How well it is known, once it has had its last polish.
    pub(crate) known: Option<Known>,
    overlap: OnceLock<f64>,
}

impl Instance {
    pub(crate) fn pose(&self) -> &Isometry3<f64> {
        &self.hypothesis.target_from_source
    }

    /// How sure it is by itself.
    fn certainty(&self) -> f64 {
        self.proof.map_or(0.0, |proof| proof.measures.certainty())
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
        self.all.push(Instance { hypothesis, round, proof, known: None, overlap: OnceLock::new() });
    }

    /// The last polish of one of them.
    pub(crate) fn polished(&mut self, at: usize, target_from_source: Isometry3<f64>, known: Known) {
        let instance = &mut self.all[at];
        if instance.hypothesis.target_from_source != target_from_source {
            instance.overlap = OnceLock::new();
        }
        (instance.hypothesis.target_from_source, instance.known) = (target_from_source, Some(known));
        self.poses[at] = target_from_source;
    }

    pub(crate) fn poses(&self) -> &[Isometry3<f64>] {
        &self.poses
    }

    /// What they add to the odds of another pose.
    pub(crate) fn company(&self) -> f64 {
        company(self.all.iter().map(Instance::certainty))
    }

    /// The proof of one of them among the others.
    pub(crate) fn proof_among_others(&self, at: usize) -> Option<Proof> {
        let others = self.all.iter().enumerate().filter(|&(other, _)| other != at);
        Some(self.all[at].proof?.found_among(company(others.map(|(_, other)| other.certainty()))))
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
