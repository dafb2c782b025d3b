"""Pictures of searches: the scan, and over it what was found, missed and invented."""

from __future__ import annotations

from pathlib import Path

import ibi_rs as ibi
import numpy as np
from frame import plots
from numpy.typing import NDArray
from verdict_metrics import HIDDEN, RIGHT, UNKNOWN, WRONG, Judgement
from verdict_searches import Search

COLORS = {RIGHT: "#1a9641", HIDDEN: "#91cf60", WRONG: "#d7191c", UNKNOWN: "#fdae61"}
MISSED = "#404040"
MAX_POINTS = 120_000


def draw(
    search: Search, model: ibi.Model, found: ibi.Registration, judgement: Judgement, folder: Path
) -> None:
    """Draw a scan as its camera sees it, rooms from above, with each pose by what it is.

    Green: right; light green: right, of one that is hardly visible; red: wrong; grey: missed.
    """
    place = _from_above if len(search.scan.eyes) > 1 else _from_eye
    figure, axes = plots.panels((13, 6.2), 2)
    points = search.scan.points[:: 1 + len(search.scan.points) // MAX_POINTS]
    flat, depth = place(points)
    low, high = np.percentile(depth, [3, 97])
    for axis in axes:
        axis.scatter(*flat.T, c=depth, cmap="gray_r", s=0.25, linewidths=0, vmin=2 * low - high, vmax=high)
        axis.set_aspect("equal")
        axis.axis("off")
    for pose in search.poses[judgement.is_missed]:
        _outline(axes[1], place, model, pose, MISSED)
    # The best last, so that it lies on top.
    for pose, state in reversed(list(zip(found, judgement.states, strict=True))):
        _outline(axes[1], place, model, pose.target_from_source, COLORS[state], f"{pose.score:.2f}")
    axes[1].set(xlim=axes[0].get_xlim(), ylim=axes[0].get_ylim())
    counts = f"{judgement.count(RIGHT)} of {judgement.is_asked_for.sum()} found"
    title = f"{search.regime}, {search.what}: {search.part} x {search.scale:g} in {search.scan.name}"
    figure.suptitle(f"{title}: {counts}, {judgement.count(WRONG)} wrong", fontsize=9)
    name = f"{search.regime}_{search.scan.name}_{search.part}_{search.scale:g}".replace(", ", "-")
    plots.save(figure, folder / f"{name}.png", 75)


def _outline(
    axis: object, place: object, model: ibi.Model, pose: NDArray[np.float64], color: str, text: str = ""
) -> None:
    moved = model.points @ pose[:3, :3].T + pose[:3, 3]
    flat, _ = place(moved)  # type: ignore[operator]
    axis.scatter(*flat.T, c=color, s=1.2, linewidths=0, alpha=0.6)  # type: ignore[attr-defined]
    if text:
        axis.text(*flat.mean(axis=0), text, fontsize=6, ha="center")  # type: ignore[attr-defined]


def _from_eye(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """As a camera at the origin sees it."""
    return points[:, :2] / points[:, 2:] * [1, -1], points[:, 2]


def _from_above(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Obliquely from above, without what is above the furniture."""
    low = points[points[:, 2] < 1.9]
    tilt = np.radians(40)
    return np.column_stack([low[:, 0], low[:, 1] * np.sin(tilt) + low[:, 2] * np.cos(tilt)]), -low[:, 2]
