"""Registration against other programs on the same correspondences: prints tables, writes record and plot.

    python benchmarks/compare.py                       # or: make bench-peers
    python benchmarks/compare.py --layout fpfh --scenes 3 --repeats 1 --method "PCL GC"
    python benchmarks/compare.py --tune --scenes 3 --method ECC

All run in one process: each method on the first scene, then each on the second, and all of that again, so
that whatever slows the machine down slows all of them. The time of a method on a scene is the median of the
repeats; its ratio to ours is taken within each repeat, and the median of that is kept. What belongs to the
model alone is prepared outside the timing. Scores are those of the first repeat.

The peers and how they are set are in benchmarks/peers, the scenes and the scores those of
benchmarks/accuracy.py, one to one. A peer that cannot run here is a row that says why.
"""

from __future__ import annotations

import argparse
import csv
import os
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import ibi_rs as ibi
import numpy as np
from accuracy import RECORDS, Result, score
from ibi_rs import metrics, synth
from layouts import FIRST_SEED, LAYOUTS, scenes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from peers import METHODS, Missing
from peers.contract import CORES
from peers.methods import OURS, PAPER_ONLY
from peers.settings import SETTINGS, SWEEP, settings

FIGURES = Path(__file__).parents[1] / "docs/figures"
LAYOUTS_RUN = ("outlier-5000", "ecc-0.02", "fpfh")
WITH_MODELNET = "fpfh-modelnet"


@dataclass
class Run:
    """One method on one scene.

    Attributes
    ----------
    method, version : str
    result : Result
        The scores, of the first repeat.
    seconds : list of float
        One for each repeat.
    ratio : float
        Median over the repeats of the time as a multiple of ours, on one thread.
    """

    method: str
    version: str
    result: Result
    seconds: list[float] = field(default_factory=list)
    ratio: float = float("nan")

    @property
    def median_s(self) -> float:
        """Median of the repeats."""
        return float(np.median(self.seconds))

    def row(self, layout: str) -> dict[str, Any]:
        """Return what the record holds."""
        one, strict = self.result.one_to_one, self.result.strict
        return {
            **empty_row(layout, self.method),
            "version": self.version,
            "scene": self.result.scene,
            "K": one.num_truth,
            "M": self.result.num_correspondences,
            **{key: f"{getattr(one, key):.4f}" for key in ("recall", "precision", "f1")},
            "strict_f1": "" if strict is None else f"{strict.f1:.4f}",
            "poses": one.num_predicted,
            "seconds": f"{self.median_s:.5f}",
            "ratio": f"{self.ratio:.3f}",
            "repeats": len(self.seconds),
        }


def empty_row(layout: str, method: str, missing: str = "") -> dict[str, Any]:
    """Return the row of a method that did not run."""
    scores = ("recall", "precision", "f1", "strict_f1")
    keys = ("scene", "K", "M", *scores, "poses", "seconds", "ratio", "repeats")
    return {
        "layout": layout,
        "method": method,
        "threads": METHODS[method].threads,
        "version": "",
        **dict.fromkeys(keys, ""),
        "missing": missing,
    }


def check(methods: Sequence[str]) -> tuple[dict[str, str], dict[str, str]]:
    """Versions of the methods that can run, and why the others cannot."""
    versions, missing = {}, {}
    for name in methods:
        try:
            versions[name] = METHODS[name].module.version()
        except Missing as reason:
            missing[name] = str(reason)
    return versions, missing


def compare(
    layout: str, half: str, todo: Sequence[synth.Scene], versions: dict[str, str], repeats: int
) -> dict[str, list[Run]]:
    """Run methods in turn on scene after scene, and all of it again.

    Returns
    -------
    dict
        Of each method its runs, in the order of the scenes.
    """
    prepared = {
        name: [METHODS[name].prepare(scene, settings(name, layout)) for scene in todo] for name in versions
    }
    runs: dict[str, list[Run]] = {name: [] for name in versions}
    for repeat in range(repeats):
        for i, scene in enumerate(todo):
            for name, version in versions.items():
                start = time.perf_counter()
                poses = prepared[name][i](scene)
                seconds = time.perf_counter() - start
                if repeat == 0:
                    runs[name].append(
                        Run(name, version, score(scene, poses, layout, half, name, 1e3 * seconds))
                    )
                runs[name][i].seconds.append(seconds)
    if OURS in runs:
        for i, ours in enumerate(runs[OURS]):
            for of_method in runs.values():
                of_method[i].ratio = float(np.median(np.divide(of_method[i].seconds, ours.seconds)))
    return runs


# Output ---------------------------------------------------------------------------------------------------


def print_table(layout: str, half: str, runs: dict[str, list[Run]], missing: dict[str, str]) -> None:
    """Print one layout: a line per method."""
    first = next(iter(runs.values()))
    inliers = np.mean([r.result.inlier_share for r in first])
    m = np.mean([r.result.num_correspondences for r in first])
    head = f"{layout}, {half} half: {len(first)} scenes, {m:.0f} correspondences, {inliers:.2%} inliers"
    print(f"\n{head}\n{'method':36s}  MHR    MHP    MHF1   strict poses        ms   x ours")
    for name, of_method in runs.items():
        loose = metrics.mean_score(r.result.one_to_one for r in of_method)
        strict = metrics.mean_score(r.result.strict for r in of_method)
        poses = sum(r.result.one_to_one.num_predicted for r in of_method)
        ms = 1e3 * np.median([r.median_s for r in of_method])
        ratio = np.median([r.ratio for r in of_method])
        print(
            f"{name:36s}  {loose.mhr:.3f}  {loose.mhp:.3f}  {loose.mhf1:.3f}  {strict.mhf1:.3f}  {poses:5d} "
            f"{ms:9.1f}  {ratio:7.2f}",
            flush=True,
        )
    for name, reason in missing.items():
        print(f"{name:36s}  missing: {reason}")


def applies(name: str, layout: str) -> bool:
    """Whether a method is for this layout."""
    return not METHODS[name].needs_normals or layout.startswith("fpfh")


def draw(path: Path, by_layout: dict[str, dict[str, list[Run]]]) -> None:
    """MHF1 against the time, a panel for each layout."""
    figure = Figure(figsize=(4.2 * len(by_layout) + 2.6, 4.2), layout="constrained")
    panels = figure.subplots(1, len(by_layout), sharey=True, squeeze=False)[0]
    markers, handles = "os^DvPX<>*ph", {}
    for panel, (layout, runs) in zip(panels, by_layout.items(), strict=True):
        for i, name in enumerate(METHODS):
            if name not in runs:
                continue
            seconds = np.median([r.median_s for r in runs[name]])
            mhf1 = metrics.mean_score(r.result.one_to_one for r in runs[name]).mhf1
            (handles[name],) = panel.plot(
                seconds, mhf1, markers[i % len(markers)], ms=9 if name.startswith("ibi") else 7,
                color="tab:red" if name.startswith("ibi") else f"C{i}", mec="black", mew=0.6, ls="none",
            )  # fmt: skip
        panel.set(title=layout, xlabel="seconds a scene (median)", xscale="log", ylim=(-0.03, 1.03))
        panel.grid(alpha=0.3, which="both")
    panels[0].set_ylabel("MHF1, one to one")
    figure.legend(handles.values(), handles, loc="outside right center", fontsize=8)
    FigureCanvasAgg(figure)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    print(f"\nwrote {path.name}")


# Tuning ---------------------------------------------------------------------------------------------------


def tune(layout: str, todo: Sequence[synth.Scene], name: str) -> None:
    """Sweep the settings of a method, one after the other, and print each combination tried, best first.

    Begins with the settings as they are. Each one in turn takes the value of its sweep with the best MHF1,
    among equals the fastest, among those within a tenth or so the best by the strict score; twice around.
    """
    tried: dict[tuple[Any, ...], tuple[float, int, float, float]] = {}

    def outcome(values: dict[str, Any]) -> tuple[float, int, float, float]:
        """Score the settings: the least is the best, so scores have their signs turned."""
        key = tuple(values.items())
        if key not in tried:
            results = []
            for scene in todo:
                register = METHODS[name].prepare(scene, values)
                start = time.perf_counter()
                poses = register(scene)
                ms = 1e3 * (time.perf_counter() - start)
                results.append(score(scene, poses, layout, "tuning", name, ms))
            loose = metrics.mean_score(r.one_to_one for r in results).mhf1
            strict = metrics.mean_score(r.strict for r in results).mhf1
            ms = float(np.median([r.ms for r in results]))
            tried[key] = -round(loose, 3), round(np.log(ms) / np.log(1.1)), -strict, ms
        return tried[key]

    best = settings(name, layout)
    for key, values in 2 * list(SWEEP[name].items()):
        best = min(({**best, key: value} for value in dict.fromkeys([best[key], *values])), key=outcome)
    print(f"\n{name}, {layout}, tuning half: {len(todo)} scenes\n MHF1  strict       ms  settings")
    for values, (loose, _, strict, ms) in sorted(tried.items(), key=lambda item: item[1]):
        print(f"{-loose:.3f}  {-strict:.3f}  {ms:7.1f}  {dict(values)}", flush=True)


def main() -> None:
    """Run, print, record, draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--half", choices=FIRST_SEED, default="reporting")
    parser.add_argument("--layout", nargs="+", choices=LAYOUTS, metavar="NAME", help=", ".join(LAYOUTS_RUN))
    parser.add_argument("--method", nargs="+", choices=METHODS, metavar="NAME", help="; ".join(METHODS))
    parser.add_argument("--scenes", type=int, default=10, help="of each layout")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--modelnet", type=Path, help=f"npz file: category/name -> (n, 3); adds {WITH_MODELNET}"
    )
    parser.add_argument(
        "--tune", action="store_true", help="sweep the settings of the peers on the tuning half"
    )
    parser.add_argument(
        "--out",
        type=Path,
        help="folder for record and plot; by default benchmarks/records and docs/figures, and none at all "
        "where the other options are not the default",
    )
    args = parser.parse_args()
    usual = all(
        getattr(args, key) == parser.get_default(key) for key in ("half", "layout", "method", "scenes")
    )
    chosen = args.layout or [*LAYOUTS_RUN, *([WITH_MODELNET] if args.modelnet else [])]
    if args.modelnet is None and any(LAYOUTS[name].shapes == "modelnet" for name in chosen):
        parser.error("ModelNet layouts need --modelnet")
    versions, missing = check(args.method or [name for name in METHODS if name not in PAPER_ONLY])
    print(f"{CORES} of {os.cpu_count()} cores, {platform.machine()}, ibi_rs {ibi.__version__}")
    for name, reason in missing.items():
        print(f"missing: {name}: {reason}")

    by_layout, rows = {}, []
    for layout in chosen:
        todo = list(scenes(layout, "tuning" if args.tune else args.half, args.scenes, args.modelnet))
        if args.tune:
            for name in versions:
                if name in SETTINGS:
                    tune(layout, todo, name)
            continue
        here = {name: version for name, version in versions.items() if applies(name, layout)}
        runs = by_layout[layout] = compare(layout, args.half, todo, here, args.repeats)
        print_table(layout, args.half, runs, missing)
        rows += [run.row(layout) for of_method in runs.values() for run in of_method]
        rows += [empty_row(layout, name, reason) for name, reason in missing.items()]
    if args.tune or not (args.out or usual):
        return
    record = (args.out or RECORDS) / "peers.csv"
    record.parent.mkdir(parents=True, exist_ok=True)
    with record.open("w", newline="", encoding="utf-8") as file:
        out = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        out.writeheader()
        out.writerows(rows)
    draw((args.out or FIGURES) / "peers.png", by_layout)


if __name__ == "__main__":
    main()
