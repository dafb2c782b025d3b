"""`View`: what a depth camera saw, and from where."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ibi_rs import _core
from ibi_rs._inputs import _frozen, _number, _points, _real, _viewpoint


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

    Examples
    --------
    >>> import ibi_rs as ibi
    >>> view = ibi.View.from_depth([[0.0, 2.0], [2.0, 2.0]], fx=2.0, fy=2.0, cx=0.5, cy=0.5)
    >>> view.points.tolist()
    [[0.5, -0.5, 2.0], [-0.5, 0.5, 2.0], [0.5, 0.5, 2.0]]
    """

    eye: npt.NDArray[np.float64]
    points: npt.NDArray[np.float64]

    def __init__(self, eye: npt.ArrayLike, points: Any) -> None:
        held = _points("viewpoint.points", points)
        object.__setattr__(self, "eye", _frozen(np.array(_viewpoint(eye))))
        object.__setattr__(self, "points", _frozen(held[np.isfinite(held).all(axis=1)]))

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
            An array has a wrong shape, a focal length is not above 0, or no pixel has a depth.
        TypeError
            An argument is of another type than above.
        """
        image = np.asarray(_real("depth", depth), dtype=np.float64)
        if image.ndim != 2:
            raise _core.InputError(f"depth has shape {image.shape}; it must be (H, W)")
        names = ("fx", "fy", "cx", "cy")
        fx, fy, cx, cy = (_number(name, value) for name, value in zip(names, (fx, fy, cx, cy), strict=True))
        if not (fx > 0 and fy > 0):
            raise _core.InputError(f"fx and fy are {fx:g} and {fy:g}; they must be above 0")
        points = depth_points(image, fx, fy, cx, cy)
        if len(points) == 0:
            raise _core.InputError("depth: no pixel has one")
        if target_from_camera is None:
            return cls(np.zeros(3), points)
        motion = np.asarray(_real("target_from_camera", target_from_camera), dtype=np.float64)
        if motion.shape != (4, 4):
            raise _core.InputError(f"target_from_camera has shape {motion.shape}; it must be (4, 4)")
        return cls(motion[:3, 3], points @ motion[:3, :3].T + motion[:3, 3])

    def __repr__(self) -> str:
        eye = ", ".join(np.format_float_positional(x + 0.0, 9, trim="-") for x in self.eye.round(9))
        return f"View({len(self.points)} points from [{eye}])"


def depth_points(
    image: npt.NDArray[np.float64], fx: float, fy: float, cx: float, cy: float
) -> npt.NDArray[np.float64]:
    """Return a point for each pixel with a finite depth above 0, row by row, in the frame of the camera."""
    v, u = np.nonzero(np.isfinite(image) & (image > 0))
    z = image[v, u]
    return np.column_stack([(u - cx) / fx * z, (v - cy) / fy * z, z])


def _camera(
    value: npt.ArrayLike | View | None,
) -> tuple[list[float] | None, npt.NDArray[np.float64] | None]:
    """Return the camera's place and what it measured, as far as they are known."""
    if isinstance(value, View):
        return value.eye.tolist(), value.points
    return None if value is None else _viewpoint(value), None
