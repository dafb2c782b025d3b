"""How good predicted poses are: pose errors, and the scores of the field.

Two families of scores are in use, and their numbers cannot be compared. Each result carries its
``matching``, and `mean_score` refuses to mix them.

========== ============================================ =====================================
           ``"one_to_one"`` (ECC, IBI)                  ``"any"`` (PointCLM, MIRETR, 3DFMNet)
========== ============================================ =====================================
pairs      one optimal assignment, before any threshold every prediction with every truth
duplicates false positives                              free
MHF1       mean of the scenes' F1                       harmonic mean of MHR and MHP
========== ============================================ =====================================

A pose is a 4x4 rigid motion that moves the model into the scene (target_from_source), K of them an array
of shape (K, 4, 4); a `Registration` can be given in its place. Rates are fractions in [0, 1].

Examples
--------
>>> import numpy as np
>>> from ibi_rs import metrics
>>> truth = np.stack([np.eye(4), np.eye(4)])
>>> truth[1, 0, 3] = 5.0
>>> predicted = truth[[0, 0]]  # the first instance twice, the second not at all
>>> strict = metrics.score_scene(predicted, truth)
>>> strict.recall, strict.precision, strict.f1
(0.5, 0.5, 0.5)
>>> lenient = metrics.score_scene(predicted, truth, matching="any")
>>> lenient.recall, lenient.precision
(0.5, 1.0)
>>> metrics.mean_score([strict]).mhf1
0.5
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from . import _core
from ._inputs import _num_threads
from .symmetries import Symmetries, _as_symmetries

__all__ = [
    "ADD_S",
    "ECC",
    "MSSD_DIAMETER_FRACTIONS",
    "POINTCLM_SCAN",
    "AddS",
    "Criterion",
    "Matching",
    "MeanScore",
    "MssdRecall",
    "PoseMatch",
    "PoseThresholds",
    "SceneScore",
    "add",
    "add_s",
    "assignment",
    "diameter",
    "frobenius_distance",
    "mean_score",
    "mssd",
    "mssd_recall",
    "pointclm_voxels",
    "rotation_error_deg",
    "score_scene",
    "strict",
    "translation_error",
]

Matching: TypeAlias = Literal["one_to_one", "any"]
"""Which pairs of prediction and truth are asked for a hit; see the module."""

_Floats: TypeAlias = npt.NDArray[np.float64]


def _positive(value: float, name: str) -> None:
    # A string read from a file has no order; bool is an int to Python and never meant.
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError(f"{name} must be a number, not {type(value).__name__}")
    if not value > 0.0:
        raise ValueError(f"{name} must be above 0, not {value}")


@dataclass(frozen=True)
class PoseThresholds:
    """A pair is a hit if both its errors are below these.

    One to one, pairs are assigned by `frobenius_distance`.

    Parameters
    ----------
    rotation_deg : float
        Upper bound of the rotation error, in degrees; above 0.
    translation : float
        Upper bound of the translation error, in the unit of the data; above 0.
    """

    rotation_deg: float
    translation: float

    def __post_init__(self) -> None:
        _positive(self.rotation_deg, "rotation_deg")
        _positive(self.translation, "translation")


@dataclass(frozen=True)
class AddS:
    """A pair is a hit if its ADD-S is below a part of the model's diameter.

    For parts with symmetry, which pose errors punish for what cannot be seen. One to one, pairs are
    assigned by ADD-S.

    Parameters
    ----------
    diameter_fraction : float, default 0.1
        The part of the diameter; above 0.
    """

    diameter_fraction: float = 0.1

    def __post_init__(self) -> None:
        _positive(self.diameter_fraction, "diameter_fraction")


Criterion: TypeAlias = PoseThresholds | AddS
"""What makes a pair of prediction and truth a hit."""

ECC: Final = PoseThresholds(rotation_deg=20.0, translation=0.5)
"""20 deg and 0.5 data units: model radii on unit-sphere models, metres on scans.

Of ECC (Tang & Zou, "Multi-instance point cloud registration by efficient correspondence clustering",
CVPR 2022) and IBI, with ``matching="one_to_one"``.
"""

POINTCLM_SCAN: Final = PoseThresholds(rotation_deg=15.0, translation=0.1)
"""15 deg and 0.1 m, on real scans in metres.

Of PointCLM (Yuan et al., ECCV 2022), with ``matching="any"``.
"""

ADD_S: Final = AddS(diameter_fraction=0.1)
"""ADD-S below a tenth of the diameter (Hinterstoisser et al., ACCV 2012)."""

MSSD_DIAMETER_FRACTIONS: Final = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5)
"""The parts of the diameter at which MSSD recall is taken (Hodan et al., "BOP challenge 2020")."""


def pointclm_voxels(voxel: float) -> PoseThresholds:
    """15 deg and 4 voxels: PointCLM's thresholds, and after it MIRETR's, with ``matching="any"``.

    Parameters
    ----------
    voxel : float
        Size of the voxels the clouds were downsampled to, in the unit of the data.

    Returns
    -------
    PoseThresholds
    """
    _positive(voxel, "voxel")
    return PoseThresholds(rotation_deg=15.0, translation=4.0 * voxel)


def strict(resolution: float) -> PoseThresholds:
    """5 deg and one point resolution: whether a pose can be used as it is. From no paper.

    Parameters
    ----------
    resolution : float
        Mean distance of neighbouring points, in the unit of the data.

    Returns
    -------
    PoseThresholds
    """
    _positive(resolution, "resolution")
    return PoseThresholds(rotation_deg=5.0, translation=resolution)


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


def rotation_error_deg(
    a: npt.ArrayLike, b: npt.ArrayLike, *, symmetries: Symmetries | npt.ArrayLike | None = None
) -> float:
    """Angle of the rotation that leads from one pose to the other, in [0, 180] degrees.

    Computed through an arc tangent: never NaN, and exact to the last digits near 0 and 180 degrees, where
    the usual arc cosine of the trace is not.

    Parameters
    ----------
    a, b : array_like, shape (4, 4)
        Rigid motions.
    symmetries : Symmetries or array_like of shape (S, 4, 4), optional
        Of the model: `a` counts as the pose nearest to `b` of those that look like it.

    Returns
    -------
    float
        Degrees.

    Raises
    ------
    ValueError
        If an argument is not a rigid motion.
    TypeError
        If an argument is not made of real numbers.
    """
    angle = _core.metrics_rotation_error_rad(_pose(a, "a"), _pose(b, "b"), _as_symmetries(symmetries))
    return math.degrees(angle)


def translation_error(
    a: npt.ArrayLike, b: npt.ArrayLike, *, symmetries: Symmetries | npt.ArrayLike | None = None
) -> float:
    """Distance of the two translations, in the unit of the data.

    Depends on where the model's origin lies; centre the model if its origin means nothing.

    Parameters
    ----------
    a, b : array_like, shape (4, 4)
        Rigid motions.
    symmetries : Symmetries or array_like of shape (S, 4, 4), optional
        Of the model: `a` counts as the pose nearest to `b` of those that look like it.

    Returns
    -------
    float

    Raises
    ------
    ValueError
        If an argument is not a rigid motion.
    TypeError
        If an argument is not made of real numbers.
    """
    return _core.metrics_translation_error(_pose(a, "a"), _pose(b, "b"), _as_symmetries(symmetries))


def frobenius_distance(a: npt.ArrayLike, b: npt.ArrayLike) -> float:
    """Frobenius norm of the difference of the two matrices.

    By this the poses are assigned one to one. It adds numbers without a unit to lengths, so it depends on
    the unit of the data.

    Parameters
    ----------
    a, b : array_like, shape (4, 4)
        Rigid motions.

    Returns
    -------
    float

    Raises
    ------
    ValueError
        If an argument is not a rigid motion.
    TypeError
        If an argument is not made of real numbers.
    """
    return _core.metrics_frobenius_distance(_pose(a, "a"), _pose(b, "b"))


def add(model: npt.ArrayLike, predicted: npt.ArrayLike, truth: npt.ArrayLike) -> float:
    """Mean distance between each model point under one pose and the same point under the other: ADD.

    Parameters
    ----------
    model : array_like, shape (N, 3)
        Points of the model, at least one.
    predicted, truth : array_like, shape (4, 4)
        Rigid motions.

    Returns
    -------
    float
        In the unit of the data.

    Raises
    ------
    ValueError
        If a pose is not a rigid motion, or the model is empty or not finite.
    TypeError
        If an argument is not made of real numbers.

    References
    ----------
    Hinterstoisser et al., "Model based training, detection and pose estimation of texture-less 3D objects
    in heavily cluttered scenes", ACCV 2012.
    """
    return _core.metrics_add(_points(model, "model"), _pose(predicted, "predicted"), _pose(truth, "truth"))


def add_s(model: npt.ArrayLike, predicted: npt.ArrayLike, truth: npt.ArrayLike) -> float:
    """Mean distance from each model point under the truth to the *closest* under the prediction: ADD-S.

    Blind to symmetry, with none declared. Exchanging the two poses changes the value, though little when
    it is small.

    Parameters
    ----------
    model : array_like, shape (N, 3)
        Points of the model, at least one.
    predicted, truth : array_like, shape (4, 4)
        Rigid motions.

    Returns
    -------
    float
        In the unit of the data.

    Raises
    ------
    ValueError
        If a pose is not a rigid motion, or the model is empty or not finite.
    TypeError
        If an argument is not made of real numbers.

    References
    ----------
    Hinterstoisser et al., ACCV 2012, as in `add`; named ADD-S by Xiang et al., "PoseCNN: A convolutional
    neural network for 6D object pose estimation in cluttered scenes", RSS 2018.

    Examples
    --------
    >>> import numpy as np
    >>> from ibi_rs import metrics
    >>> stick = [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    >>> flipped = np.diag([-1.0, -1.0, 1.0, 1.0])
    >>> metrics.add(stick, flipped, np.eye(4)), metrics.add_s(stick, flipped, np.eye(4))
    (2.0, 0.0)
    """
    return _core.metrics_add_s(
        _points(model, "model"), _pose(predicted, "predicted"), _pose(truth, "truth"), _num_threads(None)
    )


def mssd(
    model: npt.ArrayLike,
    predicted: npt.ArrayLike,
    truth: npt.ArrayLike,
    *,
    symmetries: Symmetries | npt.ArrayLike | None = None,
) -> float:
    """Largest distance between corresponding model points, under the symmetry that makes it least: MSSD.

    Parameters
    ----------
    model : array_like, shape (N, 3)
        Points of the model, at least one.
    predicted, truth : array_like, shape (4, 4)
        Rigid motions.
    symmetries : Symmetries or array_like of shape (S, 4, 4), optional
        Motions of the model, in its frame, that leave it looking the same. The identity is always among
        them and need not be named. Turns about an axis are tried in BOP's steps, from the nearest one on; a
        ball is turned to the truth.

    Returns
    -------
    float
        In the unit of the data.

    Raises
    ------
    ValueError
        If a pose or symmetry is not a rigid motion, or the model is empty or not finite.
    TypeError
        If an argument is not made of real numbers.

    References
    ----------
    Hodan et al., "BOP challenge 2020 on 6D object localization", ECCV workshops 2020.
    """
    return _core.metrics_mssd(
        _points(model, "model"),
        _pose(predicted, "predicted"),
        _pose(truth, "truth"),
        _as_symmetries(symmetries),
    )


def diameter(points: npt.ArrayLike) -> float:
    """Largest distance between two points, exactly; 0 for fewer than two.

    About O(n log n). Of more than 4096 points all about equally far from their centroid the last one or two
    of its digits may differ.

    Parameters
    ----------
    points : array_like, shape (N, 3)
        Points of the model.

    Returns
    -------
    float
        In the unit of the data.

    Raises
    ------
    ValueError
        If the shape is another, or a point is not finite.
    TypeError
        If `points` is not made of real numbers.
    """
    return _core.metrics_diameter(_points(points, "points"), _num_threads(None))


def assignment(cost: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """Assign rows to columns at the least total cost, no row and no column twice.

    Parameters
    ----------
    cost : array_like, shape (R, C)
        Finite costs, of either sign.

    Returns
    -------
    ndarray of int64, shape (R,)
        The column of each row, -1 for a row left over (only if R > C).

    Raises
    ------
    ValueError
        If the shape is another, or a cost is not finite.
    TypeError
        If `cost` is not made of real numbers.

    References
    ----------
    Jonker & Volgenant, "A shortest augmenting path algorithm for dense and sparse linear assignment
    problems", Computing 38 (1987).

    Examples
    --------
    >>> from ibi_rs import metrics
    >>> metrics.assignment([[1.0, 2.0], [3.0, 9.0]])  # 2 + 3, where greedy takes 1 + 9
    array([1, 0])
    """
    array = _floats(cost, "cost")
    if array.ndim != 2:
        raise ValueError(f"cost must have shape (R, C), not {array.shape}")
    return _core.metrics_assignment(array)


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
    estimates, truths = _poses(predicted, "predicted"), _poses(truth, "truth")
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
            _points(model, "model"),
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
        _poses(predicted, "predicted"),
        _poses(truth, "truth"),
        matching,
        _points(model, "model"),
        _as_symmetries(symmetries),
        _num_threads(None),
    )
    return MssdRecall(average, tuple(recalls.tolist()))


def _floats(value: npt.ArrayLike, name: str) -> _Floats:
    try:
        array = np.asarray(value)
    except ValueError as error:
        # A list of lists of unequal lengths.
        raise ValueError(f"{name} must be an array of real numbers: {error}") from error
    # What is empty has no type of its own: np.asarray([]) is as good as any. Strings and booleans would
    # convert, but are never meant.
    if array.size and array.dtype.kind not in "fiu":
        raise TypeError(f"{name} must be an array of real numbers, not of {array.dtype}")
    return np.ascontiguousarray(array, dtype=np.float64)


def _points(value: npt.ArrayLike, name: str) -> _Floats:
    array = _floats(value, name)
    if array.shape == (0,):
        return array.reshape(0, 3)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"{name} must have shape (N, 3), not {array.shape}")
    return array


def _pose(value: npt.ArrayLike, name: str) -> _Floats:
    array = _floats(value, name)
    if array.shape != (4, 4):
        raise ValueError(f"{name} must have shape (4, 4), not {array.shape}")
    return array


def _poses(value: npt.ArrayLike, name: str) -> _Floats:
    array = _floats(value, name)
    if array.shape == (0,):
        return array.reshape(0, 4, 4)
    if array.ndim != 3 or array.shape[1:] != (4, 4):
        raise ValueError(f"{name} must have shape (K, 4, 4), not {array.shape}")
    return array


def _check_matching(value: object) -> None:
    if value not in ("one_to_one", "any"):
        raise ValueError(f"matching must be 'one_to_one' or 'any', not {value!r}")
