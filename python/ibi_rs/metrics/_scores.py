"""How well the poses of a scene were found, and of many scenes."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy.typing as npt

from ibi_rs import _core
from ibi_rs._inputs import _floats, _num_threads, _points
from ibi_rs.metrics._criteria import ECC, AddS, Criterion, PoseThresholds
from ibi_rs.symmetries import Symmetries, _as_symmetries

Matching: TypeAlias = Literal["one_to_one", "any"]
"""Which pairs of prediction and truth are asked for a hit; see the module."""


@dataclass(frozen=True)
class PoseMatch:
    """The truth a prediction is held against.

    Attributes
    ----------
    truth : int
        Row of the truth.
    rotation_error_deg : float
        Rotation error, in degrees.
    translation_error : float
        Translation error, in the unit of the data.
    distance : float
        What the matching went by: the Frobenius distance, or ADD-S where that is the criterion.
    is_hit : bool
        Whether the criterion is met.
    """

    truth: int
    rotation_error_deg: float
    translation_error: float
    distance: float
    is_hit: bool


@dataclass(frozen=True)
class SceneScore:
    """How well the poses of one scene were found.

    Attributes
    ----------
    matching : {"one_to_one", "any"}
        The family of this score.
    num_truth, num_predicted : int
        K and M, the numbers of true and of predicted poses.
    num_truth_hit, num_predicted_hit : int
        True poses that some prediction hits, and predictions that hit; one to one the same number.
    recall, precision, f1 : float
        Hits over K, hits over M, their harmonic mean. With M = 0 all are 0; with K = 0 recall is 1,
        and precision and F1 are 0; with neither, all are 1.
    matches : tuple of (PoseMatch or None)
        For each prediction the truth it is held against: one to one its assigned truth, None if left
        over; else the nearest truth it hits, or the nearest of all if it hits none, None only if K = 0.
    """

    matching: Matching
    num_truth: int
    num_predicted: int
    num_truth_hit: int
    num_predicted_hit: int
    recall: float
    precision: float
    f1: float
    matches: tuple[PoseMatch | None, ...] = field(repr=False)


@dataclass(frozen=True)
class MeanScore:
    """Means over scenes, each scene with the same weight.

    Attributes
    ----------
    matching : {"one_to_one", "any"}
        The family of these scores.
    num_scenes : int
        How many scenes were averaged.
    mhr, mhp : float
        Mean hit recall and mean hit precision: the means of the scenes' recalls and precisions.
    mhf1 : float
        Mean hit F1: one to one the mean of the scenes' F1, else the harmonic mean of `mhr` and `mhp`.
    """

    matching: Matching
    num_scenes: int
    mhr: float
    mhp: float
    mhf1: float


@dataclass(frozen=True)
class MssdRecall:
    """MSSD recall of one scene.

    Attributes
    ----------
    average : float
        Mean of `recalls`, BOP's average recall.
    recalls : tuple of float
        The recall at each of `MSSD_DIAMETER_FRACTIONS`.
    """

    average: float
    recalls: tuple[float, ...]


def score_scene(
    predicted: npt.ArrayLike,
    truth: npt.ArrayLike,
    *,
    matching: Matching = "one_to_one",
    criterion: Criterion = ECC,
    model: npt.ArrayLike | None = None,
    symmetries: Symmetries | npt.ArrayLike | None = None,
) -> SceneScore:
    """Score the poses predicted for one scene against the true ones.

    Parameters
    ----------
    predicted : array_like, shape (M, 4, 4)
        Predicted poses, for instance a `Registration`; none is an answer.
    truth : array_like, shape (K, 4, 4)
        True poses.
    matching : {"one_to_one", "any"}, default "one_to_one"
        ``"one_to_one"`` pairs by the assignment of least total distance *before* any threshold, so a
        duplicate is a false positive. ``"any"`` asks every pair, so duplicates are free.
    criterion : PoseThresholds or AddS, default `ECC`
        What makes a pair a hit.
    model : array_like, shape (N, 3), optional
        Points of the model; needed by `AddS` and by nothing else.
    symmetries : Symmetries or array_like of shape (S, 4, 4), optional
        Of the model: against each truth a prediction counts as the pose nearest to it of those that look
        like it. `AddS` sees to this by itself; of it only the errors of the `PoseMatch` change.

    Returns
    -------
    SceneScore

    Raises
    ------
    ValueError
        If a pose is not a rigid motion, a shape or a name is not one of those above, or a model is missing
        or not needed.
    TypeError
        If an array is not made of real numbers, or `criterion` is of another type.
    """
    _check_matching(matching)
    estimates, truths = _floats("predicted", predicted, "K", 4, 4), _floats("truth", truth, "K", 4, 4)
    held = _as_symmetries(symmetries)
    if isinstance(criterion, PoseThresholds):
        if model is not None:
            raise ValueError("model must be left out unless criterion is AddS")
        scored = _core.metrics_score_pose(
            estimates,
            truths,
            matching,
            math.radians(criterion.rotation_deg),
            float(criterion.translation),
            held,
            _num_threads(None),
        )
    elif isinstance(criterion, AddS):
        if model is None:
            raise ValueError("model must be given when criterion is AddS")
        scored = _core.metrics_score_add_s(
            estimates,
            truths,
            matching,
            _points("model", model),
            float(criterion.diameter_fraction),
            held,
            _num_threads(None),
        )
    else:
        raise TypeError(f"criterion must be PoseThresholds or AddS, not {type(criterion).__name__}")

    (num_truth_hit, num_predicted_hit), (recall, precision, f1), *columns = scored
    rows, rotation_rad, translation, distance, is_hit = (column.tolist() for column in columns)
    matches = (
        PoseMatch(row, math.degrees(angle), shift, apart, hit) if row >= 0 else None
        for row, angle, shift, apart, hit in zip(
            rows, rotation_rad, translation, distance, is_hit, strict=True
        )
    )
    return SceneScore(
        matching=matching,
        num_truth=len(truths),
        num_predicted=len(estimates),
        num_truth_hit=num_truth_hit,
        num_predicted_hit=num_predicted_hit,
        recall=recall,
        precision=precision,
        f1=f1,
        matches=tuple(matches),
    )


def mean_score(scenes: Iterable[SceneScore]) -> MeanScore:
    """Mean score of several scenes of one family: MHR, MHP and MHF1.

    Parameters
    ----------
    scenes : iterable of SceneScore
        At least one, all scored with the same matching.

    Returns
    -------
    MeanScore

    Raises
    ------
    ValueError
        If there is no scene, or the scenes were not all scored with the same matching.
    TypeError
        If `scenes` holds anything else.
    """
    scores = list(scenes)
    if not scores:
        raise ValueError("scenes must hold at least one SceneScore")
    for index, score in enumerate(scores):
        if not isinstance(score, SceneScore):
            raise TypeError(f"scenes[{index}] must be a SceneScore, not {type(score).__name__}")
        if score.matching != scores[0].matching:
            raise ValueError(
                f"scenes[{index}] must be scored with {scores[0].matching!r} as scenes[0] is, "
                f"not with {score.matching!r}"
            )
    counts = [(s.num_truth, s.num_predicted, s.num_truth_hit, s.num_predicted_hit) for s in scores]
    mhr, mhp, mhf1 = _core.metrics_mean_score(scores[0].matching, counts)
    return MeanScore(scores[0].matching, len(scores), mhr, mhp, mhf1)


def mssd_recall(
    predicted: npt.ArrayLike,
    truth: npt.ArrayLike,
    *,
    model: npt.ArrayLike,
    symmetries: Symmetries | npt.ArrayLike | None = None,
    matching: Matching = "one_to_one",
) -> MssdRecall:
    """Part of the true poses found with an MSSD below 0.05, 0.10 .. 0.50 of the model's diameter.

    Parameters
    ----------
    predicted : array_like, shape (M, 4, 4)
        Predicted poses.
    truth : array_like, shape (K, 4, 4)
        True poses.
    model : array_like, shape (N, 3)
        Points of the model, at least one.
    symmetries : Symmetries or array_like of shape (S, 4, 4), optional
        As in `mssd`.
    matching : {"one_to_one", "any"}, default "one_to_one"
        As in `score_scene`; one to one by MSSD, before any threshold. BOP instead lets predictions choose
        in the order of their confidence, which poses do not carry.

    Returns
    -------
    MssdRecall

    Raises
    ------
    ValueError
        If a pose or symmetry is not a rigid motion, the model is empty or not finite, or a shape or a name
        is not one of those above.
    TypeError
        If an array is not made of real numbers.
    """
    _check_matching(matching)
    average, recalls = _core.metrics_mssd_recall(
        _floats("predicted", predicted, "K", 4, 4),
        _floats("truth", truth, "K", 4, 4),
        matching,
        _points("model", model),
        _as_symmetries(symmetries),
        _num_threads(None),
    )
    return MssdRecall(average, tuple(recalls.tolist()))


def _check_matching(value: object) -> None:
    if not isinstance(value, str) or value not in ("one_to_one", "any"):
        shown = " ".join(repr(value).split())
        raise ValueError(f"matching must be 'one_to_one' or 'any', not {shown}")
