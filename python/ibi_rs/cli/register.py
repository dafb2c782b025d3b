"""`ibi register`: one scan."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import ibi_rs as ibi
from ibi_rs import io

from .common import (
    ERRORS,
    FOUND_NOTHING,
    FromAllSides,
    MaxInstances,
    ModelFile,
    ParamsFile,
    Preset,
    RemovePlane,
    SceneFile,
    Search,
    SymmetriesOf,
    TimeoutS,
    Viewpoint,
    Voxel,
    app,
    as_dict,
    chosen_params,
    err,
    fail,
    out,
    show,
    symmetries_of,
    write_bop,
    write_json,
)


@app.command()
def register(
    model: ModelFile,
    scene: SceneFile,
    corr: Annotated[
        Path | None,
        typer.Option(help="Your own correspondences, pairs of rows (NPY or text); MODEL is a cloud then."),
    ] = None,
    viewpoint: Viewpoint = (0.0, 0.0, 0.0),
    from_all_sides: FromAllSides = False,
    voxel: Voxel = None,
    remove_plane: RemovePlane = None,
    symmetries: SymmetriesOf = "none",
    preset: Preset = None,
    params: ParamsFile = None,
    max_instances: MaxInstances = None,
    timeout_s: TimeoutS = None,
    threads: Annotated[int | None, typer.Option(min=1, help="Default: all that the process may use.")] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Poses as JSON.")] = None,
    bop: Annotated[
        Path | None, typer.Option(help="Poses as BOP's CSV: t in mm, if the unit is the metre.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="A picture (PNG): the scene grey, each part in a colour.")
    ] = None,
    rerun: Annotated[
        Path | None,
        typer.Option(help="A recording (RRD) of parts, matches and rounds; `rerun FILE` plays it."),
    ] = None,
) -> None:
    """Find the parts MODEL in SCENE and print a table of their poses.

    From a CAD file and a scan:    ibi register part.stl scan.ply --plot found.png

    With your own matches:         ibi register part.npy scan.npy --corr m.npy

    Exit code: 0 if parts were found, 3 if none was, 1 if the input is at fault,
    2 if the command line is.
    """
    start = time.perf_counter()
    if corr is not None and (voxel is not None or remove_plane is not None or from_all_sides):
        fail("--corr brings the matches: --voxel, --remove-plane and --from-all-sides have no say then")
    chosen = chosen_params(preset, params)
    search = Search(
        viewpoint, from_all_sides, voxel, remove_plane, chosen, max_instances, timeout_s, symmetries
    )
    options = search.limits(threads)
    pairs: Any = None
    try:
        with err.status("reading") as status:
            tgt, tgt_normals = io.read_cloud(scene)
            if corr is not None:
                src, src_normals = io.read_cloud(model)
                held = symmetries_of(symmetries, src, src_normals)
                pairs = _pairs(corr)
                status.update("registering")
                found = ibi.Model(src, symmetries=held).register(tgt, pairs, chosen, **options)
            else:
                part = search.model(model, threads)
                src, held = part.points, part.symmetries
                status.update("detecting")
                found = part.detect(
                    tgt,
                    chosen,
                    **search.sight(tgt_normals),
                    callback=lambda done: status.update(f"detecting: round {done.index + 1}"),
                    **options,
                )
        seconds = time.perf_counter() - start
        found = found.canonical(held)
        show(found, seconds)
        if not held.is_none:
            out.print(f"modulo {held!r}", style="dim", highlight=False)
        if output is not None:
            write_json(output, as_dict(found, model, scene, seconds))
        if bop is not None:
            write_bop(bop, [(0, 0, np.asarray(found), [pose.score for pose in found], seconds)])
        if plot is not None:
            ibi.plot.instances(tgt, src, found, plot, title=f"{scene.name}: {len(found)} x {model.name}")
        if rerun is not None:
            if corr is None:  # once more, as `detect` keeps them to itself
                matches = part.correspond(tgt, **search.sight(tgt_normals), num_threads=threads)
                pairs = src[matches.corr[:, 0]], matches.tgt[matches.corr[:, 1]]
            ibi.viz.record(tgt, src, found, rerun, corr=pairs)
    except ERRORS as error:
        fail(error)
    if len(found) == 0:
        raise typer.Exit(FOUND_NOTHING)


def _pairs(path: Path) -> Any:
    try:
        return (
            np.load(path, allow_pickle=False) if path.suffix == ".npy" else np.loadtxt(path, dtype=np.int64)
        )
    except (OSError, ValueError) as error:
        raise ibi.InputError(f"{path}: cannot be read: {str(error).splitlines()[0]}") from error
