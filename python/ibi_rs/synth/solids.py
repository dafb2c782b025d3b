"""Closed meshes of parts and furniture, built of prisms.

A mesh is joined of closed pieces that run into one another; their outer surface is that of the part.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from .scene import Array

__all__ = ["FURNITURE", "PARTS", "Mesh", "furniture_mesh", "part_mesh"]

Mesh: TypeAlias = tuple[Array, NDArray[np.int64]]
"""(V, 3) vertices and (F, 3) triangles, counter-clockwise as seen from outside."""


# Pieces: an outline in the two axes after `axis`, in order, drawn out along `axis` -------------------------


def prism(
    outline: npt.ArrayLike, low: float, high: float, axis: int = 2, top: npt.ArrayLike | None = None
) -> Mesh:
    """Draw out a convex outline, counter-clockwise; towards another outline of as many corners if given."""
    below = np.asarray(outline, dtype=np.float64)
    above = below if top is None else np.asarray(top, dtype=np.float64)
    n = len(below)
    i, j = np.arange(n), np.roll(np.arange(n), -1)
    fan = np.stack([np.zeros(n - 2, dtype=np.int64), np.arange(1, n - 1), np.arange(2, n)], axis=1)
    faces = np.concatenate(
        [np.stack([i, j, n + j], axis=1), np.stack([i, n + j, n + i], axis=1), fan[:, ::-1], n + fan]
    )
    return _lifted([(below, low), (above, high)], axis), faces


def ring(outer: npt.ArrayLike, inner: npt.ArrayLike, low: float, high: float, axis: int = 2) -> Mesh:
    """Draw out what lies between two outlines of as many corners, each seen from the middle in order."""
    out, hole = np.asarray(outer, dtype=np.float64), np.asarray(inner, dtype=np.float64)
    n = len(out)
    i, j = np.arange(n), np.roll(np.arange(n), -1)

    def band(a: int, b: int) -> NDArray[np.int64]:
        return np.concatenate(
            [np.stack([a + i, a + j, b + j], axis=1), np.stack([a + i, b + j, b + i], axis=1)]
        )

    # Loops: 0 outer low, 1 outer high, 2 inner high, 3 inner low; each band faces outwards.
    faces = np.concatenate([band(0, n), band(n, 2 * n), band(2 * n, 3 * n), band(3 * n, 0)])
    return _lifted([(out, low), (out, high), (hole, high), (hole, low)], axis), faces


def sheet(path: npt.ArrayLike, thickness: float, low: float, high: float, axis: int = 2) -> Mesh:
    """Draw out a bent strip of even thickness, along a path that turns by less than 150 degrees."""
    corners = np.asarray(path, dtype=np.float64)
    along = np.diff(corners, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    before, after = normal[[0, *range(len(normal))]], normal[[*range(len(normal)), -1]]
    mitre = (before + after) / (1 + np.sum(before * after, axis=1, keepdims=True))
    left, right = corners + thickness / 2 * mitre, corners - thickness / 2 * mitre
    pieces = [
        prism([right[k], right[k + 1], left[k + 1], left[k]], low, high, axis) for k in range(len(along))
    ]
    return joined(*pieces)


def box(low: npt.ArrayLike, high: npt.ArrayLike) -> Mesh:
    """Return the box between two corners."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    return prism([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], z0, z1)


def circle(
    radius: float | Array, center: tuple[float, float] = (0, 0), sides: int = 32, turn: float = 0.0
) -> Array:
    """Return corners on a circle; a radius for each gives other outlines."""
    angle = turn + 2 * np.pi * np.arange(sides) / sides
    corners: Array = np.stack([np.cos(angle), np.sin(angle)], axis=1) * np.reshape(
        radius, (-1, 1)
    ) + np.asarray(center)
    return corners


def rod(
    radius: float,
    low: float,
    high: float,
    axis: int = 2,
    center: tuple[float, float] = (0, 0),
    sides: int = 24,
    tip: float | None = None,
) -> Mesh:
    """Return a cylinder, or a cone cut off at the radius `tip`."""
    top = None if tip is None else circle(tip, center, sides)
    return prism(circle(radius, center, sides), low, high, axis, top)


def joined(*pieces: Mesh) -> Mesh:
    """Put pieces into one mesh."""
    starts = np.cumsum([0, *(len(points) for points, _ in pieces[:-1])])
    faces = [triangles + start for (_, triangles), start in zip(pieces, starts, strict=True)]
    return np.concatenate([points for points, _ in pieces]), np.concatenate(faces)


def mirrored(mesh: Mesh) -> Mesh:
    """Return the mirror image, y for -y."""
    points, triangles = mesh
    return points * [1.0, -1.0, 1.0], triangles[:, ::-1].copy()


def _lifted(loops: list[tuple[Array, float]], axis: int) -> Array:
    points = [np.column_stack([loop, np.full(len(loop), height)]) for loop, height in loops]
    lifted: Array = np.roll(np.concatenate(points), axis - 2, axis=1)
    return lifted


def _square(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float]]:
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


# Parts, millimetres ---------------------------------------------------------------------------------------


def _bracket_a(wall: float = 40, lug: float = 44) -> Mesh:
    return joined(
        box((0, 0, 0), (60, 40, 4)),
        box((0, 0, 0), (4, 40, wall)),
        box((0, 0, 0), (30, 4, 20)),
        box((lug, 12, 0), (lug + 8, 24, 9)),
    )


def _bracket_b(leg: float = 52, hook: float = 46) -> Mesh:
    return joined(
        ring(_square(0, 0, 80, 34), _square(28, 8, 62, 26), 0, 5),
        box((0, 0, 0), (5, 22, leg)),
        box((0, 0, hook), (19, 10, hook + 6)),
        prism([(4, 4), (30, 4), (4, 24)], 14, 19, axis=1),
    )


def _flange_a(hub: float = 30, tab: bool = True) -> Mesh:
    pieces = [ring(circle(30, sides=48), circle(8, sides=48), 0, 8)]
    pieces.append(ring(circle(14, sides=48), circle(8, sides=48), 0, hub))
    if tab:
        pieces.append(box((20, -6, 4), (29, 6, 12)))
    return joined(*pieces)


def _flange_b(port: float = 34, height: float = 26) -> Mesh:
    angle = 2 * np.pi * np.arange(64) / 64
    oval = 18 + 20 * np.abs(np.cos(angle)) ** 3
    return joined(
        ring(circle(oval, sides=64), circle(11, sides=64), 0, 6),
        ring(circle(16, sides=64), circle(11, sides=64), 0, height),
        rod(7, 12, port, axis=1, center=(height - 8, 0)),
        rod(4, 5, 9, center=(-28, 0)),
    )


def _bolt_a(shank: float = 40) -> Mesh:
    return joined(prism(circle(9, sides=6), 0, 7), rod(5, -shank, 1))


def _bolt_b(shank: float = 34) -> Mesh:
    return joined(
        rod(11, 2, 8, tip=6),
        rod(13, 0, 2, sides=32),
        box((-5, -5, -7), (5, 5, 1)),
        rod(4.2, -shank, -6),
        rod(2.8, -shank - 9, -shank + 1),
    )


def _clip_a(lip: float = 16) -> Mesh:
    return joined(
        box((0, 0, 0), (50, 20, 2)),
        box((0, 0, 0), (2, 20, 18)),
        box((0, 0, 16), (lip, 20, 18)),
        box((48, 0, -10), (50, 20, 2)),
    )


def _clip_b(rise: float = 16) -> Mesh:
    arch = [(0, -28), (0, -11), (rise, -7), (rise, 7), (0, 12), (0, 24)]
    return joined(
        sheet(arch, 1.8, 0, 14, axis=1),
        box((22.2, 0, -0.9), (24, 7, 11)),
        box((-28, 9, -0.9), (-22, 14, 6)),
    )


def _pin_a(collar: float = 18) -> Mesh:
    return joined(rod(5, 0, 58), rod(9, collar, collar + 6), rod(5, 58, 62, tip=3))


def _pin_b(bar: float = 20) -> Mesh:
    return joined(
        rod(8, 0, 4),
        rod(4.5, 3, 40),
        rod(3, 39, 45),
        rod(4.5, 44, 52),
        rod(4.5, 52, 57, tip=2),
        rod(2.2, -13, 13, axis=0, center=(0, bar)),
    )


_PARTS: dict[str, Callable[[], Mesh]] = {
    "bracket-a": _bracket_a,
    "flange-a": _flange_a,
    "bolt-a": _bolt_a,
    "clip-a": _clip_a,
    "pin-a": _pin_a,
    "bracket-b": _bracket_b,
    "flange-b": _flange_b,
    "bolt-b": _bolt_b,
    "clip-b": _clip_b,
    "pin-b": _pin_b,
    "plate-a": lambda: box((0, 0, 0), (60, 40, 4)),
    "cube-a": lambda: box((0, 0, 0), (30, 30, 30)),
    "rod-a": lambda: rod(6, 0, 70),
    "plate-b": lambda: box((0, 0, 0), (72, 30, 6)),
    "cube-b": lambda: box((0, 0, 0), (24, 24, 24)),
    "rod-b": lambda: rod(8, 0, 48, sides=32),
    "carton-a": lambda: box((0, 0, 0), (60, 40, 30)),
    "carton-b": lambda: box((0, 0, 0), (76, 45, 24)),
    "bracket-a-mirror": lambda: mirrored(_bracket_a()),
    "bracket-b-mirror": lambda: mirrored(_bracket_b()),
    "bracket-a-near": lambda: _bracket_a(wall=50, lug=34),
    "flange-a-near": lambda: _flange_a(hub=18, tab=False),
    "bolt-a-near": lambda: _bolt_a(shank=52),
    "clip-a-near": lambda: _clip_a(lip=30),
    "pin-a-near": lambda: _pin_a(collar=34),
    "bracket-b-near": lambda: _bracket_b(leg=38, hook=32),
    "flange-b-near": lambda: _flange_b(port=22, height=38),
    "bolt-b-near": lambda: _bolt_b(shank=22),
    "clip-b-near": lambda: _clip_b(rise=25),
    "pin-b-near": lambda: _pin_b(bar=33),
}


# Furniture, metres: z up, the floor is z = 0 --------------------------------------------------------------


def _legs(width: float, depth: float, height: float, thick: float) -> list[Mesh]:
    x, y = width / 2 - thick, depth / 2 - thick
    return [
        box((cx - thick / 2, cy - thick / 2, 0), (cx + thick / 2, cy + thick / 2, height))
        for cx in (-x, x)
        for cy in (-y, y)
    ]


def _chair_a() -> Mesh:
    return joined(
        *_legs(0.46, 0.46, 0.44, 0.05),
        box((-0.23, -0.23, 0.42), (0.23, 0.23, 0.47)),
        box((-0.23, -0.23, 0.45), (-0.18, 0.23, 0.95)),
        box((-0.18, 0.18, 0.64), (0.2, 0.23, 0.68)),
        box((0.15, 0.18, 0.45), (0.2, 0.23, 0.66)),
    )


def _chair_b() -> Mesh:
    spoke = prism([(0, -0.03), (0.3, -0.025), (0.3, 0.025), (0, 0.03)], 0.0, 0.08)
    spokes = [_turned(spoke, 72 * k) for k in range(5)]
    back = sheet([(0.2, -0.22), (0.27, -0.1), (0.27, 0.1), (0.2, 0.22)], 0.05, 0.56, 1.02)
    return joined(
        *spokes,
        rod(0.04, 0.02, 0.44),
        prism(circle(0.25, sides=20), 0.42, 0.5),
        back,
        box((0.2, -0.04, 0.44), (0.26, 0.04, 0.6)),
        box((-0.14, 0.22, 0.62), (0.16, 0.29, 0.66)),
        box((0.0, 0.23, 0.44), (0.05, 0.27, 0.63)),
    )


def _table_a() -> Mesh:
    return joined(
        *_legs(1.2, 0.7, 0.72, 0.07),
        box((-0.6, -0.35, 0.7), (0.6, 0.35, 0.75)),
        box((-0.5, -0.3, 0.6), (-0.1, 0.3, 0.72)),
    )


def _table_b() -> Mesh:
    return joined(
        prism(circle(0.5, sides=28), 0.68, 0.73),
        rod(0.07, 0.0, 0.7),
        prism(circle(0.28, sides=20), 0, 0.05),
        box((0.1, -0.18, 0.5), (0.48, 0.18, 0.7)),
    )


def _shelf_a() -> Mesh:
    boards = [box((-0.4, -0.15, z), (0.4, 0.15, z + 0.03)) for z in (0.0, 0.4, 0.8, 1.2, 1.57)]
    return joined(
        *boards,
        box((-0.4, -0.15, 0), (-0.37, 0.15, 1.6)),
        box((0.37, -0.15, 0), (0.4, 0.15, 1.6)),
        box((-0.4, -0.15, 0), (0.4, -0.13, 1.6)),
        box((0.0, -0.15, 0.4), (0.03, 0.15, 1.2)),
    )


def _shelf_b() -> Mesh:
    return joined(
        box((-0.55, -0.2, 0), (0.55, 0.2, 0.06)),
        box((-0.55, -0.2, 0), (-0.5, 0.2, 1.3)),
        box((0.1, -0.2, 0), (0.15, 0.2, 0.9)),
        box((0.5, -0.2, 0), (0.55, 0.2, 0.5)),
        box((-0.55, -0.2, 0.44), (0.55, 0.2, 0.5)),
        box((-0.55, -0.2, 0.86), (0.15, 0.2, 0.92)),
        box((-0.55, -0.2, 1.26), (-0.1, 0.2, 1.32)),
    )


def _sofa_a() -> Mesh:
    return joined(
        box((-0.85, -0.4, 0), (0.85, 0.4, 0.42)),
        box((-0.85, -0.4, 0.3), (0.85, -0.2, 0.85)),
        box((-0.85, -0.4, 0.3), (-0.67, 0.4, 0.6)),
        box((0.67, -0.4, 0.3), (0.85, 0.4, 0.6)),
    )


def _sofa_b() -> Mesh:
    return joined(
        *_legs(1.3, 0.6, 0.2, 0.06),
        box((-0.7, -0.35, 0.15), (0.9, 0.35, 0.4)),
        box((-0.7, -0.35, 0.15), (0.1, -0.22, 0.75)),
        prism(circle(0.12, sides=16), 0.2, 0.8),
        box((0.75, -0.35, 0.3), (0.9, 0.35, 0.55)),
    )


def _cabinet_a() -> Mesh:
    return joined(
        box((-0.35, -0.25, 0.1), (0.35, 0.25, 0.9)),
        *_legs(0.7, 0.5, 0.12, 0.06),
        box((-0.3, 0.25, 0.55), (-0.05, 0.28, 0.6)),
    )


def _cabinet_b() -> Mesh:
    return joined(
        box((-0.3, -0.3, 0), (0.3, 0.3, 0.65)),
        box((-0.3, -0.3, 0.6), (0.0, 0.1, 1.05)),
        rod(0.02, 0.28, 0.34, axis=0, center=(0.15, 0.4)),
    )


def _stool_a() -> Mesh:
    return joined(*_legs(0.36, 0.36, 0.6, 0.04), prism(circle(0.2, sides=20), 0.58, 0.63))


def _stool_b() -> Mesh:
    return joined(
        prism(circle(0.17, sides=6), 0.36, 0.42),
        *[_turned(box((0.1, -0.02, 0), (0.15, 0.02, 0.4)), 120 * k) for k in range(3)],
    )


def _lamp_a() -> Mesh:
    return joined(
        prism(circle(0.18, sides=20), 0, 0.04), rod(0.02, 0, 1.4), rod(0.2, 1.25, 1.55, tip=0.1, sides=20)
    )


def _lamp_b() -> Mesh:
    return joined(
        box((-0.15, -0.15, 0), (0.15, 0.15, 0.05)),
        rod(0.025, 0, 1.2),
        rod(0.02, 0, 0.5, axis=0, center=(0, 1.19)),
        rod(0.1, 1.05, 1.2, center=(0.45, 0), tip=0.04),
    )


def _turned(mesh: Mesh, angle_deg: float) -> Mesh:
    """Turn about the upright axis."""
    angle = np.radians(angle_deg)
    c, s = np.cos(angle), np.sin(angle)
    return mesh[0] @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]), mesh[1]


_FURNITURE: dict[str, Callable[[], Mesh]] = {
    "chair-a": _chair_a,
    "table-a": _table_a,
    "shelf-a": _shelf_a,
    "sofa-a": _sofa_a,
    "cabinet-a": _cabinet_a,
    "stool-a": _stool_a,
    "lamp-a": _lamp_a,
    "chair-b": _chair_b,
    "table-b": _table_b,
    "shelf-b": _shelf_b,
    "sofa-b": _sofa_b,
    "cabinet-b": _cabinet_b,
    "stool-b": _stool_b,
    "lamp-b": _lamp_b,
}

PARTS: tuple[str, ...] = tuple(_PARTS)
"""Names of the parts: two families, a and b, of other shapes; with mirror images and near-copies."""

FURNITURE: tuple[str, ...] = tuple(_FURNITURE)
"""Names of the furniture, in two families, a and b, of other shapes."""


def part_mesh(name: str) -> Mesh:
    """Return the mesh of a small part, of sheet metal or turned and milled.

    Parameters
    ----------
    name : str
        One of `PARTS`. Five kinds, bracket, flange, bolt, clip and pin, in the families a and b, whose
        shapes differ by more than their sizes: whoever tunes on one family can report on the other. To each
        there is a near-copy (``bolt-a-near``), to the brackets a mirror image (``bracket-a-mirror``); the
        rest is plain: plates, cubes, rods, cartons.

    Returns
    -------
    vertices : (V, 3) float64
        Millimetres.
    faces : (F, 3) int64
        Of closed pieces that run into one another, counter-clockwise as seen from outside.

    Raises
    ------
    ValueError
        If the name is unknown.

    Examples
    --------
    >>> from ibi_rs import synth
    >>> vertices, faces = synth.part_mesh("plate-a")
    >>> vertices.max(axis=0).tolist(), len(faces)
    ([60.0, 40.0, 4.0], 12)
    """
    return _named(_PARTS, "part", name)


def furniture_mesh(name: str) -> Mesh:
    """Return the mesh of a piece of furniture.

    Parameters
    ----------
    name : str
        One of `FURNITURE`, in the families a and b as the parts of `part_mesh`.

    Returns
    -------
    vertices : (V, 3) float64
        Metres; z is up, and the piece stands on z = 0.
    faces : (F, 3) int64
        As those of `part_mesh`.

    Raises
    ------
    ValueError
        If the name is unknown.

    Examples
    --------
    >>> from ibi_rs import synth
    >>> float(synth.furniture_mesh("chair-a")[0][:, 2].max())
    0.95
    """
    return _named(_FURNITURE, "piece of furniture", name)


def _named(makers: dict[str, Callable[[], Mesh]], what: str, name: str) -> Mesh:
    if name not in makers:
        raise ValueError(f"unknown {what} {name!r}; there are {', '.join(makers)}")
    return makers[name]()
