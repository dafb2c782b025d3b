//! A scan as it can be matched: without rows that are no points, thinned, without its table.

use std::borrow::Cow;

use nalgebra::{Point3, Vector3};

use super::bodies::{Body, bodies};
use super::extent::extent;
use super::faces::{faces, is_larger};
use super::twins::distinct;
use super::{DetectionError, VOXELS_PER_SPACING};
use crate::error::{Argument, Error};
use crate::features::{
    FeatureError, Neighborhood, Plane, PlaneSearch, dominant_plane, estimate_normals, voxel_downsample,
};
use crate::interrupt::Interrupt;
use crate::kernels::nearby::Nearby;
use crate::kernels::neighbors::Neighbors;
use crate::scene::{Cloud, PreparedCloud};

/// Where more of the points have no normal, those of the others tell nothing about them.
const MOST_WITHOUT_NORMAL: f64 = 0.5;

/// Wider neighbourhoods round off what is thin.
const NORMAL_VOXELS: f64 = 2.0;
const NORMAL_NEIGHBORS: usize = 30;

/// A scan whose points are so much coarser than the voxel is matched at one that it fills: one of so many voxels from each to
/// twice of it, few, as the model is described anew in each.
const COARSE: f64 = 1.15;
const VOXEL_STEPS_PER_DOUBLING: f64 = 8.0;

/// Points beside a table are stray ones if they are so much farther apart than those of the whole scan.
const STRAY_SPACINGS: f64 = 4.0;

/// How far from a table its points may lie, and the least share of them.
const PLANE_VOXELS: f64 = 1.5;
const PLANE_SHARE: f64 = 0.2;

/// A table has nothing behind it; the largest plane of a heap of parts has.
const MAX_BEHIND: f64 = 0.02;

/// A plane that hangs together over more is no face of a part, nor of two that touch.
const TABLE_DIAMETERS: f64 = 2.0;

/// Shares of a scan: on a table, and behind it; and before it to behind it, where it is seen from below.
const TABLE_SHARE: f64 = 0.3;
const BEHIND_SHARE: f64 = 0.05;
const FRONT_PER_BEHIND: f64 = 0.1;

/// The rows of a scan that are points, as cameras write NaN where they have measured nothing.
#[derive(Debug, Clone, PartialEq)]
pub struct Measured {
    /// Finite.
    pub points: Vec<Point3<f64>>,
    /// Where one was 0 or not finite, that of the nearest point that has one; `None` where most were.
    pub normals: Option<Vec<Vector3<f64>>>,
    /// Rows that were not finite.
    pub num_dropped: usize,
    /// Points that had no normal.
    pub num_without_normal: usize,
}

impl Measured {
    /// Takes what is finite, and completes its normals.
    ///
    /// # Errors
    /// If there is not one normal for each point.
    pub fn of(points: &[Point3<f64>], normals: Option<&[Vector3<f64>]>) -> Result<Self, Error> {
        let expected = points.len();
        if let Some(len) = normals.map(<[_]>::len).filter(|&len| len != expected) {
            let (argument, of) = (Argument::TgtNormals, Argument::Tgt);
            return Err(Error::LengthMismatch { argument, len, of, expected });
        }
        let is_finite = |&row: &usize| points[row].iter().all(|x| x.is_finite());
        let rows: Vec<usize> = (0..expected).filter(is_finite).collect();
        let points: Vec<_> = rows.iter().map(|&row| points[row]).collect();
        let normals = normals.map(|normals| rows.iter().map(|&row| normals[row]).collect());
        let num_dropped = expected - points.len();
        let (normals, num_without_normal) = normals.map_or((None, 0), |normals| completed(&points, normals));
        Ok(Self { points, normals, num_dropped, num_without_normal })
    }

    /// Each point once.
    pub(super) fn distinct(self) -> Self {
        match distinct(&self.points) {
            Some(rows) => self.picked(&rows),
            None => self,
        }
    }

    /// The points that are wanted.
    pub(super) fn within(self, is_wanted: impl Fn(&Point3<f64>) -> bool) -> Self {
        let rows: Vec<usize> = (0..self.points.len()).filter(|&row| is_wanted(&self.points[row])).collect();
        self.picked(&rows)
    }

    /// The points that do not lie within `distance` of a background, and those that do.
    pub(super) fn off(
        self,
        background: &[Point3<f64>],
        distance: f64,
        interrupt: &Interrupt,
    ) -> Result<(Self, Vec<Point3<f64>>), DetectionError> {
        let near = Nearby::until(background, distance, distance, || interrupt.is_set());
        let is_on = near.ok_or(FeatureError::Interrupted)?.any_within_each(distance, &self.points);
        let (on, off): (Vec<usize>, Vec<usize>) = (0..is_on.len()).partition(|&row| is_on[row]);
        let on = picked(&self.points, &on);
        Ok((self.picked(&off), on))
    }

    fn picked(self, rows: &[usize]) -> Self {
        let normals = self.normals.map(|normals| picked(&normals, rows));
        Self { points: picked(&self.points, rows), normals, ..self }
    }
}

fn completed(points: &[Point3<f64>], mut normals: Vec<Vector3<f64>>) -> (Option<Vec<Vector3<f64>>>, usize) {
    let is_normal = |normal: &Vector3<f64>| normal.iter().all(|x| x.is_finite()) && normal.amax() > 0.0;
    let (with, without): (Vec<usize>, Vec<usize>) =
        (0..normals.len()).partition(|&row| is_normal(&normals[row]));
    if without.len() as f64 > MOST_WITHOUT_NORMAL * normals.len() as f64 {
        return (None, without.len());
    }
    if !without.is_empty() {
        let tree = Neighbors::new(&with.iter().map(|&row| points[row]).collect::<Vec<_>>());
        for &row in &without {
            if let Some((nearest, _)) = tree.nearest(&points[row]) {
                normals[row] = normals[with[nearest as usize]];
            }
        }
    }
    (Some(normals), without.len())
}

/// A scan that was thinned, without its table.
pub(super) struct Prepared {
    pub(super) points: Vec<Point3<f64>>,
    pub(super) normals: Vec<Vector3<f64>>,
    /// One that the scan fills: that of the model, or a larger one.
    pub(super) voxel: f64,
    /// With its table.
    pub(super) whole: Vec<Point3<f64>>,
    /// If they were given.
    pub(super) whole_normals: Option<Vec<Vector3<f64>>>,
    /// Its table and its walls.
    pub(super) taken_away: Vec<Point3<f64>>,
    /// Whether nearly all of it lies behind a table, as seen from the viewpoint.
    pub(super) is_behind_table: bool,
}

/// What is known of a scan that is to be prepared for a model.
#[derive(Clone, Copy)]
pub(super) struct Setting<'a> {
    /// Of the model.
    pub(super) voxel: f64,
    /// Of the model.
    pub(super) diameter: f64,
    pub(super) viewpoint: Option<Point3<f64>>,
    pub(super) remove_plane: Option<bool>,
    /// How long and how wide the faces of all models are.
    pub(super) faces: &'a [[f64; 2]],
}

impl Prepared {
    pub(super) fn new(
        measured: &Measured,
        setting: &Setting<'_>,
        interrupt: &Interrupt,
    ) -> Result<Self, DetectionError> {
        let given = setting.voxel;
        let mut voxel = given;
        let (whole, mut left, is_behind_table) = loop {
            let normals = measured.normals.as_deref();
            let whole = voxel_downsample(&measured.points, normals, voxel, interrupt)?;
            let table = Table::of(&whole.points, voxel, setting, interrupt)?;
            let left: Vec<usize> = (0..whole.points.len()).filter(|&row| !table.holds(row)).collect();
            let apart = spacing(&picked(&whole.points, &left), interrupt)?;
            if apart.is_infinite() || VOXELS_PER_SPACING * apart <= COARSE * voxel {
                break (whole, left, table.is_above);
            }
            // Too coarse: the scan is, or there are but stray points beside its table.
            let of_whole = spacing(&whole.points, interrupt)?;
            if apart > STRAY_SPACINGS * of_whole.max(given) {
                break (whole, Vec::new(), table.is_above);
            }
            let filled = VOXELS_PER_SPACING * apart.min(of_whole);
            if voxel > given || filled <= COARSE * voxel {
                break (whole, left, table.is_above);
            }
            let steps = (VOXEL_STEPS_PER_DOUBLING * (filled / given).log2()).ceil();
            voxel = given * 2_f64.powf(steps / VOXEL_STEPS_PER_DOUBLING);
        };
        let mut points = picked(&whole.points, &left);
        let mut normals = if let Some(normals) = &whole.normals {
            picked(normals, &left)
        } else {
            let neighborhood =
                Neighborhood { radius: NORMAL_VOXELS * voxel, max_neighbors: NORMAL_NEIGHBORS };
            estimate_normals(&points, neighborhood, setting.viewpoint, interrupt)?
        };
        if setting.remove_plane != Some(false) {
            let found = faces(&points, &normals, voxel, interrupt).ok_or(FeatureError::Interrupted)?;
            let mut stays = vec![true; points.len()];
            for face in
                found.iter().filter(|face| is_larger(face.extents, setting.faces, setting.diameter, voxel))
            {
                face.rows.iter().for_each(|&row| stays[row as usize] = false);
            }
            let rows: Vec<usize> = (0..points.len()).filter(|&row| stays[row]).collect();
            (points, normals) = (picked(&points, &rows), picked(&normals, &rows));
            left = picked(&left, &rows);
        }
        let mut is_left = vec![false; whole.points.len()];
        for &row in &left {
            is_left[row] = true;
        }
        let gone: Vec<usize> = (0..is_left.len()).filter(|&row| !is_left[row]).collect();
        let taken_away = picked(&whole.points, &gone);
        let (whole, whole_normals) = (whole.points, whole.normals);
        Ok(Self { points, normals, voxel, whole, whole_normals, taken_away, is_behind_table })
    }
}

impl Prepared {
    /// Turns each normal to those of the eyes that saw the point: of all, unless it is known what each of them measured.
    pub(super) fn turn_to_eyes(&mut self, eyes: &[Point3<f64>], parts: &[Cow<'_, [Point3<f64>]>]) {
        let mut ways = vec![Vector3::zeros(); self.points.len()];
        for (k, eye) in eyes.iter().enumerate() {
            let saw = match parts.get(k) {
                Some(part) if parts.len() == eyes.len() => {
                    Nearby::new(part, self.voxel).any_within_each(self.voxel, &self.points)
                }
                _ => vec![true; self.points.len()],
            };
            for ((way, point), _) in ways.iter_mut().zip(&self.points).zip(saw).filter(|(_, saw)| *saw) {
                *way += (eye - point).try_normalize(0.0).unwrap_or_default();
            }
        }
        for (normal, way) in self.normals.iter_mut().zip(ways) {
            if normal.dot(&way) < 0.0 {
                normal.neg_mut();
            }
        }
    }
}

/// Which points are the table's, and whether it is between the viewpoint and nearly all else.
#[derive(Default)]
struct Table {
    /// Nothing without a table.
    is_on: Vec<bool>,
    is_above: bool,
}

impl Table {
    fn of(
        points: &[Point3<f64>],
        voxel: f64,
        setting: &Setting<'_>,
        interrupt: &Interrupt,
    ) -> Result<Self, DetectionError> {
        let is_sure = setting.remove_plane == Some(true);
        let is_wanted = setting.remove_plane != Some(false) && (is_sure || setting.viewpoint.is_some());
        let plane = if is_wanted { plane(points, voxel, setting.viewpoint, interrupt)? } else { None };
        let Some(plane) = plane else { return Ok(Self::default()) };
        let on: Vec<Point3<f64>> =
            points.iter().zip(&plane.inliers).filter(|&(_, &is_on)| is_on).map(|(p, _)| *p).collect();
        let is_wide = || {
            let widest = bodies(&on, 2.0 * voxel).iter().map(|body| body.across).fold(0.0, f64::max);
            widest > TABLE_DIAMETERS * setting.diameter
        };
        let behind = plane.behind;
        if !(is_sure || behind < MAX_BEHIND) {
            let share = on.len() as f64 / points.len() as f64;
            let is_seen_from_below = share >= TABLE_SHARE
                && behind >= BEHIND_SHARE
                && 1.0 - share - behind <= FRONT_PER_BEHIND * behind;
            return Ok(Self { is_on: Vec::new(), is_above: is_seen_from_below && is_wide() });
        }
        // A scan of one flat part is a plane and nothing else; so is that of an empty table.
        if on.len() + 3 > points.len() && !is_wide() {
            return Ok(Self::default());
        }
        Ok(Self { is_on: plane.inliers, is_above: false })
    }

    fn holds(&self, row: usize) -> bool {
        self.is_on.get(row).is_some_and(|&is_on| is_on)
    }
}

/// What stands out of a scan, by its own spacing.
pub(super) fn standing(
    points: &[Point3<f64>],
    viewpoint: Option<Point3<f64>>,
    interrupt: &Interrupt,
) -> Result<Vec<Body>, DetectionError> {
    let voxel = (2.0 * spacing(points, interrupt)?).max(extent(points) / 300.0);
    if !(voxel > 0.0 && voxel.is_finite()) {
        return Ok(Vec::new());
    }
    let thinned = voxel_downsample(points, None, voxel, interrupt)?.points;
    let plane = plane(&thinned, voxel, viewpoint, interrupt)?;
    let is_table = |plane: &Plane| {
        let num_on = plane.inliers.iter().filter(|&&is_on| is_on).count();
        plane.behind < MAX_BEHIND || 2 * num_on > thinned.len()
    };
    let table = plane.filter(is_table);
    let stands = |&row: &usize| table.as_ref().is_none_or(|table| !table.inliers[row]);
    let left: Vec<usize> = (0..thinned.len()).filter(stands).collect();
    Ok(bodies(&picked(&thinned, &left), 1.5 * voxel))
}

fn plane(
    points: &[Point3<f64>],
    voxel: f64,
    viewpoint: Option<Point3<f64>>,
    interrupt: &Interrupt,
) -> Result<Option<Plane>, DetectionError> {
    let search = PlaneSearch { distance: PLANE_VOXELS * voxel, min_share: PLANE_SHARE, seed: 0 };
    Ok(dominant_plane(points, &search, viewpoint, interrupt)?)
}

/// Mean distance to the nearest point; infinite where there are too few points to tell.
fn spacing(points: &[Point3<f64>], interrupt: &Interrupt) -> Result<f64, DetectionError> {
    match PreparedCloud::source_until(&Cloud::new(points), interrupt) {
        Ok(cloud) => Ok(cloud.spacing),
        Err(error @ Error::Interrupted { .. }) => Err(error.into()),
        Err(_) => Ok(f64::INFINITY),
    }
}

fn picked<T: Copy>(of: &[T], rows: &[usize]) -> Vec<T> {
    rows.iter().map(|&row| of[row]).collect()
}
