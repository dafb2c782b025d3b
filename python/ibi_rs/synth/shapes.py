"""Procedural shapes and mesh sampling: surfaces that a seed can draw points from.

The built-in shapes are unions of boxes, cylinders and tori, so a plain wheel needs no data files. None has a
rotational symmetry: the pose of an instance is then unique and a pose error means what it says.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

__all__ = ["SHAPES", "catalogue", "sample_mesh", "shape"]

Array: TypeAlias = NDArray[np.float64]
PointsNormals: TypeAlias = tuple[Array, Array]
Vec: TypeAlias = tuple[float, float, float]

DENSE_POINTS = 10_000  # surface points per shape, as in the layout of Tang and Zou (see `ecc`)


class Box(NamedTuple):
    """An axis-aligned box."""

    center: Vec
    half: Vec

    def area(self) -> float:
        """Surface area."""
        x, y, z = self.half
        return 8 * (x * y + y * z + z * x)

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether each point lies strictly inside."""
        inside: NDArray[np.bool_] = np.all(
            np.abs(points - self.center) < np.subtract(self.half, 1e-9), axis=1
        )
        return inside

    def sample(self, n: int, rng: np.random.Generator) -> PointsNormals:
        """Draw `n` surface points and their outward normals."""
        half = np.asarray(self.half)
        face_area = half.prod() / half
        axis = rng.choice(3, size=n, p=face_area / face_area.sum())
        normals = np.zeros((n, 3))
        normals[np.arange(n), axis] = rng.choice([-1.0, 1.0], size=n)
        points = rng.uniform(-1, 1, (n, 3))
        return self.center + half * np.where(normals != 0, normals, points), normals


class Cylinder(NamedTuple):
    """A capped cylinder of length 2 `half` along coordinate axis `axis`."""

    center: Vec
    axis: int
    radius: float
    half: float

    def area(self) -> float:
        """Surface area, caps included."""
        return 2 * np.pi * self.radius * (2 * self.half + self.radius)

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether each point lies strictly inside."""
        local = np.roll(points - self.center, 2 - self.axis, axis=1)
        within = np.hypot(local[:, 0], local[:, 1]) < self.radius - 1e-9
        return within & (np.abs(local[:, 2]) < self.half - 1e-9)

    def sample(self, n: int, rng: np.random.Generator) -> PointsNormals:
        """Draw `n` surface points and their outward normals."""
        on_side = rng.random(n) < 2 * self.half / (2 * self.half + self.radius)
        angle, u = rng.uniform(0, 2 * np.pi, n), rng.uniform(-1, 1, n)
        ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1)
        cap = np.stack([np.zeros(n), np.zeros(n), np.sign(u)], axis=1)
        z = np.array([0.0, 0.0, self.half])
        side_points = self.radius * ring + u[:, None] * z
        cap_points = self.radius * np.sqrt(np.abs(u))[:, None] * ring + cap * z  # sqrt: uniform on the disc
        points = np.where(on_side[:, None], side_points, cap_points)
        normals = np.where(on_side[:, None], ring, cap)
        return self.center + np.roll(points, self.axis - 2, axis=1), np.roll(normals, self.axis - 2, axis=1)


class Torus(NamedTuple):
    """A torus about coordinate axis `axis`."""

    center: Vec
    axis: int
    major: float
    minor: float

    def area(self) -> float:
        """Surface area."""
        return 4 * np.pi**2 * self.major * self.minor

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether each point lies strictly inside."""
        local = np.roll(points - self.center, 2 - self.axis, axis=1)
        tube = np.hypot(np.hypot(local[:, 0], local[:, 1]) - self.major, local[:, 2])
        return tube < self.minor - 1e-9

    def sample(self, n: int, rng: np.random.Generator) -> PointsNormals:
        """Draw `n` surface points and their outward normals."""
        u, v = rng.uniform(0, 2 * np.pi, (2, n))
        # The outer half of the tube has more area. Mirroring the surplus draws to the other half gives the
        # density 1 + (minor / major) cos v exactly, without a rejection loop.
        keep = rng.random(n) < 0.5 * (1 + self.minor / self.major * np.cos(v))
        v = np.where(keep, v, np.pi - v)
        normals = np.stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)], axis=1)
        ring = self.major * np.stack([np.cos(u), np.sin(u), np.zeros(n)], axis=1)
        points = np.roll(ring + self.minor * normals, self.axis - 2, axis=1)
        return self.center + points, np.roll(normals, self.axis - 2, axis=1)


Part: TypeAlias = Box | Cylinder | Torus

_PARTS: dict[str, tuple[Part, ...]] = {
    "bracket": (Box((0, 0, 0.1), (1, 0.6, 0.1)), Box((-0.9, 0, 0.7), (0.1, 0.6, 0.6)),
                Cylinder((0.4, 0.2, 0.3), 2, 0.25, 0.2), Box((-0.5, -0.4, 0.4), (0.35, 0.06, 0.25))),
    "chair": (Box((0, 0, 0), (0.5, 0.5, 0.06)), Box((-0.45, 0, 0.6), (0.06, 0.5, 0.6)),
              *(Cylinder((x, y, -0.4), 2, 0.07, 0.4) for x in (-0.4, 0.4) for y in (-0.4, 0.4)),
              Box((0, 0.45, 0.35), (0.45, 0.06, 0.05)), Cylinder((0.35, 0.45, 0.15), 2, 0.05, 0.2)),
    "clamp": (Box((0, 0, 0), (0.12, 0.15, 0.8)), Box((0.45, 0, 0.7), (0.5, 0.15, 0.1)),
              Box((0.35, 0, -0.7), (0.4, 0.15, 0.1)), Cylinder((0.75, 0, 0.55), 2, 0.09, 0.5),
              Cylinder((0.75, 0.1, 1.0), 1, 0.05, 0.35)),
    "faucet": (Cylinder((0, 0, 0), 2, 0.35, 0.08), Cylinder((0, 0, 0.5), 2, 0.14, 0.5),
               Cylinder((0.45, 0, 0.85), 0, 0.1, 0.5), Cylinder((0.88, 0, 0.7), 2, 0.11, 0.2),
               Box((0, 0.3, 1.0), (0.06, 0.32, 0.05))),
    "gearbox": (Box((0, 0, 0), (0.6, 0.4, 0.45)), Cylinder((0.75, 0.1, 0.15), 0, 0.12, 0.35),
                Cylinder((-0.65, -0.1, -0.1), 0, 0.28, 0.15), Box((0.1, 0, -0.5), (0.75, 0.5, 0.06)),
                Cylinder((-0.25, 0.15, 0.5), 2, 0.15, 0.15)),
    "hammer": (Cylinder((0, 0, -0.2), 2, 0.09, 0.9), Cylinder((0.25, 0, 0.7), 0, 0.17, 0.25),
               Box((-0.15, 0, 0.7), (0.25, 0.12, 0.12)), Box((-0.5, 0.03, 0.62), (0.2, 0.09, 0.05)),
               Cylinder((0, 0, -0.85), 2, 0.13, 0.25)),
    "key": (Torus((0, 0, 0.75), 1, 0.3, 0.09), Box((0, 0, -0.15), (0.09, 0.07, 0.65)),
            Box((0.2, 0, -0.7), (0.15, 0.05, 0.08)), Box((0.16, 0, -0.42), (0.1, 0.05, 0.07)),
            Cylinder((0, 0.05, 0.4), 1, 0.16, 0.08)),
    "lamp": (Cylinder((0, 0, -0.9), 2, 0.4, 0.07), Cylinder((0, 0, -0.1), 2, 0.06, 0.8),
             Cylinder((0.35, 0, 0.65), 0, 0.06, 0.4), Cylinder((0.7, 0, 0.5), 2, 0.28, 0.18),
             Box((-0.2, 0.1, -0.8), (0.1, 0.07, 0.08))),
    "mug": (Cylinder((0, 0, 0), 2, 0.5, 0.6), Torus((0.5, 0, 0.1), 1, 0.33, 0.08),
            Cylinder((0, 0, -0.6), 2, 0.62, 0.06), Box((-0.1, 0.48, 0.25), (0.2, 0.1, 0.15))),
    "pump": (Cylinder((0, 0, 0), 1, 0.5, 0.3), Cylinder((0.4, 0.05, 0.45), 2, 0.16, 0.5),
             Cylinder((0, -0.5, 0), 1, 0.2, 0.3), Box((0, 0.1, -0.55), (0.6, 0.35, 0.08)),
             Cylinder((0.1, 0.55, 0.05), 1, 0.3, 0.35)),
    "shaft": (Cylinder((0, 0, -0.4), 2, 0.3, 0.55), Cylinder((0, 0, 0.4), 2, 0.19, 0.55),
              Cylinder((0, 0, -0.8), 2, 0.5, 0.07), Box((0.28, 0, -0.3), (0.1, 0.09, 0.25)),
              Box((0.05, 0.17, 0.65), (0.07, 0.08, 0.2))),
    "valve": (Cylinder((0, 0, 0), 0, 0.2, 0.9), Cylinder((0.8, 0, 0), 0, 0.38, 0.07),
              Cylinder((-0.1, 0, 0.35), 2, 0.1, 0.45), Torus((-0.1, 0, 0.75), 2, 0.35, 0.06),
              Box((-0.1, 0, 0.75), (0.33, 0.05, 0.04)), Box((-0.7, 0.2, 0.05), (0.12, 0.12, 0.1))),
}  # fmt: skip

SHAPES: tuple[str, ...] = tuple(_PARTS)
"""Names of the built-in shapes."""


def _sample_union(parts: tuple[Part, ...], n: int, rng: np.random.Generator) -> PointsNormals:
    """Draw points by area from the outer surface of a union; what is buried in another part is dropped."""
    area = np.array([part.area() for part in parts])
    points, normals = np.empty((0, 3)), np.empty((0, 3))
    while len(points) < n:
        batch = rng.multinomial(2 * n, area / area.sum())
        for i, (part, count) in enumerate(zip(parts, batch, strict=True)):
            p, normal = part.sample(int(count), rng)
            outside = ~np.any([other.contains(p) for j, other in enumerate(parts) if j != i], axis=0)
            points, normals = np.vstack([points, p[outside]]), np.vstack([normals, normal[outside]])
    rows = rng.permutation(len(points))[:n]
    return points[rows], normals[rows]


@cache
def _frame(name: str) -> tuple[Array, float]:
    """Centre and radius of a shape, from a sample of its own: every later draw then shares one frame."""
    rng = np.random.default_rng([zlib.crc32(name.encode()), 0])
    points, _ = _sample_union(_PARTS[name], DENSE_POINTS, rng)
    center = points.mean(axis=0)
    return center, float(np.linalg.norm(points - center, axis=1).max())


def shape(name: str, num_points: int, rng: np.random.Generator) -> PointsNormals:
    """Draw points from the surface of a built-in shape.

    Parameters
    ----------
    name : str
        One of `SHAPES`.
    num_points : int
        How many points to draw, uniformly by area.
    rng : numpy.random.Generator
        Source of randomness. The frame of a shape does not depend on it: two draws lie on one and the same
        surface.

    Returns
    -------
    points : (num_points, 3) float64
        Centred, within the unit sphere (to about one per cent, as the radius is measured on a sample).
    normals : (num_points, 3) float64
        Outward unit normals.

    Raises
    ------
    ValueError
        If `name` is unknown or `num_points` is not positive.
    """
    if name not in _PARTS:
        raise ValueError(f"unknown shape {name!r}; the built-in shapes are {', '.join(SHAPES)}")
    if num_points < 1:
        raise ValueError(f"num_points must be at least 1, got {num_points}")
    points, normals = _sample_union(_PARTS[name], num_points, rng)
    center, radius = _frame(name)
    return (points - center) / radius, normals


def to_unit_sphere(points: Array) -> Array:
    """Move the mean to the origin and the farthest point to distance 1."""
    centred = points - points.mean(axis=0)
    radius = np.linalg.norm(centred, axis=1).max()
    if not radius > 0:
        raise ValueError("a shape needs at least two distinct finite points")
    scaled: Array = centred / radius
    return scaled


def sample_mesh(path: str | Path, num_points: int, rng: np.random.Generator) -> PointsNormals:
    """Draw points from the triangles of a PLY mesh.

    Parameters
    ----------
    path : str or pathlib.Path
        Binary little-endian PLY with float x, y, z per vertex and triangles as `list uchar int`; that is the
        layout of the meshes in the repository's ``examples/models``. Anything else is better read by a mesh
        library and passed on as arrays.
    num_points : int
        How many points to draw, uniformly by area.
    rng : numpy.random.Generator
        Source of randomness.

    Returns
    -------
    points : (num_points, 3) float64
        In the unit of the file.
    normals : (num_points, 3) float64
        Unit normal of the triangle that each point lies on.

    Raises
    ------
    ValueError
        If the file has another layout or no area.
    """
    vertices, triangles = _read_ply(Path(path))
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    double_area = np.linalg.norm(cross, axis=1)
    if not double_area.sum() > 0:
        raise ValueError(f"{path}: the mesh has no area")
    rows = rng.choice(len(triangles), size=num_points, p=double_area / double_area.sum())
    u, v = rng.random((2, num_points, 1))
    fold = u + v > 1  # the far half of the parallelogram, folded back into the triangle
    u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
    points = a[rows] + u * (b - a)[rows] + v * (c - a)[rows]
    return points, cross[rows] / double_area[rows, None]


_VERTEX = np.dtype([("xyz", "<f4", 3)])
_TRIANGLE = np.dtype([("count", "u1"), ("index", "<i4", 3)])


def _read_ply(path: Path) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (V, 3) and triangles (T, 3) of a PLY file in the layout that `sample_mesh` documents."""
    data = path.read_bytes()
    head, found, body = data.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    lines = [words for words in lines if words and words[0] in ("format", "element", "property")]
    wanted = [["format", "binary_little_endian", "1.0"], ["element", "vertex"], ["property", "float", "x"],
              ["property", "float", "y"], ["property", "float", "z"], ["element", "face"],
              ["property", "list", "uchar", "int"]]  # fmt: skip
    begins = [words[: len(w)] for words, w in zip(lines, wanted, strict=False)]
    if not found or len(lines) != len(wanted) or begins != wanted:
        raise ValueError(f"{path}: not a binary little-endian PLY of float x, y, z and triangles")
    num_vertices, num_faces = int(lines[1][2]), int(lines[5][2])
    if len(body) < num_vertices * _VERTEX.itemsize + num_faces * _TRIANGLE.itemsize:
        raise ValueError(f"{path}: the file is shorter than its header says")
    vertices = np.frombuffer(body, _VERTEX, num_vertices)["xyz"].astype(np.float64)
    faces = np.frombuffer(body, _TRIANGLE, num_faces, num_vertices * _VERTEX.itemsize)
    triangles = faces["index"].astype(np.int64)
    if np.any(faces["count"] != 3) or np.any(triangles < 0) or np.any(triangles >= num_vertices):
        raise ValueError(f"{path}: faces must be triangles over existing vertices")
    return vertices, triangles


def catalogue(
    shapes: Mapping[str, tuple[Array, Array | None]] | str | Path | None,
) -> dict[str, Callable[[], tuple[Array, Array | None]]]:
    """Name each available shape and how to get its dense cloud; nothing is loaded before it is used.

    A dense cloud is seeded by the shape's name alone, so it is the same in every scene and its descriptors
    can be kept.
    """
    loaders: dict[str, Callable[[], tuple[Array, Array | None]]]
    if shapes is None:
        loaders = {name: partial(shape, name, DENSE_POINTS, _dense_rng(name)) for name in SHAPES}
    elif isinstance(shapes, (str, Path)):
        loaders = {path.stem: partial(_dense_mesh, path) for path in sorted(Path(shapes).glob("*.ply"))}
    else:
        loaders = {name: partial(_dense_cloud, *shapes[name]) for name in sorted(shapes)}
    if not loaders:
        raise ValueError(f"no shapes found in {shapes!r}")
    return loaders


def _dense_rng(name: str) -> np.random.Generator:
    return np.random.default_rng([zlib.crc32(name.encode()), 1])


def _dense_mesh(path: Path) -> PointsNormals:
    points, normals = sample_mesh(path, DENSE_POINTS, _dense_rng(path.stem))
    return to_unit_sphere(points), normals


def _dense_cloud(points: Array, normals: Array | None) -> tuple[Array, Array | None]:
    points = np.asarray(points, dtype=np.float64)
    normals = None if normals is None else np.asarray(normals, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or (normals is not None and normals.shape != points.shape):
        raise ValueError("points and normals of a shape must be (n, 3) arrays of equal length")
    return to_unit_sphere(points), normals
