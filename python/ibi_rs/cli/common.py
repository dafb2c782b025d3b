"""What the commands share: options, the search they describe, tables, files, errors."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NoReturn

import numpy as np

import ibi_rs as ibi
from ibi_rs import _interrupts, io, metrics
from ibi_rs.symmetries import _bop_entry as bop_entry

try:
    with _interrupts.held():
        import typer
        from rich.console import Console
        from rich.table import Table
except ImportError as error:
    raise SystemExit(f"ibi: the command needs more: pip install 'ibi_rs[cli]' ({error})") from None

FOUND_NOTHING = 3
"""Exit code of `ibi register` where nothing is found; 1: the input is at fault; 2: the command line is."""
INTERRUPTED = 130

SYMMETRIES = "find, none, or BOP's models_info.json, with :ID where it has several objects"

PRESETS = {
    "default": ibi.Params,
    "single_view": ibi.Params.single_view,
    "paper_synthetic": ibi.Params.paper_synthetic,
    "paper_real": ibi.Params.paper_real,
}

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Find every copy of a part in a scan: poses in six degrees of freedom.",
)
out = Console()
err = Console(stderr=True)


@app.callback(invoke_without_command=True)
def main(
    version: Annotated[bool, typer.Option("--version", help="Print the version and end.")] = False,
) -> None:
    """Find every copy of a part in a scan: poses in six degrees of freedom."""
    if version:
        print(f"ibi_rs {ibi.__version__}")
        raise typer.Exit


# Options that commands share.
ModelFile = Annotated[
    Path, typer.Argument(help="Mesh of the part: STL, PLY, OBJ, OFF or GLB.", metavar="MODEL")
]
SceneFile = Annotated[
    Path, typer.Argument(help="Scan: PLY, PCD, LAS, XYZ, CSV, NPY ... in the same unit.", metavar="SCENE")
]
Viewpoint = Annotated[
    tuple[float, float, float], typer.Option(help="Where the depth camera stood, in the frame of SCENE.")
]
FromAllSides = Annotated[
    bool, typer.Option("--from-all-sides", help="SCENE is no depth scan but a whole cloud, with normals.")
]
Voxel = Annotated[
    float | None,
    typer.Option(
        help="Spacing of what is looked at. Default: 1/24 of the model, less where that leaves few points."
    ),
]
RemovePlane = Annotated[
    bool | None,
    typer.Option(
        "--remove-plane/--keep-plane",
        help="Take the largest plane away, or not. Default: if it looks like a table.",
    ),
]
SymmetriesOf = Annotated[
    str, typer.Option(help=f"{SYMMETRIES}. Of poses that look the same the one turned least is given.")
]
Preset = Annotated[str | None, typer.Option(help=f"{', '.join(PRESETS)}; by default what fits the scene.")]
ParamsFile = Annotated[Path | None, typer.Option(help="Parameters as TOML or JSON.")]
MaxInstances = Annotated[int | None, typer.Option(min=1, help="No more than so many.")]
TimeoutS = Annotated[float | None, typer.Option(help="Seconds, then what was found is kept.")]

ERRORS = (ibi.InputError, ibi.ParamsError, ImportError, OSError, TypeError)
"""What a user can do something about: one line."""


@dataclass(frozen=True)
class Search:
    """How to look for a part in a scan, from the options of the command line."""

    viewpoint: tuple[float, float, float]
    from_all_sides: bool
    voxel: float | None
    remove_plane: bool | None
    params: ibi.Params | None
    max_instances: int | None
    timeout_s: float | None
    symmetries: str = "none"

    def model(self, path: Path, num_threads: int | None) -> ibi.Model:
        """Read and prepare the part."""
        mesh = io.read_mesh(path)
        wanted = None if self.symmetries == "find" else symmetries_of(self.symmetries, mesh[0])
        return ibi.Model.from_mesh(
            *mesh, voxel=self.voxel, symmetries=wanted or "find", num_threads=num_threads
        )

    def sight(self, normals: Any) -> dict[str, Any]:
        """Those arguments of `Model.correspond` that `Model.detect` has, too."""
        return {
            "tgt_normals": normals if self.from_all_sides else None,
            "viewpoint": None if self.from_all_sides else self.viewpoint,
            "remove_plane": self.remove_plane,
        }

    def limits(self, num_threads: int | None) -> dict[str, Any]:
        """Return what ends a run, and its threads."""
        return {
            "max_instances": self.max_instances,
            "timeout_s": self.timeout_s,
            "num_threads": num_threads,
        }


def symmetries_of(given: str, points: Any, normals: Any = None) -> ibi.Symmetries:
    """Read, find or leave out the symmetries of a model."""
    if given in ("find", "none"):
        return ibi.find_symmetries(points, normals) if given == "find" else ibi.Symmetries.none()
    path, _, number = given.rpartition(":")
    path, obj_id = (path, int(number)) if path and number.isdecimal() else (given, None)
    # BOP's lengths are in mm; what the model's are is seen by its diameter.
    entry = bop_entry(path, obj_id)
    scale = (
        10.0 ** round(np.log10(metrics.diameter(points) / entry["diameter"])) if "diameter" in entry else 1.0
    )
    return ibi.Symmetries.from_bop(entry, scale=scale)


def chosen_params(preset: str | None, path: Path | None) -> ibi.Params | None:
    """Read the parameters of a preset or a file; None where neither is given."""
    if preset is not None and path is not None:
        fail("give --preset or --params, not both")
    if preset is not None:
        if preset not in PRESETS:
            fail(f"--preset {preset}: there are {', '.join(PRESETS)}")
        return PRESETS[preset]()
    if path is None:
        return None
    try:
        return ibi.Params.load(path)
    except (ibi.ParamsError, OSError) as error:
        fail(error)


def show(found: ibi.Registration, seconds: float) -> None:
    """Print a table of the poses."""
    table = Table(box=None, pad_edge=False)
    for column in ("", "score", "overlap", "inliers", "x", "y", "z", "rx", "ry", "rz"):
        table.add_column(column, justify="right", no_wrap=True)
    for number, pose in enumerate(found):
        place = [f"{x:.4g}" for x in pose.target_from_source[:3, 3]]
        turn = [f"{x:.1f}" for x in np.degrees(_rotation_vector(pose.target_from_source[:3, :3]))]
        quality = [f"{pose.score:.2f}", f"{pose.overlap:.2f}", str(pose.num_inliers)]
        table.add_row(str(number), *quality, *place, *turn)
    if len(found):
        out.print(table)
        out.print("x, y, z in the unit of the scene; rx, ry, rz: rotation vector, degrees", style="dim")
    out.print(f"{len(found)} found in {seconds:.2f} s; stopped by {found.stop_reason}", highlight=False)


def _rotation_vector(rotation: Any) -> Any:
    """Axis times angle, by the quaternion: exact for half turns, too."""
    four = np.empty((4, 4))  # 4 q qT, whose rows are all the quaternion q, (w, x, y, z), times something
    four[0, 0] = 1 + np.trace(rotation)
    off = rotation - rotation.T
    four[0, 1:] = four[1:, 0] = off[2, 1], off[0, 2], off[1, 0]
    four[1:, 1:] = rotation + rotation.T + (1 - np.trace(rotation)) * np.eye(3)
    quaternion = four[np.argmax(np.diag(four))]
    quaternion = quaternion / np.linalg.norm(quaternion) * np.copysign(1, quaternion[0])
    sine = float(np.linalg.norm(quaternion[1:]))
    return quaternion[1:] * (2 * np.arctan2(sine, quaternion[0]) / max(sine, 1e-300))


def as_dict(found: ibi.Registration, model: Path, scene: Path, seconds: float) -> dict[str, Any]:
    """Bring the poses into the form of the JSON files."""
    return {
        "ibi_rs": ibi.__version__,
        "model": str(model),
        "scene": str(scene),
        "poses": [
            {
                "target_from_source": pose.target_from_source.tolist(),
                "score": pose.score,
                "overlap": pose.overlap,
                "num_inliers": pose.num_inliers,
                "inlier_rmse": pose.inlier_rmse,
            }
            for pose in found
        ],
        "stop_reason": str(found.stop_reason),
        "seconds": round(seconds, 4),
        "resolution": found.resolution,
        "params": found.params.to_dict(),
    }


def write_json(path: Path, data: dict[str, Any]) -> None:
    """All of it or nothing, so that what is there after Ctrl-C can be relied on."""
    part = path.with_name(f"{path.name}.part")
    part.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    os.replace(part, path)


def write_bop(
    path: Path, images: Sequence[tuple[int, int, Any, list[float], float]], obj_id: int = 1
) -> None:
    """Rows of images: scene_id, im_id, (K, 4, 4) poses, their scores, and seconds."""
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["scene_id", "im_id", "obj_id", "score", "R", "t", "time"])
        for scene_id, im_id, poses, scores, seconds in images:
            for pose, score in zip(poses, scores, strict=True):
                parts = pose[:3, :3], 1000 * pose[:3, 3]
                numbers = (" ".join(f"{x:.9g}" for x in part.ravel()) for part in parts)
                rows.writerow([scene_id, im_id, obj_id, f"{score:.6f}", *numbers, f"{seconds:.4f}"])


def fail(error: object) -> NoReturn:
    """End with an error of one line."""
    err.print(f"ibi: {error}", highlight=False, markup=False, soft_wrap=True)
    raise typer.Exit(1)
