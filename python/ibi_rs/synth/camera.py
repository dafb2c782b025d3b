"""A depth camera: what it sees, and what it makes of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .casting import Solids
from .scene import Array, move

__all__ = ["DepthImage", "Flaws", "Sight", "pinhole", "sight", "spoilt"]

_BLUR = 2.0  # pixels: half of the noise is that of stereo matching, which is shared by neighbours
_GRAZING = np.cos(np.radians(75))  # a surface that is seen more slantingly is lost more and more
_SPECKLE = 0.005  # share of pixels that are lost anyhow
_BASELINE = 0.07  # between the two eyes of a stereo camera, distances: that of common ones at 0.7 m


@dataclass(frozen=True, eq=False, repr=False)
class DepthImage:
    """A depth image, and where it was taken from.

    Lengths are in the unit of the meshes. The camera's frame: origin at the camera, x to the right, y down,
    z forward.

    Attributes
    ----------
    depth : (H, W) float64
        z of what each pixel measured, in the camera's frame; NaN without a measurement. It is the point
        ((column - cx) / fx, (row - cy) / fy, 1) * depth.
    labels : (H, W) int64
        Instance that each measured point lies on; -1 if on none.
    fx, fy, cx, cy : float
        Intrinsics, pixels.
    target_from_camera : (4, 4) float64
        Moves the camera's frame to that of the scene, as `ibi_rs.View.from_depth` takes it.
    """

    depth: Array
    labels: NDArray[np.int64]
    fx: float
    fy: float
    cx: float
    cy: float
    target_from_camera: Array

    def __repr__(self) -> str:
        """Summarise the image in one line."""
        height, width = self.depth.shape
        return f"DepthImage({width} x {height} pixels, {np.isfinite(self.depth).mean():.0%} measured)"

    @property
    def eye(self) -> Array:
        """Where the camera stood, in the frame of the scene, (3,)."""
        place: Array = self.target_from_camera[:3, 3]
        return place

    @property
    def grid(self) -> Array:
        """The points in the frame of the scene, (H, W, 3), NaN where there is none."""
        rays = pinhole(self.depth.shape, self.fx, self.fy, self.cx, self.cy)
        points = move(self.target_from_camera, (rays * self.depth[..., None]).reshape(-1, 3))
        return points.reshape(*self.depth.shape, 3)

    @property
    def points(self) -> Array:
        """The points in the frame of the scene, row by row, without those that are missing, (N, 3)."""
        points: Array = self.grid[np.isfinite(self.depth)]
        return points


def pinhole(shape: tuple[int, ...], fx: float, fy: float, cx: float, cy: float) -> Array:
    """Return the ray of each pixel in the camera's frame, (H, W, 3), of depth 1."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones(rows.shape)], axis=-1)


class Sight(NamedTuple):
    """What a camera sees, exactly.

    Attributes
    ----------
    depth : (H, W) float64
        inf: nothing.
    owner : (H, W) int64
        Solid that is seen; -1: none.
    slant : (H, W) float64
        Cosine between the ray and the normal.
    in_shadow : (H, W) bool
        Hidden from the second eye of a stereo camera, on the right of the first.
    """

    depth: Array
    owner: NDArray[np.int64]
    slant: Array
    in_shadow: NDArray[np.bool_]


def sight(solids: Solids, target_from_camera: Array, rays: Array) -> Sight:
    """Look at solids along rays of the camera's frame."""
    turn, eye = target_from_camera[:3, :3], target_from_camera[:3, 3]
    along = rays @ turn.T
    depth, owner, normals = solids.look(np.concatenate([np.broadcast_to(eye, rays.shape), along], axis=-1))
    slant = np.abs(np.sum(along * normals, axis=-1)) / np.linalg.norm(rays, axis=-1)
    is_hit = np.isfinite(depth)
    in_shadow = np.zeros(depth.shape, dtype=bool)
    points = eye + along[is_hit] * depth[is_hit, None]
    baseline = _BASELINE * np.median(depth[is_hit]) if is_hit.any() else 0.0
    second = np.broadcast_to(eye + baseline * turn[:, 0], points.shape)
    in_shadow[is_hit] = solids.is_blocked(second, points)
    return Sight(depth, owner, slant, in_shadow)


class Flaws(NamedTuple):
    """What a camera makes of what it sees; all 0: nothing.

    Attributes
    ----------
    noise : float
        Standard deviation along z at the depth `at`, data units; it grows with the square of the depth.
    quantum : float
        Step between two depths there; it grows likewise, as disparities have even steps.
    smear : float
        Share of the pixels beside a step of more than `jump` that measure something in between.
    dropout : float
        1: slanting, shaded and stray pixels are lost as in a stereo camera; 0: none are.
    at, jump : float
        Data units.
    """

    noise: float
    quantum: float
    smear: float
    dropout: float
    at: float
    jump: float


def spoilt(seen: Sight, flaws: Flaws, rng: np.random.Generator) -> tuple[Array, NDArray[np.int64]]:
    """Return depth (NaN: lost) and owners (-1: on none) as a camera measures them.

    One draw of each kind whatever the flaws are, so that a flaw changes nothing but itself.
    """
    depth = np.where(np.isfinite(seen.depth), seen.depth, np.nan)
    shape = depth.shape
    chance, share, side, lost = rng.random((4, *shape))
    noise = (rng.normal(size=shape) + _blurred(rng.normal(size=shape))) / np.sqrt(2)

    beside, owner = _beside(depth, side), seen.owner
    is_edge = np.abs(beside - depth) > flaws.jump
    is_smeared = is_edge & (chance < flaws.smear)
    depth = np.where(is_smeared, depth + share * (beside - depth), depth)
    owner = np.where(is_smeared, -1, owner)

    depth = depth + flaws.noise * (depth / flaws.at) ** 2 * noise
    if flaws.quantum > 0:
        # Even steps of 1 / depth, as wide at the depth `at` as asked for.
        step = flaws.quantum / flaws.at**2
        depth = 1 / (np.maximum(np.round(1 / depth / step), 1) * step)

    slanting = np.clip(1 - seen.slant / _GRAZING, 0, 1)
    is_lost = lost < flaws.dropout * np.maximum(np.maximum(slanting, _SPECKLE), seen.in_shadow)
    depth = np.where(is_lost, np.nan, depth)
    return depth, np.where(np.isfinite(depth), owner, -1)


def _beside(depth: Array, side: Array) -> Array:
    """Depth of one of the four neighbours of each pixel; beyond the border its own."""
    padded = np.pad(depth, 1, mode="edge")
    n, m = depth.shape
    ways = [padded[1 + i : 1 + i + n, 1 + j : 1 + j + m] for i, j in ((0, 1), (0, -1), (1, 0), (-1, 0))]
    return np.choose(np.minimum((4 * side).astype(np.int64), 3), ways)


def _blurred(white: Array) -> Array:
    """White noise, blurred across the image, of standard deviation 1 again."""
    waves = [np.exp(-2 * (np.pi * _BLUR * np.fft.fftfreq(n)) ** 2) for n in white.shape]
    passed = waves[0][:, None] * waves[1]
    blurred: Array = np.fft.ifft2(np.fft.fft2(white) * passed).real / np.sqrt(np.mean(passed**2))
    return blurred
