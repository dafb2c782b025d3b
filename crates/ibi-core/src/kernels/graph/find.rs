//! Which correspondences are joined: a test of all that are near each other, cell by cell.

use std::ops::Range;

use super::super::columns::Columns;
use super::super::grid::Grid;
use super::super::par;
use super::super::simd::simd;
use super::{EdgeTest, Edges, NONE, PairNormals};

/// Correspondences in the order of a grid over their target points, and what lies around each cell. Places are
/// positions in this order.
pub(super) struct Places {
    /// The correspondence at each place.
    ids: Vec<u32>,
    pairs: Columns,
    /// For each cell that holds any: its places, and, ascending, those that may be joined to them.
    cells: Vec<(Range<usize>, Vec<Range<usize>>)>,
}

impl Places {
    /// All of `pairs`. `max_length` is that of an edge.
    pub(super) fn new(pairs: &Columns, max_length: f32, cell: f32) -> Self {
        let grid = Grid::new(&pairs.q, cell);
        let cells = grid.neighborhoods(max_length).collect();
        Self { pairs: pairs.gather(grid.order()), ids: grid.order().to_vec(), cells }
    }

    /// Number of places.
    pub(super) fn len(&self) -> usize {
        self.ids.len()
    }

    /// Those of the correspondences that are alive.
    pub(super) fn filtered(self, is_alive: impl Fn(u32) -> bool) -> Self {
        let is_kept: Vec<bool> = self.ids.iter().map(|&id| is_alive(id)).collect();
        self.kept(&is_kept)
    }

    /// So many of them that about `max_vicinity` lie around each.
    pub(super) fn sampled(self, max_vicinity: u32) -> Self {
        let vicinities = self.cells.iter().flat_map(|(home, runs)| {
            let num: usize = runs.iter().map(Range::len).sum();
            home.clone().map(move |_| num as f32)
        });
        let is_kept = thinned(vicinities, max_vicinity);
        self.kept(&is_kept)
    }

    /// Those of `is_kept`, moved together.
    fn kept(self, is_kept: &[bool]) -> Self {
        if !is_kept.contains(&false) {
            return self;
        }
        // How many are kept before each place.
        let mut before = Vec::with_capacity(is_kept.len() + 1);
        before.push(0);
        before.extend(is_kept.iter().scan(0, |num, &is_kept| {
            *num += usize::from(is_kept);
            Some(*num)
        }));
        let moved = |run: &Range<usize>| before[run.start]..before[run.end];
        let cells = self.cells.iter().filter_map(|(home, runs)| {
            let home = moved(home);
            (!home.is_empty()).then(|| (home, runs.iter().map(moved).filter(|run| !run.is_empty()).collect()))
        });
        let cells = cells.collect();
        let kept: Vec<u32> = (0..self.ids.len() as u32).filter(|&place| is_kept[place as usize]).collect();
        let ids = kept.iter().map(|&place| self.ids[place as usize]).collect();
        Self { ids, pairs: self.pairs.gather(&kept), cells }
    }
}

/// Finds the edges of each correspondence.
pub(super) struct Finder<'a> {
    pub(super) places: Places,
    /// By correspondence.
    pub(super) normals: Option<&'a PairNormals>,
    pub(super) test: &'a EdgeTest,
}

/// Rows of the graph one after the other.
#[derive(Default)]
struct Rows {
    lens: Vec<u32>,
    neighbors: Vec<u32>,
    weights: Vec<f32>,
}

/// Correspondences of a cell that are looked at in one go: a crowded cell is work for several threads.
const PART: usize = 512;

/// Pairs of correspondences that are looked at before the clock is: about a millisecond of work.
const PAIRS_AT_A_TIME: usize = 1 << 21;

/// Where more correspondences than this are left around one, joined or not, about so many of them become nodes. Else so many
/// copies of one correspondence, which have no edge, would all be held against each other. Of the scenes of the benchmarks
/// the one of 100,000 correspondences and a million points leaves the most: 12,080.
pub const MAX_CROWD: u32 = 1 << 15;

impl Finder<'_> {
    /// The correspondences of the nodes, and the edges weighed by w_ij = 1 - (r / tau)^2.
    pub(super) fn find(mut self, interrupted: &(impl Fn() -> bool + Sync)) -> (Vec<u32>, Edges) {
        let degrees = self.map_cells(|home, runs| {
            if interrupted() { vec![0.0; home.len()] } else { self.estimated_degrees(home, runs) }
        });
        self.places = self.places.kept(&thinned(degrees.concat(), self.test.max_degree));
        self.places = self.places.sampled(MAX_CROWD);
        let upper = self.map_cells(|home, runs| {
            let mut rows = Rows::default();
            // Only what comes later in the order: the graph is symmetric.
            let later = runs.iter().map(|run| run.start.max(home.start)..run.end.max(home.start));
            if interrupted() {
                rows.lens = vec![0; home.len()];
            } else {
                Vicinity::of_runs(&self.places.pairs, &later).push_rows(&self, home, &mut rows, interrupted);
            }
            rows
        });
        (self.places.ids, assembled(&upper))
    }

    /// What `of` makes of the correspondences of each cell and what lies around them; of crowded cells part by part.
    fn map_cells<T: Send>(&self, of: impl Fn(Range<usize>, &[Range<usize>]) -> T + Sync) -> Vec<T> {
        let cells = &self.places.cells;
        if cells.iter().all(|(home, _)| home.len() <= PART) {
            return par::map(cells.len(), 4, |cell| of(cells[cell].0.clone(), &cells[cell].1));
        }
        let parts: Vec<(Range<usize>, &[Range<usize>])> = cells
            .iter()
            .flat_map(|(home, runs)| {
                let starts = home.clone().step_by(PART);
                starts.map(move |start| (start..home.end.min(start + PART), runs.as_slice()))
            })
            .collect();
        par::map(parts.len(), 4, |part| of(parts[part].0.clone(), parts[part].1))
    }

    /// About how many neighbours each correspondence of a cell has; 0 where the vicinity is too small for it to matter.
    fn estimated_degrees(&self, home: Range<usize>, runs: &[Range<usize>]) -> Vec<f32> {
        /// So many of the vicinity are looked at: a degree is good to a fifth. In a crowd, of which few may be joined to one,
        /// more are.
        const SAMPLE: usize = 128;
        const SAMPLE_OF_CROWD: usize = 1024;
        let num: usize = runs.iter().map(Range::len).sum();
        let sample = if num > MAX_CROWD as usize { SAMPLE_OF_CROWD } else { SAMPLE };
        if num <= 2_usize.saturating_mul(self.test.max_degree as usize) {
            return vec![0.0; home.len()];
        }
        let step = (num as f64 / sample as f64).max(1.0);
        let mut chosen =
            (0..sample.min(num)).map(|i| ((i as f64 + out_of_step(i)) * step) as usize).peekable();
        let (mut some, mut start) = (Vec::with_capacity(sample), 0);
        for run in runs {
            while let Some(at) = chosen.next_if(|&at| at < start + run.len()) {
                some.push((run.start + at - start) as u32);
            }
            start += run.len();
        }
        let mut vicinity = Vicinity::new(&self.places.pairs, some);
        let scale = step as f32;
        let degrees = home.map(|place| {
            vicinity.join(self.places.pairs.pair(place), self.test, 0);
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
            let Places { ids, pairs, .. } = &self.places;
            let [i, j] = [place, other].map(|place| ids[place] as usize);
            normals.compatible((i, j), (place, other), pairs, self.test.normal_tolerance)
        })
    }
}

/// Rows of all cells, one after the other.
fn assembled(rows: &[Rows]) -> Edges {
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
    Edges { starts, neighbors, weights }
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
    fn new(pairs: &Columns, places: Vec<u32>) -> Self {
        Self::filled(pairs, places, |places, axis, column| {
            column.extend(places.iter().map(|&place| axis[place as usize]));
        })
    }

    /// The same for whole runs, copied piece by piece.
    fn of_runs(pairs: &Columns, runs: &(impl Iterator<Item = Range<usize>> + Clone)) -> Self {
        let mut places = Vec::new();
        runs.clone().for_each(|run| places.extend(run.start as u32..run.end as u32));
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

    /// Adds the rows of the places `home`, with which this vicinity begins: the neighbours that come later in the order.
    fn push_rows(
        mut self,
        finder: &Finder<'_>,
        home: Range<usize>,
        rows: &mut Rows,
        interrupted: &impl Fn() -> bool,
    ) {
        let at_a_time = PAIRS_AT_A_TIME.div_ceil(self.places.len().max(1));
        let inv_tau_sq = 1.0 / (finder.test.tau * finder.test.tau);
        let mut found = Vec::new();
        for (at, place) in home.clone().enumerate() {
            if at % at_a_time == at_a_time - 1 && interrupted() {
                rows.lens.resize(rows.lens.len() + home.end - place, 0);
                return;
            }
            let (p, q) = finder.places.pairs.pair(place);
            // Whole vectors, so that a few before it are looked at too.
            let first = (at + 1) / LANES * LANES;
            self.join((p, q), finder.test, first);
            found.clear();
            self.each_joined(first, |other| {
                if other > at && finder.normals_fit(place, self.places[other] as usize) {
                    found.push(other);
                }
            });
            // By itself, as roots take long and need not wait for each other.
            rows.weights.extend(found.iter().map(|&at| {
                let [a, b] = [(p, 0), (q, 3)].map(|(x, axis)| {
                    let [dx, dy, dz] = [0, 1, 2].map(|k| self.coords[axis + k][at] - x[k]);
                    (dx * dx + dy * dy + dz * dz).sqrt()
                });
                // Rounding may put an edge at the very bound.
                (1.0 - (a - b) * (a - b) * inv_tau_sq).max(f32::MIN_POSITIVE)
            }));
            rows.neighbors.extend(found.iter().map(|&at| self.places[at]));
            rows.lens.push(found.len() as u32);
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

/// Which places are kept where `crowds` tells how many neighbours each has: of those with more than `most` about so many
/// that each is left with `most`, evenly spread over the places, which are in the order of the grid.
fn thinned(crowds: impl IntoIterator<Item = f32>, most: u32) -> Vec<bool> {
    let most = most as f32;
    let mut num_too_many = 0;
    let is_kept = crowds.into_iter().map(|crowd| {
        if crowd <= most {
            return true;
        }
        num_too_many += 1;
        out_of_step(num_too_many) < f64::from(most / crowd)
    });
    is_kept.collect()
}

/// Evenly spread over 0..1, and in step with no period of the list: the fractional part of i times the golden ratio. A
/// matcher that gives each point two candidates lists right and wrong ones in turn, and every second of them would all
/// be wrong.
fn out_of_step(i: usize) -> f64 {
    (i as f64 * 0.618_033_988_749_894_9).fract()
}
