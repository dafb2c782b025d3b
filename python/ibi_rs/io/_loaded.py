"""Meshes by trimesh, and what it does not read: text of other encodings, binary PLY of mixed polygons."""

from __future__ import annotations

import io
import logging
import re
from pathlib import Path
from typing import Any

import numpy as np

from . import _ply, _whole
from ._polygons import Faces, checked, fans
from ._reading import Floats, check_count, extra


def opened(path: Path, ply: _ply.Ply | None, **options: Any) -> Any:
    """Load without merging; for text of another encoding than UTF-8 trimesh wants a library more."""
    trimesh = extra("trimesh")
    # What it takes for worth a line is an error of ours, or nothing; without a handler Python prints it.
    logging.getLogger("trimesh").addHandler(logging.NullHandler())
    suffix = path.suffix.lower()
    if ply is not None and (outlines := mixed(ply)) is not None:
        points, polygons = outlines
        made = trimesh.Trimesh(points, fans(polygons), process=False)
        made.metadata["_ply_raw"] = {"vertex": {"data": ply.rows["vertex"]}}
        return made
    if suffix in (".obj", ".off") or (suffix == ".stl" and _whole.is_stl_text(path)):
        data = path.read_bytes()
        try:
            data.decode("utf-8")
        except UnicodeDecodeError:
            source = io.BytesIO(data.decode("latin-1").encode("utf-8"))
            loaded = trimesh.load(source, file_type=suffix[1:], process=False, **options)
        else:
            loaded = trimesh.load(path, process=False, **options)
        if suffix == ".stl":
            facets = len(re.findall(_whole.STL_BEGIN, data))
            parts = loaded.geometry.values() if hasattr(loaded, "geometry") else [loaded]
            check_count(facets, sum(len(getattr(part, "faces", ())) for part in parts), "triangles")
        return loaded
    return trimesh.load(path, process=False, **options)


def mixed(held: _ply.Ply) -> tuple[Floats, list[Faces]] | None:
    """Vertices and polygons of a binary PLY that trimesh does not read."""
    rows = held.rows.get("vertex")
    if held.polygons is None or rows is None or not set("xyz") <= set(rows.dtype.names or ()):
        return None
    return checked(np.column_stack([rows[axis] for axis in "xyz"]).astype(np.float64), held.polygons)


def names(raw: Any) -> Any:
    """Properties of a PLY's vertices: a dict of columns if it is text, a structured array if it is binary."""
    return raw if isinstance(raw, dict) else getattr(getattr(raw, "dtype", None), "names", None) or ()
