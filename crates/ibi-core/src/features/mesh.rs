//! Points on a mesh, evenly spread.

use nalgebra::{Point3, Vector3};

use super::FeatureError;
use super::door::{check_len, check_length, check_points};
use crate::interrupt::{Interrupt, Phase};
use crate::kernels::rng::Rng;

/// A surface of triangles. Seen from outside, the corners of a face run counter-clockwise: that is where its normal
/// points.
#[derive(Debug, Clone, Copy)]
pub struct Mesh<'a> {
    /// The corners, in data units.
    pub vertices: &'a [Point3<f64>],
    /// Three rows of `vertices` each.
    pub faces: &'a [[usize; 3]],
}

impl Mesh<'_> {
    pub(super) fn check(&self) -> Result<(), FeatureError> {
        check_points("vertices", self.vertices)?;
        check_len("faces", self.faces.len())?;
        let len = self.vertices.len();
        let bad = |face: &[usize; 3]| face.iter().position(|&index| index >= len);
        let found = self.faces.iter().enumerate().find_map(|(row, face)| Some((row, bad(face)?)));
        found.map_or(Ok(()), |(row, column)| {
            let index = i64::try_from(self.faces[row][column]).unwrap_or(i64::MAX);
            Err(FeatureError::FaceIndex { row, column, index, len })
        })
    }

    pub(super) fn corners(&self, face: usize) -> [Point3<f64>; 3] {
        self.faces[face].map(|vertex| self.vertices[vertex])
    }

    /// Across the face, twice as long as its area.
    fn across(&self, face: usize) -> Vector3<f64> {
        let [a, b, c] = self.corners(face);
        (b - a).cross(&(c - a))
    }
}

/// How many points to draw.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Amount {
    /// So many, as far from each other as they come.
    Count(usize),
    /// As many as find room so far from each other; data units.
    Spacing(f64),
}

/// Points on a surface.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Sampled {
    /// In data units, in no particular order.
    pub points: Vec<Point3<f64>>,
    /// The normals of the faces that they lie on, of length 1.
    pub normals: Vec<Vector3<f64>>,
}

/// No more points; they would take gigabytes.
const MAX_POINTS: usize = 100_000_000;

/// Draws for each point that could find room at best, before a surface counts as full: then hardly a gap is left.
const DRAWS: usize = 12;

/// How much closer points may come each time that no room is left for all that are wanted, and the draws in between.
const SHRINK: f64 = 0.9;
const DRAWS_A_SIZE: usize = 4;

/// Points whose normals are turned by more than 120 degrees do not crowd each other: the two sides of a thin wall.
const SAME_SIDE_COS: f64 = -0.5;

/// Draws points on a mesh at random, by area, and keeps those that are not too near to another one (dart throwing with
/// a shrinking radius, McCool & Fiume 1992).
///
/// # Errors
/// If a coordinate is not finite, if a face names no vertex, if no face has an area, if the spacing is not above 0 or
/// more than 10^8 points are wanted.
///
/// # Complexity
/// O(n) time for n points, about 20 draws each; 60 bytes a point.
pub fn sample_mesh(
    mesh: &Mesh<'_>,
    amount: Amount,
    seed: u64,
    interrupt: &Interrupt,
) -> Result<Sampled, FeatureError> {
    mesh.check()?;
    if let Amount::Spacing(spacing) = amount {
        check_length("spacing", spacing)?;
    }
    if !interrupt.enter(Phase::SampleMesh) {
        return Err(FeatureError::Interrupted);
    }
    let surface = Surface::new(mesh).ok_or(FeatureError::NoArea)?;
    let (count, spacing) = match amount {
        // The nodes of a lattice of triangles are the farthest apart.
        Amount::Count(count) => (count, (surface.area() / (count.max(1) as f64 * 0.75_f64.sqrt())).sqrt()),
        Amount::Spacing(spacing) => {
            let most = surface.area() / (spacing * spacing * 0.75_f64.sqrt());
            (most.min(2.0 * MAX_POINTS as f64).ceil() as usize, spacing)
        }
    };
    if count > MAX_POINTS {
        return Err(FeatureError::TooManySamples { count, most: MAX_POINTS });
    }
    let (mut rng, mut kept) = (Rng::new(seed, 0, 0), Kept::new(count, spacing, mesh.vertices[0]));
    let mut radius = spacing;
    let farthest = mesh.vertices.iter().map(|p| p.coords.amax()).fold(0.0, f64::max);
    let is_full = |kept: &Kept| matches!(amount, Amount::Count(n) if kept.sampled.points.len() >= n);
    while !is_full(&kept) {
        let draws = if matches!(amount, Amount::Count(_)) { DRAWS_A_SIZE } else { DRAWS };
        for draw in 0..draws * count + DRAWS {
            if is_full(&kept) {
                break;
            }
            // Where all points share a few cells, a draw looks at all of them.
            if draw % 16 == 0 && interrupt.is_set() {
                return Err(FeatureError::Interrupted);
            }
            let (point, normal) = surface.draw(&mut rng);
            if kept.has_room(&point, &normal, radius) {
                kept.push(point, normal);
            }
        }
        if matches!(amount, Amount::Spacing(_)) {
            break;
        }
        radius *= SHRINK;
        // Points that the numbers cannot hold so near to each other fall onto each other, and for ever.
        if radius < f64::EPSILON * farthest {
            radius = 0.0;
        }
    }
    Ok(kept.sampled)
}

/// A mesh to draw from.
struct Surface<'a> {
    mesh: &'a Mesh<'a>,
    /// Of all faces up to each one, itself included.
    areas: Vec<f64>,
}

impl<'a> Surface<'a> {
    /// `None` without any area.
    fn new(mesh: &'a Mesh<'a>) -> Option<Self> {
        let mut area = 0.0;
        let sum = |face| {
            area += 0.5 * mesh.across(face).norm();
            area
        };
        let areas: Vec<f64> = (0..mesh.faces.len()).map(sum).collect();
        (area > 0.0 && area.is_finite()).then_some(Self { mesh, areas })
    }

    fn area(&self) -> f64 {
        self.areas.last().copied().unwrap_or(0.0)
    }

    fn draw(&self, rng: &mut Rng) -> (Point3<f64>, Vector3<f64>) {
        let at = rng.unit() * self.area();
        // The first face beyond: one that has an area.
        let face = self.areas.partition_point(|&area| area <= at).min(self.areas.len() - 1);
        let [a, b, c] = self.mesh.corners(face);
        let (s, t) = (rng.unit().sqrt(), rng.unit());
        let point = a + (b - a) * (s * (1.0 - t)) + (c - a) * (s * t);
        (point, self.mesh.across(face).try_normalize(0.0).unwrap_or_else(Vector3::z))
    }
}

/// No further point in this chain.
const END: u32 = u32::MAX;

/// What has been kept, in a table by cell.
struct Kept {
    sampled: Sampled,
    inv_cell: f64,
    origin: Point3<f64>,
    /// The last point of each chain, and the one before each point.
    last: Vec<u32>,
    before: Vec<u32>,
}

impl Kept {
    fn new(count: usize, cell: f64, origin: Point3<f64>) -> Self {
        let last = vec![END; (2 * count).next_power_of_two().max(64)];
        Self { sampled: Sampled::default(), inv_cell: 1.0 / cell, origin, last, before: Vec::new() }
    }

    /// Coordinates beyond what 64 bits can count share the last cells.
    fn cell(&self, point: &Point3<f64>) -> [i64; 3] {
        [0, 1, 2].map(|axis| ((point[axis] - self.origin[axis]) * self.inv_cell).floor() as i64)
    }

    /// The chain of a cell; others may share it (Teschner et al. 2003).
    fn chain(&self, [x, y, z]: [i64; 3]) -> usize {
        let [x, y, z] = [x, y, z].map(i64::cast_unsigned);
        let hash = x.wrapping_mul(73_856_093) ^ y.wrapping_mul(19_349_663) ^ z.wrapping_mul(83_492_791);
        hash as usize & (self.last.len() - 1)
    }

    /// Whether no point of the same side is within `radius`, at most the width of a cell.
    fn has_room(&self, point: &Point3<f64>, normal: &Vector3<f64>, radius: f64) -> bool {
        let [x, y, z] = self.cell(point);
        let is_free = |cell: [i64; 3]| {
            let mut at = self.last[self.chain(cell)];
            while at != END {
                let other = at as usize;
                let near = (self.sampled.points[other] - point).norm_squared() < radius * radius;
                if near && self.sampled.normals[other].dot(normal) > SAME_SIDE_COS {
                    return false;
                }
                at = self.before[other];
            }
            true
        };
        (-1..=1).all(|i| {
            (-1..=1).all(|j| {
                (-1..=1).all(|k| is_free([x.saturating_add(i), y.saturating_add(j), z.saturating_add(k)]))
            })
        })
    }

    fn push(&mut self, point: Point3<f64>, normal: Vector3<f64>) {
        let chain = self.chain(self.cell(&point));
        self.before.push(self.last[chain]);
        self.last[chain] = self.sampled.points.len() as u32;
        self.sampled.points.push(point);
        self.sampled.normals.push(normal);
    }
}
