"""`register`: brings what users hold into arrays, calls the core, dresses the answer."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from ibi_rs import _core
from ibi_rs.params import Params
from ibi_rs.registration import Pose, Registration, Round, StopReason, Timings
from ibi_rs.stages import Run

Points = Any
"""(N, 3) real numbers, or an object with ``.points``, ``.vertices`` or ``__array__``."""

_MAX_THREADS = 65535
"""As many as rayon can tell apart."""


def register(
    src: Points,
    tgt: Points,
    corr: Any,
    params: Params | None = None,
    *,
    src_normals: npt.ArrayLike | None = None,
    tgt_normals: npt.ArrayLike | None = None,
    src_frames: npt.ArrayLike | None = None,
    tgt_frames: npt.ArrayLike | None = None,
    similarity: npt.ArrayLike | None = None,
    viewpoint: npt.ArrayLike | None = None,
    num_threads: int | None = None,
    max_instances: int | None = None,
    timeout_s: float | None = None,
    callback: Callable[[Round], object] | None = None,
) -> Registration:
    """Find every instance of a model in a scene.

    Parameters
    ----------
    src, tgt : (N, 3) array_like
        The model (source) and the scene (target) in the same unit of length, of any real dtype; or an object
        with ``.points`` (Open3D), ``.vertices`` (trimesh) or ``__array__``. At least 3 points each.
    corr : (M, 2) array_like of int, (M, 6) array_like, or pair of (M, 3) arrays
        Putative correspondences: [source row, target row], or the source point and the target point
        themselves.
    params : Params, optional
        Default ``Params()``.
    src_normals, tgt_normals : (N, 3) array_like, optional
        Normals of both clouds, or of neither; any length but 0. Used by the local game (``LocalGtm``) and,
        where ``min_normal_cos`` is set, by inliers, refinement and overlap: :meth:`Params.single_view`.
    src_frames, tgt_frames : (N, 3, 3) array_like, optional
        Local reference frames of both clouds, or of neither: at each point three unit axes, as rows,
        right-handed. Used by :class:`Hough3d`, which computes them where they are not given.
    similarity : (M,) array_like, optional
        How alike the two descriptors of each correspondence are, on any scale; larger is better. Used by
        :class:`Nnsr`, which cannot do without. A good choice is 1 - d1 / d2, with d1 and d2 the distances to
        the nearest and to the second nearest descriptor.
    viewpoint : (3,) array_like, optional
        Where the depth camera stood, in the frame of ``tgt``. With normals that count, only source points
        that face it count in the overlap.
    num_threads : int, optional
        Default: the environment variable ``IBI_NUM_THREADS``, else the cores the process may use. The result
        does not depend on it.
    max_instances, timeout_s : optional
        Override those of ``params``.
    callback : callable, optional
        Called with a :class:`Round` after each round; returning False ends the run and keeps what is found.

    Returns
    -------
    Registration
        The poses, best score first; empty if there is none, and ``stop_reason`` says why the run ended.

    Raises
    ------
    InputError
        An array has a wrong shape, a value that is not finite, or an index out of range, or a variant needs
        one that is not given, or a stage of your own returns what cannot be used; the message names the
        argument, the place and what is allowed. A ValueError.
    ParamsError
        A parameter is out of range. A ValueError.
    TypeError
        An array has a dtype that cannot be used, or an argument is of another type than above.
    ValueError
        ``num_threads`` or ``IBI_NUM_THREADS`` is no integer from 1 to 65535.

    Notes
    -----
    The GIL is released. Ctrl-C ends the run within 0.1 s. Stages of your own are called in the thread that
    called this function; an exception in one, Ctrl-C among them, ends the run and is raised as it is.

    References
    ----------
    Cao et al., "Instance by Instance: An Iterative Framework for Multi-instance 3D Registration".

    Examples
    --------
    >>> import ibi_rs as ibi
    >>> scene = ibi.synth.outlier_layout(seed=1, num_instances=5)
    >>> found = ibi.register(scene.src, scene.tgt, scene.corr)
    >>> found[0].target_from_source.shape
    (4, 4)
    """
    model = Model(src, normals=src_normals, frames=src_frames)
    return model.register(
        tgt,
        corr,
        params,
        tgt_normals=tgt_normals,
        tgt_frames=tgt_frames,
        similarity=similarity,
        viewpoint=viewpoint,
        num_threads=num_threads,
        max_instances=max_instances,
        timeout_s=timeout_s,
        callback=callback,
    )


class Model:
    """A model (source), checked and prepared once, to be found in any number of scenes.

    Its spacing and diameter are measured once; :func:`register` measures them anew with every call. A model
    can be pickled, and shared by threads.

    Parameters
    ----------
    src : (N, 3) array_like
        The model, as in :func:`register`.
    normals : (N, 3) array_like, optional
        Its normals; any length but 0.
    frames : (N, 3, 3) array_like, optional
        Its local reference frames, as in :func:`register`.

    Raises
    ------
    InputError
        As :func:`register`, of ``src``, ``src_normals`` and ``src_frames``.
    TypeError
        As :func:`register`.

    Examples
    --------
    >>> import ibi_rs as ibi
    >>> scene = ibi.synth.outlier_layout(seed=1, num_instances=5)
    >>> model = ibi.Model(scene.src)
    >>> len(model.register(scene.tgt, scene.corr))
    5
    """

    def __init__(
        self,
        src: Points,
        *,
        normals: npt.ArrayLike | None = None,
        frames: npt.ArrayLike | None = None,
    ) -> None:
        points = _points("src", src)
        of_points = None if normals is None else _points("src_normals", normals)
        axes = None if frames is None else _frames("src_frames", frames)
        self._source = _core.Source(points, of_points, axes)
        # Copies: the caller's arrays may change, the prepared source does not.
        self._points, self._normals = _frozen(points), None if of_points is None else _frozen(of_points)
        self._frames = None if axes is None else _frozen(axes)

    @property
    def points(self) -> npt.NDArray[np.float64]:
        """(N, 3), in data units; read-only."""
        return self._points

    @property
    def normals(self) -> npt.NDArray[np.float64] | None:
        """(N, 3) as given, or None; read-only."""
        return self._normals

    @property
    def frames(self) -> npt.NDArray[np.float64] | None:
        """(N, 3, 3) as given, or None; read-only."""
        return self._frames

    @property
    def spacing(self) -> float:
        """Mean distance of a point to its nearest other point, in data units."""
        return self._source.spacing

    @property
    def diameter(self) -> float:
        """Largest distance of two points, in data units; measured when first asked for."""
        return self._source.diameter

    def __len__(self) -> int:
        return len(self._points)

    def __repr__(self) -> str:
        normals = "with" if self._normals is not None else "without"
        return f"Model({len(self)} points, {normals} normals, spacing {self.spacing:.4g})"

    def __getstate__(self) -> dict[str, Any]:
        return {"points": self._points, "normals": self._normals, "frames": self._frames}

    def __setstate__(self, state: dict[str, Any]) -> None:
        Model.__init__(self, state["points"], normals=state["normals"], frames=state["frames"])

    def register(
        self,
        tgt: Points,
        corr: Any,
        params: Params | None = None,
        *,
        tgt_normals: npt.ArrayLike | None = None,
        tgt_frames: npt.ArrayLike | None = None,
        similarity: npt.ArrayLike | None = None,
        viewpoint: npt.ArrayLike | None = None,
        num_threads: int | None = None,
        max_instances: int | None = None,
        timeout_s: float | None = None,
        callback: Callable[[Round], object] | None = None,
    ) -> Registration:
        """Find every instance of this model in a scene: :func:`register` without the model's arguments.

        Parameters, returns, raises: those of :func:`register`.
        """
        params = params if params is not None else Params()
        if not isinstance(params, Params):
            raise TypeError(f"params must be ibi_rs.Params, not {type(params).__name__}")
        if callback is not None and not callable(callback):
            raise TypeError(f"callback must be callable, not {type(callback).__name__}")
        overrides = {"max_instances": max_instances, "timeout_s": timeout_s}
        params = params.replace(**{name: value for name, value in overrides.items() if value is not None})

        target, pairs, own = _points("tgt", tgt), _correspondences(corr), params._own()
        # Copies the scene for them, so only where there is one.
        run = Run(self._points, target, pairs, params.seed) if own else None
        raw = _core.register(
            self._source,
            target,
            pairs,
            params._to_json(),
            tgt_normals=None if tgt_normals is None else _points("tgt_normals", tgt_normals),
            tgt_frames=None if tgt_frames is None else _frames("tgt_frames", tgt_frames),
            similarity=None if similarity is None else _vector("similarity", similarity),
            viewpoint=None if viewpoint is None else _viewpoint(viewpoint),
            num_threads=_num_threads(num_threads),
            on_round=None if callback is None else _on_round(callback),
            **({} if run is None else {name: run.stage(name, stage) for name, stage in own.items()}),
        )
        return _registration(raw, params)


def _frozen(array: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    copy = array.copy()
    copy.flags.writeable = False
    return copy


def _on_round(callback: Callable[[Round], object]) -> Callable[[str], bool]:
    """Bring a round from the core to the user, and back whether to go on: unless the answer is False."""

    def on_round(text: str) -> bool:
        answer = callback(Round._from_dict(json.loads(text)))
        return bool(answer) if isinstance(answer, (bool, np.bool_)) else True

    return on_round


def _registration(raw: dict[str, Any], params: Params) -> Registration:
    numbers = ("score", "overlap", "closeness", "back_fit", "evidence", "inlier_rmse")
    poses = []
    for k, matrix in enumerate(raw["target_from_source"]):
        measured = {name: float(raw[name][k]) for name in numbers}
        poses.append(Pose(matrix, **measured, inliers=raw["inliers"][k], round=int(raw["round"][k])))
    return Registration(
        poses,
        labels=raw["labels"],
        rounds=[Round._from_dict(data) for data in json.loads(raw["rounds"])],
        stop_reason=StopReason(message=raw["stop_message"], **json.loads(raw["stop_reason"])),
        timings=Timings(**json.loads(raw["timings"])),
        resolution=raw["resolution"],
        params=params,
    )


def _real(name: str, value: Any) -> npt.NDArray[Any]:
    """Any array of real numbers."""
    try:
        array = np.asarray(value)
    except ValueError as error:  # ragged lists
        raise _core.InputError(f"{name} is not a rectangular array: {error}") from None
    if array.dtype.kind not in "fiu":  # a timedelta is an np.integer
        raise TypeError(f"{name} has dtype {array.dtype}; it must be real numbers")
    return array


def _aligned(array: npt.NDArray[Any], dtype: type) -> npt.NDArray[Any]:
    """Copy what the core cannot read in place: it takes a field of a packed record for something else."""
    with np.errstate(over="ignore"):  # of longdouble; the core refuses infinity
        return np.require(array, dtype, ["C_CONTIGUOUS", "ALIGNED"])


def _points(name: str, value: Any) -> npt.NDArray[np.float64]:
    """(N, 3) float64, from an array or from an object that holds one."""
    if not isinstance(value, np.ndarray):
        for attribute in ("points", "vertices"):
            value = getattr(value, attribute, value)
    array = _real(name, value)
    if array.shape == (0,):
        array = array.reshape(0, 3)
    if array.ndim != 2 or array.shape[1] != 3:
        raise _core.InputError(f"{name} has shape {array.shape}; it must be (N, 3)")
    return _aligned(array, np.float64)


def _frames(name: str, value: Any) -> npt.NDArray[np.float64]:
    array = _real(name, value)
    if array.ndim != 3 or array.shape[1:] != (3, 3):
        raise _core.InputError(f"{name} has shape {array.shape}; it must be (N, 3, 3)")
    return _aligned(array, np.float64)


def _vector(name: str, value: Any) -> npt.NDArray[np.float64]:
    array = _real(name, value)
    if array.ndim != 1:
        raise _core.InputError(f"{name} has shape {array.shape}; it must be (M,)")
    return _aligned(array, np.float64)


def _viewpoint(value: Any) -> list[float]:
    array = _real("viewpoint", value)
    if array.shape != (3,):
        raise _core.InputError(f"viewpoint has shape {array.shape}; it must be (3,)")
    return [float(x) for x in array]


def _correspondences(value: Any) -> npt.NDArray[Any]:
    """(M, 2) int64 rows or (M, 6) float64 points."""
    if isinstance(value, (tuple, list)) and len(value) == 2 and all(map(_is_rows3, value)):
        source, target = _points("corr[0]", value[0]), _points("corr[1]", value[1])
        if len(source) != len(target):
            raise _core.InputError(
                f"corr is a pair of {len(source)} and {len(target)} points; it must be of equally many"
            )
        return np.hstack([source, target])
    if not isinstance(value, np.ndarray):
        value = getattr(value, "correspondence_set", value)  # Open3D's RegistrationResult
    if isinstance(value, (tuple, list, np.ndarray)) and len(value) == 0:  # of any dtype
        return np.empty((0, 2), np.int64)
    array = _real("corr", value)
    if array.shape == (0,):
        return np.empty((0, 2), np.int64)
    if array.ndim != 2 or array.shape[1] not in (2, 6):
        raise _core.InputError(f"corr has shape {array.shape}; it must be (M, 2) rows or (M, 6) points")
    if array.shape[1] == 6:
        return _aligned(array, np.float64)
    if not np.issubdtype(array.dtype, np.integer):
        raise TypeError(f"corr of shape (M, 2) has dtype {array.dtype}; rows must be integers")
    # Indices beyond int64 are out of any range; clipped, the core still refuses them and says where.
    if array.dtype == np.uint64:
        array = np.minimum(array, np.uint64(np.iinfo(np.int64).max))
    return _aligned(array, np.int64)


def _is_rows3(side: Any) -> bool:
    """Whether this is a list of points, of which two make a pair, and not one row of indices."""
    try:
        shape = np.shape(side)
    except ValueError:  # ragged; who reads it next says so
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
