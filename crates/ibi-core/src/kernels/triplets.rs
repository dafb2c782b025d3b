//! The triplets of largest score sum, one after the other, without listing the others.

use std::cmp::{Ordering, Reverse};
use std::collections::BinaryHeap;

/// Yields all [i, j, k] with i < j < k over `scores` (sorted in descending order), largest sum of scores
/// first, ties in lexicographic order.
///
/// A best-first search in which every triplet has exactly one parent, of no smaller sum: (i, j, k - 1), or
/// (i, j - 1, k - 1) where k follows j, or (i - 1, j - 1, k - 1) where all three are neighbours. So nothing is
/// visited twice and nothing needs remembering.
///
/// # Complexity
/// O(log n) for the n-th triplet; memory O(n).
#[derive(Debug)]
pub struct TopTriplets<'a> {
    scores: &'a [f32],
    frontier: BinaryHeap<Candidate>,
}

impl<'a> TopTriplets<'a> {
    /// Starts the search; `scores` must be sorted in descending order.
    #[must_use]
    pub fn new(scores: &'a [f32]) -> Self {
        let mut search = Self { scores, frontier: BinaryHeap::new() };
        search.push([0, 1, 2]);
        search
    }

    fn push(&mut self, triplet: [u32; 3]) {
        let [i, j, k] = triplet.map(|t| t as usize);
        if let Some(&last) = self.scores.get(k) {
            self.frontier.push(Candidate { sum: self.scores[i] + self.scores[j] + last, triplet });
        }
    }
}

impl Iterator for TopTriplets<'_> {
    type Item = [usize; 3];

    fn next(&mut self) -> Option<[usize; 3]> {
        let [i, j, k] = self.frontier.pop()?.triplet;
        self.push([i, j, k + 1]);
        if k == j + 1 {
            self.push([i, j + 1, k + 1]);
            if j == i + 1 {
                self.push([i + 1, j + 1, k + 1]);
            }
        }
        Some([i, j, k].map(|t| t as usize))
    }
}

#[derive(Debug)]
struct Candidate {
    sum: f32,
    triplet: [u32; 3],
}

impl Ord for Candidate {
    fn cmp(&self, other: &Self) -> Ordering {
        self.sum.total_cmp(&other.sum).then_with(|| Reverse(self.triplet).cmp(&Reverse(other.triplet)))
    }
}

impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Candidate {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Candidate {}
