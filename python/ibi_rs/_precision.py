"""Numbers of single precision that are too coarse for the points they hold."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ibi_rs import _core

MAX_STEP = 0.5
"""How far apart the numbers of a cloud may be, in spacings of its points."""
SAMPLE = 1000
"""Points that stand for all of a cloud."""


def check_step(name: str, points: npt.NDArray[np.float64], spacing: float | None = None) -> None:
    """Refuse a cloud of single precision so far off that its numbers are as far apart as its points.

    Also one that is held in double precision by now: all its numbers are of single precision then.
    """
    sample = points[:: max(1, len(points) // SAMPLE)]
    sample = sample[np.isfinite(sample).all(axis=1)]
    if len(sample) < 3:
        return
    # Of an even number of points the mean of the middle two may be beyond the floats.
    distance = float(np.abs(np.quantile(sample, 0.5, axis=0, method="lower")).max())
    with np.errstate(over="ignore"):
        step = float(np.spacing(np.float32(distance)))
        # A step of a millionth is below the spacing of any cloud that fits into memory.
        if not step > 1e-6 * float(np.ptp(sample, axis=0).max()):
            return
        if not np.array_equal(sample, sample.astype(np.float32)):
            return
    if spacing is None:
        finite = np.isfinite(points).all(axis=1)
        try:
            spacing = _core.Model(np.ascontiguousarray(points[finite])).spacing
        except _core.InputError:  # whoever takes the cloud says so, by its name
            return
    if step > MAX_STEP * spacing:
        raise _core.InputError(
            f"{name}: the points are {spacing:.3g} apart and their coordinates about {distance:.3g}, where"
            f" numbers of single precision (float32) are {step:.3g} apart; subtract an offset before the cast"
        )
