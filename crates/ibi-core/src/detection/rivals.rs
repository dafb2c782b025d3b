//! Poses of different models compete for the points that were measured.

/// A pose of one of the models.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Rival<'a> {
    pub(super) part: usize,
    /// The probability that it is right.
    pub(super) score: f64,
    /// Rows of the points that it explains.
    pub(super) rows: &'a [u32],
}

/// A pose of whose points more than this share is explained by better poses of other models is outdone. Of right poses a wrong one that
/// is better explains most, or next to nothing: what lies between is wrong. Chosen on the tuning half of `benchmarks/bins.py`.
const MOST_SHARED: f64 = 1.0 / 3.0;

impl Rival<'_> {
    /// How many points it may be expected to explain rightly. By its score alone a pin would outdo the bolt on whose shank it was found
    /// if it fits a little better, and a bolt the pin that is hidden where its head should be.
    fn worth(&self) -> f64 {
        self.score * self.rows.len() as f64
    }
}

/// Poses of which model explain a point.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Held {
    ByNone,
    By(usize),
    BySeveral,
}

/// Which poses are outdone: the one of most worth comes first, and holds what it explains; each later one is held against those before
/// it that were not outdone. Of equals the earlier one is better.
///
/// # Complexity
/// O(points + what all poses explain).
pub(super) fn outdone(rivals: &[Rival<'_>], num_points: usize) -> Vec<bool> {
    let mut order: Vec<usize> = (0..rivals.len()).collect();
    order.sort_by(|&a, &b| rivals[b].worth().total_cmp(&rivals[a].worth()));
    let mut held = vec![Held::ByNone; num_points];
    let mut is_outdone = vec![false; rivals.len()];
    for at in order {
        let Rival { part, rows, .. } = rivals[at];
        let is_others = |row: &&u32| match held[**row as usize] {
            Held::ByNone => false,
            Held::By(other) => other != part,
            Held::BySeveral => true,
        };
        let num_shared = rows.iter().filter(is_others).count();
        if num_shared as f64 > MOST_SHARED * rows.len() as f64 {
            is_outdone[at] = true;
            continue;
        }
        for &row in rows {
            let held = &mut held[row as usize];
            *held = match *held {
                Held::ByNone => Held::By(part),
                Held::By(other) if other == part => Held::By(part),
                Held::By(_) | Held::BySeveral => Held::BySeveral,
            };
        }
    }
    is_outdone
}
