"""What benchmarks/verdict.py looks for, and where: searches by row of its table, half and size of the run."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count
from typing import Any, Literal

import ibi_rs as ibi
import numpy as np
import numpy.typing as npt
from frame import scans
from frame.layouts import FIRST_SEED, MODELS, shapes
from ibi_rs import synth
from numpy.typing import NDArray
from verdict_metrics import Judgement, centred, judge

Half = Literal["tuning", "reporting"]
Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]

KINDS = ("bracket", "flange", "bolt", "clip", "pin")
PIECES = ("chair", "table", "shelf")
GAPS = (0, 1, 4, 10)
SIZES = (0.5, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2)
ABSENT = ("plate", "cube", "rod", "other", "near-copy")
FAMILY = {"tuning": "a", "reporting": "b"}
VISIBLE = 0.5
"""Least share of the silhouette that an instance must show to be asked for."""
VISIBLE_SURFACE = 0.3
"""In rooms, of the surface: a camera that sees all of a silhouette sees about half of the surface."""
NUM_DENSE, ALIKE = 12_000, 0.01
"""Points of a surface, and how far it may be off for a turn to be a symmetry, diameters."""
BOX_FRAMES = {
    "tuning": ("00020", "00024", "00028", "00009"),
    "reporting": ("00022", "00026", "00000"),
}
SCAN_NAMES = {"tuning": ("tee4", "tee10a", "multi"), "reporting": ("tee6", "tee16", "two", "Sileane")}


@dataclass(frozen=True)
class Scan:
    """What was measured, and what `Model.detect` is told of it.

    Attributes
    ----------
    name : str
    points : (N, 3) float64
    told : dict
        Further arguments of `Model.detect`.
    eyes : (E, 3) float64
        Where the cameras stood.
    half : str
    """

    name: str
    points: NDArray[np.float64]
    told: dict[str, Any]
    eyes: NDArray[np.float64]
    half: Half


@dataclass(frozen=True)
class Search:
    """One part looked for in one scan.

    Attributes
    ----------
    regime, what : str
        Which row of the table, and which part of it.
    scan : Scan
    part : str
        Name of the mesh, scaled by `scale`.
    mesh : Mesh
    scale : float
    poses, visibility : (K, 4, 4) and (K,) float64
        Of this part; none if it is not there.
    visible : float
        Least visibility of an instance that is asked for.
    mm : float
        A millimetre in the unit of the scan.
    is_complete : bool
        Whether all instances are labelled.
    """

    regime: str
    what: str
    scan: Scan
    part: str
    mesh: Mesh
    poses: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 4, 4)))
    visibility: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    scale: float = 1.0
    visible: float = VISIBLE
    mm: float = 1.0
    is_complete: bool = True

    def judge(self, found: npt.ArrayLike, model: ibi.Model, symmetries: ibi.Symmetries) -> Judgement:
        """Hold poses against the truth."""
        return judge(
            found,
            self.poses,
            self.visibility,
            model,
            symmetries,
            visible=self.visible,
            mm=self.mm,
            is_complete=self.is_complete,
        )


# Scans ----------------------------------------------------------------------------------------------------


def told_by_eyes(room: synth.Room) -> dict[str, Any]:
    """Return what `Model.detect` is told of a room whose eyes are known."""
    return {"tgt_normals": room.normals, "viewpoint": room.eyes}


def told_without_eyes(room: synth.Room) -> dict[str, Any]:
    """Return what it is told if they are not."""
    return {"tgt_normals": room.normals}


def of_camera(image: synth.DepthImage) -> dict[str, Any]:
    """Return what it is told of the scan of one camera."""
    intrinsics = image.fx, image.fy, image.cx, image.cy
    view = ibi.View.from_depth(image.depth, *intrinsics, target_from_camera=image.target_from_camera)
    return {"viewpoint": view}


def bin_scan(name: str, made: synth.Bin, half: Half) -> Scan:
    """Return the scan of the first camera of a bin."""
    image = made.cameras[0]
    return Scan(name, image.points, of_camera(image), made.eyes[:1], half)


def room_scan(name: str, made: synth.Room, half: Half, with_eyes: bool = True) -> Scan:
    """Return the scan of a room."""
    told = told_by_eyes if with_eyes else told_without_eyes
    return Scan(name, made.points, told(made), made.eyes, half)


def flaws(seed: int) -> dict[str, float]:
    """Return the noise of a camera: cameras differ."""
    rng = np.random.default_rng([seed, 18])
    return {"noise": float(rng.uniform(0.03, 0.2)), "quantum": float(rng.uniform(0.01, 0.06))}


def part(kind: str, half: Half, more: str = "") -> tuple[str, Mesh]:
    """Return the name and the mesh of a part of one half."""
    name = f"{kind}-{FAMILY[half]}{more}"
    return name, synth.part_mesh(name)


def piece(kind: str, half: Half) -> tuple[str, Mesh]:
    """Return the name and the mesh of a piece of furniture of one half."""
    name = f"{kind}-{FAMILY[half]}"
    return name, synth.furniture_mesh(name)


def other_pieces(half: Half, *without: str) -> dict[str, Mesh]:
    """Return all furniture of a half but some kinds, by kind."""
    kinds = [name.rsplit("-", 1)[0] for name in synth.FURNITURE if name.endswith(FAMILY[half])]
    return {kind: piece(kind, half)[1] for kind in kinds if kind not in without}


def exact(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rigid motions that are meant by rounded ones."""
    u, _, vt = np.linalg.svd(poses[:, :3, :3])
    meant = poses.copy()
    meant[:, :3, :3] = u @ vt
    return meant


def fewer(quick: bool, many: int, few: int = 1) -> int:
    """Return how many there are of something."""
    return few if quick else many


# Rows -----------------------------------------------------------------------------------------------------


def boxes(half: Half, quick: bool) -> Iterator[Search]:
    """Look for each of two boxes in each frame of the folder; those of the other half are marked so."""
    if scans.FOLDER is None:
        return
    from PIL import Image

    folder = scans.FOLDER / "real_boxes"
    truth = json.loads((folder / "gt.json").read_text(encoding="utf-8"))
    camera = truth["camera"]
    for frame, labels in truth["scenes"].items():
        of_half: Half = "tuning" if frame in BOX_FRAMES["tuning"] else "reporting"
        if quick and of_half != half:
            continue
        with Image.open(folder / f"depth/{frame}.png") as image:
            depth = np.asarray(image, dtype=np.float64) / 8000
        view = ibi.View.from_depth(depth, *(camera[key] for key in ("fx", "fy", "cx", "cy")))
        scan = Scan(f"boxes-{frame}", view.points, {"viewpoint": view}, np.zeros((1, 3)), of_half)
        for name in truth["objects"]:
            mine = [one for one in labels["instances"] if one["object"] == name]
            yield Search(
                f"boxes, {labels['kind']}",
                name,
                scan,
                name,
                ibi.io.read_mesh(folder / f"model_{name}.ply"),
                exact(np.array([one["T"] for one in mine]).reshape(-1, 4, 4)),
                np.array([one["visible"] for one in mine]),
                mm=1e-3,
            )


def real_scans(half: Half, quick: bool) -> Iterator[Search]:
    """Look for the part of each real scan with labels."""
    for case in scans.real():
        of_half: Half = "tuning" if case.name in SCAN_NAMES["tuning"] else "reporting"
        if quick and of_half != half:
            continue
        scan = Scan(case.name, case.points, {"viewpoint": [0, 0, 0]}, np.zeros((1, 3)), of_half)
        yield Search(
            "scans",
            case.name,
            scan,
            case.name,
            case.mesh,
            case.poses,
            case.visibility,
            mm=1e-3,
            is_complete=case.is_complete,
        )


def bins(half: Half, quick: bool) -> Iterator[Search]:
    """Look for the parts of bins: of one kind each, and of all five."""
    seed = count(FIRST_SEED[half])
    for kind in KINDS:
        for _ in range(fewer(quick, 4)):
            made_of = part(kind, half)
            at = next(seed)
            made = synth.bin_scene([made_of[1]], seed=at, num_instances=12, **flaws(at))
            scan = bin_scan(f"bin-{made_of[0]}-{at}", made, half)
            yield Search("bins", kind, scan, *made_of, made.poses, made.visibility)
    parts = [part(kind, half) for kind in KINDS]
    for _ in range(fewer(quick, 4)):
        at = next(seed)
        made = synth.bin_scene([mesh for _, mesh in parts], seed=at, num_instances=4, **flaws(at))
        scan = bin_scan(f"bin-mixed-{at}", made, half)
        for i, (kind, made_of) in enumerate(zip(KINDS, parts, strict=True)):
            yield Search("bins", kind, scan, *made_of, *made.of_kind(i))


def rows(half: Half, quick: bool) -> Iterator[Search]:
    """Look for boxes in flush rows."""
    made_of = part("carton", half)
    seed = count(FIRST_SEED[half])
    for gap in GAPS:
        for _ in range(fewer(quick, 3)):
            at = next(seed)
            made = synth.row_scene(made_of[1], seed=at, gap=gap, num_empty=at % 3, **flaws(at))
            scan = bin_scan(f"rows-{gap}mm-{at}", made, half)
            yield Search("rows", f"gap {gap} mm", scan, *made_of, made.poses, made.visibility)


def furnished(half: Half, seed: int, coverage: str, *without: str) -> tuple[str, synth.Room]:
    """Make a room of one kind of piece, by the seed, and of other kinds but some."""
    kind = PIECES[seed % len(PIECES)]
    others = other_pieces(half, kind, *without)
    return kind, synth.room_scene(
        piece(kind, half)[1],
        list(others.values()),
        seed=seed,
        coverage=coverage,  # type: ignore[arg-type]
    )


def rooms(half: Half, quick: bool) -> Iterator[Search]:
    """Look for the pieces of rooms, with and without knowing the eyes."""
    seed = count(FIRST_SEED[half])
    for coverage in ("little", "well"):
        for _ in range(fewer(quick, 20, 2)):
            at = next(seed)
            kind, room = furnished(half, at, coverage)
            for with_eyes in (True, False):
                yield Search(
                    "rooms, eyes" if with_eyes else "rooms, no eyes",
                    coverage,
                    room_scan(f"room-{kind}-{coverage}-{at}", room, half, with_eyes),
                    *piece(kind, half),
                    room.poses,
                    room.visibility,
                    visible=VISIBLE_SURFACE,
                    mm=1e-3,
                )


def piles(half: Half, quick: bool) -> Iterator[Search]:
    """Look for the part of which a pile is made: shapes of all kinds, two piles of each."""
    names = [name for name in shapes("plain", half) if (MODELS / name).exists()]
    for at in range(FIRST_SEED[half] + 400, FIRST_SEED[half] + 400 + fewer(quick, 2)):
        for name in names[: fewer(quick, len(names), 2)]:
            case = scans.pile(MODELS / name, at)
            scan = Scan(
                f"pile-{case.name}-{at}", case.points, {"viewpoint": [0, 0, 0]}, np.zeros((1, 3)), half
            )
            yield Search("piles", "piles", scan, case.name, case.mesh, case.poses, case.visibility)


def absent(half: Half, quick: bool) -> Iterator[Search]:
    """Look for parts that are not there, in piles, bins and rooms: 40 times each, and for near-copies."""
    seed = count(FIRST_SEED[half] + 100)
    for i in range(fewer(quick, 10)):
        kind, other = KINDS[i % 5], KINDS[(i + 1 + i // 5) % 5]
        mesh = part(kind, half)[1]
        at = next(seed)
        pile = synth.pile_scene(*mesh, seed=at)
        scan = Scan(f"pile-{kind}-{at}", pile.points, {"viewpoint": [0, 0, 0]}, np.zeros((1, 3)), half)
        made = synth.bin_scene([mesh], seed=at, num_instances=12, **flaws(at))
        for one in (scan, bin_scan(f"absent-bin-{kind}-{at}", made, half)):
            for what in ABSENT:
                looked_for = {"other": part(other, half), "near-copy": part(kind, half, "-near")}
                yield Search("absent", what, one, *(looked_for.get(what) or part(what, half)))
    for i in range(fewer(quick, 10)):
        at = next(seed)
        left_out = ("stool", "cabinet", "lamp")[i % 3]
        kind, room = furnished(half, at, ("little", "well")[i % 2], left_out)
        scan = room_scan(f"absent-room-{kind}-{at}", room, half)
        for what in ABSENT:
            if what == "other":
                name, mesh = piece(left_out, half)
            elif what == "near-copy":
                name, mesh = piece(kind, half)
                name, mesh = f"{name}, wider", (mesh[0] * [1.3, 1, 1], mesh[1])
            else:
                # In metres, as large as furniture.
                name, mesh = part(what, half)
                name, mesh = f"{name}, large", (mesh[0] * 0.02, mesh[1])
            yield Search("absent", what, scan, name, mesh, mm=1e-3)


def mirror(half: Half, quick: bool) -> Iterator[Search]:
    """Look for the mirror image of a bracket, and for the bracket itself."""
    right, other = part("bracket", half), part("bracket", half, "-mirror")
    for at in range(FIRST_SEED[half] + 200, FIRST_SEED[half] + 200 + fewer(quick, 5)):
        pile = synth.pile_scene(*right[1], seed=at)
        made = synth.bin_scene([right[1]], seed=at, num_instances=12, **flaws(at))
        told = {"viewpoint": [0, 0, 0]}
        for scan, truth in (
            (Scan(f"pile-bracket-{at}", pile.points, told, np.zeros((1, 3)), half), pile),
            (bin_scan(f"mirror-bin-{at}", made, half), made),
        ):
            yield Search("mirror", "mirror image", scan, *other)
            yield Search("mirror", "the right one", scan, *right, truth.poses, truth.visibility)


def sizes(half: Half, quick: bool) -> Iterator[Search]:
    """Look for models of other sizes in a real scan and in piles."""
    wanted = "tee4" if half == "tuning" else "tee6"
    told = {"viewpoint": [0, 0, 0]}
    cases = [(case, 1e-3) for case in scans.real() if case.name == wanted]
    names = [name for name in shapes("plain", half) if (MODELS / name).exists()]
    cases += [
        (scans.pile(MODELS / name, FIRST_SEED[half] + 300 + i), 1.0)
        for i, name in enumerate(names[: fewer(quick, 8)])
    ]
    for case, mm in cases:
        name = case.name if case.seed is None else f"pile-{case.name}-{case.seed}"
        scan = Scan(name, case.points, told, np.zeros((1, 3)), half)
        for scale in SIZES:
            mesh = case.mesh[0] * scale, case.mesh[1]
            is_size = scale == 1.0
            yield Search(
                "sizes",
                case.data,
                scan,
                case.name,
                mesh,
                case.poses if is_size else case.poses[:0],
                case.visibility if is_size else case.visibility[:0],
                scale=scale,
                mm=mm,
            )


ROWS: dict[str, Callable[[Half, bool], Iterator[Search]]] = {
    "boxes": boxes,
    "scans": real_scans,
    "bins": bins,
    "rows": rows,
    "piles": piles,
    "rooms": rooms,
    "absent": absent,
    "mirror": mirror,
    "sizes": sizes,
}


def outlier_scenes(half: Half, quick: bool) -> Iterator[synth.Scene]:
    """Make scenes of five instances, each with 10 right pairs of 5000: more would help to find the rest."""
    clouds = shapes("plain", half)
    names = list(clouds)
    for i in range(fewer(quick, 20, 2)):
        cloud = clouds[names[i % len(names)]][0]
        yield synth.outlier_layout(
            FIRST_SEED[half] + i, shape=cloud, true_pairs=10, num_correspondences=5000, num_instances=5
        )


def symmetries(mesh: Mesh, to_middle: NDArray[np.float64]) -> ibi.Symmetries:
    """Return what leaves a part looking the same, about its middle.

    From points that are denser than those of the model, which cannot tell a box of 44 x 52 from a square one.
    """
    points, normals = ibi.features.sample_mesh(*mesh, n=NUM_DENSE)
    seen = ibi.features.outer_surface(points, normals, *mesh)
    return ibi.find_symmetries(points[seen] - to_middle[:3, 3], normals[seen], tolerance=ALIKE)


class Models:
    """Models of searches, each made once, with their symmetries about their middle where there is a truth."""

    def __init__(self) -> None:
        self._held: dict[tuple[str, float, bool], tuple[bytes, ibi.Model, ibi.Symmetries]] = {}

    def of(self, search: Search) -> tuple[ibi.Model, ibi.Symmetries]:
        """Return the model of a search, and its symmetries."""
        key = search.part, search.scale, len(search.poses) > 0
        corners = search.mesh[0].tobytes()
        if key not in self._held or self._held[key][0] != corners:
            model = ibi.Model.from_mesh(*search.mesh)
            found = ibi.Symmetries.none()
            if len(search.poses):
                found = symmetries(search.mesh, centred(model)[1])
            self._held[key] = corners, model, found
        return self._held[key][1:]
