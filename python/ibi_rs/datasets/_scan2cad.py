"""Scan2CAD: scanned rooms of ScanNet, with models of ShapeNet at the places of the furniture."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ibi_rs import io
from ibi_rs._core import InputError
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

_MESHES = ("{0}_vh_clean_2.ply", "{0}_vh_clean.ply")
_TURNS = {"__SYM_NONE": 1, "__SYM_ROTATE_UP_2": 2, "__SYM_ROTATE_UP_4": 4, "__SYM_ROTATE_UP_INF": 0}
_SAME_SCALE = 0.1
"""How far the scales of copies of one model may be apart, per axis, to be one model."""
_ROUND = 0.05
"""How far the scales of the two axes across may be apart where a quarter turn leaves a model the same."""


class Scan2Cad(Lazy[Scene]):
    """Rooms with several copies of one model: a sequence, a :class:`Scene` for each room and model.

    Lengths are metres, in the frame of the scan's mesh, whose vertices are the points, with their normals.
    Its labels have nine degrees of freedom. A model is scaled along its axes before it is placed: copies of
    one model whose scales are within a tenth of one another's, along each axis, are one, of the median scale;
    others are not of this scene. The camera's way is not read, so a scene has no ``views``.

    Symmetries are those annotated, turns about the model's y, as far as the scales across leave them.

    Parameters
    ----------
    annotations : path
        ``full_annotations.json``.
    scannet : path
        Folder of ScanNet with ``SCENE/SCENE_vh_clean_2.ply``, or ``scans`` in it with these.
    shapenet : path
        Folder of ShapeNetCore.v2 with ``CATEGORY/MODEL/models/model_normalized.obj``.
    min_copies : int, default 2
        Rooms with fewer copies of a model are left out. The paper takes rooms with several.
    skip_missing : bool, default False
        Leave out scenes of which a mesh is not there, instead of raising an error.

    Raises
    ------
    InputError
        A folder or file is not there, or is not what Scan2CAD says; the message names it.

    References
    ----------
    Avetisyan et al., "Scan2CAD: Learning CAD model alignment in RGB-D scans", CVPR 2019.
    """

    def __init__(
        self,
        annotations: PathLike,
        scannet: PathLike,
        shapenet: PathLike,
        *,
        min_copies: int = 2,
        skip_missing: bool = False,
    ) -> None:
        self._path = Path(annotations)
        scans, self._shapes = folder(scannet, "that of ScanNet"), folder(shapenet, "that of ShapeNet")
        self._scans = scans / "scans" if (scans / "scans").is_dir() else scans
        self._found: list[tuple[str, Kind, Floats]] = []
        for entry in object_of(self._path, list):
            self._found += self._of_room(entry, min_copies, skip_missing)

    def _of_room(self, entry: Any, min_copies: int, skip_missing: bool) -> list[tuple[str, Kind, Floats]]:
        try:
            room, listed, scan = str(entry["id_scan"]), list(entry["aligned_models"]), entry["trs"]
        except (KeyError, TypeError):
            raise InputError(f"{self._path}: an entry lacks id_scan, trs or aligned_models") from None
        if skip_missing and self._mesh(room) is None:
            return []
        scan_from_world, shrink = self._scan_from_world(scan)
        copies: dict[tuple[str, str], list[tuple[Floats, Floats, str]]] = {}
        for model in listed:
            try:
                key = str(model["catid_cad"]), str(model["id_cad"])
                pose, scale = self._placed(model["trs"])
            except (KeyError, TypeError):
                raise InputError(f"{self._path}: a model of {room} lacks catid_cad, id_cad or trs") from None
            # The scan's own scale is one number, so it moves through the rotation.
            moved = scan_from_world @ pose
            moved[:3, 3] = shrink * (scan_from_world[:3, :3] @ pose[:3, 3]) + scan_from_world[:3, 3]
            copies.setdefault(key, []).append((moved, shrink * scale, str(model.get("sym", "__SYM_NONE"))))
        found = []
        for (category, model_id), held in sorted(copies.items()):
            scales = np.array([scale for _, scale, _ in held])
            median = np.median(scales, axis=0)
            is_same = (np.abs(scales / median - 1) <= _SAME_SCALE).all(axis=1)
            poses = stacked([pose for (pose, _, _), same in zip(held, is_same, strict=True) if same])
            path = self._shapes / category / model_id / "models" / "model_normalized.obj"
            if len(poses) < max(1, min_copies) or (skip_missing and not path.is_file()):
                continue
            scale = np.median(scales[is_same], axis=0)
            turns = self._symmetries(held[0][2], scale)
            found.append((room, Kind(f"{category}/{model_id}", path, symmetries=turns, scale=scale), poses))
        return found

    def _mesh(self, room: str) -> Path | None:
        named = (self._scans / room / name.format(room) for name in _MESHES)
        return next((path for path in named if path.is_file()), None)

    def _placed(self, trs: Any) -> tuple[Floats, Floats]:
        """Return a rigid motion, and the scales along the axes before it."""
        scale = numbers(self._path, trs, "scale", 3)
        if not (scale > 0).all():
            raise InputError(f"{self._path}: a 'scale' is {scale.tolist()}; it must be above 0")
        turn = _turned(numbers(self._path, trs, "rotation", 4))
        return rigid(self._path, "rotation", turn, numbers(self._path, trs, "translation", 3)), scale

    def _scan_from_world(self, trs: Any) -> tuple[Floats, float]:
        """Return what leads from the world of the labels back to the scan: a rigid motion, after a scale."""
        world_from_scan, scale = self._placed(trs)
        if np.ptp(scale) > 1e-3 * scale.max():
            raise InputError(f"{self._path}: a scan is scaled by {scale.tolist()}, not alike along its axes")
        shrink = 1 / float(scale.mean())
        back = inverse(world_from_scan)
        back[:3, 3] *= shrink
        return back, shrink

    def _symmetries(self, said: str, scale: Floats) -> Symmetries:
        if said not in _TURNS:
            raise InputError(f"{self._path}: 'sym' is {said!r}; it must be of {', '.join(_TURNS)}")
        turns, is_round = _TURNS[said], abs(scale[0] / scale[2] - 1) <= _ROUND
        if turns == 0 and is_round:
            return Symmetries(continuous=[([0, 1, 0], [0, 0, 0])])
        turns = turns if is_round and turns else min(turns or 2, 2)
        angles = 2 * np.pi * np.arange(1, turns) / max(turns, 1)
        return Symmetries(stacked([_about_y(angle) for angle in angles]))

    def __len__(self) -> int:
        return len(self._found)

    def _item(self, index: int) -> Scene:
        room, kind, poses = self._found[index]
        path = self._mesh(room) or self._scans / room / _MESHES[0].format(room)
        part = Part(kind, poses, np.full(len(poses), np.nan))
        return Scene(f"{room}/{kind.name}", (part,), partial(_surface, path))

    def __repr__(self) -> str:
        return f"Scan2Cad({len({room for room, _, _ in self._found})} rooms, {len(self)} scenes)"


def _turned(quaternion: Floats) -> Floats:
    """Return the rotation of (w, x, y, z)."""
    length = float(np.linalg.norm(quaternion))
    if length == 0:
        return np.zeros((3, 3))
    w, x, y, z = quaternion / length
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn: Floats = np.eye(3) + 2 * w * across + 2 * across @ across
    return turn


def _about_y(angle: float) -> Floats:
    pose = np.eye(4)
    pose[0, 0] = pose[2, 2] = np.cos(angle)
    pose[0, 2], pose[2, 0] = np.sin(angle), -np.sin(angle)
    return pose


def _surface(path: Path) -> Held:
    vertices, faces = io.read_mesh(path)
    return Held(vertices, _normals(vertices, faces), ())


def _normals(vertices: Floats, faces: npt.NDArray[np.int64]) -> Floats:
    """Of each vertex the mean of its faces' normals, by area; (0, 0, 0) where it has no face."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    across = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for i in range(3):
        np.add.at(normals, faces[:, i], across)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    unit: Floats = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    return unit
