//! Motions of a model that leave it looking the same: declared by who knows them, or found on its surface.
//!
//! Two poses that differ by one of them are the same to any eye: a tee turned by half a turn about its branch. So
//! errors are measured modulo symmetry, and of the poses that are the same the one nearest to a wanted one is chosen:
//! [`Symmetries::nearest`].

mod find;
mod group;
mod surface;

pub use find::{FindSymmetries, find_symmetries};

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use std::f64::consts::{PI, TAU};

use crate::checks::MAX_COORDINATE;
use crate::features::FeatureError;
use crate::kernels::rotation::angle_between;

/// The step in which BOP lists the turns about an axis: no point of the model moves farther than this part of its
/// diameter from one to the next (Hodan et al., "BOP challenge 2020 on 6D object localization").
pub const BOP_STEP: f64 = 0.01;

/// A line that the model may be turned about by any angle.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Axis {
    /// Of length 1.
    pub direction: Vector3<f64>,
    /// Any point of the line, in data units.
    pub point: Point3<f64>,
}

impl Axis {
    /// The turn about the line by an angle.
    #[must_use]
    pub fn turn(&self, angle_rad: f64) -> Isometry3<f64> {
        about(self.point, UnitQuaternion::from_scaled_axis(self.direction * angle_rad))
    }
}

/// The rotation, with `centre` where it was.
fn about(centre: Point3<f64>, rotation: UnitQuaternion<f64>) -> Isometry3<f64> {
    Isometry3::from_parts(Translation3::from(centre.coords - rotation * centre.coords), rotation)
}

/// What the model may be turned about by any angle.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Turning {
    /// Nothing.
    #[default]
    None,
    /// A line: a bottle.
    About(Axis),
    /// A point: a ball.
    Any(Point3<f64>),
}

/// The proper symmetries of a model, in its own frame: some motions, each followed by any turn about an axis if there is
/// one.
///
/// What is listed counts as it is and is not completed to a group: list all, as BOP does.
///
/// # Examples
/// ```
/// use ibi_core::nalgebra::{Isometry3, Vector3};
/// use ibi_core::{Symmetries, metrics::rotation_error_rad};
/// use std::f64::consts::PI;
///
/// let tee = Symmetries::new(&[Isometry3::rotation(Vector3::z() * PI)], &[])?;
/// let (pose, wanted) = (Isometry3::rotation(Vector3::z() * 3.0), Isometry3::identity());
/// assert!((rotation_error_rad(&tee.nearest(&pose, &wanted), &wanted) - (PI - 3.0)).abs() < 1e-12);
/// # Ok::<(), ibi_core::SymmetryError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Symmetries {
    discrete: Vec<Isometry3<f64>>,
    turning: Turning,
}

/// Why symmetries cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SymmetryError {
    /// A number that is NaN, infinite or huge.
    #[error("{argument}[{row}] must be finite")]
    NotFinite {
        /// Which list.
        argument: &'static str,
        /// Where in it.
        row: usize,
    },
    /// An axis without direction.
    #[error("continuous[{row}] has an axis of length 0")]
    NoDirection {
        /// Where in the list.
        row: usize,
    },
    /// Turns about lines that do not meet lead anywhere.
    #[error(
        "continuous[{row}] is a line that does not meet that of continuous[0]; all turns leave one point in place"
    )]
    Apart {
        /// Where in the list.
        row: usize,
    },
    /// A number of the search is out of its range.
    #[error("{argument} is {value}; it must be {allowed}")]
    Setting {
        /// The argument.
        argument: &'static str,
        /// The value given.
        value: f64,
        /// What is allowed.
        allowed: &'static str,
    },
    /// Too few points to show a shape.
    #[error("points has {len} rows that differ; at least {least} are needed")]
    TooFewPoints {
        /// How many there are.
        len: usize,
        /// How many there should be.
        least: usize,
    },
    /// The caller's token or clock has ended the search.
    #[error("interrupted")]
    Interrupted,
    /// Points or normals that cannot be used.
    #[error(transparent)]
    Cloud(FeatureError),
}

impl From<FeatureError> for SymmetryError {
    fn from(error: FeatureError) -> Self {
        match error {
            FeatureError::Interrupted => Self::Interrupted,
            error => Self::Cloud(error),
        }
    }
}

impl Default for Symmetries {
    fn default() -> Self {
        Self::none()
    }
}

impl Symmetries {
    /// Of a model that looks different from everywhere: the identity alone.
    #[must_use]
    pub fn none() -> Self {
        Self { discrete: vec![Isometry3::identity()], turning: Turning::None }
    }

    /// Motions, of which the identity need not be named, and axes. Axes that meet stand for all rotations about the
    /// point where they do.
    ///
    /// # Errors
    /// If a number is not finite, if an axis has no direction, if two axes do not meet.
    pub fn new(discrete: &[Isometry3<f64>], continuous: &[Axis]) -> Result<Self, SymmetryError> {
        let is_finite = |v: &Vector3<f64>| v.iter().all(|x| x.abs() < MAX_COORDINATE);
        if let Some(row) = discrete.iter().position(|motion| !is_finite(&motion.translation.vector)) {
            return Err(SymmetryError::NotFinite { argument: "discrete", row });
        }
        let mut turning = Turning::None;
        for (row, axis) in continuous.iter().enumerate() {
            if !is_finite(&axis.direction) || !is_finite(&axis.point.coords) {
                return Err(SymmetryError::NotFinite { argument: "continuous", row });
            }
            let direction = axis.direction.try_normalize(0.0).ok_or(SymmetryError::NoDirection { row })?;
            let axis = Axis { direction, ..*axis };
            turning = match turning {
                Turning::None => Turning::About(axis),
                Turning::About(first) => meeting(&first, &axis).ok_or(SymmetryError::Apart { row })?,
                Turning::Any(centre) if distance_to(&axis, &centre) > slack(&axis.point, &centre) => {
                    return Err(SymmetryError::Apart { row });
                }
                any @ Turning::Any(_) => any,
            };
        }
        let identity = Isometry3::identity();
        // From a matrix it comes with rounding.
        let is_identity =
            |m: &Isometry3<f64>| m.rotation.angle() < 1e-12 && m.translation.vector == Vector3::zeros();
        let others = discrete.iter().filter(|motion| !is_identity(motion));
        Ok(Self { discrete: [identity].iter().chain(others).copied().collect(), turning })
    }

    /// The motions that are listed, the identity first.
    #[must_use]
    pub fn discrete(&self) -> &[Isometry3<f64>] {
        &self.discrete
    }

    /// What the model may be turned about by any angle.
    #[must_use]
    pub fn turning(&self) -> &Turning {
        &self.turning
    }

    /// The axes: none, one, or three for a ball.
    #[must_use]
    pub fn continuous(&self) -> Vec<Axis> {
        match self.turning {
            Turning::None => Vec::new(),
            Turning::About(axis) => vec![axis],
            Turning::Any(point) => {
                [Vector3::x(), Vector3::y(), Vector3::z()].map(|direction| Axis { direction, point }).to_vec()
            }
        }
    }

    /// Whether the identity is all there is.
    #[must_use]
    pub fn is_none(&self) -> bool {
        self.discrete.len() == 1 && self.turning == Turning::None
    }

    /// Of the poses that look like `pose` the one turned least against `reference`; of equals the one listed first.
    ///
    /// By the rotation alone: a symmetry leaves the middle of the model where it is, so they all put it at one place.
    ///
    /// # Complexity
    /// O(s) in the number of motions; turns about an axis are solved for.
    #[must_use]
    pub fn nearest(&self, pose: &Isometry3<f64>, reference: &Isometry3<f64>) -> Isometry3<f64> {
        /// Below this, radians, two are equals.
        const EQUAL: f64 = 1e-9;
        let (mut best, mut least) = (*pose, f64::INFINITY);
        for motion in &self.discrete {
            let other = match self.turning {
                Turning::None => pose * motion,
                Turning::About(axis) => {
                    // |w| of (D R^-1 P) C(2 h) is to be largest, (w, v) being the bracket: w cos h - v.u sin h.
                    let q = motion.rotation * reference.rotation.inverse() * pose.rotation;
                    let half = (-q.imag().dot(&axis.direction)).atan2(q.w);
                    pose * axis.turn(2.0 * half) * motion
                }
                Turning::Any(centre) => {
                    let turned = reference.rotation;
                    let shift = (pose * centre).coords - turned * centre.coords;
                    Isometry3::from_parts(Translation3::from(shift), turned)
                }
            };
            let error = angle_between(&other.rotation, &reference.rotation);
            if error < least - EQUAL {
                (best, least) = (other, error);
            }
        }
        best
    }

    /// All of them as a list, the identity first: turns about an axis in steps small enough that no point within half a
    /// diameter of it moves more than `max_step` diameters, as BOP lists them with [`BOP_STEP`]. Of a ball's the turns
    /// about three axes only.
    ///
    /// # Errors
    /// If `max_step` is not in 1e-5 to 1.
    pub fn discretised(&self, max_step: f64) -> Result<Vec<Isometry3<f64>>, SymmetryError> {
        if !(1e-5..=1.0).contains(&max_step) {
            let allowed = "from 1e-5 to 1";
            return Err(SymmetryError::Setting { argument: "max_step", value: max_step, allowed });
        }
        Ok(self.listed(max_step))
    }

    /// [`Self::discretised`] by a step that is in its range.
    pub(crate) fn listed(&self, max_step: f64) -> Vec<Isometry3<f64>> {
        let count = (PI / max_step).ceil() as u32;
        let axes = self.continuous();
        let turns = axes
            .iter()
            .flat_map(|axis| (1..count).map(move |k| axis.turn(TAU * f64::from(k) / f64::from(count))));
        [Isometry3::identity()]
            .into_iter()
            .chain(turns)
            .flat_map(|turn| self.discrete.iter().map(move |motion| turn * motion))
            .collect()
    }
}

fn distance_to(axis: &Axis, point: &Point3<f64>) -> f64 {
    (point - axis.point).cross(&axis.direction).norm()
}

/// How far apart lines may be that are meant to meet: declared numbers are rounded.
fn slack(a: &Point3<f64>, b: &Point3<f64>) -> f64 {
    1e-6 + 1e-3 * (a - b).norm()
}

/// What two lines are together; `None` if they do not meet.
fn meeting(a: &Axis, b: &Axis) -> Option<Turning> {
    let between = b.point - a.point;
    let across = a.direction.cross(&b.direction);
    let slack = slack(&a.point, &b.point);
    if across.norm() < 1e-3 {
        return (distance_to(a, &b.point) <= slack).then_some(Turning::About(*a));
    }
    let gap = between.dot(&across) / across.norm();
    let along = between.cross(&b.direction).dot(&across) / across.norm_squared();
    (gap.abs() <= slack).then(|| Turning::Any(a.point + a.direction * along))
}
