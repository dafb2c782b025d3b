"""The check that all peers share: a pose's model must be seen, on scene points that no better pose has.

Grouping, RANSAC and voting return candidates, wrong ones among them and right ones more than once. The
peers leave the choice to their users, so it is made here, in the same way for all.
"""

from __future__ import annotations

import numpy as np
from ibi_rs import synth
from ibi_rs.synth.scene import move
from numpy.typing import NDArray
from scipy.spatial import cKDTree


class Claims:
    """The points of a scene, and which of them kept poses have claimed.

    Parameters
    ----------
    model, scene : (N, 3) and (Q, 3) float64
    radius : float
        A model point is seen if an unclaimed scene point is this near to it; a kept pose claims all scene
        points this near to its model.
    """

    def __init__(self, model: NDArray[np.float64], scene: NDArray[np.float64], radius: float) -> None:
        self._model, self._radius = model, radius
        self._tree = cKDTree(scene, balanced_tree=False)
        self.free = np.ones(len(scene), dtype=bool)

    def keep(self, pose: NDArray[np.float64], least: float) -> bool:
        """Keep a pose, and claim its scene points, if more than the share `least` of its model is seen."""
        moved = move(pose, self._model)
        # Cheap, and many wrong poses end here: seen at all, be it by claimed points.
        near = self._near(moved)
        if near.mean() <= least:
            return False
        pairs = cKDTree(moved[near]).sparse_distance_matrix(self._tree, self._radius, output_type="ndarray")
        seen = np.zeros(near.sum(), dtype=bool)
        seen[pairs["i"][self.free[pairs["j"]]]] = True
        if seen.sum() <= least * len(moved):
            return False
        self.free[pairs["j"]] = False
        return True

    def plausible(self, poses: NDArray[np.float64], least: float) -> NDArray[np.bool_]:
        """Mark the poses worth a check: every eighth model point is asked, for all poses at once.

        The share of these may be three standard deviations below `least`.
        """
        few = self._model[::8]
        moved = few @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
        return self._near(moved).mean(axis=1) > least - 1.5 / np.sqrt(len(few))

    def _near(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.isfinite(self._tree.query(points, distance_upper_bound=self._radius)[0])


def keep_best(poses: NDArray[np.float64], claims: Claims, least: float) -> NDArray[np.float64]:
    """Go through candidates, best first, and return those that `Claims.keep` keeps."""
    kept = [pose for pose in poses[claims.plausible(poses, least)] if claims.keep(pose, least)]
    return np.array(kept).reshape(-1, 4, 4)


def checked(
    poses: NDArray[np.float64], scene: synth.Scene, pr: float, least: float | None
) -> NDArray[np.float64]:
    """Return the candidates that stand the check; without a threshold all of them."""
    return poses if least is None else keep_best(poses, Claims(scene.src, scene.tgt, 1.5 * pr), least)
