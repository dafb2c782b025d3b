"""PCD and LAS: headers are held against the size of the file before anything is made of them."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ibi_rs._core import InputError

from ._reading import Floats, Rows, check_count, check_most, check_rows, extra, place

AXES, NORMALS = ("x", "y", "z"), ("normal_x", "normal_y", "normal_z")

LZF_RATIO = 264
"""No three bytes of LZF hold more."""
LAZ_POINTS_PER_BYTE = 1000
"""More than LASzip makes of points that are all the same."""
CHUNK_SIZE_AT = 64
"""Bytes from the name of LASzip's record on."""
VARYING = 2**32 - 1
"""A table says how many points each chunk holds."""
MAX_CHUNK = 2**24
"""LASzip's own is 50,000; lazrs makes room for so many points at once, for each thread."""
LAS_POINTS_AT_ONCE = 1_000_000
"""Between these Ctrl-C is heard."""


def pcd(path: Path) -> Rows:
    """Read a PCD file, its normals and the viewpoint."""
    reader = extra("pypcd4")
    said, text = _check_pcd(path)
    if text is not None:
        columns = text
    else:
        cloud = reader.PointCloud.from_path(path)
        check_count(said, len(cloud.pc_data), "points")
        columns = {name: cloud.pc_data[name] for name in cloud.fields if name in NORMALS + AXES}
    missing = [name for name in AXES if name not in columns]
    if missing:
        raise InputError(f"has no field {missing[0]}; x, y and z are wanted")
    normals = [columns[name] for name in NORMALS if name in columns]
    return Rows(
        np.column_stack([columns[name] for name in AXES]),
        np.column_stack(normals) if len(normals) == 3 else None,
        viewpoint(path),
    )


def viewpoint(path: Path) -> Floats | None:
    """Where the camera stood, if the header says so."""
    with path.open("rb") as file:
        said = _pcd_header(file).get("VIEWPOINT")
    return None if said is None else place(said[:3])


def _pcd_header(file: BinaryIO) -> dict[str, list[str]]:
    header: dict[str, list[str]] = {}
    for line in file:
        words = line.decode("utf-8").split()
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
        if "DATA" in header:
            break
    return header


def _check_pcd(path: Path) -> tuple[int, dict[str, Floats] | None]:
    """Return how many points the header says, and the columns if they are text; refuse what is cut."""
    with path.open("rb") as file:
        header = _pcd_header(file)
        start = file.tell()
        sizes = file.read(8)
    try:
        said = int((header.get("POINTS") or header["WIDTH"])[0])
        width, height = (
            int(header.get(name, [default])[0]) for name, default in (("WIDTH", said), ("HEIGHT", 1))
        )
        fields = header["FIELDS"]
        size = [int(x) for x in header["SIZE"]]
        counts = [int(x) for x in header.get("COUNT", ["1"] * len(size))]
        kind = header["DATA"][0]
    except (KeyError, IndexError, ValueError):
        raise InputError("has no header of a PCD file") from None
    if not len(fields) == len(size) == len(counts) or min(said, *size, *counts) < 0:
        raise InputError("has no header of a PCD file")
    if width * height != said:
        raise InputError(f"the header says {said} points, and a width of {width} by a height of {height}")
    check_most(said)
    if kind == "ascii":
        return said, _pcd_text(path, start, said, fields, counts)
    row = sum(a * b for a, b in zip(size, counts, strict=True))
    held = path.stat().st_size - start
    if kind == "binary":
        check_count(said, held // max(row, 1), "points")
    elif kind == "binary_compressed" and said > 0:
        compressed, whole = struct.unpack("<II", sizes) if len(sizes) == 8 else (0, 0)
        if compressed > held - 8 or whole != said * row or whole > LZF_RATIO * compressed:
            raise InputError(f"the header says {said} points, and the {held} bytes after it are not these")
    return said, None


def _pcd_text(path: Path, start: int, said: int, fields: list[str], counts: list[int]) -> dict[str, Floats]:
    """Read columns that are apart by any white space: pypcd4 wants one blank."""
    with path.open("rb") as file:
        file.seek(start)
        lines = [line for line in file.read().decode("ascii", "replace").splitlines() if line.strip()]
    check_rows(said, len(lines), "points")
    table = np.loadtxt(lines, ndmin=2) if lines else np.empty((0, sum(counts)))
    if table.shape[1] != sum(counts):
        raise InputError(f"the header says {sum(counts)} numbers a point, and {table.shape[1]} are there")
    firsts = np.cumsum([0, *counts])
    return {name: table[:, first] for name, first in zip(fields, firsts, strict=False)}


def las(path: Path) -> Rows:
    """Read a LAS or LAZ file."""
    reader = extra("laspy")
    said, varies = _check_las(path)
    # One thread makes no room for what a table says of a chunk, and a table cannot be checked before.
    backend = reader.LazBackend.Lazrs if varies else None
    parts = [np.empty((0, 3))]
    # What stands after the points is not looked at: its length may be any number.
    with reader.open(path, read_evlrs=False, laz_backend=backend) as file:
        for part in file.chunk_iterator(LAS_POINTS_AT_ONCE):
            parts.append(np.column_stack([part.x, part.y, part.z]))
    points = np.concatenate(parts)
    check_count(said, len(points), "points")
    return Rows(points)


def _check_las(path: Path) -> tuple[int, bool]:
    """Return how many points the header says, and whether a table of chunks says how many each holds."""
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
    if not all(scale > 0 for scale in struct.unpack_from("<3d", head, 131)):
        raise InputError("has a scale that is not above 0")
    check_most(said)
    most = LAZ_POINTS_PER_BYTE * (size - start) if is_compressed else (size - start) // row
    check_count(said, most, "points")
    varies = is_compressed and said > 0 and _check_chunks(path, start, row)
    return int(said), varies


def _check_chunks(path: Path, start: int, row: int) -> bool:
    """Refuse a table of more chunks than the file can hold: lazrs makes room for all, or ends the process."""
    size = path.stat().st_size
    with path.open("rb") as file:
        records = file.read(start)
        at = records.find(b"laszip encoded") + CHUNK_SIZE_AT
        if not CHUNK_SIZE_AT <= at <= len(records) - 22:
            raise InputError("has no record of LASzip")
        (chunk,) = struct.unpack_from("<I", records, at)
        (num_items,) = struct.unpack_from("<H", records, at + 20)
        items = records[at + 22 : at + 22 + 6 * num_items]
        widths = [width for _, width, _ in struct.iter_unpack("<3H", items[: len(items) // 6 * 6])]
        if sum(widths) != row:
            raise InputError(f"says that its points take {sum(widths)} bytes, and {row}")
        if chunk != VARYING and not 0 < chunk <= MAX_CHUNK:
            raise InputError(f"says that its chunks hold {chunk} points; 1 to {MAX_CHUNK} are allowed")
        (table,) = struct.unpack("<q", file.read(8).ljust(8, b"\0"))
        if table == -1:  # written by what cannot go back: it is at the end
            file.seek(size - 8)
            (table,) = struct.unpack("<q", file.read(8))
        if not start + 8 <= table <= size - 8:
            raise InputError("the table of its chunks is not there; the file is cut")
        file.seek(table)
        _, num_chunks = struct.unpack("<II", file.read(8))
    # A chunk begins with a whole point.
    check_count(num_chunks, (table - start - 8) // row, "chunks")
    return bool(chunk == VARYING)
