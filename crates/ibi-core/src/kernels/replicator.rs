//! Discrete replicator dynamics (Eq. 2; Rodola et al. 2013).

use super::columns::{LANES, dot};
use super::par;
use super::simd::simd;

/// Shares below this are extinct. Left to decay, they would reach the subnormal floats, which are slow; with
/// payoffs of at least 1e-14 no product does.
const EXTINCT: f32 = 1e-20;

/// What n players gain from each other: a symmetric matrix in rows of whole vectors.
#[derive(Debug, Clone)]
pub struct Payoffs {
    n: usize,
    stride: usize,
    values: Vec<f32>,
}

impl Payoffs {
    /// n players that gain nothing.
    #[must_use]
    pub fn zeros(n: usize) -> Self {
        let stride = n.max(1).next_multiple_of(LANES); // rows have a length even where there are none
        Self { n, stride, values: vec![0.0; n * stride] }
    }

    /// The payoffs in `values`, row by row, n each.
    #[must_use]
    pub fn from_rows(n: usize, values: &[f32]) -> Self {
        let mut payoffs = Self::zeros(n);
        for (row, values) in
            payoffs.values.chunks_exact_mut(payoffs.stride).zip(values.chunks_exact(n.max(1)))
        {
            row[..n].copy_from_slice(values);
        }
        payoffs
    }

    /// Number of players.
    #[must_use]
    pub fn len(&self) -> usize {
        self.n
    }

    /// Whether there is no player.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.n == 0
    }

    /// What player i gains from each.
    #[must_use]
    pub fn row(&self, i: usize) -> &[f32] {
        &self.values[i * self.stride..][..self.n]
    }

    /// The same, and the zeros after it that fill the last vector.
    pub(crate) fn padded_row(&self, i: usize) -> &[f32] {
        &self.values[i * self.stride..][..self.stride]
    }

    /// Sets what two players gain from each other.
    #[inline]
    pub(crate) fn set(&mut self, i: usize, j: usize, value: f32) {
        self.values[i * self.stride + j] = value;
        self.values[j * self.stride + i] = value;
    }

    /// Sets the rows to what `fill(i, row)` makes of them, in parallel.
    pub(crate) fn fill(&mut self, grain: usize, fill: impl Fn(usize, &mut [f32]) + Sync + Send) {
        let n = self.n;
        par::for_rows(&mut self.values, self.stride, grain, |i, row| fill(i, &mut row[..n]));
    }
}

/// The population after exactly `steps` synchronous steps x_i <- x_i (Pi x)_i / x^T Pi x from the uniform
/// population 1/n. `None` once x^T Pi x is 0: nobody supports anybody.
///
/// `interrupted` is asked before every step; the population as it is then comes back.
///
/// # Complexity
/// O(steps n^2).
pub fn replicator(payoffs: &Payoffs, steps: usize, interrupted: impl Fn() -> bool) -> Option<Vec<f32>> {
    let Payoffs { n, stride, .. } = *payoffs;
    let mut x = vec![1.0 / n as f32; n];
    x.resize(stride, 0.0);
    for _ in 0..steps {
        if interrupted() {
            break;
        }
        let fitness = if n <= FEW { fitness_of_few(payoffs, &x) } else { fitness(payoffs, &x) };
        if !step(&mut x, &fitness) {
            return None;
        }
    }
    x.truncate(n);
    Some(x)
}

/// One step of `x`; false if its mean fitness is 0. In whole vectors, as both are.
fn step(x: &mut [f32], fitness: &[f32]) -> bool {
    let (x, fitness) = (x.as_chunks_mut::<LANES>().0, fitness.as_chunks::<LANES>().0);
    simd(
        #[inline(always)]
        move || {
            let mut sums = [0.0; LANES];
            for (x, fitness) in x.iter().zip(fitness) {
                for k in 0..LANES {
                    sums[k] += f64::from(x[k]) * f64::from(fitness[k]);
                }
            }
            let mean: f64 = sums.iter().sum();
            if mean <= 0.0 {
                return false;
            }
            for (x, fitness) in x.iter_mut().zip(fitness) {
                for k in 0..LANES {
                    let next = (f64::from(x[k]) * f64::from(fitness[k]) / mean) as f32;
                    x[k] = if next < EXTINCT { 0.0 } else { next };
                }
            }
            true
        },
    )
}

/// Pi x, row by row: large matrices come from memory, in its order.
fn fitness(Payoffs { n, stride, values }: &Payoffs, x: &[f32]) -> Vec<f32> {
    /// Rows that one thread takes at a time.
    const GRAIN: usize = 256;
    let (n, stride) = (*n, *stride);
    let chunks = par::chunks(n, GRAIN, |rows| {
        let rows = &values[rows.start * stride..rows.end * stride];
        simd(
            #[inline(always)]
            move || rows.chunks_exact(stride).map(|row| dot(row, x)).collect::<Vec<f32>>(),
        )
    });
    let mut fitness = chunks.concat();
    fitness.resize(stride, 0.0);
    fitness
}

/// Players of whom a matrix stays in the cache.
const FEW: usize = 128;

/// The same for few, as x^T Pi, since Pi is symmetric: a sum of rows needs no sum over lanes.
fn fitness_of_few(Payoffs { n, stride, values }: &Payoffs, x: &[f32]) -> Vec<f32> {
    let (n, stride) = (*n, *stride);
    let mut fitness = vec![0.0; stride];
    let blocks = fitness.as_chunks_mut::<LANES>().0;
    simd(
        #[inline(always)]
        move || {
            for (block, sums) in blocks.iter_mut().enumerate() {
                let mut lanes = [0.0; LANES];
                for (row, &x) in values.chunks_exact(stride).zip(&x[..n]) {
                    let payoffs = row.as_chunks::<LANES>().0[block];
                    for k in 0..LANES {
                        lanes[k] += x * payoffs[k];
                    }
                }
                *sums = lanes;
            }
        },
    );
    fitness
}
