"""Recordings of a registration, to be turned and played back in Rerun: ``pip install 'ibi_rs[viz]'``."""

from __future__ import annotations

import colorsys
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ibi_rs import _interrupts
from ibi_rs._core import InputError
from ibi_rs._files import written
from ibi_rs._inputs import Points, _correspondences, _count, _points

if TYPE_CHECKING:
    from ibi_rs.registration import Registration, Round

__all__ = ["MAX_OUTLIERS", "record"]

MAX_OUTLIERS = 2000
"""Correspondences of no instance that a recording shows by default, evenly spread over all of them."""

_GREY = (128, 128, 128)


def record(
    tgt: Points,
    src: Points,
    registration: Registration,
    path: str | os.PathLike[str],
    *,
    corr: Any = None,
    max_outliers: int = MAX_OUTLIERS,
) -> None:
    """Write a recording (.rrd) of the scene, the instances, the correspondences and the rounds.

    ``rerun found.rrd`` shows it. On the timeline ``round`` each instance appears in the round that found it.

    ======================== ==========================================================================
    entity                   what
    ======================== ==========================================================================
    ``scene``                the points of the scene, grey
    ``model``                those of the model, moved to the side of the scene, where lines begin
    ``instances/<k>``        the pose ``registration[k]`` as a transform, its score, overlap and inliers
    ``instances/<k>/model``  the points of the model, which the transform moves, in a colour for each k
    ``correspondences/<k>``  lines of the correspondences with the label k, in its colour
    ``correspondences/none`` those of the label -1, grey
    ``rounds/...``           ``alive`` and ``seeds`` (numbers of correspondences), ``value`` and
                             ``threshold`` of the verdict, and ``log``, a line in words for each round
    ======================== ==========================================================================

    Parameters
    ----------
    tgt : (N, 3) array_like
        The scene. Rerun keeps coordinates as float32.
    src : (N, 3) array_like
        The model.
    registration : Registration
        What was found.
    path : path
        The file to be written; ``.rrd`` is usual.
    corr : optional
        The correspondences of the registration, as in :func:`ibi_rs.register`; rows are those of ``src`` and
        ``tgt``. By default no lines are drawn.
    max_outliers : int
        Most lines of the label -1; at least 0.

    Returns
    -------
    None

    Raises
    ------
    InputError
        An array cannot be used, or ``corr`` is not as long as ``registration.labels``, or a row is out of
        range.
    ImportError
        Rerun is not installed; the message names the extra.
    OSError
        The file cannot be written; then nothing of it is left.
    """
    rr = _rerun()
    scene, model = _points("tgt", tgt), _points("src", src)
    lines = None if corr is None else _ends(scene, model, corr, len(registration.labels))
    max_outliers = _count("max_outliers", max_outliers, 0)
    for name, cloud in (("tgt", scene), ("src", model)):
        if len(cloud) == 0:
            raise InputError(f"{name} has 0 points; there is nothing to record")
    stream = rr.RecordingStream("ibi_rs")
    with written(path) as part:
        part.open("wb").close()  # Rerun would only log that it cannot
        try:
            _fill(rr, stream, part, scene, model, registration, lines, max_outliers)
        finally:
            stream.disconnect()


def _rerun() -> Any:
    try:
        with _interrupts.held():
            import rerun
    except ImportError as error:
        raise ImportError(f"recordings need Rerun: pip install 'ibi_rs[viz]' ({error})") from error
    return rerun


def _fill(
    rr: Any,
    stream: Any,
    path: Path,
    scene: npt.NDArray[np.float64],
    model: npt.NDArray[np.float64],
    registration: Registration,
    lines: npt.NDArray[np.float64] | None,
    max_outliers: int,
) -> None:
    if hasattr(stream, "set_log_time_enabled"):  # newer than the oldest that serves
        stream.set_log_time_enabled(False)  # when and in which order it was written is of no interest
        stream.set_log_tick_enabled(False)
    stream.save(path, default_blueprint=_blueprint())
    stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)  # as a camera sees it, and `ibi.plot`
    stream.log("scene", rr.Points3D(scene, colors=_GREY), static=True)
    aside = _aside(scene, model)
    stream.log("model", rr.Transform3D(translation=aside), rr.Points3D(model), static=True)

    for k, pose in enumerate(registration):
        stream.set_time("round", sequence=pose.round)
        turn, shift = pose.target_from_source[:3, :3], pose.target_from_source[:3, 3]
        quality = rr.AnyValues(
            score=pose.score, overlap=pose.overlap, num_inliers=pose.num_inliers, evidence=pose.evidence
        )
        stream.log(f"instances/{k}", rr.Transform3D(translation=shift, mat3x3=turn), quality)
        stream.log(f"instances/{k}/model", rr.Points3D(model, colors=_colour(k)))
        if lines is not None:
            own = lines[registration.labels == k] + [aside, np.zeros(3)]
            stream.log(f"correspondences/{k}", rr.LineStrips3D(own, colors=_colour(k)))
    if lines is not None:
        rows = np.flatnonzero(registration.labels < 0)
        shown = rows[np.linspace(0, len(rows) - 1, min(len(rows), max_outliers)).astype(int)]
        strips = lines[shown] + [aside, np.zeros(3)]
        stream.log("correspondences/none", rr.LineStrips3D(strips, colors=_GREY), static=True)

    for played in registration.rounds:
        stream.set_time("round", sequence=played.index)
        stream.log("rounds/alive", rr.Scalars(played.num_alive))
        stream.log("rounds/seeds", rr.Scalars(played.num_seeds))
        if played.verdict is not None:
            stream.log("rounds/value", rr.Scalars(played.verdict.value))
            stream.log("rounds/threshold", rr.Scalars(played.verdict.threshold))
        stream.log("rounds/log", rr.TextLog(_in_words(played), level="INFO" if played.accepted else "DEBUG"))


def _blueprint() -> Any:
    with _interrupts.held():
        import rerun.blueprint as rrb

    numbers = rrb.Vertical(
        rrb.TimeSeriesView(
            origin="rounds", contents=["rounds/alive", "rounds/seeds"], name="correspondences"
        ),
        rrb.TimeSeriesView(origin="rounds", contents=["rounds/value", "rounds/threshold"], name="verdicts"),
        rrb.TextLogView(origin="rounds/log", name="rounds"),
    )
    return rrb.Blueprint(rrb.Horizontal(rrb.Spatial3DView(origin="/"), numbers, column_shares=[3, 1]))


def _ends(
    scene: npt.NDArray[np.float64], model: npt.NDArray[np.float64], corr: Any, num_labels: int
) -> npt.NDArray[np.float64]:
    """(M, 2, 3): the source point and the target point of each correspondence."""
    pairs = _correspondences(corr)
    if len(pairs) != num_labels:
        raise InputError(f"corr has {len(pairs)} rows; the registration has {num_labels} labels")
    if pairs.shape[1] == 6:
        return pairs.reshape(-1, 2, 3)
    for column, (name, cloud) in enumerate((("src", model), ("tgt", scene))):
        bad = np.flatnonzero((pairs[:, column] < 0) | (pairs[:, column] >= len(cloud)))
        if len(bad):
            value = pairs[bad[0], column]
            raise InputError(f"corr[{bad[0]}, {column}] is {value}; {name} has rows 0 to {len(cloud) - 1}")
    return np.stack([model[pairs[:, 0]], scene[pairs[:, 1]]], axis=1)


def _aside(scene: npt.NDArray[np.float64], model: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """How the model is moved to be at the left of the scene, half its own size away from it."""
    low, high = scene.min(axis=0), scene.max(axis=0)
    shift: npt.NDArray[np.float64] = (low + high) / 2 - (model.min(axis=0) + model.max(axis=0)) / 2
    shift[0] = low[0] - model[:, 0].max() - np.ptp(model, axis=0).max() / 2
    return shift


def _colour(k: int) -> tuple[int, int, int]:
    """Far from those of its neighbours, for any number of instances: hues apart by the golden ratio."""
    red, green, blue = colorsys.hsv_to_rgb(k * 0.618034 % 1, 0.8, 0.95)
    return round(255 * red), round(255 * green), round(255 * blue)


def _in_words(played: Round) -> str:
    head = f"round {played.index}: {played.num_seeds} seeds of {played.num_alive} alive"
    if played.verdict is None:
        return f"{head}; no hypothesis"
    verdict = "accepted" if played.accepted else "rejected"
    numbers = f"{played.verdict.value:.3g}, {played.verdict.threshold:.3g} needed"
    return f"{head}; {verdict}: {numbers}; {played.num_removed} removed"
