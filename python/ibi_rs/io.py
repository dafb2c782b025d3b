"""Meshes, clouds and depth images from files, through well-kept readers: ``pip install 'ibi_rs[io]'``.

Every error names the file. Lengths are those of the file; nothing is scaled but depth images.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ibi_rs import _interrupts
from ibi_rs._core import InputError
from ibi_rs._view import depth_points

__all__ = ["read_cloud", "read_depth", "read_mesh"]

Floats = npt.NDArray[np.float64]
PathLike = str | os.PathLike[str]

_MESHES = (".stl", ".ply", ".obj", ".off", ".glb", ".gltf")
_TEXTS = (".xyz", ".txt", ".csv")


def read_mesh(path: PathLike) -> tuple[Floats, npt.NDArray[np.int64]]:
    """Read the triangles of an STL, PLY, OBJ, OFF or GLB file.

    Parameters
    ----------
    path : path

    Returns
    -------
    vertices : (V, 3) float64
        Vertices at one place are one.
    faces : (F, 3) int64

    Raises
    ------
    InputError
        The file cannot be read, has another suffix, or has no faces (then it may be a cloud).
    ImportError
        trimesh is not installed; the message names the extra.
    """
    loaded = _trimesh(Path(path), force="mesh")
    faces = np.asarray(getattr(loaded, "faces", ()), dtype=np.int64)
    if len(faces) == 0:
        raise InputError(f"{path}: no faces; a point cloud is no mesh")
    return np.asarray(loaded.vertices, dtype=np.float64), faces


def read_cloud(path: PathLike) -> tuple[Floats, Floats | None]:
    """Read a point cloud: PLY, OBJ, STL, OFF, GLB, PCD, LAS, LAZ, XYZ, TXT, CSV, NPY or NPZ.

    Of a mesh the vertices are taken. Points that are not finite, as depth cameras write them where they see
    nothing, are left out.

    Parameters
    ----------
    path : path
        Text files and arrays have x, y, z and perhaps three columns of normals; an NPZ file has ``points``
        (or ``tgt``) and perhaps ``normals``.

    Returns
    -------
    points : (N, 3) float64
    normals : (N, 3) float64 or None

    Raises
    ------
    InputError
        The file cannot be read, has another suffix, or has no points.
    ImportError
        The reader is not installed; the message names the extra.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    readers: dict[str, Callable[[Path], Any]] = {
        **dict.fromkeys(_MESHES, _read_trimesh),
        **dict.fromkeys(_TEXTS, _read_text),
        **dict.fromkeys((".las", ".laz"), _read_las),
        ".pcd": _read_pcd,
        ".npy": lambda path: np.load(path, allow_pickle=False),
        ".npz": _read_npz,
    }
    if suffix not in readers:
        raise InputError(f"{path}: clouds are read from {', '.join(sorted(readers))}, not from '{suffix}'")
    rows = np.asarray(_reading(path, lambda: readers[suffix](path)))
    if rows.ndim != 2 or rows.shape[1] not in (3, 6) or rows.dtype.kind not in "fiu":
        raise InputError(f"{path}: wanted (N, 3) or (N, 6) numbers, found {rows.dtype} of shape {rows.shape}")
    rows = rows.astype(np.float64)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) == 0:
        raise InputError(f"{path}: no points")
    normals = rows[:, 3:]
    # Writers without normals to give leave them 0.
    has_normals = normals.shape[1] == 3 and bool((np.abs(normals).max(axis=1) > 0).all())
    return np.ascontiguousarray(rows[:, :3]), np.ascontiguousarray(normals) if has_normals else None


def read_depth(
    path: PathLike, fx: float, fy: float, cx: float, cy: float, *, scale: float = 0.001, offset: float = 0.0
) -> Floats:
    """Read a depth image as a cloud in the frame of its camera: x to the right, y down, z forward.

    Parameters
    ----------
    path : path
        PNG or TIFF with one channel. Pixels of 0 and of the largest value of 16 bits have no depth.
    fx, fy, cx, cy : float
        Focal lengths and principal point of the pinhole camera, pixels.
    scale, offset : float
        A pixel's depth along z is ``offset + scale * value``; by default millimetres become metres.

    Returns
    -------
    (N, 3) float64
        A point for each pixel with a depth, row by row.

    Raises
    ------
    InputError
        The file cannot be read, or has more than one channel, or no depth at all.
    ImportError
        Pillow is not installed; the message names the extra.
    """
    path = Path(path)

    def read() -> npt.NDArray[Any]:
        Image = _extra("PIL.Image")
        with Image.open(path) as image:
            return np.asarray(image)

    depth = _reading(path, read)
    if depth.ndim != 2:
        raise InputError(f"{path}: a depth image has one channel, this has shape {depth.shape}")
    is_measured = (depth > 0) & (depth < np.iinfo(np.uint16).max)
    z = np.where(is_measured, offset + scale * depth.astype(np.float64), 0)
    points = depth_points(z, fx, fy, cx, cy)
    if len(points) == 0:
        raise InputError(f"{path}: no pixel has a depth")
    return points


def _read_trimesh(path: Path) -> npt.NDArray[Any]:
    # As they are in the file: merged vertices would be fewer.
    loaded = _trimesh(path, process=False)
    if hasattr(loaded, "geometry"):
        parts = [np.asarray(part.vertices) for part in loaded.dump()]
        return np.concatenate(parts) if parts else np.empty((0, 3))
    points = np.asarray(loaded.vertices)
    raw = loaded.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    names = ("nx", "ny", "nz")
    if raw is not None and all(name in _names(raw) for name in names):
        normals = [np.ravel(raw[name]) for name in names]
        if len(normals[0]) == len(points):
            return np.column_stack([points, *normals])
    return points


def _names(raw: Any) -> Any:
    """Properties of a PLY's vertices: a dict of columns if it is text, a structured array if it is binary."""
    return raw if isinstance(raw, dict) else getattr(getattr(raw, "dtype", None), "names", None) or ()


def _read_text(path: Path) -> npt.NDArray[Any]:
    first = path.read_text(encoding="utf-8").lstrip()[:1]
    has_header = first.isalpha() or first in "\"'/"
    delimiter = "," if path.suffix.lower() == ".csv" else None
    return np.loadtxt(path, delimiter=delimiter, skiprows=int(has_header), ndmin=2)


def _read_npz(path: Path) -> npt.NDArray[Any]:
    with np.load(path, allow_pickle=False) as file:
        name = next((name for name in ("points", "tgt") if name in file), None)
        if name is None:
            raise InputError(f"{path}: wanted an array 'points', found {', '.join(file.files) or 'none'}")
        normals = file.get("normals" if name == "points" else "tgt_normals")
        points: npt.NDArray[Any] = file[name]
        return points if normals is None else np.column_stack([points, normals])


def _read_pcd(path: Path) -> npt.NDArray[Any]:
    cloud = _extra("pypcd4").PointCloud.from_path(path)
    normals = [name for name in ("normal_x", "normal_y", "normal_z") if name in cloud.fields]
    rows: npt.NDArray[Any] = cloud.numpy(["x", "y", "z", *(normals if len(normals) == 3 else [])])
    return rows


def _read_las(path: Path) -> npt.NDArray[Any]:
    return np.asarray(_extra("laspy").read(path).xyz)


def _trimesh(path: Path, **options: Any) -> Any:
    if path.suffix.lower() not in _MESHES:
        raise InputError(f"{path}: meshes are read from {', '.join(_MESHES)}, not from '{path.suffix}'")
    trimesh = _extra("trimesh")
    return _reading(path, lambda: trimesh.load(path, **options))


class _Missing(ImportError):
    """A reader that is not installed; other import errors are a reader's own, over a file it cannot read."""


def _reading(path: Path, read: Callable[[], Any]) -> Any:
    """Read, or name the file that could not be."""
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with _interrupts.remembered():
            return read()
    except (InputError, _Missing):
        raise
    except Exception as error:  # readers raise whatever the garbage in a file leads them to
        reason = str(error).strip().splitlines()
        raise InputError(
            f"{path}: cannot be read: {reason[0] if reason else type(error).__name__}"
        ) from error


def _extra(module: str) -> Any:
    import importlib

    try:
        with _interrupts.held():
            return importlib.import_module(module)
    except ImportError as error:
        raise _Missing(f"{module} is needed: pip install 'ibi_rs[io]' ({error})") from error
