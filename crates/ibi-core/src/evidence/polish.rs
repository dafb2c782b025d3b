//! The last polish: measured points against the planes of the model, at full resolution.
//!
//! Point to plane (Chen & Medioni 1992) of each *measured* point against the model point nearest to it, with Tukey's biweight
//! (Beaton & Tukey 1974). What holds a pose along its faces has no part in it: that is handed in as an information about the start.

use nalgebra::{Isometry3, Matrix6, Point3, Vector3, Vector6};

use super::slip::{jacobian, motion_between, moved};
use crate::kernels::nearby::Nearby;

/// Points on the surface of a model, in its frame, and the planes that they lie in.
#[derive(Debug, Clone, Copy)]
pub struct Faces<'a> {
    /// The points.
    pub points: &'a [Point3<f64>],
    /// Outward unit normals, one for each.
    pub normals: &'a [Vector3<f64>],
    /// Finds the points, within a voxel at least.
    pub nearby: &'a Nearby,
    /// How far apart they lie, data units.
    pub spacing: f64,
}

/// A measured point, and a unit vector from there to the eye that measured it; target's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
#[allow(missing_docs)]
pub struct Measured {
    pub at: Point3<f64>,
    pub to_eye: Vector3<f64>,
}

/// A measured point that a pose explains.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Touch {
    /// How far it lies in front of the plane, data units.
    pub gap: f64,
    /// Of the plane, target's frame.
    pub normal: Vector3<f64>,
}

/// What holds a pose but for the planes, and how far it may go.
#[derive(Debug, Clone, Copy)]
pub struct Hold {
    /// Centre of the model, in its frame, and how far its points lie from there at most.
    pub centre: Point3<f64>,
    /// See `centre`.
    pub size: f64,
    /// Information on a motion from the start, about the moved centre.
    pub information: Matrix6<f64>,
    /// How far off its plane a point may lie, data units.
    pub across: f64,
    /// No point of the model is moved farther, data units.
    pub most: f64,
    /// Standard deviation of a measured point across its surface, data units: at least so much is made of what lies off.
    pub noise: f64,
}

/// A polished pose.
#[derive(Debug, Clone, PartialEq)]
pub struct Polished {
    /// The pose.
    pub target_from_source: Isometry3<f64>,
    /// What each measured point is to it; `None`: nothing, or too far off to count.
    pub touches: Vec<Option<Touch>>,
    /// Of a gap, from where on it counts nothing; data units.
    pub cutoff: f64,
}

/// What is seen more slantingly is measured badly: least cosine between a face and the way to the eye.
const MIN_FACING_COS: f64 = 0.25;

/// Tukey's: 95 % as good as least squares where nothing is foreign. In standard deviations.
const CUTOFF: f64 = 4.685;

/// Of a normal distribution, over the median of absolute values.
const DEVIATIONS_PER_MEDIAN: f64 = 1.4826;

const STEPS: u32 = 20;

/// A step that moves the model by less than this part of a standard deviation is the last one.
const AT_REST: f64 = 1e-3;

/// Fewer points say nothing.
pub const FEW: usize = 30;

/// To how many points of noise one counts: those of a camera share theirs with those around them.
const SHARED: f64 = 10.0;

/// What nothing holds is held where it is, by so much of a size.
const LOOSE: f64 = 0.1;

/// How each measured point lies on a model that a pose has moved: `None` where it lies more than `across` off the plane of the
/// nearest point of the model, or more than a spacing beside that point (the surface runs on beyond a rim), or where the plane
/// is turned away from the eye.
#[must_use]
pub fn touches(
    faces: &Faces<'_>,
    measured: &[Measured],
    target_from_source: &Isometry3<f64>,
    across: f64,
) -> Vec<Option<Touch>> {
    let back = target_from_source.inverse();
    let (turn_back, shift) = (back.rotation.to_rotation_matrix(), back.translation.vector);
    let turn = target_from_source.rotation.to_rotation_matrix();
    let points: Vec<Point3<f64>> = measured.iter().map(|ray| turn_back * ray.at + shift).collect();
    let distance = across.hypot(faces.spacing).min(faces.nearby.reach());
    let nearest = faces.nearby.nearest_each(distance, &points);
    let touch = |((point, ray), row): ((&Point3<f64>, &Measured), Option<u32>)| {
        let row = row? as usize;
        let off = point - faces.points[row];
        let gap = faces.normals[row].dot(&off);
        let aside_sq = off.norm_squared() - gap * gap;
        let normal = turn * faces.normals[row];
        let is_on = gap.abs() <= across && aside_sq <= faces.spacing * faces.spacing;
        (is_on && normal.dot(&ray.to_eye) > MIN_FACING_COS).then_some(Touch { gap, normal })
    };
    points.iter().zip(measured).zip(nearest).map(touch).collect()
}

/// How much a gap counts, 1 where there is none.
#[must_use]
pub fn weight(gap: f64, cutoff: f64) -> f64 {
    let part = (gap / cutoff).powi(2);
    if part < 1.0 { (1.0 - part).powi(2) } else { 0.0 }
}

/// Tukey's loss: the mean over all points of 1 - (1 - (gap / cutoff)^2)^3, and of 1 for what is not explained.
#[must_use]
pub fn loss(touches: &[Option<Touch>], cutoff: f64) -> f64 {
    let of = |touch: &Option<Touch>| {
        touch.map_or(1.0, |touch| 1.0 - (1.0 - (touch.gap / cutoff).powi(2)).max(0.0).powi(3))
    };
    touches.iter().map(of).sum::<f64>() / touches.len().max(1) as f64
}

/// Polishes a pose; of all that it comes by, the one of the least [`loss`] and pull of the `hold`. `None` where fewer than 30 points are
/// explained.
///
/// The loss is measured with one cutoff and on the same points throughout: no pose is returned that is worse than the start.
///
/// # Complexity
/// O(points) a step, 20 steps at most.
#[must_use]
pub fn polish(
    faces: &Faces<'_>,
    measured: &[Measured],
    start: &Isometry3<f64>,
    hold: &Hold,
) -> Option<Polished> {
    let at = |pose: &Isometry3<f64>| touches(faces, measured, pose, hold.across);
    let mut found = at(start);
    let mut cutoff = cutoff_of(&found, hold.noise)?;
    let mut pose = *start;
    // The scale is known once the pose has settled a little.
    for _ in 0..STEPS / 4 {
        pose = step(measured, &found, &pose, start, hold, cutoff)?;
        found = at(&pose);
        cutoff = cutoff_of(&found, hold.noise)?;
    }
    let scale = (cutoff / CUTOFF).powi(2);
    let value = |pose: &Isometry3<f64>, found: &[Option<Touch>]| {
        let pull = motion_between(start, pose, &(start * hold.centre));
        // Of the loss times c^2 / 6 the gap's square is twice: so both are in chances.
        let num = measured.len() as f64;
        num * loss(found, cutoff) * CUTOFF * CUTOFF / (3.0 * SHARED) + (hold.information * pull).dot(&pull)
    };
    let first = at(start);
    let mut best = (value(start, &first), *start, first);
    for _ in 0..STEPS {
        let is_near = displacement(start, &pose, hold) <= hold.most;
        let now = value(&pose, &found);
        if now < best.0 && is_near {
            best = (now, pose, found.clone());
        }
        let next = step(measured, &found, &pose, start, hold, cutoff)?;
        let way = displacement(&pose, &next, hold);
        pose = next;
        found = at(&pose);
        if way < AT_REST * scale.sqrt() || !is_near {
            break;
        }
    }
    if value(&pose, &found) < best.0 && displacement(start, &pose, hold) <= hold.most {
        best = (0.0, pose, found);
    }
    let (_, target_from_source, mut touches) = best;
    for touch in &mut touches {
        *touch = touch.filter(|touch| touch.gap.abs() < cutoff);
    }
    let is_enough = touches.iter().flatten().count() >= FEW;
    is_enough.then_some(Polished { target_from_source, touches, cutoff })
}

/// The information of polished points on a motion about `centre`, as if the error of each were its own: of a robust fit (Huber
/// 1964), (mean slope)^2 / mean square of what counts of the gaps, for each point.
#[must_use]
pub fn information(measured: &[Measured], polished: &Polished, centre: &Point3<f64>) -> Matrix6<f64> {
    let (mut planes, mut weights, mut slope, mut square) = (Matrix6::zeros(), 0.0, 0.0, 0.0);
    for (ray, touch) in measured.iter().zip(&polished.touches) {
        let Some(Touch { gap, normal }) = *touch else { continue };
        let (weight, part) = (weight(gap, polished.cutoff), (gap / polished.cutoff).powi(2));
        let j = jacobian(&ray.at, &normal, centre);
        planes.syger(weight, &j, &j, 1.0);
        weights += weight;
        slope += (1.0 - part) * (1.0 - 5.0 * part);
        square += (weight * gap).powi(2);
    }
    planes.fill_upper_triangle_with_lower_triangle();
    let strength = if square > 0.0 { slope.max(0.0).powi(2) / square } else { 0.0 };
    planes * (strength / f64::max(weights, f64::MIN_POSITIVE))
}

/// No point of the model is moved farther by going from one pose to another.
fn displacement(a: &Isometry3<f64>, b: &Isometry3<f64>, hold: &Hold) -> f64 {
    (a * hold.centre - b * hold.centre).norm() + hold.size * a.rotation.angle_to(&b.rotation)
}

fn cutoff_of(touches: &[Option<Touch>], noise: f64) -> Option<f64> {
    let mut gaps: Vec<f64> = touches.iter().flatten().map(|touch| touch.gap.abs()).collect();
    let middle = gaps.len() / 2;
    if gaps.len() < FEW {
        return None;
    }
    let median = *gaps.select_nth_unstable_by(middle, f64::total_cmp).1;
    let deviation = (DEVIATIONS_PER_MEDIAN * median).max(noise);
    (deviation > 0.0).then_some(CUTOFF * deviation)
}

/// A weighted Gauss-Newton step.
fn step(
    measured: &[Measured],
    touches: &[Option<Touch>],
    pose: &Isometry3<f64>,
    start: &Isometry3<f64>,
    hold: &Hold,
    cutoff: f64,
) -> Option<Isometry3<f64>> {
    let centre = pose * hold.centre;
    let per_point = SHARED * (cutoff / CUTOFF).powi(2);
    let (mut hessian, mut gradient) = (Matrix6::zeros(), Vector6::zeros());
    for (ray, touch) in measured.iter().zip(touches) {
        let Some(Touch { gap, normal }) = touch else { continue };
        let j = jacobian(&ray.at, normal, &centre);
        let weight = weight(*gap, cutoff) / per_point;
        hessian.syger(weight, &j, &j, 1.0);
        gradient.axpy(weight * gap, &j, 1.0);
    }
    hessian.fill_upper_triangle_with_lower_triangle();
    let loose = (LOOSE * hold.size).powi(-2);
    let turn = loose * hold.size * hold.size;
    hessian += hold.information;
    hessian += Matrix6::from_diagonal(&Vector6::new(turn, turn, turn, loose, loose, loose));
    gradient += hold.information * motion_between(pose, start, &centre);
    let motion = hessian.cholesky()?.solve(&gradient);
    let next = moved(&motion, &centre, pose);
    next.to_homogeneous().iter().all(|x| x.is_finite()).then_some(next)
}
