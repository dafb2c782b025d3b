"""Hypotheses from three correspondences each, drawn near one another: what T-Linkage and Progressive-X share.

Both papers draw minimal samples of neighbours. Among thousands of correspondences of which one in a hundred
belongs to an instance, three drawn from all of them belong to the same one once in a million.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .ecc import fit

Array = NDArray[np.float64]


class Sampler:
    """Draws triplets of correspondences and fits a pose to each.

    Parameters
    ----------
    src, tgt : (n, 3) float64
        Matched points, n at least 3.
    neighbors : int or None
        The second and the third of a triplet are among so many that are nearest to the first by their target
        points; None: among all.
    inlier : float or None
        Triplets with two sides whose lengths differ by more than twice this are passed over: no rigid pose
        brings all three within it. So are those with a side shorter than this, which fix no rotation. None:
        triplets as they are drawn, as in the papers.
    rng : numpy.random.Generator
    """

    def __init__(
        self, src: Array, tgt: Array, neighbors: int | None, inlier: float | None, rng: np.random.Generator
    ) -> None:
        self._src, self._tgt, self._inlier, self._rng = src, tgt, inlier, rng
        self._near = None
        if neighbors is not None and neighbors < len(tgt) - 1:
            self._near = cKDTree(tgt).query(tgt, k=neighbors + 1)[1]

    def triplets(self, draws: int) -> NDArray[np.int64]:
        """Draw so many triplets and return those that may belong to a rigid pose, (H, 3)."""
        n = len(self._src)
        first = self._rng.integers(n, size=draws)
        if self._near is None:
            others = self._rng.integers(n, size=(draws, 2))
        else:
            columns = self._rng.integers(self._near.shape[1], size=(draws, 2))
            others = self._near[first[:, None], columns]
        rows = np.column_stack([first, others])
        if self._inlier is None:
            return rows
        return rows[may_be_rigid(self._src[rows], self._tgt[rows], self._inlier)]

    def poses(self, draws: int, most: int) -> Array:
        """Draw so many triplets and fit poses to at most so many of those that may be rigid, (H, 4, 4)."""
        rows = self.triplets(draws)[:most]
        if not len(rows):
            return np.empty((0, 4, 4))
        label = np.repeat(np.arange(len(rows)), 3)
        return fit(self._src[rows.ravel()], self._tgt[rows.ravel()], label, len(rows))


def may_be_rigid(src: Array, tgt: Array, inlier: float) -> NDArray[np.bool_]:
    """Mark the triplets, (H, 3, 3) source and target points, whose sides are alike and long enough."""
    a, b = (np.linalg.norm(points - np.roll(points, 1, axis=1), axis=2) for points in (src, tgt))
    return np.all((np.abs(a - b) <= 2 * inlier) & (np.minimum(a, b) > inlier), axis=1)
