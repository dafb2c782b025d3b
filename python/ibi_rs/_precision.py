"""What makes a scan doubtful: told in words, or refused, instead of found wrongly in silence.

Each number was chosen on ray-cast piles and on the scans of examples: tests/test_scans.py has the cases.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ibi_rs import _core

Floats = npt.NDArray[np.float64]

MIN_EXTENTS, MAX_EXTENTS = 0.1, 300.0
"""A scene so many models wide is in another unit: millimetres for metres are a factor of 1000."""
ENOUGH = 100
"""Fewer points tell nothing of the unit: an empty bin, and stray points."""
TAIL = 0.01
"""Share of the points on either end of an axis that do not count: far pixels."""

MAX_STEP = 0.5
"""How far apart the numbers of a cloud may be, in spacings of its points."""
SAMPLE, MANY = 1000, 20_000
"""Points that stand for all of a cloud: for its place, and for its extent."""

FACTORS = (1000.0, 100.0, 25.4, 10.0, 2.54)
"""Between metres, centimetres, millimetres and inches, and their inverses."""
LEAST_RATIO, MOST_RATIO = 0.5, 2.0
"""Of what stands out of a scan to the model: in part hidden, or two that touch."""
FEW_CELLS = 8

MAX_AWAY, AWAY_COS = 0.01, -0.2
"""Share of given normals that may face away from the viewpoint, and what counts as away."""
MAX_HIDDEN = 0.04
"""Share of points that may lie behind others as the viewpoint sees them."""
PIXEL_VOXELS, BEHIND_VOXELS = 2.0, 4.0

MAX_INWARD = 0.25
"""Share of model points that are seen from their backs only. Thin walls, seen through, have up to 0.17."""
NUM_VIEWS, VIEW_COS, FEW_VIEWS = 48, 0.3, 2


def extent(points: Floats) -> float:
    """Diagonal of the box around all points but a few far ones; 0 without points."""
    if len(points) == 0:
        return 0.0
    low, high = np.quantile(points[:: 1 + len(points) // MANY], [TAIL, 1 - TAIL], axis=0)
    return float(np.linalg.norm(high - low))


def check_units(diameter: float, points: Floats) -> None:
    """Refuse a whole scan that cannot be in the unit of the model, whose diameter is given."""
    if len(points) < ENOUGH:
        return
    size = extent(points)
    if not MIN_EXTENTS * diameter <= size <= MAX_EXTENTS * diameter:
        raise _core.InputError(
            f"tgt: the scene is {size:.3g} across and the model {diameter:.3g}; are they in the same unit?"
            " (Metres for millimetres are a factor of 1000; check_units=False takes them as they are.)"
        )


def check_step(name: str, points: Floats, spacing: float | None = None) -> None:
    """Refuse a cloud of single precision so far off that its numbers are as far apart as its points.

    Also one that is held in double precision by now: all its numbers are of single precision then.
    """
    sample = points[:: max(1, len(points) // SAMPLE)]
    sample = sample[np.isfinite(sample).all(axis=1)]
    if len(sample) < 3:
        return
    distance = float(np.abs(np.median(sample, axis=0)).max())
    with np.errstate(over="ignore"):
        step = float(np.spacing(np.float32(distance)))
        # A step of a millionth is below the spacing of any cloud that fits into memory.
        if not step > 1e-6 * float(np.ptp(sample, axis=0).max()):
            return
        if not np.array_equal(sample, sample.astype(np.float32)):
            return
    if spacing is None:
        finite = np.isfinite(points).all(axis=1)
        try:
            spacing = _core.Source(np.ascontiguousarray(points[finite])).spacing
        except _core.InputError:  # whoever takes the cloud says so, by its name
            return
    if step > MAX_STEP * spacing:
        raise _core.InputError(
            f"{name}: the points are {spacing:.3g} apart and their coordinates about {distance:.3g}, where"
            f" numbers of single precision (float32) are {step:.3g} apart; subtract an offset before the cast"
        )


def cells(points: Floats, width: float) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Each cell of a lattice that holds a point, as a row of three; and the row of each point's cell."""
    at = np.floor((points - points.min(axis=0)) / width).astype(np.int64)
    rows, of_point = np.unique(at, axis=0, return_inverse=True)
    return rows, of_point.reshape(-1)


def bodies(points: Floats, width: float) -> list[tuple[float, int]]:
    """Find what hangs together in a lattice of cells: how far each is across, and how many cells it has."""
    rows, of_point = cells(points, width)
    rows += 1
    shape = rows.max(axis=0) + 2
    keys = np.ravel_multi_index(tuple(rows.T), tuple(shape))  # ascending, as the rows are
    offsets = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) > (0, 0, 0)]
    pairs = []
    for offset in offsets:
        other = (
            keys
            + np.ravel_multi_index(tuple(np.add(offset, 1)), tuple(shape))
            - np.ravel_multi_index((1, 1, 1), tuple(shape))
        )
        at = np.searchsorted(keys, other).clip(max=len(keys) - 1)
        is_there = keys[at] == other
        pairs.append(np.column_stack([np.flatnonzero(is_there), at[is_there]]))
    a, b = np.concatenate(pairs).T
    label = np.arange(len(keys))
    while True:
        least = np.minimum(label[a], label[b])
        new = label.copy()
        np.minimum.at(new, a, least)
        np.minimum.at(new, b, least)
        new = new[new]
        if np.array_equal(new, label):
            break
        label = new
    of_points = label[of_point]
    order = np.argsort(of_points, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(of_points[order])) + 1)
    counts = np.bincount(label, minlength=len(keys))
    return [(float(np.linalg.norm(np.ptp(points[g], axis=0))), int(counts[of_points[g[0]]])) for g in groups]


def unit_warning(diameter: float, sizes: list[tuple[float, int]]) -> str | None:
    """Say by which factor a model would fit what stands out of a scan, if it does not as it is."""
    sizes = sorted(size for size in sizes if size[1] >= FEW_CELLS)
    if not sizes:
        return None
    # The median by cells: what most of the surface belongs to.
    half = np.cumsum([count for _, count in sizes])
    typical = sizes[int(np.searchsorted(half, half[-1] / 2))][0]
    ratio = typical / diameter
    if LEAST_RATIO <= ratio <= MOST_RATIO:
        return None
    factors = [*FACTORS, *(1 / factor for factor in FACTORS)]
    fitting = [f for f in factors if LEAST_RATIO <= ratio / f <= MOST_RATIO]
    if not fitting:
        return None
    fitting.sort(key=lambda f: abs(np.log(ratio / f)))
    words = " or ".join(f"{f:g}" if f > 1 else f"1/{1 / f:g}" for f in fitting)
    return (
        f"nothing is found; what stands out of the scan is {typical:.3g} across and the model {diameter:.3g};"
        f" in the same unit? The model times {words} would fit"
    )


def viewpoint_warning(eye: Any, points: Floats, given_normals: Floats | None, voxel: float) -> str | None:
    """Say that a scan contradicts its viewpoint: what share of it cannot be seen from there."""
    if given_normals is not None:
        share = facing_away(points, given_normals, np.asarray(eye))
        if share > MAX_AWAY:
            return (
                f"viewpoint: {share:.0%} of the normals face away from it; it is another one, or the scan is"
                " of several"
            )
    share = hidden(points, np.asarray(eye), voxel)
    if share > MAX_HIDDEN:
        return (
            f"viewpoint: {share:.0%} of the scan lie behind other points of it, as seen from there; it is"
            " another one, or the scan is of several"
        )
    return None


def facing_away(points: Floats, normals: Floats, eye: Floats) -> float:
    """Share of the points whose normals clearly face away from the eye."""
    way = eye - points
    cos = np.einsum("ij,ij->i", way, normals) / np.maximum(np.linalg.norm(way, axis=1), 1e-300)
    return float(np.mean(cos < AWAY_COS)) if len(points) else 0.0


def hidden(points: Floats, eye: Floats, voxel: float) -> float:
    """Share of the points that others hide from the eye, of those that lie amidst others as it sees them.

    A point is hidden if all nine pixels around it show something that is nearer by more than slant explains.
    """
    way = points - eye
    depth = np.linalg.norm(way, axis=1)
    way, depth = way[depth > 0], depth[depth > 0]
    if len(way) < 3:
        return 0.0
    ahead = (way / depth[:, None]).mean(axis=0)
    ahead /= max(np.linalg.norm(ahead), 1e-300)
    side = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
    side /= max(np.linalg.norm(side), 1e-300)
    x, y, z = way @ side, way @ np.cross(ahead, side), way @ ahead
    angle = PIXEL_VOXELS * voxel / np.median(depth)
    column = np.floor(np.arctan2(x, z) / angle).astype(np.int64)
    row = np.floor(np.arcsin(np.clip(y / depth, -1, 1)) / angle).astype(np.int64)
    stride = 2 * int(np.pi / angle) + 8
    keys, of_point = np.unique((column - column.min()) * stride + row - row.min() + 1, return_inverse=True)
    nearest = np.full(len(keys), np.inf)
    np.minimum.at(nearest, of_point, depth)
    front = np.zeros(len(keys))
    for offset in (i * stride + j for i in (-1, 0, 1) for j in (-1, 0, 1)):
        at = np.searchsorted(keys, keys + offset).clip(max=len(keys) - 1)
        front = np.maximum(front, np.where(keys[at] == keys + offset, nearest[at], np.inf))
    judged = np.isfinite(front[of_point])
    behind = depth[judged] > front[of_point][judged] + BEHIND_VOXELS * voxel
    return float(behind.mean()) if judged.any() else 0.0


def inward(points: Floats, normals: Floats, spacing: float) -> float:
    """Share of the points that are seen from outside from their backs only, of those that are seen."""
    front, back = np.zeros((2, len(points)), dtype=np.int64)
    for k in range(NUM_VIEWS):
        z = 1 - (2 * k + 1) / NUM_VIEWS
        turn = k * np.pi * (3 - 5**0.5)
        to_eye = np.array([*(np.sqrt(1 - z * z) * np.array([np.cos(turn), np.sin(turn)])), z])
        side = np.cross(to_eye, np.eye(3)[np.argmin(np.abs(to_eye))])
        side /= np.linalg.norm(side)
        screen = np.column_stack([points @ side, points @ np.cross(to_eye, side)]) / (2 * spacing)
        x, y = (screen - screen.min(axis=0)).astype(np.int64).T
        order = np.lexsort((points @ to_eye, y, x))  # the nearest of a pixel comes last
        is_last = np.append((np.diff(x[order]) != 0) | (np.diff(y[order]) != 0), True)
        seen = order[is_last]
        cos = normals[seen] @ to_eye
        front[seen[cos > VIEW_COS]] += 1
        back[seen[cos < -VIEW_COS]] += 1
    is_seen = front + back >= FEW_VIEWS
    is_inward = is_seen & (back > 4 * front)
    return float(is_inward.sum() / is_seen.sum()) if is_seen.any() else 0.0
