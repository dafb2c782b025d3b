"""Progressive-X without its graph cuts, written from the paper's description; numpy alone.

D. Barath and J. Matas, "Progressive-X: Efficient, Anytime, Multi-Model Fitting Algorithm", ICCV 2019. The
published program was not looked at.

The paper's proposals come from Graph-Cut RANSAC and its compound instance from alpha expansion, with an
energy that rewards neighbours of one label. Here a proposal is the best of a batch of triplets, refitted, and
labels go to the nearest model: no spatial term in either. Triplets that no rigid pose can explain are passed
over before they are fitted.
"""

from __future__ import annotations

import numpy as np
from ibi_rs import synth
from numpy.typing import NDArray

from .contract import Register, model_spacing
from .ecc import fit, residuals
from .triplets import Sampler

Array = NDArray[np.float64]


def version() -> str:
    """Name what stands here: no published program."""
    return "own, from the paper"


def prepare(
    scene: synth.Scene,
    *,
    inlier_pr: float,
    least: int,
    neighbors: int | None,
    rigid: bool = True,
    t_alike: float = 0.8,
    confidence: float = 0.95,
    draws: int = 30_000,
    hypotheses: int = 200,
    failures: int = 10,
) -> Register:
    """Propose an instance, fit all instances anew, and again.

    Parameters
    ----------
    inlier_pr : float
        Largest residual of an inlier; gamma of the paper's quality.
    least : int
        An instance explains at least so many correspondences.
    neighbors : int or None
        As in `Sampler`.
    rigid : bool
        Whether triplets that no rigid pose can explain are passed over.
    t_alike : float
        A proposal whose preferences are more like those of the compound instance, by Tanimoto, is none.
    confidence : float
        Ends once an instance of `least` correspondences would have been proposed with this probability.
    draws, hypotheses : int
        Of a proposal: so many triplets, of which at most so many are fitted.
    failures : int
        Ends as well after so many proposals in a row that come to nothing. Not of the paper: among ten
        thousand correspondences its criterion asks for a billion triplets.
    """
    gamma = inlier_pr * model_spacing(scene.src)

    def register(scene: synth.Scene) -> Array:
        src, tgt = scene.src[scene.corr[:, 0]], scene.tgt[scene.corr[:, 1]]
        models, failed, drawn = np.empty((0, 4, 4)), 0, 0
        if len(src) < 3:
            return models
        rng = np.random.default_rng(0)
        sampler = Sampler(src, tgt, neighbors, gamma if rigid else None, rng)
        compound = np.zeros(len(src))
        while failed < failures and undetected(compound, drawn, confidence) >= least:
            drawn += draws
            proposed = propose(sampler.poses(draws, hypotheses), src, tgt, compound, gamma)
            failed += 1
            if proposed is None or alike(preference(residuals(proposed, src, tgt), gamma), compound, t_alike):
                continue
            fitted = compete(np.concatenate([models, proposed]), src, tgt, gamma, least)
            failed = failed if len(fitted) <= len(models) else 0
            models = fitted
            compound = preference(residuals(models, src, tgt), gamma)
        return _most_first(models, src, tgt, gamma)

    return register


def preference(residual: Array, gamma: float) -> Array:
    """Return max(0, 1 - (r / gamma)^2) of the nearest model, for residuals (models, n)."""
    return np.maximum(0, 1 - np.square(residual / gamma)).max(axis=0, initial=0)


def quality(residual: Array, compound: Array, gamma: float) -> Array:
    """Return what each model, a row, adds: sum of 1 - min(1, max(r^2 / gamma^2, 1 - R^2 / gamma^2)).

    R is the residual under the compound instance, so that `compound`, its preference, is 1 - R^2 / gamma^2:
    what is already explained counts only as far as it is explained badly.
    """
    gain: Array = np.clip(1 - np.square(residual / gamma), 0, 1 - compound)
    return gain.sum(axis=1)


def propose(poses: Array, src: Array, tgt: Array, compound: Array, gamma: float) -> Array | None:
    """Take the pose that adds most, refitted once to its share of what is unexplained, (1, 4, 4)."""
    if not len(poses):
        return None
    residual = residuals(poses, src, tgt)
    best = int(np.argmax(quality(residual, compound, gamma)))
    mine = (residual[best] < gamma) & (1 - np.square(residual[best] / gamma) > compound)
    return fit(src, tgt, np.where(mine, 0, -1), 1) if mine.sum() >= 3 else poses[best : best + 1]


def alike(a: Array, b: Array, least: float) -> bool:
    """Whether two vectors of preferences are more alike than so much, by Tanimoto."""
    both = float(a @ b)
    return both > least * (float(a @ a) + float(b @ b) - both)


def compete(models: Array, src: Array, tgt: Array, gamma: float, least: int, rounds: int = 10) -> Array:
    """Give each correspondence to the nearest model, drop models of too few, refit; until nothing changes."""
    label = np.empty(0)
    for _ in range(rounds):
        residual = residuals(models, src, tgt)
        before, label = label, np.where(residual.min(axis=0) < gamma, residual.argmin(axis=0), -1)
        count = np.bincount(label[label >= 0], minlength=len(models))
        if count.min() < least:
            # The weakest alone: what it held may be what another lacks.
            models = np.delete(models, count.argmin(), axis=0)
            if not len(models):
                break
            continue
        if np.array_equal(before, label):
            break
        models = fit(src, tgt, label, len(models))
    return models


def undetected(compound: Array, drawn: int, confidence: float) -> float:
    """Size of the largest instance that may have been missed: n (1 - (1 - mu)^(1/k))^(1/3).

    n are the correspondences that the compound instance leaves, k the triplets drawn.
    """
    left = int(np.sum(compound == 0))
    if drawn == 0:
        return left
    share = -np.expm1(np.log1p(-confidence) / drawn)
    return float(left * share ** (1 / 3))


def _most_first(models: Array, src: Array, tgt: Array, gamma: float) -> Array:
    return models[np.argsort(-(residuals(models, src, tgt) < gamma).sum(axis=1), kind="stable")]
