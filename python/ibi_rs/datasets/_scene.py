"""What every reader gives: a scan, the kinds of parts in it, and where they are."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np
import numpy.typing as npt

from ibi_rs import io, metrics
from ibi_rs._core import InputError
from ibi_rs._files import read_json
from ibi_rs._inputs import _frozen
from ibi_rs._model import Model
from ibi_rs._view import View
from ibi_rs.symmetries import Symmetries

Floats = npt.NDArray[np.float64]
Item = TypeVar("Item")


class Lazy(Sequence[Item]):
    """A sequence whose items are made when they are asked for, and not kept."""

    @abstractmethod
    def _item(self, index: int) -> Item:
        """Make one."""

    @overload
    def __getitem__(self, index: int) -> Item: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Item]: ...
    def __getitem__(self, index: int | slice) -> Item | Sequence[Item]:
        """Return one, or several."""
        if isinstance(index, slice):
            return [self._item(i) for i in range(len(self))[index]]
        return self._item(index)

    def __iter__(self) -> Iterator[Item]:
        """Give all, one by one; none is kept."""
        return (self._item(i) for i in range(len(self)))


class Kind:
    """A kind of part: its mesh, which is read when it is first asked for, and what is known of it.

    Attributes
    ----------
    name : str
        ``obj_id`` in BOP, category and number elsewhere.
    path : Path
        File of the mesh.
    symmetries : Symmetries
        As the data set declares them.
    """

    def __init__(
        self,
        name: str,
        path: Path,
        *,
        symmetries: Symmetries | None = None,
        diameter: float | None = None,
        scale: npt.ArrayLike = 1.0,
        surface: Path | None = None,
    ) -> None:
        self.name, self.path = name, path
        self.symmetries = symmetries or Symmetries.none()
        self._diameter, self._scale, self._surface = diameter, np.asarray(scale, np.float64), surface

    @cached_property
    def mesh(self) -> tuple[Floats, npt.NDArray[np.int64]]:
        """Vertices (V, 3), data units, and faces (F, 3)."""
        vertices, faces = io.read_mesh(self.path)
        return _frozen(vertices * self._scale), _frozen(faces)

    @cached_property
    def points(self) -> Floats:
        """(N, 3), data units, by which errors are measured: vertices, of the mesh for evaluation if any."""
        if self._surface is None:
            return self.mesh[0]
        return _frozen(io.read_mesh(self._surface)[0] * self._scale)

    @cached_property
    def diameter(self) -> float:
        """Largest distance of two points, data units: as declared, else measured."""
        return self._diameter if self._diameter is not None else metrics.diameter(self.points)

    def model(self, *, voxel: float | None = None, num_threads: int | None = None) -> Model:
        """Prepare it for detection: :meth:`ibi_rs.Model.from_mesh`, with its symmetries.

        Parameters
        ----------
        voxel, num_threads : optional
            As in :meth:`ibi_rs.Model.from_mesh`.

        Returns
        -------
        Model
        """
        return Model.from_mesh(*self.mesh, voxel=voxel, symmetries=self.symmetries, num_threads=num_threads)

    def __repr__(self) -> str:
        return f"Kind({self.name!r}, {self.path})"

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what can be read again."""
        return {name: value for name, value in self.__dict__.items() if name not in ("mesh", "points")}


@dataclass(frozen=True, eq=False, repr=False)
class Part:
    """A kind of part in a scene, and where its copies are.

    Attributes
    ----------
    kind : Kind
        What it is.
    poses : (K, 4, 4) float64
        target_from_model of all labelled copies, data units; none where the truth is kept secret.
    visibility : (K,) float64
        Share of each copy's silhouette that can be seen; NaN where it is not told.
    count : int or None
        How many copies are asked for, where the data set says so.
    """

    kind: Kind
    poses: Floats
    visibility: Floats
    count: int | None = None

    def __repr__(self) -> str:
        return f"Part({self.kind.name!r}, {len(self.poses)} copies)"


@dataclass(frozen=True, eq=False)
class Held:
    """What a scan consists of, once it is read."""

    points: Floats
    normals: Floats | None
    views: tuple[View, ...]


class Scene:
    """A scan with its truth; read when its points are first asked for.

    Attributes
    ----------
    name : str
        Tells it from the others of its data set.
    ids : tuple of int
        ``(scene_id, im_id)`` in BOP; numbers of scene and view in ROBI; empty elsewhere.
    parts : tuple of Part
        The kinds of parts to look for.
    has_truth : bool
        Whether ``parts`` have the poses of all copies.
    """

    def __init__(
        self,
        name: str,
        parts: tuple[Part, ...],
        read: Callable[[], Held],
        *,
        ids: tuple[int, ...] = (),
        has_truth: bool = True,
    ) -> None:
        self.name, self.parts, self.ids, self.has_truth = name, parts, ids, has_truth
        self._read = read

    @cached_property
    def _held(self) -> Held:
        return self._read()

    @property
    def points(self) -> Floats:
        """(N, 3), data units; in BOP and ROBI in the frame of the camera, of several that of the first."""
        return self._held.points

    @property
    def normals(self) -> Floats | None:
        """(N, 3), outwards, where the data are a surface; else None."""
        return self._held.normals

    @property
    def views(self) -> tuple[View, ...]:
        """Of each camera its place and all that it measured; none where the cameras are not known."""
        return self._held.views

    @property
    def viewpoint(self) -> View | tuple[View, ...] | None:
        """As :meth:`ibi_rs.Model.detect` takes it."""
        return (self.views if len(self.views) > 1 else self.views[0]) if self.views else None

    @property
    def inputs(self) -> dict[str, Any]:
        """What :meth:`ibi_rs.Model.detect` wants of a scan: ``model.detect(**scene.inputs)``."""
        return {"tgt": self.points, "tgt_normals": self.normals, "viewpoint": self.viewpoint}

    def __repr__(self) -> str:
        held = ", ".join(f"{len(part.poses)} of {part.kind.name}" for part in self.parts)
        return f"Scene({self.name!r}: {held if self.has_truth else 'truth not known'})"

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what can be read again."""
        return {name: value for name, value in self.__dict__.items() if name != "_held"}


def folder(path: Any, what: str) -> Path:
    """Return a folder that is there, or raise InputError."""
    held = Path(path)
    if not held.is_dir():
        raise InputError(f"{held}: there is no such folder; {what} is wanted")
    return held


def object_of(path: Path, kind: type = dict) -> Any:
    """Read JSON of one kind, dict or list."""
    held = read_json(path)
    if not isinstance(held, kind):
        wanted = "object" if kind is dict else "list"
        raise InputError(f"{path}: must be a JSON {wanted}, not {type(held).__name__}")
    return held


def numbers(path: Path, entry: Any, key: str, *shape: int) -> Floats:
    """Finite numbers of an entry in a JSON file, in this shape."""
    try:
        array = np.asarray(entry[key], np.float64)
    except KeyError:
        raise InputError(f"{path}: an entry has no {key!r}") from None
    except (TypeError, ValueError):
        raise InputError(f"{path}: {key!r} must be numbers") from None
    if array.size != int(np.prod(shape)) or not np.isfinite(array).all():
        raise InputError(f"{path}: {key!r} must be {int(np.prod(shape))} finite numbers")
    return array.reshape(shape)


def rigid(path: Path, key: str, rotation: Floats, translation: Floats) -> Floats:
    """(4, 4) of a rotation, which may be rounded, and a translation."""
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-2 or np.linalg.det(rotation) < 0:
        raise InputError(f"{path}: {key!r} is no rotation")
    u, _, vt = np.linalg.svd(rotation)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = u @ vt, np.ravel(translation)
    return pose


def inverse(pose: Floats) -> Floats:
    """Of a rigid motion."""
    back = np.eye(4)
    back[:3, :3], back[:3, 3] = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]
    return back


def stacked(poses: list[Floats]) -> Floats:
    """(K, 4, 4), also of none."""
    return np.array(poses, np.float64).reshape(-1, 4, 4)
