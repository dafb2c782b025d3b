"""What the layouts share: streams of random numbers, poses, noise."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum

import numpy as np

from .scene import Array

__all__ = ["CLUTTER_SIDE", "Layout", "Purpose", "bounds", "jitter_noise", "random_poses", "spacing", "stream"]

CLUTTER_SIDE = 10.0

_JITTER_CLIP = 0.05  # per axis: 0.05 * sqrt(3) = 0.087 < INLIER_DISTANCE, so an exact pair stays a true pair
_DISTANCE = (2.5, 12.5)  # of an object from the origin


class Layout(IntEnum):
    """First key of a stream of random numbers."""

    ECC = 1
    OUTLIER = 2
    FPFH = 3
    PILE = 4
    BIN = 5
    ROWS = 6
    ROOM = 7


class Purpose(IntEnum):
    """Second key: one stream per purpose, so that descriptor noise, say, leaves the geometry alone."""

    DRAW = 0
    POSES = 1
    POINTS = 2
    CLUTTER = 3
    MATCHES = 4
    SHUFFLE = 5


def stream(seed: int, layout: Layout, purpose: Purpose, *keys: int) -> np.random.Generator:
    """Return the stream of random numbers of one seed, layout and purpose."""
    return np.random.default_rng([seed, layout, purpose, *keys])


def bounds(name: str, value: int | tuple[int, int], least: int = 1) -> tuple[int, int]:
    """Both ends of an argument that is one number or a range."""
    lo, hi = value if isinstance(value, (tuple, list)) else (value, value)
    if not least <= lo <= hi:
        raise ValueError(f"{name} must be a number from {least} or a range in order, got {value}")
    return int(lo), int(hi)


def jitter_noise(size: tuple[int, ...], sigma: float, rng: np.random.Generator) -> Array:
    """Gaussian noise, clipped."""
    return np.clip(rng.normal(0, sigma, size), -_JITTER_CLIP, _JITTER_CLIP)


def spacing(points: Array, *, chunk: int = 1024) -> float:
    """Mean distance from each point to the nearest other one."""
    total, squared = 0.0, np.sum(points**2, axis=1)
    for start in range(0, len(points), chunk):
        part = points[start : start + chunk]
        dist_sq = squared[start : start + chunk, None] + squared - 2 * part @ points.T
        rows = np.arange(len(part))
        dist_sq[rows, start + rows] = np.inf
        total += float(np.sqrt(np.maximum(dist_sq.min(axis=1), 0)).sum())
    return total / len(points)


def random_poses(
    k: int,
    rng: np.random.Generator,
    min_spacing: float,
    center: Callable[[np.random.Generator], Array] | None = None,
) -> Array:
    """Uniform rotations, and centres that `center` draws.

    Without it a centre lies in a random direction of the positive octant, 2.5 to 12.5 from the origin. One
    nearer than `min_spacing` to an earlier one is drawn again, up to 200 times; then the best draw is kept.
    """
    draw = _octant if center is None else center
    poses = np.tile(np.eye(4), (k, 1, 1))
    for i in range(k):
        poses[i, :3, :3] = _rotation(rng)
        best = -1.0
        for _ in range(200):
            drawn = draw(rng)
            gap = np.linalg.norm(poses[:i, :3, 3] - drawn, axis=1).min(initial=np.inf)
            if gap > best:
                best, poses[i, :3, 3] = gap, drawn
            if gap >= min_spacing:
                break
    return poses


def _octant(rng: np.random.Generator) -> Array:
    direction = np.abs(rng.normal(size=3))
    center: Array = direction / np.linalg.norm(direction) * rng.uniform(*_DISTANCE)
    return center


def _rotation(rng: np.random.Generator) -> Array:
    """Uniform rotation: a normalised Gaussian quaternion has no preferred direction."""
    q = rng.normal(size=4)
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
