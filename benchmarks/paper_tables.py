"""The paper's tables, measured with ours and with the peers on our data: prints, records, draws.

    python benchmarks/paper_tables.py                        # or: make tables
    python benchmarks/paper_tables.py --table modules --docs # one table anew, in record and page
    python benchmarks/paper_tables.py --table main --half tuning --scenes 3
    IBI_DATA=SCANS python benchmarks/paper_tables.py         # all labelled scans, not the shipped ones alone

A block is one table on one kind of data. The synthetic data are the layouts of benchmarks/layouts.py, run
with `Params.paper_synthetic`; the scans are those of benchmarks/scans.py, run with `Params.paper_real`. What
is changed in a row is told by its name; benchmarks/paper_rows.py has them all.

Scores are one to one, in percent: on synthetic data below 20 degrees and 0.5 radii; on scans by ADD-S below a
tenth of the diameter, since a tee looks the same from two sides, with MHP and MHF1 over the scans that are
labelled completely. Behind MHF1 stands the standard error of the mean over scenes. Seconds are the median of
whole calls in one process; blocks without them run in several. The last column has the paper's own figures,
on its data and its machine.

The record holds a row per row of each table. A run replaces the blocks it has measured and leaves the others.
"""

from __future__ import annotations

import argparse
import csv
import multiprocessing
import os
import platform
import re
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import ibi_rs as ibi
import numpy as np
import paper_loop
import scans
from accuracy import RECORDS
from ibi_rs import metrics, synth
from layouts import FIRST_SEED, scene_of, seeds
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from paper_figures import CITED, Cited
from paper_rows import CURVE_DATA, CURVES, SCANS, SHIPPED, TABLES, Row, curve_rows, is_real
from peers import METHODS, Missing, Register
from peers.contract import CORES
from peers.settings import settings

DOCS = Path(__file__).parents[1] / "docs"
PAGE = DOCS / "paper-tables.md"
FIGURES = DOCS / "figures"
RECORD, CURVE_RECORD = "paper_tables.csv", "paper_curves.csv"
SCORES = ("mhr", "mhp", "mhf1")
MACHINE = f"{CORES} cores, {platform.machine()}"

# Data -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Source:
    """Where scenes come from.

    Attributes
    ----------
    half : str
    count : int
        So many scenes of a layout.
    root : pathlib.Path or None
        Folder of all labelled scans.
    """

    half: str
    count: int
    root: Path | None

    def keys(self, data: str) -> list[Any]:
        """Return what tells the scenes apart: seeds of a layout, names of scans."""
        if is_real(data):
            return list(scans.ALL if data == SCANS else scans.SHIPPED)
        return list(seeds(data, self.half, self.count))

    def scene(self, data: str, key: Any) -> synth.Scene:
        """Make one scene."""
        if not is_real(data):
            return scene_of(data, self.half, key)
        return scans.shipped_scan(key) if self.root is None or data == SHIPPED else scans.scan(key, self.root)


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


# Running --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """One row on one scene; `precise` tells whether poses without a label are wrong."""

    score: metrics.SceneScore
    precise: bool
    seconds: float


def method(row: Row, data: str, scene: synth.Scene, num_threads: int | None) -> Register:
    """Prepare a row for the model of a scene."""
    if row.peer is not None:
        of_data = settings(row.peer, "fpfh" if is_real(data) else data)
        return METHODS[row.peer].prepare(scene, {**of_data, **(row.change or {})})
    if row.loop:
        words = row.loop.split(", ")
        return paper_loop.prepare(row.params, first="first" in words, alone="alone" in words)

    def register(scene: synth.Scene) -> np.ndarray:
        found = ibi.register(
            scene.src,
            scene.tgt,
            scene.corr,
            row.params,
            src_normals=scene.src_normals,
            tgt_normals=scene.tgt_normals,
            similarity=scene.similarity,
            viewpoint=np.zeros(3) if is_real(data) else None,
            num_threads=num_threads,
        )
        return np.asarray(found).reshape(-1, 4, 4)

    return register


def run_scene(
    data: str, rows: Sequence[Row], source: Source, num_threads: int | None, key: Any
) -> list[Outcome]:
    """Run all rows on one scene."""
    made = source.scene(data, key)
    outcomes = []
    for row in rows:
        scene = reorder(made, row.order)
        register = method(row, data, scene, num_threads)
        start = time.perf_counter()
        poses = register(scene)
        seconds = time.perf_counter() - start
        if is_real(data):
            score = metrics.score_scene(poses, scene.poses, criterion=metrics.ADD_S, model=scene.src)
        else:
            score = metrics.score_scene(poses, scene.poses)
        outcomes.append(Outcome(score, not is_real(data) or scans.SCANS[key].is_complete, seconds))
    return outcomes


def run_block(
    name: str,
    data: str,
    rows: Iterable[Row],
    source: Source,
    cited: dict[str, Cited],
    *,
    timed: bool,
    most: int | None = None,
) -> list[dict[str, str]]:
    """Run one block.

    Returns
    -------
    list of dict
        What the record holds, a dict per row.
    """
    rows = [_checked(row) for row in rows]
    todo = [row for row in rows if not row.missing]
    keys = source.keys(data)[:most]
    task = partial(run_scene, data, todo, source, None if timed else 1)
    if timed:
        by_scene = list(map(task, keys))
    else:
        # Open3D's threads do not survive a fork.
        with ProcessPoolExecutor(CORES, multiprocessing.get_context("spawn")) as pool:
            by_scene = list(pool.map(task, keys))
    outcomes = dict(zip([row.name for row in todo], zip(*by_scene, strict=True), strict=True))
    out = []
    for row in rows:
        entry = {"table": name, "data": data, "row": row.name, "missing": row.missing}
        entry |= _summary(outcomes.get(row.name, ()), timed)
        entry |= {
            f"paper_{key}": _number(v, "g") for key, v in cited.get(row.name, Cited())._asdict().items()
        }
        version = METHODS[row.peer].module.version() if row.peer and not row.missing else ibi.__version__
        entry |= {"half": "" if is_real(data) else source.half, "version": version, "machine": MACHINE}
        out.append(entry)
    return out


def _checked(row: Row) -> Row:
    """Say why a peer cannot run here."""
    if row.peer is None:
        return row
    try:
        METHODS[row.peer].module.version()
    except Missing as reason:
        return replace(row, missing=str(reason))
    return row


def _summary(outcomes: Sequence[Outcome], timed: bool) -> dict[str, str]:
    precise = [outcome.score for outcome in outcomes if outcome.precise]
    mean = dict.fromkeys((*SCORES, "mhf1_error"), "")
    if outcomes:
        mean["mhr"] = _number(100 * metrics.mean_score(o.score for o in outcomes).mhr, ".2f")
    if precise:
        of_precise = metrics.mean_score(precise)
        mean |= {key: _number(100 * getattr(of_precise, key), ".2f") for key in ("mhp", "mhf1")}
    if len(precise) > 1:
        error = np.std([score.f1 for score in precise], ddof=1) / np.sqrt(len(precise))
        mean["mhf1_error"] = _number(100 * float(error), ".2f")
    seconds = float(np.median([o.seconds for o in outcomes])) if timed and outcomes else None
    return {
        "scenes": str(len(outcomes)),
        "precise_scenes": str(len(precise)),
        **mean,
        "poses": str(sum(o.score.num_predicted for o in outcomes)),
        "truths": str(sum(o.score.num_truth for o in outcomes)),
        "seconds": _number(seconds, ".3f"),
    }


def _number(value: float | None, how: str) -> str:
    return "" if value is None else format(value, how)


# Output ---------------------------------------------------------------------------------------------------


def markdown(rows: Sequence[dict[str, str]]) -> str:
    """Return one block as a Markdown table, from what the record holds."""
    cited = any(row[f"paper_{key}"] for row in rows for key in Cited._fields)
    timed = any(row["seconds"] for row in rows)
    head = ["", "scenes", "MHR", "MHP", "MHF1", *(["s"] if timed else [])]
    head += ["paper (its data): MHR / MHP / MHF1 / s"] if cited else []
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
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
            figures = [row[f"paper_{key}"] for key in Cited._fields]
            cells.append(" / ".join(f"{float(x):.2f}" if x else "–" for x in figures) if any(figures) else "")
        lines.append(f"| {' | '.join([row['row'], *cells])} |")
    return "\n".join(lines)


def read_record(path: Path) -> list[dict[str, str]]:
    """Read a record; none is an empty one."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write_record(path: Path, rows: Sequence[dict[str, str]]) -> list[dict[str, str]]:
    """Put blocks in the place of those that the record has, and return what it holds now."""
    new = {block(row) for row in rows}
    held = [row for row in read_record(path) if block(row) not in new] + list(rows)
    order = [*TABLES, *CURVES]
    places = {name: table.data for name, table in TABLES.items()} | dict.fromkeys(CURVES, CURVE_DATA)
    held.sort(key=lambda row: (order.index(row["table"]), places[row["table"]].index(row["data"])))
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        out = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        out.writeheader()
        out.writerows(held)
    return held


def block(row: dict[str, str]) -> tuple[str, str]:
    """Table and data of a row."""
    return row["table"], row["data"]


def write_page(page: str, rows: Sequence[dict[str, str]]) -> str:
    """Fill in the tables of the page, between ``<!-- begin TABLE, DATA -->`` and ``<!-- end -->``."""

    def fill(match: re.Match[str]) -> str:
        mine = [row for row in rows if block(row) == (match[1], match[2])]
        return f"<!-- begin {match[1]}, {match[2]} -->\n{markdown(mine)}\n<!-- end -->" if mine else match[0]

    return re.sub(r"<!-- begin ([^,]+), (.+?) -->\n.*?<!-- end -->", fill, page, flags=re.DOTALL)


def draw(path: Path, curve: str, rows: Sequence[dict[str, str]]) -> None:
    """Draw one curve: scores against the parameter, a panel for each kind of data."""
    by_data: dict[str, list[dict[str, str]]] = {}
    for row in rows:
        by_data.setdefault(row["data"], []).append(row)
    figure = Figure(figsize=(4.2 * len(by_data), 3.4), layout="constrained")
    panels = figure.subplots(1, len(by_data), sharey=True, squeeze=False)[0]
    for panel, (data, points) in zip(panels, by_data.items(), strict=True):
        x = [int(point["row"]) for point in points]
        for key, style in zip(SCORES, ("--", ":", "-"), strict=True):
            panel.plot(x, [float(point[key]) for point in points], f"o{style}", ms=4, label=key.upper())
        panel.set(title=data, xlabel=curve, ylim=(-3, 103))
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("%")
    panels[-1].legend(fontsize=8)
    FigureCanvasAgg(figure)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Run, print, record, draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = [*TABLES, *CURVES]
    parser.add_argument(
        "--table", nargs="+", choices=names, metavar="NAME", help=f"default: all of {', '.join(names)}"
    )
    parser.add_argument("--half", choices=FIRST_SEED, default="reporting")
    parser.add_argument("--scenes", type=int, default=20, help="of each layout; default: 20")
    parser.add_argument(
        "--data",
        type=Path,
        default=os.environ.get("IBI_DATA"),
        help="folder of all labelled scans; by default the environment variable IBI_DATA, and without it the "
        f"blocks {SCANS!r} are left out, those of {SHIPPED!r} remain",
    )
    parser.add_argument(
        "--docs", action="store_true", help="fill the record's figures into docs/paper-tables.md"
    )
    parser.add_argument(
        "--out",
        type=Path,
        help="folder for records and pictures; by default benchmarks/records and docs/figures, and none at "
        "all where --half or --scenes is not the default",
    )
    args = parser.parse_args()
    usual = all(getattr(args, key) == parser.get_default(key) for key in ("half", "scenes"))
    if args.docs and not usual:
        parser.error("--docs fills in the reporting half with the usual number of scenes")
    if args.data is not None and not args.data.is_dir():
        parser.error(f"--data: {args.data} is no folder")
    source = Source(args.half, args.scenes, args.data)
    print(f"{MACHINE}, ibi_rs {ibi.__version__}, {args.half} half, at most {args.scenes} scenes")

    rows: dict[str, list[dict[str, str]]] = {}
    for name in args.table or names:
        rows[name] = []
        title = TABLES[name].title if name in TABLES else f"Robustness to {name}"
        for data in TABLES[name].data if name in TABLES else CURVE_DATA:
            if data == SCANS and args.data is None:
                continue
            if name in TABLES:
                table = TABLES[name]
                todo, timed, most = table.rows(data), table.timed, table.scenes
            else:
                todo, timed, most = curve_rows(name, data), False, None
            by_kind = CITED.get(name, {})
            cited = by_kind.get(data, by_kind.get("real" if is_real(data) else "synthetic", {}))
            start = time.perf_counter()
            of_block = run_block(name, data, todo, source, cited, timed=timed, most=most)
            seconds = time.perf_counter() - start
            print(f"\n### {title}: {data}\n\n{markdown(of_block)}\n\n({seconds:.0f} s)", flush=True)
            rows[name] += of_block
    if not (usual or args.out):
        return
    tables = [row for name in TABLES for row in rows.get(name, [])]
    curves = [row for name in CURVES for row in rows.get(name, [])]
    folder = args.out or RECORDS
    held = write_record(folder / RECORD, tables) if tables else read_record(folder / RECORD)
    if curves:
        points = write_record(folder / CURVE_RECORD, curves)
        for name in CURVES:
            of_curve = [point for point in points if point["table"] == name]
            if rows.get(name):
                draw((args.out or FIGURES) / f"curve_{name}.png", name, of_curve)
    if args.docs:
        PAGE.write_text(write_page(PAGE.read_text(encoding="utf-8"), held), encoding="utf-8")


if __name__ == "__main__":
    main()
