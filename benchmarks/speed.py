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

import argparse
import csv
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import ibi_rs as ibi
import numpy as np
from accuracy import RECORDS, register
from ibi_rs import metrics, synth
from layouts import scene_of, seeds
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

FIGURES = Path(__file__).parents[1] / "docs/figures"
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


@dataclass(frozen=True)
class Memory:
    """Peak memory of a process in MB, 2^20 bytes."""

    rise: float
    total: float


def timed(scene: synth.Scene, params: ibi.Params, num_threads: int) -> Run:
    """Register a scene, on the clock."""
    start = time.perf_counter()
    found = register(scene, params, num_threads)
    seconds = time.perf_counter() - start
    stages = {name: getattr(found.timings, name) for name in STAGES}
    return Run(seconds, stages, metrics.score_scene(found, scene.poses).f1)


def median_run(scene: synth.Scene, params: ibi.Params, num_threads: int, repeats: int) -> Run:
    """Register a scene once to warm up and then so many times; return the run of median time."""
    timed(scene, params, num_threads)
    return middle([timed(scene, params, num_threads) for _ in range(repeats)])


def middle(runs: list[Run]) -> Run:
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


def memory(scene: synth.Scene, params: ibi.Params, num_threads: int) -> Memory:
    """Register a scene in a fresh process."""
    arrays = {name: getattr(scene, name) for name in ("src", "tgt", "corr", "src_normals", "tgt_normals")}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.npz"
        np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
        command = [sys.executable, "-c", CHILD, str(path), json.dumps(params.to_dict()), str(num_threads)]
        answer = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return Memory(*json.loads(answer))


def write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write a record."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        out = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        out.writeheader()
        out.writerows(rows)


# Rows -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """One row of the table: scenes, parameters, and the time and memory aimed at."""

    name: str
    scenes: Callable[[], Iterator[synth.Scene]]
    target: str
    params: ibi.Params = ibi.Params()  # noqa: RUF009 (immutable)
    max_repeats: int = 100


def outlier_scenes(count: int, **options: Any) -> Iterator[synth.Scene]:
    """Make outlier layouts of the seeds from 0."""
    return (synth.outlier_layout(seed, **options) for seed in range(count))


def ecc_scenes(count: int) -> Iterator[synth.Scene]:
    """Make the first ECC layouts of the accuracy tables."""
    return (scene_of("ecc-0.02", "reporting", seed) for seed in seeds("ecc-0.02", "reporting", count))


usual_outliers = partial(
    outlier_scenes, 4, num_correspondences=5000, num_instances=20, outlier_ratio=(0.7, 0.9)
)
LARGE = {
    "num_correspondences": 100_000,
    "num_instances": 100,
    "outlier_ratio": 0.8,
    "num_points": 9000,
    "num_clutter": 100_000,
    "jitter_pr": 0.25,
}
ROWS = (
    Row("outlier layout, 70-90 % outliers", usual_outliers, "10 ms"),
    Row("ECC layout, noise 0.02", partial(ecc_scenes, 6), "10 ms"),
    Row("outlier layout, paper_synthetic", usual_outliers, "100 ms", ibi.Params.paper_synthetic()),
    Row(
        "20 000 correspondences",
        partial(outlier_scenes, 2, num_correspondences=20_000, num_instances=50, outlier_ratio=0.8),
        "60 ms, 300 MB",
    ),
    Row(
        "100 000 correspondences, 1 M points",
        partial(outlier_scenes, 1, **LARGE),
        "1 s, 1.5 GB",
        max_repeats=3,
    ),
    Row(
        "no outliers, 5 instances",
        partial(outlier_scenes, 4, num_correspondences=5000, num_instances=5, outlier_ratio=0),
        "20 ms",
    ),
    Row(
        "no outliers, 1 instance",
        partial(
            outlier_scenes, 4, num_correspondences=5000, num_instances=1, outlier_ratio=0, num_points=5000
        ),
        "20 ms",
    ),
)


def span(values: list[int]) -> str:
    """Write equal numbers as one, others as a range."""
    low, high = min(values), max(values)
    return str(low) if low == high else f"{low}-{high}"


def run_rows(repeats: int) -> list[dict[str, Any]]:
    """Print the table line by line, as Markdown; return what the record holds."""
    names = [name.removesuffix("_s") for name in [*STAGES, "other_s"]]
    heads = ["row", "scenes", "M", "K", "Q", "threads", "ms", "target", "MHF1", "MB more", "MB in all"]
    heads += [f"{name} ms" for name in names]
    print(f"\n| {' | '.join(heads)} |\n|{'---|' * len(heads)}", flush=True)
    record = []
    for row in ROWS:
        scenes = list(row.scenes())
        for num_threads in THREADS:
            # Only with as many threads as the targets are for.
            used = memory(scenes[0], row.params, num_threads) if num_threads == THREADS[0] else None
            runs = [
                median_run(scene, row.params, num_threads, min(repeats, row.max_repeats)) for scene in scenes
            ]
            record += [
                {
                    "version": ibi.__version__,
                    "row": row.name,
                    "threads": num_threads,
                    "scene": scene.name,
                    "M": len(scene.corr),
                    "K": scene.num_instances,
                    "Q": len(scene.tgt),
                    "ms": f"{1e3 * run.seconds:.2f}",
                    "f1": f"{run.f1:.4f}",
                    "rss_mb": f"{used.rise:.1f}" if used and scene is scenes[0] else "",
                    "rss_total_mb": f"{used.total:.1f}" if used and scene is scenes[0] else "",
                    **{name: f"{seconds:.5f}" for name, seconds in run.stages_and_other().items()},
                }
                for scene, run in zip(scenes, runs, strict=True)
            ]
            cells = [
                row.name,
                str(len(scenes)),
                span([len(scene.corr) for scene in scenes]),
                span([scene.num_instances for scene in scenes]),
                span([len(scene.tgt) for scene in scenes]),
                str(num_threads),
                f"{1e3 * np.median([run.seconds for run in runs]):.1f}",
                row.target,
                f"{np.mean([run.f1 for run in runs]):.3f}",
                f"{used.rise:.0f}" if used else "",
                f"{used.total:.0f}" if used else "",
                *(f"{1e3 * seconds:.1f}" for seconds in middle(runs).stages_and_other().values()),
            ]
            print(f"| {' | '.join(cells)} |", flush=True)
    return record


# Scaling --------------------------------------------------------------------------------------------------

# One shape and one seed, so that nothing but the size differs along a sweep.
outliers = partial(synth.outlier_layout, 0, shape=synth.SHAPES[0])


def by_m(m: int) -> synth.Scene:
    """Scene of so many correspondences among 100 000 target points."""
    return outliers(
        num_correspondences=m, num_instances=20, outlier_ratio=0.8, num_points=2000, num_clutter=60_000
    )


def by_k(k: int) -> synth.Scene:
    """Scene of so many instances among 250 000 target points."""
    return outliers(
        num_correspondences=10_000,
        num_instances=k,
        outlier_ratio=0.8,
        num_points=2048,
        num_clutter=250_000 - 2048 * k,
    )


def by_q(q: int) -> synth.Scene:
    """Scene of so many target points."""
    return outliers(
        num_correspondences=1000,
        num_instances=5,
        outlier_ratio=0.8,
        num_points=150,
        num_clutter=q - 5 * 150,
    )


def by_inlier_share(share: float) -> synth.Scene:
    """Scene of that share of true pairs."""
    return outliers(num_correspondences=5000, num_instances=5, outlier_ratio=round(1 - share, 6))


@dataclass(frozen=True)
class Sweep:
    """One size that varies, from the easy end to the hard one."""

    label: str
    make: Callable[[Any], synth.Scene]
    sizes: tuple[float, ...]
    fixed: str
    threads: tuple[int, ...] = (2,)


SWEEPS = {
    "M": Sweep("correspondences", by_m, (1000, 3000, 10_000, 30_000, 100_000), "K 20, 80 % outliers"),
    "K": Sweep("instances", by_k, (1, 3, 10, 30, 100), "M 10 000, 80 % outliers"),
    "Q": Sweep("target points", by_q, (1000, 10_000, 100_000, 1_000_000), "M 1000, K 5, 80 % outliers"),
    "inliers": Sweep(
        "share of true pairs (1 - outlier ratio)",
        by_inlier_share,
        (1, 0.5, 0.2, 0.1, 0.05, 0.01),
        "M 5000, K 5",
    ),
    "threads": Sweep("threads", by_m, (10_000,), "M 10 000, K 20, 80 % outliers", (1, 2)),
}


@dataclass(frozen=True)
class Point:
    """One scene of a sweep, measured."""

    sweep: str
    size: float
    threads: int
    scene: synth.Scene
    run: Run
    memory: Memory

    def row(self) -> dict[str, Any]:
        """Return what the record holds."""
        return {
            "version": ibi.__version__,
            "sweep": self.sweep,
            "size": f"{self.size:g}" if self.size < 1 else int(self.size),
            "threads": self.threads,
            "scene": self.scene.name,
            "M": len(self.scene.corr),
            "K": self.scene.num_instances,
            "N": len(self.scene.src),
            "Q": len(self.scene.tgt),
            "ms": f"{1e3 * self.run.seconds:.2f}",
            "f1": f"{self.run.f1:.4f}",
            "rss_mb": f"{self.memory.rise:.1f}",
            "rss_total_mb": f"{self.memory.total:.1f}",
            **{name: f"{seconds:.5f}" for name, seconds in self.run.stages_and_other().items()},
        }


def exponent(x: list[float], y: list[float]) -> tuple[float, float]:
    """Fit y = a x^b by least squares of the logarithms; return b and a."""
    slope, offset = np.polyfit(np.log(x), np.log(y), 1)
    return float(slope), float(np.exp(offset))


def run_scaling(repeats: int) -> list[Point]:
    """Print a line per scene and the exponents, as Markdown."""
    params = ibi.Params()
    heads = ("sweep", "size", "threads", "ms", "MHF1", "MB more", "MB in all")
    print(f"\n| {' | '.join(heads)} |\n|{'---|' * len(heads)}", flush=True)
    points = []
    for name, sweep in SWEEPS.items():
        for size in sweep.sizes:
            scene = sweep.make(size)
            for num_threads in sweep.threads:
                run = median_run(scene, params, num_threads, repeats)
                points.append(Point(name, size, num_threads, scene, run, memory(scene, params, num_threads)))
                row = points[-1].row()
                cells = [
                    str(row[key])
                    for key in ("sweep", "size", "threads", "ms", "f1", "rss_mb", "rss_total_mb")
                ]
                print(f"| {' | '.join(cells)} |", flush=True)
    print("\n| time grows with | fixed | exponent | over the last step |\n|---|---|---|---|")
    for name, sweep in SWEEPS.items():
        part = [point for point in points if point.sweep == name]
        x = [point.threads if len(sweep.threads) > 1 else point.size for point in part]
        y = [point.run.seconds for point in part]
        last = exponent(x[-2:], y[-2:])[0]
        print(f"| {sweep.label} | {sweep.fixed} | {exponent(x, y)[0]:.2f} | {last:.2f} |", flush=True)
    return points


def draw(points: list[Point], path: Path) -> None:
    """Draw time over each size, a panel each, with the fitted power."""
    drawn = [name for name, sweep in SWEEPS.items() if len(sweep.sizes) > 1]
    figure = Figure(figsize=(9, 7.5), layout="constrained")
    FigureCanvasAgg(figure)
    for i, name in enumerate(drawn):
        axes = figure.add_subplot(2, 2, i + 1)
        part = [point for point in points if point.sweep == name]
        x, y = [point.size for point in part], [1e3 * point.run.seconds for point in part]
        slope, factor = exponent(x, y)
        axes.loglog(x, y, marker="o", zorder=2, label="measured")
        ends = np.array([min(x), max(x)])
        axes.loglog(
            ends, factor * ends**slope, color="0.5", linestyle="--", zorder=1, label=f"exponent {slope:.2f}"
        )
        # Where instances are missed, the time is that of another task.
        missed = [point for point in part if point.run.f1 < 0.9]
        if missed:
            axes.loglog(
                [point.size for point in missed],
                [1e3 * point.run.seconds for point in missed],
                "o",
                color="tab:red",
                zorder=3,
                label="MHF1 below 0.9",
            )
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
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


# Stages of your own ---------------------------------------------------------------------------------------


def own_off(_context: ibi.stages.StageContext, seeds: ibi.stages.Ranked) -> ibi.stages.Ranked:
    """CE ``off`` as a callable: it does nothing, so that what it takes is the call."""
    return seeds


def run_stages(repeats: int) -> None:
    """Print what calls into Python cost: runs with ``ce="off"``, and with a callable that does the same."""
    heads = ("M", "threads", "calls", "us a call", "ms, ce=off", "ms, ce=callable")
    print(f"\n| {' | '.join(heads)} |\n|{'---|' * len(heads)}", flush=True)
    for size in (1000, 10_000, 100_000):
        scene = by_m(size)
        for num_threads in (1, 2):
            ms = {}
            for name, ce in (("off", ibi.Off()), ("own", own_off)):
                params = ibi.Params(ce=ce)
                ms[name] = 1e3 * median_run(scene, params, num_threads, repeats).seconds
            found = [register(scene, ibi.Params(ce=own_off), num_threads) for _ in range(repeats)]
            calls = len(found[0].rounds)
            us = 1e6 * np.median([each.timings.ce_s for each in found]) / calls
            cells = (size, num_threads, calls, f"{us:.0f}", f"{ms['off']:.1f}", f"{ms['own']:.1f}")
            print(f"| {' | '.join(map(str, cells))} |", flush=True)


def main() -> None:
    """Run, print, record, draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--part", nargs="+", choices=("rows", "scaling", "stages"), default=["rows", "scaling"]
    )
    parser.add_argument(
        "--repeats", type=int, help="timed runs of each scene; default: rows and stages 9, scaling 3"
    )
    parser.add_argument(
        "--out",
        type=Path,
        help="folder for the records and the picture; by default benchmarks/records and docs/figures, and "
        "none at all with --repeats",
    )
    args = parser.parse_args()
    if args.repeats is not None and args.repeats < 1:
        parser.error("--repeats must be at least 1")
    keep = args.repeats is None or args.out is not None
    print(f"{os.cpu_count()} cores, {platform.machine()}, ibi_rs {ibi.__version__}", flush=True)
    if "rows" in args.part:
        record = run_rows(args.repeats or 9)
        if keep:
            write_csv((args.out or RECORDS) / "speed.csv", record)
    if "stages" in args.part:
        run_stages(args.repeats or 9)
    if "scaling" in args.part:
        points = run_scaling(args.repeats or 3)
        if keep:
            write_csv((args.out or RECORDS) / "scaling.csv", [point.row() for point in points])
            draw(points, (args.out or FIGURES) / "scaling.png")


if __name__ == "__main__":
    main()
