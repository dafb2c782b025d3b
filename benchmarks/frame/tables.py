"""Tables as Markdown, at once or line by line, and numbers as text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def line(cells: Iterable[object]) -> str:
    """Return one line."""
    return f"| {' | '.join(map(str, cells))} |"


def head(names: Sequence[str]) -> str:
    """Return the two lines that a table begins with."""
    return f"{line(names)}\n|{'---|' * len(names)}"


def markdown(names: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a whole table."""
    return "\n".join([head(names), *map(line, rows)])


def show(text: str) -> None:
    """Print at once what is known so far."""
    print(text, flush=True)


def number(value: float | None, how: str) -> str:
    """Format a number; None is empty."""
    return "" if value is None else format(value, how)
