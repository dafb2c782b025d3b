"""Meshes in files that are cut, or say more than they hold: refused before trimesh looks at them."""

from __future__ import annotations

import json
import re
import struct
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from ibi_rs._core import InputError

from . import _ply
from ._reading import check_count, check_most


def check_file(path: Path) -> _ply.Ply | None:
    """Refuse a file that is shorter than it says."""
    suffix = path.suffix.lower()
    if suffix == ".ply":
        return _ply.checked(path)
    checks = {
        ".stl": _check_stl,
        ".off": _check_off,
        ".obj": _check_obj,
        ".glb": _check_gltf,
        ".gltf": _check_gltf,
    }
    check = checks.get(suffix)
    if check is not None:
        check(path)
    return None


# At the beginning of a line: the name of a solid may have these words, too.
STL_BEGIN, STL_END = rb"(?im)^[ \t]*facet\b", rb"(?im)^[ \t]*endfacet\b"
STL_CORNER = rb"(?im)^[ \t]*vertex[ \t]+\S+[ \t]+\S+[ \t]+\S+[ \t]*\r?$"


def is_stl_text(path: Path) -> bool:
    """Whether it is no binary file; those may begin with ``solid``, too."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(1000)
    is_binary = len(head) >= 84 and size == 84 + 50 * struct.unpack_from("<I", head, 80)[0]
    return not is_binary and b"\0" not in head and head.lstrip()[:5].lower() == b"solid"


def _check_stl(path: Path) -> None:
    if is_stl_text(path):
        text = path.read_bytes()
        opened, closed, corners = (len(re.findall(word, text)) for word in (STL_BEGIN, STL_END, STL_CORNER))
        if opened != closed or not re.search(rb"(?i)endsolid[^\n]*\s*$", text):
            raise InputError(f"{opened} facets begin, and {closed} end; the file is cut")
        if corners != 3 * opened:
            raise InputError(f"{opened} facets have {corners} corners; they must have three each")
        return
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(84)
    if len(head) < 84:
        raise InputError("is no STL file")
    (said,) = struct.unpack_from("<I", head, 80)
    if size != 84 + 50 * said:
        raise InputError(
            f"is no STL file, or is cut: the header says {said} triangles, and {(size - 84) / 50:g} are there"
        )
    check_most(said)


def _check_obj(path: Path) -> None:
    for number, words in obj_lines(path):
        if words[0] == "v" and len(words) < 4:
            raise InputError(f"line {number} is a vertex of {len(words) - 1} numbers; it must have three")
        if words[0] == "f" and len(words) < 4:
            raise InputError(f"line {number} is a face of {len(words) - 1} corners; it must have three")


def obj_lines(path: Path) -> Iterable[tuple[int, list[str]]]:
    """Split those that are vertices or faces; there are no counts to compare with."""
    text = path.read_bytes()
    if b"\0" in text:
        raise InputError("is no OBJ file: it is no text")
    number = 1
    # A backslash goes on in the next line; there it counts as a line, too.
    for line in text.decode("utf-8", "replace").replace("\r\n", "\n").replace("\\\n", " \v ").split("\n"):
        if line[:2] in ("v ", "f ", "v\t", "f\t"):
            yield number, line.split()
        number += 1 + line.count("\v")


def _check_gltf(path: Path) -> None:
    text = path.read_bytes()
    size = len(text)
    if path.suffix.lower() == ".glb":
        if size < 20 or text[:4] != b"glTF":
            raise InputError("is no GLB file")
        said, length = struct.unpack_from("<8xII", text)
        check_count(said, size, "bytes")
        text = text[20 : 20 + length]
    held = json.loads(text)
    accessors = held.get("accessors", [])
    for accessor in accessors:  # zeros, which take no room in the file
        if "bufferView" not in accessor and accessor["count"] > size:
            raise InputError(f"says {accessor['count']} numbers, and holds none of them")
    uses = Counter(node["mesh"] for node in held.get("nodes", []) if "mesh" in node)
    check_most(
        sum(
            times * accessors[part["attributes"]["POSITION"]]["count"]
            for number, times in uses.items()
            for part in held["meshes"][number]["primitives"]
        )
    )


def _check_off(path: Path) -> None:
    lines = off_lines(path)
    counts = off_counts(lines)
    check_count(counts[0], min(len(lines) - 1, counts[0]), "vertices")
    faces = lines[1 + counts[0] :]
    check_count(counts[1], len(faces), "faces")
    cut = [line for line in faces[: counts[1]] if line[0].isdecimal() and len(line) <= int(line[0])]
    check_count(counts[1], counts[1] - len(cut), "whole faces")


def off_lines(path: Path) -> list[list[str]]:
    """Split each line from that of the counts on."""
    text = path.read_text(encoding="utf-8", errors="replace")
    words = [line.split("#")[0].split() for line in text.splitlines()]
    words = [line for line in words if line]
    head = re.match(r"[A-Za-z0-9]*OFF", words[0][0], re.IGNORECASE) if words else None
    if head:  # in some files of ModelNet the counts follow at once: OFF490 518 0
        words[0] = [word for word in (words[0][0][head.end() :], *words[0][1:]) if word]
        words = words if words[0] else words[1:]
    return words


def off_counts(lines: list[list[str]]) -> tuple[int, int]:
    try:
        return int(lines[0][0]), int(lines[0][1])
    except (IndexError, ValueError):
        raise InputError("is no OFF file: its first line does not count vertices and faces") from None
