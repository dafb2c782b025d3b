//! Random numbers, keyed by (seed, round, stage) so that no stage's draw depends on another's or on threads.

use std::f64::consts::TAU;

use nalgebra::{Quaternion, UnitQuaternion};

/// The stages, as keys of random streams.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Stage {
    Scs,
    Ce,
    Te,
    Hv,
}

/// `SplitMix64` (Steele, Lea & Flood 2014): one word of state, and good enough to draw samples.
#[derive(Debug, Clone)]
pub struct Rng(u64);

impl Rng {
    /// The stream of one stage in one round.
    #[must_use]
    pub fn new(seed: u64, round: u32, stage: u32) -> Self {
        // Two steps of mixing keep neighbouring keys from giving overlapping streams.
        let key = Self(seed).next_u64() ^ (u64::from(round) << 32 | u64::from(stage));
        Self(Self(key).next_u64())
    }

    /// The next 64 random bits.
    pub fn next_u64(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Uniform in `0..n`; `n` > 0. The bias of the multiply-shift is below n / 2^64.
    pub fn below(&mut self, n: usize) -> usize {
        ((u128::from(self.next_u64()) * n as u128) >> 64) as usize
    }

    /// Uniform in [0, 1).
    pub fn unit(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// A rotation, all equally likely (Shoemake 1992).
    pub fn rotation(&mut self) -> UnitQuaternion<f64> {
        let (u, a, b) = (self.unit(), self.unit() * TAU, self.unit() * TAU);
        let (s, c) = ((1.0 - u).sqrt(), u.sqrt());
        UnitQuaternion::new_normalize(Quaternion::new(c * b.cos(), s * a.sin(), s * a.cos(), c * b.sin()))
    }

    /// `count` distinct members of `ids`, every subset equally likely, in the order of `ids`; all of them if
    /// there are no more than `count`.
    pub fn sample(&mut self, ids: &[u32], count: usize) -> Vec<u32> {
        if ids.len() <= count {
            return ids.to_vec();
        }
        // A partial Fisher-Yates shuffle of positions; sorted again so that memory is read in order.
        let mut positions: Vec<u32> = (0..ids.len() as u32).collect();
        for i in 0..count {
            let j = i + self.below(ids.len() - i);
            positions.swap(i, j);
        }
        positions.truncate(count);
        positions.sort_unstable();
        positions.into_iter().map(|i| ids[i as usize]).collect()
    }
}
