"""Text: a point a line, its columns named or not."""

from __future__ import annotations

import codecs
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ibi_rs._core import InputError

from ._reading import Floats, Rows, check_count, check_most, unnamed

COMMENTS = ("#", "//", "%")
AXES = ("x", "y", "z")
ROWS_THAT_COUNT = 8
"""So many rows of a first column that counts them are no coincidence."""


def read(path: Path) -> Rows:
    """Read XYZ, TXT, PTS or CSV."""
    lines = _decoded(path.read_bytes()).splitlines()
    layout = _layout(lines)
    body = [line for line in lines[layout.first :] if line.strip() and not line.lstrip().startswith(COMMENTS)]
    if any(mark in line for mark in COMMENTS for line in body[:1]):
        body = [_without_comment(line) for line in body]
    check_most(len(body))
    if layout.count is not None:
        check_count(layout.count, len(body), "points")
    if layout.has_decimal_commas:
        body = [line.replace(",", ".") for line in body]
    if layout.delimiter is not None:  # one at the end of a line is no column
        body = [line.rstrip().removesuffix(layout.delimiter) for line in body]
    table = np.loadtxt(body, delimiter=layout.delimiter, ndmin=2) if body else np.empty((0, 3))
    return _named(table, layout.names) if layout.names is not None else _unnamed(table)


def _decoded(data: bytes) -> str:
    for mark, encoding in ((codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16")):
        if data.startswith(mark):
            return data.decode(encoding)
    if b"\0" in data:
        raise InputError("is no text")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:  # names and comments of another encoding; numbers are the same in all
        return data.decode("latin-1")


def _without_comment(line: str) -> str:
    for mark in COMMENTS:
        line = line.split(mark)[0]
    return line


@dataclass(frozen=True)
class _Layout:
    first: int
    """The first line that may hold a point."""
    names: list[str] | None
    count: int | None
    """How many points a line says there are."""
    delimiter: str | None
    """None: any white space."""
    has_decimal_commas: bool


def _layout(lines: list[str]) -> _Layout:
    names, count = None, None
    for at, line in enumerate(lines):
        stripped = line.strip()
        if not stripped:
            continue
        is_comment = stripped.startswith(COMMENTS)
        words = _words(stripped.lstrip("#/%") if is_comment else _without_comment(stripped))
        if is_comment or not all(map(_is_number, words)):
            found = [_name(word) for word in words]
            if set(AXES) <= set(found) or not is_comment:
                names = found
            if not is_comment and not set(AXES) <= set(found):
                raise InputError(
                    f"line {at + 1} names the columns {', '.join(words)[:80]}; none are x, y and z"
                )
            continue
        if len(words) == 1 and words[0].isdecimal() and count is None:
            count = int(words[0])
            continue
        delimiter = next((mark for mark in (";", ",", "\t") if mark in line.rstrip()), None)
        if delimiter == "," and "\t" in stripped:
            delimiter = "\t"
        if delimiter == "\t" and len(stripped.split()) != stripped.count("\t") + 1:
            if "" in stripped.split("\t"):
                raise InputError(f"line {at + 1} has an empty cell between two tabs")
            delimiter = None
        return _Layout(at, names, count, delimiter, delimiter in (";", "\t") and "," in stripped)
    return _Layout(len(lines), names, count, None, False)


def _words(line: str) -> list[str]:
    separators = r"[;\t]" if ";" in line or "\t" in line else r"[,\s]"
    if '"' in line or "[" in line or "(" in line:  # units and quoted names have spaces of their own
        line = re.sub(r"\[[^\]]*\]|\([^)]*\)", "", line).replace('"', "").replace("'", "")
    return [word.strip() for word in re.split(f"{separators}+", line.strip()) if word.strip()]


def _is_number(word: str) -> bool:
    try:
        float(word.replace(",", "."))
    except ValueError:
        return False
    return True


def _name(word: str) -> str:
    """x, y, z, nx, ny, nz, however a program writes them; other words as they are."""
    word = word.lower().strip(" \"'")
    word = re.sub(r"(?<=[xyz])_(mm|cm|dm|m|um|in|inch|ft)$", "", word)
    if match := re.fullmatch(r"(points?|normals?)[:_ ]?([012xyz])", word):
        kind, axis = match.groups()
        axis = AXES[int(axis)] if axis.isdecimal() else axis
        return axis if kind.startswith("p") else f"n{axis}"
    if match := re.fullmatch(r"n[_ ]?([xyz])", word):
        return f"n{match[1]}"
    return word


def _named(table: Floats, names: list[str]) -> Rows:
    if table.size == 0:
        return Rows(np.empty((0, 3)))
    if table.shape[1] != len(names):
        raise InputError(
            f"names {len(names)} columns ({', '.join(names)[:80]}), and {table.shape[1]} are there"
        )
    at = {name: column for column, name in reversed(list(enumerate(names)))}
    points = table[:, [at[axis] for axis in AXES]]
    normals = [at[f"n{axis}"] for axis in AXES if f"n{axis}" in at]
    return Rows(points, table[:, normals] if len(normals) == 3 else None)


def _unnamed(table: Floats) -> Rows:
    if table.shape[1] < 3:
        raise InputError(f"has {table.shape[1]} columns; a point has three")
    first = table[:, 0]
    if table.shape[1] > 3 and len(table) >= ROWS_THAT_COUNT and (np.diff(first) == 1).all():
        raise InputError(
            "the first of its columns counts the rows; name the columns in a first line: id x y z"
        )
    return unnamed(table)
