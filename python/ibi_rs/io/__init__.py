"""Meshes, scans and depth images from files, through well-kept readers: ``pip install 'ibi_rs[io]'``.

Every error names the file. Lengths are those of the file; nothing is scaled but depth images. A file that
holds fewer rows than it says is refused, not read by half.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ibi_rs._core import InputError, measured_rows
from ibi_rs._files import read_npy
from ibi_rs._inputs import _number
from ibi_rs._view import _intrinsics, depth_points

from . import _arrays, _cameras, _clouds, _columns, _meshes, _ply
from ._cameras import Camera
from ._reading import Floats, PathLike, Rows, extra, reading

__all__ = [
    "Camera",
    "Scan",
    "read_camera",
    "read_cloud",
    "read_depth",
    "read_mesh",
    "read_scan",
    "read_viewpoint",
]

IMAGES = (".png", ".tif", ".tiff")

_READERS: dict[str, Callable[[Path], Rows]] = {
    **dict.fromkeys(_meshes.SUFFIXES, _meshes.vertices),
    **dict.fromkeys((".xyz", ".txt", ".csv", ".pts"), _columns.read),
    **dict.fromkeys((".las", ".laz"), _clouds.las),
    ".pcd": _clouds.pcd,
    ".npy": _arrays.npy,
    ".npz": _arrays.npz,
}


@dataclass(frozen=True, eq=False)
class Scan:
    """A scan as a file holds it: what :meth:`Model.detect` wants.

    Attributes
    ----------
    points : (N, 3) float64
        Without those that are not finite, as depth cameras write them where they see nothing.
    normals : (N, 3) float64 or None
        Of any length but 0. A point that has none in a file in which most have one gets that of its nearest
        point.
    viewpoint : (3,) float64 or None
        Where the camera stood in the frame of the points, if the file says so: PCD's ``VIEWPOINT``, the
        element ``camera`` of a PLY file, an array ``viewpoint`` of an NPZ file.
    num_dropped : int
        How many points were not finite.
    """

    points: Floats
    normals: Floats | None
    viewpoint: Floats | None
    num_dropped: int


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
        Polygons of more corners are cut into triangles, concave ones along their outline.

    Raises
    ------
    InputError
        The file cannot be read, has another suffix, holds less than it says, or has no faces (then it may be
        a cloud).
    ImportError
        A reader is not installed; the message names the extra.
    """
    path = Path(path)
    _meshes.check_suffix(path)
    return reading(path, lambda: _meshes.mesh(path))


def read_cloud(path: PathLike) -> tuple[Floats, Floats | None]:
    """Read a point cloud whose rows may be numbered by others; else as :func:`read_scan`.

    Of a mesh the vertices are taken, in the order of the file.

    Parameters
    ----------
    path : path

    Returns
    -------
    points : (N, 3) float64
    normals : (N, 3) float64 or None

    Raises
    ------
    InputError, ImportError
        As :func:`read_scan`.
    """
    scan = _scan(Path(path), _READERS)
    return scan.points, scan.normals


def read_scan(path: PathLike) -> Scan:
    """Read a scan: PLY, OBJ, STL, OFF, GLB, PCD, LAS, LAZ, XYZ, TXT, PTS, CSV, NPY or NPZ.

    Where a file has faces of very different sizes, as CAD programs make them, points are drawn on these; the
    vertices of a mesh that is as dense everywhere, as scanners make it, are taken as they are.

    Parameters
    ----------
    path : path
        A text file has a point a line, its columns apart by spaces, tabs, ``,`` or ``;``. Where a line names
        the columns, ``x, y, z`` and ``nx, ny, nz`` (or ``normal_x`` ...) are taken, in any order. Where none
        does, the first three are, and the next three are normals if they are of length 1; intensities and
        colours are left out. An NPY file holds (N, 3), (N, 6) or (H, W, 3) numbers, likewise; an NPZ file
        ``points`` (or ``tgt``) and perhaps ``normals`` and ``viewpoint``. No file may hold more than 2^27
        points, and none of more than 64 MiB may unpack to more than a hundred times what it takes.

    Returns
    -------
    Scan

    Raises
    ------
    InputError
        The file cannot be read, has another suffix, holds less than it says, or has no points; or its columns
        could mean several things.
    ImportError
        A reader is not installed; the message names the extra.
    """
    return _scan(Path(path), _READERS | dict.fromkeys(_meshes.SUFFIXES, _meshes.surface))


def read_viewpoint(path: PathLike) -> Floats | None:
    """Read where the camera of a scan stood, without the scan.

    Parameters
    ----------
    path : path

    Returns
    -------
    (3,) float64 or None
        As in :class:`Scan`.

    Raises
    ------
    InputError
        The file cannot be read.
    """
    path = Path(path)
    readers = {".pcd": _clouds.viewpoint, ".ply": _ply.viewpoint, ".npz": _arrays.viewpoint}
    read = readers.get(path.suffix.lower())
    return None if read is None else reading(path, lambda: read(path))


def read_camera(path: PathLike, image: PathLike | None = None) -> Camera:
    """Read a pinhole camera: JSON as BOP, RealSense, Open3D or ROS (``CameraInfo``) have it.

    Parameters
    ----------
    path : path
        ``fx``, ``fy`` and ``cx``, ``cy`` or ``ppx``, ``ppy``; or ``K``, ``cam_K``, ``camera_matrix`` (by
        rows) or ``intrinsic_matrix`` (by columns). ``depth_scale`` is taken for metres beside ``ppx``, else
        for millimetres.
    image : path, optional
        The depth image: BOP's ``scene_camera.json`` has a camera for each, by its number.

    Returns
    -------
    Camera

    Raises
    ------
    InputError
        The file cannot be read, or holds no pinhole camera, or several and none for the image.
    """
    path = Path(path)
    return reading(path, lambda: _cameras.camera(path, None if image is None else Path(image)))


def _scan(path: Path, readers: dict[str, Callable[[Path], Rows]]) -> Scan:
    suffix = path.suffix.lower()
    if suffix in IMAGES:
        raise InputError(f"{path}: is an image; with a camera read_depth reads it, or ibi with --camera")
    if suffix not in readers:
        raise InputError(f"{path}: clouds are read from {', '.join(sorted(readers))}, not from '{suffix}'")
    rows = reading(path, lambda: readers[suffix](path))
    points = np.asarray(rows.points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{path}: its points are of shape {points.shape}, not (N, 3)")
    normals = None if rows.normals is None else np.ascontiguousarray(rows.normals, dtype=np.float64)
    points, normals, num_dropped, _ = measured_rows(np.ascontiguousarray(points), normals)
    if len(points) == 0:
        raise InputError(f"{path}: no points")
    return Scan(points, normals, rows.viewpoint, num_dropped)


def read_depth(
    path: PathLike, fx: float, fy: float, cx: float, cy: float, *, scale: float = 0.001, offset: float = 0.0
) -> Floats:
    """Read a depth image as a cloud in the frame of its camera: x to the right, y down, z forward.

    Parameters
    ----------
    path : path
        PNG or TIFF with one channel, or an NPY file of (H, W) numbers. Pixels of 0, those that are not
        finite and, of 16 bits, those of the largest value have no depth.
    fx, fy, cx, cy : float
        Focal lengths (above 0) and principal point of the pinhole camera, pixels.
    scale, offset : float
        A pixel's depth along z is ``offset + scale * value``; by default millimetres become metres. The scale
        is above 0.

    Returns
    -------
    (N, 3) float64
        A point for each pixel with a depth, row by row.

    Raises
    ------
    InputError
        The file cannot be read, or has more than one channel, or no depth at all; or a number is out of
        range.
    ImportError
        Pillow is not installed; the message names the extra.
    """
    path = Path(path)
    camera = _intrinsics(fx, fy, cx, cy)
    scale, offset = _number("scale", scale), _number("offset", offset)
    if not 0 < scale < np.inf or not np.isfinite(offset):
        raise InputError(f"scale and offset are {scale:g} and {offset:g}; scale must be above 0, both finite")

    def read() -> tuple[npt.NDArray[Any], bool]:
        if path.suffix.lower() == ".npy":
            array = read_npy(path)
            if array.dtype.kind not in "fiu":
                raise InputError(f"holds {array.dtype}; depths are numbers")
            return array, array.dtype == np.uint16
        with extra("PIL.Image").open(path) as image:
            # Some versions of Pillow hold the 16 bits of a PNG in 32.
            has_16_bits = (image.format == "PNG" and image.mode != "L") or image.mode.startswith("I;16")
            if image.mode in ("1", "P"):
                raise InputError(f"has pixels of mode {image.mode}, which are no depths")
            return np.asarray(image), has_16_bits

    depth, has_16_bits = reading(path, read)
    if depth.ndim != 2:
        raise InputError(f"{path}: a depth image has one channel, this has shape {depth.shape}")
    is_measured = np.isfinite(depth) & (depth > 0)
    if has_16_bits:
        is_measured &= depth < np.iinfo(np.uint16).max
    z = np.where(is_measured, offset + scale * np.where(is_measured, depth, 0).astype(np.float64), 0)
    points = depth_points(z, *camera)
    if len(points) == 0:
        raise InputError(f"{path}: no pixel has a depth")
    return points
