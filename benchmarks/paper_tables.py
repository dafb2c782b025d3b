"""The paper's tables, measured with ours and with the peers on our data: prints, records, draws.

    python benchmarks/paper_tables.py                        # or: make tables
    python benchmarks/paper_tables.py --table modules --docs # one table anew, in record and page
    python benchmarks/paper_tables.py --table main --half tuning --scenes 3
    IBI_DATA=SCANS python benchmarks/paper_tables.py         # all labelled scans, not the shipped ones alone

A block is one table on one kind of data. The synthetic data are layouts of benchmarks/frame/layouts.py, run
with `Params.paper_synthetic`; the scans are those of benchmarks/frame/scans.py, run with `Params.paper_real`.
What is changed in a row is told by its name; benchmarks/paper_rows.py has them all.

Scores are one to one, in percent: on synthetic data below 20 degrees and 0.5 radii; on scans by ADD-S below a
tenth of the diameter, since a tee looks the same from two sides, with MHP and MHF1 over the scans that are
labelled completely. Behind MHF1 stands the standard error of the mean over scenes. Seconds are the median of
whole calls in one process; blocks without them run in several. The last column has the paper's own figures,
on its data and its machine.

The record holds a row per row of each table. A run replaces the blocks it has measured and leaves the others.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import ibi_rs as ibi
import numpy as np
import paper_loop
from frame import cli, ours, plots, records, runs, scans, tables
from frame.layouts import scene_of, seeds
from frame.records import Row
from frame.runs import Outcome, Register
from frame.tables import show
from frame.timing import CORES, MACHINE, timed
from ibi_rs import synth
from paper_rows import ALL, CURVES, SCANS, SHIPPED, TABLES, cited, is_real
from paper_rows import Row as Method
from peers import METHODS, available
from peers.settings import settings

PAGE = records.DOCS / "paper-tables.md"
RECORD, CURVE_RECORD = "paper_tables.csv", "paper_curves.csv"
SCORES = ("mhr", "mhp", "mhf1")
CITED = ("paper_mhr", "paper_mhp", "paper_mhf1", "paper_seconds")

# Running --------------------------------------------------------------------------------------------------


def keys(data: str, half: str, count: int) -> list[Any]:
    """Return what tells the scenes apart: seeds of a layout, names of scans."""
    if is_real(data):
        return list(scans.ALL if data == SCANS else scans.SHIPPED)
    return list(seeds(data, half, count))


def make(data: str, half: str, root: Path | None, key: Any) -> synth.Scene:
    """Make one scene; the root is the folder of all labelled scans."""
    if not is_real(data):
        return scene_of(data, half, key)
    return scans.shipped_scan(key) if root is None or data == SHIPPED else scans.scan(key, root)


def reorder(scene: synth.Scene, order: str) -> synth.Scene:
    """Change the list of correspondences.

    Parameters
    ----------
    scene : ibi_rs.synth.Scene
    order : str
        Words for what is done, with commas between: "inliers first", "by target point" (the order of the
        points of the scene), "first N".

    Returns
    -------
    ibi_rs.synth.Scene
    """
    rows = np.arange(len(scene.corr))
    for word in order.split(", ") if order else ():
        if word == "inliers first":
            rows = rows[np.argsort(scene.labels()[rows] < 0, kind="stable")]
        elif word == "by target point":
            rows = rows[np.argsort(scene.corr[rows, 1], kind="stable")]
        else:
            rows = rows[: int(word.removeprefix("first "))]
    similarity = None if scene.similarity is None else scene.similarity[rows]
    return replace(scene, corr=scene.corr[rows], similarity=similarity)


def prepare(method: Method, data: str, num_threads: int | None, scene: synth.Scene) -> Register:
    """Prepare a row for a scene, which it runs on with its correspondences in the order of the row."""
    scene = reorder(scene, method.order)
    if method.peer is not None:
        of_data = settings(method.peer, "fpfh" if is_real(data) else data)
        register = METHODS[method.peer].prepare(scene, {**of_data, **(method.change or {})})
    elif method.loop:
        words = method.loop.split(", ")
        register = paper_loop.prepare(method.params, first="first" in words, alone="alone" in words)
    else:
        viewpoint = np.zeros(3) if is_real(data) else None
        inputs = {"similarity": scene.similarity, "viewpoint": viewpoint}
        register = partial(ours.register, params=method.params, num_threads=num_threads, **inputs)
    return lambda _: register(scene)


def run_block(
    name: str, data: str, methods: Iterable[Method], half: str, count: int, root: Path | None
) -> list[Row]:
    """Run one block; return what the record holds, a row of the table each."""
    is_timed = ALL[name].timed
    methods = list(methods)
    versions, reasons = available({method.peer for method in methods if method.peer is not None})
    missing = {method.name: method.missing or reasons.get(method.peer, "") for method in methods}
    num_threads = None if is_timed else 1
    todo = {
        method.name: partial(prepare, method, data, num_threads)
        for method in methods
        if not missing[method.name]
    }
    chosen = keys(data, half, count)[: ALL[name].scenes]
    jobs = 1 if is_timed else CORES
    outcomes = runs.run_each(partial(make, data, half, root), chosen, todo, is_real(data), jobs)
    is_precise = [not is_real(data) or scans.SCANS[key].is_complete for key in chosen]
    figures = cited(name, data)
    return [
        {
            **{"table": name, "data": data, "row": method.name, "missing": missing[method.name]},
            **summary(outcomes.get(method.name, ()), is_precise, is_timed),
            **{key: figures.get(method.name, {}).get(key.removeprefix("paper_"), "") for key in CITED},
            "half": "" if is_real(data) else half,
            "version": versions.get(method.peer, ibi.__version__),
            "machine": MACHINE,
        }
        for method in methods
    ]


def summary(outcomes: Sequence[Outcome], is_precise: Sequence[bool], is_timed: bool) -> Row:
    """Sum up one row; where poses without a label may be right, recall alone counts."""
    precise = [outcome for outcome, of in zip(outcomes, is_precise, strict=False) if of]
    mean = dict.fromkeys((*SCORES, "mhf1_error"), "")
    if outcomes:
        mean["mhr"] = f"{100 * runs.mean(outcomes).mhr:.2f}"
    if precise:
        mean |= {key: f"{100 * getattr(runs.mean(precise), key):.2f}" for key in ("mhp", "mhf1")}
    if len(precise) > 1:
        error = np.std([o.one_to_one.f1 for o in precise], ddof=1) / np.sqrt(len(precise))
        mean["mhf1_error"] = f"{100 * float(error):.2f}"
    return {
        "scenes": str(len(outcomes)),
        "precise_scenes": str(len(precise)),
        **mean,
        "poses": str(runs.num_poses(outcomes)),
        "truths": str(runs.num_truths(outcomes)),
        "seconds": f"{runs.median_ms(outcomes) / 1e3:.3f}" if is_timed and outcomes else "",
    }


# Output ---------------------------------------------------------------------------------------------------


def markdown(rows: Sequence[Row]) -> str:
    """Return one block as a Markdown table, from what the record holds."""
    cited = any(row[key] for row in rows for key in CITED)
    timed = any(row["seconds"] for row in rows)
    head = ["", "scenes", "MHR", "MHP", "MHF1", *(["s"] if timed else [])]
    head += ["paper (its data): MHR / MHP / MHF1 / s"] if cited else []
    lines = []
    for row in rows:
        if row["missing"]:
            cells = [row["missing"].partition(";")[0], *[""] * (len(head) - 2 - cited)]
        else:
            scenes = row["scenes"]
            if row["precise_scenes"] != scenes:
                scenes += f" ({row['precise_scenes']})"
            cells = [scenes, *(f"{float(row[key]):.1f}" if row[key] else "–" for key in SCORES)]
            cells[-1] += f" ± {float(row['mhf1_error']):.1f}" if row["mhf1_error"] else ""
            cells += [f"{float(row['seconds']):.2f}"] if timed else []
        if cited:
            figures = [row[key] for key in CITED]
            cells.append(" / ".join(f"{float(x):.2f}" if x else "–" for x in figures) if any(figures) else "")
        lines.append([row["row"], *cells])
    return tables.markdown(head, lines)


def block(row: Row) -> tuple[str, str]:
    """Table and data of a row."""
    return row["table"], row["data"]


def update(folder: Path, name: str, rows: Sequence[Row]) -> list[Row]:
    """Put blocks in the place of those that a record has, and return what it holds now."""
    new = {block(row) for row in rows}
    held = [row for row in records.read(folder / name) if block(row) not in new] + list(rows)
    order = [(table, data) for table, of in ALL.items() for data in of.data]
    held.sort(key=lambda row: order.index(block(row)))
    if rows:
        records.write(folder, name, held, list(rows[0]))
    return held


def page_tables(rows: Sequence[Row]) -> dict[str, str]:
    """Return the tables of the page, each by its place."""
    blocks = groupby(rows, block)
    return {f"begin {table}, {data}": markdown(list(of_block)) for (table, data), of_block in blocks}


def draw(path: Path, curve: str, rows: Sequence[Row]) -> None:
    """Draw one curve: scores against the parameter, a panel for each kind of data."""
    by_data = {data: list(points) for data, points in groupby(rows, lambda row: row["data"])}
    figure, panels = plots.panels((4.2 * len(by_data), 3.4), len(by_data), sharey=True)
    for panel, (data, points) in zip(panels, by_data.items(), strict=True):
        x = [int(point["row"]) for point in points]
        for key, style in zip(SCORES, ("--", ":", "-"), strict=True):
            panel.plot(x, [float(point[key]) for point in points], f"o{style}", ms=4, label=key.upper())
        panel.set(title=data, xlabel=curve, ylim=(-3, 103))
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("%")
    panels[-1].legend(fontsize=8)
    plots.save(figure, path, 110)


def main() -> None:
    """Run, print, record, draw."""
    args = cli.parse(
        __doc__,
        cli.several("--table", ALL, f"default: all of {', '.join(ALL)}"),
        cli.HALF,
        cli.scenes(20, "of each layout"),
        cli.option(
            "--data",
            type=Path,
            default=scans.FOLDER,
            help="folder of all labelled scans; by default the environment variable IBI_DATA, and without it "
            f"the blocks {SCANS!r} are left out, those of {SHIPPED!r} remain",
        ),
        cli.flag("--docs", "fill the record's figures into docs/paper-tables.md"),
        cli.out("table", "data"),
    )
    if args.docs and not args.usual:
        args.error("--docs fills in the reporting half with the usual number of scenes")
    if args.data is not None and not args.data.is_dir():
        args.error(f"--data: {args.data} is no folder")
    cli.machine(f"{args.half} half", f"at most {args.scenes} scenes")
    rows: dict[str, list[Row]] = {}
    for name in args.table or ALL:
        rows[name] = []
        for data in ALL[name].data:
            if data == SCANS and args.data is None:
                continue
            of_block = ALL[name].rows(data), args.half, args.scenes, args.data
            seconds, done = timed(run_block, name, data, *of_block)
            show(f"\n### {ALL[name].title}: {data}\n\n{markdown(done)}\n\n({seconds:.0f} s)")
            rows[name] += done
    if not args.records:
        return
    held = update(args.records, RECORD, [row for name in TABLES for row in rows.get(name, [])])
    points = update(args.records, CURVE_RECORD, [row for name in CURVES for row in rows.get(name, [])])
    for name in CURVES:
        if rows.get(name):
            of_curve = [point for point in points if point["table"] == name]
            draw(args.pictures / f"curve_{name}.png", name, of_curve)
    if args.docs:
        records.fill(PAGE, page_tables(held))


if __name__ == "__main__":
    main()
