//! Which correspondences are joined: a test of all that are near each other, cell by cell.

use std::ops::Range;

use super::super::columns::Columns;
use super::super::grid::Grid;
use super::super::par;
use super::super::simd::simd;
use super::{EdgeTest, Edges, NONE, PairNormals};

/// Finds the edges of each correspondence. Places are positions in the order of the grid.
pub(super) struct Finder<'a> {
    /// In the order of the grid.
    pub(super) pairs: Columns,
    /// By correspondence.
    pub(super) normals: Option<&'a PairNormals>,
    pub(super) grid: &'a Grid,
    pub(super) test: &'a EdgeTest,
}

/// Rows of the graph one after the other.
#[derive(Default)]
struct Rows {
    lens: Vec<u32>,
    neighbors: Vec<u32>,
    weights: Vec<f32>,
}

impl Finder<'_> {
    /// The nodes, and the edges weighed by w_ij = 1 - (r / tau)^2.
    pub(super) fn find(&self, interrupted: &(impl Fn() -> bool + Sync)) -> (Vec<u32>, Edges) {
        let cells: Vec<_> = self.grid.neighborhoods(self.test.max_length).collect();
        let degrees = par::map(cells.len(), 4, |cell| self.estimated_degrees(&cells[cell]));
        let is_node = thinned(&degrees.concat(), self.test.max_degree);
        let thins = is_node.contains(&false);
        let upper = par::map(cells.len(), 4, |cell| {
            let (home, runs) = &cells[cell];
            let nodes = home.clone().filter(|&place| is_node[place]);
            let mut rows = Rows::default();
            if interrupted() {
                rows.lens = vec![0; nodes.count()];
            } else {
                // Only what comes later in the order: the graph is symmetric.
                let later = runs.iter().map(|run| run.start.max(home.start)..run.end.max(home.start));
                let vicinity = if thins {
                    Vicinity::new(&self.pairs, later.flatten().filter(|&place| is_node[place]))
                } else {
                    Vicinity::of_runs(&self.pairs, &later)
                };
                vicinity.push_rows(self, nodes, &mut rows);
            }
            rows
        });
        self.assemble(&upper, &is_node)
    }

    /// About how many neighbours each correspondence of a cell has; 0 where the vicinity is too small for it to matter.
    fn estimated_degrees(&self, (home, runs): &(Range<usize>, Vec<Range<usize>>)) -> Vec<f32> {
        /// So many of the vicinity are looked at: a degree is good to a fifth.
        const SAMPLE: usize = 128;
        let num: usize = runs.iter().map(Range::len).sum();
        if num <= 2_usize.saturating_mul(self.test.max_degree as usize) {
            return vec![0.0; home.len()];
        }
        let step = num as f64 / SAMPLE as f64;
        let mut chosen = (0..SAMPLE).map(|i| ((i as f64 + out_of_step(i)) * step) as usize).peekable();
        let all = runs.iter().cloned().flatten().enumerate();
        let some = all.filter(|&(at, _)| chosen.next_if_eq(&at).is_some()).map(|(_, place)| place);
        let mut vicinity = Vicinity::new(&self.pairs, some);
        let scale = step as f32;
        let degrees = home.clone().map(|place| {
            vicinity.join(self.pairs.pair(place), self.test, 0);
            let mut hits = 0_u32;
            vicinity.each_joined(0, |at| {
                hits += u32::from(self.normals_fit(place, vicinity.places[at] as usize));
            });
            hits as f32 * scale
        });
        degrees.collect()
    }

    /// Whether the normals at two places allow an edge.
    fn normals_fit(&self, place: usize, other: usize) -> bool {
        self.normals.is_none_or(|normals| {
            let [i, j] = [place, other].map(|place| self.grid.order()[place] as usize);
            normals.compatible((i, j), (place, other), &self.pairs, self.test.normal_tolerance)
        })
    }

    /// The nodes, and their rows one after the other, in which places become nodes.
    fn assemble(&self, rows: &[Rows], is_node: &[bool]) -> (Vec<u32>, Edges) {
        let ids = self.grid.order().iter().zip(is_node).filter(|&(_, &is_node)| is_node).map(|(&id, _)| id);
        let ids: Vec<u32> = ids.collect();
        let mut starts = vec![0];
        for &len in rows.iter().flat_map(|rows| &rows.lens) {
            starts.push(starts[starts.len() - 1] + len as usize);
        }
        let num = starts[starts.len() - 1];
        let (mut neighbors, mut weights) = (Vec::with_capacity(num), Vec::with_capacity(num));
        for rows in rows {
            neighbors.extend_from_slice(&rows.neighbors);
            weights.extend_from_slice(&rows.weights);
        }
        if ids.len() < is_node.len() {
            let nodes = is_node.iter().scan(0, |next, &is_node| {
                *next += u32::from(is_node);
                Some(*next - u32::from(is_node))
            });
            let nodes: Vec<u32> = nodes.collect();
            for place in &mut neighbors {
                *place = nodes[*place as usize];
            }
        }
        (ids, Edges { starts, neighbors, weights })
    }
}

/// What can be joined to the correspondences of one cell, copied together and filled up to whole vectors: the runs of
/// the grid are short, and the ends of so many loops would take longer than the loops.
struct Vicinity {
    places: Vec<u32>,
    /// p and q.
    coords: [Vec<f32>; 6],
    /// Whether there is an edge: 0 or 1.
    is_edge: Vec<u8>,
}

/// What a vicinity is filled up to a multiple of.
const LANES: usize = 64;

impl Vicinity {
    fn new(pairs: &Columns, places: impl Iterator<Item = usize>) -> Self {
        let places = places.map(|place| place as u32).collect();
        Self::filled(pairs, places, |places, axis, column| {
            column.extend(places.iter().map(|&place| axis[place as usize]));
        })
    }

    /// The same for whole runs, copied piece by piece.
    fn of_runs(pairs: &Columns, runs: &(impl Iterator<Item = Range<usize>> + Clone)) -> Self {
        let places = runs.clone().flat_map(|run| run.start as u32..run.end as u32).collect();
        Self::filled(pairs, places, |_, axis, column| {
            runs.clone().for_each(|run| column.extend_from_slice(&axis[run]));
        })
    }

    /// `copy(places, axis, column)` takes the values of the places.
    fn filled(pairs: &Columns, mut places: Vec<u32>, copy: impl Fn(&[u32], &[f32], &mut Vec<f32>)) -> Self {
        let len = places.len().next_multiple_of(LANES);
        let [px, py, pz] = &pairs.p;
        let [qx, qy, qz] = &pairs.q;
        let coords = [px, py, pz, qx, qy, qz].map(|axis| {
            let mut column = Vec::with_capacity(len);
            copy(&places, axis, &mut column);
            // Infinitely far from everything.
            column.resize(len, f32::INFINITY);
            column
        });
        places.resize(len, NONE);
        Self { places, coords, is_edge: vec![0; len] }
    }

    /// Sets which of the vicinity, from position `first` on, are joined to (p, q).
    fn join(&mut self, (p, q): ([f32; 3], [f32; 3]), test: &EdgeTest, first: usize) {
        let (coords, is_edge) =
            (self.coords.each_ref().map(|axis| &axis[first..]), &mut self.is_edge[first..]);
        simd(
            #[inline(always)]
            move || join(coords, is_edge, p, q, test),
        );
    }

    /// Tells `found` the positions that the last [`Self::join`] has found, from `first` on (a multiple of `LANES`).
    #[inline]
    fn each_joined(&self, first: usize, mut found: impl FnMut(usize)) {
        let blocks = self.is_edge[first..].as_chunks::<LANES>().0;
        for (block, flags) in blocks.iter().enumerate() {
            let mut bits = bits(flags);
            while bits != 0 {
                found(first + LANES * block + bits.trailing_zeros() as usize);
                bits &= bits - 1;
            }
        }
    }

    /// Adds the rows of `nodes`: the neighbours that come later in the order.
    fn push_rows(mut self, finder: &Finder<'_>, nodes: impl Iterator<Item = usize>, rows: &mut Rows) {
        let inv_tau_sq = 1.0 / (finder.test.tau * finder.test.tau);
        for place in nodes {
            let (p, q) = finder.pairs.pair(place);
            let before = rows.neighbors.len();
            let first = self.places.partition_point(|&other| other as usize <= place) / LANES * LANES;
            self.join((p, q), finder.test, first);
            self.each_joined(first, |at| {
                let other = self.places[at] as usize;
                if other > place && finder.normals_fit(place, other) {
                    let [a, b] = [(p, 0), (q, 3)].map(|(x, axis)| {
                        let [dx, dy, dz] = [0, 1, 2].map(|k| self.coords[axis + k][at] - x[k]);
                        (dx * dx + dy * dy + dz * dz).sqrt()
                    });
                    rows.neighbors.push(other as u32);
                    // Rounding may put an edge at the very bound.
                    rows.weights.push((1.0 - (a - b) * (a - b) * inv_tau_sq).max(f32::MIN_POSITIVE));
                }
            });
            rows.lens.push((rows.neighbors.len() - before) as u32);
        }
    }
}

/// Tells of each pair of `coords` whether there is an edge to (p, q). Without a root: with A = a^2, B = b^2 the test
/// |a - b| < tau is A + B - tau^2 < 2ab, that is: the left side is negative, or its square less than 4AB.
#[inline(always)]
#[allow(clippy::inline_always, clippy::needless_bitwise_bool)] // a loop that must vectorise, so without branches
fn join(coords: [&[f32]; 6], is_edge: &mut [u8], p: [f32; 3], q: [f32; 3], test: &EdgeTest) {
    let n = is_edge.len();
    let [px, py, pz, qx, qy, qz] = coords.map(|axis| &axis[..n]);
    let [tau_sq, least_sq, most_sq] = [test.tau, test.min_length, test.max_length].map(|x| x * x);
    for i in 0..n {
        let (dx, dy, dz) = (px[i] - p[0], py[i] - p[1], pz[i] - p[2]);
        let a_sq = dx * dx + dy * dy + dz * dz;
        let (dx, dy, dz) = (qx[i] - q[0], qy[i] - q[1], qz[i] - q[2]);
        let b_sq = dx * dx + dy * dy + dz * dz;
        let left = a_sq + b_sq - tau_sq;
        let agrees = (left < 0.0) | (left * left < 4.0 * a_sq * b_sq);
        is_edge[i] = u8::from(agrees & (a_sq > least_sq) & (b_sq > least_sq) & (b_sq < most_sq));
    }
}

/// One bit for each flag of 0 or 1.
fn bits(flags: &[u8; LANES]) -> u64 {
    // The product moves the low bits of eight bytes side by side into the highest byte.
    let eight = |flags: &[u8; 8]| u64::from_le_bytes(*flags).wrapping_mul(0x0102_0408_1020_4080) >> 56;
    flags.as_chunks::<8>().0.iter().enumerate().fold(0, |bits, (k, flags)| bits | eight(flags) << (8 * k))
}

/// Which places become nodes: of those with too many neighbours (as estimated) about as many as leave each
/// `max_degree`, evenly spread over the places, which are in the order of the grid.
fn thinned(degrees: &[f32], max_degree: u32) -> Vec<bool> {
    let most = max_degree as f32;
    let mut num_too_many = 0;
    let is_node = degrees.iter().map(|&degree| {
        if degree <= most {
            return true;
        }
        num_too_many += 1;
        out_of_step(num_too_many) < f64::from(most / degree)
    });
    is_node.collect()
}

/// Evenly spread over 0..1, and in step with no period of the list: the fractional part of i times the golden ratio. A
/// matcher that gives each point two candidates lists right and wrong ones in turn, and every second of them would all
/// be wrong.
fn out_of_step(i: usize) -> f64 {
    (i as f64 * 0.618_033_988_749_894_9).fract()
}
