//! Refinement of a pose on the two clouds: iterative closest points (Besl & McKay 1992; point-to-plane: Chen &
//! Medioni 1992).

use nalgebra::{Isometry3, Matrix6, Point3, Translation3, UnitQuaternion, Vector3, Vector6};

use super::kabsch::rigid_fit;
use super::neighbors::Neighbors;
use super::overlap::{Contact, Place, Surface, places};

/// Largest turn of one step, in radians: beyond it the linearisation is worth nothing.
const MAX_TURN_RAD: f64 = 0.2;

/// Damping relative to the mean curvature: what the surface does not hold (a plane slides) stays where it is.
const DAMPING: f64 = 1e-3;

/// Polishes `start` in at most `steps` steps and returns the pose with the least cost among all it came by: the
/// mean over the visible source points of min(d, distance)^2, d being the distance to the target (to its tangent
/// planes where there are normals). So it is never worse than its start by its own measure.
#[must_use]
pub fn icp(
    source: &Surface<'_>,
    target: &Surface<'_>,
    neighbors: &Neighbors,
    start: &Isometry3<f64>,
    contact: &Contact,
    steps: u32,
) -> Isometry3<f64> {
    let (mut pose, mut best) = (*start, (f64::INFINITY, *start));
    for step in 0..=steps {
        let places = places(source, target, neighbors, &pose, contact);
        let cost = cost(source, target, &pose, contact, &places);
        if cost < best.0 {
            best = (cost, pose);
        }
        if step == steps {
            break;
        }
        let next = match target.normals {
            Some(normals) => to_planes(source, target.points, normals, &pose, contact, &places),
            None => rigid_fit(on(&places).map(|(i, row)| (&source.points[i], &target.points[row]))),
        };
        match next {
            Some(next) => pose = next,
            None => break,
        }
    }
    best.1
}

/// (source row, target row) of the points in contact.
fn on(places: &[Place]) -> impl Iterator<Item = (usize, usize)> + Clone + '_ {
    places.iter().enumerate().filter_map(|(i, place)| match place {
        Place::On(row) => Some((i, *row as usize)),
        _ => None,
    })
}

fn cost(
    source: &Surface<'_>,
    target: &Surface<'_>,
    pose: &Isometry3<f64>,
    contact: &Contact,
    places: &[Place],
) -> f64 {
    let distance_sq = contact.distance * contact.distance;
    let visible = places.iter().filter(|&&place| place != Place::Hidden).count();
    let touching = on(places).map(|(i, row)| {
        let gap = pose * source.points[i] - target.points[row];
        let d_sq = target.normals.map_or(gap.norm_squared(), |normals| gap.dot(&normals[row]).powi(2));
        d_sq - distance_sq
    });
    touching.sum::<f64>() / visible.max(1) as f64 + distance_sq
}

/// One damped Gauss-Newton step of the point-to-plane distances.
fn to_planes(
    source: &Surface<'_>,
    target: &[Point3<f64>],
    normals: &[Vector3<f64>],
    pose: &Isometry3<f64>,
    contact: &Contact,
    places: &[Place],
) -> Option<Isometry3<f64>> {
    let num = on(places).count();
    if num < 6 {
        return None;
    }
    // Turning about the centre of the contact keeps rotation and translation apart.
    let centre = on(places).map(|(i, _)| (pose * source.points[i]).coords).sum::<Vector3<f64>>() / num as f64;
    let (mut hessian, mut gradient) = (Matrix6::zeros(), Vector6::zeros());
    for (i, row) in on(places) {
        let moved = pose * source.points[i];
        let normal = normals[row];
        let turn = (moved.coords - centre).cross(&normal);
        // Rotation is measured in arcs of the contact distance, so that both halves have one scale.
        let turn = turn / contact.distance;
        let jacobian = Vector6::new(turn.x, turn.y, turn.z, normal.x, normal.y, normal.z);
        hessian += jacobian * jacobian.transpose();
        gradient += jacobian * (moved - target[row]).dot(&normal);
    }
    hessian += Matrix6::identity() * (DAMPING * hessian.trace() / 6.0);
    let step = -hessian.cholesky()?.solve(&gradient);
    let turn = Vector3::new(step[0], step[1], step[2]) / contact.distance;
    let shift = Vector3::new(step[3], step[4], step[5]);
    let turn = turn * (MAX_TURN_RAD / turn.norm()).min(1.0);
    let shift = shift * (contact.distance / shift.norm()).min(1.0);
    let rotation = UnitQuaternion::from_scaled_axis(turn);
    let moved = Isometry3::from_parts(Translation3::from(centre + shift - rotation * centre), rotation);
    let next = moved * pose;
    next.to_homogeneous().iter().all(|x| x.is_finite()).then_some(next)
}
