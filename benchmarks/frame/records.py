"""Where results go: csv files in benchmarks/records, tables in pages, pictures beside the pages."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
RECORDS = ROOT / "benchmarks/records"
DOCS = ROOT / "docs"
FIGURES = DOCS / "figures"

Row = dict[str, str]


def read(path: Path) -> list[Row]:
    """Read a record; none is an empty one."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write(
    folder: Path | None, name: str, rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = ()
) -> None:
    """Write a record: these columns of the rows, or all that the first has; without a folder nothing."""
    if folder is None:
        return
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / name).open("w", newline="", encoding="utf-8") as file:
        out = csv.DictWriter(
            file, columns or list(rows[0]), restval="", extrasaction="ignore", lineterminator="\n"
        )
        out.writeheader()
        out.writerows(rows)


def filled(page: str, tables: Mapping[str, str]) -> str:
    """Return a page with tables put between ``<!-- NAME -->`` and ``<!-- end -->``."""
    for name, table in tables.items():
        begin, end = f"<!-- {name} -->\n", "\n<!-- end -->"
        text = begin + table + end
        page = re.sub(f"{re.escape(begin)}.*?{end}", lambda _, text=text: text, page, flags=re.DOTALL)
    return page


def fill(page: Path, tables: Mapping[str, str]) -> None:
    """Put tables into a page."""
    page.write_text(filled(page.read_text(encoding="utf-8"), tables), encoding="utf-8")
