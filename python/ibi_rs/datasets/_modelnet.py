"""ModelNet40: meshes of forty categories."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ibi_rs import io
from ibi_rs._core import InputError
from ibi_rs._inputs import _frozen
from ibi_rs.datasets._scene import Floats, Kind, Lazy, folder
from ibi_rs.io._reading import PathLike


class _Shape(Kind):
    @cached_property
    def mesh(self) -> tuple[Floats, npt.NDArray[np.int64]]:
        """Centred, and as large as the unit sphere."""
        vertices, faces = io.read_mesh(self.path)
        used = vertices[np.unique(faces)]
        centre = (used.min(axis=0) + used.max(axis=0)) / 2
        radius = float(np.linalg.norm(used - centre, axis=1).max())
        if radius == 0:
            raise InputError(f"{self.path}: all its vertices are one point")
        return _frozen((vertices - centre) / radius), _frozen(faces)


class ModelNet40(Lazy[Kind]):
    """The meshes of ModelNet, scaled into the unit sphere: a sequence of :class:`Kind`, each "chair_0001".

    There are no scenes: place copies with :mod:`ibi_rs.synth`. The middle of a mesh's box is at the origin,
    and its farthest vertex at a distance of 1.

    Parameters
    ----------
    root : path
        Folder with one for each category, of which each has ``train`` and ``test`` with OFF files.
    split : {"train", "test"}
        Which half.
    categories : sequence of str, optional
        Only these; by default all that are there.

    Raises
    ------
    InputError
        A folder is not there, or has no such files.

    References
    ----------
    Wu et al., "3D ShapeNets: A deep representation for volumetric shapes", CVPR 2015.

    Examples
    --------
    >>> from ibi_rs import datasets
    >>> chairs = datasets.ModelNet40("ModelNet40", split="test", categories=["chair"])   # doctest: +SKIP
    >>> points, normals = ibi.features.sample_mesh(*chairs[0].mesh, n=2048)              # doctest: +SKIP
    """

    def __init__(
        self, root: PathLike, *, split: str = "test", categories: Sequence[str] | None = None
    ) -> None:
        self.root = folder(root, "that of ModelNet40")
        if split not in ("train", "test"):
            raise InputError(f"split is {split!r}; it must be 'train' or 'test'")
        if categories is None:
            categories = sorted(path.parent.name for path in self.root.glob(f"*/{split}") if path.is_dir())
        self._files: list[Path] = []
        for category in categories:
            self._files += sorted(folder(self.root / category / split, "a category").glob("*.off"))
        if not self._files:
            raise InputError(f"{self.root}: there is no CATEGORY/{split} with OFF files")

    def __len__(self) -> int:
        return len(self._files)

    def _item(self, index: int) -> Kind:
        path = self._files[index]
        return _Shape(path.stem, path)

    def __repr__(self) -> str:
        return f"ModelNet40({self.root}: {len(self)} meshes)"
