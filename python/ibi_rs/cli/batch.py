"""`ibi batch`: many scans."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

import ibi_rs as ibi
from ibi_rs import io
from ibi_rs._files import read_json, try_writing

from .outputs import (
    as_dict,
    millimetres,
    print_table,
    sha256,
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
    ModelFile,
    ParamsFile,
    Preset,
    RemovePlane,
    RemovePlanes,
    Search,
    Set,
    SymmetriesOf,
    TimeoutS,
    Unit,
    Viewpoint,
    Voxel,
    changes_of,
    unit_of,
)
from .terminal import (
    MAX_THREADS,
    Verbose,
    command,
    err,
    misused,
    out,
    say,
    warn,
)


@command()
def batch(
    model: ModelFile,
    scenes: Annotated[
        list[Path],
        typer.Argument(help="Scans, of any kind that `register` reads.", metavar="SCENES"),
    ],
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
    jobs: Annotated[
        int | None, typer.Option(min=1, max=MAX_THREADS, help="Scans at a time. Default: one for each core.")
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option(min=1, max=MAX_THREADS, help="Of each scan. Default: what shares the cores among them."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for the poses: a JSON for each scan.")
    ] = None,
    bop: Annotated[Path | None, typer.Option(help="All poses as BOP's CSV: t in mm.")] = None,
    obj_id: Annotated[int, typer.Option(min=0, help="obj_id in the CSV.")] = 1,
    skip_existing: Annotated[
        bool,
        typer.Option(
            "--skip-existing",
            help="Leave out scans whose JSON is there and would come out the same: resume a batch.",
        ),
    ] = False,
    verbose: Verbose = 0,
) -> None:
    """Find the parts MODEL in each of SCENES, several at a time.

    A folder of scans:      ibi batch part.stl scans/*.ply -o poses

    Go on after a stop:     the same with --skip-existing

    poses/NAME.json is what `ibi register -o` writes of scans/NAME.ply. It says
    what it was made of and how: with --skip-existing a scan is done again whose
    content, MODEL, parameters or options are others now, and a line says why.

    In the CSV im_id is the last number in a scan's name (scan_0012.ply: 12),
    and scene_id the name of its folder where that is a number, as in BOP
    (000003/), else 0. Where a scan has no number, or two have the same, im_id
    counts the scans from 0.

    A scan that fails costs one line and no other scan. After Ctrl-C the table
    is of the scans that are done; the CSV is not written.

    Exit code: 0 if none failed, found or not; 1 if any did, or MODEL cannot be
    used; 2 if the command line is at fault; 130 after Ctrl-C.
    """
    if skip_existing and output is None:
        misused("--skip-existing looks into the folder of -o; give it")
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
    start = time.perf_counter()
    targets = _targets(scenes, output)
    inputs = {"MODEL": model, "--params": params, "--background": background}
    try_outputs({"--bop": bop}, inputs | {f"scan {scene}": scene for scene in scenes})
    _try_folder(output, targets)
    part = search.model(model, None)
    mm = 0.0 if bop is None else millimetres(unit, part.diameter)
    of_model: dict[str, Any] = {"model": model, "model_sha256": sha256(model)}
    recorded = search.recorded(part.symmetries)
    outcomes: dict[int, _Outcome] = {}
    if skip_existing:
        for i, old in _kept(scenes, targets, of_model, recorded, search.params_for()):
            outcomes[i] = old
    new = [i for i in range(len(scenes)) if i not in outcomes]
    # Without a viewpoint a job takes the normals of its file.
    options = [search.sight(None, _place(scenes[i])) | search.limits(None) for i in new]
    # Of an image, or without planes, all is made where the job runs.
    by = search if camera is not None or remove_planes is not None else None
    todo = [
        _TimedJob(part, scenes[i], params=search.params, search=by, **own)
        for i, own in zip(new, options, strict=True)
    ]

    def keep(number: int, found: ibi.Registration | ibi.JobError) -> None:
        i, job = new[number], todo[number]
        if not isinstance(found, ibi.JobError):
            found = search.kept(found)
            for warning in found.warnings:
                warn(f"{scenes[i]}: {warning}")
        outcome = _outcome(job, found)
        target = targets[i]
        if target is not None and not isinstance(found, ibi.JobError):
            of_scene: dict[str, Any] = {"scene": scenes[i], "scene_sha256": job.sha256[-1]}
            write_json(
                target, as_dict(found, outcome.seconds, **of_model, **of_scene, search=recorded, unit=unit)
            )
        outcomes[i] = outcome

    try:
        _run_all(todo, jobs, threads, keep)
    except KeyboardInterrupt:
        _show_batch(scenes, outcomes, time.perf_counter() - start)
        if output is not None:
            say("with --skip-existing the batch goes on from here")
        raise
    except Exception:  # a JSON that cannot be written
        _show_batch(scenes, outcomes, time.perf_counter() - start)
        raise
    _show_batch(scenes, outcomes, time.perf_counter() - start)
    if bop is not None:
        ids = _bop_ids(scenes)
        write_bop(bop, [(*ids[i], *outcomes[i].row()) for i in range(len(scenes))], obj_id, mm=mm)
    if any(one.has_failed for one in outcomes.values()):
        raise typer.Exit(1)


def _place(scene: Path) -> Any:
    """Return where the camera of a scan stood, if its file says so; its job tells if it cannot be read."""
    try:
        return io.read_viewpoint(scene)
    except ibi.InputError:
        return None


@dataclass(frozen=True, eq=False, repr=False)
class _TimedJob(ibi.Job):
    """Remembers of what and how long, reading included; in threads of this process, which share it."""

    seconds: list[float] = field(default_factory=list, kw_only=True)
    sha256: list[str] = field(default_factory=list, kw_only=True)
    search: Search | None = field(default=None, kw_only=True)

    def run(self, **options: Any) -> ibi.Registration:
        start = time.perf_counter()
        assert self.path is not None
        if self.search is None:
            found = super().run(**options)
        else:
            tgt, sight = self.search.look(self.search.read(self.path), self.model.voxel)
            num_threads = options.pop("num_threads", None)
            found = self.model.detect(tgt, self.params, **sight, **self.search.limits(num_threads), **options)
        self.seconds.append(time.perf_counter() - start)
        self.sha256.append(sha256(self.path))
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
            keep(number, found)  # before it is told, so that what was told is in the table
            if isinstance(found, ibi.JobError):
                name = "" if str(found.name) in found.reason else f"{found.name}: "
                say(f"{name}{found.reason}")
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


def _try_folder(folder: Path | None, targets: list[Path | None]) -> None:
    """Make the folder, and see that it can be written to, before anything is run."""
    if folder is None:
        return
    if folder.exists() and not folder.is_dir():
        raise ibi.InputError(f"{folder}: is no folder")
    folder.mkdir(parents=True, exist_ok=True)
    for target in targets:
        if target is not None and (target.exists() or target == targets[0]):
            try_writing(target)


def _kept(
    scenes: list[Path],
    targets: list[Path | None],
    of_model: dict[str, Any],
    search: dict[str, Any],
    params: ibi.Params,
) -> Iterator[tuple[int, _Outcome]]:
    """Give what a batch before has written and this one would write again; say of the rest why not."""
    for i, target in enumerate(targets):
        if target is None or not target.exists():
            continue
        try:
            data = read_json(target)
            outcome = _old(data)
            why = _difference(data, scenes[i], of_model, search, params)
        except (ibi.InputError, KeyError, TypeError, ValueError, AttributeError):
            why = "cannot be read"
        if why is None:
            yield i, outcome
        else:
            say(f"{target.name}: {why}; done again")


def _old(data: dict[str, Any]) -> _Outcome:
    scores = [float(pose["score"]) for pose in data["poses"]]
    poses = np.array([pose["target_from_source"] for pose in data["poses"]], np.float64)
    return _Outcome(poses.reshape(len(scores), 4, 4), scores, float(data["seconds"]), is_old=True)


def _difference(
    data: dict[str, Any],
    scene: Path,
    of_model: dict[str, Any],
    search: dict[str, Any],
    params: ibi.Params,
) -> str | None:
    """Say in what an old result differs from what would be found now; None if in nothing."""
    if not {"model_sha256", "scene_sha256", "search", "params"} <= set(data):
        return "made by an older ibi, which did not write down of what and how"
    if data["model_sha256"] != of_model["model_sha256"]:
        return f"made of another model ({_other(data['model'], of_model['model'])})"
    try:
        if data["scene_sha256"] != sha256(scene):
            return f"made of another scan ({_other(data['scene'], scene)})"
    except OSError as error:
        return f"{scene} cannot be read: {error.strerror}"
    for kind, old, now in (
        ("options", data["search"], search),
        ("parameters", data["params"], params.to_dict()),
    ):
        changes = list(_changes(old, now))
        if changes:
            more = f" and {len(changes) - 3} more" if len(changes) > 3 else ""
            return f"made with other {kind} ({', '.join(changes[:3])}{more})"
    return None


def _other(old: Any, now: Path) -> str:
    return f"{now} has changed" if str(old) == str(now) else f"{old} for {now}"


def _changes(old: dict[str, Any], now: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """Name what two nested dicts differ in: 'hv.t_score 0.9 for 0.5'."""
    for key in dict.fromkeys([*now, *old]):
        name, was, wanted = f"{prefix}{key}", old.get(key), now.get(key)
        if was == wanted:
            continue
        if key == "symmetries":
            yield "other symmetries"
        elif isinstance(was, dict) and isinstance(wanted, dict):
            if was.get("variant") != wanted.get("variant"):  # whose parameters have nothing in common
                yield f"{name} {was.get('variant')} for {wanted.get('variant')}"
            else:
                yield from _changes(was, wanted, f"{name}.")
        else:
            yield f"{name} {_shown(was)} for {_shown(wanted)}"


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(_shown(one) for one in value)
    if value is None or isinstance(value, bool):
        return {None: "none", True: "yes", False: "no"}[value]
    return f"{value:.9g}" if isinstance(value, float) else str(value)


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
        if i not in outcomes:
            continue  # interrupted
        one = outcomes[i]
        note = "failed" if one.has_failed else "kept" if one.is_old else ""
        best = f"{max(one.scores):.2f}" if one.scores else ""
        cells = ("", "", "") if one.has_failed else (str(len(one.scores)), best, f"{one.seconds:.2f}")
        table.add_row(escape(str(scene)), *cells, note)
    print_table(table)
    failed = sum(one.has_failed for one in outcomes.values())
    found = sum(len(one.scores) for one in outcomes.values())
    missing = len(scenes) - len(outcomes)
    rest = f", {missing} not done" if missing else ""
    line = f"{found} found in {len(outcomes)} scans, {failed} of which failed{rest}; {seconds:.2f} s"
    out.print(line, highlight=False)
