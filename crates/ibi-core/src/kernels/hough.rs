//! Votes for a place, gathered in the cells of a grid; sparse, so that memory grows with the votes and not with the room.

/// A cell: x, y, z in multiples of its width.
pub type Cell = [i32; 3];

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
/// ascending. Of cells that gather as much the lowest wins. Without a vote there are no voters.
///
/// # Complexity
/// O(n log n) time, 160 bytes a vote.
#[must_use]
pub fn peak(votes: &[(u32, [f32; 3])], width: f32) -> Vec<(u32, f32)> {
    let mut all: Vec<(Cell, u32, f32)> = Vec::with_capacity(8 * votes.len());
    for &(voter, place) in votes {
        all.extend(
            shares(place, width).filter(|&(_, share)| share > 0.0).map(|(cell, share)| (cell, voter, share)),
        );
    }
    // By voter within a cell: so are the sums, whatever the sort does.
    all.sort_unstable_by_key(|&(cell, voter, _)| (cell, voter));
    let mut best: (f32, &[(Cell, u32, f32)]) = (0.0, &[]);
    for votes in all.chunk_by(|a, b| a.0 == b.0) {
        let sum = votes.iter().map(|&(.., share)| share).sum();
        if sum > best.0 {
            best = (sum, votes);
        }
    }
    best.1.iter().map(|&(_, voter, share)| (voter, share)).collect()
}
