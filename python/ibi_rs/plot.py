"""Pictures of a registration. Needs matplotlib: ``pip install 'ibi_rs[plot]'``."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ibi_rs import _interrupts
from ibi_rs._core import InputError
from ibi_rs._files import written
from ibi_rs._inputs import Points, _points, _real

if TYPE_CHECKING:
    from ibi_rs.registration import Registration

__all__ = ["instances"]


def instances(
    tgt: Points,
    src: Points,
    registration: Registration | npt.ArrayLike,
    path: str | os.PathLike[str] | None = None,
    *,
    turns_deg: Sequence[float] = (0.0, 70.0),
    title: str | None = None,
) -> Any:
    """Draw the scene in grey and the model at each pose in a colour of its own, from several sides.

    Each view is an orthographic projection, x to the right, y down, z into the picture, as a camera at the
    origin sees its scene; turned about the vertical through the middle of the scene.

    Parameters
    ----------
    tgt : (N, 3) array_like
        The scene.
    src : (N, 3) array_like
        The model.
    registration : Registration or (K, 4, 4) array_like
        The poses; numbered from 0 as in the registration.
    path : path, optional
        Where to save the picture; the suffix chooses the format: ``.png``, ``.pdf``, ``.svg`` and others.
    turns_deg : sequence of float
        One view for each turn, in degrees.
    title : str, optional
        A line above the views.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        An array has a wrong shape or is empty, or matplotlib writes no pictures of that suffix.
    ImportError
        If matplotlib is not installed; the message names the extra.
    OSError
        The picture cannot be written; then nothing of it is left.
    """
    picture_format = _format(path)
    with _interrupts.held():
        from matplotlib import colormaps
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

    scene, model = _points("tgt", tgt), _points("src", src)
    for name, cloud in (("tgt", scene), ("src", model)):
        if len(cloud) == 0:
            raise InputError(f"{name} has 0 points; there is nothing to draw")
    poses = np.asarray(_real("registration", registration), np.float64)
    if poses.size and (poses.ndim != 3 or poses.shape[1:] != (4, 4)):
        raise InputError(f"registration has shape {poses.shape}; it must be (K, 4, 4)")
    poses = poses.reshape(-1, 4, 4)
    if len(turns_deg) == 0:
        raise InputError("turns_deg is empty; it must have one angle or more")
    middle = (scene.min(axis=0) + scene.max(axis=0)) / 2
    colours = colormaps["tab10" if len(poses) <= 10 else "tab20"]

    # No pyplot: it would keep the figure and may want a display.
    figure = Figure(figsize=(6.5 * len(turns_deg), 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    for column, turn_deg in enumerate(turns_deg):
        axes = figure.add_subplot(1, len(turns_deg), column + 1)
        cos, sin = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
        turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
        flat = (scene - middle) @ turn.T
        axes.scatter(flat[:, 0], flat[:, 1], s=2, c="0.7", linewidths=0, zorder=0)
        for k, pose in enumerate(poses):
            moved = (model @ pose[:3, :3].T + pose[:3, 3] - middle) @ turn.T
            colour = colours(k % colours.N)
            axes.scatter(moved[:, 0], moved[:, 1], s=1.5, color=colour, alpha=0.5, linewidths=0, zorder=1)
            centre = moved.mean(axis=0)
            label = {"boxstyle": "circle,pad=0.15", "fc": "white", "ec": colour}
            axes.annotate(str(k), centre[:2], ha="center", va="center", bbox=label, zorder=2)
        axes.set_aspect("equal")
        axes.invert_yaxis()
        axes.set_axis_off()
        axes.set_title(f"turned by {turn_deg:g} degrees" if turn_deg else "as the camera sees it")
    if title:
        figure.suptitle(title)
    if path is not None:
        with written(path) as part:
            figure.savefig(part, dpi=110, format=picture_format)
    return figure


def _format(path: str | os.PathLike[str] | None) -> str | None:
    """Return the format of a picture by its suffix; raise now what would be raised after a long run."""
    try:
        with _interrupts.held():
            from matplotlib.backend_bases import FigureCanvasBase
    except ImportError as error:
        raise ImportError(f"pictures need matplotlib: pip install 'ibi_rs[plot]' ({error})") from error
    if path is None:
        return None
    known = set(FigureCanvasBase.get_supported_filetypes()) - {"pgf"}  # which needs LaTeX
    suffix = Path(path).suffix.lower().removeprefix(".")
    if suffix not in known:
        raise InputError(f"{path}: pictures are written as {', '.join(sorted(known))}, not as '{suffix}'")
    return suffix
