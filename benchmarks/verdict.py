"""Whether a verdict may be acted on: in bins, rows, rooms, on real scans, and where there is nothing to find.

    IBI_DATA=FOLDER make bench-verdict
    IBI_DATA=FOLDER python benchmarks/verdict.py --half tuning --rows bins rooms
    python benchmarks/verdict.py --quick
    python benchmarks/verdict.py --rows bins --draw pictures --save-poses poses

Each search is for one part in one scan, whole, by `Model.detect` as it is by default; scenes are those of
benchmarks/verdict_searches.py, of two halves that share no shape and no seed. A pose is right one to one by
ADD-S below a tenth of the diameter. Asked for are instances that show at least half of their silhouette, in
rooms 0.3 of their surface; a pose of another one is neither right nor wrong. Strict: within 10 degrees,
modulo symmetry, and 10 mm.

The calibration error is the expected one, over tenths of the score; it and Brier's score are those of the
poses that are returned, and of those that would be with ``hv.t_score`` at 0.02. `--no-low` leaves these out.

Without IBI_DATA the real boxes are left out, and of the real scans those that are not shipped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import ibi_rs as ibi
import numpy as np
from frame import cli, ours, plots, records, runs, tables
from frame.records import Row
from frame.scans import FOLDER
from frame.tables import show
from frame.timing import timed
from verdict_metrics import HIDDEN, RIGHT, UNKNOWN, WRONG, Judgement, brier, calibration_error
from verdict_pictures import draw
from verdict_searches import GAPS, KINDS, ROWS, SIZES, Models, Search, outlier_scenes

PAGE = records.DOCS / "verdict.md"
PICTURE = "verdict_reliability.png"
RECORDS = {
    "before": ("verdict_before.csv", "verdict_before_poses.csv"),
    "now": ("verdict.csv", "verdict_poses.csv"),
}
"""Searches and poses of each column of the page; before: as it was when this was first measured."""
OUTLIERS = "outliers"
LOW_SCORE = 0.02
NO_LOW = ("absent", "mirror", "sizes")
"""Regimes in which only poses that are returned count."""
RETURNED, LOW = "returned", "low"
COLUMNS = (
    *("half", "regime", "what", "scan", "part", "scale", "run", "points", "visible", "poses"),
    *(RIGHT, HIDDEN, WRONG, UNKNOWN, "strict", "mean_score", "seconds", "version"),
)
POSE_COLUMNS = ("half", "regime", "what", "scan", "part", "run", "score", "state")


# Runs -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Done:
    """A search and what came of it."""

    search: Search
    run: str
    model: ibi.Model
    found: ibi.Registration
    judgement: Judgement
    seconds: float

    def row(self) -> Row:
        """Return what the record holds of it."""
        search, judgement = self.search, self.judgement
        scores = [pose.score for pose in self.found]
        counts = {state: str(judgement.count(state)) for state in (RIGHT, HIDDEN, WRONG, UNKNOWN)}
        return {
            **self._head(),
            "scale": f"{search.scale:g}",
            "points": str(len(search.scan.points)),
            "visible": str(int(judgement.is_asked_for.sum())),
            "poses": str(len(self.found)),
            **counts,
            "strict": str(
                sum(
                    bool(strict) and state == RIGHT
                    for strict, state in zip(judgement.is_strict, judgement.states, strict=True)
                )
            ),
            "mean_score": f"{np.mean(scores):.4f}" if scores else "",
            "seconds": f"{self.seconds:.3f}",
            "version": ibi.__version__,
        }

    def pose_rows(self) -> Iterator[Row]:
        """Return what the record holds of each pose."""
        for pose, state in zip(self.found, self.judgement.states, strict=True):
            yield {**self._head(), "score": f"{pose.score:.4f}", "state": state}

    def _head(self) -> Row:
        search = self.search
        named = {"half": search.scan.half, "regime": search.regime, "what": search.what}
        return {**named, "scan": search.scan.name, "part": search.part, "run": self.run}

    def line(self) -> str:
        """Say in a line what came of it."""
        row = self.row()
        name = f"{row['regime']}: {row['what']}, {row['scan']}, {row['part']} x {row['scale']} ({row['run']})"
        counts = f"{row[RIGHT]} of {row['visible']} right, {row['poses']} poses, {row[WRONG]} wrong"
        return f"{name:76s} {counts}, {self.seconds:.1f} s"


def params_of(search: Search, run: str) -> ibi.Params | None:
    """Return the parameters: the default ones, or those that return poses of low score, too."""
    if run == RETURNED:
        return None
    usual = ibi.Params.single_view() if "viewpoint" in search.scan.told else ibi.Params()
    return usual.replace(hv=ibi.Evidence(t_score=LOW_SCORE, t_sure=1.0))


def run(search: Search, how: str, models: Models) -> Done:
    """Search and judge."""
    model, symmetries = models.of(search)
    seconds, found = timed(
        partial(model.detect, search.scan.points, params_of(search, how), **search.scan.told)
    )
    judgement = search.judge(found, model, symmetries)
    return Done(search, how, model, found, judgement, seconds)


def run_outliers(half: str, quick: bool) -> Iterator[Row]:
    """Register scenes in which each instance has 10 right pairs of 5000."""
    for scene in outlier_scenes(half, quick):  # type: ignore[arg-type]
        seconds, found = timed(partial(ours.register, scene, ibi.Params()))
        score = runs.score(scene, found).one_to_one
        yield {
            **{"half": half, "regime": OUTLIERS, "what": "10 of 5000", "scan": scene.name, "run": RETURNED},
            **{"visible": str(score.num_truth), "poses": str(score.num_predicted)},
            RIGHT: str(score.num_truth_hit),
            WRONG: str(score.num_predicted - score.num_predicted_hit),
            "seconds": f"{seconds:.3f}",
            "version": ibi.__version__,
        }


def save(done: Done, folder: Path) -> None:
    """Write the scan, once, and all that is known of the poses, for whoever fits the score."""
    search, scan = done.search, done.search.scan
    folder.mkdir(parents=True, exist_ok=True)
    cloud = folder / f"scan_{scan.name}.npz"
    if not cloud.exists():
        more = {"normals": scan.told["tgt_normals"]} if "tgt_normals" in scan.told else {}
        np.savez_compressed(cloud, points=scan.points.astype(np.float32), eyes=scan.eyes, **more)
    name = f"{search.regime}_{scan.name}_{search.part}_{search.scale:g}_{done.run}".replace(", ", "-")
    judgement = done.judgement
    measures = ("score", "overlap", "closeness", "back_fit", "evidence", "inlier_rmse", "round")
    np.savez_compressed(
        folder / f"poses_{name}.npz",
        **{key: np.array([getattr(pose, key) for pose in done.found]) for key in measures},
        found=np.asarray(done.found).reshape(-1, 4, 4),
        state=np.array(judgement.states, dtype=str),
        add_s=judgement.distances,
        is_strict=judgement.is_strict,
        truth_of=judgement.truths,
        truth=search.poses,
        visibility=search.visibility,
        is_asked_for=judgement.is_asked_for,
        vertices=search.mesh[0],
        faces=search.mesh[1],
        half=scan.half,
        regime=search.regime,
        what=search.what,
        scan=scan.name,
        part=search.part,
        scale=search.scale,
        run=done.run,
        knows_eye="viewpoint" in scan.told,
    )


# Tables ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Line:
    """A line of the table: of which searches it is, what is said of them, and what is to be reached."""

    work: str
    regime: str
    say: Callable[[Sequence[Row]], str]
    goal: str
    what: str = ""
    all_halves: bool = False

    def of(self, rows: Iterable[Row], half: str) -> list[Row]:
        """Return the searches."""
        return [
            row
            for row in rows
            if row["regime"] == self.regime
            and row["run"] == RETURNED
            and self.what in ("", row["what"])
            and (self.all_halves or row["half"] == half)
        ]


def total(rows: Iterable[Row], *keys: str) -> int:
    """Sum columns."""
    return sum(int(row[key] or 0) for row in rows for key in keys)


def ratio(part: int, whole: int) -> str:
    """Say how many of how many, and the share."""
    return f"{part / whole:.2f} ({part} of {whole})" if whole else "-"


def precision_recall(rows: Sequence[Row]) -> str:
    """Say how many of the poses are right, and how many of the visible instances are found."""
    precision = ratio(total(rows, RIGHT), total(rows, RIGHT, WRONG))
    return f"{precision} / {ratio(total(rows, RIGHT), total(rows, 'visible'))}"


def precision(rows: Sequence[Row]) -> str:
    """Say how many of the poses are right."""
    return ratio(total(rows, RIGHT), total(rows, RIGHT, WRONG))


def strict(rows: Sequence[Row]) -> str:
    """Say how many of the right poses are within 10 degrees and 10 mm."""
    return ratio(total(rows, "strict"), total(rows, RIGHT))


def recall_invented(rows: Sequence[Row]) -> str:
    """Say how many of the visible instances are found, and how many poses are wrong."""
    return f"{ratio(total(rows, RIGHT), total(rows, 'visible'))}; {total(rows, WRONG)} invented"


def labels_wrong(rows: Sequence[Row]) -> str:
    """Say how many labels are reached, and how many poses are wrong where all is labelled."""
    return f"{total(rows, RIGHT)} of {total(rows, 'visible')} labels, {total(rows, WRONG)} wrong"


def searches_with_poses(rows: Sequence[Row]) -> str:
    """Say how many searches return anything."""
    with_any = sum(int(row["poses"]) > 0 for row in rows)
    return f"{with_any} of {len(rows)} searches, {total(rows, 'poses')} poses"


def poses_mean(rows: Sequence[Row]) -> str:
    """Say how many poses there are, and their mean score."""
    scores = [(int(row["poses"]), float(row["mean_score"])) for row in rows if row["mean_score"]]
    num = sum(count for count, _ in scores)
    mean = f"{sum(count * score for count, score in scores) / num:.2f}" if num else "-"
    return f"{num} poses in {len(rows)} searches, mean score {mean}"


def by_size(rows: Sequence[Row]) -> str:
    """Say how many poses each size gets, of those of the right one, and their mean score."""
    of_size = {size: [row for row in rows if row["scale"] == f"{size:g}"] for size in SIZES}
    right = total(of_size[1.0], "poses")
    cells = []
    for size, of in of_size.items():
        num = total(of, "poses")
        scores = sum(int(row["poses"]) * float(row["mean_score"]) for row in of if row["mean_score"])
        mean = f"{scores / num:.2f}" if num else "-"
        cells.append(f"{size:g}: {num / right:.2f} ({mean})" if right else f"{size:g}: {num} ({mean})")
    return ", ".join(cells)


LINES = (
    Line("real boxes, jumbled: precision / recall", "boxes, jumbled", precision_recall, ">= 0.90 / >= 0.75"),
    Line("the same, frames of both halves", "boxes, jumbled", precision_recall, "", all_halves=True),
    Line("of those right, strict", "boxes, jumbled", strict, ">= 85 %", all_halves=True),
    Line("real boxes, packed: precision / recall", "boxes, packed", precision_recall, ">= 0.80 / any"),
    Line(
        "the same, frames of both halves", "boxes, packed", precision_recall, ">= 0.80 / any", all_halves=True
    ),
    Line("real scans: labels, wrong", "scans", labels_wrong, "all, no more wrong", all_halves=True),
    *(
        Line(f"bins, {kind}: precision / recall", "bins", precision_recall, ">= 0.95 / >= 0.80", kind)
        for kind in KINDS
    ),
    *(
        Line(f"rows, gap {gap} mm: precision / recall", "rows", precision_recall, "", f"gap {gap} mm")
        for gap in GAPS
    ),
    Line("piles, 11 shapes: precision / recall", "piles", precision_recall, ""),
    Line("rooms, little covered, eyes: recall", "rooms, eyes", recall_invented, ">= 0.80; none", "little"),
    Line("rooms, well covered, eyes: recall", "rooms, eyes", recall_invented, ">= 0.95; none", "well"),
    Line(
        "rooms, little covered, no eyes: recall", "rooms, no eyes", recall_invented, ">= 0.65; none", "little"
    ),
    Line("rooms, well covered, no eyes: recall", "rooms, no eyes", recall_invented, ">= 0.90; none", "well"),
    *(
        Line(f"absent, {what}", "absent", searches_with_poses, goal, what)
        for what, goal in (
            ("plate", "<= 3 of 120"),
            ("cube", "in these"),
            ("rod", "four rows"),
            ("other", ""),
            ("near-copy", "apart"),
        )
    ),
    Line("mirror image of the bracket", "mirror", poses_mean, "mean below 0.5", "mirror image"),
    Line("the bracket itself there", "mirror", precision_recall, "", "the right one"),
    Line("sizes, tee scan: poses of those of size 1 (mean score)", "sizes", by_size, "<= 0.1", "scan"),
    Line("sizes, piles", "sizes", by_size, "<= 0.1 to 0.8, from 1.2", "pile"),
    Line("piles, size 1: precision / recall", "sizes, right", precision_recall, "", "pile"),
    Line("10 right pairs of 5000: precision / recall", OUTLIERS, precision_recall, "1 / 1"),
)


def verdict_table(columns: dict[str, tuple[Sequence[Row], str]]) -> str:
    """Return the table of the works; a column has a record and its half."""
    lines = []
    for line in LINES:
        cells = []
        for rows, half in columns.values():
            of = line.of([*rows, *sizes_right(rows)], half)
            cells.append(line.say(of) if of else "not run")
        if any(cell != "not run" for cell in cells):
            lines.append((line.work, *cells, line.goal))
    return tables.markdown(("work", *columns, "to reach"), lines)


def sizes_right(rows: Iterable[Row]) -> Iterator[Row]:
    """Return the searches of the right size as a regime of their own."""
    for row in rows:
        if row["regime"] == "sizes" and row["scale"] == "1":
            yield row | {"regime": "sizes, right"}


def calibration_table(columns: dict[str, tuple[Sequence[Row], str]]) -> str:
    """Return the table of calibration by regime; a column has a record of poses and its half."""
    names = [f"{name}, {how}" for name in columns for how in (RETURNED, LOW)]
    regimes = list(dict.fromkeys(row["regime"] for rows, _ in columns.values() for row in rows))
    lines = []
    for regime in regimes:
        cells = []
        for rows, half in columns.values():
            for how in (RETURNED, LOW):
                of = [
                    row
                    for row in rows
                    if (row["regime"], row["half"], row["run"]) == (regime, half, how)
                    and row["state"] != UNKNOWN
                ]
                cells.append(calibration(of))
        lines.append((regime, *cells))
    return tables.markdown(("regime", *names), lines)


def calibration(rows: Sequence[Row]) -> str:
    """Say calibration error, Brier's score and the number of poses."""
    if not rows:
        return "-"
    scores, right = [float(row["score"]) for row in rows], [row["state"] in (RIGHT, HIDDEN) for row in rows]
    return f"{calibration_error(scores, right):.2f} / {brier(scores, right):.2f} ({len(rows)})"


def draw_reliability(columns: dict[str, tuple[Sequence[Row], str]], path: Path) -> None:
    """Draw, for each regime, the share of right poses over the score, those of low score among them."""
    regimes = list(dict.fromkeys(row["regime"] for rows, _ in columns.values() for row in rows))
    figure, axes = plots.panels(
        (3 * 4, 2.9 * -(-len(regimes) // 4)), 4, -(-len(regimes) // 4), count=len(regimes)
    )
    for axis, regime in zip(axes, regimes, strict=True):
        axis.plot([0, 1], [0, 1], color="0.7", linestyle="--", zorder=1)
        for (name, (rows, half)), color in zip(columns.items(), ("0.45", "#2166ac"), strict=False):
            of = [row for row in rows if (row["regime"], row["half"]) == (regime, half)]
            of = [row for row in of if row["state"] != UNKNOWN]
            of = [row for row in of if row["run"] == LOW] or of
            scores = np.array([float(row["score"]) for row in of])
            right = np.array([row["state"] in (RIGHT, HIDDEN) for row in of], dtype=float)
            tenth = np.minimum((scores * 10).astype(int), 9)
            held = [tenth == i for i in range(10) if (tenth == i).any()]
            axis.scatter(
                [scores[rows].mean() for rows in held],
                [right[rows].mean() for rows in held],
                s=[8 + 120 * rows.mean() for rows in held],
                color=color,
                label=f"{name}, {len(of)} poses",
                zorder=2,
            )
        axis.set(title=regime, xlim=(-0.03, 1.03), ylim=(-0.03, 1.03), aspect="equal")
        axis.legend(fontsize=7, loc="upper left")
        axis.grid(color="0.92")
    plots.save(figure, path, 80)


def recorded() -> dict[str, tuple[list[Row], list[Row]]]:
    """Return the records of searches and poses that there are, by the name of their column."""
    read = {
        name: tuple(records.read(records.RECORDS / file) for file in files) for name, files in RECORDS.items()
    }
    return {name: (searches, poses) for name, (searches, poses) in read.items() if searches}


def page_tables() -> dict[str, str]:
    """Return the tables of the page, from the records."""
    columns = recorded()
    return {
        "verdict": verdict_table({name: (of[0], "reporting") for name, of in columns.items()}),
        "calibration": calibration_table({name: (of[1], "reporting") for name, of in columns.items()}),
    }


def main() -> None:
    """Run, print, record."""
    args = cli.parse(
        __doc__,
        cli.HALF,
        cli.several("--rows", (*ROWS, OUTLIERS)),
        cli.flag("--quick", "one or two scenes of each kind: about two minutes"),
        cli.flag("--no-low", "leave out the runs that return poses of low score"),
        cli.option("--draw", type=Path, metavar="DIR", help="a picture of each search: hits, misses, wrong"),
        cli.option("--save-poses", type=Path, metavar="DIR", help="scans, poses and what they are, as npz"),
        cli.flag("--docs", "write the record and the tables of docs/verdict.md"),
        cli.option("--record", choices=tuple(RECORDS), default="now", help="which column of the page"),
    )
    if args.docs and (args.quick or args.half != "reporting"):
        args.error("--docs is for all scenes of the reporting half")
    cli.machine(f"{args.half} half", "quick" if args.quick else "all scenes")
    chosen = args.rows or (*ROWS, OUTLIERS)
    if FOLDER is None and "boxes" in chosen:
        show("boxes: left out, IBI_DATA is not set")
    rows: list[Row] = []
    poses: list[Row] = []
    for name in chosen:
        if name == OUTLIERS:
            rows += run_outliers(args.half, args.quick)
            continue
        models = Models()
        for search in ROWS[name](args.half, args.quick):
            with_low = not (args.no_low or args.quick) and search.regime not in NO_LOW
            with_low = with_low and search.scan.half == args.half
            for how in (RETURNED, LOW) if with_low else (RETURNED,):
                done = run(search, how, models)
                show(done.line())
                rows.append(done.row())
                poses += [*done.pose_rows()] if search.regime != "sizes" else []
                if args.save_poses:
                    save(done, args.save_poses)
                if args.draw and how == RETURNED:
                    draw(search, done.model, done.found, done.judgement, args.draw)
    show(f"\n{verdict_table({'measured': (rows, args.half)})}\n")
    show(calibration_table({"measured": (poses, args.half)}))
    if args.docs:
        # Rows that were not run this time are kept.
        regimes = {row["regime"] for row in rows}
        for file, new, columns in zip(
            RECORDS[args.record], (rows, poses), (COLUMNS, POSE_COLUMNS), strict=True
        ):
            old = [row for row in records.read(records.RECORDS / file) if row["regime"] not in regimes]
            records.write(records.RECORDS, file, old + new, columns)
        records.fill(PAGE, page_tables())
        pictured = {name: (of[1], "reporting") for name, of in recorded().items()}
        draw_reliability(pictured, records.FIGURES / PICTURE)


if __name__ == "__main__":
    main()
