//! The table that parts lie on.

use nalgebra::{Matrix3, Point3, Vector3};

use super::FeatureError;
use super::door::{check_length, check_place, check_points};
use crate::interrupt::{Interrupt, Phase};
use crate::kernels::columns::{columns, middle};
use crate::kernels::par;
use crate::kernels::rng::Rng;
use crate::kernels::simd::simd;
use crate::kernels::spread::least_axis;

/// What counts as a plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaneSearch {
    /// How far from the plane its points may lie, data units; above 0.
    pub distance: f64,
    /// The least share of all points that makes a plane worth a word; above 0, at most 1.
    pub min_share: f64,
    /// Of the draws.
    pub seed: u64,
}

/// A plane: the points x with n . x = offset.
#[derive(Debug, Clone, PartialEq)]
pub struct Plane {
    /// n, of length 1.
    pub normal: Vector3<f64>,
    /// Distance of the plane from the origin along n, data units.
    pub offset: f64,
    /// Which points lie within the distance of it.
    pub inliers: Vec<bool>,
    /// Share of all points that lie behind the plane, farther than the distance. A table hides what is behind it: a plane
    /// with more than a few stray points there is a face of the parts.
    pub behind: f64,
}

/// How many points stand for all while planes are drawn.
const SAMPLE: usize = 2000;

/// Draws at most; fewer where the share that is wanted makes a good draw likelier.
const MAX_DRAWS: f64 = 20_000.0;

/// How often it may happen that no draw lies in a plane of the least share.
const FAILURE: f64 = 1e-4;

/// Fits at most to what lies near the plane drawn.
const FITS: usize = 10;

/// Draws that one thread takes at a time.
const GRAIN: usize = 64;

/// The plane that holds the most points (RANSAC, Fischler & Bolles 1981), fitted to them by least squares; `None` if
/// their share is below the least.
///
/// The normal points to the side of the viewpoint; without one, to the side on which more of the other points lie.
///
/// # Errors
/// If a coordinate is not finite or a number of `search` is out of its range.
///
/// # Complexity
/// O(n), and at most 40 million point tests for the draws, a few milliseconds.
pub fn dominant_plane(
    points: &[Point3<f64>],
    search: &PlaneSearch,
    viewpoint: Option<Point3<f64>>,
    interrupt: &Interrupt,
) -> Result<Option<Plane>, FeatureError> {
    check_points("points", points)?;
    check_place("viewpoint", viewpoint.as_ref())?;
    check_length("distance", search.distance)?;
    let share = search.min_share;
    if !(share > 0.0 && share <= 1.0) {
        let (argument, allowed) = ("min_share", "above 0 and at most 1");
        return Err(FeatureError::Setting { argument, value: share, allowed });
    }
    if points.len() < 3 {
        return Ok(None);
    }
    if !interrupt.enter(Phase::Plane) {
        return Err(FeatureError::Interrupted);
    }
    let Some(drawn) = best_draw(points, search, interrupt)? else { return Ok(None) };
    let Some(plane) = fitted(points, drawn, search.distance, interrupt) else { return Ok(None) };
    if interrupt.is_set() {
        return Err(FeatureError::Interrupted);
    }
    let inliers: Vec<bool> = points.iter().map(|p| plane.distance(p).abs() <= search.distance).collect();
    if (inliers.iter().filter(|&&near| near).count() as f64) < share * points.len() as f64 {
        return Ok(None);
    }
    let turn = if faces(&plane, points, &inliers, viewpoint) { 1.0 } else { -1.0 };
    let normal = turn * plane.normal;
    let behind = points.iter().filter(|p| turn * plane.distance(p) < -search.distance).count();
    let (offset, behind) = (normal.dot(&plane.through.coords), behind as f64 / points.len() as f64);
    Ok(Some(Plane { normal, offset, inliers, behind }))
}

/// Through a point and not at an offset, which would lose digits far from the origin.
#[derive(Clone, Copy)]
struct Candidate {
    normal: Vector3<f64>,
    through: Point3<f64>,
}

impl Candidate {
    fn distance(&self, point: &Point3<f64>) -> f64 {
        self.normal.dot(&(point - self.through))
    }
}

/// The plane through three points of a sample that is near to most of it; of equal ones the first.
fn best_draw(
    points: &[Point3<f64>],
    search: &PlaneSearch,
    interrupt: &Interrupt,
) -> Result<Option<Candidate>, FeatureError> {
    let mut rng = Rng::new(search.seed, 0, 0);
    let all: Vec<u32> = (0..points.len() as u32).collect();
    let sample: Vec<Point3<f64>> =
        rng.sample(&all, SAMPLE).into_iter().map(|row| points[row as usize]).collect();
    let origin = middle(&sample);
    let local = columns(&sample, origin, search.distance);
    let draws = (FAILURE.ln() / (-search.min_share.powi(3)).ln_1p()).clamp(100.0, MAX_DRAWS) as usize;
    let triplets: Vec<[usize; 3]> =
        (0..draws).map(|_| [0; 3].map(|_: usize| rng.below(sample.len()))).collect();
    let parts = par::chunks(draws, GRAIN, |run| {
        if interrupt.is_set() {
            return Vec::new();
        }
        let counted = |draw: usize| {
            let candidate = through(triplets[draw].map(|i| sample[i]))?;
            let offset = candidate.normal.dot(&(candidate.through.coords - origin)) / search.distance;
            Some((count(&local, candidate.normal.cast().into(), offset as f32), candidate))
        };
        run.filter_map(counted).collect::<Vec<_>>()
    });
    if interrupt.is_set() {
        return Err(FeatureError::Interrupted);
    }
    let first_best = |best: Option<(u32, Candidate)>, next: (u32, Candidate)| match best {
        Some(best) if best.0 >= next.0 => Some(best),
        _ => Some(next),
    };
    Ok(parts.into_iter().flatten().fold(None, first_best).map(|(_, candidate)| candidate))
}

fn through([a, b, c]: [Point3<f64>; 3]) -> Option<Candidate> {
    Some(Candidate { normal: (b - a).cross(&(c - a)).try_normalize(0.0)?, through: a })
}

/// How many points are within 1 of the plane.
fn count(points: &[Vec<f32>; 3], normal: [f32; 3], offset: f32) -> u32 {
    let [x, y, z] = points.each_ref().map(|axis| &axis[..points[0].len()]);
    simd(
        #[inline(always)]
        || {
            let mut near = 0;
            for k in 0..x.len() {
                let distance = normal[0] * x[k] + normal[1] * y[k] + normal[2] * z[k] - offset;
                near += u32::from(distance.abs() <= 1.0);
            }
            near
        },
    )
}

/// Fitted to the points near it, again and again until these stay the same. The fit may have fewer of them than the draw:
/// the best draw leans towards what stands on the plane.
fn fitted(
    points: &[Point3<f64>],
    drawn: Candidate,
    distance: f64,
    interrupt: &Interrupt,
) -> Option<Candidate> {
    let mut plane = drawn;
    let mut last = 0;
    for _ in 0..FITS {
        let near = || points.iter().filter(|p| plane.distance(p).abs() <= distance);
        let count = near().count();
        if count < 3 || count == last || interrupt.is_set() {
            break;
        }
        let mean = plane.through + near().map(|p| p - plane.through).sum::<Vector3<f64>>() / count as f64;
        if interrupt.is_set() {
            break;
        }
        let spread: Matrix3<f64> = near().map(|p| (p - mean) * (p - mean).transpose()).sum();
        (plane, last) = (Candidate { normal: least_axis(&spread)?, through: mean }, count);
    }
    Some(plane)
}

/// Whether the normal points where it should.
fn faces(
    plane: &Candidate,
    points: &[Point3<f64>],
    inliers: &[bool],
    viewpoint: Option<Point3<f64>>,
) -> bool {
    let of_others = || {
        let others = points.iter().zip(inliers).filter(|&(_, &near)| !near);
        others.map(|(p, _)| plane.distance(p).signum()).sum()
    };
    let side: f64 = viewpoint.map_or_else(of_others, |eye| plane.distance(&eye));
    // Undecided: the one with z above 0, as for normals.
    let n = plane.normal;
    if side == 0.0 { (n.z, n.y, n.x) >= (0.0, 0.0, 0.0) } else { side > 0.0 }
}
