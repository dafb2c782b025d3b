"""The command `ibi`. Needs typer, rich and the readers: ``pip install 'ibi_rs[cli]'``."""

from __future__ import annotations

import csv
import json
import sys
import time
from pathlib import Path
from typing import Annotated, Any, NoReturn

import numpy as np

import ibi_rs as ibi
from ibi_rs import io, metrics
from ibi_rs.symmetries import _bop_entry as bop_entry

try:
    import typer
    from rich.console import Console
    from rich.table import Table
except ImportError as error:
    raise SystemExit(f"ibi: the command needs more: pip install 'ibi_rs[cli]' ({error})") from None

FOUND_NOTHING = 3
"""Exit code of `ibi register` where nothing is found; 1: the input is at fault; 2: the command line is."""

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


@app.command()
def register(
    model: Annotated[Path, typer.Argument(help="Mesh of the part: STL, PLY, OBJ, OFF or GLB.")],
    scene: Annotated[Path, typer.Argument(help="Scan: PLY, PCD, LAS, XYZ, CSV, NPY ... in the same unit.")],
    corr: Annotated[
        Path | None,
        typer.Option(help="Your own correspondences, pairs of rows (NPY or text); MODEL is a cloud then."),
    ] = None,
    viewpoint: Annotated[
        tuple[float, float, float], typer.Option(help="Where the depth camera stood, in the frame of SCENE.")
    ] = (0.0, 0.0, 0.0),
    from_all_sides: Annotated[
        bool, typer.Option("--from-all-sides", help="SCENE is no depth scan but a whole cloud, with normals.")
    ] = False,
    voxel: Annotated[
        float | None, typer.Option(help="Spacing of what is looked at. Default: 1/24 of the model.")
    ] = None,
    remove_plane: Annotated[
        bool | None,
        typer.Option(
            "--remove-plane/--keep-plane",
            help="Take the largest plane away, or not. Default: if it looks like a table.",
        ),
    ] = None,
    symmetries: Annotated[
        str, typer.Option(help=f"{SYMMETRIES}. Of poses that look the same the one turned least is given.")
    ] = "none",
    preset: Annotated[
        str | None, typer.Option(help=f"{', '.join(PRESETS)}; by default what fits the scene.")
    ] = None,
    params: Annotated[Path | None, typer.Option(help="Parameters as TOML or JSON.")] = None,
    max_instances: Annotated[int | None, typer.Option(min=1, help="No more than so many.")] = None,
    timeout_s: Annotated[float | None, typer.Option(help="Seconds, then what was found is kept.")] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="Default: all that the process may use.")] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Poses as JSON.")] = None,
    bop: Annotated[
        Path | None, typer.Option(help="Poses as BOP's CSV: t in mm, if the unit is the metre.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="A picture (PNG): the scene grey, each part in a colour.")
    ] = None,
) -> None:
    """Find the parts MODEL in SCENE and print a table of their poses.

    From a CAD file and a scan:    ibi register part.stl scan.ply --plot found.png

    With your own matches:         ibi register part.npy scan.npy --corr matches.npy
    """
    start = time.perf_counter()
    if corr is not None and (voxel is not None or remove_plane is not None or from_all_sides):
        _fail("--corr brings the matches: --voxel, --remove-plane and --from-all-sides have no say then")
    chosen = _params(preset, params)
    options: dict[str, Any] = {"max_instances": max_instances, "timeout_s": timeout_s, "num_threads": threads}
    try:
        with err.status("reading") as status:
            tgt, tgt_normals = io.read_cloud(scene)
            if corr is not None:
                src, src_normals = io.read_cloud(model)
                held = _symmetries(symmetries, src, src_normals)
                pairs = _pairs(corr)
                status.update("registering")
                found = ibi.Model(src, symmetries=held).register(tgt, pairs, chosen, **options)
            else:
                mesh = io.read_mesh(model)
                wanted = None if symmetries == "find" else _symmetries(symmetries, mesh[0])
                part = ibi.Model.from_mesh(
                    *mesh, voxel=voxel, symmetries=wanted or "find", num_threads=threads
                )
                src, held = part.points, part.symmetries
                status.update("detecting")
                found = part.detect(
                    tgt,
                    chosen,
                    tgt_normals=tgt_normals if from_all_sides else None,
                    viewpoint=None if from_all_sides else viewpoint,
                    remove_plane=remove_plane,
                    callback=lambda done: status.update(f"detecting: round {done.index + 1}"),
                    **options,
                )
        seconds = time.perf_counter() - start
        found = found.canonical(held)
        _show(found, seconds)
        if not held.is_none:
            out.print(f"modulo {held!r}", style="dim", highlight=False)
        if output is not None:
            output.write_text(json.dumps(_as_dict(found, model, scene), indent=1) + "\n", encoding="utf-8")
        if bop is not None:
            _write_bop(bop, found, seconds)
        if plot is not None:
            ibi.plot.instances(tgt, src, found, plot, title=f"{scene.name}: {len(found)} x {model.name}")
    except (ibi.InputError, ibi.ParamsError, ImportError, OSError, TypeError) as error:
        _fail(error)
    if len(found) == 0:
        raise typer.Exit(FOUND_NOTHING)


@app.command("eval")
def evaluate(
    poses: Annotated[Path, typer.Argument(help="JSON that `ibi register -o` has written.")],
    truth: Annotated[Path, typer.Argument(help="True poses: JSON with 'poses', or a (K, 4, 4) NPY.")],
    model: Annotated[Path, typer.Argument(help="Mesh or cloud of the part, for ADD-S and its diameter.")],
    diameters: Annotated[float, typer.Option(help="A pose is right within so many diameters.")] = 0.1,
    symmetries: Annotated[
        str | None, typer.Option(help=f"{SYMMETRIES}: adds rotation errors and MSSD, modulo these.")
    ] = None,
) -> None:
    """Score poses against true ones: one to one, by ADD-S below a tenth of the model's diameter."""
    try:
        points = _surface(model)
        held = _symmetries(symmetries or "none", points)
        predicted, true = _poses(poses), _poses(truth)
        criterion = metrics.AddS(diameter_fraction=diameters)
        score = metrics.score_scene(predicted, true, criterion=criterion, model=points, symmetries=held)
        mssd = metrics.mssd_recall(predicted, true, model=points, symmetries=held)
    except (ibi.InputError, ImportError, OSError, TypeError, ValueError) as error:
        _fail(error)
    print(f"recall     {score.recall:.3f}  ({score.num_truth_hit} of {score.num_truth})")
    print(f"precision  {score.precision:.3f}  ({score.num_predicted_hit} of {score.num_predicted})")
    print(f"F1         {score.f1:.3f}")
    if symmetries is not None:
        turned = [match.rotation_error_deg for match in score.matches if match and match.is_hit]
        print(f"MSSD       {mssd.average:.3f}  (BOP's average recall, modulo {held!r})")
        if turned:
            print(f"turned by  {np.median(turned):.1f} deg in the median, {max(turned):.1f} at most")


def _symmetries(given: str, points: Any, normals: Any = None) -> ibi.Symmetries:
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


def _surface(model: Path) -> Any:
    """Points of a cloud, or spread over a mesh, whose vertices are few where it is flat."""
    try:
        mesh = io.read_mesh(model)
    except ibi.InputError:
        return io.read_cloud(model)[0]
    return ibi.features.sample_mesh(*mesh, n=2000)[0]


def _params(preset: str | None, path: Path | None) -> ibi.Params | None:
    if preset is not None and path is not None:
        _fail("give --preset or --params, not both")
    if preset is not None:
        if preset not in PRESETS:
            _fail(f"--preset {preset}: there are {', '.join(PRESETS)}")
        return PRESETS[preset]()
    if path is None:
        return None
    try:
        return ibi.Params.load(path)
    except (ibi.ParamsError, OSError) as error:
        _fail(error)


def _pairs(path: Path) -> Any:
    try:
        return (
            np.load(path, allow_pickle=False) if path.suffix == ".npy" else np.loadtxt(path, dtype=np.int64)
        )
    except (OSError, ValueError) as error:
        raise ibi.InputError(f"{path}: cannot be read: {str(error).splitlines()[0]}") from error


def _poses(path: Path) -> Any:
    if path.suffix == ".npy":
        return np.load(path, allow_pickle=False)
    data = json.loads(path.read_text(encoding="utf-8"))
    rows = [pose["target_from_source"] if isinstance(pose, dict) else pose for pose in data["poses"]]
    return np.array(rows, dtype=np.float64).reshape(-1, 4, 4)


def _show(found: ibi.Registration, seconds: float) -> None:
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


def _as_dict(found: ibi.Registration, model: Path, scene: Path) -> dict[str, Any]:
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
        "resolution": found.resolution,
        "params": found.params.to_dict(),
    }


def _write_bop(path: Path, found: ibi.Registration, seconds: float) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["scene_id", "im_id", "obj_id", "score", "R", "t", "time"])
        for pose in found:
            rotation, shift = pose.target_from_source[:3, :3], 1000 * pose.target_from_source[:3, 3]
            numbers = (" ".join(f"{x:.9g}" for x in part.ravel()) for part in (rotation, shift))
            rows.writerow([0, 0, 1, f"{pose.score:.6f}", *numbers, f"{seconds:.4f}"])


def _fail(error: object) -> NoReturn:
    err.print(f"ibi: {error}", highlight=False, markup=False, soft_wrap=True)
    raise typer.Exit(1)


if __name__ == "__main__":
    sys.exit(app())
