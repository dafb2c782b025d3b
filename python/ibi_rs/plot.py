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
from ibi_rs._inputs import Points, _count, _mesh, _points, _real, _scan_rows
from ibi_rs._numbers import lengths, significant
from ibi_rs._written import checked_unit, quaternion

if TYPE_CHECKING:
    from ibi_rs.io import Camera
    from ibi_rs.registration import Pose, Registration, Rejected

__all__ = ["MAX_POINTS", "html", "instances", "outlines"]

MAX_POINTS = 60_000
"""Points of the scene that a page shows by default, and of all parts together four times as many."""
_MOST_PIXELS = 16_384
"""Of a depth image, in a row or a column: more are of another camera."""


def instances(
    tgt: Points,
    src: Points,
    registration: Registration | npt.ArrayLike,
    path: str | os.PathLike[str] | None = None,
    *,
    turns_deg: Sequence[float] = (0.0, 70.0),
    title: str | None = None,
    unit: str | None = None,
    viewpoint: npt.ArrayLike | None = None,
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
    unit : str, optional
        Of lengths: ``"m"``, ``"mm"`` and so on; beside the scale, and in the heading.
    viewpoint : (3,) array_like, optional
        Where the camera stood, in the frame of ``tgt``; named in the heading.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        An array has a wrong shape or is empty, ``unit`` is none, or matplotlib writes no pictures of that
        suffix.
    ImportError
        If matplotlib is not installed; the message names the extra.
    OSError
        The picture cannot be written; then nothing of it is left.
    """
    picture_format = _format(path)
    scene, model = _points("tgt", tgt), _points("src", src)
    for name, cloud in (("tgt", scene), ("src", model)):
        if len(cloud) == 0:
            raise InputError(f"{name} has 0 points; there is nothing to draw")
    poses = _poses(registration)
    if len(turns_deg) == 0:
        raise InputError("turns_deg is empty; it must have one angle or more")
    unit = checked_unit(unit)
    middle = (scene.min(axis=0) + scene.max(axis=0)) / 2
    figure = _figure(6.5 * len(turns_deg), 6.0)
    views = []
    for column, turn_deg in enumerate(turns_deg):
        axes = figure.add_subplot(1, len(turns_deg), column + 1)
        cos, sin = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
        turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
        flat = (scene - middle) @ turn.T
        centres = np.empty((len(poses), 2))
        axes.scatter(flat[:, 0], flat[:, 1], s=2, c="0.7", linewidths=0, zorder=0)
        for k, pose in enumerate(poses):
            moved = (model @ pose[:3, :3].T + pose[:3, 3] - middle) @ turn.T
            style = {"s": 1.5, "color": _shade(k), "alpha": 0.5, "linewidths": 0, "zorder": 1}
            axes.scatter(moved[:, 0], moved[:, 1], **style)
            centres[k] = moved[:, :2].mean(axis=0)
        axes.set_aspect("equal")
        axes.invert_yaxis()
        axes.set_axis_off()
        axes.set_title(f"turned by {turn_deg:g} degrees" if turn_deg else "as the camera sees it")
        _scale(axes, unit)
        views.append((axes, centres))
    about = [] if unit is None else [f"lengths in {unit}"]
    if viewpoint is not None:
        x, y, z = _points("viewpoint", np.reshape(_real("viewpoint", viewpoint), (1, -1)))[0]
        about.append(f"camera at {x:.6g}, {y:.6g}, {z:.6g}")
    _head(figure, title, about)
    _label(figure, views, [str(k) for k in range(len(poses))])
    return _saved(figure, path, picture_format)


def outlines(
    tgt: Points,
    camera: Camera,
    mesh: Any,
    registration: Registration,
    path: str | os.PathLike[str] | None = None,
    *,
    title: str | None = None,
    unit: str | None = None,
) -> Any:
    """Draw a depth image in grey, near is light, and the outline of the part at each pose.

    Each has its number and its score. What hides a part does not hide its outline.

    Parameters
    ----------
    tgt : (N, 3) or (H, W, 3) array_like
        What the camera measured, in its frame (x to the right, y down, z forward), as
        :func:`ibi_rs.io.read_depth` gives it.
    camera : Camera
        Of :func:`ibi_rs.io.read_camera`, or ``ibi_rs.io.Camera(fx, fy, cx, cy)``, in pixels.
    mesh : (vertices, faces), or a mesh of trimesh or Open3D
        The part, as :meth:`ibi_rs.Model.from_mesh` takes it.
    registration : Registration
        The poses; numbered from 0.
    path : path, optional
        As in :func:`instances`.
    title : str, optional
        A line above the picture.
    unit : str, optional
        Of lengths, for the heading: ``"m"``, ``"mm"`` and so on.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        As :func:`instances`; or ``tgt`` has nothing before the camera, or fills so large an image that it is
        of another camera.
    ImportError, OSError
        As :func:`instances`.
    """
    picture_format = _format(path)
    points = _scan_rows("tgt", tgt)
    points = points[np.isfinite(points).all(axis=1)]
    points = points[points[:, 2] > 0]
    if len(points) == 0:
        raise InputError("tgt has no point before the camera; there is nothing to draw")
    vertices, faces = _mesh(*mesh) if isinstance(mesh, tuple) else _mesh(mesh, None)
    unit = checked_unit(unit)
    pixels = np.rint(_projected(points, camera)).astype(np.int64)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    width, height = (high - low + 1).tolist()
    if max(width, height) > _MOST_PIXELS:
        raise InputError(f"camera: tgt would fill {width} x {height} pixels; is it the camera of this scan?")
    image = np.full((height, width), np.nan)
    far_first = np.argsort(-points[:, 2], kind="stable")
    columns, rows = (pixels[far_first] - low).T
    image[rows, columns] = points[far_first, 2]

    scale = min(12.0 / width, 9.0 / height)
    figure = _figure(max(5.0, width * scale), max(4.0, height * scale) + 0.6)
    axes = figure.add_subplot()
    near, far = np.nanpercentile(image, [1, 99])
    extent = (low[0] - 0.5, high[0] + 0.5, high[1] + 0.5, low[1] - 0.5)
    axes.set_facecolor("#26303c")  # where nothing was measured
    axes.imshow(-image, cmap="gray", vmin=-far - 0.25 * (far - near), vmax=-near, extent=extent)
    centres, texts = np.empty((len(registration), 2)), []
    for k, pose in enumerate(registration):
        matrix = pose.target_from_source
        seen = _projected(vertices @ matrix[:3, :3].T + matrix[:3, 3], camera)
        mask, corner, step = _silhouette(seen, faces)
        grid = [corner[i] + step * np.arange(mask.shape[1 - i]) for i in (0, 1)]
        for width_pt, colour in ((2.6, "black"), (1.3, _shade(k))):
            style = {"levels": [0.5], "colors": [colour], "linewidths": width_pt}
            axes.contour(*grid, mask.astype(np.float64), **style)
        is_in = np.argwhere(mask)
        centres[k] = corner + step * is_in.mean(axis=0)[::-1] if len(is_in) else seen.mean(axis=0)
        texts.append(f"{k}  {pose.score:.2f}")
    axes.set_xlim(extent[0], extent[1])
    axes.set_ylim(extent[2], extent[3])
    axes.set_xticks([])
    axes.set_yticks([])
    ends = " to ".join(lengths((near, far), (far - near) / 10))
    depth = f"depth {ends} {unit or ''}".strip()
    _head(figure, title, [f"as the camera sees it, near is light: {depth}", "number and score of each part"])
    _label(figure, [(axes, centres)], texts)
    return _saved(figure, path, picture_format)


_DPI = 110


def _poses(registration: Any) -> npt.NDArray[np.float64]:
    poses = np.asarray(_real("registration", registration), np.float64)
    if poses.size and (poses.ndim != 3 or poses.shape[1:] != (4, 4)):
        raise InputError(f"registration has shape {poses.shape}; it must be (K, 4, 4)")
    return poses.reshape(-1, 4, 4)


def _figure(width: float, height: float) -> Any:
    """Without pyplot, which would keep the figure and may want a display."""
    with _interrupts.held():
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _saved(figure: Any, path: str | os.PathLike[str] | None, picture_format: str | None) -> Any:
    if path is not None:
        with written(path) as part:
            figure.savefig(part, dpi=_DPI, format=picture_format)
    return figure


def _shade(k: int) -> Any:
    """Return one of matplotlib's ten colours; for more, one far from those of its neighbours."""
    if k < 10:
        return f"C{k}"
    return colorsys.hsv_to_rgb(k * 0.618034 % 1, 0.85, (0.9, 0.7)[k // 8 % 2])


def _head(figure: Any, title: str | None, about: list[str]) -> None:
    """Write the title, and below it in small print what else is to be known."""
    lines = [*([title] if title else []), *(["; ".join(about)] if about else [])]
    if lines:
        figure.suptitle("\n".join(lines), fontsize=11)


def _label(figure: Any, views: Sequence[tuple[Any, npt.NDArray[np.float64]]], texts: list[str]) -> None:
    """Write texts at places of each of the axes, or beside them, so that none covers another."""
    figure.canvas.draw()  # then it is known how large a text is, and where
    figure.set_layout_engine("none")  # and that stays so
    if not texts:
        return
    size = 9 if len(texts) <= 20 else 7
    for axes, centres in views:
        to_pixels = axes.transData
        at = to_pixels.transform(centres)
        trial = axes.text(0, 0, max(texts, key=len), fontsize=size)
        extent = trial.get_window_extent()
        trial.remove()
        room = np.array([extent.width, extent.height]) + 0.6 * size * _DPI / 72
        beside = _apart(at / room, 1.0) * room
        places = to_pixels.inverted().transform(beside)
        for k, text in enumerate(texts):
            label = {"boxstyle": "round,pad=0.2", "fc": "white", "ec": _shade(k), "alpha": 0.9}
            is_off = np.abs(beside[k] - at[k]).max() > 1
            line = {"arrowstyle": "-", "color": _shade(k), "lw": 0.8} if is_off else None
            style: dict[str, Any] = {"ha": "center", "va": "center", "bbox": label, "arrowprops": line}
            axes.annotate(
                text, centres[k], places[k], fontsize=size, zorder=3, annotation_clip=False, **style
            )


def _scale(axes: Any, unit: str | None) -> None:
    """Draw a length to go by into a corner."""
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    wanted = (right - left) / 5
    if not 0 < wanted < np.inf:
        return
    power = 10.0 ** np.floor(np.log10(wanted))
    length = power * max(step for step in (1, 2, 5) if step * power <= wanted)
    height = bottom - 0.01 * (bottom - top)
    axes.plot([left, left + length], [height, height], color="0.2", lw=2, solid_capstyle="butt")
    text = f"{length:.6g} {unit or ''}".strip()
    axes.text(left, height - 0.01 * (bottom - top), text, color="0.2", fontsize=9, va="bottom")


def _projected(points: npt.NDArray[np.float64], camera: Camera) -> npt.NDArray[np.float64]:
    """(N, 2): columns and rows of pixels; what is behind the camera is nowhere."""
    depth = np.where(points[:, 2] > 0, points[:, 2], np.nan)
    columns = points[:, 0] / depth * camera.fx + camera.cx
    return np.column_stack([columns, points[:, 1] / depth * camera.fy + camera.cy])


def _silhouette(
    seen: npt.NDArray[np.float64], faces: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.float64], float]:
    """Fill the faces of a projected mesh: a mask, where its first pixel is, and the size of its pixels."""
    with _interrupts.held():
        from PIL import Image, ImageDraw  # matplotlib needs it, too

    faces = faces[np.isfinite(seen[faces]).all(axis=(1, 2))]
    if len(faces) == 0:
        return np.zeros((2, 2), np.bool_), np.zeros(2), 1.0
    low, high = seen[faces].min(axis=(0, 1)), seen[faces].max(axis=(0, 1))
    step = max(0.5, float((high - low).max()) / 600)
    corner = low - 2 * step
    # Many of a fine mesh are the same few pixels.
    shapes = np.unique(np.rint((seen[faces] - corner) / step).astype(np.int64).reshape(-1, 6), axis=0)
    columns, rows = (np.ceil((high - corner) / step).astype(int) + 3).tolist()
    image = Image.new("1", (columns, rows))
    draw = ImageDraw.Draw(image)
    for corners in shapes.tolist():
        draw.polygon(corners, fill=1, outline=1)
    return np.asarray(image, np.bool_), corner, step


def _apart(centres: npt.NDArray[np.float64], distance: float) -> npt.NDArray[np.float64]:
    """Move square labels that would cover others to the nearest free place, on rings about them."""
    places: list[npt.NDArray[np.float64]] = []
    angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    for centre in centres:
        held = np.array(places).reshape(-1, 2)
        free = [centre]
        for radius in range(1, len(places) + 2):
            gaps = [np.abs(held - place).max(axis=1).min(initial=np.inf) for place in free]
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
