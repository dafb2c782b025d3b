"""CONSAC's search on weights that the user brings; never run with real ones, as none can be shipped.

F. Kluger, E. Brachmann, H. Ackermann, C. Rother, M. Y. Yang and B. Rosenhahn, "CONSAC: Robust Multi-Model
Fitting by Conditional Sample Consensus", CVPR 2020. The published program was not looked at.

The checkpoint is a TorchScript module that takes (M, 7) float32, source point, target point and state, and
gives M logarithms of sampling weights. The state of a correspondence is how well the instances found so far
explain it, from 0 to 1. Its path comes as a setting or in the environment variable IBI_CONSAC_CHECKPOINT.
"""

from __future__ import annotations

import numpy as np
from ibi_rs import synth
from numpy.typing import NDArray

from . import checkpoint as weights
from .contract import Register, model_spacing
from .ecc import fit, residuals
from .progx import preference, quality

Array = NDArray[np.float64]
VARIABLE = "IBI_CONSAC_CHECKPOINT"


def version() -> str:
    """Name what stands here."""
    return f"own search, weights {weights.find('CONSAC', VARIABLE).name}"


def prepare(
    scene: synth.Scene,
    *,
    checkpoint: str | None = None,
    inlier_pr: float = 1.5,
    instances: int = 25,
    hypotheses: int = 100,
    least: int = 10,
) -> Register:
    """Draw triplets by the network's weights, take the best, tell the network, and again.

    Parameters
    ----------
    checkpoint : str or None
    inlier_pr : float
        Largest residual of an inlier.
    instances, hypotheses : int
        At most so many instances, each the best of so many triplets.
    least : int
        Ends with an instance that adds fewer correspondences.
    """
    network = weights.load(weights.find("CONSAC", VARIABLE, checkpoint))
    gamma = inlier_pr * model_spacing(scene.src)

    def register(scene: synth.Scene) -> Array:
        src, tgt = scene.src[scene.corr[:, 0]], scene.tgt[scene.corr[:, 1]]
        rng, found, state = np.random.default_rng(0), np.empty((0, 4, 4)), np.zeros(len(src))
        while len(src) >= 3 and len(found) < instances:
            log_weight = network(np.column_stack([src, tgt, state]).astype(np.float32)).ravel()
            share = np.exp(log_weight - log_weight.max())
            rows = rng.choice(len(src), size=(hypotheses, 3), p=share / share.sum()).ravel()
            poses = fit(src[rows], tgt[rows], np.repeat(np.arange(hypotheses), 3), hypotheses)
            residual = residuals(poses, src, tgt)
            best = int(np.argmax(quality(residual, state, gamma)))
            mine = (residual[best] < gamma) & (state == 0)
            if mine.sum() < max(least, 3):
                break
            found = np.concatenate([found, fit(src, tgt, np.where(mine, 0, -1), 1)])
            state = preference(residuals(found, src, tgt), gamma)
        return found

    return register
