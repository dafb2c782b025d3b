//! Maximal cliques of a small graph (Bron & Kerbosch 1973, with the pivot of Tomita et al. 2006 and the outer order of
//! Eppstein, Löffler & Strash 2010), and of those that hold a node the heaviest.
//!
//! There may be 3^(n/3) of them, so the search is bounded, in cliques and in steps. Both are shared out over the outer
//! nodes, the densest part of the graph first: a search that is cut off has been everywhere.

use super::dense_graph::{DenseGraph, members};

/// Bounds of a search.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Maximal cliques, of three nodes or more.
    pub max_cliques: usize,
    /// Steps: sets of candidates looked at.
    pub max_steps: usize,
}

/// What a search for cliques came to.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Cliques {
    /// For each node the maximal clique of three nodes or more that holds it and has the largest sum of weights, each
    /// clique once: largest sum first, ties by their nodes. The nodes of a clique are ascending.
    pub heaviest: Vec<Vec<u32>>,
    /// Maximal cliques that were seen.
    pub num_seen: usize,
    /// Whether one of the limits cut the search off: there may be heavier cliques.
    pub capped: bool,
}

/// For each node the heaviest maximal clique that holds it. `interrupted` is asked every 256 steps.
///
/// # Complexity
/// O(n^2) time for each step; memory n^2 / 4 bytes, and as much for the search.
pub fn heaviest_cliques(graph: &DenseGraph, limits: Limits, interrupted: impl Fn() -> bool) -> Cliques {
    let n = graph.len();
    let words = n.div_ceil(64);
    let mut search = Search {
        graph,
        interrupted,
        clique: Vec::new(),
        best: vec![0.0; n],
        holders: vec![0; n * words],
        steps: 0,
        num_seen: 0,
        until: limits,
        capped: false,
        stopped: false,
    };
    let (mut candidates, mut excluded) = (vec![0; words], vec![0; words]);
    let order = degeneracy_order(graph);
    for &v in &order {
        insert(&mut excluded, v);
    }
    // From the last of the order: each begins where the nodes after it are candidates, those before it excluded.
    for (place, &v) in order.iter().enumerate().rev() {
        remove(&mut excluded, v);
        let left = place + 1;
        search.until = Limits {
            max_cliques: search.num_seen + (limits.max_cliques - search.num_seen).div_ceil(left),
            max_steps: search.steps + (limits.max_steps - search.steps).div_ceil(left),
        };
        search.clique.push(v);
        let neighbors = graph.neighbors(v);
        search.expand(both(&candidates, neighbors), both(&excluded, neighbors), 0.0);
        search.clique.pop();
        insert(&mut candidates, v);
        if search.stopped {
            break;
        }
    }
    search.into_cliques()
}

struct Search<'a, F> {
    graph: &'a DenseGraph,
    interrupted: F,
    clique: Vec<u32>,
    /// For each node the weight of the heaviest clique that holds it, and its members.
    best: Vec<f64>,
    holders: Vec<u64>,
    steps: usize,
    num_seen: usize,
    until: Limits,
    capped: bool,
    stopped: bool,
}

impl<F: Fn() -> bool> Search<'_, F> {
    /// All maximal cliques made of `self.clique`, of the given weight, and of some of `candidates`, all of which are
    /// its neighbours; none of `excluded` may be a neighbour of the whole.
    fn expand(&mut self, mut candidates: Vec<u64>, mut excluded: Vec<u64>, mut weight: f64) {
        if self.steps >= self.until.max_steps || self.num_seen >= self.until.max_cliques {
            self.capped = true;
            return;
        }
        self.steps += 1;
        if self.steps.is_multiple_of(256) && (self.interrupted)() {
            self.stopped = true;
        }
        let begun_with = self.clique.len();
        let all = count(&candidates);
        // Who is joined to all other candidates is in every clique to come. Else a good pivot is joined to many: a clique
        // without any of the others could be extended by the pivot.
        let mut pivot: Option<(u32, u32)> = None;
        let mut rest = candidates.clone();
        for u in members(&candidates) {
            let joined = count_both(&candidates, self.graph.neighbors(u));
            if joined + 1 == all {
                weight += self.weight_to(u);
                self.clique.push(u);
                remove(&mut rest, u);
            } else if pivot.is_none_or(|(most, _)| joined > most) {
                pivot = Some((joined, u));
            }
        }
        for &u in &self.clique[begun_with..] {
            excluded = both(&excluded, self.graph.neighbors(u));
        }
        candidates = rest;
        let left = count(&candidates);
        let mut most = pivot.map(|(joined, u)| (joined - (all - left), u));
        let mut is_hopeless = false;
        for u in members(&excluded) {
            let joined = count_both(&candidates, self.graph.neighbors(u));
            // It could extend every clique to come: none is maximal.
            is_hopeless |= joined == left;
            if most.is_none_or(|(most, _)| joined > most) {
                most = Some((joined, u));
            }
        }
        match most {
            _ if is_hopeless => {}
            Some((_, pivot)) if left > 0 => {
                let apart: Vec<u64> =
                    candidates.iter().zip(self.graph.neighbors(pivot)).map(|(c, n)| c & !n).collect();
                for v in members(&apart) {
                    if self.stopped {
                        break;
                    }
                    let added = self.weight_to(v);
                    let neighbors = self.graph.neighbors(v);
                    self.clique.push(v);
                    self.expand(both(&candidates, neighbors), both(&excluded, neighbors), weight + added);
                    self.clique.pop();
                    remove(&mut candidates, v);
                    insert(&mut excluded, v);
                }
            }
            _ => self.see(weight),
        }
        self.clique.truncate(begun_with);
    }

    /// The sum of the weights from the clique to a further node.
    fn weight_to(&self, v: u32) -> f64 {
        self.clique.iter().map(|&u| f64::from(self.graph.weight(u, v))).sum()
    }

    fn see(&mut self, weight: f64) {
        if self.clique.len() < 3 {
            return;
        }
        self.num_seen += 1;
        let words = self.graph.len().div_ceil(64);
        let mut bits = vec![0; words];
        for &u in &self.clique {
            insert(&mut bits, u);
        }
        for &u in &self.clique {
            if weight > self.best[u as usize] {
                self.best[u as usize] = weight;
                self.holders[u as usize * words..][..words].copy_from_slice(&bits);
            }
        }
    }

    fn into_cliques(self) -> Cliques {
        let words = self.graph.len().div_ceil(64);
        let holders = self.holders.chunks_exact(words.max(1)).zip(&self.best);
        let held = holders.filter(|&(_, &weight)| weight > 0.0);
        let mut heaviest: Vec<(f64, Vec<u32>)> =
            held.map(|(bits, &weight)| (weight, members(bits).collect())).collect();
        heaviest.sort_by(|a, b| b.0.total_cmp(&a.0).then_with(|| a.1.cmp(&b.1)));
        heaviest.dedup();
        Cliques {
            heaviest: heaviest.into_iter().map(|(_, clique)| clique).collect(),
            num_seen: self.num_seen,
            capped: self.capped,
        }
    }
}

/// The nodes in the order in which one of least degree, the lower one of equals, is taken out after the other.
fn degeneracy_order(graph: &DenseGraph) -> Vec<u32> {
    let mut degrees: Vec<u32> = (0..graph.len() as u32).map(|v| count(graph.neighbors(v))).collect();
    let mut left: Vec<u32> = (0..graph.len() as u32).collect();
    let mut order = Vec::with_capacity(left.len());
    while let Some((at, &v)) = left.iter().enumerate().min_by_key(|&(_, &v)| degrees[v as usize]) {
        left.remove(at);
        order.push(v);
        for u in members(graph.neighbors(v)) {
            degrees[u as usize] = degrees[u as usize].saturating_sub(1);
        }
    }
    order
}

fn both(a: &[u64], b: &[u64]) -> Vec<u64> {
    a.iter().zip(b).map(|(a, b)| a & b).collect()
}

fn count(bits: &[u64]) -> u32 {
    bits.iter().map(|word| word.count_ones()).sum()
}

fn count_both(a: &[u64], b: &[u64]) -> u32 {
    a.iter().zip(b).map(|(a, b)| (a & b).count_ones()).sum()
}

fn insert(bits: &mut [u64], v: u32) {
    bits[v as usize / 64] |= 1 << (v % 64);
}

fn remove(bits: &mut [u64], v: u32) {
    bits[v as usize / 64] &= !(1 << (v % 64));
}
