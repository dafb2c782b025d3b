use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::gtm::OTSU_BINS;
use crate::error::Error;
use crate::kernels::graph::{EdgeTest, Graph};
use crate::kernels::otsu::otsu;
use crate::kernels::replicator::replicator;
use crate::params::{at_least_1, non_negative, positive};
use crate::stages::{Context, Ranked, SelectSeeds};

/// Neighbourhoods of so few cannot be split by a histogram: seeds are those above a share of the largest.
const FEW: usize = 8;
const FEW_SHARE: f32 = 0.3;

/// `local_gtm`: the game of `gtm`, played by the neighbourhood of one correspondence at a time in the
/// second-order compatibility graph of *all* correspondences.
///
/// The correspondence with the most support leads; it and its neighbours play. One instance cannot be pulled
/// apart by twenty equal ones, as in the global game, and nothing is drawn at random. The graph is built once
/// and serves all rounds.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(default, deny_unknown_fields)
)]
pub struct LocalGtm {
    /// tau: largest rigidity of compatible correspondences, in pr. > 0.
    pub tau_pr: f64,
    /// Correspondences nearer to each other than this, on either side, say nothing about a pose, in pr. >= 0.
    pub min_length_pr: f64,
    /// With normals: how far the angles between two oriented points may differ, in cosine. > 0.
    pub normal_tolerance: f64,
    /// Whether an edge is weighed by what its two ends have in common, or by its own rigidity alone.
    pub second_order: bool,
    /// `N_gtm`: generations of the replicator. At least 1.
    pub n_gtm: u32,
}

impl Default for LocalGtm {
    fn default() -> Self {
        Self { tau_pr: 1.0, min_length_pr: 1.0, normal_tolerance: 0.5, second_order: true, n_gtm: 20 }
    }
}

impl LocalGtm {
    pub(super) fn check(&self) -> Result<(), Error> {
        positive("scs.tau_pr", self.tau_pr)?;
        non_negative("scs.min_length_pr", self.min_length_pr)?;
        positive("scs.normal_tolerance", self.normal_tolerance)?;
        at_least_1("scs.n_gtm", self.n_gtm)
    }

    fn build(&self, context: &Context<'_>) -> Graph {
        let diameter_pr = context.scene.source.diameter() / context.scene.resolution;
        let test = EdgeTest {
            tau: self.tau_pr as f32,
            min_length: self.min_length_pr as f32,
            max_length: (diameter_pr + self.tau_pr) as f32,
            normal_tolerance: self.normal_tolerance as f32,
            second_order: self.second_order,
        };
        let interrupted = || context.interrupt.is_set();
        let mut graph =
            Graph::new(&context.pairs.columns, context.pairs.normals.as_ref(), &test, interrupted);
        // In the first round everything is alive; a stage of the user's may have begun the run, though.
        if context.alive.ids().len() < graph.len() {
            let is_dead = |id: &u32| context.alive.ids().binary_search(id).is_err();
            graph.remove(&(0..graph.len() as u32).filter(is_dead).collect::<Vec<_>>());
        }
        graph
    }

    /// The seeds among `leader` and its alive neighbours.
    fn play(&self, context: &Context<'_>, graph: &Graph, leader: u32) -> Ranked {
        let (neighbors, _) = graph.edges(leader);
        let mut players: Vec<u32> =
            neighbors.iter().copied().filter(|&j| graph.is_alive(j)).chain([leader]).collect();
        players.sort_unstable();
        let payoff = payoffs(graph, &players);
        let generations = self.n_gtm as usize;
        let interrupted = || context.interrupt.is_set();
        let Some(population) = replicator(&payoff, players.len(), generations, interrupted) else {
            return Ranked::default();
        };
        let t_gtm = if players.len() > FEW {
            otsu(&population, OTSU_BINS).unwrap_or(0.0)
        } else {
            FEW_SHARE * population.iter().copied().fold(0.0, f32::max)
        };
        // The leader is a seed whatever its share: barred with the others, it cannot lead to them again.
        let is_seed = |&(i, x): &(u32, f32)| x > t_gtm || i == leader;
        Ranked::new(players.into_iter().zip(population).filter(is_seed).collect())
    }
}

/// Row-major second-order payoffs of `players` with each other.
fn payoffs(graph: &Graph, players: &[u32]) -> Vec<f32> {
    const NONE: u32 = u32::MAX;
    let n = players.len();
    // Looking a neighbour's column up beats walking the two sorted lists side by side four to one.
    let mut columns = vec![NONE; graph.len()];
    for (column, &player) in (0_u32..).zip(players) {
        columns[player as usize] = column;
    }
    let mut matrix = vec![0.0; n * n];
    for (row, &i) in matrix.chunks_exact_mut(n).zip(players) {
        let (neighbors, weights) = graph.edges(i);
        for (&j, &w) in neighbors.iter().zip(weights) {
            let column = columns[j as usize];
            if column != NONE {
                row[column as usize] = w;
            }
        }
    }
    matrix
}

impl SelectSeeds for LocalGtm {
    fn select_seeds(&self, context: &Context<'_>) -> Ranked {
        let graph = context.graph.get_or_init(|| self.build(context));

        let may_lead = |i: u32| !context.barred[i as usize] && !graph.is_futile(i) && graph.support(i) > 0.0;
        // The first or second leader will do in most rounds, so they are not sorted. Supports are positive: their bits
        // order them.
        let key = |&i: &u32| (graph.support(i).to_bits(), Reverse(i));
        let leaders = context.alive.ids().iter().filter(|&&i| may_lead(i)).map(key);
        let mut leaders: BinaryHeap<_> = leaders.collect();
        let enough = context.params.t_s as usize;
        let mut most = Ranked::default();
        while let Some((_, Reverse(leader))) = leaders.pop() {
            let seeds = self.play(context, graph, leader);
            if seeds.len() >= enough || context.interrupt.is_set() {
                return seeds;
            }
            // It gives way to the next, and would lose again as long as its neighbourhood stays the same. Without
            // this memory a scan's run played a hundred games a round (measured: 44,000 in 478 rounds).
            graph.set_futile(leader);
            if seeds.len() > most.len() {
                most = seeds;
            }
        }
        most
    }
}
