"""Pictures of a registration, and pages to turn it: ``pip install 'ibi_rs[plot]'``."""

from __future__ import annotations

import colorsys
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ibi_rs import _interrupts, _page
from ibi_rs._core import InputError
from ibi_rs._files import written
from ibi_rs._inputs import Points, _count, _points, _real
from ibi_rs._numbers import lengths, significant
from ibi_rs._written import checked_unit, quaternion

if TYPE_CHECKING:
    from ibi_rs.registration import Pose, Registration, Rejected

__all__ = ["MAX_POINTS", "html", "instances"]

MAX_POINTS = 60_000
"""Points of the scene that a page shows by default, and of all parts together four times as many."""


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

    size = 10 if len(poses) <= 20 else 7
    # No pyplot: it would keep the figure and may want a display.
    figure = Figure(figsize=(6.5 * len(turns_deg), 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    for column, turn_deg in enumerate(turns_deg):
        axes = figure.add_subplot(1, len(turns_deg), column + 1)
        cos, sin = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
        turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
        flat = (scene - middle) @ turn.T
        centres = np.empty((len(poses), 2))
        axes.scatter(flat[:, 0], flat[:, 1], s=2, c="0.7", linewidths=0, zorder=0)
        for k, pose in enumerate(poses):
            moved = (model @ pose[:3, :3].T + pose[:3, 3] - middle) @ turn.T
            colour = colours(k % colours.N)
            axes.scatter(moved[:, 0], moved[:, 1], s=1.5, color=colour, alpha=0.5, linewidths=0, zorder=1)
            centres[k] = moved[:, :2].mean(axis=0)
        corners = np.concatenate([flat[:, :2], centres])
        places = _apart(centres, 0.03 * np.ptp(corners, axis=0).max())
        for k, (centre, place) in enumerate(zip(centres, places, strict=True)):
            label = {"boxstyle": "circle,pad=0.15", "fc": "white", "ec": colours(k % colours.N)}
            line = {"arrowstyle": "-", "color": "0.3", "lw": 0.6} if (place != centre).any() else None
            style: dict[str, Any] = {
                "ha": "center",
                "va": "center",
                "bbox": label,
                "arrowprops": line,
                "fontsize": size,
            }
            at, to = centre.tolist(), place.tolist()
            axes.annotate(str(k), at, to, zorder=2, **style)
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


def _apart(centres: npt.NDArray[np.float64], distance: float) -> npt.NDArray[np.float64]:
    """Move labels that would cover others to the nearest free place, on rings about their centres."""
    places: list[npt.NDArray[np.float64]] = []
    angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    for centre in centres:
        held = np.array(places).reshape(-1, 2)
        free = [centre]
        for radius in range(1, len(places) + 2):
            gaps = [np.linalg.norm(held - place, axis=1).min(initial=np.inf) for place in free]
            if max(gaps) >= distance:
                break
            free = list(centre + radius * distance * ring)
        places.append(free[int(np.argmax(np.array(gaps) >= distance))])
    return np.array(places).reshape(-1, 2)


def html(
    tgt: Points,
    src: Points | Sequence[Points],
    registration: Registration,
    path: str | os.PathLike[str],
    *,
    title: str = "found",
    unit: str | None = None,
    max_points: int = MAX_POINTS,
) -> None:
    """Write a page that shows the scene and the model at each pose, to be turned with the mouse.

    One file, which needs a browser and no network. Poses are listed with their scores and picked by a click
    or by their number; the scene, numbers, what was rejected and low scores are switched on and off.

    Parameters
    ----------
    tgt : (N, 3) array_like
        The scene.
    src : (N, 3) array_like, or a sequence of them
        The model; of :class:`Models` each of them.
    registration : Registration
        What was found.
    path : path
        The file to be written; ``.html`` is usual.
    title : str
        Above the list.
    unit : str, optional
        Of lengths, beside which it is shown: ``"m"``, ``"mm"`` and so on.
    max_points : int
        Most points of the scene, and a quarter of those of all parts; at least 100. More are thinned evenly.

    Returns
    -------
    None

    Raises
    ------
    InputError
        An array has a wrong shape or is empty, or there are more models or fewer than in the registration.
    ImportError
        Plotly is not installed; the message names the extra.
    OSError
        The file cannot be written; then nothing of it is left.
    """
    from ibi_rs.registration import Rejected

    go = _plotly()
    scene = _points("tgt", tgt)
    max_points = _count("max_points", max_points, 100)
    unit = checked_unit(unit)
    names = registration.models or (None,)
    clouds = [src] if len(names) == 1 and np.ndim(src) != 3 else list(src)
    if len(clouds) != len(names):
        raise InputError(f"src: there are {len(clouds)} models; {len(names)} were looked for")
    parts = [_points("src", cloud) for cloud in clouds]
    for name, cloud in (("tgt", scene), *(("src", part) for part in parts)):
        if len(cloud) == 0:
            raise InputError(f"{name} has 0 points; there is nothing to draw")
    rejected = registration.rejected
    most = max(50, 4 * max_points // max(1, len(registration) + len(rejected)))
    parts = [_thinned(part, most) for part in parts]

    def markers(points: npt.NDArray[np.float64], **style: Any) -> Any:
        columns = dict(zip("xyz", np.ascontiguousarray(points.T, np.float32), strict=True))
        return go.Scatter3d(**columns, **{"mode": "markers", **style})

    marker = {"size": 1.5, "color": "#9a9a9a"}
    traces = [markers(_thinned(scene, max_points), marker=marker, hoverinfo="skip", name="scene")]
    poses, centres = [], []
    every: list[Pose | Rejected] = [*registration, *rejected]
    for k, one in enumerate(every):
        is_out = k >= len(registration)
        label = f"r{k - len(registration)}" if is_out else str(k)
        objection = f", {one.objection}" if isinstance(one, Rejected) else ""
        matrix = one.target_from_source
        moved = parts[one.model] @ matrix[:3, :3].T + matrix[:3, 3]
        centres.append((moved.min(axis=0) + moved.max(axis=0)) / 2)
        colour = "#d33" if is_out else _colour(k)
        hover = f"{label}: {one.score:.2f}{objection}<extra></extra>"
        style = {"marker": {"size": 2, "color": colour}, "hovertemplate": hover, "visible": not is_out}
        traces.append(markers(moved, name=label, **style))
        poses.append(
            {
                "trace": len(traces) - 1,
                "label": label,
                "name": " ".join([one.model_name or "", objection.removeprefix(", ")]).strip(),
                "score": one.score,
                "colour": colour,
                "rejected": one.objection if isinstance(one, Rejected) else None,
                "facts": _facts(one, registration.resolution, unit),
            }
        )
    if poses:
        texts = [pose["label"] for pose in poses]
        font = {"size": 13, "color": "#111"}
        traces.append(markers(np.array(centres), mode="text", text=texts, textfont=font, hoverinfo="skip"))
    axes = {f"{axis}axis": {"title": {"text": f"{axis} [{unit}]" if unit else axis}} for axis in "xyz"}
    # As a camera at the origin sees it: x to the right, y down, z into the picture.
    camera = {"up": {"x": 0, "y": -1, "z": 0}, "eye": {"x": 0.4, "y": -0.5, "z": -1.5}}
    figure = go.Figure(traces)
    figure.update_layout(
        scene={"aspectmode": "data", "camera": camera, "dragmode": "orbit", **axes},
        showlegend=False,
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        uirevision="kept",  # who turned it does not lose that by a click
    )
    body = figure.to_html(full_html=False, include_plotlyjs=True, config={"displaylogo": False})
    counts = f"{len(registration)} found, {len(rejected)} rejected; {len(scene)} points"
    data = {"poses": poses, "scene": 0, "labels": len(traces) - 1 if poses else None}
    with written(path) as part:
        part.write_text(_page.page(body, title, counts, data, len(rejected)), encoding="utf-8")


def _plotly() -> Any:
    try:
        with _interrupts.held():
            import plotly.graph_objects
    except ImportError as error:
        raise ImportError(f"pages need Plotly: pip install 'ibi_rs[plot]' ({error})") from error
    return plotly.graph_objects


def _thinned(points: npt.NDArray[np.float64], most: int) -> npt.NDArray[np.float64]:
    """No more than so many, drawn at random, so that no pattern of the scan shows."""
    if len(points) <= most:
        return points
    return points[np.sort(np.random.default_rng(0).choice(len(points), most, replace=False))]


def _colour(k: int) -> str:
    """Far from those of its neighbours, for any number of instances: hues apart by the golden ratio."""
    red, green, blue = colorsys.hsv_to_rgb(k * 0.618034 % 1, 0.85, (0.9, 0.7)[k // 8 % 2])
    return f"rgb({255 * red:.0f},{255 * green:.0f},{255 * blue:.0f})"


def _facts(pose: Any, resolution: float, unit: str | None) -> list[tuple[str, str]]:
    """Say what is known of a pose, by names."""
    after = f" {unit}" if unit else ""
    place = ", ".join(lengths(pose.target_from_source[:3, 3], resolution))
    turn = ", ".join(f"{x:.4f}" for x in quaternion(pose.target_from_source[:3, :3]))
    facts = [("score", f"{pose.score:.3f}"), ("place", f"{place}{after}"), ("x, y, z, w", turn)]
    if hasattr(pose, "objection"):
        return [*facts, ("objection", pose.objection)]
    facts += [("overlap", f"{pose.overlap:.2f}"), ("inliers", str(pose.num_inliers))]
    if pose.covariance is not None:
        deviations = np.sqrt(np.diag(pose.covariance))
        facts.append(("turn \u00b1", f"{np.degrees(deviations[:3].max()):.2f} deg"))
        facts.append(("place \u00b1", f"{significant(deviations[3:].max(), 2)}{after}"))
    return facts


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
