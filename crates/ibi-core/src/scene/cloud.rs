//! One cloud: as it is handed in, and checked and prepared.

use std::borrow::Cow;
use std::f64::consts::FRAC_PI_2;
use std::sync::OnceLock;

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, UnitQuaternion, Vector3};

use crate::checks::{first_not_finite, unit_vectors};
use crate::detail::Detail;
use crate::error::{Argument, Error};
use crate::interrupt::{Interrupt, Phase};
use crate::kernels::columns::middle;
use crate::kernels::diameter::diameter;
use crate::kernels::nearby::spacing_until;
use crate::kernels::neighbors::Neighbors;
use crate::kernels::overlap::Surface;
use crate::kernels::rng::Rng;
use crate::kernels::sight::OwnShadow;
use crate::symmetries::Symmetries;

/// As many normals as points.
pub(crate) type PointsAndNormals = (Vec<Point3<f64>>, Vec<Vector3<f64>>);

/// A point cloud as a user hands it in: nothing is checked until a [`crate::Registrar`] takes it.
#[derive(Debug, Clone, Default)]
pub struct Cloud<'a> {
    pub(crate) points: Cow<'a, [Point3<f64>]>,
    pub(crate) normals: Option<Vec<Vector3<f64>>>,
    pub(crate) viewpoints: Vec<Point3<f64>>,
    pub(crate) measured: Measurement<'a>,
    pub(crate) frames: Option<Vec<Matrix3<f64>>>,
    pub(crate) symmetries: Symmetries,
    pub(crate) fine: Option<PointsAndNormals>,
}

impl<'a> Cloud<'a> {
    /// A cloud that borrows its points, in any unit of length (the same for both clouds).
    #[must_use]
    pub fn new(points: &'a [Point3<f64>]) -> Self {
        Self { points: Cow::Borrowed(points), ..Self::default() }
    }

    /// One normal per point; any length but 0.
    #[must_use]
    pub fn with_normals(mut self, normals: Vec<Vector3<f64>>) -> Self {
        self.normals = Some(normals);
        self
    }

    /// One local reference frame per point, its axes as rows: right-handed, and turning with the cloud.
    #[must_use]
    pub fn with_frames(mut self, frames: Vec<Matrix3<f64>>) -> Self {
        self.frames = Some(frames);
        self
    }

    /// More points of the surface that a source's are of, closer to each other, with the normals of the faces that they lie on:
    /// what poses are polished on at the end. By default the cloud itself.
    #[must_use]
    pub fn with_fine(mut self, points: Vec<Point3<f64>>, normals: Vec<Vector3<f64>>) -> Self {
        self.fine = Some((points, normals));
        self
    }

    /// What leaves a source looking the same: of two instances that differ by nothing else the one of the lesser score
    /// is dropped, whatever the parameters are. Without any, which is the default, nothing is.
    #[must_use]
    pub fn with_symmetries(mut self, symmetries: Symmetries) -> Self {
        self.symmetries = symmetries;
        self
    }

    /// Where the depth camera stood, in the frame of the points; for scenes seen from one side.
    #[must_use]
    pub fn with_viewpoint(mut self, viewpoint: Point3<f64>) -> Self {
        self.viewpoints = vec![viewpoint];
        self
    }

    /// Where several depth cameras stood, or one that went about: what one of them sees was seen.
    #[must_use]
    pub fn with_viewpoints(mut self, viewpoints: Vec<Point3<f64>>) -> Self {
        self.viewpoints = viewpoints;
        self
    }

    /// All that the camera at the viewpoint measured, or all of them together, where the cloud is only a part of it: thinned, or
    /// without the table. It tells where there is nothing, and what hides what. By default the cloud itself.
    #[must_use]
    pub fn with_measured(mut self, points: impl Into<Cow<'a, [Point3<f64>]>>) -> Self {
        self.measured.parts = vec![points.into()];
        self
    }

    /// The same, by camera: as many parts as there are viewpoints.
    #[must_use]
    pub fn with_measured_by_each(mut self, parts: Vec<Cow<'a, [Point3<f64>]>>) -> Self {
        self.measured.parts = parts;
        self
    }

    /// Outward normals of all that several cameras measured together, one per point, any length but 0: which of them saw a point is
    /// told by these.
    #[must_use]
    pub fn with_measured_normals(mut self, normals: Vec<Vector3<f64>>) -> Self {
        self.measured.normals = Some(normals);
        self
    }
}

/// All that the cameras at the viewpoints of a cloud measured.
#[derive(Debug, Clone, Default)]
pub(crate) struct Measurement<'a> {
    /// Of each, or of all in one; none if it is the cloud itself.
    pub(crate) parts: Vec<Cow<'a, [Point3<f64>]>>,
    /// Of the one part that is of all.
    pub(crate) normals: Option<Vec<Vector3<f64>>>,
}

impl<'a> Measurement<'a> {
    /// What one of `num` cameras measured, or may have, and its normals if several have measured it together.
    pub(crate) fn of<'s>(
        &'s self,
        eye: usize,
        num: usize,
        target: &'s PreparedCloud<'a>,
    ) -> (&'s [Point3<f64>], Option<&'s [Vector3<f64>]>) {
        match &self.parts[..] {
            [] => (&target.points, target.normals.as_deref().filter(|_| num > 1)),
            [all] if num > 1 => (all, self.normals.as_deref()),
            parts => (&parts[eye], None),
        }
    }
}

impl From<Vec<Point3<f64>>> for Cloud<'static> {
    fn from(points: Vec<Point3<f64>>) -> Self {
        Self { points: Cow::Owned(points), ..Self::default() }
    }
}

impl From<Vec<[f64; 3]>> for Cloud<'static> {
    fn from(rows: Vec<[f64; 3]>) -> Self {
        rows.into_iter().map(Point3::from).collect::<Vec<_>>().into()
    }
}

/// A cloud that was checked, with its spacing.
#[derive(Debug)]
pub struct PreparedCloud<'a> {
    /// The points, in data units.
    pub points: Cow<'a, [Point3<f64>]>,
    /// Unit normals, one per point.
    pub normals: Option<Vec<Vector3<f64>>>,
    /// Local reference frames, one per point, if they were given.
    pub frames: Option<Vec<Matrix3<f64>>>,
    /// Where the depth cameras stood.
    pub viewpoints: Vec<Point3<f64>>,
    /// More points of its surface, and their unit normals.
    pub fine: Option<PointsAndNormals>,
    /// What leaves the cloud looking the same, if that was declared.
    pub symmetries: Symmetries,
    /// Mean distance of a point to its nearest distinct other point, in data units; stray points do not count.
    pub spacing: f64,
    /// Diagonal of the bounding box, in data units.
    pub extent: f64,
    /// Centre of the bounding box.
    pub centre: Point3<f64>,
    /// No point is farther from the centre than this; data units.
    pub radius: f64,
    /// A few points that stand for all, where a mean over the cloud is wanted: [`PROBE_POINTS`] drawn at random.
    pub(crate) probe: Probe,
    /// Fewer still, for a first glance.
    pub(crate) scout: Probe,
    diameter: OnceLock<f64>,
    tree: OnceLock<Neighbors>,
    /// On all points, and on the probe.
    shadows: OnceLock<[OwnShadow; 2]>,
}

impl<'a> PreparedCloud<'a> {
    /// Checks and prepares a source, for any number of registrations: its spacing and, once asked for, its diameter.
    ///
    /// # Errors
    /// Those of [`crate::Registrar::new`].
    pub fn source(cloud: &Cloud<'a>) -> Result<Self, Error> {
        Self::source_until(cloud, &Interrupt::never())
    }

    /// The same, until it is interrupted.
    ///
    /// # Errors
    /// [`Error::Interrupted`] too.
    pub fn source_until(cloud: &Cloud<'a>, interrupt: &Interrupt) -> Result<Self, Error> {
        Self::new(cloud, Argument::Src, Argument::SrcNormals, Argument::SrcFrames, interrupt)
    }

    /// Checks `cloud` and builds what the stages need. `argument`, `normals` and `frames` are what errors call them.
    pub(crate) fn new(
        cloud: &Cloud<'a>,
        argument: Argument,
        normals: Argument,
        frames: Argument,
        interrupt: &Interrupt,
    ) -> Result<Self, Error> {
        let points = &cloud.points;
        check_points(points, argument)?;
        if points.len() < 3 {
            return Err(Error::TooFewPoints { argument, len: points.len() });
        }
        if points.len() > u32::MAX as usize {
            return Err(Error::TooMany { argument, len: points.len() });
        }
        check_points(&cloud.viewpoints, Argument::Viewpoint)?;
        let (parts, num_eyes) = (&cloud.measured.parts, cloud.viewpoints.len());
        for part in parts {
            check_points(part, Argument::Measured)?;
        }
        if parts.len() > 1 && parts.len() != num_eyes {
            let (argument, of) = (Argument::Measured, Argument::Viewpoint);
            return Err(Error::LengthMismatch { argument, len: parts.len(), of, expected: num_eyes });
        }
        let unit_normals = cloud
            .normals
            .as_deref()
            .map(|rows| normalised(rows, normals, points.len(), argument))
            .transpose()?;
        let fine = cloud.fine.as_ref().filter(|(points, _)| !points.is_empty());
        let fine = fine.map(|(points, rows)| {
            check_points(points, argument)?;
            Ok::<_, Error>((points.clone(), normalised(rows, normals, points.len(), argument)?))
        });
        let fine = fine.transpose()?;
        if let Some(rows) = &cloud.frames {
            check_frames(rows, frames, points.len(), argument)?;
        }
        interrupt.proceed()?;
        let (centre, extent) = bounding_box(points);
        if extent <= 0.0 {
            return Err(Error::NoExtent { argument });
        }
        if !interrupt.enter(Phase::Spacing) {
            return Err(interrupt.error());
        }
        let spacing = spacing_until(points, || interrupt.is_set()).ok_or_else(|| interrupt.error())?;
        interrupt.proceed()?;
        // Of the bulk: a stray point far off may be held as coarsely as it likes.
        let distance = middle(points).amax();
        let step = distance.next_up() - distance;
        if step > MAX_STEP * spacing {
            return Err(Error::TooFarOff { argument, distance, step, spacing });
        }
        // A little more, for rounding.
        let radius_sq = points.iter().map(|p| (p - centre).norm_squared()).fold(0.0, f64::max);
        Ok(Self {
            points: points.clone(),
            frames: cloud.frames.clone(),
            viewpoints: cloud.viewpoints.clone(),
            fine,
            symmetries: cloud.symmetries.clone(),
            spacing,
            extent,
            centre,
            radius: (1.0 + 1e-12) * radius_sq.sqrt(),
            probe: Probe::new(points, unit_normals.as_deref(), PROBE_POINTS),
            scout: Probe::new(points, unit_normals.as_deref(), SCOUT_POINTS),
            normals: unit_normals,
            diameter: OnceLock::new(),
            tree: OnceLock::new(),
            shadows: OnceLock::new(),
        })
    }
}

impl PreparedCloud<'_> {
    /// Largest distance of two points, in data units; measured when first asked for. `None` if interrupted.
    #[must_use]
    pub fn diameter(&self, interrupt: &Interrupt) -> Option<f64> {
        if let Some(&known) = self.diameter.get() {
            return Some(known);
        }
        // Not from within `get_or_init`: threads that wait for each other there could be those that have the work to do.
        let diameter = diameter(&self.points, interrupt)?;
        Some(*self.diameter.get_or_init(|| diameter))
    }

    /// kd-tree over the points, built when first asked for: for nearest points at any distance.
    pub(crate) fn tree(&self) -> &Neighbors {
        self.tree.get_or_init(|| Neighbors::new(&self.points))
    }

    /// Works out which points the cloud itself hides, if it has normals and nobody has done so before; nothing if
    /// interrupted.
    pub(crate) fn shade(&self, interrupt: &Interrupt) {
        let Some(normals) = self.normals.as_deref().filter(|_| self.shadows.get().is_none()) else { return };
        if let Some(all) = OwnShadow::until(&self.points, normals, self.spacing, interrupt) {
            let probe = all.on(&self.probe.rows);
            self.shadows.get_or_init(|| [all, probe]);
        }
    }

    /// Which points the cloud itself hides, at a glance those of the probe; `None` before [`Self::shade`].
    pub(crate) fn own_shadow(&self, detail: Detail) -> Option<&OwnShadow> {
        let [all, probe] = self.shadows.get()?;
        Some(if detail == Detail::Glance { probe } else { all })
    }

    /// The 23 motions other than none that turn the cloud about its centre by right angles of its principal axes.
    pub(crate) fn turns(&self) -> Vec<Isometry3<f64>> {
        let axes = principal_axes(&self.points, &self.centre);
        let to_centre = Isometry3::from(self.centre);
        let turn = |right_angles: Rotation3<f64>| {
            let turn = axes * right_angles * axes.inverse();
            to_centre * UnitQuaternion::from_rotation_matrix(&turn) * to_centre.inverse()
        };
        right_angles().into_iter().skip(1).map(turn).collect()
    }

    /// An upper bound of how far two poses move a point of this cloud apart, data units.
    #[must_use]
    pub(crate) fn displacement(&self, a: &Isometry3<f64>, b: &Isometry3<f64>) -> f64 {
        (a * self.centre - b * self.centre).norm() + 0.5 * self.extent * a.rotation.angle_to(&b.rotation)
    }

    /// Whether two poses look the same: whether they differ by a declared symmetry and less than [`SAME_INSTANCE`].
    pub(crate) fn look_the_same(&self, a: &Isometry3<f64>, b: &Isometry3<f64>) -> bool {
        self.displacement(&self.symmetries.nearest(a, b), b) < SAME_INSTANCE * self.extent
    }

    pub(crate) fn surface(&self, with_normals: bool) -> Surface<'_> {
        Surface { points: &self.points, normals: self.normals.as_deref().filter(|_| with_normals) }
    }
}

/// Two poses that are one: no point moves farther, in diagonals of the bounding box. Parts cannot lie so close, unless
/// they are thin plates in a stack.
const SAME_INSTANCE: f64 = 0.05;

/// How far apart the numbers may be that coordinates are held in, in spacings: what is rounded so coarsely is moved by
/// rounding. Poses are good to a few hundredths of a spacing.
const MAX_STEP: f64 = 1e-3;

/// How many points stand for a cloud: the mean of so many distances is good to a hundredth.
pub(crate) const PROBE_POINTS: usize = 256;
pub(crate) const SCOUT_POINTS: usize = 64;

/// Points drawn from a cloud, with their normals.
#[derive(Debug)]
pub(crate) struct Probe {
    rows: Vec<u32>,
    points: Vec<Point3<f64>>,
    normals: Option<Vec<Vector3<f64>>>,
}

impl Probe {
    fn new(points: &[Point3<f64>], normals: Option<&[Vector3<f64>]>, count: usize) -> Self {
        let all: Vec<u32> = (0..points.len() as u32).collect();
        let rows = Rng::new(0, 0, 0).sample(&all, count);
        Self {
            points: rows.iter().map(|&row| points[row as usize]).collect(),
            normals: normals.map(|normals| rows.iter().map(|&row| normals[row as usize]).collect()),
            rows,
        }
    }

    pub(crate) fn surface(&self, with_normals: bool) -> Surface<'_> {
        Surface { points: &self.points, normals: self.normals.as_deref().filter(|_| with_normals) }
    }
}

pub(crate) fn check_points(points: &[Point3<f64>], argument: Argument) -> Result<(), Error> {
    check_finite(points.iter().map(|p| p.coords), argument)
}

fn check_finite(rows: impl Iterator<Item = Vector3<f64>>, argument: Argument) -> Result<(), Error> {
    match first_not_finite(rows) {
        Some((row, value)) => Err(Error::NotFinite { argument, row, value }),
        None => Ok(()),
    }
}

fn normalised(
    rows: &[Vector3<f64>],
    argument: Argument,
    expected: usize,
    of: Argument,
) -> Result<Vec<Vector3<f64>>, Error> {
    if rows.len() != expected {
        return Err(Error::LengthMismatch { argument, len: rows.len(), of, expected });
    }
    check_finite(rows.iter().copied(), argument)?;
    unit_vectors(rows).map_err(|row| Error::ZeroNormal { argument, row })
}

/// How far the axes of a frame may be from orthonormal: frames may come from single precision.
const FRAME_TOLERANCE: f64 = 1e-3;

fn check_frames(
    frames: &[Matrix3<f64>],
    argument: Argument,
    expected: usize,
    of: Argument,
) -> Result<(), Error> {
    if frames.len() != expected {
        return Err(Error::LengthMismatch { argument, len: frames.len(), of, expected });
    }
    // NaN is no rotation either.
    let is_rotation = |frame: &Matrix3<f64>| {
        let off = (frame * frame.transpose() - Matrix3::identity()).amax();
        off <= FRAME_TOLERANCE && frame.iter().all(|x| x.is_finite()) && frame.determinant() > 0.0
    };
    match frames.iter().position(|frame| !is_rotation(frame)) {
        Some(row) => Err(Error::NotARotation { argument, row }),
        None => Ok(()),
    }
}

/// The rotations that map the coordinate axes to each other, none first.
fn right_angles() -> Vec<Rotation3<f64>> {
    let angle = |quarters: u32| f64::from(quarters) * FRAC_PI_2;
    let first = (0..4).map(|i| Rotation3::from_axis_angle(&Vector3::y_axis(), angle(i)));
    let first = first.chain([1, 3].map(|i| Rotation3::from_axis_angle(&Vector3::x_axis(), angle(i))));
    first
        .flat_map(|a| (0..4).map(move |i| a * Rotation3::from_axis_angle(&Vector3::z_axis(), angle(i))))
        .collect()
}

/// The principal axes of points about `centre`, as a rotation.
fn principal_axes(points: &[Point3<f64>], centre: &Point3<f64>) -> Rotation3<f64> {
    let spread: Matrix3<f64> = points.iter().map(|p| (p - centre) * (p - centre).transpose()).sum();
    let eigen = spread.try_symmetric_eigen(f64::EPSILON, 100);
    let mut axes = eigen.map_or_else(Matrix3::identity, |eigen| eigen.eigenvectors);
    if axes.determinant() < 0.0 {
        axes.neg_mut();
    }
    Rotation3::from_matrix_unchecked(axes)
}

/// Centre and diagonal of the bounding box.
fn bounding_box(points: &[Point3<f64>]) -> (Point3<f64>, f64) {
    let Some(&first) = points.first() else { return (Point3::origin(), 0.0) };
    let (low, high) = points.iter().fold((first, first), |(low, high), p| (low.inf(p), high.sup(p)));
    (nalgebra::center(&low, &high), (high - low).norm())
}
