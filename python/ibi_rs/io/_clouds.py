"""PCD and LAS: headers are held against the size of the file before anything is made of them."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ibi_rs._core import InputError

from ._files import Floats, Rows, check_count, check_most, extra

LZF_RATIO = 264
"""No three bytes of LZF hold more."""
LAZ_POINTS_PER_BYTE = 1000
"""More than LASzip makes of points that are all the same."""


def pcd(path: Path) -> Rows:
    """Read a PCD file, its normals and the viewpoint."""
    reader = extra("pypcd4")
    said = _check_pcd(path)
    cloud = reader.PointCloud.from_path(path)
    check_count(said, len(np.atleast_1d(cloud.pc_data)), "points")
    names = ("normal_x", "normal_y", "normal_z")
    normals = cloud.numpy(names) if all(name in cloud.fields for name in names) else None
    return Rows(cloud.numpy(("x", "y", "z")), normals, viewpoint(path))


def viewpoint(path: Path) -> Floats | None:
    """Where the camera stood, if the header says so."""
    with path.open("rb") as file:
        place = np.array(_pcd_header(file).get("VIEWPOINT", [])[:3], dtype=np.float64)
    return place if place.shape == (3,) and np.isfinite(place).all() else None


def _pcd_header(file: BinaryIO) -> dict[str, list[str]]:
    header: dict[str, list[str]] = {}
    for line in file:
        words = line.decode("utf-8").split()
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
        if "DATA" in header:
            break
    return header


def _check_pcd(path: Path) -> int:
    """Return how many points the header says; refuse more than the file can hold."""
    with path.open("rb") as file:
        header = _pcd_header(file)
        start = file.tell()
        sizes = file.read(8)
    try:
        said = int((header.get("POINTS") or header["WIDTH"])[0])
        size = [int(x) for x in header["SIZE"]]
        counts = [int(x) for x in header.get("COUNT", ["1"] * len(size))]
        kind = header["DATA"][0]
    except (KeyError, IndexError, ValueError):
        raise InputError("has no header of a PCD file") from None
    check_most(said)
    row = sum(a * b for a, b in zip(size, counts, strict=True))
    held = path.stat().st_size - start
    if kind == "binary":
        check_count(said, held // max(row, 1), "points")
    elif kind == "binary_compressed" and said > 0:
        compressed, whole = struct.unpack("<II", sizes) if len(sizes) == 8 else (0, 0)
        if compressed > held - 8 or whole != said * row or whole > LZF_RATIO * compressed:
            raise InputError(f"the header says {said} points, and the {held} bytes after it are not these")
    return said


def las(path: Path) -> Rows:
    """Read a LAS or LAZ file."""
    reader = extra("laspy")
    said = _check_las(path)
    points = np.asarray(reader.read(path).xyz)
    check_count(said, len(points), "points")
    return Rows(points)


def _check_las(path: Path) -> int:
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(375)
    if len(head) < 227 or head[:4] != b"LASF":
        raise InputError("has no header of a LAS file")
    minor, (header, start, num_vlrs, kind, row, said) = head[25], struct.unpack_from("<HIIBHI", head, 94)
    if minor >= 4 and len(head) >= 255:
        said = max(said, *struct.unpack_from("<Q", head, 247))
    is_compressed = bool(kind & 0x80) or path.suffix.lower() == ".laz"
    if not 227 <= header <= start <= size or 54 * num_vlrs > start - header or row == 0:
        raise InputError("its header does not fit the size of the file")
    check_most(said)
    most = LAZ_POINTS_PER_BYTE * (size - start) if is_compressed else (size - start) // row
    check_count(said, most, "points")
    return int(said)
