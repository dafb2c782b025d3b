//! The symmetries of a surface: it is moved onto itself.

use nalgebra::{Isometry3, Matrix3, Point3, UnitQuaternion, Vector3};
use std::f64::consts::{PI, TAU};

use super::group::{SAME_RAD, closure, find};
use super::surface::{REACH, Shape};
use super::{Axis, Symmetries, SymmetryError, about};
use crate::interrupt::{Interrupt, Phase};

/// How [`find_symmetries`] goes about it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FindSymmetries {
    /// How far the moved surface may be off the unmoved one, in diameters: 98 % of its points by no more than this, none
    /// by more than twice of it. From 0.001 to 0.05. Points thinned to 1/24 of the diameter are worth 0.03 and no less;
    /// denser ones tell finer details.
    pub tolerance: f64,
}

impl Default for FindSymmetries {
    fn default() -> Self {
        Self { tolerance: 0.03 }
    }
}

/// Directions of the axes that are looked at: 7 degrees apart.
const DIRECTIONS: u32 = 400;
/// Every finite group of rotations but those about one axis has members of two or three of these orders, and turns by the
/// last angle, as good as any other, have no order: those of bodies of revolution. Orders beyond these are looked for about
/// the axes found and the principal ones, on which they must lie unless all directions of the spread are equal.
const ANGLES: [f64; 5] = [PI, TAU / 3.0, TAU / 4.0, TAU / 5.0, 2.399_963_229_728_653];
/// How many of the best directions are polished, for each angle, and how far apart they are.
const STARTS: usize = 12;
const APART_RAD: f64 = 0.2;
/// The highest order that is told from turns by any angle.
const MOST_FOLD: u32 = 24;
/// A candidate whose points are off by more on average, in diameters, is not polished.
const HOPELESS: f64 = 0.05;
/// Two axes nearer than this are one; the same is what is allowed between an axis and the right angle to another.
const SAME_AXIS_RAD: f64 = 0.1;
/// Turns by these, radians, are all there for a body of revolution and for no other: none is near a half, a third ... of
/// a turn, and no two differ by one.
const GENERIC: [f64; 6] = [0.43, 0.71, 1.27, 1.93, 2.63, 2.95];

/// The rotations that leave a surface as it is, within a tolerance: about how it looks to a depth camera.
///
/// Starts about many axes are polished by ICP of the surface with itself, the best checked on all points, and completed to
/// the largest group of which every member passes: the identity alone, finite, or with turns by any angle. The members are
/// a group to rounding. Reflections are none: no part can be moved so.
///
/// `normals` of either sign, one per point, help; without them they are estimated. Of more than 8000 points one a voxel
/// is looked at.
///
/// # Errors
/// If there are fewer than 10 points, a value is not finite, a normal has no length or there is not one for each point, or
/// the tolerance is out of its range. [`SymmetryError::Interrupted`].
///
/// # Complexity
/// About 0.1 to 0.3 s, for up to 8000 points and for more.
///
/// # Examples
/// ```
/// use ibi_core::nalgebra::Point3;
/// use ibi_core::{FindSymmetries, Interrupt, find_symmetries};
///
/// // A box of 4 x 3 x 2, its faces full of points: three half turns.
/// let mut points = Vec::new();
/// for a in 0..16 {
///     for b in 0..16 {
///         let (u, v) = (f64::from(a) / 15.0 - 0.5, f64::from(b) / 15.0 - 0.5);
///         for side in [-0.5, 0.5] {
///             points.extend([[u, v, side], [u, side, v], [side, u, v]].map(|[x, y, z]| Point3::new(4.0 * x, 3.0 * y, 2.0 * z)));
///         }
///     }
/// }
/// let found = find_symmetries(&points, None, FindSymmetries::default(), &Interrupt::never())?;
/// assert_eq!(found.discrete().len(), 4);
/// # Ok::<(), ibi_core::SymmetryError>(())
/// ```
pub fn find_symmetries(
    points: &[Point3<f64>],
    normals: Option<&[Vector3<f64>]>,
    settings: FindSymmetries,
    interrupt: &Interrupt,
) -> Result<Symmetries, SymmetryError> {
    let tolerance = settings.tolerance;
    if !(0.001..=0.5 * REACH).contains(&tolerance) {
        let allowed = "from 0.001 to 0.05 diameters";
        return Err(SymmetryError::Setting { argument: "tolerance", value: tolerance, allowed });
    }
    if !interrupt.enter(Phase::Symmetries) {
        return Err(SymmetryError::Interrupted);
    }
    let shape = Shape::new(points, normals, interrupt)?;
    let search = Search { shape: &shape, tolerance, interrupt };
    let found = search.find();
    // What was found meanwhile is not all.
    if interrupt.is_set() { Err(SymmetryError::Interrupted) } else { found }
}

impl Search<'_> {
    /// All of them, back at the place and in the size of the model.
    fn find(&self) -> Result<Symmetries, SymmetryError> {
        let (search, shape) = (self, self.shape);
        let motions = sorted(search.low_order());

        let axes = search.continuous(&motions);
        let place = |p: Point3<f64>| shape.centre + shape.size * p.coords;
        let Some(first) = axes.first() else {
            let motions = sorted([search.high_order(&motions), motions].concat());
            let (centre, group) = search.group(&motions);
            let motions: Vec<_> = group.iter().map(|turn| about(place(centre), *turn)).collect();
            return Symmetries::new(&motions, &[]);
        };
        if let Some(other) = axes.get(1) {
            // Two bodies of revolution in one are a ball; its middle is where the axes come closest.
            let middle = crossing(first, other);
            let axes = [Vector3::x(), Vector3::y()].map(|direction| Axis { direction, point: place(middle) });
            return Symmetries::new(&[], &axes);
        }
        let flip = search.flip(&motions, first);
        // Of the points on the axis the one that stays where it is.
        let middle = flip.map_or(first.point, |(_, centre)| centre);
        let axis = Axis { direction: first.direction, point: place(middle) };
        let motions: Vec<_> = flip.iter().map(|(turn, _)| about(axis.point, *turn)).collect();
        Symmetries::new(&motions, &[axis])
    }
}

/// The best first.
fn sorted(mut motions: Vec<Motion>) -> Vec<Motion> {
    motions.sort_by(|a, b| a.deviation.total_cmp(&b.deviation));
    motions
}

/// A motion that passed.
#[derive(Debug, Clone, Copy)]
struct Motion {
    motion: Isometry3<f64>,
    deviation: f64,
}

impl Motion {
    /// Of its rotation; not asked of the identity.
    fn direction(&self) -> Vector3<f64> {
        self.motion.rotation.axis().map_or_else(Vector3::z, nalgebra::Unit::into_inner)
    }

    /// The line that stays where it is, but for a shift along it.
    fn axis(&self) -> Axis {
        let (direction, shift) = (self.direction(), self.motion.translation.vector);
        let across = shift - direction * shift.dot(&direction);
        let half = 0.5 * self.motion.rotation.angle();
        let point = 0.5 * (across + direction.cross(&across) * (half.cos() / half.sin()));
        Axis { direction, point: point.into() }
    }
}

struct Search<'a> {
    shape: &'a Shape,
    tolerance: f64,
    interrupt: &'a Interrupt,
}

impl Search<'_> {
    /// A start, polished and checked; `None` if it fails, comes to the identity or is known.
    fn tried(&self, start: &Isometry3<f64>, known: &[Motion]) -> Option<Motion> {
        if self.interrupt.is_set() {
            return None;
        }
        let motion = self.shape.refined(start);
        let is_known = || known.iter().any(|m| m.motion.rotation.angle_to(&motion.rotation) < SAME_RAD);
        if motion.rotation.angle() < 2.0 * SAME_RAD || is_known() {
            return None;
        }
        let deviation = self.shape.deviation(&motion);
        (deviation <= self.tolerance).then_some(Motion { motion, deviation })
    }

    fn passes(&self, motion: &Isometry3<f64>) -> bool {
        !self.interrupt.is_set() && self.shape.deviation(motion) <= self.tolerance
    }

    /// Motions of low order about any axis.
    fn low_order(&self) -> Vec<Motion> {
        let principal = self.shape.principal_axes();
        let mut found: Vec<Motion> = Vec::new();
        for angle in ANGLES {
            if self.interrupt.is_set() {
                break;
            }
            let start = |direction: &Vector3<f64>| {
                Isometry3::rotation(direction * angle) // about the mean of the points
            };
            let mut ranked: Vec<(f64, Vector3<f64>)> =
                half_sphere().map(|direction| (self.shape.glance(&start(&direction)), direction)).collect();
            ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
            let mut starts: Vec<Vector3<f64>> = Vec::new();
            for (off, direction) in ranked {
                if starts.len() == STARTS || off > 2.0 * HOPELESS {
                    break;
                }
                if starts.iter().all(|other| between(other, &direction) > APART_RAD) {
                    starts.push(direction);
                }
            }
            for direction in principal.iter().chain(&starts) {
                found.extend(self.tried(&start(direction), &found));
            }
        }
        found
    }

    /// Motions of high order about the principal axes and those of the motions found.
    fn high_order(&self, found: &[Motion]) -> Vec<Motion> {
        let principal =
            self.shape.principal_axes().map(|direction| Axis { direction, point: Point3::origin() });
        let mut axes: Vec<Axis> = Vec::new();
        for axis in found.iter().map(Motion::axis).chain(principal) {
            if axes.iter().all(|other| between(&other.direction, &axis.direction) > SAME_AXIS_RAD) {
                axes.push(axis);
            }
        }
        let mut all = found.to_vec();
        for axis in axes {
            for fold in 3..=MOST_FOLD {
                let start = axis.turn(TAU / f64::from(fold));
                if self.shape.glance(&start) <= HOPELESS {
                    let more = self.tried(&start, &all);
                    all.extend(more);
                }
            }
        }
        all.split_off(found.len())
    }

    /// Axes about which any turn passes: no more than two, as a ball has all.
    fn continuous(&self, motions: &[Motion]) -> Vec<Axis> {
        let passes = |axis: &Axis, angle: f64| self.passes(&axis.turn(angle));
        let (mut axes, mut looked_at): (Vec<Axis>, Vec<Axis>) = (Vec::new(), Vec::new());
        for axis in motions.iter().map(Motion::axis) {
            let is_same = |other: &Axis| between(&other.direction, &axis.direction) < SAME_AXIS_RAD;
            if axes.len() == 2 || looked_at.iter().any(is_same) {
                continue;
            }
            looked_at.push(axis);
            if GENERIC.iter().all(|&angle| passes(&axis, angle)) {
                axes.push(mean_axis(&axis, motions));
            }
        }
        axes
    }

    /// Half a turn across the axis of a body of revolution, and the point of the axis that it leaves in place.
    fn flip(&self, motions: &[Motion], axis: &Axis) -> Option<(UnitQuaternion<f64>, Point3<f64>)> {
        let u = axis.direction;
        let across = u.cross(&if u.x.abs() < 0.6 { Vector3::x() } else { Vector3::y() }).normalize();
        let start = Isometry3::rotation(across * PI);
        let is_flip = |m: &&Motion| (m.motion.rotation * u).dot(&u) < -(SAME_AXIS_RAD.cos());
        let found = motions.iter().find(is_flip).copied().or_else(|| self.tried(&start, &[]))?;
        if !is_flip(&&found) {
            return None;
        }
        // A flip sends s along the axis to 2 m - s: m is the middle.
        let middle = 0.5 * (axis.point.coords.dot(&u) + (found.motion * axis.point).coords.dot(&u));
        let centre = axis.point + u * (middle - axis.point.coords.dot(&u));
        let turn = UnitQuaternion::from_scaled_axis(across * PI);
        self.passes(&about(centre, turn)).then_some((turn, centre))
    }

    /// The largest group that grows from the best motions, all of whose members pass; and the point they leave in place.
    fn group(&self, motions: &[Motion]) -> (Point3<f64>, Vec<UnitQuaternion<f64>>) {
        let mut group = vec![UnitQuaternion::identity()];
        let mut centre = Point3::origin();
        let mut members: Vec<&Motion> = Vec::new();
        for motion in motions {
            if find(&group, &motion.motion.rotation).is_some() {
                continue;
            }
            let Some(larger) = closure(&group, whole_fraction(&motion.motion.rotation)) else { continue };
            members.push(motion);
            let about_centre = fixed_point(&members);
            let passes = |turn: &UnitQuaternion<f64>| self.passes(&about(about_centre, *turn));
            if larger.iter().skip(1).all(passes) {
                (group, centre) = (larger, about_centre);
            } else {
                members.pop();
            }
        }
        (centre, group)
    }
}

/// Directions spread evenly over half of the sphere: an axis and its opposite are one (a Fibonacci lattice).
fn half_sphere() -> impl Iterator<Item = Vector3<f64>> {
    let golden = PI * (1.0 + 5_f64.sqrt());
    (0..DIRECTIONS).map(move |k| {
        let k = f64::from(k) + 0.5;
        let z = 1.0 - k / f64::from(DIRECTIONS);
        let (radius, angle) = ((1.0 - z * z).sqrt(), golden * k);
        Vector3::new(radius * angle.cos(), radius * angle.sin(), z)
    })
}

/// The angle between two lines, in 0 to pi / 2.
fn between(a: &Vector3<f64>, b: &Vector3<f64>) -> f64 {
    a.cross(b).norm().atan2(a.dot(b).abs())
}

/// The axis as all motions about it see it.
fn mean_axis(axis: &Axis, motions: &[Motion]) -> Axis {
    let (mut direction, mut point, mut count) = (Vector3::zeros(), Vector3::zeros(), 0.0);
    for other in motions.iter().map(Motion::axis) {
        let sign = other.direction.dot(&axis.direction).signum();
        if between(&other.direction, &axis.direction) < 0.5 * SAME_AXIS_RAD {
            direction += sign * other.direction;
            point += other.point.coords;
            count += 1.0;
        }
    }
    let direction = direction.normalize();
    let point = point / count;
    // Next to the mean of the points.
    Axis { direction, point: Point3::from(point - direction * point.dot(&direction)) }
}

/// The middle between the two points where lines come closest.
fn crossing(a: &Axis, b: &Axis) -> Point3<f64> {
    let across = a.direction.cross(&b.direction);
    let between = b.point - a.point;
    let [s, t] = [b.direction, a.direction].map(|d| between.cross(&d).dot(&across) / across.norm_squared());
    nalgebra::center(&(a.point + a.direction * s), &(b.point + b.direction * t))
}

/// The rotation by the nearest k / n of a turn, n as small as can be; as it is if none is near.
fn whole_fraction(rotation: &UnitQuaternion<f64>) -> UnitQuaternion<f64> {
    const NEAR_RAD: f64 = 0.02;
    let (angle, Some(axis)) = (rotation.angle(), rotation.axis()) else { return *rotation };
    let fractions = (2..=MOST_FOLD).map(|fold| {
        let part = TAU / f64::from(fold);
        (angle / part).round() * part
    });
    let nearest = fractions.into_iter().find(|whole| (whole - angle).abs() < NEAR_RAD);
    UnitQuaternion::from_axis_angle(&axis, nearest.unwrap_or(angle))
}

/// The point that motions leave in place, or nearly so; next to the mean of the points where they leave a line.
fn fixed_point(motions: &[&Motion]) -> Point3<f64> {
    /// Holds what the motions do not.
    const TO_MEAN: f64 = 1e-3;
    let (mut normal, mut right) = (Matrix3::identity() * TO_MEAN, Vector3::zeros());
    for Motion { motion, .. } in motions {
        let stays = Matrix3::identity() - motion.rotation.to_rotation_matrix().into_inner();
        normal += stays.transpose() * stays;
        right += stays.transpose() * motion.translation.vector;
    }
    normal.cholesky().map_or_else(Point3::origin, |factors| factors.solve(&right).into())
}
