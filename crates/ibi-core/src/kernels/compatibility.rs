//! How well two correspondences agree with one rigid motion: payoff (Eq. 3-5) and votes (Eq. 6).
//!
//! With a = |p_i - p_j| and b = |q_i - q_j| the rigidity is r = |a - b| (Eq. 4). Every measure here is 0 when a
//! or b is 0: correspondences that share a source or a target point never support each other, nor one itself.

use super::columns::Columns;
use super::par;
use super::replicator::Payoffs;

/// Pairs of rows below which a matrix row or a vote is not worth a thread of its own.
const GRAIN: usize = 32;

/// The payoff of two correspondences in the game of the seed selection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(rename_all = "snake_case"))]
pub enum Payoff {
    /// exp(-r^2 / `delta_r`^2), the form of Eq. 5.
    // PAPER: Eq. 3 prints r itself, which rewards inconsistency.
    #[default]
    Gaussian,
    /// min(a/b, b/a), the form of the game-theoretic matching literature (Rodola et al. 2013).
    Ratio,
}

/// The dense payoffs, symmetric with a zero diagonal. `delta_r` in the unit of the columns.
///
/// # Complexity
/// O(n^2) time, 4 n^2 bytes.
#[must_use]
pub fn payoff_matrix(
    pairs: &Columns,
    payoff: Payoff,
    delta_r: f64,
    interrupted: impl Fn() -> bool + Sync,
) -> Payoffs {
    let inv = 1.0 / delta_r as f32;
    let mut matrix = Payoffs::zeros(pairs.len());
    matrix.fill(GRAIN, |i, row| {
        if interrupted() {
            return;
        }
        let (p, q) = pairs.pair(i);
        match payoff {
            Payoff::Gaussian => pairs.map_into(row, |pj, qj| gaussian(distance(p, pj), distance(q, qj), inv)),
            Payoff::Ratio => pairs.map_into(row, |pj, qj| ratio(distance(p, pj), distance(q, qj))),
        }
    });
    matrix
}

/// Votes of `voters` for each of `candidates`: s_i = sum over voters j of exp(-r_ij^2 / `delta_r`^2) (Eq. 6).
/// `delta_r` in the unit of the columns.
///
/// # Complexity
/// O(candidates x voters).
#[must_use]
pub fn votes(candidates: &Columns, voters: &Columns, delta_r: f64) -> Vec<f32> {
    votes_until(candidates, voters, delta_r, || false)
}

/// [`votes`] that asks `interrupted` from time to time; then they are too few.
pub(crate) fn votes_until(
    candidates: &Columns,
    voters: &Columns,
    delta_r: f64,
    interrupted: impl Fn() -> bool + Sync + Send,
) -> Vec<f32> {
    let inv = 1.0 / delta_r as f32;
    let grain = VOTE_GRAIN.max(VOTES_PER_THREAD / voters.len().max(1));
    let chunks = par::chunks(candidates.len(), grain, |run| {
        let (mut votes, mut of_one) = (vec![0.0; run.len()], vec![0.0; run.len()]);
        for j in 0..voters.len() {
            if j % VOTERS_AT_A_TIME == 0 && interrupted() {
                break;
            }
            let (p, q) = voters.pair(j);
            candidates.map_run_into(run.clone(), &mut of_one, |pi, qi| {
                gaussian(distance(p, pi), distance(q, qi), inv)
            });
            for (vote, one) in votes.iter_mut().zip(&of_one) {
                *vote += one;
            }
        }
        votes
    });
    chunks.concat()
}

/// Rigidities of more than this bring no vote, nor any gaussian payoff.
pub(crate) fn vote_reach(delta_r: f64) -> f32 {
    // A little more, for rounding.
    1.001 * NEGLIGIBLE.sqrt() * delta_r as f32
}

/// Candidates that one thread takes at a time at least: more fit into no innermost cache.
const VOTE_GRAIN: usize = 1024;

/// Voters that have their say before the clock is looked at: about a millisecond of work.
const VOTERS_AT_A_TIME: usize = 512;

/// Votes that are worth a thread.
const VOTES_PER_THREAD: usize = 1 << 16;

#[inline(always)]
#[allow(clippy::inline_always)] // this and those below are the bodies of the loops above
fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    let d = [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt()
}

#[inline(always)]
#[allow(clippy::inline_always)]
fn gaussian(a: f32, b: f32, inv_delta_r: f32) -> f32 {
    let u = (a - b) * inv_delta_r;
    let value = exp_neg(u * u);
    if a > 0.0 && b > 0.0 { value } else { 0.0 }
}

#[inline(always)]
#[allow(clippy::inline_always)]
fn ratio(a: f32, b: f32) -> f32 {
    let value = if a < b { a / b } else { b / a };
    if a > 0.0 && b > 0.0 { value } else { 0.0 }
}

/// Exponents beyond which a payoff or a vote is 0. exp(-32) = 1e-14 is lost in any `f32` sum it could enter, and
/// would make subnormal numbers in the replicator, each of which costs a hundred cycles (measured: with a cut at
/// 87 the mat-vecs of a run took four times as long).
const NEGLIGIBLE: f32 = 32.0;

/// exp(-x) for x >= 0, to 3e-7 relative; 0 where x > [`NEGLIGIBLE`].
///
/// The library's `expf` is a call per element and keeps the loops above from vectorising. This is the
/// textbook reduction exp(-x) = 2^k e^f with |f| <= ln(2) / 2, and the Taylor polynomial of e^f; ln(2) comes in
/// two parts, the first of few bits, so that k ln(2) is exact (Cody & Waite 1980).
#[inline(always)]
#[allow(clippy::inline_always)]
fn exp_neg(x: f32) -> f32 {
    // Adding 1.5 * 2^23 rounds to an integer and leaves it in the low bits of the mantissa.
    const ROUND: f32 = 12_582_912.0;
    const LN_2_HIGH: f32 = 355.0 / 512.0;
    const LN_2_LOW: f32 = -2.121_944_4e-4;
    let y = -x.min(NEGLIGIBLE);
    let shifted = y * std::f32::consts::LOG2_E + ROUND;
    let k = shifted - ROUND;
    let f = (y - k * LN_2_HIGH) - k * LN_2_LOW;
    let poly = 1.0
        + f * (1.0 + f * (0.5 + f * (1.0 / 6.0 + f * (1.0 / 24.0 + f * (1.0 / 120.0 + f * (1.0 / 720.0))))));
    let power = f32::from_bits(shifted.to_bits().wrapping_add(127) << 23);
    if x > NEGLIGIBLE { 0.0 } else { poly * power }
}

#[cfg(test)]
mod tests {
    use super::{NEGLIGIBLE, exp_neg};

    // Here and not in tests/: the function is private, and a matrix shows its error only on distances.
    #[test]
    fn exp_neg_is_accurate_and_0_beyond_the_cut() {
        let steps = 1_000_000;
        for x in (0..=steps).map(|i| i as f32 * (NEGLIGIBLE / steps as f32)) {
            let (value, exact) = (f64::from(exp_neg(x)), (-f64::from(x)).exp());
            assert!((value / exact - 1.0).abs() < 3e-7, "{value} at {x}");
        }
        for x in [NEGLIGIBLE.next_up(), 33.0, 1e4, f32::MAX, f32::INFINITY] {
            assert_eq!(exp_neg(x).to_bits(), 0);
        }
    }
}
