"""The command `ibi`. Needs typer, rich and the readers: ``pip install 'ibi_rs[cli]'``."""

from __future__ import annotations

import csv
import functools
import json
import os
import platform
import re
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NoReturn

import numpy as np

import ibi_rs as ibi
from ibi_rs import _batch, io, metrics
from ibi_rs.symmetries import _bop_entry as bop_entry

try:
    import typer
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
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
class _Search:
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
        mesh = io.read_mesh(path)
        wanted = None if self.symmetries == "find" else _symmetries(self.symmetries, mesh[0])
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

    def job(self, model: ibi.Model, scene: Path) -> _TimedJob:
        """Without a viewpoint a job takes the normals of its file."""
        sight = self.sight(None)
        return _TimedJob(model, scene, params=self.params, **sight, **self.limits(None))

    def limits(self, num_threads: int | None) -> dict[str, Any]:
        return {
            "max_instances": self.max_instances,
            "timeout_s": self.timeout_s,
            "num_threads": num_threads,
        }


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
        _fail("--corr brings the matches: --voxel, --remove-plane and --from-all-sides have no say then")
    chosen = _params(preset, params)
    search = _Search(
        viewpoint, from_all_sides, voxel, remove_plane, chosen, max_instances, timeout_s, symmetries
    )
    options = search.limits(threads)
    pairs: Any = None
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
        _show(found, seconds)
        if not held.is_none:
            out.print(f"modulo {held!r}", style="dim", highlight=False)
        if output is not None:
            _write_json(output, _as_dict(found, model, scene, seconds))
        if bop is not None:
            _write_bop(bop, [(0, 0, np.asarray(found), [pose.score for pose in found], seconds)])
        if plot is not None:
            ibi.plot.instances(tgt, src, found, plot, title=f"{scene.name}: {len(found)} x {model.name}")
        if rerun is not None:
            if corr is None:  # once more, as `detect` keeps them to itself
                matches = part.correspond(tgt, **search.sight(tgt_normals), num_threads=threads)
                pairs = src[matches.corr[:, 0]], matches.tgt[matches.corr[:, 1]]
            ibi.viz.record(tgt, src, found, rerun, corr=pairs)
    except ERRORS as error:
        _fail(error)
    if len(found) == 0:
        raise typer.Exit(FOUND_NOTHING)


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
        _fail("--skip-existing looks into the folder of -o; give it")
    chosen = _params(preset, params)
    search = _Search(
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
        todo = [search.job(part, scenes[i]) for i in new]

        def keep(number: int, found: ibi.Registration | ibi.JobError) -> None:
            i = new[number]
            if not isinstance(found, ibi.JobError):
                found = found.canonical(part.symmetries)
            outcome = _outcome(todo[number], found)
            target = targets[i]
            if target is not None and not isinstance(found, ibi.JobError):
                _write_json(target, _as_dict(found, model, scenes[i], outcome.seconds))
            outcomes[i] = outcome

        _run_all(todo, jobs, threads, keep)
        _show_batch(scenes, outcomes, time.perf_counter() - start)
        if bop is not None:
            ids = _bop_ids(scenes)
            _write_bop(bop, [(*ids[i], *outcomes[i].row()) for i in range(len(scenes))], obj_id)
    except ERRORS as error:
        _fail(error)
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


@app.command()
def bench(
    model: Annotated[
        Path | None,
        typer.Argument(help="Mesh of the part. Without one a synthetic scene is timed.", metavar="MODEL"),
    ] = None,
    scene: Annotated[Path | None, typer.Argument(help="Scan, in the same unit.", metavar="SCENE")] = None,
    viewpoint: Viewpoint = (0.0, 0.0, 0.0),
    from_all_sides: FromAllSides = False,
    voxel: Voxel = None,
    remove_plane: RemovePlane = None,
    preset: Preset = None,
    params: ParamsFile = None,
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
        _fail("give MODEL and SCENE, or neither")
    chosen = _params(preset, params)
    search = _Search(viewpoint, from_all_sides, voxel, remove_plane, chosen, max_instances, timeout_s)
    cores = _batch._cores()
    runs: dict[int, list[dict[str, float]]] = {}
    num_poses = 0
    try:
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
            _write_json(output, data)
    except ERRORS as error:
        _fail(error)


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
    search: _Search, model: Path, scene: Path, threads: int
) -> tuple[dict[str, float], ibi.Registration]:
    watch = _Watch()
    mesh = io.read_mesh(model)
    tgt, tgt_normals = io.read_cloud(scene)
    watch.lap("read")
    part = ibi.Model.from_mesh(*mesh, voxel=search.voxel, num_threads=threads)
    watch.lap("model")
    sight = search.sight(tgt_normals)
    matches = part.correspond(tgt, **sight, num_threads=threads)
    watch.lap("match")
    default = ibi.Params() if search.from_all_sides else ibi.Params.single_view()
    found = part.register(
        matches.tgt,
        matches.corr,
        search.params or default,
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


def _time_synthetic(search: _Search, threads: int) -> tuple[dict[str, float], ibi.Registration]:
    scene = _synthetic()
    watch = _Watch()
    part = ibi.Model(scene.src)
    watch.lap("model")
    found = part.register(scene.tgt, scene.corr, search.params, **search.limits(threads))
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
    out.print(table)
    out.print(
        f"{data['num_poses']} found; {data['repeats']} runs of {data['model']}, {data['scene']}",
        highlight=False,
    )
    versions = f"ibi_rs {data['ibi_rs']}, Python {data['python']}, numpy {data['numpy']}"
    out.print(f"{versions}; {data['cores']} cores, {data['cpu']}; {data['platform']}", highlight=False)


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


def _as_dict(found: ibi.Registration, model: Path, scene: Path, seconds: float) -> dict[str, Any]:
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


def _write_json(path: Path, data: dict[str, Any]) -> None:
    """All of it or nothing, so that what is there after Ctrl-C can be relied on."""
    part = path.with_name(f"{path.name}.part")
    part.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    os.replace(part, path)


def _write_bop(
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


def _fail(error: object) -> NoReturn:
    err.print(f"ibi: {error}", highlight=False, markup=False, soft_wrap=True)
    raise typer.Exit(1)


if __name__ == "__main__":
    sys.exit(app())
