//! Correspondences from descriptors.

use super::FeatureError;
use super::door::check_len;
use super::leaves::Leaves;
use crate::interrupt::{Interrupt, Phase};
use crate::kernels::par;

/// Descriptors of any kind, a row for each point.
#[derive(Debug, Clone, Copy)]
pub struct Descriptors<'a> {
    /// Row-major.
    pub values: &'a [f32],
    /// Numbers of a row; at least 1.
    pub dim: usize,
}

impl Descriptors<'_> {
    /// Number of rows.
    #[must_use]
    pub fn len(&self) -> usize {
        self.values.len() / self.dim
    }

    /// Whether there is no row.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    pub(super) fn row(&self, row: u32) -> &[f32] {
        &self.values[row as usize * self.dim..][..self.dim]
    }

    /// Squares and their sums must be finite in `f32`.
    const MAX: f32 = 1e15;

    fn check(&self, argument: &'static str) -> Result<(), FeatureError> {
        check_len(argument, self.len())?;
        let bad = self.values.iter().position(|x| !matches!(x.abs(), 0.0..Self::MAX));
        bad.map_or(Ok(()), |at| {
            let (row, column) = (at / self.dim, at % self.dim);
            Err(FeatureError::Descriptor { argument, row, column, value: self.values[at] })
        })
    }
}

/// Which pairs of descriptors are matches.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Matching {
    /// How many source rows each target row is joined to; at least 1.
    pub k: usize,
    /// Whether the target row must be among the k nearest of the source row, too.
    pub mutual: bool,
    /// The largest ratio of the distance to that of the first source row left out (Lowe 2004); above 0, at most 1.
    pub max_ratio: Option<f64>,
}

impl Default for Matching {
    fn default() -> Self {
        Self { k: 1, mutual: false, max_ratio: None }
    }
}

/// Pairs of rows.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Matches {
    /// [source row, target row], by target row and then the nearest first.
    pub rows: Vec<[u32; 2]>,
    /// 1 - d / d', d' being the distance to the nearest source row left out: from 0 to 1, larger is better. 1 if none
    /// is left out, 0 if both are 0.
    pub similarity: Vec<f64>,
}

/// Target rows that one thread takes at a time.
const GRAIN: usize = 128;

/// Joins each target row to its `k` nearest source rows (Euclidean distance), exactly; of equally near ones to those of
/// lower rows.
///
/// # Errors
/// If a number is not finite or beyond 1e15, if the rows differ in length, if `k` is 0 or `max_ratio` out of range.
///
/// # Complexity
/// At most O(n m d) time, a fraction of it where descriptors are as alike as those of one object are; about twice the
/// memory of the sources (with `mutual`: of both), and 16 bytes of each row a thread.
pub fn match_features(
    source: Descriptors<'_>,
    target: Descriptors<'_>,
    matching: Matching,
    interrupt: &Interrupt,
) -> Result<Matches, FeatureError> {
    if source.dim != target.dim {
        return Err(FeatureError::DimMismatch { src: source.dim, tgt: target.dim });
    }
    source.check("src_feat")?;
    target.check("tgt_feat")?;
    let Matching { k, mutual, max_ratio } = matching;
    if k == 0 {
        return Err(FeatureError::Setting { argument: "k", value: 0.0, allowed: "at least 1" });
    }
    if let Some(value) = max_ratio
        && !(value > 0.0 && value <= 1.0)
    {
        return Err(FeatureError::Setting { argument: "ratio", value, allowed: "above 0 and at most 1" });
    }
    if !interrupt.enter(Phase::Match) {
        return Err(FeatureError::Interrupted);
    }
    let back = if mutual { Some(nearest_rows(target, source, k, interrupt)?) } else { None };
    let leaves = Leaves::new(source, interrupt)?;
    let parts = par::chunks(target.len(), GRAIN, |run| {
        let mut part = Matches::default();
        leaves.nearest(&target, run, k + 1, interrupt, |row, hits| {
            let row = row as u32;
            let left_out = hits.get(k).map_or(f64::INFINITY, |hit| hit.0.sqrt());
            for &(dist_sq, other) in hits.iter().take(k) {
                let ratio = ratio(dist_sq.sqrt(), left_out);
                let is_mutual = back.as_ref().is_none_or(|back| back[other as usize].contains(&row));
                if is_mutual && max_ratio.is_none_or(|most| ratio <= most) {
                    part.rows.push([other, row]);
                    part.similarity.push(1.0 - ratio);
                }
            }
        });
        part
    });
    if interrupt.is_set() {
        return Err(FeatureError::Interrupted);
    }
    let mut matches = Matches::default();
    for part in parts {
        matches.rows.extend(part.rows);
        matches.similarity.extend(part.similarity);
    }
    Ok(matches)
}

/// d1 / d2, 1 where nothing tells them apart.
fn ratio(d1: f64, d2: f64) -> f64 {
    if d2 > 0.0 { d1 / d2 } else { 1.0 }
}

/// For each query the `k` nearest of `rows`.
fn nearest_rows(
    rows: Descriptors<'_>,
    queries: Descriptors<'_>,
    k: usize,
    interrupt: &Interrupt,
) -> Result<Vec<Vec<u32>>, FeatureError> {
    let leaves = Leaves::new(rows, interrupt)?;
    let parts = par::chunks(queries.len(), GRAIN, |run| {
        let mut part = Vec::new();
        leaves.nearest(&queries, run, k, interrupt, |_, hits| {
            part.push(hits.iter().map(|hit| hit.1).collect());
        });
        part
    });
    if interrupt.is_set() {
        Err(FeatureError::Interrupted)
    } else {
        Ok(parts.into_iter().flatten().collect())
    }
}
