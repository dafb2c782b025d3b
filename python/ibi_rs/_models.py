"""`Models`: parts of several kinds, prepared once and looked for together; and `detect`, its short form."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy.typing as npt

from ibi_rs import _core, _log
from ibi_rs._box import Box
from ibi_rs._inputs import Points
from ibi_rs._matches import scan_arguments
from ibi_rs._model import Model
from ibi_rs._view import Viewpoint, _preset
from ibi_rs.params import Params, _limited
from ibi_rs.registration import Registration, Round, StopReason, on_round
from ibi_rs.stages import own_stages


class Models(Sequence[Model]):
    """Models of several kinds of parts, to be found together in any number of scans.

    Each is searched as by :meth:`Model.detect`, which cannot know that a pin fits the shank of a bolt. Then
    all poses compete for the points that were measured: one of whose points more than a third are explained
    by better poses of other parts is rejected, the better being the one of the larger score times the number
    of points that it explains. A sequence of the models; it can be pickled, and shared by threads.

    Parameters
    ----------
    parts : sequence or mapping
        A :class:`Model` each, or a mesh, of which one is made by :meth:`Model.from_mesh`: ``(vertices,
        faces)``, or a mesh of trimesh or Open3D. A mapping has their names as keys.
    names : sequence of str, optional
        One for each part, all different. By default "0", "1" and so on.

    Raises
    ------
    InputError
        There is no part, a part has no normals, two have one name, there are more names than parts or fewer,
        or a mesh cannot be used.
    TypeError
        A part is neither a model nor a mesh, or a name is no str.

    Examples
    --------
    >>> import ibi_rs as ibi, trimesh                                                  # doctest: +SKIP
    >>> parts = {name: trimesh.load(f"{name}.stl") for name in ("bolt", "pin")}        # doctest: +SKIP
    >>> found = ibi.Models(parts).detect(trimesh.load("scan.ply"), viewpoint=[0, 0, 0])  # doctest: +SKIP
    >>> [(pose.model_name, round(pose.score, 2)) for pose in found]                    # doctest: +SKIP
    [('bolt', 0.97), ('bolt', 0.93), ('pin', 0.9)]
    """

    def __init__(
        self, parts: Sequence[Any] | Mapping[str, Any], *, names: Sequence[str] | None = None
    ) -> None:
        if isinstance(parts, Mapping):
            if names is not None:
                raise _core.InputError("names: the parts have theirs; leave it out")
            names, parts = list(parts), list(parts.values())
        elif isinstance(parts, Model) or not isinstance(parts, (Sequence, Iterator)):
            raise TypeError(f"parts must be a sequence or a mapping of models, not {type(parts).__name__}")
        parts = list(parts)
        if isinstance(names, str):
            raise TypeError("names must be a sequence of str, not str")
        names = [str(i) for i in range(len(parts))] if names is None else list(names)
        if len(names) != len(parts):
            raise _core.InputError(f"names: there are {len(names)} of {len(parts)} parts")
        for name in names:
            if not isinstance(name, str):
                raise TypeError(f"names must be str, not {type(name).__name__}")
        self._hold([_model(i, part) for i, part in enumerate(parts)], names)

    def _hold(self, parts: Sequence[Model], names: Sequence[str]) -> None:
        self._parts, self._names = tuple(parts), tuple(names)
        self._core = _core.Models([(name, part._core) for name, part in zip(names, parts, strict=True)])

    @property
    def names(self) -> tuple[str, ...]:
        """Of the models, in their order."""
        return self._names

    def __getitem__(self, which: Any) -> Any:
        """Return a model, by its index or its name."""
        return self._parts[_index(which, self._names) if isinstance(which, str) else which]

    def __len__(self) -> int:
        return len(self._parts)

    def __repr__(self) -> str:
        lines = (f"  {name}: {part!r}" for name, part in zip(self._names, self._parts, strict=True))
        return "\n".join([f"Models: {len(self)}", *lines])

    def __getstate__(self) -> tuple[Any, ...]:
        return self._parts, self._names

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self._hold(*state)

    def detect(
        self,
        tgt: Points,
        params: Params | None = None,
        *,
        tgt_normals: npt.ArrayLike | None = None,
        viewpoint: Viewpoint | None = None,
        remove_plane: bool | None = None,
        check_units: bool = True,
        roi: Box | npt.ArrayLike | None = None,
        background: Points | None = None,
        num_threads: int | None = None,
        max_instances: int | None = None,
        timeout_s: float | None = None,
        callback: Callable[[Round], object] | None = None,
        reference: Registration | npt.ArrayLike | None = None,
    ) -> Registration:
        """Find every instance of every model in a scan.

        The scan is checked once, and thinned, freed of its table and described once for all models of the
        same :attr:`Model.voxel`.

        Parameters
        ----------
        tgt, params, tgt_normals, viewpoint, remove_plane, check_units, roi, background, num_threads
            As in :meth:`Model.detect`.
        max_instances : int, optional
            Overrides that of ``params``; of each model.
        timeout_s : float, optional
            Overrides that of ``params``; of the whole, counted from this call. A model may take an equal
            share of what is left when its turn comes.
        callback : callable, optional
            As in :func:`register`; each model counts its rounds from 0. False ends all.
        reference : optional
            As in :meth:`Model.detect`.

        Returns
        -------
        Registration
            All poses, best score first; ``pose.model`` and ``pose.model_name`` tell of which model, and
            ``found.of(model)`` gives those of one. What better poses of other models outdo is in
            ``found.rejected``, with the objection ``outdone``. ``labels`` and ``inliers`` are rows of the
            correspondences of all models, one model after the other; ``warnings`` name the models that they
            are about.

        Raises
        ------
        InputError, TypeError, ValueError
            As :meth:`Model.detect`.
        """
        if params is None:
            params = _preset(viewpoint)
        params = _limited(params, max_instances, timeout_s)
        scan = scan_arguments(
            tgt, tgt_normals, viewpoint, remove_plane, check_units, roi, background, num_threads
        )
        own = params._own()
        parts, ranking, reason, message, total_s = _core.detect_together(
            self._core,
            params=params._json,
            on_round=None if callback is None else on_round(callback),
            own=[partial(own_stages, own, params.seed, part.points) for part in self._parts] if own else [],
            **scan,
        )
        found = [Registration._of_part(raw, params, i, self._names[i]) for i, raw in enumerate(parts)]
        why = StopReason._of(reason, message)
        all_found = Registration._of_parts(self._names, found, ranking, params, why, total_s)
        of = f"{len(self)} models, {len(scan['tgt'])} points, {len(all_found.labels)} correspondences"
        _log.ended("detect", of, all_found)
        held = [part.symmetries for part in self._parts]
        return all_found if all(one.is_none for one in held) else all_found.canonical(held, reference)


def detect(
    parts: Any,
    tgt: Points,
    params: Params | None = None,
    *,
    names: Sequence[str] | None = None,
    tgt_normals: npt.ArrayLike | None = None,
    viewpoint: Viewpoint | None = None,
    remove_plane: bool | None = None,
    check_units: bool = True,
    roi: Box | npt.ArrayLike | None = None,
    background: Points | None = None,
    num_threads: int | None = None,
    max_instances: int | None = None,
    timeout_s: float | None = None,
    callback: Callable[[Round], object] | None = None,
    reference: Registration | npt.ArrayLike | None = None,
) -> Registration:
    """Find every instance of one part or of several in a scan: of models of which nothing is kept.

    Parameters
    ----------
    parts
        A part, or a sequence or a mapping of parts, as in :class:`Models`; or :class:`Models`.
    names
        As in :class:`Models`.
    tgt, params, tgt_normals, viewpoint, remove_plane, check_units, roi, background
        As in :meth:`Models.detect`.
    num_threads, max_instances, timeout_s, callback, reference
        As in :meth:`Models.detect`. The time does not count for the models, which are made first.

    Returns
    -------
    Registration
        As of :meth:`Models.detect`.

    Raises
    ------
    InputError, TypeError, ValueError
        As :class:`Models` and :meth:`Models.detect`.

    Examples
    --------
    >>> import ibi_rs as ibi, trimesh                                                   # doctest: +SKIP
    >>> found = ibi.detect(trimesh.load("part.stl"), scan, viewpoint=[0, 0, 0])         # doctest: +SKIP
    """
    if isinstance(parts, Models):
        if names is not None:
            raise _core.InputError("names: the models have theirs; leave it out")
        models = parts
    else:
        models = Models([parts] if _is_part(parts) else parts, names=names)
    return models.detect(
        tgt,
        params,
        tgt_normals=tgt_normals,
        viewpoint=viewpoint,
        remove_plane=remove_plane,
        check_units=check_units,
        roi=roi,
        background=background,
        num_threads=num_threads,
        max_instances=max_instances,
        timeout_s=timeout_s,
        callback=callback,
        reference=reference,
    )


def _is_pair(part: Any) -> bool:
    """Whether it is (vertices, faces), and not two parts."""
    return isinstance(part, tuple) and len(part) == 2 and not any(map(_is_part, part))


def _is_part(part: Any) -> bool:
    if isinstance(part, (Model, Mapping, str)):
        return isinstance(part, Model)
    return _is_pair(part) or any(hasattr(part, name) for name in ("vertices", "vertex", "geometry"))


def _model(number: int, part: Any) -> Model:
    if not _is_part(part):
        kind = type(part).__name__
        raise TypeError(f"parts[{number}] must be a Model, (vertices, faces) or a mesh, not {kind}")
    if not isinstance(part, Model):
        return Model.from_mesh(*part) if _is_pair(part) else Model.from_mesh(part)
    if part.normals is None:
        raise _core.InputError(f"parts[{number}] has no normals; detection needs them")
    return part


def _index(name: str, names: Sequence[str]) -> int:
    if name not in names:
        raise KeyError(f"{name!r}; there are {', '.join(map(repr, names))}")
    return names.index(name)
