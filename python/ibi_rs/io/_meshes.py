"""Meshes: the files are looked at before trimesh reads them, as it passes over much in silence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ibi_rs import features
from ibi_rs._core import InputError

from . import _ply
from ._loaded import mixed, names, opened
from ._polygons import Faces, along_outlines, checked
from ._reading import Floats, Rows, extra
from ._whole import check_file, obj_lines, off_counts, off_lines

NORMALS = ("nx", "ny", "nz")
SUFFIXES = (".stl", ".ply", ".obj", ".off", ".glb", ".gltf")

LONG_EDGES = 4.0
"""A triangle with an edge so many times longer than they are in the median is none of a scanner's."""
MAX_LONG_SHARE = 0.1
"""Share of the surface that such triangles may hold in a scan whose vertices are taken."""
MIN_SCANNED = 1000
MIN_SAMPLES = 100_000
"""Vertices, and points drawn where there are not enough of them."""


def check_suffix(path: Path) -> None:
    """Refuse what is no mesh by its name."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: meshes are read from {', '.join(SUFFIXES)}, not from '{path.suffix}'")


def mesh(path: Path) -> tuple[Floats, Faces]:
    """Vertices and triangles; vertices at one place are one."""
    trimesh = extra("trimesh")
    ply = check_file(path)
    cut = _cut(path, ply)
    loaded = opened(path, ply, force="mesh") if cut is None else trimesh.Trimesh(*cut, process=False)
    faces = np.asarray(getattr(loaded, "faces", ()))
    if len(faces) == 0:
        raise InputError("no faces; a point cloud is no mesh")
    finite = np.isfinite(loaded.vertices).all(axis=1)
    num_odd = int((~finite[faces].all(axis=1)).sum())
    if num_odd:
        raise InputError(f"{num_odd} of {len(faces)} triangles have a corner that is not finite")
    loaded.process()
    return np.asarray(loaded.vertices, dtype=np.float64), np.asarray(loaded.faces, dtype=np.int64)


def vertices(path: Path) -> Rows:
    """Vertices in the order of the file: merged ones would be fewer."""
    extra("trimesh")
    ply = check_file(path)
    return _vertices(opened(path, ply), ply)


def _vertices(loaded: Any, ply: _ply.Ply | None) -> Rows:
    if hasattr(loaded, "geometry"):
        parts = [np.asarray(part.vertices) for part in loaded.dump()]
        return Rows(np.concatenate(parts) if parts else np.empty((0, 3)))
    points = np.asarray(loaded.vertices)
    eye = None if ply is None else ply.viewpoint
    raw = loaded.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    if raw is not None and set(NORMALS) <= set(names(raw)):
        normals = [np.ravel(raw[name]) for name in NORMALS]
        if len(normals[0]) == len(points):
            return Rows(points, np.column_stack(normals), eye)
    return Rows(points, None, eye)


def surface(path: Path) -> Rows:
    """Vertices where they are as dense everywhere, else points drawn on the faces."""
    extra("trimesh")
    ply = check_file(path)
    loaded = opened(path, ply)
    rows = _vertices(loaded, ply)
    if hasattr(loaded, "geometry"):  # a scene of several, perhaps with clouds
        if not any(len(getattr(part, "faces", ())) for part in loaded.geometry.values()):
            return rows
    elif len(getattr(loaded, "faces", ())) == 0 or _is_scanned(rows.points, loaded.faces):
        return rows
    corners, faces = mesh(path)
    if _is_scanned(corners, faces):
        return rows
    points, _ = features.sample_mesh(corners, faces, n=max(len(corners), MIN_SAMPLES))
    return Rows(points, None, rows.viewpoint)


def _is_scanned(points: npt.NDArray[Any], faces: npt.NDArray[Any]) -> bool:
    corners = points[faces]
    edges = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2).max(axis=1)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    is_long = edges > LONG_EDGES * np.median(edges)
    return len(points) >= MIN_SCANNED and area[is_long].sum() <= MAX_LONG_SHARE * area.sum()


# Polygons ---------------------------------------------------------------------------------------------------


def _cut(path: Path, ply: _ply.Ply | None) -> tuple[Floats, Faces] | None:
    """Cut polygons along their outlines if one of them is concave: trimesh cuts all as fans."""
    if ply is not None:
        held = mixed(ply) or _ply_polygons(path, ply)
    else:
        found = {".off": _off_polygons, ".obj": _obj_polygons}.get(path.suffix.lower())
        held = found(path) if found else None
    if held is None:
        return None
    faces = along_outlines(*held)
    return None if faces is None else (held[0], faces)


def _off_polygons(path: Path) -> tuple[Floats, list[Faces]] | None:
    lines = off_lines(path)
    num_points, num_faces = off_counts(lines)
    rows = lines[1 + num_points : 1 + num_points + num_faces]
    if all(row[0] == "3" for row in rows):
        return None
    points = np.array([row[:3] for row in lines[1 : 1 + num_points]], dtype=np.float64)
    return checked(points, (row[1 : 1 + int(row[0])] for row in rows))


def _obj_polygons(path: Path) -> tuple[Floats, list[Faces]] | None:
    points: list[list[str]] = []
    held: list[tuple[int, list[str]]] = []
    for _, words in obj_lines(path):
        if words[0] == "v":
            points.append(words[1:4])
        else:
            held.append((len(points), words[1:]))
    if all(len(words) == 3 for _, words in held):
        return None
    faces = []
    for num_points, words in held:
        rows = [int(word.split("/")[0]) for word in words]
        faces.append([row - 1 if row > 0 else num_points + row for row in rows])
    return checked(np.array(points, dtype=np.float64), faces)


def _ply_polygons(path: Path, ply: _ply.Ply) -> tuple[Floats, list[Faces]] | None:
    if ply.has_triangles_only:
        return None
    loaded = opened(path, ply)
    data = loaded.metadata.get("_ply_raw", {}).get("face", {}).get("data")
    lists = [data[name] for name in names(data) if name in ("vertex_indices", "vertex_index")]
    if not lists:
        return None
    rows = lists[0]["f1"] if getattr(getattr(lists[0], "dtype", None), "names", None) else lists[0]
    if getattr(rows, "ndim", 1) == 2 and rows.shape[1] == 3:
        return None
    rows = [np.ravel(row) for row in rows]
    if all(len(row) == 3 for row in rows):
        return None
    return checked(np.asarray(loaded.vertices, dtype=np.float64), rows)
