"""Files that are written whole or not at all, and JSON that others have written."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ibi_rs._core import InputError


@contextmanager
def written(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a name to write to, which becomes ``path`` at the end.

    After an error or Ctrl-C nothing of it is left, and what was at ``path`` still is.
    """
    path = Path(path)
    if path.exists() and not path.is_file():  # /dev/stdout, a pipe: nothing to take the place of
        try:
            yield path
        except OSError as error:
            error.filename = error.filename or str(path)
            raise
        return
    target = Path(os.path.realpath(path))  # a link stays one
    part = _part(target)
    try:
        yield part
        if target.exists():
            shutil.copymode(target, part)
        os.replace(part, target)
    except BaseException as error:
        with suppress(OSError):
            part.unlink()
        if isinstance(error, OSError) and str(error.filename) == str(part):
            error.filename = str(path)  # the name that the caller knows
        raise


def try_writing(path: Path) -> None:
    """Raise now what `written` would raise at the end of a long run."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give the name of a file")
    if path.exists() and not os.access(path, os.W_OK):
        raise InputError(f"{path}: must not be written")
    if path.exists() and not path.is_file():
        return
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}")
    try:
        with suppress(FileNotFoundError):
            os.lstat(_part(target))  # the name may be too long
        with tempfile.TemporaryFile(dir=target.parent):
            pass
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error


def _part(target: Path) -> Path:
    return target.with_name(f"{target.name}.{os.getpid()}.part")


def read_json(path: str | os.PathLike[str]) -> Any:
    """Read a JSON file, or raise InputError that names it."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except RecursionError:
        raise InputError(f"{path}: cannot be read: it is nested too deeply") from None
    except ValueError as error:  # of the text or its encoding
        raise InputError(f"{path}: is no JSON: {error}") from error


def read_npy(path: str | os.PathLike[str]) -> npt.NDArray[Any]:
    """Read an NPY file, or raise InputError that names it."""
    try:
        return np.asarray(np.load(path, allow_pickle=False))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except MemoryError:
        raise InputError(f"{path}: cannot be read: it says that it is larger than the memory") from None
    except Exception as error:  # numpy raises whatever a broken header leads it to
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise InputError(f"{path}: cannot be read: {reason}") from error
