//! Which points of a part can be seen from outside.
//!
//! A CAD part is often hollow, or made of bodies that touch; what lies within is in no scan. Rays and not the hidden
//! point removal of point clouds (Katz et al. 2007), whose answer depends on how dense the points are.

use std::f64::consts::FRAC_PI_2;

use nalgebra::{Point3, Vector3};

use super::FeatureError;
use super::door::{check_points, unit_normals};
use super::mesh::Mesh;
use crate::interrupt::{Interrupt, Phase};
use crate::kernels::grid::buckets;
use crate::kernels::par;
use crate::kernels::sight::{across, direction};
use crate::kernels::sort::sorted;
use crate::pace::Pace;

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
        // 75 degrees.
        Self { count: 64, max_angle_rad: 1.309, lift: None }
    }
}

/// Points that one thread takes at a time.
const GRAIN: usize = 256;

/// Directions that are looked from at the same time.
const AT_ONCE: usize = 4;

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
/// O(faces log faces); then for each direction O(faces), and far fewer where few points were not seen yet, and a few faces
/// for each of them.
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
    if !interrupt.enter(Phase::OuterSurface) {
        return Err(FeatureError::Interrupted);
    }
    let cos = views.max_angle_rad.cos();
    let patches = Patches::new(mesh, low, high, interrupt).ok_or(FeatureError::Interrupted)?;
    let mut is_seen = vec![false; points.len()];
    // Side by side, although one of them may look again at what another one sees.
    let at_once = if par::is_parallel() { AT_ONCE } else { 1 };
    for first in (0..views.count).step_by(at_once) {
        let seen = par::map(at_once.min(views.count - first), 1, |i| {
            let to_eye = direction(first + i, views.count);
            let facing = |&row: &usize| !is_seen[row] && normals[row].dot(&to_eye) >= cos;
            let rows: Vec<usize> = (0..points.len()).filter(facing).collect();
            let lifted = |&row: &usize| points[row] + lift * normals[row];
            let asked: Vec<Point3<f64>> = rows.iter().map(lifted).collect();
            let screen = Screen::new(&patches, to_eye, 1e-9 * size, &asked, interrupt);
            let seen = par::chunks(rows.len(), GRAIN, |run| {
                let is_asked = !interrupt.is_set();
                let sees = |&at: &usize| is_asked && screen.sees(&asked[at]);
                run.filter(sees).map(|at| rows[at]).collect::<Vec<_>>()
            });
            seen.concat()
        });
        if interrupt.is_set() {
            return Err(FeatureError::Interrupted);
        }
        seen.into_iter().flatten().for_each(|row| is_seen[row] = true);
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

/// Faces of a patch.
const PATCH: usize = 32;

/// The faces in patches that lie together, whatever their order in the mesh.
struct Patches<'a> {
    mesh: &'a Mesh<'a>,
    low: Point3<f64>,
    high: Point3<f64>,
    order: Vec<u32>,
    /// The middle of the box around each patch, and half its sides.
    boxes: Vec<(Point3<f64>, Vector3<f64>)>,
}

impl<'a> Patches<'a> {
    /// `low` and `high` are the corners of the box around the mesh. `None` if interrupted.
    fn new(mesh: &'a Mesh<'a>, low: Point3<f64>, high: Point3<f64>, interrupt: &Interrupt) -> Option<Self> {
        /// Cells an axis, of a curve that winds through all of them (Morton 1966).
        const CELLS: f64 = 65536.0;
        let scale = (high - low).map(|side| if side > 0.0 { CELLS * (1.0 - 1e-9) / side } else { 0.0 });
        let place = |face: usize| {
            let centre = mesh.corners(face).iter().map(|p| p - low).sum::<Vector3<f64>>() / 3.0;
            let [x, y, z] = [0, 1, 2].map(|k| (centre[k] * scale[k]) as u64);
            (0..16).fold(0, |code, bit| {
                code | ((x >> bit) & 1) << (3 * bit)
                    | ((y >> bit) & 1) << (3 * bit + 1)
                    | ((z >> bit) & 1) << (3 * bit + 2)
            })
        };
        let places = par::chunks(mesh.faces.len(), GRAIN, |run| {
            let is_asked = !interrupt.is_set();
            run.filter(|_| is_asked).map(|face| (place(face), face as u32)).collect::<Vec<(u64, u32)>>()
        });
        let order: Vec<u32> = sorted(places.concat(), interrupt)?.into_iter().map(|(_, face)| face).collect();
        let boxes = par::chunks(order.len(), PATCH, |run| {
            let corners = order[run].iter().flat_map(|&face| mesh.corners(face as usize));
            let nowhere = (Point3::from([f64::INFINITY; 3]), Point3::from([f64::NEG_INFINITY; 3]));
            let (low, high) = corners.fold(nowhere, |(low, high), p| (low.inf(&p), high.sup(&p)));
            (nalgebra::center(&low, &high), 0.5 * (high - low))
        });
        Some(Self { mesh, low, high, order, boxes })
    }
}

/// The mesh as seen from one direction: the faces that each pixel shows, where somebody asks.
struct Screen<'a> {
    mesh: &'a Mesh<'a>,
    /// Right, up and towards the eye.
    axes: [Vector3<f64>; 3],
    origin: Point3<f64>,
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

/// A face across more columns of pixels is followed from column to column: the box around a long and thin one is full of
/// pixels that do not show it.
const WIDE: usize = 4;

impl<'a> Screen<'a> {
    /// For questions about the points `asked`. Less than all if interrupted.
    fn new(
        patches: &Patches<'a>,
        to_eye: Vector3<f64>,
        rounding: f64,
        asked: &[Point3<f64>],
        interrupt: &Interrupt,
    ) -> Self {
        let [right, up] = across(&to_eye);
        let (mesh, origin) = (patches.mesh, patches.low);
        let axes = [right, up, to_eye];
        let middle = on_screen(&axes, origin, &nalgebra::center(&patches.low, &patches.high));
        let half = axes.map(|axis| axis.abs().dot(&(0.5 * (patches.high - patches.low))));
        // About as many pixels as faces.
        let side = ((mesh.faces.len() as f64).sqrt() as usize).clamp(8, MAX_SIDE);
        let pixel = (2.0 * half[0].max(half[1]) / side as f64).max(f64::MIN_POSITIVE);
        let mut screen = Self {
            mesh,
            axes,
            origin,
            low: [0, 1].map(|k| middle[k] - half[k]),
            inv_pixel: 1.0 / pixel,
            shape: [0, 1].map(|k| ((2.0 * half[k] / pixel) as usize + 1).min(side + 1)),
            starts: Vec::new(),
            shown: Vec::new(),
            rounding,
        };
        if !asked.is_empty() {
            screen.show(patches, asked, &mut Pace::new(interrupt));
        }
        screen
    }

    /// Sorts the faces by the pixels that they may cover: those that lie before a point that is asked for.
    fn show(&mut self, patches: &Patches<'_>, asked: &[Point3<f64>], pace: &mut Pace<'_>) {
        let [width, height] = self.shape;
        let mut deepest = vec![f64::INFINITY; width * height];
        for point in asked {
            let p = on_screen(&self.axes, self.origin, point);
            let pixel = self.pixel(&p);
            deepest[pixel] = deepest[pixel].min(p[2]);
        }
        // How many pixels to the left of and below a corner are asked for.
        let mut below = vec![0_u32; (width + 1) * (height + 1)];
        for x in 0..width {
            let mut in_column = 0;
            for y in 0..height {
                in_column += u32::from(deepest[x * height + y] < f64::INFINITY);
                below[(x + 1) * (height + 1) + y + 1] = below[x * (height + 1) + y + 1] + in_column;
            }
        }
        let is_asked = |[left, right]: [usize; 2], [bottom, top]: [usize; 2]| {
            let at = |x: usize, y: usize| below[x * (height + 1) + y];
            at(right + 1, top + 1) + at(left, bottom) > at(left, top + 1) + at(right + 1, bottom)
        };
        let mut shown: Vec<(u32, usize)> = Vec::new();
        for (faces, (middle, half)) in patches.order.chunks(PATCH).zip(&patches.boxes) {
            let middle = on_screen(&self.axes, self.origin, middle);
            let pixels = [0, 1].map(|k| {
                let reach = self.axes[k].abs().dot(half) + self.rounding;
                [self.along(k, middle[k] - reach), self.along(k, middle[k] + reach)]
            });
            let mut work = 1;
            if is_asked(pixels[0], pixels[1]) {
                for &id in faces {
                    let face = self.corners(id as usize);
                    let nearest = face[0][2].max(face[1][2]).max(face[2][2]);
                    work += 8 + self.each_pixel(&face, |pixel| {
                        if deepest[pixel] < nearest {
                            shown.push((id, pixel));
                        }
                    });
                }
            }
            if pace.is_over(work) {
                return;
            }
        }
        (self.starts, self.shown) = buckets(deepest.len(), shown.iter().copied());
    }

    fn corners(&self, face: usize) -> [[f64; 3]; 3] {
        self.mesh.corners(face).map(|vertex| on_screen(&self.axes, self.origin, &vertex))
    }

    /// Tells `look` all pixels that a face may cover, and others; returns how many.
    fn each_pixel(&self, face: &[[f64; 3]; 3], mut look: impl FnMut(usize)) -> usize {
        let bounds = |k: usize| {
            let low = face[0][k].min(face[1][k]).min(face[2][k]) - self.rounding;
            let high = face[0][k].max(face[1][k]).max(face[2][k]) + self.rounding;
            (low, high)
        };
        let ((left, right), (bottom, top)) = (bounds(0), bounds(1));
        let (first, last) = (self.along(0, left), self.along(0, right));
        let mut count = 0;
        for x in first..=last {
            let (mut low, mut high) = (bottom, top);
            if last - first >= WIDE {
                (low, high) = self.within_column(face, x);
            }
            for y in self.along(1, low)..=self.along(1, high) {
                look(x * self.shape[1] + y);
                count += 1;
            }
        }
        count
    }

    /// From where to where a face reaches within a column of pixels, and a little beyond.
    fn within_column(&self, face: &[[f64; 3]; 3], column: usize) -> (f64, f64) {
        /// In pixels; for rounding.
        const BEYOND: f64 = 0.01;
        let pixel = 1.0 / self.inv_pixel;
        let edge = |steps: f64| self.low[0] + steps * pixel;
        // What lies beyond the screen, by rounding, counts to the columns at its ends.
        let left = if column == 0 { f64::NEG_INFINITY } else { edge(column as f64 - BEYOND) };
        let is_last = column + 1 == self.shape[0];
        let right = if is_last { f64::INFINITY } else { edge(column as f64 + 1.0 + BEYOND) };
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for k in 0..3 {
            let (a, b) = (face[k], face[(k + 1) % 3]);
            if a[0].max(b[0]) < left || a[0].min(b[0]) > right {
                continue;
            }
            for (x, end) in [(a[0], a[1]), (b[0], b[1])] {
                let inside = x.clamp(left, right);
                let part = ((inside - a[0]) / (b[0] - a[0])).clamp(0.0, 1.0);
                let y = if (left..=right).contains(&x) { end } else { a[1] + part * (b[1] - a[1]) };
                (low, high) = (low.min(y), high.max(y));
            }
        }
        (low - BEYOND * pixel, high + BEYOND * pixel)
    }

    fn pixel(&self, p: &[f64; 3]) -> usize {
        self.along(0, p[0]) * self.shape[1] + self.along(1, p[1])
    }

    fn along(&self, k: usize, x: f64) -> usize {
        // A cast of a negative number gives 0.
        (((x - self.low[k]) * self.inv_pixel) as usize).min(self.shape[k] - 1)
    }

    /// Whether no face is between the point, one that was asked for, and the eye.
    fn sees(&self, point: &Point3<f64>) -> bool {
        let p = on_screen(&self.axes, self.origin, point);
        let pixel = self.pixel(&p);
        let shown = &self.shown[self.starts[pixel] as usize..self.starts[pixel + 1] as usize];
        !shown.iter().any(|&face| self.hides(&self.corners(face as usize), p))
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

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests may panic")]
mod tests {
    use super::*;
    use crate::kernels::rng::Rng;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]

        // Of all faces each that hides a point is among those that its pixel shows: large ones, long and thin ones, and of
        // no area; wherever the points lie.
        #[test]
        fn a_point_is_seen_where_no_face_of_all_hides_it(
            seed: u64, num_faces in 1..3000_usize, size in prop::sample::select(vec![0.003, 0.1, 1.0]), thin in 0..3_u32,
        ) {
            let mut rng = Rng::new(seed, 0, 0);
            let mut vector = |half: f64| Vector3::from([0; 3].map(|_: u32| half * (2.0 * rng.unit() - 1.0)));
            let (mut vertices, mut faces) = (Vec::new(), Vec::new());
            for face in 0..num_faces {
                let a = Point3::from(vector(1.0));
                let along = vector(size);
                let across = if thin == 0 { vector(size) } else { along * 0.4 + vector(1e-4 * f64::from(thin - 1)) };
                vertices.extend([a, a + along, a + across]);
                faces.push([3 * face, 3 * face + 1, 3 * face + 2]);
            }
            let mesh = Mesh { vertices: &vertices, faces: &faces };
            let asked: Vec<Point3<f64>> = (0..200)
                .map(|_| Point3::from(vector(1.2)))
                .chain(vertices.iter().copied().take(100))
                .collect();
            let (low, high) = bounds(&vertices);
            let (to_eye, rounding) = (vector(1.0).normalize(), 1e-9 * (high - low).norm());
            let never = Interrupt::never();
            let patches = Patches::new(&mesh, low, high, &never).unwrap();
            let screen = Screen::new(&patches, to_eye, rounding, &asked, &never);
            for point in &asked {
                let p = on_screen(&screen.axes, screen.origin, point);
                let is_hidden = (0..num_faces).any(|face| screen.hides(&screen.corners(face), p));
                prop_assert_eq!(screen.sees(point), !is_hidden);
            }
        }
    }
}
