"""What all readers share: a file, or one line that says what is wrong with it."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from ibi_rs import _interrupts
from ibi_rs._core import InputError

Floats = npt.NDArray[np.float64]
PathLike = str | os.PathLike[str]
T = TypeVar("T")

MAX_POINTS = 2**27
"""A file that claims more is broken, or wants to be thinned first: 3 GB of coordinates."""


@dataclass(frozen=True, eq=False)
class Rows:
    """What a reader has found, row by row."""

    points: npt.NDArray[Any]
    normals: npt.NDArray[Any] | None = None
    viewpoint: Floats | None = None


class Missing(ImportError):
    """A reader that is not installed; other import errors are a reader's own, over a file it cannot read."""


def reading(path: Path, read: Callable[[], T]) -> T:
    """Read, or name the file that could not be."""
    if not path.is_file():
        if path.exists():
            raise InputError(f"{path}: is no file but a {'folder' if path.is_dir() else 'device or pipe'}")
        raise InputError(f"{path}: no such file")
    try:
        with _interrupts.remembered():
            return read()
    except Missing:
        raise
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith(str(path)) else f"{path}: {text}") from None
    except PermissionError:
        raise InputError(f"{path}: may not be read") from None
    # Readers raise whatever the garbage in a file leads them to; a panic of Rust is no Exception.
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        reason = str(error).strip().splitlines()
        raise InputError(
            f"{path}: cannot be read: {reason[0] if reason else type(error).__name__}"
        ) from error


def extra(module: str) -> Any:
    """Import what a plain installation lacks."""
    import importlib

    try:
        with _interrupts.held():
            return importlib.import_module(module)
    except ImportError as error:
        raise Missing(f"{module} is needed: pip install 'ibi_rs[io]' ({error})") from error


def check_count(said: int, held: int, what: str) -> None:
    """Refuse a file of which a part is missing."""
    if held < said:
        raise InputError(f"the header says {said} {what}, and {held} are there; the file is cut")


def check_rows(said: int, held: int, what: str) -> None:
    """Refuse a file that holds fewer or more than it says."""
    check_count(said, held, what)
    if held > said:
        raise InputError(f"the header says {said} {what}, and {held} are there")


def place(said: Any) -> Floats:
    """Three numbers that say where the camera stood."""
    try:
        numbers = np.asarray(said, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise InputError(f"its viewpoint is {str(said)[:80]}; it must be three finite numbers")
    return numbers


def check_most(count: int) -> None:
    """Refuse what no scan has."""
    if count > MAX_POINTS:
        raise InputError(f"has {count} points; {MAX_POINTS} are allowed")


ON_UNIT = 0.02
"""A normal's length is so near to 1, rounded as text may be."""
MOST_OFF_UNIT = 0.05


def are_normals(columns: Floats) -> bool:
    """Whether three columns that nobody has named hold normals and not colours: nearly all of length 1."""
    length = np.linalg.norm(columns, axis=1)
    is_given = np.isfinite(length) & (length > 0)
    if not is_given.any():
        return False
    return bool((np.abs(length[is_given] - 1) > ON_UNIT).mean() <= MOST_OFF_UNIT)


def unnamed(rows: npt.NDArray[Any]) -> Rows:
    """Take the points of columns that nobody has named, and their normals where three of them hold some."""
    for first in (3, 6):
        if rows.shape[1] >= first + 3:
            columns = rows[:, first : first + 3].astype(np.float64)
            if are_normals(columns):
                return Rows(rows[:, :3], columns)
    return Rows(rows[:, :3])
