"""What users hold, as arrays that the core takes."""

from __future__ import annotations

import os
import sys
from typing import Any

import numpy as np
import numpy.typing as npt

from ibi_rs._core import InputError

Points = Any
"""(N, 3) real numbers, or an object with ``.points``, ``.vertices``, ``__array__`` or ``__dlpack__``."""

# More than a few for each core are not started: the core sees to that.
_MAX_THREADS = 65535
"""As many as rayon can tell apart."""


def _real(name: str, value: Any) -> npt.NDArray[Any]:
    """Any array of real numbers."""
    try:
        if hasattr(value, "__dlpack__") and not hasattr(value, "__array__"):  # Open3D's tensors
            value = np.from_dlpack(value)
        array = np.asarray(value)
    except ValueError as error:  # ragged lists
        raise InputError(f"{name} is not a rectangular array: {error}") from None
    except (BufferError, RuntimeError, TypeError) as error:  # tensors on a GPU, with a gradient, of bfloat16
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise TypeError(f"{name} cannot be read as an array: {reason}") from None
    # Not imported for the question: without the module there is none.
    if "numpy.ma" in sys.modules and np.ma.is_masked(value):
        raise InputError(f"{name} has masked entries; leave those rows out")
    if array.dtype.kind not in "fiu":  # a timedelta is an np.integer
        raise TypeError(f"{name} has dtype {array.dtype}; it must be real numbers")
    return array


def _shaped(name: str, value: Any, *shape: int | str) -> npt.NDArray[Any]:
    """Real numbers in this shape, in which a letter stands for any number; of an empty list for none."""
    array = _real(name, value)
    if array.shape == (0,) and isinstance(shape[0], str) and all(isinstance(side, int) for side in shape[1:]):
        return array.reshape(0, *shape[1:])
    sides = zip(array.shape, shape, strict=False)
    if array.ndim != len(shape) or any(isinstance(want, int) and side != want for side, want in sides):
        words = ", ".join(map(str, shape)) + "," * (len(shape) == 1)
        raise InputError(f"{name} has shape {array.shape}; it must be ({words})")
    return array


def _floats(name: str, value: Any, *shape: int | str) -> npt.NDArray[np.float64]:
    return _aligned(_shaped(name, value, *shape), np.float64)


def _aligned(array: npt.NDArray[Any], dtype: type) -> npt.NDArray[Any]:
    """Copy what the core cannot read in place: it takes a field of a packed record for something else."""
    with np.errstate(over="ignore"):  # of longdouble; the core refuses infinity
        return np.require(array, dtype, ["C_CONTIGUOUS", "ALIGNED"])


def _points(name: str, value: Any) -> npt.NDArray[np.float64]:
    """(N, 3) float64, from an array or from an object that holds one."""
    return _floats(name, _held(name, value), "N", 3)


def _held(name: str, value: Any) -> npt.NDArray[Any]:
    """Take the points out of what holds some, in any shape; (0, 3) if there are none."""
    if not isinstance(value, np.ndarray):
        for attribute in ("points", "vertices"):
            value = getattr(value, attribute, value)
        for attribute in ("point", "vertex"):  # Open3D's tensor geometry
            value = getattr(getattr(value, attribute, None), "positions", value)
    array = _real(name, value)
    return array.reshape(0, 3) if array.shape == (0,) else array


def _scan_rows(name: str, value: Any) -> npt.NDArray[np.float64]:
    """(N, 3) float64 of what is (N, 3) or (H, W, 3)."""
    array = _held(name, value)
    if array.ndim == 3 and array.shape[-1] == 3:
        array = array.reshape(-1, 3)
    elif array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"{name} has shape {array.shape}; it must be (N, 3) or (H, W, 3)")
    return _aligned(array, np.float64)


RIGID_TOLERANCE = 1e-6
"""How far from a rotation a matrix may be, per entry of R^T R: single precision passes, a scale does not."""


def _rigid(name: str, value: Any) -> npt.NDArray[np.float64]:
    """(4, 4), a rotation and a translation."""
    motion = _floats(name, value, 4, 4)
    if not np.isfinite(motion).all():
        raise InputError(f"{name} has a value that is not finite")
    turn = motion[:3, :3]
    with np.errstate(over="ignore"):
        off = np.abs(turn.T @ turn - np.eye(3)).max()
    if not off <= RIGID_TOLERANCE or np.linalg.det(turn) < 0 or motion[3].tolist() != [0, 0, 0, 1]:
        raise InputError(
            f"{name} is no rigid motion: its upper 3x3 must be a rotation, its last row 0 0 0 1;"
            " is it transposed?"
        )
    return motion


def _mesh(vertices: Any, faces: Any) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """(V, 3) and (F, 3), from arrays or from an object that holds both."""
    if faces is None:
        if hasattr(vertices, "geometry") and hasattr(vertices, "dump"):  # a Scene of trimesh
            parts = [part for part in vertices.dump() if len(getattr(part, "faces", ()))]
            counts = np.cumsum([0, *(len(part.vertices) for part in parts)])
            faces = [np.asarray(part.faces) + start for part, start in zip(parts, counts, strict=False)]
            faces = np.concatenate(faces) if faces else None
            vertices = np.concatenate([part.vertices for part in parts]) if parts else np.empty((0, 3))
        else:
            faces = getattr(vertices, "faces", getattr(vertices, "triangles", None))
            triangle = getattr(vertices, "triangle", None)  # Open3D's tensor meshes
            faces = getattr(triangle, "indices", faces)
        if faces is None or len(faces) == 0:
            raise InputError("faces: the mesh has none; a cloud goes to Model(src, normals=...)")
    return _points("vertices", vertices), _faces(faces)


def _frames(name: str, value: Any) -> npt.NDArray[np.float64]:
    return _floats(name, value, "N", 3, 3)


def _vector(name: str, value: Any) -> npt.NDArray[np.float64]:
    return _floats(name, value, "M")


def _viewpoint(value: Any) -> list[float]:
    eye: list[float] = _floats("viewpoint", value, 3).tolist()
    return eye


def _eyes(value: Any) -> npt.NDArray[np.float64]:
    """(E, 3) float64, from one place or several."""
    array = np.asarray(value)
    if array.ndim != 2:
        return np.array([_viewpoint(value)])
    if len(array) == 0:
        raise InputError("viewpoint has shape (0, 3); leave it out where none is known")
    return _floats("viewpoint", value, "E", 3)


def _correspondences(value: Any) -> npt.NDArray[Any]:
    """(M, 2) int64 rows or (M, 6) float64 points."""
    if isinstance(value, (tuple, list)) and len(value) == 2 and all(map(_is_rows3, value)):
        source, target = _points("corr[0]", value[0]), _points("corr[1]", value[1])
        if len(source) != len(target):
            raise InputError(
                f"corr is a pair of {len(source)} and {len(target)} points; it must be of equally many"
            )
        return np.hstack([source, target])
    if not isinstance(value, np.ndarray):
        value = getattr(value, "correspondence_set", value)  # Open3D's RegistrationResult
    is_sized = isinstance(value, (tuple, list)) or (isinstance(value, np.ndarray) and value.ndim > 0)
    if is_sized and len(value) == 0:  # of any dtype
        return np.empty((0, 2), np.int64)
    array = _real("corr", value)
    if array.shape == (0,):
        return np.empty((0, 2), np.int64)
    if array.ndim != 2 or array.shape[1] not in (2, 6):
        raise InputError(f"corr has shape {array.shape}; it must be (M, 2) rows or (M, 6) points")
    if array.shape[1] == 6:
        return _aligned(array, np.float64)
    return _indices("corr of shape (M, 2)", array)


def _is_rows3(side: Any) -> bool:
    """Whether this is a list of points, of which two make a pair, and not one row of indices."""
    try:
        shape = np.shape(side)
    except (BufferError, RuntimeError, TypeError, ValueError):  # who reads it next says so
        return False
    return len(shape) == 2 and shape[1] == 3


def _num_threads(value: int | None) -> int | None:
    name: str = "num_threads"
    given: Any = value
    if given is None:
        name, given = "IBI_NUM_THREADS", os.environ.get("IBI_NUM_THREADS", "")
        if not given:
            return None
        given = int(given) if given.isdecimal() and len(given) < 10 else given
    is_integer = isinstance(given, (int, np.integer)) and not isinstance(given, bool)
    if not is_integer or not 1 <= given <= _MAX_THREADS:
        raise ValueError(f"{name} is {given!r}; it must be an integer from 1 to {_MAX_THREADS}")
    return int(given)


def _optional(name: str, value: Any) -> npt.NDArray[np.float64] | None:
    return None if value is None else _points(name, value)


def _number(name: str, value: Any) -> float:
    array = _real(name, value)
    if array.shape != ():
        raise TypeError(f"{name} has shape {array.shape}; it must be a number")
    return float(array)


def _count(name: str, value: Any, least: int) -> int:
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool):
        raise TypeError(f"{name} must be an integer, not {type(value).__name__}")
    if not least <= value < 2**32:
        raise InputError(f"{name} is {value}; it must be at least {least} and below 2^32")
    return int(value)


def _seed(value: Any) -> int:
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool):
        raise TypeError(f"seed must be an integer, not {type(value).__name__}")
    if not 0 <= value < 2**64:
        raise InputError(f"seed is {value}; it must be from 0 to 2^64 - 1")
    return int(value)


def _rows(name: str, value: Any) -> npt.NDArray[np.int64]:
    return _indices(name, _shaped(name, value, "K"))


def _faces(value: Any) -> npt.NDArray[np.int64]:
    return _indices("faces", _shaped("faces", value, "F", 3))


def _indices(name: str, array: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    if array.size and not np.issubdtype(array.dtype, np.integer):  # what is empty has no type of its own
        raise TypeError(f"{name} has dtype {array.dtype}; rows must be integers")
    return _int64(array)


def _int64(array: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Any integers; what is beyond int64 is clipped, is still no row, and is refused with its place."""
    if array.dtype == np.uint64:
        array = np.minimum(array, np.uint64(np.iinfo(np.int64).max))
    return _aligned(array, np.int64)


def _frozen(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Make an array read-only; return it."""
    array.flags.writeable = False
    return array
