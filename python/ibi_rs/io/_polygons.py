"""Polygons, as rows of vertices: which are concave, and the triangles they are cut into."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from ibi_rs._core import InputError

from ._reading import Floats, extra

Faces = npt.NDArray[np.int64]


def checked(points: Floats, polygons: Iterable[Any]) -> tuple[Floats, list[Faces]]:
    """Leave out what has no three corners; refuse what names no vertex."""
    faces = [np.asarray(polygon, dtype=np.int64) for polygon in polygons]
    for number, face in enumerate(faces):
        if len(face) and not 0 <= face.min() <= face.max() < len(points):
            raise InputError(f"face {number} names a vertex that is not there; there are {len(points)}")
    return points, [face for face in faces if len(face) >= 3]


def fans(polygons: list[Faces]) -> Faces:
    """Cut convex polygons, as trimesh does it."""
    return _joined([_fan(alike) for alike in _by_length(polygons)])


def along_outlines(points: Floats, polygons: list[Faces]) -> Faces | None:
    """Cut polygons of which at least one is concave; None if none is."""
    cut, num_concave = [], 0
    for alike in _by_length(polygons):
        concave = _are_concave(points[alike])
        num_concave += int(concave.sum())
        cut.append(_fan(alike[~concave]))
        cut += [_ears(points, polygon) for polygon in alike[concave]]
    return _joined(cut) if num_concave else None


def _by_length(polygons: list[Faces]) -> list[Faces]:
    lengths = np.array([len(polygon) for polygon in polygons])
    return [
        np.stack([polygons[row] for row in np.nonzero(lengths == length)[0]]) for length in np.unique(lengths)
    ]


def _joined(faces: list[Faces]) -> Faces:
    return np.concatenate([np.empty((0, 3), np.int64), *faces])


def _fan(alike: Faces) -> Faces:
    """(M, K) polygons as triangles around their first corners."""
    number, length = alike.shape
    fan = np.empty((number, length - 2, 3), np.int64)
    fan[..., 0], fan[..., 1], fan[..., 2] = alike[:, :1], alike[:, 1:-1], alike[:, 2:]
    return fan.reshape(-1, 3)


def _normals(corners: Floats) -> Floats:
    """Of (M, K, 3) polygons (Newell's method), as long as twice their area."""
    near = corners - corners[:, :1]
    return np.asarray(np.cross(near, np.roll(near, -1, axis=1)).sum(axis=1))


def _are_concave(corners: Floats) -> npt.NDArray[np.bool_]:
    around = np.roll(corners, -1, axis=1) - corners
    turns = np.einsum("mkx,mx->mk", np.cross(around, np.roll(around, -1, axis=1)), _normals(corners))
    return np.asarray((turns < -1e-9 * np.abs(turns).max(axis=1, keepdims=True)).any(axis=1))


def _ears(points: Floats, polygon: Faces) -> Faces:
    """Cut one, seen from where its normal points: its triangles run as it does."""
    corners = points[polygon] - points[polygon[0]]
    (normal,) = _normals(corners[None])
    kept = np.delete(np.arange(3), np.argmax(np.abs(normal)))
    flat = np.ascontiguousarray(corners[:, kept])
    ends = np.array([len(polygon)], dtype=np.uint32)
    rows = extra("mapbox_earcut").triangulate_float64(flat, ends).reshape(-1, 3).astype(np.int64)
    sides = corners[rows]
    runs_back = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]) @ normal < 0
    rows[runs_back] = rows[runs_back][:, ::-1]
    return np.asarray(polygon[rows])
