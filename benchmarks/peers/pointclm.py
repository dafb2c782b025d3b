"""PointCLM's clustering on weights that the user brings; never run with real ones, as none can be shipped.

M. Yuan, Z. Li, Q. Jin, X. Chen and M. Wang, "PointCLM: A Contrastive Learning-based Framework for
Multi-instance Point Cloud Registration", ECCV 2022. The published program carries no licence and was not
looked at.

The checkpoint is a TorchScript module that takes (M, 6) float32, source point and target point, and gives
(M, d) representations, alike for correspondences of one instance. Its path comes as a setting or in the
environment variable IBI_POINTCLM_CHECKPOINT. What follows the network is simple here: correspondences that
are alike and keep their length are joined, and each group gives a pose.
"""

from __future__ import annotations

import numpy as np
from ibi_rs import synth
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from . import checkpoint as weights
from .contract import Register, model_spacing
from .ecc import fit_groups

Array = NDArray[np.float64]
VARIABLE = "IBI_POINTCLM_CHECKPOINT"


def version() -> str:
    """Name what stands here."""
    return f"own clustering, weights {weights.find('PointCLM', VARIABLE).name}"


def prepare(
    scene: synth.Scene,
    *,
    checkpoint: str | None = None,
    inlier_pr: float = 1.5,
    t_alike: float = 0.9,
    least: int = 10,
    samples: int = 4096,
) -> Register:
    """Prune by the number of those alike, group, fit.

    Parameters
    ----------
    checkpoint : str or None
    inlier_pr : float
        Two correspondences agree if their lengths differ by at most this.
    t_alike : float
        Least cosine of two representations that are alike.
    least : int
        A correspondence with fewer that are alike and agree is an outlier, a smaller group no instance.
    samples : int
        So many correspondences, drawn at random, take part: the matrix of all pairs grows with their square.
    """
    network = weights.load(weights.find("PointCLM", VARIABLE, checkpoint))
    inlier = inlier_pr * model_spacing(scene.src)

    def register(scene: synth.Scene) -> Array:
        rows = scene.corr[np.random.default_rng(0).permutation(len(scene.corr))[:samples]]
        src, tgt = scene.src[rows[:, 0]], scene.tgt[rows[:, 1]]
        return groups(network(np.hstack([src, tgt]).astype(np.float32)), src, tgt, inlier, t_alike, least)

    return register


def groups(features: Array, src: Array, tgt: Array, inlier: float, t_alike: float, least: int) -> Array:
    """Fit a pose to each group of correspondences that are alike and agree, the largest first."""
    unit = features / np.maximum(np.linalg.norm(features, axis=1, keepdims=True), 1e-12)
    a, b = (np.linalg.norm(points[:, None] - points, axis=2) for points in (src, tgt))
    joined = (unit @ unit.T > t_alike) & (np.abs(a - b) <= inlier)
    stays = joined.sum(axis=1) > least
    joined &= stays & stays[:, None]
    _, label = connected_components(csr_matrix(joined), directed=False)
    return fit_groups(src, tgt, np.where(stays, label, -1), max(least, 3))
