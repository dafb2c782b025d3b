"""What benchmarks/verdict.py counts: which poses are right, and whether scores are probabilities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import ibi_rs as ibi
import numpy as np
import numpy.typing as npt
from ibi_rs import metrics
from numpy.typing import NDArray

RIGHT_BELOW = 0.1
STRICT_DEG, STRICT_MM = 10.0, 10.0
RIGHT, HIDDEN, WRONG, UNKNOWN = "right", "hidden", "wrong", "unknown"
"""States of a pose; hidden: right for an instance of which too little is seen to ask for it."""
NUM_BINS = 10


@dataclass(frozen=True)
class Judgement:
    """What the poses found in one search are.

    Attributes
    ----------
    states : tuple of str
        Of each pose. Where labels are missing, a pose that is not right is unknown.
    distances : (M,) float64
        ADD-S to the nearest truth, diameters; inf without one within a diameter.
    is_strict : (M,) bool
        Whether a right or hidden pose is within 10 degrees, modulo symmetry, and 10 mm.
    truths : (M,) int64
        Row of the truth that a pose is right for, or -1.
    is_asked_for : (K,) bool
        Truths of which enough is seen.
    """

    states: tuple[str, ...]
    distances: NDArray[np.float64]
    is_strict: NDArray[np.bool_]
    truths: NDArray[np.int64]
    is_asked_for: NDArray[np.bool_]

    def count(self, *states: str) -> int:
        """Count the poses in some states."""
        return sum(state in states for state in self.states)

    @property
    def is_missed(self) -> NDArray[np.bool_]:
        """Truths that are asked for and not found, (K,)."""
        missed = self.is_asked_for.copy()
        missed[self.truths[self.truths >= 0]] = False
        return missed


def judge(
    found: npt.ArrayLike,
    poses: NDArray[np.float64],
    visibility: NDArray[np.float64],
    model: ibi.Model,
    symmetries: ibi.Symmetries,
    *,
    visible: float,
    mm: float,
    is_complete: bool = True,
) -> Judgement:
    """Hold poses against the truth, one to one, by ADD-S below a tenth of the diameter.

    Parameters
    ----------
    found : (M, 4, 4) array_like
    poses : (K, 4, 4) float64
    visibility : (K,) float64
    model : ibi_rs.Model
    symmetries : ibi_rs.Symmetries
        Of the model about its middle: see `centred`.
    visible : float
        Least visibility of a truth that is asked for.
    mm : float
        A millimetre in the unit of the data.
    is_complete : bool
        Whether all truths are known.
    """
    points, to_middle = centred(model)
    predicted = np.asarray(found, dtype=np.float64).reshape(-1, 4, 4) @ to_middle
    truth = poses.reshape(-1, 4, 4) @ to_middle
    is_asked_for = visibility >= visible
    distance = distances(predicted, truth, points, model.diameter)
    is_near = distance < RIGHT_BELOW
    # As many hits as there can be, and of these the nearest; against all truths, so that one that is hardly
    # visible excuses a pose, and no duplicate of it. `metrics.score_scene` assigns before it asks for hits:
    # a wrong pose near a truth that is found can cost a hit there, if there are fewer poses than truths.
    column = metrics.assignment(np.where(is_near, distance - 1, 0.0)) if distance.size else []
    states = [WRONG if is_complete else UNKNOWN] * len(predicted)
    is_strict, truths = np.zeros(len(predicted), dtype=bool), np.full(len(predicted), -1)
    for row, k in enumerate(column):
        if k >= 0 and is_near[row, k]:
            states[row] = RIGHT if is_asked_for[k] else HIDDEN
            truths[row] = k
            turned = symmetries.nearest(predicted[row], truth[k])
            is_strict[row] = (
                metrics.rotation_error_deg(turned, truth[k]) < STRICT_DEG
                and metrics.translation_error(turned, truth[k]) < STRICT_MM * mm
            )
    nearest = distance.min(axis=1, initial=np.inf)
    return Judgement(tuple(states), nearest, is_strict, truths, is_asked_for)


def distances(
    predicted: NDArray[np.float64],
    truth: NDArray[np.float64],
    points: NDArray[np.float64],
    diameter: float,
) -> NDArray[np.float64]:
    """Return ADD-S of poses and truths, (M, K), in diameters; inf where their middles are farther apart."""
    apart = np.linalg.norm(predicted[:, None, :3, 3] - truth[None, :, :3, 3], axis=2)
    result = np.full(apart.shape, np.inf)
    for row, k in np.argwhere(apart < diameter):
        result[row, k] = metrics.add_s(points, predicted[row], truth[k]) / diameter
    return result


def centred(model: ibi.Model) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the points of a model about their middle, and the motion (4, 4) from there to the model."""
    middle = (model.points.min(axis=0) + model.points.max(axis=0)) / 2
    to_middle = np.eye(4)
    to_middle[:3, 3] = middle
    return model.points - middle, to_middle


def calibration_error(scores: Sequence[float], is_right: Sequence[bool]) -> float:
    """Return the expected calibration error: mean over poses of |mean score - share right| of their tenth."""
    score, right = np.asarray(scores, dtype=np.float64), np.asarray(is_right, dtype=np.float64)
    bins = np.minimum((score * NUM_BINS).astype(np.int64), NUM_BINS - 1)
    off = np.bincount(bins, weights=score - right, minlength=NUM_BINS)
    return float(np.abs(off).sum() / len(score))


def brier(scores: Sequence[float], is_right: Sequence[bool]) -> float:
    """Return the mean square of score minus truth."""
    return float(np.mean((np.asarray(scores) - np.asarray(is_right, dtype=np.float64)) ** 2))
