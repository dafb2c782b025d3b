"""What the commands print and write."""

from __future__ import annotations

import csv
import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

import ibi_rs as ibi
from ibi_rs._files import try_writing, written
from ibi_rs._numbers import lengths
from ibi_rs._written import METRES, quaternion

from .terminal import Printer, misused, out


def try_outputs(outputs: dict[str, Path | None], inputs: dict[str, Path | None]) -> None:
    """See before a run that what it finds can be written, and costs no other file.

    Parameters
    ----------
    outputs, inputs
        Files, by what the command line calls them.
    """
    taken = {os.path.realpath(path): name for name, path in inputs.items() if path is not None}
    for name, path in outputs.items():
        if path is None:
            continue
        if name == "--plot":
            try:
                ibi.plot._format(path)
            except ibi.InputError as error:
                misused(str(error))
        if name == "--html":
            ibi.plot._plotly()
        if name == "--rerun":
            ibi.viz._rerun()
        try_writing(path)
        if path.exists() and not path.is_file():
            continue  # of /dev/null there is no end
        other = taken.setdefault(os.path.realpath(path), name)
        if other != name:
            misused(f"{name} {path}: that is {other}; give another name")


def show(found: ibi.Registration, seconds: float) -> None:
    """Print a table of the poses."""
    table = Table(box=None, pad_edge=False)
    is_of_several = len(found.models) > 1
    for column in ("", *["part"] * is_of_several, "score", "overlap", "inliers", *"xyz", "rx", "ry", "rz"):
        table.add_column(column, justify="left" if column == "part" else "right", no_wrap=True)
    for number, pose in enumerate(found):
        place = lengths(pose.target_from_source[:3, 3], found.resolution)
        turn = [f"{x:.1f}" for x in np.degrees(_rotation_vector(pose.target_from_source[:3, :3]))]
        quality = [f"{pose.score:.2f}", f"{pose.overlap:.2f}", str(pose.num_inliers)]
        name = [escape(str(pose.model_name))] if is_of_several else []
        table.add_row(str(number), *name, *quality, *place, *turn)
    if len(found):
        print_table(table)
        out.print("x, y, z in the unit of the scene; rx, ry, rz: rotation vector, degrees", style="dim")
    counts = ", ".join(f"{len(found.of(name))} {name}" for name in found.models)
    what = f"{len(found)} found ({counts})" if is_of_several else f"{len(found)} found"
    out.print(
        f"{what} in {seconds:.2f} s; stopped by {found.stop_reason}",
        highlight=False,
        markup=False,
    )


def print_table(table: Table) -> None:
    """Print a table as wide as it has to be: half a number is none, and half a path in a pipe."""
    needed = Measurement.get(out, out.options.update(width=10_000), table).maximum
    is_folded = any(column.overflow == "fold" for column in table.columns) and out.is_terminal
    console = out if is_folded else Printer(emoji=False, width=max(needed, out.width))
    console.print(table, crop=False)


def _rotation_vector(rotation: Any) -> Any:
    """Axis times angle, by the quaternion: exact for half turns, too."""
    *axis, cosine = quaternion(rotation)
    sine = float(np.linalg.norm(axis))
    return np.array(axis) * (2 * np.arctan2(sine, cosine) / max(sine, 1e-300))


def sha256(path: Path) -> str:
    """Tell a file's content from any other."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def as_dict(
    found: ibi.Registration,
    seconds: float,
    *,
    model: Path | Sequence[Path],
    model_sha256: str | Sequence[str],
    scene: Path,
    scene_sha256: str,
    search: dict[str, Any],
    unit: str | None = None,
) -> dict[str, Any]:
    """Bring the poses into the form of the JSON files, with all that they depend on."""
    return {
        **found.to_dict(unit=unit, run=False),
        "model": str(model) if isinstance(model, Path) else list(map(str, model)),
        "model_sha256": model_sha256,
        "scene": str(scene),
        "scene_sha256": scene_sha256,
        "search": search,
        "seconds": round(seconds, 4),
    }


def write_json(path: Path, data: dict[str, Any]) -> None:
    """All of it or nothing, so that what is there after Ctrl-C can be relied on."""
    with written(path) as part:
        part.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def millimetres(unit: str | None, *diameters: float) -> float:
    """Return how many millimetres the unit of the data has: as it is said, or by the size of the parts."""
    if unit is not None:
        return 1000 * METRES[unit]
    if max(diameters) < 1:  # one of a millimetre would be a grain
        return 1000.0
    if min(diameters) > 10:  # one of ten metres is no part
        return 1.0
    sizes = ", ".join(f"{one:.4g}" for one in diameters)
    misused(f"--bop writes millimetres, and a part {sizes} across may be in mm or m; say --unit")


def write_bop(
    path: Path, images: Sequence[tuple[int, int, Any, list[float], float]], *obj_ids: int, mm: float
) -> None:
    """Rows of images: scene_id, im_id, (K, 4, 4) poses, their scores, and seconds; an obj_id each.

    ``mm`` is how many millimetres the unit of the poses has.
    """
    with written(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["scene_id", "im_id", "obj_id", "score", "R", "t", "time"])
        obj_ids = obj_ids if len(obj_ids) == len(images) else (obj_ids or (1,)) * len(images)
        for obj_id, (scene_id, im_id, poses, scores, seconds) in zip(obj_ids, images, strict=True):
            for pose, score in zip(poses, scores, strict=True):
                parts = pose[:3, :3], mm * pose[:3, 3]
                numbers = (" ".join(f"{x:.9g}" for x in part.ravel()) for part in parts)
                rows.writerow([scene_id, im_id, obj_id, f"{score:.6f}", *numbers, f"{seconds:.4f}"])
