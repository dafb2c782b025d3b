"""PCL: geometric consistency grouping, and Hough voting with BOARD reference frames.

Through pcl.cpp, a small driver of ours, which `make bench-peers` compiles to _pcl.so against the PCL of the
system. It is loaded into this process; nothing runs beside the call.

H. Chen and B. Bhanu, "3D free-form object recognition in range images using local surface patches", PRL 2007.
F. Tombari and L. Di Stefano, "Object recognition in 3D scenes with occlusions and clutter by Hough voting",
PSIVT 2010.
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from ibi_rs import synth
from numpy.typing import NDArray

from .contract import Missing, Register, model_spacing
from .overlap import checked

LIBRARY = Path(__file__).parent / "_pcl.so"
CAPACITY = 4096  # poses; a grouping gives tens to hundreds


@cache
def _library() -> Any:
    if not LIBRARY.exists():
        raise Missing("driver not built; needs g++, pkg-config and PCL's headers (Debian: libpcl-dev)")
    try:
        library = ctypes.CDLL(str(LIBRARY))
    except OSError as error:
        raise Missing(f"driver cannot be loaded: {error}") from error
    library.peers_pcl_version.restype = ctypes.c_char_p
    pointer, number, size = ctypes.c_void_p, ctypes.c_double, ctypes.c_int
    out = [size, size, pointer, pointer]
    cloud = [pointer, size]
    library.peers_pcl_gc.argtypes = [*cloud, *cloud, pointer, pointer, size, number, size, *out]
    library.peers_pcl_hough.argtypes = [pointer, pointer, pointer, size, pointer, size, number, number, *out]
    library.peers_pcl_hough_model.argtypes = [pointer, pointer, size, number, size]
    library.peers_pcl_hough_model.restype = pointer
    library.peers_pcl_hough_free.argtypes = [pointer]
    return library


def version() -> str:
    """Return the version of PCL that the driver was built against."""
    return f"PCL {_library().peers_pcl_version().decode()}"


def prepare(scene: synth.Scene, *, method: str, **settings: Any) -> Register:
    """Prepare ``method``, "gc" or "hough"; see `prepare_gc` and `prepare_hough`."""
    return {"gc": prepare_gc, "hough": prepare_hough}[method](scene, **settings)


def prepare_gc(
    scene: synth.Scene, *, size_pr: float, threshold: int, refit: bool, least: float | None
) -> Register:
    """Geometric consistency grouping.

    Parameters
    ----------
    size_pr : float
        Two correspondences agree if their lengths differ by at most this; also the inlier distance of the
        RANSAC that PCL runs in each group.
    threshold : int
        A group has more correspondences than this.
    refit : bool
        Fit the pose to the whole group. PCL's own is that of the best three correspondences.
    least : float or None
        Threshold of the overlap check; None: PCL's poses as they are.
    """
    library, pr = _library(), model_spacing(scene.src)

    def register(scene: synth.Scene) -> NDArray[np.float64]:
        src, tgt, corr = _float(scene.src), _float(scene.tgt), _pairs(scene)
        similarity = np.zeros(len(corr)) if scene.similarity is None else scene.similarity
        distance = _float(1 - similarity)  # groups begin with the most distinctive match
        poses, counts = np.empty((CAPACITY, 4, 4)), np.empty(CAPACITY, dtype=np.int32)
        number = library.peers_pcl_gc(
            src.ctypes.data, len(src), tgt.ctypes.data, len(tgt), corr.ctypes.data, distance.ctypes.data,
            len(corr), size_pr * pr, threshold, refit, CAPACITY, poses.ctypes.data, counts.ctypes.data,
        )  # fmt: skip
        return checked(_best_first(number, poses, counts), scene, pr, least)

    return register


class _HoughModel:
    """Keeps the driver's model as long as it is used."""

    def __init__(self, scene: synth.Scene, radius: float, neighbors: int) -> None:
        self._library = _library()
        src, normals = _float(scene.src), _optional(scene.src_normals)
        self.handle = self._library.peers_pcl_hough_model(
            src.ctypes.data, _address(normals), len(src), radius, neighbors
        )
        if not self.handle:
            raise RuntimeError("PCL failed to compute the model's reference frames")

    def __del__(self) -> None:
        self._library.peers_pcl_hough_free(self.handle)


def prepare_hough(
    scene: synth.Scene,
    *,
    bin_pr: float,
    threshold: float,
    frame_pr: float,
    neighbors: int,
    refit: bool,
    least: float | None,
) -> Register:
    """Hough voting; the model's frames are prepared, the scene's are timed.

    Parameters
    ----------
    bin_pr : float
        Width of a bin; also the inlier distance of the RANSAC in each bin.
    threshold : float
        Least number of votes of a bin; a negative one is a share of the most.
    frame_pr : float
        Radius of the BOARD reference frames.
    neighbors : int
        Of PCL's normal estimation, where the scene has no normals.
    refit, least
        As in `prepare_gc`.
    """
    library, pr = _library(), model_spacing(scene.src)
    model = _HoughModel(scene, frame_pr * pr, neighbors)

    def register(scene: synth.Scene) -> NDArray[np.float64]:
        tgt, normals, corr = _float(scene.tgt), _optional(scene.tgt_normals), _pairs(scene)
        poses, counts = np.empty((CAPACITY, 4, 4)), np.empty(CAPACITY, dtype=np.int32)
        number = library.peers_pcl_hough(
            model.handle, tgt.ctypes.data, _address(normals), len(tgt), corr.ctypes.data, len(corr),
            bin_pr * pr, threshold, refit, CAPACITY, poses.ctypes.data, counts.ctypes.data,
        )  # fmt: skip
        return checked(_best_first(number, poses, counts), scene, pr, least)

    return register


def _best_first(number: int, poses: NDArray[np.float64], counts: NDArray[np.int32]) -> NDArray[np.float64]:
    if number < 0:
        raise RuntimeError("PCL raised an exception")
    return poses[:number][np.argsort(-counts[:number], kind="stable")]


def _float(values: NDArray[Any]) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, dtype=np.float32)


def _optional(values: NDArray[Any] | None) -> NDArray[np.float32] | None:
    return None if values is None else _float(values)


def _address(values: NDArray[Any] | None) -> int | None:
    return None if values is None else values.ctypes.data


def _pairs(scene: synth.Scene) -> NDArray[np.int32]:
    return np.ascontiguousarray(scene.corr, dtype=np.int32)
