"""PLY: its header, held against what follows it, and what trimesh does not read of it.

trimesh reads as many rows of a text as there are, and no
binary file whose faces have not all as many corners.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from ibi_rs._core import InputError

from ._reading import Floats, check_count, check_most, check_rows, place

TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    "int64": "i8",
    "uint64": "u8",
    "float16": "f2",
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
MAX_HEADER_LINES = 1000
CORNERS = ("vertex_indices", "vertex_index")
EYE = ("view_px", "view_py", "view_pz")


@dataclass
class Element:
    """What the header says of vertices, faces or others."""

    name: str
    count: int
    properties: list[tuple[str, str, str | None]] = field(default_factory=list)
    """Name, type, and the type of its length if it is a list."""

    @property
    def has_lists(self) -> bool:
        """Whether its rows may have different lengths."""
        return any(length is not None for _, _, length in self.properties)

    def dtype(self) -> npt.DTypeLike:
        """Of a row of one without lists."""
        return np.dtype([(name, kind) for name, kind, _ in self.properties])


@dataclass
class Ply:
    """What is there, checked, as far as it was read."""

    rows: dict[str, npt.NDArray[np.void]]
    """Elements without lists, of a binary file."""
    polygons: list[npt.NDArray[np.int64]] | None
    """Of a binary file whose faces have different numbers of corners."""
    viewpoint: Floats | None = None
    has_triangles_only: bool = True


def viewpoint(path: Path) -> Floats | None:
    """Where the camera stood, if an element ``camera`` says so, as PCL writes it."""
    return checked(path).viewpoint


def checked(path: Path) -> Ply:
    """Refuse what is cut; return what trimesh would not read."""
    with path.open("rb") as file:
        kind, elements = _header(file)
        for element in elements:
            check_most(element.count)
        if kind == "ascii":
            lines = [line for line in file.read().decode("utf-8", "replace").splitlines() if line.strip()]
            return _check_text(lines, elements)
        held = _binary(path, file, elements)
    camera = held.rows.get("camera")
    if camera is not None and set(EYE) <= set(camera.dtype.names or ()):
        held.viewpoint = place([camera[name][0] for name in EYE])
    return held


def _header(file: BinaryIO) -> tuple[str, list[Element]]:
    if file.readline(80).strip().lower() != b"ply":
        raise InputError("is no PLY file")
    kind, elements = "", []
    try:
        for _ in range(MAX_HEADER_LINES):
            words = file.readline(10_000).decode("ascii", "replace").split()
            if words[:1] == ["format"]:
                kind = words[1]
            elif words[:1] == ["element"]:
                elements.append(Element(words[1], int(words[2])))
            elif words[:2] == ["property", "list"]:
                order = ">" if "big" in kind else "<"
                elements[-1].properties.append((words[4], order + TYPES[words[3]], order + TYPES[words[2]]))
            elif words[:1] == ["property"]:
                order = ">" if "big" in kind else "<"
                elements[-1].properties.append((words[2], order + TYPES[words[1]], None))
            elif words == ["end_header"]:
                if kind not in ("ascii", "binary_little_endian", "binary_big_endian"):
                    raise InputError(f"is of the format '{kind}', which PLY does not have")
                if any(element.count < 0 for element in elements):
                    raise InputError("its header counts less than nothing")
                return kind, elements
    except (IndexError, KeyError, ValueError):
        raise InputError(f"its header has a line that means nothing: {' '.join(words)[:80]}") from None
    raise InputError("its header does not end; the file is cut")


def _check_text(lines: list[str], elements: list[Element]) -> Ply:
    """Refuse lines that are cut."""
    first, held = 0, Ply({}, None)
    for element in elements:
        what = _plural(element.name)
        rows = lines[first : first + element.count]
        check_count(element.count, len(rows), what)
        first += element.count
        for number, line in enumerate(rows):
            words = line.split()
            if not element.has_lists:
                wanted = len(element.properties)
            else:
                wanted = 0
                for _, _, length in element.properties:
                    wanted += 1
                    if length is not None and wanted <= len(words):
                        wanted += int(words[wanted - 1]) if words[wanted - 1].isdecimal() else 0
            if len(words) != wanted:
                raise InputError(
                    f"row {number} of its {what} has {len(words)} numbers; it must have {wanted}"
                )
            if element.name == "face" and wanted != 4:  # or a list of three with something more: looked into
                held.has_triangles_only = False
        if element.name == "camera" and rows:
            names = [name for name, _, _ in element.properties]
            values = dict(zip(names, rows[0].split(), strict=False))
            held.viewpoint = place([values.get(name) for name in EYE])
    check_rows(first, len(lines), "rows")
    return held


def _plural(name: str) -> str:
    return {"vertex": "vertices"}.get(name, f"{name}s")


def _binary(path: Path, file: BinaryIO, elements: list[Element]) -> Ply:
    held = Ply({}, None)
    size = path.stat().st_size
    for element in elements:
        if element.count == 0:
            continue
        what = _plural(element.name)
        if not element.has_lists:
            dtype = np.dtype(element.dtype())
            check_count(element.count, (size - file.tell()) // max(dtype.itemsize, 1), what)
            held.rows[element.name] = np.frombuffer(file.read(element.count * dtype.itemsize), dtype)
            continue
        start = file.tell()
        corners = _corners_alike(file, element, size)
        if element.name == "face" and corners != 3:
            held.has_triangles_only = False
        if corners is None:
            file.seek(start)
            polygons = _walked(file.read(), element)
            check_count(element.count, len(polygons.ends), what)
            file.seek(start + polygons.ends[-1])
            if element.name == "face":
                held.polygons = polygons.rows
    if file.tell() != size:
        raise InputError(f"{size - file.tell()} bytes follow what the header says")
    return held


def _corners_alike(file: BinaryIO, element: Element, size: int) -> int | None:
    """Return how long the first list is if all rows are alike: the file is then behind them."""
    start = file.tell()
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for number, (_, kind, length) in enumerate(element.properties):
        items: tuple[int, ...] = ()
        if length is not None:
            fields.append((f"length {number}", length, ()))
            file.seek(start + np.dtype(fields).itemsize - np.dtype(length).itemsize)
            said = file.read(np.dtype(length).itemsize)
            if len(said) < np.dtype(length).itemsize:
                return None
            items = (int(np.frombuffer(said, length)[0]),)
            if not 0 <= items[0] <= size:
                return None
        fields.append((f"values {number}", kind, items))
    dtype = np.dtype(fields)
    if element.count * dtype.itemsize > size - start:
        return None
    file.seek(start)
    rows = np.frombuffer(file.read(element.count * dtype.itemsize), dtype)
    lengths = [rows[name] for name, _, _ in fields if name.startswith("length")]
    return int(lengths[0][0]) if all((length == length[0]).all() for length in lengths) else None


@dataclass
class _Walked:
    rows: list[npt.NDArray[np.int64]]
    ends: list[int]


def _walked(data: bytes, element: Element) -> _Walked:
    """Read the corners of each row, as far as rows are whole."""
    # numpy's names of types, and those of struct.
    codes = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "i8": "q", "u8": "Q"}
    codes |= {"f2": "e", "f4": "f", "f8": "d"}
    order = element.properties[0][1][0]
    steps = [
        (
            name in CORNERS,
            codes[kind[1:]],
            int(kind[2:]),
            None if length is None else struct.Struct(order + codes[length[1:]]),
        )
        for name, kind, length in element.properties
    ]
    walked, at = _Walked([], []), 0
    for _ in range(element.count):
        corners: tuple[int, ...] = ()
        for is_corners, code, width, length in steps:
            count = 1
            if length is not None:
                if at + length.size > len(data):
                    return walked
                count = int(length.unpack_from(data, at)[0])
                at += length.size
            if count < 0 or at + count * width > len(data):
                return walked
            if is_corners:
                corners = struct.unpack_from(f"{order}{count}{code}", data, at)
            at += count * width
        walked.rows.append(np.array(corners, dtype=np.int64))
        walked.ends.append(at)
    return walked
