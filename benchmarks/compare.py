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

from collections.abc import Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from frame import cli, plots, records, runs
from frame.layouts import LAYOUTS, scenes
from frame.runs import Outcome
from frame.tables import show
from ibi_rs import synth
from peers import METHODS, available
from peers.methods import OURS, PAPER_ONLY
from peers.settings import SETTINGS, SWEEP, settings

LAYOUTS_RUN = ("outlier-5000", "ecc-0.02", "fpfh", "fpfh-modelnet")
COLUMNS = (
    *("layout", "method", "threads", "version", "scene", "K", "M", "recall", "precision", "f1", "strict_f1"),
    *("poses", "seconds", "ratio", "repeats", "missing"),
)
Outcomes = dict[str, list[Outcome]]


def is_symmetric(layout: str) -> bool:
    """Whether a layout has symmetric shapes."""
    return LAYOUTS[layout].shapes == "symmetric"


def compare(layout: str, todo: Sequence[synth.Scene], names: Sequence[str], repeats: int) -> Outcomes:
    """Run methods in turn."""
    methods = {name: partial(METHODS[name].prepare, settings=settings(name, layout)) for name in names}
    return runs.run(todo, methods, is_symmetric(layout), repeats)


def ratios(outcomes: Outcomes, name: str) -> list[float]:
    """Return times as multiples of ours on one thread: of each scene the median over the repeats."""
    if OURS not in outcomes:
        return [float("nan")] * len(outcomes[name])
    pairs = zip(outcomes[name], outcomes[OURS], strict=True)
    return [float(np.median(np.divide(theirs.seconds, ours.seconds))) for theirs, ours in pairs]


def rows(
    layout: str, outcomes: Outcomes, versions: dict[str, str], missing: dict[str, str]
) -> list[dict[str, Any]]:
    """Return what the record holds of a layout."""
    held = runs.rows(outcomes, layout=layout)
    for row, ratio in zip(held, chain(*(ratios(outcomes, name) for name in outcomes)), strict=True):
        row |= {"ratio": f"{ratio:.3f}", "version": versions[row["method"]]}
    held += [{"layout": layout, "method": name, "missing": reason} for name, reason in missing.items()]
    return [{**row, "threads": METHODS[row["method"]].threads} for row in held]


# Output ---------------------------------------------------------------------------------------------------


def print_table(layout: str, half: str, outcomes: Outcomes, missing: dict[str, str]) -> None:
    """Print one layout: a line per method."""
    first = next(iter(outcomes.values()))
    inliers, m = np.mean([(o.inlier_share, o.num_correspondences) for o in first], axis=0)
    title = f"{layout}, {half} half: {len(first)} scenes, {m:.0f} correspondences, {inliers:.2%} inliers"
    print(f"\n{title}\n{'method':36s}  MHR    MHP    MHF1   strict poses        ms   x ours")
    for name, of in outcomes.items():
        loose, strict = runs.mean(of), runs.mean(of, "strict")
        show(
            f"{name:36s}  {loose.mhr:.3f}  {loose.mhp:.3f}  {loose.mhf1:.3f}  {strict.mhf1:.3f}  "
            f"{runs.num_poses(of):5d} {runs.median_ms(of):9.1f}  {np.median(ratios(outcomes, name)):7.2f}"
        )
    for name, reason in missing.items():
        print(f"{name:36s}  missing: {reason}")


def applies(name: str, layout: str) -> bool:
    """Whether a method is for this layout."""
    return not METHODS[name].needs_normals or layout.startswith("fpfh")


def draw(path: Path, by_layout: dict[str, Outcomes]) -> None:
    """MHF1 against the time, a panel for each layout."""
    size = (4.2 * len(by_layout) + 2.6, 4.2)
    figure, panels = plots.panels(size, len(by_layout), sharey=True)
    markers, handles = "os^DvPX<>*ph", {}
    for panel, (layout, of) in zip(panels, by_layout.items(), strict=True):
        for i, name in enumerate(METHODS):
            if name not in of:
                continue
            is_ours = name.startswith("ibi")
            (handles[name],) = panel.plot(
                runs.median_ms(of[name]) / 1e3,
                runs.mean(of[name]).mhf1,
                markers[i % len(markers)],
                ms=9 if is_ours else 7,
                color="tab:red" if is_ours else f"C{i}",
                mec="black",
                mew=0.6,
                ls="none",
            )
        panel.set(title=layout, xlabel="seconds a scene (median)", xscale="log", ylim=(-0.03, 1.03))
        panel.grid(alpha=0.3, which="both")
    panels[0].set_ylabel("MHF1, one to one")
    figure.legend(handles.values(), handles, loc="outside right center", fontsize=8)
    plots.save(figure, path, 110)
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
            prepare = partial(METHODS[name].prepare, settings=values)
            ((_, of),) = runs.run(todo, {name: prepare}, is_symmetric(layout)).items()
            loose, strict, ms = runs.mean(of).mhf1, runs.mean(of, "strict").mhf1, runs.median_ms(of)
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
    args = cli.parse(
        __doc__,
        cli.HALF,
        cli.LAYOUT,
        cli.several("--method", METHODS),
        cli.scenes(10),
        cli.repeats(3),
        cli.MODELNET,
        cli.flag("--tune", "sweep the settings of the peers on the tuning half"),
        cli.out("repeats", "modelnet", "tune"),
    )
    chosen = cli.layouts(args, LAYOUTS_RUN)
    versions, missing = available(args.method or [name for name in METHODS if name not in PAPER_ONLY])
    cli.machine()
    for name, reason in missing.items():
        print(f"missing: {name}: {reason}")

    by_layout, record = {}, []
    for layout in chosen:
        todo = list(scenes(layout, "tuning" if args.tune else args.half, args.scenes, args.modelnet))
        if args.tune:
            for name in versions:
                if name in SETTINGS:
                    tune(layout, todo, name)
            continue
        here = [name for name in versions if applies(name, layout)]
        by_layout[layout] = compare(layout, todo, here, args.repeats)
        print_table(layout, args.half, by_layout[layout], missing)
        record += rows(layout, by_layout[layout], versions, missing)
    if args.records and not args.tune:
        records.write(args.records, "peers.csv", record, COLUMNS)
        draw(args.pictures / "peers.png", by_layout)


if __name__ == "__main__":
    main()
