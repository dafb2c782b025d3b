"""Figures that need no window."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


def panels(
    size: tuple[float, float], columns: int, rows: int = 1, *, sharey: bool = False, count: int | None = None
) -> tuple[Figure, list[Any]]:
    """Make a figure and its axes, row by row; a count leaves the last cells of the grid empty."""
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    axes: list[Any] = []
    for i in range(rows * columns if count is None else count):
        axes.append(figure.add_subplot(rows, columns, i + 1, sharey=axes[0] if sharey and axes else None))
        if sharey and i % columns:
            axes[i].tick_params(labelleft=False)
    return figure, axes


def save(figure: Figure, path: Path, dpi: int) -> None:
    """Write a picture."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=dpi)
