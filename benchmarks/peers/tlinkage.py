"""T-Linkage, written from the paper's description; numpy alone.

L. Magri and A. Fusiello, "T-Linkage: A Continuous Relaxation of J-Linkage for Multi-Model Fitting", CVPR
2014. The published program was not looked at.

Two things bound the time and are not of the paper: the list is thinned to `samples` correspondences, as for
ECC, and triplets that no rigid pose can explain are passed over before they are fitted. The paper leaves the
rejection of outliers open; here a cluster needs `least` members.
"""

from __future__ import annotations

import numpy as np
from ibi_rs import synth
from numpy.typing import NDArray

from .contract import Register, model_spacing
from .ecc import clusters, fit_groups, residuals
from .triplets import Sampler

Array = NDArray[np.float64]
CUT = 5
"""A residual of more than so many tau is no preference at all; the paper's."""


def version() -> str:
    """Name what stands here: no published program."""
    return "own, from the paper"


def prepare(
    scene: synth.Scene,
    *,
    tau_pr: float,
    least: int,
    neighbors: int | None,
    rigid: bool = True,
    samples: int = 1024,
    hypotheses: int = 2048,
    draws: int = 400_000,
) -> Register:
    """Cluster correspondences by the hypotheses that they prefer.

    Parameters
    ----------
    tau_pr : float
        Residual at which a preference has fallen to 1/e.
    least : int
        A cluster of fewer correspondences is none.
    neighbors : int or None
        As in `Sampler`.
    rigid : bool
        Whether triplets that no rigid pose can explain are passed over.
    samples : int
        So many correspondences, drawn at random, take part.
    hypotheses, draws : int
        At most so many hypotheses, from at most so many triplets.
    """
    tau = tau_pr * model_spacing(scene.src)

    def register(scene: synth.Scene) -> Array:
        rng = np.random.default_rng(0)
        rows = scene.corr[rng.permutation(len(scene.corr))[:samples]]
        src, tgt = scene.src[rows[:, 0]], scene.tgt[rows[:, 1]]
        if len(rows) < 3:
            return np.empty((0, 4, 4))
        models = Sampler(src, tgt, neighbors, CUT * tau if rigid else None, rng).poses(draws, hypotheses)
        label = clusters(preferences(residuals(models, src, tgt), tau), t_merge=1)
        return fit_groups(src, tgt, label, max(least, 4))

    return register


def preferences(residual: Array, tau: float) -> NDArray[np.float32]:
    """Return exp(-r / tau), 0 from 5 tau on, of residuals (hypotheses, n) as (n, hypotheses)."""
    r = (residual.T / tau).astype(np.float32)
    return np.where(r < CUT, np.exp(-np.minimum(r, CUT)), 0).astype(np.float32)
