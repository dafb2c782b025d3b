"""Real scans, as registration problems and as clouds to detect parts in; and ray-cast piles like these.

Real are those shipped as examples, or all that are labelled, from a folder of scans: IBI_DATA. As scenes
their lengths are scaled so that the model has radius 1 about its middle, as in the synthetic layouts: several
peers are set in these units. The camera is at the origin.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

import ibi_rs as ibi
import numpy as np
from ibi_rs import synth
from numpy.typing import NDArray

from .records import ROOT
from .timing import timed

EXAMPLES = ROOT / "examples"
FOLDER = Path(os.environ["IBI_DATA"]) if "IBI_DATA" in os.environ else None
"""The folder of all labelled scans, if it is there."""


@dataclass(frozen=True)
class Scan:
    """Where a labelled scan lies, and how its matches are made.

    Attributes
    ----------
    folder : str
        In the folder of all scans.
    mesh : str
        The model's, there.
    shipped : str or None
        In the folder of the examples.
    voxel, feature_voxels : float
        Of examples/make_matches.py: metres, and the radius of FPFH in voxels. None: not matched by it.
    is_complete : bool
        Whether each part that can be seen has a label: elsewhere a pose without one may well be right.
    file : str
        The scan's name there; empty: as here.
    symmetries : ibi_rs.Symmetries
        Of the model, as it is in its file.
    """

    folder: str
    mesh: str
    shipped: str | None = None
    voxel: float | None = None
    feature_voxels: float | None = None
    is_complete: bool = False
    file: str = ""
    symmetries: ibi.Symmetries = field(default_factory=ibi.Symmetries.none)


def _half_turn_about_y(x: float, z: float) -> ibi.Symmetries:
    return ibi.Symmetries([[[-1, 0, 0, 2 * x], [0, 1, 0, 0], [0, 0, -1, 2 * z], [0, 0, 0, 1]]])


_TEE = partial(Scan, "real_zju_tee", "model_tee_mesh.ply", symmetries=_half_turn_about_y(0.017, 0.031))
_BOX = partial(Scan, "real_provete2", "model_provete2_mesh.ply", "provete2", 0.004, 5)
SCANS = {
    "tee4": _TEE(None, 0.003, 6, is_complete=True),
    "tee6": _TEE("tee", 0.003, 6, is_complete=True),
    "tee10a": _TEE(None, 0.003, 6),
    "tee16": _TEE(),
    "two": _BOX(is_complete=True),
    "multi": _BOX(),
    "Sileane": Scan("real_sileane_markers", "model_bunny.ply", file="scene"),
}
ALL = [name for name, scan in SCANS.items() if scan.voxel is not None]
"""Those that are registered with matches made beforehand."""
SHIPPED = [name for name in ALL if SCANS[name].shipped is not None]


def labels(folder: Path, name: str) -> NDArray[np.float64]:
    """Return the labelled poses of a scan, (K, 4, 4)."""
    held = json.loads((folder / "gt_pseudo.json").read_text(encoding="utf-8"))
    instances = held["scenes"][name]["instances"] if "scenes" in held else held["instances"]
    return np.array([instance["T"] for instance in instances])


# Clouds ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """A scan with its truth, camera at the origin.

    Attributes
    ----------
    data : {"pile", "scan"}
    name : str
        The shape's or the scan's.
    seed : int or None
    mesh : (V, 3) float64 and (F, 3) int64
    points : (N, 3) float64
    poses : (K, 4, 4) float64
    visibility : (K,) float64
        All 1 in scans, whose labels are of parts in sight.
    is_complete : bool
        Whether all parts are labelled: precision means nothing elsewhere.
    """

    data: str
    name: str
    seed: int | None
    mesh: tuple[NDArray[np.float64], NDArray[np.int64]]
    points: NDArray[np.float64]
    poses: NDArray[np.float64]
    visibility: NDArray[np.float64]
    is_complete: bool = True


def pile(path: Path, seed: int) -> Case:
    """Make a pile of one mesh."""
    mesh = ibi.io.read_mesh(path)
    made = synth.pile_scene(*mesh, seed=seed)
    return Case("pile", path.stem, seed, mesh, made.points, made.poses, made.visibility)


def real() -> Iterator[Case]:
    """Read the real scans that can be had."""
    for name, scan in SCANS.items():
        if not FOLDER and not scan.shipped:
            continue
        folder = FOLDER / scan.folder if FOLDER else EXAMPLES / str(scan.shipped)
        mesh = ibi.io.read_mesh(folder / scan.mesh)
        points, _ = ibi.io.read_cloud(folder / f"{scan.file or name}.ply")
        poses = labels(folder, name)
        yield Case("scan", name, None, mesh, points, poses, np.ones(len(poses)), scan.is_complete)


@dataclass(frozen=True)
class Detection:
    """What `Model` finds in a scan on the way from its mesh, and the seconds: medians of the repeats.

    `detect_s` is of all after the model, `search_s` of what follows the correspondences.
    """

    model: ibi.Model
    matches: ibi.Matches
    found: ibi.Registration
    model_s: float
    match_s: float
    detect_s: float
    search_s: float


def detect(case: Case, repeats: int = 1) -> Detection:
    """Detect the parts of a scan."""
    seconds = []
    for _ in range(repeats):
        model_s, model = timed(ibi.Model.from_mesh, *case.mesh)
        match_s, matches = timed(partial(model.correspond, case.points, viewpoint=[0, 0, 0]))
        detect_s, found = timed(partial(model.detect, case.points, viewpoint=[0, 0, 0]))
        seconds.append((model_s, match_s, detect_s, detect_s - match_s))
    return Detection(model, matches, found, *(max(float(of), 0.0) for of in np.median(seconds, axis=0)))


# Scenes ---------------------------------------------------------------------------------------------------


@cache
def shipped_scan(name: str) -> synth.Scene:
    """Read one of the shipped scans."""
    with np.load(EXAMPLES / str(SCANS[name].shipped) / f"{name}.npz") as data:
        return _scene(name, dict(data))


@cache
def scan(name: str, root: Path) -> synth.Scene:
    """Match one of the labelled scans with its model, as examples/make_matches.py does."""
    sys.path.insert(0, str(EXAMPLES))
    import make_matches as mm

    where, voxel, radius = root / SCANS[name].folder, SCANS[name].voxel, SCANS[name].feature_voxels
    model = mm.downsampled_model(next(where.glob("model_*_pts.ply")), voxel)
    scene = mm.downsampled_scene(where / f"{name}.ply", voxel)
    corr, similarity = mm.match(mm.fpfh(model, radius * voxel), mm.fpfh(scene, radius * voxel), k=2)
    data = {
        "src": np.asarray(model.points),
        "tgt": np.asarray(scene.points),
        "src_normals": np.asarray(model.normals),
        "tgt_normals": np.asarray(scene.normals),
        "corr": corr,
        "similarity": similarity,
        "poses": labels(where, name),
    }
    return _scene(name, data)


def _scene(name: str, data: dict[str, NDArray[Any]]) -> synth.Scene:
    src, tgt, poses = (data[key].astype(np.float64) for key in ("src", "tgt", "poses"))
    middle = (src.min(axis=0) + src.max(axis=0)) / 2
    radius = np.linalg.norm(src - middle, axis=1).max()
    poses[:, :3, 3] = (poses[:, :3, 3] + poses[:, :3, :3] @ middle) / radius
    return synth.Scene(
        (src - middle) / radius,
        tgt / radius,
        data["corr"].astype(np.int64),
        poses,
        name,
        similarity=data["similarity"].astype(np.float64),
        src_normals=data["src_normals"].astype(np.float64),
        tgt_normals=data["tgt_normals"].astype(np.float64),
    )
