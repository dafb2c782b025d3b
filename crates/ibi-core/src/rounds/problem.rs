//! What the stages look at, as far as rounds change it.

use std::sync::OnceLock;

use nalgebra::Isometry3;

use crate::evidence::{Chance, Claims, Closeup, LOOK_NEAR, Support};
use crate::interrupt::Interrupt;
use crate::kernels::graph::Graph;
use crate::params::Params;
use crate::scene::{Alive, PROBE_POINTS, PointPairs, Scene};
use crate::stages::{Context, Validate};

/// What the stages look at.
#[derive(Debug)]
pub(crate) struct Problem<'a> {
    pub(crate) scene: Scene<'a>,
    pub(crate) pairs: PointPairs,
    pub(crate) alive: Alive,
    barred: Vec<bool>,
    graph: OnceLock<Graph>,
    is_first_look: bool,
    votes: OnceLock<Vec<Option<[f32; 3]>>>,
    chance: OnceLock<Chance>,
    closeup: Option<Closeup>,
    pub(crate) interrupt: Interrupt,
}

impl<'a> Problem<'a> {
    pub(crate) fn new(
        scene: Scene<'a>,
        pairs: PointPairs,
        closeup: Option<Closeup>,
        interrupt: Interrupt,
    ) -> Self {
        let (alive, barred) = (Alive::all(&pairs), vec![false; pairs.len()]);
        Self {
            scene,
            pairs,
            alive,
            barred,
            graph: OnceLock::new(),
            is_first_look: true,
            votes: OnceLock::new(),
            chance: OnceLock::new(),
            closeup,
            interrupt,
        }
    }

    /// What a stage sees in a round, once `poses` were accepted.
    pub(crate) fn context<'c>(
        &'c self,
        params: &'c Params,
        round: u32,
        poses: &'c [Isometry3<f64>],
    ) -> Context<'c> {
        Context {
            scene: &self.scene,
            pairs: &self.pairs,
            alive: &self.alive,
            delta_r_pr: params.delta_r_pr,
            t_s: params.t_s,
            seed: params.seed,
            round,
            barred: &self.barred,
            claims: Claims::new(&self.scene, poses),
            graph: &self.graph,
            is_first_look: self.is_first_look,
            votes: &self.votes,
            chance: &self.chance,
            closeup: self.closeup.as_ref(),
            interrupt: &self.interrupt,
        }
    }

    /// Takes `ids` out of what is alive; returns how many of them were.
    pub(crate) fn remove(&mut self, ids: &[u32]) -> u32 {
        if let Some(graph) = self.graph.get_mut() {
            graph.remove(ids);
        }
        self.alive.remove(ids) as u32
    }

    /// Bars `ids` from leading; returns how many were not barred before.
    pub(crate) fn bar(&mut self, ids: &[u32]) -> u32 {
        ids.iter().map(|&id| u32::from(!std::mem::replace(&mut self.barred[id as usize], true))).sum()
    }

    /// What is barred from leading once `ids` are too.
    pub(crate) fn also_barred(&self, ids: &[u32]) -> Vec<bool> {
        let mut barred = self.barred.clone();
        for &id in ids {
            barred[id as usize] = true;
        }
        barred
    }

    /// All that was measured, if that is more than the clouds.
    pub(crate) fn closeup(&self) -> Option<&Closeup> {
        self.closeup.as_ref()
    }

    /// Whether there is more to look at than the clouds.
    pub(crate) fn has_closeup(&self) -> bool {
        self.closeup.is_some()
    }

    /// Whether the graph is one of a part of the correspondences.
    pub(crate) fn is_sampled(&self) -> bool {
        self.graph.get().is_some_and(Graph::is_sample)
    }

    /// Ends the first look, if there is one; returns whether there was.
    pub(crate) fn end_first_look(&mut self) -> bool {
        let ends = self.is_first_look && self.is_sampled();
        if ends {
            (self.graph, self.is_first_look) = (OnceLock::new(), false);
        }
        ends
    }

    /// Whether two poses of the source can have to do with the same target points.
    pub(crate) fn are_near(&self, a: &Isometry3<f64>, b: &Isometry3<f64>) -> bool {
        let source = self.scene.source;
        let tolerances = &self.scene.tolerances;
        let reach_pr = 2.0 * (tolerances.d_op_pr + tolerances.d_op_pr.max(tolerances.t_he_pr));
        let reach = reach_pr * self.scene.resolution;
        (a * source.centre - b * source.centre).norm() < source.extent + reach
    }

    /// About how many points are looked at for a close look at a pose.
    pub(crate) fn cost_of_look(&self) -> usize {
        let num_source = self.scene.source.points.len();
        let num_looked_at = if self.scene.is_one_sided() { num_source } else { num_source.min(PROBE_POINTS) };
        num_looked_at + LOOK_NEAR + self.pairs.len() / 16
    }

    /// The same for a verdict.
    pub(crate) fn cost_of(&self, hv: &dyn Validate) -> usize {
        let is_by_look = hv.verdict_of(&Support::default()).is_some();
        self.cost_of_look() + if is_by_look { 0 } else { self.scene.source.points.len() }
    }
}
