//! Putative correspondences, and which of them are still alive.

use std::sync::{Arc, OnceLock};

use nalgebra::{Point3, Vector3};

use super::cloud::{PreparedCloud, check_points};
use super::clouds::Clouds;
use crate::error::{Argument, Error};
use crate::interrupt::Interrupt;
use crate::kernels::by_target::ByTarget;
use crate::kernels::columns::Columns;
use crate::kernels::graph::PairNormals;

/// Correspondences as a user hands them in: nothing is checked until a [`crate::Registrar`] takes them.
///
/// The row of a correspondence is its id, for the whole run and in the result.
#[derive(Debug, Clone)]
pub struct Correspondences {
    pairs: Pairs,
    similarity: Option<Vec<f64>>,
}

#[derive(Debug, Clone)]
enum Pairs {
    Rows(Vec<[usize; 2]>),
    Points(Vec<[Point3<f64>; 2]>),
}

impl Correspondences {
    /// Pairs of [source row, target row].
    #[must_use]
    pub fn from_rows(rows: Vec<[usize; 2]>) -> Self {
        Self { pairs: Pairs::Rows(rows), similarity: None }
    }

    /// Pairs of [source point, target point], which need not be points of the clouds.
    #[must_use]
    pub fn from_points(points: Vec<[Point3<f64>; 2]>) -> Self {
        Self { pairs: Pairs::Points(points), similarity: None }
    }

    /// How alike the two descriptors of each correspondence are; larger is better.
    #[must_use]
    pub fn with_similarity(mut self, similarity: Vec<f64>) -> Self {
        self.similarity = Some(similarity);
        self
    }

    /// Whether a similarity was given.
    #[must_use]
    pub fn has_similarity(&self) -> bool {
        self.similarity.is_some()
    }

    /// Rows of the clouds, source and target; where points are given instead, those of the nearest points.
    fn rows(&self, clouds: &Clouds<'_>, interrupt: &Interrupt) -> Result<(Vec<u32>, Vec<u32>), Error> {
        /// Points that are looked up before the clock is looked at.
        const CHUNK: usize = 1024;
        let side = |cloud: &PreparedCloud<'_>, column: usize| match &self.pairs {
            Pairs::Rows(rows) => Ok(rows.iter().map(|row| row[column] as u32).collect()),
            Pairs::Points(points) => {
                let nearest = |pair: &[Point3<f64>; 2]| cloud.tree().nearest(&pair[column]);
                let mut rows = Vec::with_capacity(points.len());
                for points in points.chunks(CHUNK) {
                    interrupt.proceed()?;
                    rows.extend(points.iter().filter_map(nearest).map(|(row, _)| row));
                }
                Ok(rows)
            }
        };
        Ok((side(clouds.source, 0)?, side(&clouds.target, 1)?))
    }

    /// M, the number of correspondences.
    #[must_use]
    pub fn len(&self) -> usize {
        match &self.pairs {
            Pairs::Rows(rows) => rows.len(),
            Pairs::Points(points) => points.len(),
        }
    }

    /// Whether M is 0.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Correspondences that were checked and looked up: M pairs of points; the row is the id.
#[derive(Debug)]
pub struct PointPairs {
    /// p_i, in data units.
    pub source: Vec<Point3<f64>>,
    /// q_i, in data units.
    pub target: Vec<Point3<f64>>,
    /// Row of the source point, or of the one nearest to p_i where points were given.
    pub source_rows: Vec<u32>,
    /// Row of the target point, or of the one nearest to q_i.
    pub target_rows: Vec<u32>,
    /// The same pairs as centred `f32` columns in multiples of the resolution.
    pub columns: Arc<Columns>,
    /// The same columns sorted by the place of the target point.
    pub by_target: ByTarget,
    /// How alike the two descriptors of each pair are; larger is better.
    pub similarity: Option<Vec<f64>>,
    /// Normals at both points of each pair.
    pub normals: Option<PairNormals>,
    /// Whether they are pairs of rows, and no points of their own.
    pub(crate) are_rows: bool,
}

impl PointPairs {
    pub(crate) fn new(
        given: &Correspondences,
        clouds: &Clouds<'_>,
        oriented: bool,
        interrupt: &Interrupt,
    ) -> Result<Self, Error> {
        let len = given.len();
        if len > u32::MAX as usize {
            return Err(Error::TooMany { argument: Argument::Corr, len });
        }
        if let Some(similarity) = &given.similarity {
            check_similarity(similarity, len)?;
        }
        let (source, target): (Vec<_>, Vec<_>) = match &given.pairs {
            Pairs::Rows(rows) => (look_up(rows, 0, clouds.source)?, look_up(rows, 1, &clouds.target)?),
            Pairs::Points(points) => points.iter().map(|&[p, q]| (p, q)).unzip(),
        };
        check_points(&source, Argument::Corr)?;
        check_points(&target, Argument::Corr)?;
        interrupt.proceed()?;
        let (source_rows, target_rows) = given.rows(clouds, interrupt)?;
        interrupt.proceed()?;
        let columns = Arc::new(Columns::new(&source, &target, clouds.resolution));
        let by_target = ByTarget::new(&columns);
        let normals = clouds.source.normals.as_ref().zip(clouds.target.normals.as_ref()).map(|(s, t)| {
            let look_up = |normals: &[Vector3<f64>], rows: &[u32]| {
                rows.iter().map(|&row| normals[row as usize].cast()).collect()
            };
            PairNormals { source: look_up(s, &source_rows), target: look_up(t, &target_rows), oriented }
        });
        let similarity = given.similarity.clone();
        let are_rows = matches!(given.pairs, Pairs::Rows(_));
        Ok(Self {
            source,
            target,
            source_rows,
            target_rows,
            columns,
            by_target,
            similarity,
            normals,
            are_rows,
        })
    }

    /// M, the number of correspondences.
    #[must_use]
    pub fn len(&self) -> usize {
        self.source.len()
    }

    /// Whether M is 0.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.source.is_empty()
    }

    /// (p_i, q_i) for each id.
    pub fn pairs<'a>(
        &'a self,
        ids: impl IntoIterator<Item = u32, IntoIter: Clone> + 'a,
    ) -> impl Iterator<Item = (&'a Point3<f64>, &'a Point3<f64>)> + Clone {
        ids.into_iter().map(|i| (&self.source[i as usize], &self.target[i as usize]))
    }
}

fn look_up(rows: &[[usize; 2]], column: usize, cloud: &PreparedCloud<'_>) -> Result<Vec<Point3<f64>>, Error> {
    let points = &cloud.points;
    let find = |(row, pair): (usize, &[usize; 2])| {
        let index = pair[column];
        points.get(index).copied().ok_or(Error::IndexOutOfRange {
            row,
            column,
            index: index.cast_signed() as i64, // negative where a caller wrapped a negative index
            len: points.len(),
        })
    };
    rows.iter().enumerate().map(find).collect()
}

fn check_similarity(similarity: &[f64], expected: usize) -> Result<(), Error> {
    if similarity.len() != expected {
        return Err(Error::LengthMismatch {
            argument: Argument::Similarity,
            len: similarity.len(),
            of: Argument::Corr,
            expected,
        });
    }
    match similarity.iter().position(|s| !s.is_finite()) {
        Some(row) => Err(Error::Similarity { row, value: similarity[row] }),
        None => Ok(()),
    }
}

/// The correspondences that no round has removed yet.
#[derive(Debug)]
pub struct Alive {
    flags: Vec<bool>,
    len: usize,
    all: Arc<Columns>,
    // Made when asked for: most stages look at a few correspondences and need no list of all.
    ids: OnceLock<Vec<u32>>,
    columns: OnceLock<Columns>,
}

impl Alive {
    pub(crate) fn all(pairs: &PointPairs) -> Self {
        let (flags, len) = (vec![true; pairs.len()], pairs.len());
        Self { flags, len, all: Arc::clone(&pairs.columns), ids: OnceLock::new(), columns: OnceLock::new() }
    }

    /// How many there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Whether a correspondence is among them.
    #[must_use]
    pub fn contains(&self, id: u32) -> bool {
        self.flags[id as usize]
    }

    /// Their ids, ascending.
    #[must_use]
    pub fn ids(&self) -> &[u32] {
        self.ids.get_or_init(|| {
            (0_u32..).zip(&self.flags).filter(|&(_, &alive)| alive).map(|(id, _)| id).collect()
        })
    }

    /// Their points, row by row as in [`Self::ids`]; compacted so that kernels run over nothing else.
    #[must_use]
    pub fn columns(&self) -> &Columns {
        self.columns.get_or_init(|| self.all.gather(self.ids()))
    }

    /// Takes `ids` out; returns how many of them were alive.
    pub(crate) fn remove(&mut self, ids: &[u32]) -> usize {
        let before = self.len;
        for &id in ids {
            self.len -= usize::from(std::mem::replace(&mut self.flags[id as usize], false));
        }
        if self.len < before {
            (self.ids, self.columns) = (OnceLock::new(), OnceLock::new());
        }
        before - self.len
    }
}
