"""Rays cast at meshes, and the height maps by which parts fall onto one another. Needs Open3D."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from .descriptors import load_open3d
from .scene import Array
from .solids import Mesh

__all__ = ["Ground", "Solids", "checked_mesh", "inverse", "looking_at", "sides"]


def checked_mesh(vertices: npt.ArrayLike, faces: npt.ArrayLike) -> Mesh:
    """Check a mesh, and drop the vertices that no face uses: they would count in the bounding box."""
    points, triangles = np.asarray(vertices, dtype=np.float64), np.asarray(faces)
    if points.shape[1:] != (3,) or not np.isfinite(points).all():
        raise ValueError("vertices must be a (V, 3) array of finite numbers")
    if triangles.shape[1:] != (3,) or not triangles.size or triangles.dtype.kind not in "iu":
        raise ValueError("faces must be an (F, 3) array of integers, at least one row")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise ValueError(f"faces must be rows of the {len(points)} vertices")
    used, rows = np.unique(triangles, return_inverse=True)
    points = points[used]
    if not np.ptp(points, axis=0).any():
        raise ValueError("the mesh has no extent")
    return points, rows.reshape(-1, 3)


def looking_at(middle: Array, tilt: float, azimuth: float, distance: float) -> Array:
    """Return camera_from_world of a camera that looks down at the middle; its x axis is level."""
    cos, sin = np.cos(azimuth), np.sin(azimuth)
    forward = -np.array([np.sin(tilt) * cos, np.sin(tilt) * sin, np.cos(tilt)])
    right = np.array([-sin, cos, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(forward, right), forward
    pose[:3, 3] = [0, 0, distance] - pose[:3, :3] @ middle
    return pose


def inverse(pose: Array) -> Array:
    """Return the inverse of a rigid motion."""
    back = np.eye(4)
    back[:3, :3] = pose[:3, :3].T
    back[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return back


class Solids:
    """Meshes at their places, which rays are cast at. They need not be closed."""

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        o3d = self._o3d = load_open3d("Ray-cast scenes need")
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        for points, triangles in meshes:
            self._scene.add_triangles(
                o3d.core.Tensor(points.astype(np.float32)), o3d.core.Tensor(triangles.astype(np.uint32))
            )

    def cast(self, rays: Array) -> tuple[Array, NDArray[np.int64]]:
        """Cast rays (..., 6), each its start and its direction.

        Returns
        -------
        t : (...) float64
            Length to the first mesh it meets, in multiples of its direction; inf: none.
        owner : (...) int64
            Which mesh that is; -1: none.
        """
        t, owner, _ = self.look(rays)
        return t, owner

    def look(self, rays: Array) -> tuple[Array, NDArray[np.int64], Array]:
        """Cast rays, and return the normals of the faces they meet, (..., 3), of either sign, too."""
        answer = self._scene.cast_rays(self._o3d.core.Tensor(rays.astype(np.float32)))
        t = answer["t_hit"].numpy().astype(np.float64)
        owner = answer["geometry_ids"].numpy().astype(np.int64)
        normals = answer["primitive_normals"].numpy().astype(np.float64)
        return t, np.where(np.isfinite(t), owner, -1), normals

    def is_blocked(self, starts: Array, ends: Array) -> NDArray[np.bool_]:
        """Whether something lies between two points, (..., 3) each, but for a ten-thousandth at both ends."""
        rays = np.concatenate([starts, ends - starts], axis=-1).astype(np.float32)
        blocked: NDArray[np.bool_] = self._scene.test_occlusions(
            self._o3d.core.Tensor(rays), tnear=1e-4, tfar=1 - 1e-4
        ).numpy()
        return blocked


def sides(points: Array, triangles: NDArray[np.int64], cell: float) -> tuple[NDArray[np.int64], Array, Array]:
    """Height maps of a turned mesh: its first cell, its underside (inf where it has none), its top (-inf).

    A cell's rim may hang lower than its middle, where the ray is cast, so the underside of a cell is that of
    the lowest of the nine about it.
    """
    first = np.floor(points[:, :2].min(axis=0) / cell).astype(np.int64) - 1
    last = np.floor(points[:, :2].max(axis=0) / cell).astype(np.int64) + 1
    x, y = (np.arange(lo, hi + 1) + 0.5 for lo, hi in zip(first, last, strict=True))
    places = np.stack(np.broadcast_arrays(x[:, None] * cell, y * cell), axis=-1)
    below, above = points[:, 2].min() - cell, points[:, 2].max() + cell
    solid = Solids([(points, triangles)])
    heights = []
    for start, way in ((below, 1.0), (above, -1.0)):
        rays = np.zeros((*places.shape[:2], 6))
        rays[..., :2], rays[..., 2], rays[..., 5] = places, start, way
        t, _ = solid.cast(rays)
        heights.append(start + way * t)
    # A mesh so thin that all rays miss it would fall through the table.
    rows = tuple((np.floor(points[:, :2] / cell).astype(np.int64) - first).T)
    np.minimum.at(heights[0], rows, points[:, 2])
    np.maximum.at(heights[1], rows, points[:, 2])
    padded = np.pad(heights[0], 1, constant_values=np.inf)
    n, m = heights[0].shape
    lowest = np.min([padded[i : i + n, j : j + m] for i in range(3) for j in range(3)], axis=0)
    return first, lowest, heights[1]


class Ground:
    """The top of what lies there already, as a height map; at first a floor at 0.

    Parameters
    ----------
    half : (2,) array_like of int
        Cells from the middle to each side.
    """

    def __init__(self, half: npt.ArrayLike) -> None:
        self._half = np.broadcast_to(np.asarray(half, dtype=np.int64), (2,))
        self.top = np.zeros(tuple(2 * self._half))

    def rest(self, first: NDArray[np.int64], under: Array) -> float:
        """Height at which what comes down touches the ground; `first` is its first cell."""
        return float(np.max(self._part(first, under) - under))

    def add(self, first: NDArray[np.int64], upper: Array, height: float) -> None:
        """Leave it there."""
        part = self._part(first, upper)
        np.maximum(part, upper + height, out=part)

    def _part(self, first: NDArray[np.int64], like: Array) -> Array:
        i, j = self._half + first
        return self.top[i : i + like.shape[0], j : j + like.shape[1]]
