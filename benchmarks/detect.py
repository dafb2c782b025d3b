"""From mesh and scan to poses, on every real scan at hand: prints a table, records it.

    python benchmarks/detect.py                  # the shipped scans
    IBI_DATA=SCANS python benchmarks/detect.py   # all labelled scans
    IBI_DATA=SCANS python benchmarks/detect.py --docs

Recall and precision are one to one by ADD-S below a tenth of the diameter; precision only where all parts are
labelled. Poses are turned against the labels they reach by so much, modulo symmetries, at most.
Seconds are medians of `--repeats` calls: the model from its mesh, the correspondences, the
registration.
"""

from __future__ import annotations

from collections.abc import Iterable

import ibi_rs as ibi
from frame import cli, records, tables
from frame.records import Row
from frame.scans import SCANS, Case, detect, real
from frame.timing import CORES
from ibi_rs import metrics

PAGE = records.DOCS / "features.md"
RECORD = "detect.csv"
HEAD = (
    *("scan", "points", "correspondences", "labels reached", "turned by, deg", "poses", "precision"),
    *("model s", "match s", "all s"),
)


def run(case: Case, repeats: int) -> Row:
    """Detect the parts of one scan."""
    done = detect(case, repeats)
    score = metrics.score_scene(
        done.found,
        case.poses,
        criterion=metrics.ADD_S,
        model=done.model.points,
        symmetries=SCANS[case.name].symmetries,
    )
    turned = [match.rotation_error_deg for match in score.matches if match is not None and match.is_hit]
    return {
        "scan": case.name,
        "points": str(len(case.points)),
        "correspondences": str(len(done.matches.corr)),
        "labels": str(len(case.poses)),
        "reached": str(score.num_truth_hit),
        "poses": str(len(done.found)),
        "precision": f"{score.precision:.3f}" if case.is_complete else "",
        "turned_deg": f"{max(turned):.1f}" if turned else "",
        "model_s": f"{done.model_s:.3f}",
        "match_s": f"{done.match_s:.3f}",
        "detect_s": f"{done.detect_s:.3f}",
        "version": ibi.__version__,
        "cores": str(CORES),
    }


def markdown(rows: Iterable[Row]) -> str:
    """Return the table of the page, from what the record holds."""
    lines = []
    for row in rows:
        cells = [row["scan"], row["points"], row["correspondences"], f"{row['reached']} of {row['labels']}"]
        cells += [row[key] for key in ("turned_deg", "poses", "precision")]
        lines.append(cells + [f"{float(row[key]):.2f}" for key in ("model_s", "match_s", "detect_s")])
    return tables.markdown(HEAD, lines)


def main() -> None:
    """Run, print, record."""
    docs = cli.flag("--docs", "write the record and the table of docs/features.md")
    args = cli.parse(__doc__, cli.repeats(3), docs)
    rows = [run(case, args.repeats) for case in real()]
    print(markdown(rows))
    if args.docs:
        records.write(records.RECORDS, RECORD, rows)
        records.fill(PAGE, {"detect": markdown(rows)})


if __name__ == "__main__":
    main()
