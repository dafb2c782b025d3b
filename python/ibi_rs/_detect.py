"""From a mesh and a scan to what `register` wants: the steps behind `Model.from_mesh` and `Model.correspond`.

The constants were chosen on ray-cast piles, tuning half of benchmarks/piles.py, and on the seven scans of
benchmarks/detect.py.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ibi_rs import _core, _doubts, features
from ibi_rs._match import match

Floats = npt.NDArray[np.float64]

VOXELS_PER_DIAMETER, MAX_VOXELS_PER_DIAMETER = 24, 48
MIN_MODEL_POINTS = 700
"""A slender part is thinned less: with 200 points it is not known again."""
SAMPLES_PER_VOXEL = 2
MIN_TURNED = 0.02
"""Share of a mesh that is seen from its back only. Less is a gap that a ray slipped through."""
ALL_VIEWS, FEW_VIEWS, FEW_POINTS = 64, 16, 500
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

MIN_VOXELS_PER_DIAMETER, FEW_VOXELS_PER_DIAMETER = 8, 12
"""In larger voxels a part is a few points, which fit everywhere; below the second number that is told."""
COARSE = 1.15
"""A scan whose points are so much coarser than the voxel is matched at one that it fills."""
VOXEL_STEPS_PER_DOUBLING = 8
"""Voxels that are taken instead of the model's: few, as the model is described anew in each."""
STRAY_SPACINGS = 4
"""Points beside a table are stray ones if they are so much farther apart than those of the whole scan."""
TWIN_SPACINGS, MAX_TWINS = 0.1, 0.1
"""Model points so near are twins, in spacings; with a larger share of them it is thinned to be described."""
TABLE_DIAMETERS = 2.0
"""A plane that hangs together over more is no face of a part, nor of two that touch."""
TABLE_SHARE, BEHIND_SHARE, FRONT_PER_BEHIND = 0.3, 0.05, 0.1
"""Shares of a scan: on a table, and behind it; and before it to behind it, where it is seen from below."""


class _Matched(NamedTuple):
    tgt: Floats
    """(N, 3), thinned."""
    tgt_normals: Floats
    """(N, 3), of length 1."""
    corr: npt.NDArray[np.int64]
    """(M, 2): [row of the model's points, row of ``tgt``]."""
    similarity: npt.NDArray[np.float64]
    """(M,), as :func:`ibi_rs.match` gives it."""


class Matches(_Matched):
    """A scene as it was matched with a model: what :meth:`Model.register` wants, as a tuple of four.

    Attributes
    ----------
    tgt : (N, 3) float64
        The scene, thinned.
    tgt_normals : (N, 3) float64
        Of length 1.
    corr : (M, 2) int64
        [row of the model's points, row of ``tgt``].
    similarity : (M,) float64
        As :func:`ibi_rs.match` gives it.
    voxel : float
        What the scene was thinned to, data units: :attr:`Model.voxel`, or more where the scan is coarser.
        Then :meth:`Model.detect` registers with a ``resolution`` of ``voxel / 1.25``, unless ``params`` has
        one.
    warnings : tuple of str
        What is doubtful about the scene, one line each.
    """

    voxel: float
    warnings: tuple[str, ...]


class Scan(NamedTuple):
    """A scan, thinned, without its table."""

    points: Floats
    normals: Floats
    voxel: float
    whole: Floats
    """With its table."""
    whole_normals: Floats | None
    """If they were given."""
    table_above: bool
    """Whether nearly all of it lies behind a table, as seen from the viewpoint."""


def mesh_points(
    vertices: Floats, faces: npt.NDArray[np.int64], voxel: float | None, num_threads: int | None
) -> tuple[Floats, Floats, float]:
    """Points on the outer surface of a mesh, one a voxel, their normals, and the voxel."""
    features.sample_mesh(vertices, faces, n=1)  # refuses what is no mesh

    def thinned(voxel: float) -> tuple[Floats, Floats]:
        points, normals = features.sample_mesh(vertices, faces, spacing=voxel / SAMPLES_PER_VOXEL)
        seen = features.outer_surface(points, normals, vertices, faces, num_threads=num_threads)
        # A face that is turned inwards is seen from its back. Of a sheet, seen from both sides, the front
        # counts. Few directions tell whether there are such faces.
        rest = np.flatnonzero(~seen)
        for num_views, rows in ((FEW_VIEWS, rest[:: 1 + len(rest) // FEW_POINTS]), (ALL_VIEWS, rest)):
            if len(rest) < MIN_TURNED * len(points):
                break
            turned = features.outer_surface(
                points[rows], -normals[rows], vertices, faces, num_views=num_views, num_threads=num_threads
            )
            if turned.mean() * len(rest) < MIN_TURNED * len(points):
                break
            if num_views == ALL_VIEWS:
                normals[rows[turned]] *= -1
                seen[rows[turned]] = True
        if not seen.any():
            raise _core.InputError("faces: none is seen from outside")
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


def scan_points(
    points: Floats,
    normals: Floats | None,
    voxel: float,
    diameter: float,
    viewpoint: Any,
    remove_plane: bool | None,
    num_threads: int | None,
) -> Scan:
    """Points of a scan without its table, one a voxel, and normals. The voxel is one that the scan fills."""
    given = voxel
    while True:
        tgt, tgt_normals = _thinned(points, normals, voxel)
        on_plane, is_above = _table(tgt, voxel, diameter, viewpoint, remove_plane)
        left = tgt[~on_plane]
        spacing = _spacing(left)
        if spacing == math.inf or VOXELS_PER_SPACING * spacing <= COARSE * voxel:
            break
        # Too coarse: the scan is, or there are but stray points beside its table.
        of_whole = _spacing(tgt)
        if spacing > STRAY_SPACINGS * max(of_whole, given):
            left, on_plane = left[:0], np.ones_like(on_plane)
            break
        filled = VOXELS_PER_SPACING * min(spacing, of_whole)
        if voxel > given or filled <= COARSE * voxel:
            break
        steps = VOXEL_STEPS_PER_DOUBLING * math.log2(filled / given)
        voxel = given * 2 ** (math.ceil(steps) / VOXEL_STEPS_PER_DOUBLING)
    if tgt_normals is not None:
        of_left = tgt_normals[~on_plane]
    else:
        of_left = features.estimate_normals(
            left, NORMAL_VOXELS * voxel, NORMAL_NEIGHBORS, viewpoint=viewpoint, num_threads=num_threads
        )
    return Scan(left, of_left, voxel, tgt, tgt_normals, is_above)


def _thinned(points: Floats, normals: Floats | None, voxel: float) -> tuple[Floats, Floats | None]:
    try:
        return features.voxel_downsample(points, voxel, normals=normals)
    except _core.InputError as error:  # under the names that the caller gave them by
        named = str(error).replace("rows of points", "rows of tgt")
        for name, called in (("points", "tgt"), ("normals", "tgt_normals")):
            named = called + named.removeprefix(name) if named.startswith(name) else named
        raise _core.InputError(named) from None


def standing(points: Floats, viewpoint: Any) -> list[tuple[float, int]]:
    """Measure what stands out of a scan, by its own spacing: how far each body is across, and its cells."""
    voxel = max(2 * _spacing(points), _doubts.extent(points) / 300)
    if not 0 < voxel < math.inf:
        return []
    tgt, _ = features.voxel_downsample(points, voxel)
    plane = features.dominant_plane(tgt, PLANE_VOXELS * voxel, viewpoint=viewpoint) if len(tgt) >= 3 else None
    if plane is not None and (plane.behind < MAX_BEHIND or plane.inliers.mean() > 0.5):
        tgt = tgt[~plane.inliers]
    return _doubts.bodies(tgt, 1.5 * voxel) if len(tgt) else []


Described = tuple[npt.NDArray[np.int64] | None, npt.NDArray[np.float32]]
"""Rows of the model's points that were described, None for all, and their descriptors."""


def described(
    points: Floats, normals: Floats, spacing: float, own: float, voxel: float, num_threads: int | None
) -> Described:
    """Describe a model at a voxel: as it is at its own, unless many of its points are twins, else thinned."""
    distinct, _ = features.voxel_downsample(points, TWIN_SPACINGS * spacing)
    if voxel <= own and len(distinct) >= (1 - MAX_TWINS) * len(points):
        return None, describe(points, normals, voxel, num_threads)
    src, src_normals = features.voxel_downsample(points, voxel, normals=normals)
    assert src_normals is not None  # normals were given
    # In single precision, so about the middle.
    middle = points.mean(axis=0)
    nearest, _ = match(points - middle, src - middle, num_threads=num_threads)
    return nearest[:, 0], describe(src, src_normals, voxel, num_threads)


def _spacing(points: Floats) -> float:
    """Mean distance to the nearest point; infinite for too few points."""
    try:
        return _core.Source(points).spacing
    except _core.InputError:
        return math.inf


def _table(
    tgt: Floats, voxel: float, diameter: float, viewpoint: Any, remove_plane: bool | None
) -> tuple[npt.NDArray[np.bool_], bool]:
    """Which points are the table's, and whether it is between the viewpoint and nearly all else."""
    none = np.zeros(len(tgt), dtype=bool)
    is_sure = remove_plane is True
    if remove_plane is False or (viewpoint is None and not is_sure) or len(tgt) < 3:
        return none, False
    plane = features.dominant_plane(tgt, PLANE_VOXELS * voxel, viewpoint=viewpoint)
    if plane is None:
        return none, False
    share = plane.inliers.mean()
    if not (is_sure or plane.behind < MAX_BEHIND):
        is_above = share >= TABLE_SHARE and plane.behind >= BEHIND_SHARE
        is_above = is_above and 1 - share - plane.behind <= FRONT_PER_BEHIND * plane.behind
        return none, bool(is_above and _is_wide(tgt[plane.inliers], voxel, diameter))
    # A scan of one flat part is a plane and nothing else; so is that of an empty table.
    if plane.inliers.sum() > len(tgt) - 3 and not _is_wide(tgt[plane.inliers], voxel, diameter):
        return none, False
    return plane.inliers, False


def _is_wide(points: Floats, voxel: float, diameter: float) -> bool:
    """Whether a plane hangs together over more than a part."""
    sizes = _doubts.bodies(points, 2 * voxel)
    return max(sizes)[0] > TABLE_DIAMETERS * diameter


def describe(
    points: Floats, normals: Floats, voxel: float, num_threads: int | None
) -> npt.NDArray[np.float32]:
    """Descriptors, the same for both clouds."""
    radius = FEATURE_VOXELS * voxel
    return features.fpfh(points, normals, radius, FEATURE_NEIGHBORS, num_threads=num_threads)
