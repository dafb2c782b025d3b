"""ROBI: reflective parts in bins, from many viewpoints."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from ibi_rs._core import InputError
from ibi_rs.datasets._bop import depth_view
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
from ibi_rs.io._reading import PathLike, reading

_LENS = ("fx", "fy", "cx", "cy", "depth_unit")


class Robi(Lazy[Scene]):
    """The views of one object in ROBI: a sequence of depth images, each a :class:`Scene`.

    Lengths are millimetres; points are in the frame of the camera. ``ids`` are the numbers of scene and view.

    Parameters
    ----------
    root : path
        Folder with one for each object: ``Zigzag/Scene_1/Ensenso/Depth/DEPTH_view_0.png``.
    part : str
        Folder of the object: "Zigzag", "Gear" ...
    mesh : path
        Its CAD model, in millimetres, which lies elsewhere.
    camera : path, optional
        Lines ``fx: 1083.1`` and so on, with ``fy``, ``cx``, ``cy`` and ``depth_unit``, the millimetres of one
        unit of depth. By default ``cam/SENSOR_DEPTH.yml`` in ``root``, as its toolkit has them.
    sensor : {"Ensenso", "RealSense"}
        Which camera.
    scenes : sequence of int, optional
        Only these; by default all that are there.

    Raises
    ------
    InputError
        A folder or file is not there, or is not what ROBI says; the message names it.

    References
    ----------
    Yang et al., "ROBI: A multi-view dataset for reflective objects in robotic bin-picking", IROS 2021.
    """

    def __init__(
        self,
        root: PathLike,
        part: str,
        mesh: PathLike,
        *,
        camera: PathLike | None = None,
        sensor: str = "Ensenso",
        scenes: Sequence[int] | None = None,
    ) -> None:
        self.root, self._sensor = folder(folder(root, "that of ROBI") / part, "an object of ROBI"), sensor
        self._kind = Kind(part, Path(mesh))
        self._lens = _lens(Path(root) / "cam" / f"{sensor}_DEPTH.yml" if camera is None else Path(camera))
        if scenes is None:
            names = (path.name.removeprefix("Scene_") for path in self.root.glob("Scene_*"))
            scenes = sorted(int(name) for name in names if name.isdecimal())
        self._views = [(int(i), view) for i in scenes for view in self._listed(int(i))]
        if not self._views:
            raise InputError(f"{self.root}: there is no Scene_1 with views of {sensor}")

    def _depth(self, scene: int) -> Path:
        return folder(self.root / f"Scene_{scene}" / self._sensor / "Depth", "the depth of a scene of ROBI")

    def _listed(self, scene: int) -> list[int]:
        names = (
            path.stem.removeprefix("DEPTH_view_") for path in self._depth(scene).glob("DEPTH_view_*.png")
        )
        return sorted(int(name) for name in names if name.isdecimal())

    def __len__(self) -> int:
        return len(self._views)

    def _item(self, index: int) -> Scene:
        scene, view = self._views[index]
        image = self._depth(scene) / f"DEPTH_view_{view}.png"
        world_from_camera = _pose(image.with_suffix(".json"), "cam_pose")
        path = self.root / f"Scene_{scene}" / "GT_world2obj.json"
        world_from_object = [_pose(path, name) for name in object_of(path)]
        poses = stacked([inverse(world_from_camera) @ pose for pose in world_from_object])
        part = Part(self._kind, poses, np.full(len(poses), np.nan))
        read = partial(_scan, image, self._lens)
        return Scene(f"{self.root.name}/Scene_{scene}/view_{view}", (part,), read, ids=(scene, view))

    def __repr__(self) -> str:
        return f"Robi({self.root.name}, {self._sensor}: {len(self)} views)"


def _pose(path: Path, key: str) -> Floats:
    matrix = numbers(path, object_of(path), key, 4, 4)
    return rigid(path, key, matrix[:3, :3], matrix[:3, 3])


def _scan(image: Path, lens: Sequence[float]) -> Held:
    fx, fy, cx, cy, unit = lens
    view = depth_view(image, fx, fy, cx, cy, unit, np.eye(4))
    return Held(view.points, None, (view,))


def _lens(path: Path) -> tuple[float, ...]:
    """Read focal lengths, principal point, and what a unit of depth is."""

    def read() -> tuple[float, ...]:
        lines = (line.partition(":") for line in path.read_text(encoding="utf-8").splitlines())
        held = {name.strip(): value.strip() for name, colon, value in lines if colon}
        missing = [name for name in _LENS if name not in held]
        if missing:
            raise InputError(f"lacks {', '.join(missing)}")
        return tuple(float(held[name]) for name in _LENS)

    return reading(path, read)
