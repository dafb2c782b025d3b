"""NPY and NPZ: nothing is unpacked before its header says that it can be a cloud."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from ibi_rs._core import InputError

from ._reading import Floats, Rows, check_count, check_most, place, unnamed

MAX_HEADER = 10_000
"""Bytes; numpy's own limit, which it looks at when it has read them."""
UNPACKED_FREELY, MAX_RATIO = 2**26, 100
"""Bytes that any archive may unpack to; what is larger may not be so many times what it takes. A deflated
file of zeros is a thousand times."""


def npy(path: Path) -> Rows:
    """Read an array."""
    with path.open("rb") as file:
        return unnamed(_array(file, path.stat().st_size))


def npz(path: Path) -> Rows:
    """Read ``points`` (or ``tgt``), and ``normals`` (``tgt_normals``) if there are any."""
    with zipfile.ZipFile(path) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist()]
        name = next((name for name in ("points", "tgt") if name in names), None)
        if name is None:
            raise InputError(f"wanted an array 'points', found {', '.join(names) or 'none'}")
        points = _member(archive, name)
        eye = _viewpoint(archive)
        normals = "normals" if name == "points" else "tgt_normals"
        if normals not in names:
            held = unnamed(points)
            return Rows(held.points, held.normals, eye)
        of_points = _member(archive, normals)
        if of_points.shape != (len(points), 3):
            raise InputError(f"{normals} has shape {of_points.shape}; it must be ({len(points)}, 3)")
        return Rows(points[:, :3], of_points, eye)


def viewpoint(path: Path) -> Floats | None:
    """Where the camera stood, if an array ``viewpoint`` says so."""
    with zipfile.ZipFile(path) as archive:
        return _viewpoint(archive)


def _viewpoint(archive: zipfile.ZipFile) -> Floats | None:
    if "viewpoint.npy" not in archive.namelist() or archive.getinfo("viewpoint.npy").file_size > MAX_HEADER:
        return None
    with archive.open("viewpoint.npy") as file:
        return place(np.lib.format.read_array(file, allow_pickle=False))


def _member(archive: zipfile.ZipFile, name: str) -> npt.NDArray[Any]:
    info = archive.getinfo(f"{name}.npy")
    if info.file_size > max(UNPACKED_FREELY, MAX_RATIO * info.compress_size):
        raise InputError(
            f"{name} unpacks to {info.file_size // max(info.compress_size, 1)} times what it takes;"
            f" {MAX_RATIO} times are allowed"
        )
    with archive.open(info) as file:
        return _array(file, info.file_size)


def _array(file: IO[bytes], size: int) -> npt.NDArray[Any]:
    """Read an array of a file of so many bytes."""
    version = np.lib.format.read_magic(file)
    length = int.from_bytes(file.read(2 if version == (1, 0) else 4), "little")
    if length > MAX_HEADER:
        raise InputError(f"has a header of {length} bytes; {MAX_HEADER} are allowed")
    file.seek(0)
    np.lib.format.read_magic(file)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise InputError(f"is of version {version} of NPY, which holds no plain numbers")
    shape, in_columns, dtype = readers[version](file)
    if len(shape) not in (2, 3) or shape[-1] not in (3, 6) or dtype.kind not in "fiu":
        raise InputError(f"wanted (N, 3), (N, 6) or (H, W, 3) numbers, found {dtype} of shape {shape}")
    rows, columns = math.prod(shape[:-1]), shape[-1]
    check_most(rows)
    row_bytes = columns * dtype.itemsize
    check_count(rows, (size - file.tell()) // row_bytes, "rows")
    values = np.frombuffer(file.read(rows * row_bytes), dtype)
    check_count(rows, len(values) // columns, "rows")
    array = values.reshape(shape[::-1]).T if in_columns else values.reshape(shape)
    return array.reshape(rows, columns)
