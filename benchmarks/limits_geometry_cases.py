"""Cases of limits.py outside of the rounds: name, call of a size, sizes, whether it has a time limit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import ibi_rs as ibi
import numpy as np
from ibi_rs import features, metrics

Call = Callable[[float | None], object]


def ball(size: int) -> np.ndarray:
    """Points on a sphere: all as far from the middle."""
    points = np.random.default_rng(1).normal(size=(size, 3))
    return points / np.linalg.norm(points, axis=1)[:, None]


def places(count: int) -> np.ndarray:
    """Poses a few radii apart."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = 3 * np.random.default_rng(2).normal(size=(count, 3))
    return poses


def of_ball(job: Callable[[np.ndarray], object]) -> Callable[[int], Call]:
    """Call `job` with so many points of a sphere."""

    def call_of(size: int) -> Call:
        points = ball(size)
        return lambda _: job(points)

    return call_of


def shadows(size: int) -> Call:
    """Register a model that has yet to learn what it hides of itself, in a scene of one view."""
    points = ball(size) * [1.0, 0.7, 0.5]
    normals = points / np.array([1.0, 0.49, 0.25])
    tgt, rows = points[:2000] + np.array([3.0, 0.0, 0.0]), np.arange(2000)
    eye, params = [0.0, 0.0, 20.0], ibi.Params.single_view()

    def call(timeout_s: float | None) -> object:
        model = ibi.Model(points, normals=normals)
        corr = np.stack([rows, rows], 1)
        options: dict[str, Any] = {"tgt_normals": normals[:2000], "viewpoint": eye, "timeout_s": timeout_s}
        return model.register(tgt, corr, params, **options)

    return call


def torus(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Make a mesh of about so many faces."""
    n = int((size / 2) ** 0.5)
    u, v = np.meshgrid(*2 * [np.arange(n) * 2 * np.pi / n], indexing="ij")
    vertices = np.stack([(2 + np.cos(v)) * np.cos(u), (2 + np.cos(v)) * np.sin(u), np.sin(v)], -1)
    i, j = np.meshgrid(*2 * [np.arange(n)], indexing="ij")
    a, b, c, d = (x % n * n + y % n for x, y in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)))
    faces = np.concatenate([np.stack(three, -1).reshape(-1, 3) for three in ((a, b, c), (a, c, d))])
    return vertices.reshape(-1, 3), faces


def mesh(size: int) -> Call:
    """Make a model of a fine mesh: nearly all of it the outer surface."""
    vertices, faces = torus(size)
    return lambda _: ibi.Model.from_mesh(vertices, faces)


def slivers(size: int) -> Call:
    """Find the outer surface of a cylinder whose faces are as long as it is."""
    angle = np.arange(size // 2) * 2 * np.pi / (size // 2)
    ring, row = np.stack([np.cos(angle), np.sin(angle)], -1), np.arange(size // 2)
    vertices = np.concatenate([np.insert(ring, 2, z, axis=1) for z in (0.0, 3.0)])
    other = np.roll(row, -1)
    up = size // 2
    faces = np.concatenate(
        [np.stack([row, other, row + up], -1), np.stack([other, other + up, row + up], -1)]
    )
    points, normals = features.sample_mesh(vertices, faces, spacing=0.1)
    return lambda _: features.outer_surface(points, normals, vertices, faces)


def scored(size: int) -> Call:
    """Score a scene by ADD-S: so many points, ten poses against ten."""
    points, poses = ball(size), places(10)
    return lambda _: metrics.score_scene(poses, poses[::-1], criterion=metrics.ADD_S, model=points)


def matched(size: int) -> Call:
    """So many descriptors of a source, of which nothing is alike, against a thousand."""
    rows = np.random.default_rng(3).normal(size=(size, 33)).astype(np.float32)
    return lambda _: ibi.match(rows, rows[:1000], k=4)


def near(points: np.ndarray) -> object:
    """Measure ADD-S of a pose and one next to it."""
    moved = np.eye(4)
    moved[0, 3] = 0.001
    return metrics.add_s(points, moved, np.eye(4))


def of_zeros(job: Callable[[np.ndarray], object]) -> Callable[[int], Call]:
    """Return a call on points of which three of four lie at the origin, as pixels of nothing do."""

    def call_of(size: int) -> Call:
        points = ball(size)
        points[size // 4 :] = 0
        return lambda _: job(points)

    return call_of


def wide(size: int) -> Call:
    """Register where all of a model lies within `t_he` of each of its points, and normals count."""
    rng = np.random.default_rng(4)
    points, normals = rng.random((size, 3)), rng.normal(size=(size, 3))
    corr = rng.integers(0, size, (size, 2))
    corr[::2, 1] = corr[::2, 0]
    options: dict[str, Any] = {"src_normals": normals, "tgt_normals": normals}
    params = ibi.Params(t_he_pr=100, max_rounds=3)
    return lambda timeout_s: ibi.register(points, points, corr, params, timeout_s=timeout_s, **options)


THOUSANDS = (25_000, 50_000, 100_000, 200_000)
MILLIONS = (500_000, 1_000_000, 2_000_000, 5_000_000)
ROWS: list[tuple[str, Callable[[int], Call], tuple[int, ...], bool]] = [
    ("diameter of a ball", of_ball(metrics.diameter), (*THOUSANDS, 1_000_000), False),
    ("a ball as model", of_ball(ibi.Model), MILLIONS, False),
    ("mostly zeros as model", of_zeros(ibi.Model), MILLIONS, False),
    ("t_he over all, with normals", wide, THOUSANDS, True),
    ("own shadows", shadows, (40_000, 160_000, 500_000, 1_000_000), True),
    ("add_s", of_ball(near), MILLIONS[:3], False),
    ("add_s, mostly zeros", of_zeros(near), MILLIONS[:3], False),
    ("score_scene by ADD-S", scored, (2500, 5000, 10_000, 20_000), False),
    ("thinning", of_ball(lambda p: features.voxel_downsample(p, 0.001, normals=p)), MILLIONS, False),
    ("normals", of_ball(lambda p: features.estimate_normals(p, 3 * len(p) ** -0.5)), MILLIONS[:3], False),
    ("fpfh, huge radius", of_ball(lambda p: features.fpfh(p, p, 1e3)), THOUSANDS, False),
    ("match", matched, THOUSANDS, False),
    ("dominant_plane", of_ball(lambda p: features.dominant_plane(p, 0.01, min_share=0.01)), MILLIONS, False),
    ("from_mesh", mesh, (100_000, 200_000, 400_000, 864_000), False),
    ("outer surface of slivers", slivers, (100_000, 200_000, 400_000, 800_000), False),
    ("find_symmetries", of_ball(ibi.find_symmetries), (20_000, 200_000, 1_000_000), False),
]
