"""`Box`: a region of a scan to look into."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ibi_rs import _core
from ibi_rs._inputs import _floats, _frozen, _rigid


@dataclass(frozen=True, eq=False, repr=False)
class Box:
    """A box in the frame of the scan: the ``roi`` of :meth:`Model.detect`.

    Attributes
    ----------
    center : (3,) float64
        Its middle, data units.
    size : (3,) float64
        Lengths of its sides, data units; above 0.
    rotation : (3, 3) float64
        Its axes as columns, in the frame of the scan; by default those of the scan.

    Examples
    --------
    >>> import ibi_rs as ibi
    >>> ibi.Box([0, 0, 500], [300, 200, 100])
    Box(center=[0, 0, 500], size=[300, 200, 100])
    >>> ibi.Box.between([-150, -100, 450], [150, 100, 550])
    Box(center=[0, 0, 500], size=[300, 200, 100])
    """

    center: npt.NDArray[np.float64]
    size: npt.NDArray[np.float64]
    rotation: npt.NDArray[np.float64]

    def __init__(
        self, center: npt.ArrayLike, size: npt.ArrayLike, rotation: npt.ArrayLike | None = None
    ) -> None:
        place, sides = _floats("center", center, 3), _floats("size", size, 3)
        if not np.isfinite(place).all():
            raise _core.InputError(f"center is {place.tolist()}; it must be finite")
        if not ((sides > 0) & np.isfinite(sides)).all():
            raise _core.InputError(f"size is {sides.tolist()}; it must be above 0 and finite")
        motion = np.eye(4)
        if rotation is not None:
            motion[:3, :3] = _floats("rotation", rotation, 3, 3)
            motion = _rigid("rotation", motion)
        for name, value in (("center", place), ("size", sides), ("rotation", motion[:3, :3])):
            object.__setattr__(self, name, _frozen(value.copy()))

    @classmethod
    def between(cls, low: npt.ArrayLike, high: npt.ArrayLike) -> Box:
        """Make a box along the axes of the scan, of its two extreme corners.

        Parameters
        ----------
        low, high : (3,) array_like
            The corners of the least and of the largest coordinates, data units.

        Returns
        -------
        Box

        Raises
        ------
        InputError
            A corner is not finite, or ``low`` is not below ``high``.
        """
        corners = _floats("low", low, 3), _floats("high", high, 3)
        if not np.isfinite(corners).all() or not (corners[0] < corners[1]).all():
            shown = " and ".join(str(corner.tolist()) for corner in corners)
            raise _core.InputError(
                f"roi: its corners are {shown}; they must be finite, the first below the second"
            )
        return cls((corners[0] + corners[1]) / 2, corners[1] - corners[0])

    @property
    def target_from_box(self) -> npt.NDArray[np.float64]:
        """(4, 4): moves a box about the origin, its sides along the axes, to this one."""
        motion = np.eye(4)
        motion[:3, :3], motion[:3, 3] = self.rotation, self.center
        return motion

    def __repr__(self) -> str:
        texts = [", ".join(f"{x + 0.0:.6g}" for x in of) for of in (self.center, self.size)]
        turned = "" if np.array_equal(self.rotation, np.eye(3)) else ", turned"
        return f"Box(center=[{texts[0]}], size=[{texts[1]}]{turned})"


def region(value: Any) -> tuple[npt.NDArray[np.float64], list[float]] | None:
    """Return what the core takes for a ``roi``."""
    if value is None:
        return None
    if not isinstance(value, Box):
        value = Box.between(*_floats("roi", value, 2, 3))
    return np.ascontiguousarray(value.target_from_box), value.size.tolist()
