"""`Matches`: a scan as it was matched with a model, and how a scan is handed to the core."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ibi_rs import _precision
from ibi_rs._box import Box, region
from ibi_rs._inputs import Points, _num_threads, _scan_rows
from ibi_rs._view import Viewpoint, _cameras

_Floats = npt.NDArray[np.float64]


class _Matched(NamedTuple):
    tgt: _Floats
    """(N, 3), thinned."""
    tgt_normals: _Floats
    """(N, 3), of length 1."""
    corr: npt.NDArray[np.int64]
    """(M, 2): [row of the model's points, row of ``tgt``]."""
    similarity: npt.NDArray[np.float64]
    """(M,), as :func:`ibi_rs.match` gives it."""


class Matches(_Matched):
    """A scene as it was matched with a model: what :meth:`Model.register` wants, as a tuple of four.

    Attributes
    ----------
    tgt : (N, 3) float64
        The scene, thinned.
    tgt_normals : (N, 3) float64
        Of length 1.
    corr : (M, 2) int64
        [row of the model's points, row of ``tgt``].
    similarity : (M,) float64
        As :func:`ibi_rs.match` gives it.
    background : (K, 3) float64
        What of the thinned scene was taken away: its table and walls, and what lies on the ``background``
        that was given.
    voxel : float
        What the scene was thinned to, data units: :attr:`Model.voxel`, or more where the scan is coarser.
        Then :meth:`Model.detect` registers with a ``resolution`` of ``voxel / 1.25``, unless ``params`` has
        one.
    warnings : tuple of str
        What is doubtful about the scene, one line each.
    """

    background: npt.NDArray[np.float64]
    voxel: float
    warnings: tuple[str, ...]

    @classmethod
    def _of(cls, raw: tuple[Any, ...]) -> Matches:
        *arrays, background, voxel, warnings = raw
        matches = cls(*arrays)
        matches.background, matches.voxel, matches.warnings = background, voxel, tuple(warnings)
        return matches


def scan_arguments(
    tgt: Points,
    tgt_normals: npt.ArrayLike | None,
    viewpoint: Viewpoint | None,
    remove_plane: bool | None,
    check_units: bool,
    roi: Box | npt.ArrayLike | None,
    background: Points | None,
    num_threads: int | None,
) -> dict[str, Any]:
    """Check what the core is to be told of a scan."""
    if remove_plane is not None and not isinstance(remove_plane, (bool, np.bool_)):
        raise TypeError(f"remove_plane must be a bool or None, not {type(remove_plane).__name__}")
    points = _scan_rows("tgt", tgt)
    _precision.check_step("tgt", points)
    eye, measured = _cameras(viewpoint)
    return {
        "tgt": points,
        "tgt_normals": None if tgt_normals is None else _scan_rows("tgt_normals", tgt_normals),
        "viewpoint": eye,
        "measured": measured,
        "remove_plane": None if remove_plane is None else bool(remove_plane),
        "check_units": bool(check_units),
        "roi": region(roi),
        "background": None if background is None else _scan_rows("background", background),
        "num_threads": _num_threads(num_threads),
    }
