"""Stages of your own: what a callable in the place of a stage gets, and what it may answer.

``Params(te=fit)`` puts the function ``fit`` in the place of the transformation estimation, and likewise
``scs``, ``ce`` and ``hv``. Any callable but a class will do. It is called once a round (validation may be
asked more often), one call at a time, in the thread that called :func:`~ibi_rs.register`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from ibi_rs import _core
from ibi_rs._inputs import _frozen, _int64

__all__ = [
    "Enhance",
    "EstimatePose",
    "Ranked",
    "SelectSeeds",
    "StageContext",
    "Validate",
]


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class StageContext:
    """What a stage of your own sees of the run; all arrays are read-only.

    The row of a correspondence in ``corr`` is its id.

    Attributes
    ----------
    src, tgt : (M, 3) float64
        The source and the target point of every correspondence, by id, in data units. The same arrays for
        the whole run.
    alive : (A,) int64
        Ids that no round has removed yet, ascending.
    barred : (B,) int64
        Ids that should not be picked as seeds (again), ascending, some of them no longer alive: with removal
        ``"inliers"``, the seeds of all rounds before. A round that bars and removes nothing new ends the run.
    poses : (K, 4, 4) float64
        ``target_from_source`` of the instances found so far; in the joint check, of all others.
    round : int
        Number of the round, from 0; 0 in the joint check.
    resolution : float
        pr in data units: the factor of every length that ends in ``_pr``.
    seed : int
        ``Params.seed``, for random numbers of your own: ``np.random.default_rng([seed, round])``.
    src_points : (N, 3) float64
        The source, in data units.
    tgt_points : (Q, 3) float64
        The target, in data units.
    """

    src: npt.NDArray[np.float64]
    tgt: npt.NDArray[np.float64]
    alive: npt.NDArray[np.int64]
    barred: npt.NDArray[np.int64]
    poses: npt.NDArray[np.float64]
    round: int
    resolution: float
    seed: int
    src_points: npt.NDArray[np.float64]
    tgt_points: npt.NDArray[np.float64]

    def __repr__(self) -> str:
        return f"StageContext(round={self.round}, {len(self.alive)} of {len(self.src)} alive)"


@dataclass(frozen=True, eq=False, slots=True)
class Ranked:
    """Correspondences with a score each, best first, ties by the lower id; the arrays are read-only.

    Attributes
    ----------
    ids : (n,) int64
        Ids, each once, all of them alive.
    scores : (n,) float64
        Finite, at least 0, in the order of ``ids``. The core keeps them in single precision.
    """

    ids: npt.NDArray[np.int64]
    scores: npt.NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.ids)


Picked: TypeAlias = Ranked | tuple[npt.ArrayLike, npt.ArrayLike] | npt.ArrayLike
"""``ids``, or ``(ids, scores)``, a tuple, or a :class:`Ranked`."""

Estimated: TypeAlias = npt.ArrayLike | tuple[npt.ArrayLike, float] | None
"""A pose, or ``(pose, score)``, a tuple, or None."""


class SelectSeeds(Protocol):
    """SCS of your own: picks the seeds of a round, ``scs(context) -> ids`` or ``(ids, scores)``.

    ``ids`` is (n,) of any integer dtype, each id alive and there once, in any order; ``scores`` is (n,) real,
    finite, at least 0, larger is better, of any scale. Without scores all count the same. Fewer than ``t_s``
    seeds end the run, so the empty list is the answer when nothing is left to find.
    """

    def __call__(self, context: StageContext, /) -> Picked:
        """Return ids, or ids and scores."""


class Enhance(Protocol):
    """CE of your own: gathers what agrees with the seeds, ``ce(context, seeds) -> ids`` or ``(ids, scores)``.

    Answers as :class:`SelectSeeds`. With removal ``"dense"`` what it gathers is removed after the round.
    """

    def __call__(self, context: StageContext, seeds: Ranked, /) -> Picked:
        """Return ids, or ids and scores."""


class EstimatePose(Protocol):
    """TE of your own: ``te(context, dense) -> pose``, ``(pose, score)`` or None.

    ``pose`` is ``target_from_source``: (4, 4) real, acts on column vectors, translation in data units; its
    last row is 0 0 0 1 and its 3x3 part a proper rotation, orthonormal to 1e-6. ``score`` is finite, larger
    is better, shown as ``Round.hypothesis_score``; without one it is the MAE of Eq. 7-8. With
    ``refine="icp"`` a pose of a score below 10 is first polished on a few points, and ``Evidence`` may reject
    it there. None: there is no pose.
    """

    def __call__(self, context: StageContext, dense: Ranked, /) -> Estimated:
        """Return a pose, a pose and its score, or None."""


class Validate(Protocol):
    """HV of your own: ``hv(context, pose) -> (value, threshold)`` or a bool.

    ``pose`` is (4, 4) float64, ``target_from_source``, read-only. Accepted exactly if value > threshold, both
    finite and in any unit. In a contest the largest value wins, and values below 0.8 of it wait for the next
    one, so values should be positive. True is (1, 0.5) and False (0, 0.5). It is asked again about the same
    pose, at the end of a contest and in the joint check, also after a time limit.
    """

    def __call__(
        self, context: StageContext, pose: npt.NDArray[np.float64], /
    ) -> tuple[float, float] | bool | np.bool_:
        """Return the value and what it must exceed, or whether the pose is accepted."""


_ANSWERS = {
    "scs": "ids or (ids, scores)",
    "ce": "ids or (ids, scores)",
    "te": "a (4, 4) pose, (pose, score) or None",
    "hv": "(value, threshold), two finite numbers, or a bool",
}


def own_stages(
    own: dict[str, Callable[..., Any]],
    seed: int,
    src_points: npt.NDArray[np.float64],
    tgt_points: npt.NDArray[np.float64],
    corr: npt.NDArray[Any],
) -> dict[str, Callable[..., Any]]:
    """Return what the core calls in the place of stages that are callables, by their names."""
    if not own:
        return {}  # and copies no scene
    run = _Run(src_points, tgt_points, corr, seed)
    return {name: run.stage(name, stage) for name, stage in own.items()}


class _Run:
    """The callables of one run, as the core asks them: views in, checked answers out."""

    def __init__(
        self,
        src_points: npt.NDArray[np.float64],
        tgt_points: npt.NDArray[np.float64],
        corr: npt.NDArray[Any],
        seed: int,
    ) -> None:
        # Copies: the caller's arrays may change while the run lasts.
        self._src_points, self._tgt_points = src_points, _frozen(tgt_points.copy())
        self._corr, self._seed = corr.copy(), seed
        self._pairs: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]] | None = None

    def stage(self, name: str, own: Callable[..., Any]) -> Callable[..., Any]:
        """Return what the core calls in the place of the stage."""
        who = f"params.{name}: {getattr(own, '__qualname__', type(own).__qualname__)}"
        read = {"scs": _picked, "ce": _picked, "te": _estimated, "hv": _measured}[name]

        def ask(view: tuple[Any, ...], *given: npt.NDArray[Any]) -> Any:
            context = self._context(*view)
            arrays = [_frozen(array) for array in given]
            before = [Ranked(*arrays)] if len(arrays) == 2 else arrays
            answer = own(context, *before)
            try:
                return read(who, answer, context.alive)
            except _Refused as refused:
                raise _core.InputError(f"{who} returned {refused}; it must return {_ANSWERS[name]}") from None

        return ask

    def _context(
        self,
        number: int,
        resolution: float,
        alive: npt.NDArray[np.int64],
        barred: npt.NDArray[np.int64],
        poses: npt.NDArray[np.float64],
    ) -> StageContext:
        if self._pairs is None:  # not before: by now the core has checked the rows
            self._pairs = self._look_up()
        return StageContext(
            src=self._pairs[0],
            tgt=self._pairs[1],
            alive=_frozen(alive),
            barred=_frozen(barred),
            poses=_frozen(poses),
            round=number,
            resolution=resolution,
            seed=self._seed,
            src_points=self._src_points,
            tgt_points=self._tgt_points,
        )

    def _look_up(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        corr = self._corr
        if corr.shape[1] == 6:
            return _frozen(corr[:, :3].copy()), _frozen(corr[:, 3:].copy())
        return _frozen(self._src_points[corr[:, 0]]), _frozen(self._tgt_points[corr[:, 1]])


class _Refused(Exception):
    """An answer that cannot be used; the message says what it is."""


def _numbers(what: str, value: Any, kinds: str, ndim: int) -> npt.NDArray[Any]:
    """Any array of so many dimensions, of real numbers or of integers."""
    try:
        array = np.asarray(value)
    except ValueError:  # ragged
        raise _Refused(f"{what} of no rectangular shape") from None
    if array.ndim == ndim and array.size == 0:
        return array.astype(np.int64)  # an empty list is one of floats
    if array.dtype.kind not in kinds:
        raise _Refused(f"{what} of dtype {array.dtype}")
    if array.ndim != ndim:
        raise _Refused(f"{what} of shape {array.shape}")
    return array


def _picked(
    _who: str, answer: Any, alive: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float32]]:
    if isinstance(answer, Ranked):
        answer = (answer.ids, answer.scores)
    is_pair = isinstance(answer, tuple) and len(answer) == 2
    given, weights = answer if is_pair else (answer, None)
    if given is None:
        raise _Refused("None")
    ids = _numbers("ids", given, "iu", 1)
    ids = _int64(ids)
    at = np.searchsorted(alive, ids)
    is_alive = alive[np.minimum(at, len(alive) - 1)] == ids if len(alive) else np.zeros(len(ids), bool)
    if not is_alive.all():
        row = int(np.argmin(is_alive))
        raise _Refused(f"the id {ids[row]} (at {row}), which is not in context.alive")
    uses = np.bincount(at, minlength=1)
    if uses.max() > 1:
        raise _Refused(f"the id {alive[np.argmax(uses > 1)]} more than once")
    if weights is None:
        return ids, np.ones(len(ids), np.float32)
    scores = _numbers("scores", weights, "fiu", 1)
    if len(scores) != len(ids):
        raise _Refused(f"{len(ids)} ids with {len(scores)} scores")
    with np.errstate(over="ignore"):
        single = np.ascontiguousarray(scores, np.float32)
    bad = ~(np.isfinite(single) & (single >= 0))
    if bad.any():
        row = int(np.argmax(bad))
        raise _Refused(f"the score {scores[row]} (at {row}), which is not finite and at least 0")
    return ids, single


def _estimated(
    who: str, answer: Any, _alive: npt.NDArray[np.int64]
) -> tuple[str, npt.NDArray[np.float64], float | None] | None:
    if answer is None:
        return None
    is_pair = isinstance(answer, tuple) and len(answer) == 2
    given, weight = answer if is_pair else (answer, None)
    pose = _numbers("a pose", given, "fiu", 2)
    if pose.shape != (4, 4):
        raise _Refused(f"a pose of shape {pose.shape}")
    score = None if weight is None else _number("a score", weight)
    # Whether it is a rigid motion the core sees, and says so under this name.
    return f"{who} returned a pose that", np.ascontiguousarray(pose, np.float64), score


def _measured(_who: str, answer: Any, _alive: npt.NDArray[np.int64]) -> tuple[float, float]:
    if isinstance(answer, (bool, np.bool_)):
        return float(answer), 0.5
    if not (isinstance(answer, tuple) and len(answer) == 2):
        raise _Refused(_shown(answer))
    return _number("a value", answer[0]), _number("a threshold", answer[1])


def _number(what: str, value: Any) -> float:
    array = _numbers(what, value, "fiu", 0)
    number = float(array)
    if not np.isfinite(number):
        raise _Refused(f"{what} of {number}")
    return number


def _shown(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:60]}..."
