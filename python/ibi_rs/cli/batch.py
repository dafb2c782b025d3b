"""`ibi batch`: many scans."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

import ibi_rs as ibi

from .common import (
    ERRORS,
    INTERRUPTED,
    FromAllSides,
    MaxInstances,
    ModelFile,
    ParamsFile,
    Preset,
    RemovePlane,
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
    write_bop,
    write_json,
)


@app.command()
def batch(
    model: ModelFile,
    scenes: Annotated[
        list[Path],
        typer.Argument(help="Scans, of any kind that `register` reads.", metavar="SCENES"),
    ],
    viewpoint: Viewpoint = (0.0, 0.0, 0.0),
    from_all_sides: FromAllSides = False,
    voxel: Voxel = None,
    remove_plane: RemovePlane = None,
    symmetries: SymmetriesOf = "none",
    preset: Preset = None,
    params: ParamsFile = None,
    max_instances: MaxInstances = None,
    timeout_s: TimeoutS = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Scans at a time. Default: one for each core.")
    ] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, help="Of each scan. Default: what shares the cores among them.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for the poses: a JSON for each scan.")
    ] = None,
    bop: Annotated[
        Path | None, typer.Option(help="All poses as BOP's CSV: t in mm, if the unit is the metre.")
    ] = None,
    obj_id: Annotated[int, typer.Option(help="obj_id in the CSV.")] = 1,
    skip_existing: Annotated[
        bool, typer.Option("--skip-existing", help="Leave out scans whose JSON is there: resume a batch.")
    ] = False,
) -> None:
    """Find the parts MODEL in each of SCENES, several at a time.

    A folder of scans:      ibi batch part.stl scans/*.ply -o poses

    Go on after a stop:     the same with --skip-existing

    poses/NAME.json is what `ibi register -o` writes of scans/NAME.ply.

    In the CSV im_id is the last number in a scan's name (scan_0012.ply: 12),
    and scene_id the name of its folder where that is a number, as in BOP
    (000003/), else 0. Where a scan has no number, or two have the same, im_id
    counts the scans from 0.

    A scan that fails costs one line and no other scan.

    Exit code: 0 if none failed, found or not; 1 if any did, or MODEL cannot be
    used; 2 if the command line is at fault; 130 after Ctrl-C.
    """
    if skip_existing and output is None:
        fail("--skip-existing looks into the folder of -o; give it")
    chosen = chosen_params(preset, params)
    search = Search(
        viewpoint, from_all_sides, voxel, remove_plane, chosen, max_instances, timeout_s, symmetries
    )
    start = time.perf_counter()
    try:
        targets = _targets(scenes, output)
        if output is not None:
            output.mkdir(parents=True, exist_ok=True)
        outcomes = {i: old for i, target in enumerate(targets) if skip_existing and (old := _old(target))}
        new = [i for i in range(len(scenes)) if i not in outcomes]
        part = search.model(model, None)
        # Without a viewpoint a job takes the normals of its file.
        options = search.sight(None) | search.limits(None)
        todo = [_TimedJob(part, scenes[i], params=chosen, **options) for i in new]

        def keep(number: int, found: ibi.Registration | ibi.JobError) -> None:
            i = new[number]
            if not isinstance(found, ibi.JobError):
                found = found.canonical(part.symmetries)
            outcome = _outcome(todo[number], found)
            target = targets[i]
            if target is not None and not isinstance(found, ibi.JobError):
                write_json(target, as_dict(found, model, scenes[i], outcome.seconds))
            outcomes[i] = outcome

        _run_all(todo, jobs, threads, keep)
        _show_batch(scenes, outcomes, time.perf_counter() - start)
        if bop is not None:
            ids = _bop_ids(scenes)
            write_bop(bop, [(*ids[i], *outcomes[i].row()) for i in range(len(scenes))], obj_id)
    except ERRORS as error:
        fail(error)
    except KeyboardInterrupt:
        hint = "; with --skip-existing the batch goes on from here" if output is not None else ""
        err.print(f"ibi: interrupted{hint}", highlight=False, markup=False, soft_wrap=True)
        raise typer.Exit(INTERRUPTED) from None
    if any(one.has_failed for one in outcomes.values()):
        raise typer.Exit(1)


@dataclass(frozen=True, eq=False, repr=False)
class _TimedJob(ibi.Job):
    """Remembers how long it took, reading included; in threads of this process, which share it."""

    seconds: list[float] = field(default_factory=list, kw_only=True)

    def run(self, **options: Any) -> ibi.Registration:
        start = time.perf_counter()
        found = super().run(**options)
        self.seconds.append(time.perf_counter() - start)
        return found


@dataclass(frozen=True)
class _Outcome:
    """What a batch keeps of a scan: little, as there may be many."""

    poses: Any
    scores: list[float]
    seconds: float
    has_failed: bool = False
    is_old: bool = False

    def row(self) -> tuple[Any, list[float], float]:
        return self.poses, self.scores, self.seconds


def _outcome(job: _TimedJob, found: ibi.Registration | ibi.JobError) -> _Outcome:
    if isinstance(found, ibi.JobError):
        return _Outcome(np.empty((0, 4, 4)), [], 0.0, has_failed=True)
    return _Outcome(np.asarray(found), [pose.score for pose in found], job.seconds[-1])


def _run_all(
    todo: list[_TimedJob],
    jobs: int | None,
    threads: int | None,
    keep: Callable[[int, ibi.Registration | ibi.JobError], None],
) -> None:
    """Run the jobs, with a bar, and a line for each that fails."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    # Results are printed to stdout: they are not to go where the bar is.
    options: dict[str, Any] = {"transient": True, "redirect_stdout": False, "disable": not err.is_terminal}
    with Progress(*columns, console=err, **options) as progress:
        bar = progress.add_task("detecting", total=len(todo))

        def ended(number: int, found: ibi.Registration | ibi.JobError) -> None:
            if isinstance(found, ibi.JobError):
                name = "" if str(found.name) in found.reason else f"{found.name}: "
                line = f"ibi: {name}{found.reason}"
                progress.console.print(line, highlight=False, markup=False, soft_wrap=True)
            keep(number, found)
            progress.advance(bar)

        for _ in ibi.register_batch(todo, jobs, num_threads=threads, callback=ended):
            pass


def _targets(scenes: list[Path], folder: Path | None) -> list[Path | None]:
    """Name a JSON for each scan; refuse those of one name, of which one would be lost."""
    if folder is None:
        return [None] * len(scenes)
    targets = [folder / f"{scene.stem}.json" for scene in scenes]
    for i, target in enumerate(targets):
        first = targets.index(target)
        if first < i:
            raise ibi.InputError(f"{scenes[i]}: has the JSON {target}, which {scenes[first]} has already")
    return list(targets)


def _old(target: Path | None) -> _Outcome | None:
    """Read what a batch before has written; None if there is none, or none that can be read."""
    try:
        data = json.loads(target.read_text(encoding="utf-8")) if target is not None else {}
        scores = [float(pose["score"]) for pose in data["poses"]]
        poses = np.array([pose["target_from_source"] for pose in data["poses"]], np.float64)
        return _Outcome(poses.reshape(-1, 4, 4), scores, float(data.get("seconds", 0)), is_old=True)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _bop_ids(scenes: list[Path]) -> list[tuple[int, int]]:
    """scene_id and im_id by the names of folders and files, or by counting."""
    ids = []
    for scene in scenes:
        numbers = re.findall(r"\d+", scene.stem)
        folder = Path(os.path.abspath(scene)).parent.name  # not of what a link leads to
        ids.append((int(folder) if folder.isdecimal() else 0, int(numbers[-1]) if numbers else -1))
    is_clear = len(set(ids)) == len(ids) and all(number >= 0 for _, number in ids)
    return ids if is_clear else [(folder, i) for i, (folder, _) in enumerate(ids)]


def _show_batch(scenes: list[Path], outcomes: dict[int, _Outcome], seconds: float) -> None:
    table = Table(box=None, pad_edge=False)
    table.add_column("scan", overflow="fold")
    for column in ("found", "best score", "seconds", ""):
        table.add_column(column, justify="right", no_wrap=True)
    for i, scene in enumerate(scenes):
        one = outcomes[i]
        note = "failed" if one.has_failed else "kept" if one.is_old else ""
        best = f"{max(one.scores):.2f}" if one.scores else ""
        cells = ("", "", "") if one.has_failed else (str(len(one.scores)), best, f"{one.seconds:.2f}")
        table.add_row(str(scene), *cells, note)
    out.print(table)
    failed = sum(one.has_failed for one in outcomes.values())
    found = sum(len(one.scores) for one in outcomes.values())
    line = f"{found} found in {len(scenes)} scans, {failed} of which failed; {seconds:.2f} s"
    out.print(line, highlight=False)
