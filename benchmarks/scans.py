"""The real scans as scenes: those shipped as examples, or all that are labelled, from a folder of scans.

Lengths are scaled so that the model has radius 1 about its middle, as in the synthetic layouts: several peers
are set in these units. The camera is at the origin.
"""

from __future__ import annotations

import json
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from ibi_rs import synth
from numpy.typing import NDArray

EXAMPLES = Path(__file__).parents[1] / "examples"
SHIPPED = {"tee6": "tee", "two": "provete2", "multi": "provete2"}
# Folder of the scans, voxel in metres, FPFH radius in voxels: those of the examples.
ALL = {
    "tee4": ("real_zju_tee", 0.003, 6),
    "tee6": ("real_zju_tee", 0.003, 6),
    "tee10a": ("real_zju_tee", 0.003, 6),
    "two": ("real_provete2", 0.004, 5),
    "multi": ("real_provete2", 0.004, 5),
}
COMPLETE = ("tee4", "tee6", "two")
"""Scans with a label on each part that can be seen: elsewhere a pose without a label may well be right."""


@cache
def shipped_scan(name: str) -> synth.Scene:
    """Read one of the shipped scans."""
    with np.load(EXAMPLES / SHIPPED[name] / f"{name}.npz") as data:
        return _scene(name, dict(data))


@cache
def scan(name: str, root: Path) -> synth.Scene:
    """Match one of the labelled scans with its model, as examples/make_matches.py does."""
    sys.path.insert(0, str(EXAMPLES))
    import make_matches as mm

    folder, voxel, radius = ALL[name]
    where = root / folder
    model = mm.downsampled_model(next(where.glob("model_*_pts.ply")), voxel)
    scene = mm.downsampled_scene(where / f"{name}.ply", voxel)
    corr, similarity = mm.match(mm.fpfh(model, radius * voxel), mm.fpfh(scene, radius * voxel), k=2)
    labels = json.loads((where / "gt_pseudo.json").read_text(encoding="utf-8"))["scenes"][name]["instances"]
    data = {
        "src": np.asarray(model.points),
        "tgt": np.asarray(scene.points),
        "src_normals": np.asarray(model.normals),
        "tgt_normals": np.asarray(scene.normals),
        "corr": corr,
        "similarity": similarity,
        "poses": np.array([label["T"] for label in labels]),
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
