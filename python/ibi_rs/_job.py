"""`Job`: one scene and the model to be found in it, to be run here or elsewhere."""

from __future__ import annotations

import functools
import os
import pickle
import weakref
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

import numpy.typing as npt

from ibi_rs import io
from ibi_rs._box import Box
from ibi_rs._core import InputError, ParamsError
from ibi_rs._inputs import Points
from ibi_rs._model import Model
from ibi_rs.params import Params
from ibi_rs.registration import Registration, Round


@dataclass(frozen=True, eq=False, repr=False)
class Job:
    """One scene and the model to be found in it: what :func:`register_batch` runs, here or elsewhere.

    With ``corr`` it is ``model.register(tgt, corr, ...)``, without ``model.detect(tgt, ...)``. It can be
    pickled; jobs that arrive in one process share one model, which is described there once.

    Parameters
    ----------
    model : Model
        To be found.
    tgt : (N, 3) array_like, or path
        The scene, as in :func:`register`; or a file, which :func:`ibi_rs.io.read_scan` reads where the job
        runs. The normals in it count where ``corr``, ``tgt_normals`` and ``viewpoint`` are left out.
    corr : optional
        Correspondences, as in :func:`register`.
    params, tgt_normals, viewpoint, max_instances, timeout_s : optional
        As in :func:`register` and :meth:`Model.detect`.
    tgt_frames, similarity : optional
        As in :func:`register`; only with ``corr``.
    remove_plane, roi, background : optional
        As in :meth:`Model.detect`; only without ``corr``.
    num_threads : int, optional
        Default: what the batch gives each of its jobs.
    name : str, optional
        What errors call the job, beside its index. Default: the path, if ``tgt`` is one.

    Raises
    ------
    InputError
        An argument is given that has no say, with ``corr`` or without.
    TypeError
        ``model`` is no :class:`Model`. All else is looked at when the job runs.

    Examples
    --------
    >>> import ibi_rs as ibi
    >>> scene = ibi.synth.outlier_layout(seed=1, num_instances=5)
    >>> job = ibi.Job(ibi.Model(scene.src), scene.tgt, scene.corr, max_instances=2)
    >>> len(job.run())
    2
    """

    model: Model
    tgt: Points
    corr: Any = None
    params: Params | None = None
    _: KW_ONLY
    tgt_normals: npt.ArrayLike | None = None
    tgt_frames: npt.ArrayLike | None = None
    similarity: npt.ArrayLike | None = None
    viewpoint: npt.ArrayLike | None = None
    remove_plane: bool | None = None
    roi: Box | npt.ArrayLike | None = None
    background: Points | None = None
    num_threads: int | None = None
    max_instances: int | None = None
    timeout_s: float | None = None
    name: str | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.model, Model):
            raise TypeError(f"model must be ibi_rs.Model, not {type(self.model).__name__}")
        idle = ("tgt_frames", "similarity") if self.corr is None else ("remove_plane", "roi", "background")
        for name in idle:
            if getattr(self, name) is not None:
                word = "without" if self.corr is None else "with"
                raise InputError(f"{name} has no say {word} corr; leave it out")

    @property
    def path(self) -> Path | None:
        """The file that ``tgt`` is read from; None for arrays."""
        return Path(self.tgt) if isinstance(self.tgt, (str, os.PathLike)) else None

    def run(
        self, *, num_threads: int | None = None, callback: Callable[[Round], object] | None = None
    ) -> Registration:
        """Read the scene if it is a file, and find the model in it.

        Parameters
        ----------
        num_threads : int, optional
            As in :func:`register`; the job's own comes first.
        callback : callable, optional
            As in :func:`register`.

        Returns
        -------
        Registration

        Raises
        ------
        InputError, ParamsError, TypeError, ValueError
            Those of :func:`register`, :meth:`Model.detect` and :func:`ibi_rs.io.read_scan`.
        """
        tgt, tgt_normals = self.tgt, self.tgt_normals
        if self.path is not None:
            if self.corr is None:
                scan = io.read_scan(self.path)
                tgt, normals = scan.points, scan.normals
                if tgt_normals is None and self.viewpoint is None:
                    tgt_normals = normals
            else:
                tgt, _ = io.read_cloud(self.path)
        options: dict[str, Any] = {
            "tgt_normals": tgt_normals,
            "viewpoint": self.viewpoint,
            "num_threads": self.num_threads if self.num_threads is not None else num_threads,
            "max_instances": self.max_instances,
            "timeout_s": self.timeout_s,
            "callback": callback,
        }
        if self.corr is None:
            wanted: dict[str, Any] = {
                "remove_plane": self.remove_plane,
                "roi": self.roi,
                "background": self.background,
            }
            return self.model.detect(tgt, self.params, **wanted, **options)
        options |= {"tgt_frames": self.tgt_frames, "similarity": self.similarity}
        return self.model.register(tgt, self.corr, self.params, **options)

    def __repr__(self) -> str:
        scene = self.name or self.path or type(self.tgt).__name__
        return f"Job({scene}, {self.model!r})"

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"model": _dumped(self.model)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state | {"model": _loaded(state["model"])})


_dumps: weakref.WeakKeyDictionary[Model, bytes] = weakref.WeakKeyDictionary()


def _dumped(model: Model) -> bytes:
    """Pickle a model once for all jobs with it."""
    if model not in _dumps:
        _dumps[model] = pickle.dumps(model)
    return _dumps[model]


@functools.lru_cache(maxsize=8)
def _loaded(data: bytes) -> Model:
    """One model for all jobs of a process: its spacing is measured and its features are found once."""
    model = pickle.loads(data)
    assert isinstance(model, Model)
    return model


class JobError(Exception):
    """What stands in the place of the result of a job that failed.

    Attributes
    ----------
    index : int
        Which job, from 0.
    name : str or None
        Its name.
    error : Exception
        What went wrong: what ``job.run()`` raised, or the executor in its stead.
    """

    def __init__(self, index: int, name: str | None, error: Exception) -> None:
        super().__init__(index, name, error)  # so it can be pickled
        self.index, self.name, self.error = index, name, error
        self.__cause__ = error

    @property
    def reason(self) -> str:
        """What went wrong, in one line."""
        lines = str(self.error).strip().splitlines()
        text = lines[0] if lines else ""
        if text and isinstance(self.error, (InputError, ParamsError, ImportError, OSError)):
            return text
        return f"{type(self.error).__name__}: {text}".removesuffix(": ")

    def __str__(self) -> str:
        # Errors of a file name it themselves.
        name = f", {self.name}" if self.name and self.name not in self.reason else ""
        return f"job {self.index}{name}: {self.reason}"
