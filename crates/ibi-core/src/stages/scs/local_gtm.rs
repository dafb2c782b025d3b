use std::cmp::Reverse;

use super::gtm::OTSU_BINS;
use crate::error::Error;
use crate::interrupt::Phase;
use crate::kernels::graph::{EdgeTest, Graph};
use crate::kernels::otsu::otsu;
use crate::kernels::replicator::{Payoffs, replicator};
use crate::ranges::{at_least_1, at_least_8, non_negative, positive};
use crate::stages::{Context, Ranked, SelectSeeds};

/// Neighbourhoods of so few cannot be split by a histogram: seeds are those above a share of the largest.
const FEW: usize = 8;
const FEW_SHARE: f32 = 0.3;

/// With the leader play at most so many of its neighbours, those with the largest weights.
const MAX_OTHERS: usize = 63;

/// The `max_degree` of a first graph, if that is less.
const FIRST_DEGREE: u32 = 16;

/// Neighbourhoods in a row that come to too few seeds, and no more is expected of a first graph.
const FIRST_FUTILE: u32 = 8;

/// `local_gtm`: the game of `gtm`, played by the neighbourhood of one correspondence at a time in the
/// second-order compatibility graph of *all* correspondences.
///
/// The correspondence with the most support leads; it and its neighbours play. One instance cannot be pulled
/// apart by twenty equal ones, as in the global game, and nothing is drawn at random. A graph
/// serves many rounds: a first one of a part of the correspondences, then one of all that are left.
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
    /// Where correspondences have more compatible ones than this around them, only so many of them take part that they
    /// have about as many. Bounds time and memory, and keeps those down that are compatible with all and sundry. At
    /// least 8.
    pub max_degree: u32,
    /// Where more correspondences than this lie around one, a first graph holds only so many of them, which is enough to
    /// find most instances in a fraction of the time. Once nothing more comes of it, a graph of all that are left takes
    /// its place. `None`: that one from the beginning. At least 8.
    #[cfg_attr(feature = "serde", serde(deserialize_with = "crate::ranges::none_or"))]
    pub first_look: Option<u32>,
    /// `N_gtm`: generations of the replicator. At least 1.
    pub n_gtm: u32,
}

impl Default for LocalGtm {
    fn default() -> Self {
        Self {
            tau_pr: 0.9,
            min_length_pr: 1.0,
            normal_tolerance: 0.5,
            second_order: true,
            max_degree: 80,
            first_look: Some(256),
            n_gtm: 20,
        }
    }
}

impl LocalGtm {
    pub(super) fn check(&self) -> Result<(), Error> {
        positive("scs.tau_pr", self.tau_pr)?;
        non_negative("scs.min_length_pr", self.min_length_pr)?;
        positive("scs.normal_tolerance", self.normal_tolerance)?;
        at_least_8("scs.max_degree", self.max_degree)?;
        if let Some(first_look) = self.first_look {
            at_least_8("scs.first_look", first_look)?;
        }
        at_least_1("scs.n_gtm", self.n_gtm)
    }

    fn build(&self, context: &Context<'_>) -> Graph {
        if !context.interrupt.enter(Phase::Graph) {
            return Graph::default();
        }
        // Interrupted, nobody looks at the graph.
        let source = context.scene.source;
        let diameter_pr =
            source.diameter(context.interrupt).unwrap_or(source.extent) / context.scene.resolution;
        let (max_degree, max_vicinity) = match self.first_look.filter(|_| context.is_first_look) {
            Some(max_vicinity) => (self.max_degree.min(FIRST_DEGREE), max_vicinity),
            None => (self.max_degree, u32::MAX),
        };
        let test = EdgeTest {
            tau: self.tau_pr as f32,
            min_length: self.min_length_pr as f32,
            max_length: (diameter_pr + self.tau_pr) as f32,
            normal_tolerance: self.normal_tolerance as f32,
            second_order: self.second_order,
            max_degree,
            max_vicinity,
        };
        let interrupted = || context.interrupt.is_set();
        let is_alive = |id| context.alive.contains(id);
        Graph::new(&context.pairs.columns, context.pairs.normals.as_ref(), &test, is_alive, interrupted)
    }

    /// The seeds among `leader` and its alive neighbours.
    fn play(&self, context: &Context<'_>, graph: &Graph, leader: u32) -> Ranked {
        let (neighbors, weights) = graph.edges(leader);
        let mut others: Vec<(u32, u32)> = neighbors
            .iter()
            .zip(weights)
            .filter(|&(&j, _)| graph.is_alive(j))
            .map(|(&j, w)| (w.to_bits(), j))
            .collect();
        if others.len() > MAX_OTHERS {
            // Weights are not negative: their bits order them.
            others.select_nth_unstable_by_key(MAX_OTHERS, |&other| Reverse(other));
            others.truncate(MAX_OTHERS);
        }
        let mut players: Vec<u32> = others.into_iter().map(|(_, j)| j).chain([leader]).collect();
        players.sort_unstable();
        let interrupted = || context.interrupt.is_set();
        let population = replicator(&payoffs(graph, &players), self.n_gtm as usize, interrupted);
        let Some(population) = population else { return Ranked::default() };
        let t_gtm = if players.len() > FEW {
            otsu(&population, OTSU_BINS).unwrap_or(0.0)
        } else {
            FEW_SHARE * population.iter().copied().fold(0.0, f32::max)
        };
        // The leader is a seed whatever its share: barred with the others, it cannot lead to them again.
        let is_seed = |&(node, x): &(u32, f32)| x > t_gtm || node == leader;
        let seeds = players.into_iter().zip(population).filter(is_seed);
        Ranked::new(seeds.map(|(node, x)| (graph.id(node), x)).collect())
    }
}

/// Second-order payoffs of `players` with each other.
fn payoffs(graph: &Graph, players: &[u32]) -> Payoffs {
    const NOBODY: u8 = u8::MAX;
    const { assert!(MAX_OTHERS < NOBODY as usize) };
    let mut payoffs = Payoffs::zeros(players.len());
    let mut seats = vec![NOBODY; graph.len()];
    for (seat, &player) in (0..).zip(players) {
        seats[player as usize] = seat;
    }
    for (seat, &i) in players.iter().enumerate() {
        let (neighbors, weights) = graph.later_edges(i);
        for (&j, &w) in neighbors.iter().zip(weights) {
            // Whether a neighbour plays is anybody's guess, and a store costs less than a wrong guess: what is gained from
            // one that does not play is put down to the player itself, and then forgotten.
            let other = seats[j as usize];
            payoffs.set(seat, if other == NOBODY { seat } else { other as usize }, w);
        }
        payoffs.set(seat, seat, 0.0);
    }
    payoffs
}

impl SelectSeeds for LocalGtm {
    fn select_seeds(&self, context: &Context<'_>) -> Ranked {
        let graph = context.graph.get_or_init(|| self.build(context));
        let is_free = |node: u32| graph.is_alive(node) && !context.barred[graph.id(node) as usize];
        let enough = context.t_s as usize;
        let mut leaders = Leaders::new(graph, |node| is_free(node) && graph.futile(node).is_none());
        let mut num_futile = 0;
        for leader in &mut leaders {
            let seeds = self.play(context, graph, leader);
            if seeds.len() >= enough || context.interrupt.is_set() {
                return seeds;
            }
            // It gives way to the next, and would lose again as long as its neighbourhood stays the same. Without
            // this memory a scan's run played a hundred games a round (measured: 44,000 in 478 rounds).
            graph.set_futile(leader, seeds.len() as u32);
            num_futile += 1;
            if graph.is_sample() && num_futile == FIRST_FUTILE {
                return seeds;
            }
        }
        // None has enough: the one that comes nearest says by how much.
        let all = (0..graph.len() as u32).filter(|&node| is_free(node));
        let nearest = all.max_by_key(|&node| (graph.futile(node), leaders.key(node)));
        nearest.map_or_else(Ranked::default, |leader| self.play(context, graph, leader))
    }
}

/// The nodes that may lead, those with the most support first, ties by the lower correspondence. Each is looked for when
/// it is asked for: in most rounds the first or second will do.
struct Leaders<'a, F> {
    graph: &'a Graph,
    may_lead: F,
    last: Key,
}

/// Support and, of equals, the lower correspondence; then the node. Supports are not negative: their bits order them.
type Key = (u32, Reverse<u32>, u32);

impl<'a, F: Fn(u32) -> bool> Leaders<'a, F> {
    fn new(graph: &'a Graph, may_lead: F) -> Self {
        Self { graph, may_lead, last: (u32::MAX, Reverse(0), 0) }
    }

    fn key(&self, node: u32) -> Key {
        (self.graph.support(node).to_bits(), Reverse(self.graph.id(node)), node)
    }
}

impl<F: Fn(u32) -> bool> Iterator for Leaders<'_, F> {
    type Item = u32;

    fn next(&mut self) -> Option<u32> {
        let mut best: Key = (1, Reverse(u32::MAX), u32::MAX); // some support
        for (node, support) in (0_u32..).zip(self.graph.supports()) {
            // Few are better than all before them: the rest is seldom asked for.
            if (best.0..=self.last.0).contains(&support.to_bits()) {
                let key = self.key(node);
                if key > best && key < self.last && (self.may_lead)(node) {
                    best = key;
                }
            }
        }
        self.last = best;
        (best.2 != u32::MAX).then_some(best.2)
    }
}
