"""`ibi register`: one scan."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import ibi_rs as ibi
from ibi_rs import io, metrics
from ibi_rs._files import read_npy

from .outputs import (
    as_dict,
    millimetres,
    sha256,
    show,
    try_outputs,
    write_bop,
    write_json,
)
from .search import (
    Background,
    CameraOf,
    Crop,
    DepthScale,
    FromAllSides,
    MaxInstances,
    MinScore,
    ModelFiles,
    ParamsFile,
    Preset,
    RemovePlane,
    RemovePlanes,
    SceneFile,
    Search,
    Set,
    SymmetriesOf,
    TimeoutS,
    Unit,
    Viewpoint,
    Voxel,
    changes_of,
    symmetries_of,
    unit_of,
)
from .terminal import (
    FOUND_NOTHING,
    MAX_THREADS,
    Progress,
    Verbose,
    command,
    misused,
    out,
    warn,
)


@command()
def register(
    models: ModelFiles,
    scene: SceneFile,
    corr: Annotated[
        Path | None,
        typer.Option(
            help="Your own correspondences (NPY or text): pairs of rows, or of points; MODEL is a cloud then."
        ),
    ] = None,
    camera: CameraOf = None,
    depth_scale: DepthScale = None,
    viewpoint: Viewpoint = None,
    from_all_sides: FromAllSides = False,
    voxel: Voxel = None,
    remove_plane: RemovePlane = None,
    remove_planes: RemovePlanes = None,
    crop: Crop = None,
    background: Background = None,
    symmetries: SymmetriesOf = "none",
    preset: Preset = None,
    params: ParamsFile = None,
    settings: Set = None,
    min_score: MinScore = None,
    unit: Unit = None,
    max_instances: MaxInstances = None,
    timeout_s: TimeoutS = None,
    threads: Annotated[
        int | None, typer.Option(min=1, max=MAX_THREADS, help="Default: all that the process may use.")
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Poses as JSON, or as .csv.")] = None,
    bop: Annotated[Path | None, typer.Option(help="Poses as BOP's CSV: t in mm.")] = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            help="A picture (PNG, PDF ...): the scene grey, each part in a colour; with --camera the depth "
            "image, with outlines."
        ),
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option(help="A page (HTML) to turn and pick parts in with the mouse; needs no network."),
    ] = None,
    rerun: Annotated[
        Path | None,
        typer.Option(help="A recording (RRD) of parts, matches and rounds; `rerun FILE` plays it."),
    ] = None,
    verbose: Verbose = 0,
) -> None:
    """Find the parts MODEL in SCENE and print a table of their poses.

    From a CAD file and a scan:    ibi register part.stl scan.ply --plot found.png

    With your own matches:         ibi register part.npy scan.npy --corr m.npy

    Several parts in one scan:     ibi register bolt.stl nut.stl scan.ply

    A depth image:                 ibi register part.stl d.png --camera cam.json

    Of several parts each MODEL is looked for, and then all poses compete for
    what was measured. --bop numbers them from 1 in the order of the command.

    With your own matches the normals of both files count, where both have them.
    If you give the --viewpoint then, too, it is a depth scan, and the preset
    single_view fits; without it, default does.

    Exit code: 0 if parts were found, 3 if none was, 1 if the input is at fault,
    2 if the command line is, 130 after Ctrl-C.
    """
    start = time.perf_counter()
    model = models[0]
    if corr is not None and (voxel is not None or remove_plane is not None or from_all_sides):
        misused("--corr brings the matches: --voxel, --remove-plane and --from-all-sides have no say then")
    idle = {"--crop": crop, "--background": background, "--camera": camera, "--remove-planes": remove_planes}
    if corr is not None and any(value is not None for value in idle.values()):
        names = [name for name, value in idle.items() if value is not None]
        misused(f"--corr brings the matches: {', '.join(names)} has no say then")
    if len(models) > 1:
        _try_several(corr, plot, rerun, symmetries)
    unit = unit_of(unit)
    changes = changes_of(preset, params, settings)
    search = Search(
        viewpoint,
        from_all_sides,
        voxel,
        remove_plane,
        changes,
        max_instances,
        timeout_s,
        symmetries,
        crop,
        min_score,
        camera,
        depth_scale,
        remove_planes,
        unit,
        background,
    )
    outputs = {"--output": output, "--bop": bop, "--plot": plot, "--html": html, "--rerun": rerun}
    inputs: dict[str, Path | None] = {"MODEL" if len(models) == 1 else f"MODEL {one}": one for one in models}
    inputs |= {"SCENE": scene, "--corr": corr, "--params": params, "--background": background}
    try_outputs(outputs, inputs)
    options = search.limits(threads)
    pairs: Any = None
    with Progress("reading") as progress:
        if corr is not None:
            tgt, tgt_normals = io.read_cloud(scene)
            pairs = _pairs(corr)
            mm = 0.0 if bop is None else millimetres(unit, metrics.diameter(io.read_cloud(model)[0]))
            progress.update("registering")
            src, held, found = _with_matches(search, model, tgt, tgt_normals, pairs, options)
        else:
            scan = search.read(scene)
            parts = [search.model(one, threads) for one in models]
            part = parts[0]
            mm = 0.0 if bop is None else millimetres(unit, *(one.diameter for one in parts))
            tgt, sight = search.look(scan, min(one.voxel for one in parts))
            src, held = part.points, part.symmetries
            progress.update("detecting")
            kinds = part if len(parts) == 1 else ibi.Models(parts, names=_names(models))
            found = kinds.detect(
                tgt,
                search.params,
                **sight,
                callback=lambda done: progress.update(f"detecting: round {done.index + 1}"),
                **options,
            )
    seconds = time.perf_counter() - start
    found = search.kept(found)
    of_all = [held] if corr is not None else [one.symmetries for one in parts]
    for warning in found.warnings:
        warn(warning)
    show(found, seconds)
    for path, one in zip(models, of_all, strict=True):
        if not one.is_none:
            name = f"{path.name} " if len(models) > 1 else ""
            out.print(f"{name}modulo {one!r}", style="dim", highlight=False, markup=False)
    if output is not None:
        files: dict[str, Any] = {
            "model": model if len(models) == 1 else models,
            "model_sha256": sha256(model) if len(models) == 1 else [sha256(one) for one in models],
            "scene": scene,
            "scene_sha256": sha256(scene),
        }
        recorded = search.recorded(*of_all) | ({} if corr is None else {"corr": str(corr)})
        if output.suffix.lower() == ".csv":
            found.save(output)
        else:
            write_json(output, as_dict(found, seconds, **files, search=recorded, unit=unit))
    if bop is not None:
        of_parts = [found.of(i) for i in range(len(models))]
        rows = [(0, 0, np.asarray(one), [pose.score for pose in one], seconds) for one in of_parts]
        write_bop(bop, rows, *range(1, len(models) + 1), mm=mm)
    if plot is not None:
        title = f"{scene.name}: {len(found)} x {model.name}".replace("$", r"\$")  # else it is a formula
        title = title.encode(errors="replace").decode()  # names of files may be of any bytes
        if camera is not None:
            mesh = io.read_mesh(model)
            ibi.plot.outlines(scan.points, search.camera_of(scene), mesh, found, plot, title=title, unit=unit)
        else:
            eye = viewpoint if corr is not None else search.sight(None, scan.viewpoint)["viewpoint"]
            seen = tgt if corr is not None else scan.points
            ibi.plot.instances(seen, src, found, plot, title=title, unit=unit, viewpoint=eye)
    if html is not None:
        clouds = [src] if corr is not None else [one.points for one in parts]
        seen = tgt if corr is not None else scan.points
        ibi.plot.html(seen, clouds if len(clouds) > 1 else src, found, html, title=scene.name, unit=unit)
    if rerun is not None:
        if corr is None:  # once more, as `detect` keeps them to itself
            matches = part.correspond(tgt, **sight, num_threads=threads)
            pairs = src[matches.corr[:, 0]], matches.tgt[matches.corr[:, 1]]
        ibi.viz.record(tgt, src, found, rerun, corr=pairs)
    if len(found) == 0:
        raise typer.Exit(FOUND_NOTHING)


def _try_several(corr: Path | None, plot: Path | None, rerun: Path | None, symmetries: str) -> None:
    """Refuse what has no meaning for several parts."""
    for name, value in (("--corr", corr), ("--plot", plot), ("--rerun", rerun)):
        if value is not None:
            misused(f"{name} is of one MODEL; there are several")
    if symmetries not in ("find", "none"):
        misused("--symmetries of several MODELs are find or none")


def _names(models: list[Path]) -> list[str]:
    """Name parts by their files, in short if that tells them apart."""
    stems = [path.stem for path in models]
    names = stems if len(set(stems)) == len(stems) else [str(path) for path in models]
    if len(set(names)) < len(names):
        misused("MODEL: one file is given twice")
    return names


def _with_matches(
    search: Search, model: Path, tgt: Any, tgt_normals: Any, pairs: Any, options: dict[str, Any]
) -> tuple[Any, ibi.Symmetries, ibi.Registration]:
    """Register by given matches: the model's points, its symmetries, and what was found."""
    src, src_normals = io.read_cloud(model)
    held = symmetries_of(search.symmetries, src, src_normals)
    if (src_normals is None) != (tgt_normals is None):
        having, lacking = ("SCENE", "MODEL") if src_normals is None else ("MODEL", "SCENE")
        warn(f"{having} has normals and {lacking} has none, so they have no say")
    if src_normals is None or tgt_normals is None:
        src_normals = tgt_normals = None
        if search.viewpoint is not None:
            warn("--viewpoint has no say where MODEL or SCENE has no normals")
    # A scan's camera is at its origin unless it is said to be elsewhere; but is this a scan?
    is_scan = search.viewpoint is not None or search.changes.on(ibi.Params()).oriented_normals
    has_eye = tgt_normals is not None and is_scan
    found = ibi.Model(src, normals=src_normals, symmetries=held).register(
        tgt,
        pairs,
        search.changes.on(ibi.Params.single_view() if has_eye else ibi.Params()),
        tgt_normals=tgt_normals,
        viewpoint=(search.viewpoint or (0.0, 0.0, 0.0)) if has_eye else None,
        **options,
    )
    return src, held, found


def _pairs(path: Path) -> Any:
    """(M, 2) rows or (M, 6) points, from NPY or from text."""
    rows = read_npy(path) if path.suffix == ".npy" else _table(path)
    if rows.ndim != 2 or rows.shape[1] not in (2, 6) or rows.dtype.kind not in "fiu":
        raise ibi.InputError(
            f"{path}: wanted (M, 2) rows or (M, 6) points, found {rows.dtype} of shape {rows.shape}"
        )
    if rows.shape[1] == 6 or rows.dtype.kind != "f":
        return rows
    whole = np.isfinite(rows) & (rows == np.trunc(rows)) & (np.abs(rows) < 2**53)
    if not whole.all():
        row = int(np.flatnonzero(~whole.all(axis=1))[0])
        raise ibi.InputError(f"{path}: pair {row} is {rows[row].tolist()}; rows are whole numbers, from 0")
    return rows.astype(np.int64)  # np.savetxt writes them as floats


def _table(path: Path) -> Any:
    """Numbers in columns, apart by blanks, commas or semicolons, perhaps below a header."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ibi.InputError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError:
        raise ibi.InputError(f"{path}: cannot be read: it is neither NPY nor text") from None
    rows: list[list[float]] = []
    is_first = True
    for number, line in enumerate(text.splitlines(), 1):
        words = line.partition("#")[0].replace(",", " ").replace(";", " ").split()
        if not words:
            continue
        try:
            rows.append([float(word) for word in words])
        except ValueError:
            if not is_first:
                raise ibi.InputError(f"{path}, line {number}: wanted numbers, found {line[:40]!r}") from None
        is_first = False
        if rows and len(rows[-1]) != len(rows[0]):
            wanted = f"{len(rows[0])} numbers as in the first"
            raise ibi.InputError(f"{path}, line {number}: wanted {wanted}, found {len(rows[-1])}")
    if not rows:
        raise ibi.InputError(f"{path}: has no pairs")
    return np.array(rows)
