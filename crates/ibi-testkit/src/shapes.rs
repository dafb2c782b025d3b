//! Meshes whose symmetries are known.

use nalgebra::{Point3, Vector3};
use std::f64::consts::{PI, TAU};

/// A closed surface of triangles.
#[derive(Debug, Clone)]
pub struct Solid {
    /// The corners.
    pub vertices: Vec<Point3<f64>>,
    /// Three rows of them each.
    pub faces: Vec<[usize; 3]>,
}

impl Solid {
    /// Both in one mesh, the other one moved.
    #[must_use]
    pub fn with(mut self, other: &Self, shift: Vector3<f64>) -> Self {
        let first = self.vertices.len();
        self.vertices.extend(other.vertices.iter().map(|p| p + shift));
        self.faces.extend(other.faces.iter().map(|face| face.map(|row| row + first)));
        self
    }
}

/// What a line of (radius, z) sweeps out on its way about z in `sides` steps.
#[must_use]
pub fn lathe(line: &[(f64, f64)], sides: usize) -> Solid {
    let corner = |k: usize, (radius, z): (f64, f64)| {
        let (sin, cos) = (TAU * k as f64 / sides as f64).sin_cos();
        Point3::new(radius * cos, radius * sin, z)
    };
    let vertices = (0..sides).flat_map(|k| line.iter().map(move |&at| corner(k, at))).collect();
    let n = line.len();
    let row = |k: usize, i: usize| (k % sides) * n + i;
    let strip = |k: usize| {
        (0..n - 1).flat_map(move |i| {
            [[row(k, i), row(k + 1, i), row(k + 1, i + 1)], [row(k, i), row(k + 1, i + 1), row(k, i + 1)]]
        })
    };
    Solid { vertices, faces: (0..sides).flat_map(strip).collect() }
}

/// A regular prism about z, its lids among it.
#[must_use]
pub fn prism(sides: usize, radius: f64, height: f64) -> Solid {
    let half = 0.5 * height;
    lathe(&[(0.0, -half), (radius, -half), (radius, half), (0.0, half)], sides)
}

/// A box about the origin.
#[must_use]
pub fn cuboid(size: [f64; 3]) -> Solid {
    let mut solid = prism(4, 0.5_f64.sqrt(), 1.0);
    for p in &mut solid.vertices {
        // The corners of the prism lie on the axes.
        let (x, y) = ((p.x - p.y) * 0.5_f64.sqrt(), (p.x + p.y) * 0.5_f64.sqrt());
        *p = Point3::new(size[0] * x, size[1] * y, size[2] * p.z);
    }
    solid
}

/// A regular tetrahedron in a cube of side 2.
#[must_use]
pub fn tetrahedron() -> Solid {
    let vertices = [[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]];
    let faces = vec![[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]];
    Solid { vertices: vertices.map(Point3::from).to_vec(), faces }
}

/// A ball of radius 1.
#[must_use]
pub fn ball() -> Solid {
    let line: Vec<(f64, f64)> = (0..=16).map(|k| (PI * f64::from(k) / 16.0).sin_cos()).collect();
    lathe(&line.iter().map(|&(sin, cos)| (sin, -cos)).collect::<Vec<_>>(), 32)
}

/// A torus about z, 2.6 across.
#[must_use]
pub fn torus() -> Solid {
    let line: Vec<(f64, f64)> = (0..=16)
        .map(|k| (TAU * f64::from(k) / 16.0).sin_cos())
        .map(|(sin, cos)| (1.0 + 0.3 * cos, 0.3 * sin))
        .collect();
    lathe(&line, 48)
}

/// A tee of pipes: one along x, and a branch along z that ends in it; half a turn about z is its only symmetry.
#[must_use]
pub fn tee() -> Solid {
    let mut pipe = prism(24, 0.35, 2.4);
    for p in &mut pipe.vertices {
        *p = Point3::new(p.z, p.y, -p.x);
    }
    pipe.with(&lathe(&[(0.35, 0.2), (0.35, 1.2), (0.0, 1.2)], 24), Vector3::zeros())
}

/// A box with a cylinder beside its middle: the identity alone.
#[must_use]
pub fn lopsided() -> Solid {
    cuboid([3.0, 2.0, 1.0])
        .with(&lathe(&[(0.4, 0.0), (0.4, 0.6), (0.0, 0.6)], 24), Vector3::new(0.7, 0.3, 0.5))
}
