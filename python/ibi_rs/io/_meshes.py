"""Meshes, through trimesh; what it passes over in silence is looked for before and after."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ibi_rs import features
from ibi_rs._core import InputError

from ._files import Floats, Rows, check_count, check_most, extra

SUFFIXES = (".stl", ".ply", ".obj", ".off", ".glb", ".gltf")

LONG_EDGES = 4.0
"""A triangle with an edge so many times longer than they are in the median is none of a scanner's."""
MAX_LONG_SHARE = 0.1
"""Share of the surface that such triangles may hold in a scan whose vertices are taken."""
MIN_SCANNED = 1000
MIN_SAMPLES = 100_000
"""Vertices, and points drawn where there are not enough of them."""

Faces = npt.NDArray[np.int64]


def check_suffix(path: Path) -> None:
    """Refuse what is no mesh by its name."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: meshes are read from {', '.join(SUFFIXES)}, not from '{path.suffix}'")


def mesh(path: Path) -> tuple[Floats, Faces]:
    """Vertices and triangles; vertices at one place are one."""
    trimesh = extra("trimesh")
    _check_file(path)
    cut = _concave(path)
    if cut is not None:
        loaded = trimesh.Trimesh(*cut, process=False)
    else:
        loaded = trimesh.load(path, force="mesh", process=False)
        _check_loaded(path, loaded)
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
    loaded = _loaded(path)
    if hasattr(loaded, "geometry"):
        parts = [np.asarray(part.vertices) for part in loaded.dump()]
        return Rows(np.concatenate(parts) if parts else np.empty((0, 3)))
    points = np.asarray(loaded.vertices)
    raw = loaded.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    names = ("nx", "ny", "nz")
    if raw is not None and all(name in _names(raw) for name in names):
        normals = [np.ravel(raw[name]) for name in names]
        if len(normals[0]) == len(points):
            return Rows(points, np.column_stack(normals))
    return Rows(points)


def surface(path: Path) -> Rows:
    """Vertices where they are as dense everywhere, else points drawn on the faces."""
    rows = vertices(path)
    loaded = _loaded(path)
    faces = np.asarray(getattr(loaded, "faces", ()))
    if hasattr(loaded, "geometry") or (len(faces) and not _is_scanned(rows.points, faces)):
        corners, faces = mesh(path)
        points, _ = features.sample_mesh(corners, faces, n=max(len(corners), MIN_SAMPLES))
        return Rows(points)
    return rows


def _is_scanned(points: npt.NDArray[Any], faces: npt.NDArray[Any]) -> bool:
    corners = points[faces]
    edges = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2).max(axis=1)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    is_long = edges > LONG_EDGES * np.median(edges)
    return len(points) >= MIN_SCANNED and area[is_long].sum() <= MAX_LONG_SHARE * area.sum()


def _loaded(path: Path) -> Any:
    trimesh = extra("trimesh")
    _check_file(path)
    loaded = trimesh.load(path, process=False)
    _check_loaded(path, loaded)
    return loaded


def _names(raw: Any) -> Any:
    """Properties of a PLY's vertices: a dict of columns if it is text, a structured array if it is binary."""
    return raw if isinstance(raw, dict) else getattr(getattr(raw, "dtype", None), "names", None) or ()


# Files that are cut ---------------------------------------------------------------------------------------


def _check_file(path: Path) -> None:
    """Refuse a file that is shorter than it says."""
    if path.suffix.lower() == ".stl":
        _check_stl(path)
    elif path.suffix.lower() == ".off":
        _check_off(path)


def _check_stl(path: Path) -> None:
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(84)
        is_text = head.lstrip()[:5].lower() == b"solid"
        said = struct.unpack_from("<I", head, 80)[0] if len(head) == 84 else 0
        if size == 84 + 50 * said:
            return
        if not is_text:
            if len(head) < 84:
                raise InputError("is no STL file")
            check_most(said)
            check_count(said, (size - 84) // 50, "triangles")
            return
        text = head + file.read()
    opened, closed = (
        len(re.findall(word, text, re.IGNORECASE)) for word in (rb"\bfacet\b", rb"\bendfacet\b")
    )
    if opened != closed or not re.search(rb"endsolid[^\n]*\s*$", text, re.IGNORECASE):
        raise InputError(f"{opened} facets begin, and {closed} end; the file is cut")


def _check_off(path: Path) -> None:
    lines = _off_lines(path)
    counts = _off_counts(lines)
    check_count(counts[0], min(len(lines) - 1, counts[0]), "vertices")
    check_count(counts[1], len(lines) - 1 - counts[0], "faces")


def _off_lines(path: Path) -> list[list[str]]:
    """Split each line from that of the counts on."""
    text = path.read_text(encoding="utf-8", errors="replace")
    words = [line.split("#")[0].split() for line in text.splitlines()]
    words = [line for line in words if line]
    if words and words[0][0].upper().endswith("OFF"):
        words[0] = words[0][1:]
        words = words if words[0] else words[1:]
    return words


def _off_counts(lines: list[list[str]]) -> tuple[int, int]:
    try:
        return int(lines[0][0]), int(lines[0][1])
    except (IndexError, ValueError):
        raise InputError("is no OFF file: its first line does not count vertices and faces") from None


def _check_loaded(path: Path, loaded: Any) -> None:
    """Refuse a PLY that is cut: trimesh reads as much as there is."""
    if path.suffix.lower() != ".ply":
        return
    raw = loaded.metadata.get("_ply_raw", {})
    said = int(raw.get("vertex", {}).get("length", 0))
    check_count(said, len(loaded.vertices), "vertices")
    said, faces = int(raw.get("face", {}).get("length", 0)), len(getattr(loaded, "faces", ()))
    # A polygon makes at least one triangle.
    check_count(said, faces, "faces")


# Polygons -------------------------------------------------------------------------------------------------


def _concave(path: Path) -> tuple[Floats, Faces] | None:
    """Cut polygons along their outlines if one of them is concave: trimesh cuts all as fans."""
    suffix = path.suffix.lower()
    found = {".off": _off_polygons, ".obj": _obj_polygons, ".ply": _ply_polygons}.get(suffix)
    held = found(path) if found else None
    if held is None:
        return None
    points, polygons = held
    polygons = [polygon for polygon in polygons if len(polygon) >= 3]
    if not any(_is_concave(points[polygon]) for polygon in polygons if len(polygon) > 3):
        return None
    return points, np.concatenate([_triangles(points, polygon) for polygon in polygons])


def _off_polygons(path: Path) -> tuple[Floats, list[Faces]] | None:
    lines = _off_lines(path)
    num_points, num_faces = _off_counts(lines)
    rows = lines[1 + num_points : 1 + num_points + num_faces]
    if all(row[0] == "3" for row in rows):
        return None
    points = np.array([row[:3] for row in lines[1 : 1 + num_points]], dtype=np.float64)
    return _checked(points, (row[1 : 1 + int(row[0])] for row in rows))


def _obj_polygons(path: Path) -> tuple[Floats, list[Faces]] | None:
    points, faces = [], []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            points.append(words[1:4])
        elif words[:1] == ["f"]:
            rows = [int(word.split("/")[0]) for word in words[1:]]
            faces.append([row - 1 if row > 0 else len(points) + row for row in rows])
    if all(len(face) == 3 for face in faces):
        return None
    return _checked(np.array(points, dtype=np.float64), faces)


def _ply_polygons(path: Path) -> tuple[Floats, list[Faces]] | None:
    loaded = extra("trimesh").load(path, process=False)
    data = loaded.metadata.get("_ply_raw", {}).get("face", {}).get("data")
    lists = [data[name] for name in _names(data) if name in ("vertex_indices", "vertex_index")]
    if not lists:
        return None
    rows = lists[0]["f1"] if getattr(getattr(lists[0], "dtype", None), "names", None) else lists[0]
    rows = [np.ravel(row) for row in rows]
    if all(len(row) == 3 for row in rows):
        return None
    return _checked(np.asarray(loaded.vertices, dtype=np.float64), rows)


def _checked(points: Floats, polygons: Iterable[Any]) -> tuple[Floats, list[Faces]]:
    faces = [np.asarray(polygon, dtype=np.int64) for polygon in polygons]
    for number, face in enumerate(faces):
        if len(face) and not 0 <= face.min() <= face.max() < len(points):
            raise InputError(f"face {number} names a vertex that is not there; there are {len(points)}")
    return points, faces


def _normal(corners: Floats) -> Floats:
    """Of a polygon (Newell's method), as long as twice its area."""
    return np.asarray(np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0))


def _is_concave(corners: Floats) -> bool:
    around = np.roll(corners, -1, axis=0) - corners
    turns = np.cross(around, np.roll(around, -1, axis=0)) @ _normal(corners)
    return bool((turns < -1e-9 * np.abs(turns).max(initial=0)).any())


def _triangles(points: Floats, polygon: Faces) -> Faces:
    """Cut a polygon, seen from where its normal points: its triangles run as it does."""
    if len(polygon) == 3:
        return polygon[None]
    corners = points[polygon] - points[polygon[0]]
    normal = _normal(corners)
    kept = np.delete(np.arange(3), np.argmax(np.abs(normal)))
    flat = np.ascontiguousarray(corners[:, kept])
    ends = np.array([len(polygon)], dtype=np.uint32)
    rows = extra("mapbox_earcut").triangulate_float64(flat, ends).reshape(-1, 3).astype(np.int64)
    sides = corners[rows]
    runs_back = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]) @ normal < 0
    rows[runs_back] = rows[runs_back][:, ::-1]
    return np.asarray(polygon[rows])
