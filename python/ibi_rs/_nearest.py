"""The nearest of many points, for many, in a time that grows with their number and not with its square."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ibi_rs import _core

BLOCK = 2000
"""So many are looked for at once, in a slab that is as thin as they lie close along the longest axis."""


def nearest_rows(points: npt.NDArray[np.float64], queries: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Return for each query the row of the nearest of the points, of which there is one at least."""
    axis = int(np.argmax(np.ptp(points, axis=0)))
    order = np.argsort(points[:, axis], kind="stable")
    held, along = points[order], points[order, axis]
    rows = np.empty(len(queries), dtype=np.int64)
    by_place = np.argsort(queries[:, axis], kind="stable")
    for start in range(0, len(queries), BLOCK):
        block = by_place[start : start + BLOCK]
        at = queries[block, axis]
        first = max(int(np.searchsorted(along, at[0])) - BLOCK, 0)
        last = min(int(np.searchsorted(along, at[-1])) + BLOCK, len(held))
        found = first + _matched(held[first:last], queries[block])
        # The nearest one of all is no farther along the axis than this one is away.
        reach = np.linalg.norm(held[found] - queries[block], axis=1)
        first = int(np.searchsorted(along, (at - reach).min(), "left"))
        last = int(np.searchsorted(along, (at + reach).max(), "right"))
        rows[block] = order[first + _matched(held[first:last], queries[block])]
    return rows


def _matched(points: npt.NDArray[np.float64], queries: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    # A match of positions is a search for the nearest.
    centre = queries.mean(axis=0)
    near, sought = (points - centre).astype(np.float32), (queries - centre).astype(np.float32)
    pairs, _ = _core.features_match(near, sought, 1, False, None, None)
    rows = np.empty(len(queries), dtype=np.int64)
    rows[pairs[:, 1]] = pairs[:, 0]
    return rows
