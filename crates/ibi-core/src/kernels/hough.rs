//! Votes for a place, gathered in the cells of a grid; sparse, so that memory grows with the votes and not with the room.

use std::collections::HashMap;

/// A cell: x, y, z in multiples of its width.
pub type Cell = [i32; 3];

/// Less than a millisecond of work.
const VOTES_AN_ASK: usize = 4096;

/// The eight cells whose centres surround a place, and what a vote there adds to each: its trilinear weights, of sum 1.
pub fn shares(place: [f32; 3], width: f32) -> impl Iterator<Item = (Cell, f32)> {
    // Half a cell back, so that a vote at the centre of a cell is all its own.
    let at = place.map(|x| x / width - 0.5);
    // Casts saturate: places farther out than any cell share the last ones. A place beyond the floats has no share, NaN.
    let low = at.map(|x| x.floor() as i32);
    let part = [0, 1, 2].map(|axis| at[axis] - at[axis].floor());
    (0..8_u8).map(move |corner| {
        let upper = [corner & 1 != 0, corner & 2 != 0, corner & 4 != 0];
        let cell = [0, 1, 2].map(|axis| low[axis].saturating_add(i32::from(upper[axis])));
        let weights = [0, 1, 2].map(|axis| if upper[axis] { part[axis] } else { 1.0 - part[axis] });
        (cell, weights[0] * weights[1] * weights[2])
    })
}

/// The voters of the cell that gathers the most, each with what it adds, in the order of `votes`: (voter, place), voters
/// ascending. Of cells that gather as much the lowest wins. Without a vote, or once `interrupted`, there are no voters.
///
/// # Complexity
/// O(n) time, 16 bytes for each cell that has a vote, of which there are 8 n at most.
#[must_use]
pub fn peak(votes: &[(u32, [f32; 3])], width: f32, interrupted: impl Fn() -> bool) -> Vec<(u32, f32)> {
    let mut sums: HashMap<Cell, f32> = HashMap::new();
    for votes in votes.chunks(VOTES_AN_ASK) {
        if interrupted() {
            return Vec::new();
        }
        for (cell, share) in votes.iter().flat_map(|&(_, place)| shares(place, width)) {
            // NaN has no share either.
            if share > 0.0 {
                *sums.entry(cell).or_default() += share;
            }
        }
    }
    let Some((&best, _)) = sums.iter().max_by(|(a, x), (b, y)| x.total_cmp(y).then(b.cmp(a))) else {
        return Vec::new();
    };
    let part = |place| shares(place, width).find(|&(cell, share)| cell == best && share > 0.0);
    votes.iter().filter_map(|&(voter, place)| Some((voter, part(place)?.1))).collect()
}
