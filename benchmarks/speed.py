"""How fast `ibi_rs.register` is, and how its time grows: prints tables, records them, draws the growth.

    python benchmarks/speed.py                         # or: make bench-speed
    python benchmarks/speed.py --part rows --repeats 3
    python benchmarks/speed.py --part stages           # what a stage of your own costs; leaves no record

Time is that of the whole call from Python. Of a scene the median over the repeats counts, of a row the median
over its scenes; one run before them warms up. Stages are those of the run nearest to that median; `other` is
what lies outside all stages: the conversion of the input, removal, the checks at the end. Memory is measured
in a process of its own that has loaded the scene and then calls once: how far that call raises the peak, and
the peak itself. MHF1 is one to one, below 20 degrees and 0.5 radii, as in benchmarks/accuracy.py.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import ibi_rs as ibi
import numpy as np
from frame import cli, plots, records
from frame.layouts import scenes as scenes_of
from frame.ours import register
from frame.tables import head, line, number, show
from frame.timing import exponent, timed
from ibi_rs import metrics, synth
from matplotlib.ticker import LogLocator, NullFormatter

STAGES = [field.name for field in fields(ibi.registration.Timings) if field.name != "total_s"]
THREADS = (2, 1)


@dataclass(frozen=True)
class Run:
    """One timed call."""

    seconds: float
    stages: dict[str, float]
    f1: float

    def stages_and_other(self) -> dict[str, float]:
        """Seconds of the stages, and what is left."""
        return {**self.stages, "other_s": max(self.seconds - sum(self.stages.values()), 0)}


def one_run(scene: synth.Scene, params: ibi.Params, num_threads: int) -> Run:
    """Register a scene, on the clock."""
    seconds, found = timed(register, scene, params, num_threads)
    stages = {name: getattr(found.timings, name) for name in STAGES}
    return Run(seconds, stages, metrics.score_scene(found, scene.poses).f1)


def median_run(scene: synth.Scene, params: ibi.Params, num_threads: int, repeats: int) -> Run:
    """Register a scene once to warm up and then so many times; return the run of median time."""
    one_run(scene, params, num_threads)
    return middle([one_run(scene, params, num_threads) for _ in range(repeats)])


def middle(runs: Sequence[Run]) -> Run:
    """Return the run nearest to the median time."""
    median = np.median([run.seconds for run in runs])
    return min(runs, key=lambda run: abs(run.seconds - median))


# On Linux ru_maxrss of a child begins at what its parent holds, and this one holds large scenes: VmHWM begins
# anew with the program.
CHILD = """
import json, resource, sys
import numpy as np
import ibi_rs as ibi

def peak():
    try:
        with open("/proc/self/status", encoding="ascii") as status:
            return next(int(line.split()[1]) for line in status if line.startswith("VmHWM")) / 1024
    except OSError:
        unit = 1 << 20 if sys.platform == "darwin" else 1 << 10
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit

path, params, num_threads = sys.argv[1:]
with np.load(path) as file:
    scene = dict(file)
params = ibi.Params.from_dict(json.loads(params))
before = peak()
ibi.register(**scene, params=params, num_threads=int(num_threads))
after = peak()
print(json.dumps([after - before, after]))
"""


def memory(scene: synth.Scene, params: ibi.Params, num_threads: int) -> tuple[float, float]:
    """Register a scene in a fresh process: how far that raises its peak, and the peak, in MB of 2^20."""
    arrays = {name: getattr(scene, name) for name in ("src", "tgt", "corr", "src_normals", "tgt_normals")}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.npz"
        np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
        command = [sys.executable, "-c", CHILD, str(path), json.dumps(params.to_dict()), str(num_threads)]
        answer = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    rise, peak = json.loads(answer)
    return rise, peak


@dataclass(frozen=True)
class Point:
    """One scene, measured."""

    what: dict[str, Any]
    threads: int
    scene: synth.Scene
    run: Run
    memory: tuple[float, float] | None

    def columns(self) -> dict[str, Any]:
        """Return what the records hold."""
        rise, peak = self.memory or (None, None)
        return {
            "version": ibi.__version__,
            **self.what,
            "threads": self.threads,
            "scene": self.scene.name,
            "M": len(self.scene.corr),
            "K": self.scene.num_instances,
            "N": len(self.scene.src),
            "Q": len(self.scene.tgt),
            "ms": f"{1e3 * self.run.seconds:.2f}",
            "f1": f"{self.run.f1:.4f}",
            "rss_mb": number(rise, ".1f"),
            "rss_total_mb": number(peak, ".1f"),
            **{name: f"{seconds:.5f}" for name, seconds in self.run.stages_and_other().items()},
        }


# Rows -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """One row of the table: scenes, parameters, and the time and memory aimed at."""

    name: str
    scenes: Callable[[], Iterator[synth.Scene]]
    target: str
    params: ibi.Params = ibi.Params()  # noqa: RUF009 (immutable)
    max_repeats: int = 100


def outliers(
    m: int, k: int, ratio: float | tuple[float, float], seed: int = 0, **options: Any
) -> synth.Scene:
    """Make an outlier layout of so many correspondences and instances."""
    return synth.outlier_layout(seed, num_correspondences=m, num_instances=k, outlier_ratio=ratio, **options)


def first(count: int, *scene: Any, **options: Any) -> Callable[[], Iterator[synth.Scene]]:
    """Return what makes `outliers` of so many seeds."""
    return lambda: (outliers(*scene, seed=seed, **options) for seed in range(count))


USUAL = first(4, 5000, 20, (0.7, 0.9))
LARGE = first(1, 100_000, 100, 0.8, num_points=9000, num_clutter=100_000, jitter_pr=0.25)
ECC = partial(scenes_of, "ecc-0.02", "reporting", 6)
ROWS = (
    Row("outlier layout, 70-90 % outliers", USUAL, "10 ms"),
    Row("ECC layout, noise 0.02", ECC, "10 ms"),
    Row("outlier layout, paper_synthetic", USUAL, "100 ms", ibi.Params.paper_synthetic()),
    Row("20 000 correspondences", first(2, 20_000, 50, 0.8), "60 ms, 300 MB"),
    Row("100 000 correspondences, 1 M points", LARGE, "1 s, 1.5 GB", max_repeats=3),
    Row("no outliers, 5 instances", first(4, 5000, 5, 0), "20 ms"),
    Row("no outliers, 1 instance", first(4, 5000, 1, 0, num_points=5000), "20 ms"),
)


def span(values: list[int]) -> str:
    """Write equal numbers as one, others as a range."""
    low, high = min(values), max(values)
    return str(low) if low == high else f"{low}-{high}"


def run_rows(repeats: int) -> list[dict[str, Any]]:
    """Print the table line by line, as Markdown; return what the record holds."""
    names = [name.removesuffix("_s") for name in [*STAGES, "other_s"]]
    heads = ["row", "scenes", "M", "K", "Q", "threads", "ms", "target", "MHF1", "MB more", "MB in all"]
    show(f"\n{head([*heads, *(f'{name} ms' for name in names)])}")
    record: list[dict[str, Any]] = []
    for row in ROWS:
        scenes, most = list(row.scenes()), min(repeats, row.max_repeats)
        for num_threads in THREADS:
            # Only with as many threads as the targets are for, and of the first scene.
            used = memory(scenes[0], row.params, num_threads) if num_threads == THREADS[0] else None
            runs = [median_run(scene, row.params, num_threads, most) for scene in scenes]
            points = [
                Point({"row": row.name}, num_threads, scene, run, None if i else used).columns()
                for i, (scene, run) in enumerate(zip(scenes, runs, strict=True))
            ]
            record += [{key: value for key, value in point.items() if key != "N"} for point in points]
            cells = [
                *(row.name, len(scenes), *(span([point[key] for point in points]) for key in "MKQ")),
                num_threads,
                f"{1e3 * np.median([run.seconds for run in runs]):.1f}",
                row.target,
                f"{np.mean([run.f1 for run in runs]):.3f}",
                *(number(mb, ".0f") for mb in used or (None, None)),
                *(f"{1e3 * seconds:.1f}" for seconds in middle(runs).stages_and_other().values()),
            ]
            show(line(cells))
    return record


# Scaling --------------------------------------------------------------------------------------------------

# One shape and one seed, so that nothing but the size differs along a sweep.
alike = partial(outliers, shape=synth.SHAPES[0])


def by_m(m: int) -> synth.Scene:
    """Scene of so many correspondences among 100 000 target points."""
    return alike(m, 20, 0.8, num_points=2000, num_clutter=60_000)


def by_k(k: int) -> synth.Scene:
    """Scene of so many instances among 250 000 target points."""
    return alike(10_000, k, 0.8, num_points=2048, num_clutter=250_000 - 2048 * k)


def by_q(q: int) -> synth.Scene:
    """Scene of so many target points."""
    return alike(1000, 5, 0.8, num_points=150, num_clutter=q - 5 * 150)


def by_inlier_share(share: float) -> synth.Scene:
    """Scene of that share of true pairs."""
    return alike(5000, 5, round(1 - share, 6))


@dataclass(frozen=True)
class Sweep:
    """One size that varies, from the easy end to the hard one."""

    label: str
    make: Callable[[Any], synth.Scene]
    sizes: tuple[float, ...]
    fixed: str
    threads: tuple[int, ...] = (2,)


SHARE = "share of true pairs (1 - outlier ratio)"
SWEEPS = {
    "M": Sweep("correspondences", by_m, (1000, 3000, 10_000, 30_000, 100_000), "K 20, 80 % outliers"),
    "K": Sweep("instances", by_k, (1, 3, 10, 30, 100), "M 10 000, 80 % outliers"),
    "Q": Sweep("target points", by_q, (1000, 10_000, 100_000, 1_000_000), "M 1000, K 5, 80 % outliers"),
    "inliers": Sweep(SHARE, by_inlier_share, (1, 0.5, 0.2, 0.1, 0.05, 0.01), "M 5000, K 5"),
    "threads": Sweep("threads", by_m, (10_000,), "M 10 000, K 20, 80 % outliers", (1, 2)),
}


def run_scaling(repeats: int) -> dict[str, list[Point]]:
    """Print a line per scene and the exponents, as Markdown; return the points of each sweep."""
    params = ibi.Params()
    show(f"\n{head(('sweep', 'size', 'threads', 'ms', 'MHF1', 'MB more', 'MB in all'))}")
    points: dict[str, list[Point]] = {name: [] for name in SWEEPS}
    for name, sweep in SWEEPS.items():
        for size in sweep.sizes:
            scene = sweep.make(size)
            what = {"sweep": name, "size": f"{size:g}" if size < 1 else int(size)}
            for num_threads in sweep.threads:
                run = median_run(scene, params, num_threads, repeats)
                used = memory(scene, params, num_threads)
                points[name].append(Point(what, num_threads, scene, run, used))
                columns = points[name][-1].columns()
                keys = ("sweep", "size", "threads", "ms", "f1", "rss_mb", "rss_total_mb")
                show(line(columns[key] for key in keys))
    show(f"\n{head(('time grows with', 'fixed', 'exponent', 'over the last step'))}")
    for name, sweep in SWEEPS.items():
        x = [float(point.what["size"]) for point in points[name]]
        x = [float(n) for n in sweep.threads] if len(sweep.threads) > 1 else x
        y = [point.run.seconds for point in points[name]]
        last = exponent(x[-2:], y[-2:])[0]
        show(line((sweep.label, sweep.fixed, f"{exponent(x, y)[0]:.2f}", f"{last:.2f}")))
    return points


def draw(points: dict[str, list[Point]], path: Path) -> None:
    """Draw time over each size, a panel each, with the fitted power."""
    drawn = [name for name, sweep in SWEEPS.items() if len(sweep.sizes) > 1]
    figure, panels = plots.panels((9, 7.5), 2, 2)
    for axes, name in zip(panels, drawn, strict=True):
        x = [float(point.what["size"]) for point in points[name]]
        y = [1e3 * point.run.seconds for point in points[name]]
        slope, factor = exponent(x, y)
        axes.loglog(x, y, marker="o", zorder=2, label="measured")
        ends = np.array([min(x), max(x)])
        axes.loglog(
            ends, factor * ends**slope, color="0.5", linestyle="--", zorder=1, label=f"exponent {slope:.2f}"
        )
        # Where instances are missed, the time is that of another task.
        missed = [(a, b) for a, b, point in zip(x, y, points[name], strict=True) if point.run.f1 < 0.9]
        if missed:
            axes.loglog(*zip(*missed, strict=True), "o", color="tab:red", zorder=3, label="MHF1 below 0.9")
        axes.set(xlabel=SWEEPS[name].label, ylabel="ms", title=SWEEPS[name].fixed)
        # At least a decade, so that noise does not look like growth.
        low, high = axes.get_ylim()
        if high < 10 * low:
            center = np.sqrt(low * high)
            axes.set_ylim(center / 10**0.5, center * 10**0.5)
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
        if x[0] > x[-1]:
            axes.invert_xaxis()
        axes.grid(color="0.9")
        axes.legend()
    plots.save(figure, path, 90)


# Stages of your own ---------------------------------------------------------------------------------------


def own_off(_context: ibi.stages.StageContext, seeds: ibi.stages.Ranked) -> ibi.stages.Ranked:
    """CE ``off`` as a callable: it does nothing, so that what it takes is the call."""
    return seeds


def run_stages(repeats: int) -> None:
    """Print what calls into Python cost: runs with ``ce="off"``, and with a callable that does the same."""
    heads = ("M", "threads", "calls", "us a call", "ms, ce=off", "ms, ce=callable")
    show(f"\n{head(heads)}")
    for size in (1000, 10_000, 100_000):
        scene = by_m(size)
        for num_threads in (1, 2):
            ms = {
                name: 1e3 * median_run(scene, ibi.Params(ce=ce), num_threads, repeats).seconds
                for name, ce in (("off", ibi.Off()), ("own", own_off))
            }
            found = [register(scene, ibi.Params(ce=own_off), num_threads) for _ in range(repeats)]
            calls = len(found[0].rounds)
            us = 1e6 * np.median([each.timings.ce_s for each in found]) / calls
            show(line((size, num_threads, calls, f"{us:.0f}", f"{ms['off']:.1f}", f"{ms['own']:.1f}")))


def main() -> None:
    """Run, print, record, draw."""
    parts = ("rows", "scaling", "stages")
    args = cli.parse(
        __doc__,
        cli.option("--part", nargs="+", choices=parts, default=["rows", "scaling"]),
        cli.option("--repeats", type=int, help="timed runs of each; default: rows and stages 9, scaling 3"),
        cli.out("part"),
    )
    if args.repeats is not None and args.repeats < 1:
        args.error("--repeats must be at least 1")
    cli.machine()
    if "rows" in args.part:
        records.write(args.records, "speed.csv", run_rows(args.repeats or 9))
    if "stages" in args.part:
        run_stages(args.repeats or 9)
    if "scaling" in args.part:
        points = run_scaling(args.repeats or 3)
        if args.records:
            rows = [point.columns() for of_sweep in points.values() for point in of_sweep]
            records.write(args.records, "scaling.csv", rows)
            draw(points, args.pictures / "scaling.png")


if __name__ == "__main__":
    main()
