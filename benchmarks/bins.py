"""Whether several parts are better looked for together: prints a table, records it.

    python benchmarks/bins.py --quick                # one bin of each sort
    python benchmarks/bins.py --docs                 # into the record and the table of docs/features.md
    python benchmarks/bins.py --half tuning          # where anything is chosen
    IBI_DATA=SCANS python benchmarks/bins.py         # the real boxes as well

In each scan all parts of its kind are looked for: alone, by `Model.detect` one after the other, and
together, by `Models.detect`. Bins are those of `ibi.synth.bin_scene`: `mixed` ones hold parts of all five
kinds, the others one kind only, so that the other four are not there. In each real frame both kinds of
boxes are looked for. A pose is right by ADD-S below a tenth of the diameter, one to one; asked for are
instances of which half of the silhouette is seen. Poses that are right for one of which less is seen count
in precision alone.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count

import ibi_rs as ibi
import numpy as np
import verdict_searches as searches
from frame import cli, records, tables
from frame.layouts import FIRST_SEED
from frame.records import Row
from frame.timing import CORES
from ibi_rs import synth
from verdict_metrics import HIDDEN, RIGHT, WRONG
from verdict_searches import Search

PAGE = records.DOCS / "features.md"
RECORD = "bins.csv"
WAYS = {"alone": "alone", "together": "together", "one_voxel": "one voxel"}
HEAD = ("scans", "searched", "asked for", "recall", "precision", "right", "wrong", "outdone", "s a scan")
LATER = 300
"""The first seeds of a half are of benchmarks/verdict.py, to whose poses scores were fitted."""
NUM_MIXED = 4


@dataclass(frozen=True)
class Several:
    """One scan, and a search in it for each of several parts."""

    sort: str
    searches: tuple[Search, ...]


def bins(half: searches.Half, quick: bool) -> Iterator[Several]:
    """Look for five parts in bins of all of them, and in bins of one of them."""
    seed = count(FIRST_SEED[half] + LATER)
    parts = [searches.part(kind, half) for kind in searches.KINDS]
    nothing = np.empty((0, 4, 4)), np.empty(0)
    for _ in range(searches.fewer(quick, NUM_MIXED)):
        at = next(seed)
        made = synth.bin_scene([mesh for _, mesh in parts], seed=at, num_instances=4, **searches.flaws(at))
        scan = searches.bin_scan(f"bin-mixed-{at}", made, half)
        truths = [made.of_kind(i) for i in range(len(parts))]
        yield Several("mixed bins", _of_bin(scan, parts, truths))
    for i in range(searches.fewer(quick, len(parts))):
        at = next(seed)
        made = synth.bin_scene([parts[i][1]], seed=at, num_instances=12, **searches.flaws(at))
        scan = searches.bin_scan(f"bin-{parts[i][0]}-{at}", made, half)
        truths = [(made.poses, made.visibility) if i == k else nothing for k in range(len(parts))]
        yield Several("bins of one kind", _of_bin(scan, parts, truths))


def _of_bin(scan: searches.Scan, parts: Sequence, truths: Sequence) -> tuple[Search, ...]:
    named = zip(searches.KINDS, parts, truths, strict=True)
    return tuple(Search("bins", kind, scan, *made_of, *truth) for kind, made_of, truth in named)


def boxes(half: searches.Half, quick: bool) -> Iterator[Several]:
    """Look for both boxes in each real frame."""
    of_scan: dict[str, list[Search]] = {}
    for search in searches.boxes(half, quick):
        if search.scan.half == half:
            of_scan.setdefault(search.scan.name, []).append(search)
    frames = [Several("real boxes", tuple(of)) for of in of_scan.values()]
    yield from frames[:1] if quick else frames


def run(several: Several, way: str) -> list[Row]:
    """Look for the parts in one way; a row for each."""
    scan = several.searches[0].scan
    made: list[ibi.Model] = [ibi.Model.from_mesh(*search.mesh) for search in several.searches]
    if way == "one_voxel":
        voxel = float(np.median([model.voxel for model in made]))
        made = [ibi.Model.from_mesh(*search.mesh, voxel=voxel) for search in several.searches]
    if way == "alone":
        found, seconds = [], []
        for model in made:
            start = time.perf_counter()
            found.append(model.detect(scan.points, **scan.told))
            seconds.append(time.perf_counter() - start)
    else:
        models = ibi.Models(made)
        start = time.perf_counter()
        together = models.detect(scan.points, **scan.told)
        seconds = [(time.perf_counter() - start) / len(made)] * len(made)
        found = [together.of(i) for i in range(len(made))]
    rows = []
    for search, model, of, taken in zip(several.searches, made, found, seconds, strict=True):
        judged = search.judge(np.asarray(of), model, ibi.Symmetries.none())
        rows.append(
            {
                "sort": several.sort,
                "scan": scan.name,
                "part": search.part,
                "way": way,
                "asked": str(int(judged.is_asked_for.sum())),
                "right": str(judged.count(RIGHT)),
                "hidden": str(judged.count(HIDDEN)),
                "wrong": str(judged.count(WRONG)),
                "outdone": str(sum(one.objection == "outdone" for one in of.rejected)),
                "seconds": f"{taken:.2f}",
                "version": ibi.__version__,
                "cores": str(CORES),
            }
        )
    return rows


def markdown(rows: Sequence[Row]) -> str:
    """Return the table of the page, from what the record holds."""
    lines = []
    for sort in dict.fromkeys(row["sort"] for row in rows):
        of_sort = [row for row in rows if row["sort"] == sort]
        for way in dict.fromkeys(row["way"] for row in of_sort):
            of = [row for row in of_sort if row["way"] == way]
            total = {name: sum(float(row[name]) for row in of) for name in (*COUNTS, "seconds")}
            good = total["right"] + total["hidden"]
            found = good + total["wrong"]
            num_scans = len({row["scan"] for row in of})
            lines.append(
                (
                    f"{num_scans} {sort}",
                    WAYS[way],
                    f"{total['asked']:.0f}",
                    f"{total['right'] / total['asked']:.3f}",
                    f"{good / found:.3f}" if found else "",
                    f"{good:.0f}",
                    f"{total['wrong']:.0f}",
                    f"{total['outdone']:.0f}",
                    f"{total['seconds'] / num_scans:.1f}",
                )
            )
    return tables.markdown(HEAD, lines)


COUNTS = ("asked", "right", "hidden", "wrong", "outdone")


def arguments() -> argparse.Namespace:
    """Read the command line."""
    quick = cli.flag("--quick", "one scan of each sort")
    one_voxel = cli.flag("--one-voxel", "also with the median of their voxels for all parts")
    docs = cli.flag("--docs", "write the record and the table of docs/features.md")
    return cli.parse(__doc__, cli.HALF, quick, one_voxel, docs)


def main() -> None:
    """Run, print, record."""
    args = arguments()
    ways = list(WAYS) if args.one_voxel else ["alone", "together"]
    cli.machine()
    rows: list[Row] = []
    for sets in (bins, boxes):
        for several in sets(args.half, args.quick):
            for way in ways:
                new = run(several, way)
                rows += new
                shown = [f"{row['part']} {row['right']}+{row['hidden']} -{row['wrong']}" for row in new]
                seconds = sum(float(row["seconds"]) for row in new)
                tables.show(f"{new[0]['scan']}, {WAYS[way]}: {', '.join(shown)}; {seconds:.1f} s")
            if args.docs:
                records.write(records.RECORDS, RECORD, rows)
    print(markdown(rows))
    if args.docs:
        records.fill(PAGE, {"bins": markdown(rows)})


if __name__ == "__main__":
    main()
