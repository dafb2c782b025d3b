"""Detection in ray-cast piles, and other programs on the same clouds: prints tables, records every scene.

    python benchmarks/piles.py                   # the meshes of examples/models, the shipped scans
    IBI_DATA=FOLDER python benchmarks/piles.py   # FOLDER/models/*.ply, all labelled scans
    IBI_DATA=FOLDER python benchmarks/piles.py --docs
    python benchmarks/piles.py --data pile --half tuning --shapes cat koala --no-peers
    python benchmarks/piles.py --tune pile

A pile is `ibi_rs.synth.pile_scene` as it is by default: ten instances of one mesh on a table, seen by one
camera. Shapes are all meshes of the folder but the symmetric ones, which benchmarks/symmetry.py tells: there
some turn by more than 20 degrees leaves less than 0.03 radii of deviation. Seeds are those of the reporting
half of benchmarks/frame/layouts.py; whoever tunes takes ``--half tuning``.

Scores are one to one by ADD-S below a tenth of the diameter, over the instances that show at least 30 % of
what they would show alone. A pose that is right for an instance that shows less is neither right nor wrong.

The peers get what `Model.correspond` gives ours: the thinned scan without its table, with normals; PCL the
correspondences, too. They run once on the first seeds of each shape, and on the real scans of
benchmarks/frame/scans.py. Seconds are wall clock: of the model (from its mesh; for PPF its training, too), of
the correspondences, and of the search for poses. Ours are medians of `--repeats`.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import ibi_rs as ibi
import numpy as np
import numpy.typing as npt
from frame import cli, records, tables
from frame.layouts import FIRST_SEED, MODELS, index
from frame.records import Row
from frame.runs import spacing
from frame.scans import FOLDER, Case, Detection, detect, pile, real
from frame.tables import number, show
from frame.timing import CORES, timed
from ibi_rs import features, metrics, synth
from numpy.typing import NDArray
from peers import METHODS, available
from peers.overlap import Claims, keep_best
from symmetry import THRESHOLD, deviation

PAGE = records.DOCS / "features.md"
RECORD = "piles.csv"
SECONDS = ("model_s", "match_s", "search_s")
SCORES = ("recall", "precision", "f1")
COLUMNS = (
    *("data", "name", "seed", "wall", "method", "points", "model_points", "visible", "poses", "right"),
    *("ignored", *SCORES, *SECONDS, "version", "missing"),
)

VISIBLE = 0.3
"""An instance that shows a smaller share of what it would show alone is not asked for."""
THICK = 2.0
"""Walls of less, in voxels, are thin: the two sides of one lie in each other's neighbourhood."""
OURS = "ibi"
DATA = ("pile", "scan")


@dataclass(frozen=True)
class Peer:
    """How another program of `peers.METHODS` is set here, and the values that was chosen from.

    `least` is the threshold of the overlap check on piles and on scans, the rest is what the adapter takes.
    """

    settings: dict[str, Any]
    least: dict[str, float]
    sweep: dict[str, list[Any]]
    with_matches: bool


LEAST = [0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4]
"""Tried for both: from one side at most half of a model is seen."""
PEERS = {
    "PCL GC + check": Peer(
        {"size_pr": 1.5, "threshold": 4, "refit": True},
        {"pile": 0.3, "scan": 0.15},
        {"size_pr": [1.0, 1.5, 2.0], "threshold": [3, 4, 6, 8]},
        with_matches=True,
    ),
    "OpenCV PPF + check": Peer(
        {"model_step": 0.03, "scene_step": 0.01, "every": 5, "neighbors": 12, "candidates": 400},
        {"pile": 0.3, "scan": 0.2},
        {"model_step": [0.03, 0.05], "scene_step": [0.01, 0.02], "every": [2, 5]},
        with_matches=False,
    ),
}


@cache
def shapes(folder: Path = FOLDER / "models" if FOLDER else MODELS) -> dict[str, Path]:
    """Return the meshes of a folder that are not symmetric, by name.

    The index of the shipped meshes says which are; one that is not in it is measured.
    """
    known = {entry["file"]: entry["symmetric"] for entry in index()}

    def is_symmetric(path: Path) -> bool:
        if path.name in known:
            return bool(known[path.name])
        points, _ = synth.sample_mesh(path, 3400, np.random.default_rng(0))
        return deviation(points)[0] < THRESHOLD

    return {path.stem: path for path in sorted(folder.glob("*.ply")) if not is_symmetric(path)}


@cache
def wall(path: Path) -> float:
    """Median way through the part, inwards from a point of its outer surface to the next face, in voxels."""
    import open3d as o3d

    vertices, faces = ibi.io.read_mesh(path)
    voxel = np.linalg.norm(np.ptp(vertices[np.unique(faces)], axis=0)) / 24
    points, normals = features.sample_mesh(vertices, faces, n=4000)
    outer = features.outer_surface(points, normals, vertices, faces)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
    )
    rays = np.hstack([points - 1e-3 * voxel * normals, -normals])[outer].astype(np.float32)
    return float(np.median(scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()) / voxel)


# Scores ---------------------------------------------------------------------------------------------------


def score_visible(
    found: npt.ArrayLike,
    poses: NDArray[np.float64],
    visibility: NDArray[np.float64],
    model: NDArray[np.float64],
) -> tuple[metrics.SceneScore, int]:
    """Score over the visible instances, and count the poses that are right for one that is hardly visible.

    Held one to one against *all* instances, so that a hardly visible one excuses one pose and no duplicate of
    it; what it excuses is left out, and the rest is scored against the visible instances.
    """
    predicted = np.asarray(found).reshape(-1, 4, 4)
    is_visible = visibility >= VISIBLE
    against_all = metrics.score_scene(predicted, poses, criterion=metrics.ADD_S, model=model)
    excused = np.array(
        [m is not None and m.is_hit and not is_visible[m.truth] for m in against_all.matches], dtype=bool
    )
    score = metrics.score_scene(predicted[~excused], poses[is_visible], criterion=metrics.ADD_S, model=model)
    return score, int(excused.sum())


def row(case: Case, method: str, **columns: str) -> Row:
    """Return what the record holds of one method on one scan."""
    head = {"data": case.data, "name": case.name, "method": method}
    if case.seed is not None:
        head |= {"seed": str(case.seed), "wall": f"{wall(shapes()[case.name]):.2f}"}
    return dict.fromkeys(COLUMNS, "") | head | columns


def scored(
    case: Case, method: str, model: ibi.Model, found: npt.ArrayLike, seconds: Sequence[float | None]
) -> Row:
    """Return the row of a method that has run."""
    score, ignored = score_visible(found, case.poses, case.visibility, model.points)
    return row(
        case,
        method,
        points=str(len(case.points)),
        model_points=str(len(model)),
        visible=str(score.num_truth),
        poses=str(score.num_predicted),
        right=str(score.num_truth_hit),
        ignored=str(ignored),
        **{key: f"{getattr(score, key):.4f}" for key in (SCORES if case.is_complete else SCORES[:1])},
        **{key: number(value, ".4f") for key, value in zip(SECONDS, seconds, strict=True)},
    )


# Runs -----------------------------------------------------------------------------------------------------


def scene_of(case: Case, done: Detection) -> synth.Scene:
    """Return what peers are given: what ours has made of the scan."""
    matches = done.matches
    return synth.Scene(
        done.model.points,
        matches.tgt,
        matches.corr,
        case.poses,
        case.name,
        similarity=matches.similarity,
        src_normals=done.model.normals,
        tgt_normals=matches.tgt_normals,
    )


def run_peer(case: Case, name: str, done: Detection) -> Row:
    """Run a peer once on what ours has made."""
    peer, scene = PEERS[name], scene_of(case, done)
    prepare_s, register = timed(
        METHODS[name].prepare, scene, {**peer.settings, "least": peer.least[case.data]}
    )
    search_s, found = timed(register, scene)
    seconds = (done.model_s + prepare_s, done.match_s if peer.with_matches else None, search_s)
    return scored(case, name, done.model, found, seconds)


def run(case: Case, repeats: int, with_peers: bool) -> list[Row]:
    """Run ours and, if asked, the peers on one scan; print a line for each."""
    done = detect(case, repeats)
    ours = scored(case, OURS, done.model, done.found, (done.model_s, done.match_s, done.search_s))
    rows = [ours | {"version": ibi.__version__}]
    if with_peers:
        versions, missing = available(PEERS)
        rows += [run_peer(case, name, done) | {"version": version} for name, version in versions.items()]
        rows += [row(case, name, missing=reason) for name, reason in missing.items()]
    for one in rows:
        what = f"missing: {one['missing']}"
        if not one["missing"]:
            counts = f"{one['right']:>2} of {one['visible']:>2} right, {one['poses']:>2} poses"
            what = f"{counts}, {' + '.join(one[key] or '-' for key in SECONDS)} s"
        show(f"{' '.join((case.data, case.name, one['seed'])):32s} {one['method']:20s} {what}")
    return rows


def tune(cases: Sequence[Case], with_settings: bool) -> None:
    """Print how each peer does by the threshold of the check, with each of its settings or as it is set."""
    given = [(done.model, scene_of(case, done)) for case in cases for done in [detect(case)]]
    for name in available(PEERS)[0]:
        peer = PEERS[name]
        sweep = peer.sweep if with_settings else {}
        for values in itertools.product(*sweep.values()):
            settings = dict(zip(sweep, values, strict=True))
            scores: dict[float, list[metrics.SceneScore]] = {least: [] for least in LEAST}
            start = time.perf_counter()
            for case, (model, scene) in zip(cases, given, strict=True):
                register = METHODS[name].prepare(scene, peer.settings | settings | {"least": None})
                candidates = np.asarray(register(scene))
                # The check alone differs, so that the candidates are made once.
                radius = 1.5 * spacing(scene.src)
                for least in LEAST:
                    kept = keep_best(candidates, Claims(scene.src, scene.tgt, radius), least)
                    scores[least].append(score_visible(kept, case.poses, case.visibility, model.points)[0])
            print(f"{name}, {settings}, {time.perf_counter() - start:.0f} s")
            for least, of_least in scores.items():
                complete = [score for case, score in zip(cases, of_least, strict=True) if case.is_complete]
                reached = [f"{score.num_truth_hit}/{score.num_predicted}" for score in of_least]
                print(
                    f"  least {least}: MHF1 {metrics.mean_score(complete).mhf1:.3f} where all is labelled, "
                    f"right/poses {' '.join(reached)}",
                    flush=True,
                )


# Tables ---------------------------------------------------------------------------------------------------


def total(rows: Sequence[Row], key: str) -> str:
    """Sum of a column."""
    return str(sum(int(one[key]) for one in rows))


def means(rows: Sequence[Row]) -> list[str]:
    """Mean scores; empty where a scan has none."""
    by_key = {key: [float(one[key]) for one in rows if one[key]] for key in SCORES}
    return [f"{np.mean(of):.3f}" if len(of) == len(rows) else "" for of in by_key.values()]


def medians(rows: Sequence[Row]) -> list[str]:
    """Median seconds; a dash where there are none."""
    by_key = {key: [float(one[key]) for one in rows if one[key]] for key in SECONDS}
    return [f"{np.median(of):.2f}" if of else "-" for of in by_key.values()]


def groups(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Return the rows of each mean: shapes are told apart by their walls, never by their scores."""
    by_wall: dict[str, Callable[[float], bool]] = {
        "all": lambda width: True,
        f"walls from {THICK:g} voxels": lambda width: width >= THICK,
        "thinner": lambda width: width < THICK,
    }
    result = {name: [one for one in rows if wanted(float(one["wall"]))] for name, wanted in by_wall.items()}
    return {f"{name}, {len({one['name'] for one in of})} shapes": of for name, of in result.items() if of}


def by_name(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Return the rows of each shape or scan."""
    return {name: list(group) for name, group in itertools.groupby(rows, lambda one: one["name"])}


def shape_table(rows: Sequence[Row]) -> str:
    """Return the table of the piles by shape, ours alone, from what the record holds."""
    ours = [one for one in rows if one["data"] == "pile" and one["method"] == OURS]
    head = ("shape", "wall", "scans", "points", "visible", "poses", "right", "recall", "precision", "F1")

    def line(name: str, width: str, of: Sequence[Row]) -> list[object]:
        counts = [total(of, key) for key in ("visible", "poses", "right")]
        points = np.mean([float(one["points"]) for one in of])
        return [name, width, len(of), f"{points:.0f}", *counts, *means(of), *medians(of)]

    lines = [line(name, f"{float(of[0]['wall']):.1f}", of) for name, of in by_name(ours).items()]
    lines += [line(f"**{name}**", "", of) for name, of in groups(ours).items()]
    return tables.markdown((*head, "model s", "match s", "search s"), lines)


def peer_table(rows: Sequence[Row]) -> str:
    """Return the table of all methods on the same clouds, from what the record holds."""
    with_peers = {(one["data"], one["name"], one["seed"]) for one in rows if one["method"] in PEERS}
    rows = [one for one in rows if (one["data"], one["name"], one["seed"]) in with_peers]
    piles, scans = ([one for one in rows if one["data"] == data] for data in DATA)
    parts = {f"piles: {name}": of for name, of in groups(piles).items()} | by_name(scans)
    lines = []
    for name, of_part in parts.items():
        for method in (OURS, *PEERS):
            of = [one for one in of_part if one["method"] == method]
            done = [one for one in of if not one["missing"]]
            if not done:
                reason = of[0]["missing"] if of else "not run"
                lines.append(f"| {name} | {method} | missing: {reason} |{' |' * 7}")
                continue
            right = f"{total(done, 'right')} of {total(done, 'visible')}"
            cells = (name, method, right, total(done, "poses"), *means(done), *medians(done))
            lines.append(tables.line(cells))
            name = ""
    head = ("data", "method", "right", "poses", "recall", "precision", "F1", "model s", "match s", "search s")
    return "\n".join([tables.head(head), *lines])


def main() -> None:
    """Run, print, record."""
    args = cli.parse(
        __doc__,
        cli.HALF,
        cli.option("--seeds", type=int, default=3, help="piles of each shape"),
        cli.option("--peer-seeds", type=int, default=1, help="of these, with peers; PPF takes half a minute"),
        cli.option("--repeats", type=int, default=3, help="of ours, for the times"),
        cli.option("--shapes", nargs="+", help="some of the shapes, by file name without .ply"),
        cli.flag("--no-peers", "ours alone"),
        cli.option("--data", nargs="+", choices=DATA, default=DATA, help="the record keeps the other's rows"),
        cli.option("--tune", choices=DATA, help="try settings of the peers, and nothing else"),
        cli.flag("--docs", "write the record and the tables of docs/features.md"),
    )
    if args.tune == "pile":
        every_sixth = list(shapes().values())[::6]
        tune([pile(path, FIRST_SEED["tuning"]) for path in every_sixth], with_settings=True)
        return
    if args.tune == "scan":
        tune(list(real()), with_settings=False)
        return
    if unknown := set(args.shapes or ()) - set(shapes()):
        args.error(f"not among the shapes without symmetry: {', '.join(sorted(unknown))}")
    if args.docs and (args.shapes or args.no_peers or args.half != "reporting"):
        args.error("--docs is for all shapes of the reporting half, with the peers")
    rows = []
    for name, path in shapes().items() if "pile" in args.data else ():
        for i in range(args.seeds if name in (args.shapes or shapes()) else 0):
            with_peers = i < args.peer_seeds and not args.no_peers
            rows += run(pile(path, FIRST_SEED[args.half] + i), args.repeats, with_peers)
    for case in real() if "scan" in args.data else ():
        rows += run(case, args.repeats, not args.no_peers)
    if args.docs and len(args.data) == 1:
        kept = [one for one in records.read(records.RECORDS / RECORD) if one["data"] not in args.data]
        rows = sorted(kept + rows, key=lambda one: one["data"])  # piles first
    print(f"{CORES} cores\n\n{shape_table(rows)}\n\n{peer_table(rows)}")
    if args.docs:
        records.write(records.RECORDS, RECORD, rows, COLUMNS)
        records.fill(PAGE, {"piles": shape_table(rows), "piles-peers": peer_table(rows)})


if __name__ == "__main__":
    main()
