"""`ibi bench`: the time of each step."""

from __future__ import annotations

import functools
import platform
import re
import statistics
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table

import ibi_rs as ibi
from ibi_rs import _batch, io

from .outputs import print_table, try_outputs, write_json
from .search import (
    FromAllSides,
    MaxInstances,
    ParamsFile,
    Preset,
    RemovePlane,
    Search,
    Set,
    TimeoutS,
    Viewpoint,
    Voxel,
    changes_of,
)
from .terminal import command, err, misused, out


@command()
def bench(
    model: Annotated[
        Path | None,
        typer.Argument(help="Mesh of the part. Without one a synthetic scene is timed.", metavar="MODEL"),
    ] = None,
    scene: Annotated[Path | None, typer.Argument(help="Scan, in the same unit.", metavar="SCENE")] = None,
    viewpoint: Viewpoint = None,
    from_all_sides: FromAllSides = False,
    voxel: Voxel = None,
    remove_plane: RemovePlane = None,
    preset: Preset = None,
    params: ParamsFile = None,
    settings: Set = None,
    max_instances: MaxInstances = None,
    timeout_s: TimeoutS = None,
    repeats: Annotated[int, typer.Option(min=1, help="Runs, after one that does not count.")] = 10,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="All seconds as JSON.")] = None,
) -> None:
    """Time each step from MODEL and SCENE to poses, on one thread and on all.

    Your part and scan:     ibi bench part.stl scan.ply

    No files needed:        ibi bench

    Without files the scene is synthetic: 20 instances, 5000 correspondences,
    70 to 90 % of them wrong.

    The indented steps are those within `register`. Where two rounds are played
    at the same time, they count the seconds of both.
    """
    if (model is None) != (scene is None):
        misused("give MODEL and SCENE, or neither")
    changes = changes_of(preset, params, settings)
    search = Search(viewpoint, from_all_sides, voxel, remove_plane, changes, max_instances, timeout_s)
    try_outputs({"--output": output}, {"MODEL": model, "SCENE": scene, "--params": params})
    cores = _batch._cores()
    runs: dict[int, list[dict[str, float]]] = {}
    num_poses = 0
    with err.status("timing") as status:
        for threads in sorted({1, cores}):
            runs[threads] = []
            for repeat in range(-1, repeats):
                status.update(f"threads {threads}: {max(repeat, 0)} of {repeats}")
                if model is not None and scene is not None:
                    seconds, found = _time_files(search, model, scene, threads)
                else:
                    seconds, found = _time_synthetic(search, threads)
                num_poses = len(found)
                if repeat >= 0:
                    runs[threads].append(seconds)
    data = _bench_data(model, scene, repeats, num_poses, runs)
    _show_bench(data)
    if output is not None:
        write_json(output, data)


class _Watch:
    """Seconds of one step after the other."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, step: str) -> None:
        now = time.perf_counter()
        self.seconds[step] = now - self._last
        self._last = now

    def end(self, found: ibi.Registration) -> dict[str, float]:
        total = sum(self.seconds.values())
        return self.seconds | {STAGES[k]: getattr(found.timings, k) for k in STAGES} | {"total": total}


STAGES = {
    "prepare_s": "prepare",
    "scs_s": "SCS: seeds",
    "ce_s": "CE: votes",
    "te_s": "TE: pose",
    "refine_s": "refine",
    "hv_s": "HV: verdict",
}


def _time_files(
    search: Search, model: Path, scene: Path, threads: int
) -> tuple[dict[str, float], ibi.Registration]:
    watch = _Watch()
    mesh = io.read_mesh(model)
    scan = io.read_scan(scene)
    watch.lap("read")
    part = ibi.Model.from_mesh(*mesh, voxel=search.voxel, num_threads=threads)
    watch.lap("model")
    sight = search.sight(scan.normals, scan.viewpoint)
    matches = part.correspond(scan.points, **sight, num_threads=threads)
    watch.lap("match")
    found = part.register(
        matches.tgt,
        matches.corr,
        search.params_for(),
        tgt_normals=matches.tgt_normals,
        similarity=matches.similarity,
        viewpoint=sight["viewpoint"],
        **search.limits(threads),
    )
    watch.lap("register")
    return watch.end(found), found


@functools.cache
def _synthetic() -> ibi.synth.Scene:
    return ibi.synth.outlier_layout(0, num_instances=20, num_correspondences=5000)


def _time_synthetic(search: Search, threads: int) -> tuple[dict[str, float], ibi.Registration]:
    scene = _synthetic()
    watch = _Watch()
    part = ibi.Model(scene.src)
    watch.lap("model")
    found = part.register(scene.tgt, scene.corr, search.changes.on(ibi.Params()), **search.limits(threads))
    watch.lap("register")
    return watch.end(found), found


def _bench_data(
    model: Path | None,
    scene: Path | None,
    repeats: int,
    num_poses: int,
    runs: dict[int, list[dict[str, float]]],
) -> dict[str, Any]:
    return {
        "ibi_rs": ibi.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "platform": platform.platform(),
        "cpu": _cpu(),
        "cores": max(runs),
        "model": "synthetic" if model is None else str(model),
        "scene": "outlier_layout(0)" if scene is None else str(scene),
        "num_poses": num_poses,
        "repeats": repeats,
        "threads": {
            str(threads): {step: [run[step] for run in of_threads] for step in of_threads[0]}
            for threads, of_threads in runs.items()
        },
    }


def _cpu() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return platform.processor()
    named = re.search(r"^model name\s*: (.+)$", text, re.MULTILINE)
    return named[1] if named else platform.machine()


def _show_bench(data: dict[str, Any]) -> None:
    table = Table(box=None, pad_edge=False)
    table.add_column("\nseconds", no_wrap=True)
    for threads in data["threads"]:
        plural = "thread" if threads == "1" else "threads"
        for column in (f"{threads} {plural}\nmedian", "\nmin", "\nmax"):
            table.add_column(column, justify="right", no_wrap=True)
    for step in next(iter(data["threads"].values())):
        cells = []
        for steps in data["threads"].values():
            of = steps[step]
            cells += [f"{x:.4f}" for x in (statistics.median(of), min(of), max(of))]
        table.add_row(f"  {step}" if step in STAGES.values() else step, *cells)
    print_table(table)
    runs = f"{data['num_poses']} found; {data['repeats']} runs of {data['model']}, {data['scene']}"
    out.print(runs, highlight=False, markup=False)
    versions = f"ibi_rs {data['ibi_rs']}, Python {data['python']}, numpy {data['numpy']}"
    out.print(
        f"{versions}; {data['cores']} cores, {data['cpu']}; {data['platform']}", highlight=False, markup=False
    )
