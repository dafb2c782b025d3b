"""NPY and NPZ: nothing is unpacked before its header says that it can be a cloud."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from ibi_rs._core import InputError

from ._files import Rows, check_count, check_most, unnamed


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
        normals = "normals" if name == "points" else "tgt_normals"
        if normals not in names:
            return unnamed(points)
        of_points = _member(archive, normals)
        if of_points.shape != (len(points), 3):
            raise InputError(f"{normals} has shape {of_points.shape}; it must be ({len(points)}, 3)")
        return Rows(points[:, :3], of_points)


def _member(archive: zipfile.ZipFile, name: str) -> npt.NDArray[Any]:
    info = archive.getinfo(f"{name}.npy")
    with archive.open(info) as file:
        return _array(file, info.file_size)


def _array(file: IO[bytes], size: int) -> npt.NDArray[Any]:
    """Read an array of a file of so many bytes."""
    version = np.lib.format.read_magic(file)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise InputError(f"is of version {version} of NPY, which holds no plain numbers")
    shape, in_columns, dtype = readers[version](file)
    if len(shape) != 2 or shape[1] not in (3, 6) or dtype.kind not in "fiu":
        raise InputError(f"wanted (N, 3) or (N, 6) numbers, found {dtype} of shape {shape}")
    rows, columns = shape
    check_most(rows)
    row_bytes = columns * dtype.itemsize
    check_count(rows, (size - file.tell()) // row_bytes, "rows")
    values = np.frombuffer(file.read(rows * row_bytes), dtype)
    check_count(rows, len(values) // columns, "rows")
    return values.reshape(shape[::-1]).T if in_columns else values.reshape(shape)
