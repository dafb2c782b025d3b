"""BOP: images of depth cameras with the poses of known objects."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ibi_rs import io
from ibi_rs._core import InputError
from ibi_rs._view import View
from ibi_rs.datasets._scene import (
    Floats,
    Held,
    Kind,
    Lazy,
    Part,
    Scene,
    folder,
    inverse,
    numbers,
    object_of,
    rigid,
    stacked,
)
from ibi_rs.io._reading import PathLike
from ibi_rs.symmetries import Symmetries

_MODELS = ("models", "models_cad", "models_eval")
_TARGETS = ("test_targets_bop19.json", "test_targets_bop24.json", "test_targets_multiview_bop25.json")
_SUFFIXES = (".png", ".tif", ".tiff")


class Bop(Lazy[Scene]):
    """A data set in the folders of BOP: a sequence of images, each a :class:`Scene`.

    Lengths are millimetres. A scene's points are those of its depth image, in the frame of the camera, and
    its ``ids`` are ``(scene_id, im_id)``. A kind's name is its ``obj_id``; its symmetries and diameter are
    those of ``models_info.json``, and errors are measured by ``models_eval`` where there is one.

    Parameters
    ----------
    root : path
        Folder of the data set, with ``models`` and ``test`` in it.
    split : str, default "test"
        Folder of the images: "test", "val", "test_primesense", "train_pbr" ...
    camera : str or sequence of str, optional
        Of sets with several cameras: "photoneo" reads ``scene_camera_photoneo.json`` and ``depth_photoneo``.
        Of several cameras the points of all are one scan, in the frame of the first; their places are those
        of ``cam_R_w2c`` and ``cam_t_w2c``. By default the one that has no name, or the only one.
    models : str, optional
        Folder of the meshes; by default the first there is of ``models``, ``models_cad``, ``models_eval``.
    targets : path or "all", optional
        File of the images, and perhaps the objects, that are to be looked at: a name in ``root``, or a path.
        By default the first there is of ``test_targets_bop19.json``, ``test_targets_bop24.json`` and
        ``test_targets_multiview_bop25.json`` for a split whose name begins with "test", else "all": all
        images. Where it names no objects, a scene has all of the data set.
    objects : sequence of int, optional
        Only these.

    Raises
    ------
    InputError
        A folder or file is not there, or is not what BOP says; the message names it.
    TypeError
        An argument is of another type than above.

    References
    ----------
    Hodan et al., "BOP: Benchmark for 6D object pose estimation", ECCV 2018, and its description of formats.

    Examples
    --------
    >>> from ibi_rs import datasets
    >>> scenes = datasets.Bop("bop/ipd", split="val", camera="photoneo")          # doctest: +SKIP
    >>> scenes[0].parts                                                            # doctest: +SKIP
    (Part('8', 3 copies),)
    """

    def __init__(
        self,
        root: PathLike,
        *,
        split: str = "test",
        camera: str | Sequence[str] | None = None,
        models: str | None = None,
        targets: PathLike | None = None,
        objects: Sequence[int] | None = None,
    ) -> None:
        self.root = folder(root, "that of a BOP data set")
        self._images = folder(self.root / split, f"the split {split!r} of a BOP data set")
        names = _MODELS if models is None else (models,)
        held = [self.root / name for name in names if (self.root / name / "models_info.json").is_file()]
        if not held:
            raise InputError(f"{self.root}: there is no {' or '.join(names)} with a models_info.json")
        self.models, self.split = held[0], split
        self._info = object_of(self.models / "models_info.json")
        self._cameras = self._found_cameras(camera)
        self._objects = None if objects is None else [int(one) for one in objects]
        for one in self._objects or ():
            self._entry(one)
        self._targets = self._found_targets(targets)

    # Which cameras, images and objects ---------------------------------------------------------------------

    @cached_property
    def _scene_ids(self) -> list[int]:
        return sorted(int(path.name) for path in self._images.iterdir() if path.name.isdecimal())

    def _found_cameras(self, camera: str | Sequence[str] | None) -> tuple[str, ...]:
        """Suffixes of the cameras' files: "" or "_NAME"."""
        if not self._scene_ids:
            raise InputError(f"{self._images}: there are no folders of scenes in it, such as 000000")
        first = self._folder(self._scene_ids[0])
        there = sorted(path.stem.removeprefix("scene_camera") for path in first.glob("scene_camera*.json"))
        if not there:
            raise InputError(f"{first}: there is no scene_camera.json")
        if camera is None:
            if "" not in there and len(there) > 1:
                choice = ", ".join(one[1:] for one in there)
                raise InputError(f"{first}: there are several cameras; camera must be of {choice}")
            return ("",) if "" in there else (there[0],)
        wanted = [f"_{one}" for one in ([camera] if isinstance(camera, str) else camera)]
        for one in wanted:
            if one not in there:
                choice = ", ".join(name[1:] for name in there if name) or "none with a name"
                raise InputError(f"{first}: there is no camera {one[1:]!r}; there are {choice}")
        if not wanted:
            raise InputError("camera must name at least one")
        return tuple(wanted)

    def _found_targets(self, targets: PathLike | None) -> list[tuple[int, int, dict[int, int | None]]]:
        """Images, and of each the objects with how many copies are asked for; by scene and image."""
        path = None if targets is None else Path(targets)
        if path is None and self.split.startswith("test"):
            path = next((self.root / name for name in _TARGETS if (self.root / name).is_file()), None)
        if path is None or str(path) == "all":
            listed = [(i, int(j)) for i in self._scene_ids for j in self._camera_file(i, self._cameras[0])]
            return [(i, j, self._all()) for i, j in sorted(listed)]
        path = path if path.is_file() else self.root / path
        found: dict[tuple[int, int], dict[int, int | None]] = {}
        for entry in object_of(path, list):
            try:
                image = int(entry["scene_id"]), int(entry["im_id"])
                of_image = found.setdefault(image, {})
                if "obj_id" in entry:
                    count = entry.get("inst_count")
                    of_image[int(entry["obj_id"])] = None if count is None else int(count)
            except (KeyError, TypeError, ValueError):
                raise InputError(f"{path}: an entry lacks a number scene_id or im_id") from None
        listed_all = ((*image, of_image or self._all()) for image, of_image in sorted(found.items()))
        chosen = self._objects
        if chosen is None:
            return list(listed_all)
        kept = ((i, j, {k: n for k, n in of.items() if k in chosen}) for i, j, of in listed_all)
        return [image for image in kept if image[2]]

    def _all(self) -> dict[int, int | None]:
        names = sorted(int(name) for name in self._info) if self._objects is None else self._objects
        return dict.fromkeys(names)

    # Files -------------------------------------------------------------------------------------------------

    def _folder(self, scene_id: int) -> Path:
        named = (path for path in (self._images / f"{scene_id:06d}", self._images / str(scene_id)))
        missing = self._images / f"{scene_id:06d}"
        return folder(next((path for path in named if path.is_dir()), missing), "a scene")

    def _camera_file(self, scene_id: int, suffix: str) -> dict[str, Any]:
        return self._json(scene_id, f"scene_camera{suffix}.json")

    def _json(self, scene_id: int, name: str) -> dict[str, Any]:
        path = self._folder(scene_id) / name
        if path not in self._read:
            if len(self._read) > 8:  # of few scenes at a time: those of training sets are large
                self._read.pop(next(iter(self._read)))
            self._read[path] = object_of(path)
        return self._read[path]

    @cached_property
    def _read(self) -> dict[Path, dict[str, Any]]:
        return {}

    def _entry(self, obj_id: int) -> dict[str, Any]:
        entry = self._info.get(str(obj_id))
        if not isinstance(entry, dict):
            raise InputError(f"{self.models / 'models_info.json'}: has no object {obj_id}")
        return entry

    @cached_property
    def _kinds(self) -> dict[int, Kind]:
        return {}

    def kind(self, obj_id: int) -> Kind:
        """Return a kind of part; the same one for all scenes.

        Parameters
        ----------
        obj_id : int
            Its number.

        Returns
        -------
        Kind

        Raises
        ------
        InputError
            There is no such object.
        """
        if obj_id not in self._kinds:
            info, name = self.models / "models_info.json", f"obj_{obj_id:06d}.ply"
            entry = self._entry(obj_id)
            surface = self.root / "models_eval" / name
            self._kinds[obj_id] = Kind(
                str(obj_id),
                self.models / name,
                symmetries=Symmetries.from_bop(entry),
                diameter=float(numbers(info, entry, "diameter", 1)[0]) if "diameter" in entry else None,
                surface=surface if surface.is_file() else None,
            )
        return self._kinds[obj_id]

    @property
    def ids(self) -> tuple[tuple[int, int], ...]:
        """(scene_id, im_id) of each image."""
        return tuple((scene_id, im_id) for scene_id, im_id, _ in self._targets)

    @property
    def objects(self) -> tuple[int, ...]:
        """Numbers of all objects that are looked for in any image."""
        return tuple(sorted({obj_id for _, _, objects in self._targets for obj_id in objects}))

    # Scenes ------------------------------------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self._targets)

    def _item(self, index: int) -> Scene:
        scene_id, im_id, objects = self._targets[index]
        truth = self._truth(scene_id, im_id)
        parts = []
        for obj_id, count in objects.items():
            own = [(pose, seen) for of, pose, seen in truth or () if of == obj_id]
            poses, seen = stacked([pose for pose, _ in own]), np.array([one for _, one in own], np.float64)
            parts.append(Part(self.kind(obj_id), poses, seen, count))
        read = partial(self._scan, scene_id, im_id)
        name = f"{scene_id:06d}/{im_id:06d}"
        return Scene(name, tuple(parts), read, ids=(scene_id, im_id), has_truth=truth is not None)

    def _truth(self, scene_id: int, im_id: int) -> list[tuple[int, Floats, float]] | None:
        """Give all labelled objects: number, pose, visible share."""
        suffix = self._cameras[0]
        path = self._folder(scene_id) / f"scene_gt{suffix}.json"
        if not path.is_file():
            return None
        entries = self._json(scene_id, path.name).get(str(im_id), [])
        info = path.with_name(f"scene_gt_info{suffix}.json")
        seen = self._json(scene_id, info.name).get(str(im_id), []) if info.is_file() else []
        if seen and len(seen) != len(entries):
            raise InputError(f"{info}: image {im_id} has {len(seen)} entries, {path.name} {len(entries)}")
        truth = []
        for k, entry in enumerate(entries):
            motion = numbers(path, entry, "cam_R_m2c", 3, 3), numbers(path, entry, "cam_t_m2c", 3)
            share = float(numbers(info, seen[k], "visib_fract", 1)[0]) if seen else np.nan
            obj_id = int(numbers(path, entry, "obj_id", 1)[0])
            truth.append((obj_id, rigid(path, "cam_R_m2c", *motion), share))
        return truth

    def _scan(self, scene_id: int, im_id: int) -> Held:
        views, first_from_world = [], None
        for suffix in self._cameras:
            path = self._folder(scene_id) / f"scene_camera{suffix}.json"
            entry = self._camera_file(scene_id, suffix).get(str(im_id))
            if entry is None:
                raise InputError(f"{path}: has no image {im_id}")
            first_from_camera = np.eye(4)
            if len(self._cameras) > 1:
                motion = numbers(path, entry, "cam_R_w2c", 3, 3), numbers(path, entry, "cam_t_w2c", 3)
                camera_from_world = rigid(path, "cam_R_w2c", *motion)
                if first_from_world is None:
                    first_from_world = camera_from_world
                first_from_camera = first_from_world @ inverse(camera_from_world)
            views.append(self._view(path, entry, suffix, im_id, first_from_camera))
        points = views[0].points if len(views) == 1 else np.concatenate([view.points for view in views])
        return Held(points, None, tuple(views))

    def _view(self, path: Path, entry: Any, suffix: str, im_id: int, motion: Floats) -> View:
        lens = numbers(path, entry, "cam_K", 3, 3)
        scale = float(numbers(path, entry, "depth_scale", 1)[0]) if "depth_scale" in entry else 1.0
        images = path.parent / f"depth{suffix}"
        named = [images / f"{im_id:06d}{ending}" for ending in _SUFFIXES]
        image = next((one for one in named if one.is_file()), named[0])
        return depth_view(image, lens[0, 0], lens[1, 1], lens[0, 2], lens[1, 2], scale, motion)

    def __repr__(self) -> str:
        cameras = ", ".join(one[1:] for one in self._cameras if one)
        of = f", {cameras}" if cameras else ""
        return f"Bop({self.root.name}, {self.split}{of}: {len(self)} images, {len(self._info)} objects)"

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what can be read again."""
        return {name: value for name, value in self.__dict__.items() if name not in ("_read", "_kinds")}


def depth_view(
    path: Path, fx: float, fy: float, cx: float, cy: float, scale: float, motion: npt.ArrayLike
) -> View:
    """Read a depth image as what a camera saw, in the frame that the motion leads to."""
    points = io.read_depth(path, fx, fy, cx, cy, scale=scale)
    pose = np.asarray(motion, np.float64)
    if (pose == np.eye(4)).all():
        return View(np.zeros(3), points)
    return View(pose[:3, 3], points @ pose[:3, :3].T + pose[:3, 3])
