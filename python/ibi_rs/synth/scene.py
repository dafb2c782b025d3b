"""What a generated scene consists of, and which of its correspondences are true."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

__all__ = ["INLIER_DISTANCE", "Scene"]

Array: TypeAlias = NDArray[np.float64]

INLIER_DISTANCE = 0.1
"""A correspondence is true if a pose brings its source point this close to its target point (shape radii)."""


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """A registration problem with its truth.

    Attributes
    ----------
    src : (N, 3) float64
        Source points, one shape in the unit sphere.
    tgt : (Q, 3) float64
        Target points: the objects one after the other, then the clutter.
    corr : (M, 2) int64
        Correspondences, each [source row, target row], in random order.
    poses : (K, 4, 4) float64
        True poses target_from_source, acting on column vectors.
    name : str
        Layout, seed and shape.
    similarity : (M,) float64 or None
        How distinctive each match was, in [0, 1]; None where no descriptors were matched.
    src_normals, tgt_normals : (N, 3) and (Q, 3) float64 or None
        Unit normals estimated from the points, of either sign; None where the layout needs none.
    distractors : tuple of str
        Names of the other shapes in the target.
    """

    src: Array
    tgt: Array
    corr: NDArray[np.int64]
    poses: Array
    name: str
    similarity: Array | None = None
    src_normals: Array | None = None
    tgt_normals: Array | None = None
    distractors: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """Summarise the scene in one line."""
        return (
            f"Scene({self.name!r}: {self.num_instances} instances, {len(self.corr)} correspondences, "
            f"{self.inlier_ratio():.1%} inliers, {len(self.src)} source and {len(self.tgt)} target points)"
        )

    @property
    def num_instances(self) -> int:
        """Number K of true instances."""
        return len(self.poses)

    def labels(self, threshold: float = INLIER_DISTANCE) -> NDArray[np.int64]:
        """Instance that each correspondence belongs to.

        Parameters
        ----------
        threshold : float
            Largest distance of a true pair, in shape radii.

        Returns
        -------
        (M,) int64
            Index of the true pose that fits best, -1 if none fits within `threshold`.
        """
        return labels(self.src, self.tgt, self.corr, self.poses, threshold)

    def inlier_ratio(self, threshold: float = INLIER_DISTANCE) -> float:
        """Share of the correspondences that are true for some instance (0 for an empty list)."""
        return float(np.mean(self.labels(threshold) >= 0)) if len(self.corr) else 0.0


def labels(
    src: Array, tgt: Array, corr: NDArray[np.int64], poses: Array, threshold: float
) -> NDArray[np.int64]:
    """Index of the pose that fits each correspondence best, -1 if none fits within `threshold`."""
    best = np.full(len(corr), threshold, dtype=np.float64)
    nearest = np.full(len(corr), -1, dtype=np.int64)
    for k, pose in enumerate(poses):
        dist = np.linalg.norm(move(pose, src[corr[:, 0]]) - tgt[corr[:, 1]], axis=1)
        better = dist <= best
        best[better], nearest[better] = dist[better], k
    return nearest


def move(pose: Array, points: Array) -> Array:
    """Apply a 4 x 4 pose to (n, 3) points."""
    moved: Array = points @ pose[:3, :3].T + pose[:3, 3]
    return moved
