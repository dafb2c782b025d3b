"""`View`: what a depth camera saw, and from where."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ibi_rs import _core
from ibi_rs._inputs import _eyes, _floats, _frozen, _number, _rigid, _scan_rows, _viewpoint
from ibi_rs.params import Params


@dataclass(frozen=True, eq=False, repr=False)
class View:
    """What a depth camera saw, and from where: a ``viewpoint`` that knows more.

    The points tell where there is nothing, and what hides what. Give it where the cloud that is registered is
    only a part of them, thinned or without its table; :meth:`Model.detect` does so by itself.

    Attributes
    ----------
    eye : (3,) float64
        Where the camera stood, in the frame of the scene, data units.
    points : (N, 3) float64
        All that it measured, in the frame of the scene, data units. Without the points that are not finite.
    num_dropped : int
        How many were not finite, or pixels without a depth.

    Examples
    --------
    >>> import ibi_rs as ibi
    >>> view = ibi.View.from_depth([[0.0, 2.0], [2.0, 2.0]], fx=2.0, fy=2.0, cx=0.5, cy=0.5)
    >>> view.points.tolist()
    [[0.5, -0.5, 2.0], [-0.5, 0.5, 2.0], [0.5, 0.5, 2.0]]
    """

    eye: npt.NDArray[np.float64]
    points: npt.NDArray[np.float64]
    num_dropped: int

    def __init__(self, eye: npt.ArrayLike, points: Any) -> None:
        place = np.array(_viewpoint(eye))
        if not np.isfinite(place).all():
            raise _core.InputError(f"viewpoint is {place.tolist()}; it must be finite")
        held, _, num_dropped, _ = _core.measured_rows(_scan_rows("viewpoint.points", points))
        object.__setattr__(self, "eye", _frozen(place))
        object.__setattr__(self, "points", _frozen(held))
        object.__setattr__(self, "num_dropped", num_dropped)

    @classmethod
    def from_depth(
        cls,
        depth: npt.ArrayLike,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        *,
        target_from_camera: npt.ArrayLike | None = None,
    ) -> View:
        """Make a view of an organised depth image.

        Parameters
        ----------
        depth : (H, W) array_like
            Depth along the axis of the camera, data units; 0 or not finite where nothing was measured.
        fx, fy, cx, cy : float
            Focal lengths and principal point of the pinhole camera, pixels.
        target_from_camera : (4, 4) array_like, optional
            Moves the camera's frame (x to the right, y down, z forward) to that of the scene. By default they
            are one.

        Returns
        -------
        View
            Its ``points`` are the scan, row by row: ``model.detect(view.points, viewpoint=view)``.

        Raises
        ------
        InputError
            An array has a wrong shape, a focal length is not above 0, a number is not finite, the matrix is
            no rigid motion, or no pixel has a depth.
        TypeError
            An argument is of another type than above.
        """
        image = _floats("depth", depth, "H", "W")
        points = depth_points(image, *_intrinsics(fx, fy, cx, cy))
        if len(points) == 0:
            raise _core.InputError("depth: no pixel has one")
        eye = np.zeros(3)
        if target_from_camera is not None:
            motion = _rigid("target_from_camera", target_from_camera)
            eye, points = motion[:3, 3], points @ motion[:3, :3].T + motion[:3, 3]
        view = cls(eye, points)
        object.__setattr__(view, "num_dropped", image.size - len(points))
        return view

    def __repr__(self) -> str:
        eye = ", ".join(np.format_float_positional(x + 0.0, 9, trim="-") for x in self.eye.round(9))
        return f"View({len(self.points)} points from [{eye}])"


def _intrinsics(fx: float, fy: float, cx: float, cy: float) -> tuple[float, float, float, float]:
    """Check a pinhole camera."""
    names = ("fx", "fy", "cx", "cy")
    values = [_number(name, value) for name, value in zip(names, (fx, fy, cx, cy), strict=True)]
    if not (values[0] > 0 and values[1] > 0):
        raise _core.InputError(f"fx and fy are {values[0]:g} and {values[1]:g}; they must be above 0")
    for name, value in zip(names, values, strict=True):
        if not np.isfinite(value):
            raise _core.InputError(f"{name} is {value:g}; it must be finite")
    return values[0], values[1], values[2], values[3]


def depth_points(
    image: npt.NDArray[np.float64], fx: float, fy: float, cx: float, cy: float
) -> npt.NDArray[np.float64]:
    """Return a point for each pixel with a finite depth above 0, row by row, in the frame of the camera."""
    v, u = np.nonzero(np.isfinite(image) & (image > 0))
    z = image[v, u]
    with np.errstate(over="ignore", invalid="ignore"):  # what leaves the numbers is no point
        points = np.column_stack([(u - cx) / fx * z, (v - cy) / fy * z, z])
    return points[np.isfinite(points).all(axis=1)]


Viewpoint = npt.ArrayLike | View | Sequence[View]
"""Where a scene was seen from: one place, several, or cameras with all that they measured."""


def _cameras(
    value: Viewpoint | None,
) -> tuple[list[list[float]] | None, list[npt.NDArray[np.float64]] | None]:
    """Return the cameras' places and what each of them measured, as far as they are known."""
    if value is None:
        return None, None
    views = [value] if isinstance(value, View) else value
    if isinstance(views, (list, tuple)) and any(isinstance(view, View) for view in views):
        for view in views:
            if not isinstance(view, View):
                raise TypeError(
                    f"viewpoint: beside a View there can only be others, not {type(view).__name__}"
                )
        return [view.eye.tolist() for view in views], [view.points for view in views]
    eyes = _eyes(value)
    return eyes.tolist(), None


FEW_VIEWPOINTS = 4
"""A scan of more cameras is one that was walked around."""


def _preset(viewpoint: Viewpoint | None) -> Params:
    """Return the parameters that fit what is known of the cameras."""
    eyes, _ = _cameras(viewpoint)
    return Params.single_view() if eyes and len(eyes) <= FEW_VIEWPOINTS else Params.many_views()
