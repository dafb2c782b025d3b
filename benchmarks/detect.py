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

import argparse
import csv
import os
import re
import time
from pathlib import Path

import ibi_rs as ibi
import numpy as np
from ibi_rs import metrics
from peers.contract import CORES
from scans import EXAMPLES, SCANS, labels

ROOT = Path(__file__).parents[1]
RECORD = ROOT / "benchmarks/records/detect.csv"
PAGE = ROOT / "docs/features.md"


def folders(root: Path | None) -> dict[str, Path]:
    """Where each scan is that can be had."""
    return {
        name: root / scan.folder if root else EXAMPLES / str(scan.shipped)
        for name, scan in SCANS.items()
        if root or scan.shipped
    }


def run(name: str, folder: Path, repeats: int) -> dict[str, object]:
    """Detect the parts of one scan."""
    mesh = ibi.io.read_mesh(folder / SCANS[name].mesh)
    scan, _ = ibi.io.read_cloud(folder / f"{SCANS[name].file or name}.ply")
    truth = labels(folder, name)
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        model = ibi.Model.from_mesh(*mesh)
        made = time.perf_counter()
        matches = model.correspond(scan, viewpoint=[0, 0, 0])
        matched = time.perf_counter()
        found = model.detect(scan, viewpoint=[0, 0, 0])
        detected = time.perf_counter() - matched
        seconds.append((made - start, matched - made, detected))
    symmetries = SCANS[name].symmetries
    score = metrics.score_scene(
        found, truth, criterion=metrics.ADD_S, model=model.points, symmetries=symmetries
    )
    turned = [match.rotation_error_deg for match in score.matches if match is not None and match.is_hit]
    of_model, of_match, of_all = np.median(seconds, axis=0)
    return {
        "scan": name,
        "points": len(scan),
        "correspondences": len(matches.corr),
        "labels": len(truth),
        "reached": score.num_truth_hit,
        "poses": len(found),
        "precision": f"{score.precision:.3f}" if SCANS[name].is_complete else "",
        "turned_deg": f"{max(turned):.1f}" if turned else "",
        "model_s": f"{of_model:.3f}",
        "match_s": f"{of_match:.3f}",
        "detect_s": f"{of_all:.3f}",
        "version": ibi.__version__,
        "cores": CORES,
    }


def markdown(rows: list[dict[str, str]]) -> str:
    """Return the table of the page, from what the record holds."""
    lines = [
        "| scan | points | correspondences | labels reached | turned by, deg | poses | precision | model s "
        "| match s | all s |",
        f"|{'---|' * 10}",
    ]
    for row in rows:
        reached = f"{row['reached']} of {row['labels']}"
        cells = [row["scan"], row["points"], row["correspondences"], reached, row["turned_deg"]]
        cells += [row["poses"], row["precision"]]
        cells += [f"{float(row[key]):.2f}" for key in ("model_s", "match_s", "detect_s")]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Run, print, record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--docs", action="store_true", help="write the record and the table of docs/features.md"
    )
    arguments = parser.parse_args()
    root = Path(os.environ["IBI_DATA"]) if "IBI_DATA" in os.environ else None
    rows = [
        {key: str(value) for key, value in run(name, folder, arguments.repeats).items()}
        for name, folder in folders(root).items()
    ]
    print(markdown(rows))
    if arguments.docs:
        with RECORD.open("w", newline="", encoding="utf-8") as file:
            out = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            out.writeheader()
            out.writerows(rows)
        page = PAGE.read_text(encoding="utf-8")
        table = f"<!-- detect -->\n{markdown(rows)}\n<!-- end -->"
        PAGE.write_text(re.sub(r"<!-- detect -->.*?<!-- end -->", lambda _: table, page, flags=re.DOTALL))


if __name__ == "__main__":
    main()
