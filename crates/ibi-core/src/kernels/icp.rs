//! Refinement of a pose on the two clouds: iterative closest points (Besl & McKay 1992; point-to-plane: Chen &
//! Medioni 1992).

use nalgebra::{Isometry3, Matrix6, Point3, Translation3, UnitQuaternion, Vector3, Vector6};

use super::kabsch::rigid_fit;
use super::nearby::Nearby;
use super::overlap::{Contact, Place, Surface, places, visible};

/// Largest turn of one step, in radians: beyond it the linearisation is worth nothing.
const MAX_TURN_RAD: f64 = 0.2;

/// Damping relative to the mean curvature: what the surface does not hold (a plane slides) stays where it is.
const DAMPING: f64 = 1e-3;

/// Polishes `start` until `stop` and returns the pose with the least cost among all it came by: the mean over the visible
/// source points of min(d, distance)^2, d being the distance to the target (to its tangent planes where there are
/// normals). So it is never worse than its start by its own measure, but for rounding.
#[must_use]
pub fn icp(
    source: &Surface<'_>,
    target: &Surface<'_>,
    nearby: &Nearby,
    start: &Isometry3<f64>,
    contact: &Contact<'_>,
    stop: Stop,
) -> Isometry3<f64> {
    // What can be seen hardly changes on the way.
    if let Some(view) = contact.view.filter(|_| contact.oriented && source.normals.is_some()) {
        let rows = visible(source, &view, start, contact.distance, stop.max_visible);
        let points: Vec<Point3<f64>> = rows.iter().map(|&row| source.points[row as usize]).collect();
        let normals: Option<Vec<Vector3<f64>>> =
            source.normals.map(|normals| rows.iter().map(|&row| normals[row as usize]).collect());
        let seen = Surface { points: &points, normals: normals.as_deref() };
        return icp(&seen, target, nearby, start, &Contact { view: None, ..*contact }, stop);
    }
    let (mut pose, mut best) = (*start, (f64::INFINITY, *start));
    let mut has_come_to_rest = false;
    for step in 0..=stop.steps {
        let is_last = step == stop.steps || has_come_to_rest;
        // No step of point-to-point makes the cost greater: there it is not measured.
        if is_last && target.normals.is_none() {
            break;
        }
        let places = places(source, target, nearby, &pose, contact);
        let next = if let Some(normals) = target.normals {
            let cost = cost(source, target, normals, &pose, contact, &places);
            if cost < best.0 {
                best = (cost, pose);
            }
            if is_last {
                break;
            }
            to_planes(source, target.points, normals, &pose, contact, &places)
        } else {
            rigid_fit(on(&places).map(|(i, row)| (&source.points[i], &target.points[row])))
        };
        let Some(next) = next else { break };
        has_come_to_rest = is_same(&pose, &next, source, stop.shift * contact.distance);
        pose = next;
    }
    if target.normals.is_some() { best.1 } else { pose }
}

/// When a refinement ends.
#[derive(Debug, Clone, Copy)]
pub struct Stop {
    /// After so many steps.
    pub steps: u32,
    /// With a camera: of the source points that it may see at the start, at most so many take part.
    pub max_visible: usize,
    /// After a step that moves the source by less than this share of the contact distance.
    pub shift: f64,
}

impl Stop {
    /// All visible points take part.
    #[must_use]
    pub fn new(steps: u32, shift: f64) -> Self {
        Self { steps, max_visible: usize::MAX, shift }
    }
}

/// Whether two poses move the source less than `distance` apart.
fn is_same(a: &Isometry3<f64>, b: &Isometry3<f64>, source: &Surface<'_>, distance: f64) -> bool {
    let (Some(first), Some(last)) = (source.points.first(), source.points.last()) else { return true };
    let middle = source.points[source.points.len() / 2];
    [*first, middle, *last].iter().all(|p| (a * p - b * p).norm() < distance)
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
    normals: &[Vector3<f64>],
    pose: &Isometry3<f64>,
    contact: &Contact<'_>,
    places: &[Place],
) -> f64 {
    let distance_sq = contact.distance * contact.distance;
    let visible = places.iter().filter(|&&place| place != Place::Hidden).count();
    let touching = on(places).map(|(i, row)| {
        let gap = pose * source.points[i] - target.points[row];
        gap.dot(&normals[row]).powi(2) - distance_sq
    });
    touching.sum::<f64>() / visible.max(1) as f64 + distance_sq
}

/// One damped Gauss-Newton step of the point-to-plane distances.
fn to_planes(
    source: &Surface<'_>,
    target: &[Point3<f64>],
    normals: &[Vector3<f64>],
    pose: &Isometry3<f64>,
    contact: &Contact<'_>,
    places: &[Place],
) -> Option<Isometry3<f64>> {
    let num = on(places).count();
    if num < 6 {
        return None;
    }
    // Turning about the centre of the contact keeps rotation and translation apart.
    let centre = on(places).map(|(i, _)| (pose * source.points[i]).coords).sum::<Vector3<f64>>() / num as f64;
    let (mut hessian, mut gradient) = ([[0.0; 6]; 6], [0.0; 6]);
    for (i, row) in on(places) {
        let moved = pose * source.points[i];
        let normal = normals[row];
        let turn = (moved.coords - centre).cross(&normal);
        // Rotation is measured in arcs of the contact distance, so that both halves have one scale.
        let turn = turn / contact.distance;
        let jacobian = [turn.x, turn.y, turn.z, normal.x, normal.y, normal.z];
        let gap = (moved - target[row]).dot(&normal);
        for (r, &j) in jacobian.iter().enumerate() {
            gradient[r] += j * gap;
            for (c, &k) in jacobian.iter().enumerate() {
                hessian[r][c] += j * k;
            }
        }
    }
    let mut hessian = Matrix6::from(hessian);
    let gradient = Vector6::from(gradient);
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
