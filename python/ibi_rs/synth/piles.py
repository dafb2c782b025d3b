"""Piles of one part on a table, as one depth camera sees them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from .casting import Ground, Solids, checked_mesh, looking_at, sides
from .common import Layout, Purpose, random_poses, stream
from .descriptors import load_open3d
from .scene import Array, move

__all__ = ["Pile", "pile_scene"]

_VOXELS_PER_DIAMETER = 24  # of Model.from_mesh; diameter is here the diagonal of the mesh's bounding box
_CELLS_PER_DIAMETER = 96  # of the height maps: a quarter of a voxel
_PLACES = 8  # drawn for each instance; it falls to the lowest, as if it had slid there
_MARGIN = 0.5  # of table about the pile, diameters


@dataclass(frozen=True, eq=False, repr=False)
class Pile:
    """A pile as seen by a depth camera, with its truth.

    Lengths are in the unit of the mesh. The frame is the camera's: origin at the camera, x to the right, y
    down, z forward.

    Attributes
    ----------
    points : (N, 3) float64
        The scan, noise and table included: the pixels of `depth` that hold a depth, row by row.
    labels : (N,) int64
        Instance that each point lies on, -1 for the table.
    depth : (H, W) float64
        z of what each pixel sees, NaN where it sees nothing. It is the point
        ((column - cx) / fx, (row - cy) / fy, 1) * depth.
    fx, fy, cx, cy : float
        Intrinsics, pixels.
    poses : (K, 4, 4) float64
        camera_from_model of all instances, in the order in which they fell; also of those that are hidden.
    visibility : (K,) float64
        Of the pixels that would see an instance if it were alone, the share that sees it in the pile.
    table : (4,) float64
        Unit normal n towards the camera, and d: table points have n . x + d = 0.
    voxel : float
        1/24 of the diagonal of the mesh's bounding box: the unit of the noise and of the pixels.
    """

    points: Array
    labels: NDArray[np.int64]
    depth: Array
    fx: float
    fy: float
    cx: float
    cy: float
    poses: Array
    visibility: Array
    table: Array
    voxel: float

    def __repr__(self) -> str:
        """Summarise the pile in one line."""
        seen = ", ".join(f"{share:.0%}" for share in self.visibility)
        height, width = self.depth.shape
        return f"Pile({len(self.poses)} instances, visible {seen}; {width} x {height} pixels)"


def pile_scene(
    vertices: npt.ArrayLike,
    faces: npt.ArrayLike,
    *,
    seed: int,
    num_instances: int = 10,
    layers: float = 1.5,
    tilt_deg: tuple[float, float] = (20.0, 40.0),
    distance: float = 6.0,
    pixel: float = 0.45,
    noise: float = 0.3,
) -> Pile:
    """Let instances of a mesh fall onto a table, and look at the heap with a depth camera.

    Each instance is turned at random and comes down in a disc until it touches what lies there: its
    underside and the top of the heap are height maps, so instances touch and do not run into one another. It
    stays as it fell; nothing tips over. What the camera sees is found by casting a ray through each pixel,
    which needs Open3D. The mesh need not be closed; of an open one the camera also sees the inside.

    Parameters
    ----------
    vertices : (V, 3) array_like
        Of the mesh, in any unit.
    faces : (F, 3) array_like of int
        Rows of `vertices`.
    seed : int
        Non-negative; the same seed and arguments give the same pile. Across machines the last bits of Open3D
        may differ.
    num_instances : int
        At least 1.
    layers : float
        Area of all instances, as seen from above, over that of the disc in which their middles come down.
        Above 0; more: a steeper heap, and more of it hidden.
    tilt_deg : (float, float)
        Range from which the angle between the line of sight and the vertical is drawn, degrees, within
        [0, 60].
    distance : float
        From the camera to the middle of the heap, diagonals of the mesh's bounding box.
    pixel : float
        Width of what a pixel sees in the middle of the heap, voxels (1/24 diagonal).
    noise : float
        Standard deviation of the noise along the ray, voxels.

    Returns
    -------
    Pile

    Raises
    ------
    ImportError
        If Open3D is not installed; the message names the extra that brings it.
    ValueError
        If the mesh has no extent or names vertices that do not exist, an argument is out of range, or the
        heap reaches up to the camera.

    Examples
    --------
    >>> from ibi_rs import synth
    >>> corners = [[x, y, z] for x in (0, 3) for y in (0, 2) for z in (0, 1)]
    >>> sides = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
    ...          [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    >>> pile = synth.pile_scene(corners, sides, seed=1, num_instances=3)     # doctest: +SKIP
    >>> pile.poses.shape                                                     # doctest: +SKIP
    (3, 4, 4)
    """
    lo, hi = tilt_deg
    if num_instances < 1 or not noise >= 0 or not min(layers, distance, pixel) > 0:
        raise ValueError(
            "num_instances must be at least 1, layers, distance and pixel above 0, and noise at least 0"
        )
    if not 0 <= lo <= hi <= 60:
        raise ValueError(f"tilt_deg must be a range in order within [0, 60], got {tilt_deg}")
    points, triangles = checked_mesh(vertices, faces)
    load_open3d("Piles need")
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    voxel = size / _VOXELS_PER_DIAMETER
    world_from_model = _heap(points, triangles, num_instances, layers, size, seed)

    draw = stream(seed, Layout.PILE, Purpose.DRAW)
    corners = np.concatenate([move(pose, points) for pose in world_from_model])
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    tilt, azimuth = np.radians(draw.uniform(lo, hi)), draw.uniform(0, 2 * np.pi)
    camera_from_world = looking_at(middle, tilt, azimuth, distance * size)
    poses = camera_from_world @ world_from_model
    table = np.append(camera_from_world[:3, 2], -camera_from_world[:3, 2] @ camera_from_world[:3, 3])

    seen = move(camera_from_world, corners)
    if seen[:, 2].min() < size / 2:
        raise ValueError(f"the heap reaches up to the camera; distance must be more than {distance:g}")
    focal = distance * size / (pixel * voxel)
    half = np.abs(seen[:, :2] / seen[:, 2:]).max(axis=0) * focal + _MARGIN * size / (pixel * voxel)
    cx, cy = np.ceil(half)
    rows, columns = np.mgrid[: 2 * int(cy) + 1, : 2 * int(cx) + 1]
    rays = np.stack([(columns - cx) / focal, (rows - cy) / focal, np.ones(rows.shape)], axis=-1)

    depth, owner = _view(points, triangles, poses, rays, table)
    visibility = np.zeros(num_instances)
    for k in range(num_instances):
        _, alone = _view(points, triangles, poses[k : k + 1], rays, table)
        visibility[k] = np.sum(owner == k) / max(np.sum(alone == 0), 1)
    along = stream(seed, Layout.PILE, Purpose.POINTS).normal(0, noise * voxel, depth.shape)
    depth = depth + along / np.linalg.norm(rays, axis=-1)
    is_hit = np.isfinite(depth)
    return Pile(
        rays[is_hit] * depth[is_hit, None],
        owner[is_hit],
        depth,
        focal,
        focal,
        float(cx),
        float(cy),
        poses,
        visibility,
        table,
        voxel,
    )


# The heap, in the frame of the table: z up, the table is z = 0 ----------------------------------------------


def _heap(
    points: Array, triangles: NDArray[np.int64], num_instances: int, layers: float, size: float, seed: int
) -> Array:
    """Let instances fall one after another; return world_from_model, (K, 4, 4)."""
    rng = stream(seed, Layout.PILE, Purpose.POSES)
    cell = size / _CELLS_PER_DIAMETER
    # Turned about the middle of its box, an instance lies within size / 2 of its place.
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    poses = random_poses(num_instances, rng, 0.0)
    maps = [sides((points - middle) @ pose[:3, :3].T, triangles, cell) for pose in poses]
    area = sum(np.isfinite(upper).sum() for _, _, upper in maps) * cell**2
    reach = math.sqrt(area / (np.pi * layers))

    ground = Ground(math.ceil((reach + size) / cell) + 2)
    for pose, (first, under, upper) in zip(poses, maps, strict=True):
        radius, angle = reach * np.sqrt(rng.random(_PLACES)), rng.uniform(0, 2 * np.pi, _PLACES)
        places = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        # Whole cells, so that the maps of the instance and of the heap have the same ones.
        cells = np.round(places / cell).astype(np.int64)
        heights = [ground.rest(first + place, under) for place in cells]
        best = int(np.argmin(heights))
        ground.add(first + cells[best], upper, heights[best])
        pose[:3, 3] = np.append(cells[best] * cell, heights[best]) - pose[:3, :3] @ middle
    return poses


# The view ---------------------------------------------------------------------------------------------------


def _view(
    points: Array, triangles: NDArray[np.int64], poses: Array, rays: Array, table: Array
) -> tuple[Array, NDArray[np.int64]]:
    """Depth along each ray (NaN: nothing), and the instance it ends on (-1: none)."""
    from_camera = np.concatenate([np.zeros_like(rays), rays], axis=-1)
    depth, owner = Solids([(move(pose, points), triangles) for pose in poses]).cast(from_camera)
    # Rays go down to the table, or else miss it.
    down = rays @ table[:3]
    with np.errstate(divide="ignore"):
        of_table = np.where(down < 0, -table[3] / down, np.inf)
    is_table = of_table < depth
    depth = np.where(is_table, of_table, depth)
    return np.where(np.isfinite(depth), depth, np.nan), np.where(is_table, -1, owner)
