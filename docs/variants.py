"""The parameters of the variants, as their dataclasses say it: prints their table, fills it into the page.

python docs/variants.py
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple, get_args

from ibi_rs import variants

PAGE = Path(__file__).parent / "parameters.md"
STAGES = {"scs": variants.Scs, "ce": variants.Ce, "te": variants.Te, "hv": variants.Hv}
"""The union of the variants of each stage."""


class Parameter(NamedTuple):
    """One parameter of a variant."""

    path: str
    """As in ``scs.n_gtm``."""
    variant: str
    default: Any
    meaning: str
    """Of its docstring, in one line; with its range."""


def parameters() -> Iterator[Parameter]:
    """All of them, by stage and variant."""
    for stage, union in STAGES.items():
        for variant in get_args(union):
            doc = inspect.getdoc(variant) or ""
            told = re.findall(r"^(\w+)\n((?:    .*\n?)+)", doc.partition("Parameters\n")[2], re.MULTILINE)
            meanings = {name: " ".join(text.split()) for name, text in told}
            for field in fields(variant):
                path = f"{stage}.{field.name}"
                yield Parameter(path, variant.variant, field.default, meanings[field.name])


def table() -> str:
    """As Markdown."""
    rows = ["| parameter | of | default | meaning and range |", "|---|---|---|---|"]
    for path, variant, default, meaning in parameters():
        text = re.sub(r"(?::\w+:)?`+([^`]+)`+", r"`\1`", meaning)
        rows.append(f"| `{path}` | `{variant}` | {shown(default)} | {text} |")
    return "\n".join(rows)


def shown(value: Any) -> str:
    """Write a value as the tables have it."""
    if isinstance(value, float):
        return f"{value:g}"
    return "none" if value is None else str(value).lower()


def page() -> str:
    """Return the page with the table in its place."""
    text = PAGE.read_text(encoding="utf-8")
    return re.sub(r"(?<=<!-- variants -->\n).*?(?=\n<!-- end -->)", lambda _: table(), text, flags=re.DOTALL)


if __name__ == "__main__":
    print(table())
    PAGE.write_text(page(), encoding="utf-8")
