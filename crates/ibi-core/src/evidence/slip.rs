//! How far the data pin a pose down: its covariance, and the motions that nothing holds.
//!
//! Linearised point-to-plane (Chen & Medioni 1992): a point p with normal n that a small motion takes along changes its distance from
//! the surface by n . (w x (p - c) + t). A motion that changes no distance is free: a slide on a plane, a turn about an axis
//! (Gelfand & Ikemoto 2003).
//!
//! Motions are *left* perturbations in the target's frame, about a centre c: x -> c + exp(\[w\]) (x - c) + t. Six numbers in this
//! order: w_x, w_y, w_z (radians), t_x, t_y, t_z (data units).

use super::seen::{Look, Seen};
use nalgebra::{DMatrix, Isometry3, Matrix6, Point3, Translation3, UnitQuaternion, Vector3, Vector6};

/// The pose after a small motion about `centre`: rotation vector first, then translation.
#[must_use]
pub fn moved(
    motion: &Vector6<f64>,
    centre: &Point3<f64>,
    target_from_source: &Isometry3<f64>,
) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_scaled_axis(motion.fixed_rows::<3>(0).into_owned());
    let shift = centre.coords - rotation * centre.coords + motion.fixed_rows::<3>(3);
    Isometry3::from_parts(Translation3::from(shift), rotation) * target_from_source
}

/// The motion about `centre` that takes one pose to another: what [`moved`] undoes.
#[must_use]
pub fn motion_between(from: &Isometry3<f64>, to: &Isometry3<f64>, centre: &Point3<f64>) -> Vector6<f64> {
    let motion = to * from.inverse();
    let shift = motion * centre - centre;
    let turn = motion.rotation.scaled_axis();
    Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z)
}

/// The information of measured points on a motion about `centre`: the sum of j j^T / `noise`^2 over points p with unit normals n of
/// the surface that they lie on, j = ((p - c) x n, n); `noise` is their standard deviation across it, data units.
///
/// Each *measured* point counts once, however many points of the model lie near it: otherwise a model that is sampled twice as
/// densely would be known twice as well.
#[must_use]
pub fn information(
    points: &[Point3<f64>],
    normals: &[Vector3<f64>],
    centre: &Point3<f64>,
    noise: f64,
) -> Matrix6<f64> {
    let mut sum = Matrix6::zeros();
    for (p, n) in points.iter().zip(normals) {
        let j = jacobian(p, n, centre);
        sum.syger(1.0, &j, &j, 1.0);
    }
    sum.fill_upper_triangle_with_lower_triangle();
    sum / (noise * noise)
}

/// By how much a small motion about `centre` moves a point along a unit vector: ((p - c) x n, n).
#[must_use]
pub fn jacobian(point: &Point3<f64>, along: &Vector3<f64>, centre: &Point3<f64>) -> Vector6<f64> {
    let turn = (point - centre).cross(along);
    Vector6::new(turn.x, turn.y, turn.z, along.x, along.y, along.z)
}

/// The covariance of a pose of which measured points give this `information`: its inverse, the motion of a part of a `size` (data
/// units) being known beforehand to within that size. So it is finite, and as large as the part along motions that nothing holds.
///
/// (6, 6), rotation (radians) first, in the frame and about the centre that the information is of.
#[must_use]
pub fn covariance(information: &Matrix6<f64>, size: f64) -> Matrix6<f64> {
    let scale = scale(size);
    let scaled = scale * information * scale + Matrix6::identity() / (size * size);
    let inverse = scaled.cholesky().map_or_else(Matrix6::zeros, |cholesky| cholesky.inverse());
    scale * inverse * scale
}

/// Turns are measured as the ways of points that are a size away from the axis: then all six have one unit.
fn scale(size: f64) -> Matrix6<f64> {
    let turn = 1.0 / size;
    Matrix6::from_diagonal(&Vector6::new(turn, turn, turn, 1.0, 1.0, 1.0))
}

/// The six motions of a part of a `size` that the data hold independently of each other, least held first; each moves a point that
/// is a size away, or all, by 1 (data units). And the standard deviation of each (data units), infinite if nothing holds it.
#[must_use]
pub fn principal_motions(information: &Matrix6<f64>, size: f64) -> [(Vector6<f64>, f64); 6] {
    let scale = scale(size);
    let eigen = (scale * information * scale).symmetric_eigen();
    let mut order = [0, 1, 2, 3, 4, 5];
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    order.map(|k| {
        let deviation =
            if eigen.eigenvalues[k] > 0.0 { eigen.eigenvalues[k].sqrt().recip() } else { f64::INFINITY };
        (scale * eigen.eigenvectors.column(k), deviation)
    })
}

/// A motion that costs nothing.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize), serde(rename_all = "snake_case"))]
pub enum FreeMotion {
    /// A slide along a unit vector.
    Slide {
        /// In the target's frame, up to sign.
        along: Vector3<f64>,
    },
    /// A turn about an axis, or a screw about it.
    Turn {
        /// Unit vector along the axis, in the target's frame, up to sign.
        about: Vector3<f64>,
        /// A point on the axis: that nearest to the centre.
        through: Point3<f64>,
        /// How far it slides along the axis in a turn of one radian, data units: 0 for a plain turn.
        pitch: f64,
    },
}

/// The motions of a part of a `size` whose standard deviation exceeds `tolerance` (data units, at a point a size away): slides
/// first, the least held first. Three slides and turns on a plane, a turn and a slide on a cylinder, none on what has corners.
#[must_use]
pub fn free_motions(
    information: &Matrix6<f64>,
    centre: &Point3<f64>,
    size: f64,
    tolerance: f64,
) -> Vec<FreeMotion> {
    let all = principal_motions(information, size);
    let free: Vec<Vector6<f64>> =
        all.iter().filter(|(_, deviation)| *deviation > tolerance).map(|(m, _)| *m).collect();
    if free.is_empty() {
        return Vec::new();
    }
    // Together they span all free motions, in no natural order: those that do not turn are told apart.
    let gram = DMatrix::from_fn(free.len(), free.len(), |a, b| {
        size * size * free[a].fixed_rows::<3>(0).dot(&free[b].fixed_rows::<3>(0))
    });
    let eigen = gram.symmetric_eigen();
    let mut order: Vec<usize> = (0..free.len()).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    let mut slides: Vec<Vector3<f64>> = Vec::new();
    let mut found = Vec::new();
    for k in order {
        let motion: Vector6<f64> =
            free.iter().zip(eigen.eigenvectors.column(k).iter()).map(|(m, &x)| x * m).sum();
        let (turn, mut shift) =
            (motion.fixed_rows::<3>(0).into_owned(), motion.fixed_rows::<3>(3).into_owned());
        if eigen.eigenvalues[k] < SLIDES * SLIDES {
            let along = shift.normalize();
            slides.push(along);
            found.push(FreeMotion::Slide { along });
            continue;
        }
        // What slides add to a turn is free anyway.
        for along in &slides {
            shift -= along * along.dot(&shift);
        }
        let turn_sq = turn.norm_squared();
        let through = centre + turn.cross(&shift) / turn_sq;
        let pitch = turn.dot(&shift) / turn_sq;
        found.push(FreeMotion::Turn { about: turn / turn_sq.sqrt(), through, pitch });
    }
    found
}

/// A motion that turns a point a size away by less than this part of what it moves it in all is a slide.
const SLIDES: f64 = 0.2;

/// How much a pose is worth, from 1 (all that can be seen of it is supported) down: what is lost by moving it tells whether the data
/// hold it there. Supported points count less the farther they lie off, what is contradicted or buried counts against it, and so
/// does a face that runs on: `run_on` places of the rim ([`super::contour::run_on`]) of the `num_ends` that can be seen.
#[must_use]
pub fn worth(sight: &[Look], run_on: f64, num_ends: u32, across: f64) -> f64 {
    let (mut sum, mut asked) = (0.0, 0_u32);
    for Look { seen, gap, .. } in sight {
        sum += match seen {
            Seen::Away => continue,
            Seen::Supported => 1.0 - OFF * (gap / across).powi(2),
            Seen::Contradicted | Seen::Buried => -1.0,
            Seen::Hidden | Seen::Unknown => 0.0,
        };
        asked += 1;
    }
    sum / f64::from(asked.max(1)) - RUNS_ON * run_on / f64::from(num_ends.max(1))
}

/// What a supported point that lies off by the tolerance loses, and what a part loses all ends of which run on.
const OFF: f64 = 2.0;
const RUNS_ON: f64 = 0.25;

/// What a pose loses of its `worth` when it is moved along the three motions that are held least, `step` far (data units, at a
/// point a `size` from the centre), each in the way that costs less: 0 or below where another pose is as good.
#[must_use]
pub fn losses(
    target_from_source: &Isometry3<f64>,
    motions: &[(Vector6<f64>, f64); 6],
    (centre, size): (&Point3<f64>, f64),
    step: f64,
    worth: f64,
    mut worth_of: impl FnMut(&Isometry3<f64>) -> f64,
) -> [f64; 3] {
    [0, 1, 2].map(|k| {
        let (motion, _) = &motions[k];
        let most = (size * motion.fixed_rows::<3>(0).norm()).max(motion.fixed_rows::<3>(3).norm());
        [step, -step]
            .map(|way| worth - worth_of(&moved(&(motion * (way / most)), centre, target_from_source)))
            .into_iter()
            .fold(f64::INFINITY, f64::min)
    })
}
