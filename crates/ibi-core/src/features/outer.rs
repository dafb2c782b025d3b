//! Which points of a part can be seen from outside.
//!
//! A CAD part is often hollow, or made of bodies that touch; what lies within is in no scan. Rays and not the hidden
//! point removal of point clouds (Katz et al. 2007), whose answer depends on how dense the points are.

use std::f64::consts::FRAC_PI_2;

use nalgebra::{Point3, Vector3};

use super::FeatureError;
use super::door::{check_points, unit_normals};
use super::mesh::Mesh;
use crate::interrupt::Interrupt;
use crate::kernels::grid::buckets;
use crate::kernels::par;
use crate::kernels::sight::{across, corners, direction};

/// From where the part is looked at.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Views {
    /// How many directions, evenly spread over the sphere; at least 1.
    pub count: usize,
    /// How aslant a surface may be seen: the angle between its normal and the direction; above 0, below pi/2.
    pub max_angle_rad: f64,
    /// How far above its surface a point is looked for, data units: more than points may lie below the mesh. By default
    /// 1e-4 of the size of the mesh.
    pub lift: Option<f64>,
}

impl Default for Views {
    fn default() -> Self {
        Self { count: 64, max_angle_rad: 75.0_f64.to_radians(), lift: None }
    }
}

/// Points that one thread takes at a time.
const GRAIN: usize = 256;

/// Which of the points on a mesh are seen from outside, from one of the directions at least: a ray from there meets no
/// face before.
///
/// The normals must point outwards, as those of [`super::sample_mesh`] do for a mesh whose faces are wound that way.
///
/// # Errors
/// If a coordinate is not finite, if there is not one normal for each point, if a face names no vertex, if a number of
/// `views` is out of its range.
///
/// # Complexity
/// For each direction O(faces), and a few faces for each point that was not seen yet.
pub fn outer_surface(
    points: &[Point3<f64>],
    normals: &[Vector3<f64>],
    mesh: &Mesh<'_>,
    views: &Views,
    interrupt: &Interrupt,
) -> Result<Vec<bool>, FeatureError> {
    check_points("points", points)?;
    let normals = unit_normals("normals", normals, points.len())?;
    mesh.check()?;
    let (low, high) = bounds(mesh.vertices);
    let size = (high - low).norm();
    let lift = views.check(size)?;
    let cos = views.max_angle_rad.cos();
    let mut is_seen = vec![false; points.len()];
    for view in 0..views.count {
        if interrupt.is_set() {
            return Err(FeatureError::Interrupted);
        }
        let to_eye = direction(view, views.count);
        let facing = |&row: &usize| !is_seen[row] && normals[row].dot(&to_eye) >= cos;
        let rows: Vec<usize> = (0..points.len()).filter(facing).collect();
        if rows.is_empty() {
            continue;
        }
        let screen = Screen::new(mesh, low, to_eye, 1e-9 * size);
        let seen = par::map(rows.len(), GRAIN, |i| screen.sees(points[rows[i]] + lift * normals[rows[i]]));
        rows.iter().zip(seen).for_each(|(&row, seen)| is_seen[row] = seen);
    }
    Ok(is_seen)
}

impl Views {
    /// The lift to use.
    fn check(&self, size: f64) -> Result<f64, FeatureError> {
        let setting = |argument, value, allowed| Err(FeatureError::Setting { argument, value, allowed });
        if !(1..=100_000).contains(&self.count) {
            return setting("num_views", self.count as f64, "from 1 to 100000");
        }
        if !(self.max_angle_rad > 0.0 && self.max_angle_rad < FRAC_PI_2) {
            return setting("max_angle_rad", self.max_angle_rad, "above 0 and below pi/2");
        }
        let lift = self.lift.unwrap_or(1e-4 * size);
        if !(0.0..f64::INFINITY).contains(&lift) {
            return setting("lift", lift, "at least 0 and finite");
        }
        Ok(lift)
    }
}

fn bounds(points: &[Point3<f64>]) -> (Point3<f64>, Point3<f64>) {
    let Some(&first) = points.first() else { return (Point3::origin(), Point3::origin()) };
    points.iter().fold((first, first), |(low, high), p| (low.inf(p), high.sup(p)))
}

/// The mesh as seen from one direction: the faces that each pixel shows.
struct Screen {
    /// Right, up and towards the eye.
    axes: [Vector3<f64>; 3],
    origin: Point3<f64>,
    /// The corners of each face on the screen.
    faces: Vec<[[f64; 3]; 3]>,
    low: [f64; 2],
    inv_pixel: f64,
    shape: [usize; 2],
    /// Start of each pixel in `shown`, plus the end.
    starts: Vec<u32>,
    shown: Vec<u32>,
    /// Lengths below this are rounding.
    rounding: f64,
}

/// Pixels on a side at most.
const MAX_SIDE: usize = 512;

impl Screen {
    fn new(mesh: &Mesh<'_>, origin: Point3<f64>, to_eye: Vector3<f64>, rounding: f64) -> Self {
        let [right, up] = across(&to_eye);
        let axes = [right, up, to_eye];
        let vertices: Vec<[f64; 3]> = mesh.vertices.iter().map(|v| on_screen(&axes, origin, v)).collect();
        let faces: Vec<_> = mesh.faces.iter().map(|face| face.map(|vertex| vertices[vertex])).collect();
        let flat: Vec<[f64; 2]> = vertices.iter().map(|&[x, y, _]| [x, y]).collect();
        let ([left, bottom], [right, top]) = corners(&flat);
        // About as many pixels as faces.
        let side = ((faces.len() as f64).sqrt() as usize).clamp(8, MAX_SIDE);
        let pixel = ((right - left).max(top - bottom) / side as f64).max(f64::MIN_POSITIVE);
        let mut screen = Self {
            axes,
            origin,
            low: [left, bottom],
            inv_pixel: 1.0 / pixel,
            shape: [right - left, top - bottom].map(|width| ((width / pixel) as usize + 1).min(side + 1)),
            starts: Vec::new(),
            shown: Vec::new(),
            faces,
            rounding,
        };
        screen.show();
        screen
    }

    /// Sorts the faces by the pixels that they may cover.
    fn show(&mut self) {
        let faces = (0..).zip(&self.faces);
        let covered = faces.flat_map(|(id, face)| self.pixels(face).map(move |pixel| (id, pixel)));
        (self.starts, self.shown) = buckets(self.shape[0] * self.shape[1], covered);
    }

    /// The pixels of the box around a face.
    fn pixels(&self, face: &[[f64; 3]; 3]) -> impl Iterator<Item = usize> + Clone + use<> {
        let range = |k: usize| {
            let (low, high) =
                (face[0][k].min(face[1][k]).min(face[2][k]), face[0][k].max(face[1][k]).max(face[2][k]));
            self.along(k, low - self.rounding)..=self.along(k, high + self.rounding)
        };
        let (columns, rows, height) = (range(0), range(1), self.shape[1]);
        columns.flat_map(move |x| rows.clone().map(move |y| x * height + y))
    }

    fn along(&self, k: usize, x: f64) -> usize {
        // A cast of a negative number gives 0.
        (((x - self.low[k]) * self.inv_pixel) as usize).min(self.shape[k] - 1)
    }

    /// Whether no face is between the point and the eye.
    fn sees(&self, point: Point3<f64>) -> bool {
        let p = on_screen(&self.axes, self.origin, &point);
        let pixel = self.along(0, p[0]) * self.shape[1] + self.along(1, p[1]);
        let shown = &self.shown[self.starts[pixel] as usize..self.starts[pixel + 1] as usize];
        !shown.iter().any(|&face| self.hides(&self.faces[face as usize], p))
    }

    fn hides(&self, [a, b, c]: &[[f64; 3]; 3], p: [f64; 3]) -> bool {
        // Twice the areas of the triangles that the point makes with each side; the edges belong to the face.
        let area = |u: &[f64; 3], v: &[f64; 3]| (u[0] - p[0]) * (v[1] - p[1]) - (u[1] - p[1]) * (v[0] - p[0]);
        let (opposite_a, opposite_b, opposite_c) = (area(b, c), area(c, a), area(a, b));
        let whole = opposite_a + opposite_b + opposite_c;
        let sign = whole.signum();
        // Seen from its edge a face hides nothing.
        if whole == 0.0 || [opposite_a, opposite_b, opposite_c].iter().any(|area| area * sign < 0.0) {
            return false;
        }
        let depth = (opposite_a * a[2] + opposite_b * b[2] + opposite_c * c[2]) / whole;
        depth > p[2] + self.rounding
    }
}

fn on_screen(axes: &[Vector3<f64>; 3], origin: Point3<f64>, point: &Point3<f64>) -> [f64; 3] {
    axes.map(|axis| axis.dot(&(point - origin)))
}
