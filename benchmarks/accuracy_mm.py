"""How far poses are off in millimetres and degrees, by part: a table of what covariance.py has recorded.

python benchmarks/accuracy_mm.py --docs
"""

from __future__ import annotations

import argparse

import numpy as np
from frame import records, tables
from frame.records import Row

HEAD = ("scene", "part", "poses", "shift mm", "95 %", "turn deg", "95 %", "within 1 mm and 2 deg")
WHERE = {"bin": "in a bin", "alone": "alone"}


def line(where: str, part: str, of: list[Row]) -> tuple[str, ...]:
    """Sum up the poses of a part."""
    shift, turn = (np.array([float(row[name]) for row in of]) for name in ("shift_mm", "turn_deg"))
    both = (shift < 1) & (turn < 2)
    halves = [f"{np.median(shift):.2f}", f"{np.percentile(shift, 95):.2f}"]
    halves += [f"{np.median(turn):.2f}", f"{np.percentile(turn, 95):.2f}"]
    return WHERE[where], part, str(len(of)), *halves, f"{both.mean():.2f}"


def table(rows: list[Row]) -> str:
    """Return a line for each part in each kind of scene, and one for all of each."""
    lines = []
    for where in WHERE:
        of = [row for row in rows if row["where"] == where]
        for part in sorted({row["part"] for row in of}):
            lines.append(line(where, part, [row for row in of if row["part"] == part]))
        if of:
            lines.append(line(where, "all", of))
    return tables.markdown(HEAD, lines)


def main() -> None:
    """Print, and fill the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--docs", action="store_true", help="put the table into docs/accuracy.md")
    args = parser.parse_args()
    text = table(records.read(records.RECORDS / "covariance.csv"))
    tables.show(text)
    if args.docs:
        records.fill(records.DOCS / "accuracy.md", {"accuracy": text})


if __name__ == "__main__":
    main()
