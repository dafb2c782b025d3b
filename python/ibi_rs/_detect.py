"""From a mesh and a scan to what `register` wants: the steps behind `Model.from_mesh` and `Model.correspond`.

The constants were chosen on ray-cast piles, tuning half of benchmarks/piles.py, and on the seven scans of
benchmarks/detect.py.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ibi_rs import _core, features

Floats = npt.NDArray[np.float64]

VOXELS_PER_DIAMETER, MAX_VOXELS_PER_DIAMETER = 24, 48
MIN_MODEL_POINTS = 700
"""A slender part is thinned less: with 200 points it is not known again."""
SAMPLES_PER_VOXEL = 2
VOXELS_PER_SPACING = 1.25
"""Points that were thinned to a voxel are so much nearer than a voxel, on average."""
NORMAL_VOXELS, NORMAL_NEIGHBORS = 2, 30
"""Wider ones round off what is thin."""
FEATURE_VOXELS, FEATURE_NEIGHBORS = 6, 150
PER_POINT = 4
"""Nearest model points that each scene point is joined to: walls and edges repeat on a part."""
PLANE_VOXELS = 1.5
MAX_BEHIND = 0.02
"""A table has nothing behind it; the largest plane of a heap of parts has."""

MIN_EXTENTS, MAX_EXTENTS = 0.1, 300.0
"""A scene so many models wide is in another unit: millimetres for metres are a factor of 1000."""


class Matches(NamedTuple):
    """A scene as it was matched with a model: what :meth:`Model.register` wants."""

    tgt: Floats
    """(N, 3), thinned."""
    tgt_normals: Floats
    """(N, 3), of length 1."""
    corr: npt.NDArray[np.int64]
    """(M, 2): [row of the model's points, row of ``tgt``]."""
    similarity: npt.NDArray[np.float64]
    """(M,), as :func:`ibi_rs.match` gives it."""


def mesh_points(
    vertices: Floats, faces: npt.NDArray[np.int64], voxel: float | None, num_threads: int | None
) -> tuple[Floats, Floats, float]:
    """Points on the outer surface of a mesh, one a voxel, their normals, and the voxel."""
    features.sample_mesh(vertices, faces, n=1)  # refuses what is no mesh

    def thinned(voxel: float) -> tuple[Floats, Floats]:
        points, normals = features.sample_mesh(vertices, faces, spacing=voxel / SAMPLES_PER_VOXEL)
        seen = features.outer_surface(points, normals, vertices, faces, num_threads=num_threads)
        if not seen.any():
            raise _core.InputError(
                "faces: none is seen from outside; they have to be counter-clockwise from there"
            )
        src, src_normals = features.voxel_downsample(points[seen], voxel, normals=normals[seen])
        assert src_normals is not None  # normals were given
        return src, src_normals

    if voxel is not None:
        return *thinned(voxel), voxel
    used = vertices[np.unique(faces)]
    voxel = float(np.linalg.norm(np.ptp(used, axis=0))) / VOXELS_PER_DIAMETER
    src, src_normals = thinned(voxel)
    if len(src) < MIN_MODEL_POINTS:
        voxel *= max((len(src) / MIN_MODEL_POINTS) ** 0.5, VOXELS_PER_DIAMETER / MAX_VOXELS_PER_DIAMETER)
        src, src_normals = thinned(voxel)
    return src, src_normals, voxel


def scene_points(
    points: Floats,
    normals: Floats | None,
    voxel: float,
    viewpoint: Any,
    remove_plane: bool | None,
    num_threads: int | None,
) -> tuple[Floats, Floats]:
    """Points of a scan, one a voxel, without the table, and their normals."""
    try:
        tgt, tgt_normals = features.voxel_downsample(points, voxel, normals=normals)
    except _core.InputError as error:  # under the names that the caller gave them by
        named = str(error).replace("rows of points", "rows of tgt")
        for name, called in (("points", "tgt"), ("normals", "tgt_normals")):
            named = called + named.removeprefix(name) if named.startswith(name) else named
        raise _core.InputError(named) from None
    if remove_plane is not False:
        on_plane = _table(tgt, voxel, viewpoint, is_sure=remove_plane is True)
        tgt = tgt[~on_plane]
        tgt_normals = None if tgt_normals is None else tgt_normals[~on_plane]
    if tgt_normals is None:
        tgt_normals = features.estimate_normals(
            tgt, NORMAL_VOXELS * voxel, NORMAL_NEIGHBORS, viewpoint=viewpoint, num_threads=num_threads
        )
    return tgt, tgt_normals


def _table(tgt: Floats, voxel: float, viewpoint: Any, *, is_sure: bool) -> npt.NDArray[np.bool_]:
    plane = None
    if viewpoint is not None or is_sure:
        plane = features.dominant_plane(tgt, PLANE_VOXELS * voxel, viewpoint=viewpoint)
    is_table = plane is not None and (is_sure or plane.behind < MAX_BEHIND)
    # A scan of one flat part is a plane and nothing else.
    if plane is None or not is_table or plane.inliers.sum() > len(tgt) - 3:
        return np.zeros(len(tgt), dtype=bool)
    return plane.inliers


def describe(
    points: Floats, normals: Floats, voxel: float, num_threads: int | None
) -> npt.NDArray[np.float32]:
    """Descriptors, the same for both clouds."""
    radius = FEATURE_VOXELS * voxel
    return features.fpfh(points, normals, radius, FEATURE_NEIGHBORS, num_threads=num_threads)


def check_units(diameter: float, points: Floats) -> None:
    """Refuse a scan that cannot be in the unit of the model, whose diameter is given."""
    extent = float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0
    if not MIN_EXTENTS * diameter <= extent <= MAX_EXTENTS * diameter:
        raise _core.InputError(
            f"tgt: the scene is {extent:.3g} across and the model {diameter:.3g}; are they in the same unit?"
            " (Metres for millimetres are a factor of 1000.)"
        )
