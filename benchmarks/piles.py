"""Detection in ray-cast piles, and other programs on the same clouds: prints tables, records every scene.

    python benchmarks/piles.py                   # the meshes of examples/models, the shipped scans
    IBI_DATA=FOLDER python benchmarks/piles.py   # FOLDER/models/*.ply, all labelled scans
    IBI_DATA=FOLDER python benchmarks/piles.py --docs
    python benchmarks/piles.py --data pile --half tuning --shapes cat koala --no-peers
    python benchmarks/piles.py --tune pile

A pile is `ibi_rs.synth.pile_scene` as it is by default: ten instances of one mesh on a table, seen by one
camera. Shapes are all meshes of the folder but the symmetric ones, which benchmarks/symmetry.py tells: there
some turn by more than 20 degrees leaves less than 0.03 radii of deviation. Seeds are those of the reporting
half of benchmarks/layouts.py; whoever tunes takes ``--half tuning``.

Scores are one to one by ADD-S below a tenth of the diameter, over the instances that show at least 30 % of
what they would show alone. A pose that is right for an instance that shows less is neither right nor wrong.

The peers get what `Model.correspond` gives ours: the thinned scan without its table, with normals; PCL the
correspondences, too. They run once on the first seeds of each shape, and on the real scans of
benchmarks/scans.py. Seconds are wall clock: of the model (from its mesh; for PPF its training, too), of the
correspondences, and of the search for poses. Ours are medians of `--repeats`.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
import os
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import ibi_rs as ibi
import numpy as np
import numpy.typing as npt
from detect import folders
from ibi_rs import features, metrics, synth
from layouts import FIRST_SEED, MODELS
from numpy.typing import NDArray
from peers import Missing, opencv_ppf, pcl
from peers.contract import CORES, model_spacing
from peers.overlap import Claims, keep_best
from scans import SCANS, labels
from symmetry import THRESHOLD, deviation

ROOT = Path(__file__).parents[1]
RECORD = ROOT / "benchmarks/records/piles.csv"
PAGE = ROOT / "docs/features.md"

VISIBLE = 0.3
"""An instance that shows a smaller share of what it would show alone is not asked for."""
THICK = 2.0
"""Walls of less, in voxels, are thin: the two sides of one lie in each other's neighbourhood."""
OURS = "ibi"
DATA = ("pile", "scan")


@dataclass(frozen=True)
class Peer:
    """Another program: its settings, and the values they were chosen from.

    `least` is the threshold of the overlap check on piles and on scans, the rest is what the adapter takes.
    """

    module: ModuleType
    settings: dict[str, Any]
    least: dict[str, float]
    sweep: dict[str, list[Any]]
    with_matches: bool


LEAST = [0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4]
"""Tried for both: from one side at most half of a model is seen."""
PEERS = {
    "PCL GC + check": Peer(
        pcl,
        {"method": "gc", "size_pr": 1.5, "threshold": 4, "refit": True},
        {"pile": 0.3, "scan": 0.15},
        {"size_pr": [1.0, 1.5, 2.0], "threshold": [3, 4, 6, 8]},
        with_matches=True,
    ),
    "OpenCV PPF + check": Peer(
        opencv_ppf,
        {"model_step": 0.03, "scene_step": 0.01, "every": 5, "neighbors": 12, "candidates": 400},
        {"pile": 0.3, "scan": 0.2},
        {"model_step": [0.03, 0.05], "scene_step": [0.01, 0.02], "every": [2, 5]},
        with_matches=False,
    ),
}


@dataclass(frozen=True)
class Case:
    """A scan with its truth.

    Attributes
    ----------
    data : {"pile", "scan"}
    name : str
        The shape's or the scan's.
    seed : int or None
    mesh : (V, 3) float64 and (F, 3) int64
    points : (N, 3) float64
        As scanned, camera at the origin.
    poses : (K, 4, 4) float64
    visibility : (K,) float64
        All 1 in scans, whose labels are of parts in sight.
    is_complete : bool
        Whether all parts are labelled: precision means nothing elsewhere.
    """

    data: str
    name: str
    seed: int | None
    mesh: tuple[NDArray[np.float64], NDArray[np.int64]]
    points: NDArray[np.float64]
    poses: NDArray[np.float64]
    visibility: NDArray[np.float64]
    is_complete: bool = True


# Data -----------------------------------------------------------------------------------------------------


@cache
def shapes(folder: Path) -> dict[str, Path]:
    """Meshes of a folder that are not symmetric, by name.

    The index of the shipped meshes says which are; one that is not in it is measured.
    """
    index = json.loads((MODELS / "index.json").read_text(encoding="utf-8"))
    known = {entry["file"]: entry["symmetric"] for entry in index}

    def is_symmetric(path: Path) -> bool:
        if path.name in known:
            return bool(known[path.name])
        points, _ = synth.sample_mesh(path, 3400, np.random.default_rng(0))
        return deviation(points)[0] < THRESHOLD

    return {path.stem: path for path in sorted(folder.glob("*.ply")) if not is_symmetric(path)}


def wall(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> float:
    """Median way through the part, inwards from a point of its outer surface to the next face, in voxels."""
    import open3d as o3d

    voxel = np.linalg.norm(np.ptp(vertices[np.unique(faces)], axis=0)) / 24
    points, normals = features.sample_mesh(vertices, faces, n=4000)
    outer = features.outer_surface(points, normals, vertices, faces)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
    )
    rays = np.hstack([points - 1e-3 * voxel * normals, -normals])[outer].astype(np.float32)
    return float(np.median(scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()) / voxel)


def pile(path: Path, seed: int) -> Case:
    """Make a pile of one mesh."""
    mesh = ibi.io.read_mesh(path)
    made = synth.pile_scene(*mesh, seed=seed)
    return Case("pile", path.stem, seed, mesh, made.points, made.poses, made.visibility)


def real(root: Path | None) -> Iterator[Case]:
    """Read the real scans that can be had."""
    for name, folder in folders(root).items():
        mesh = ibi.io.read_mesh(folder / SCANS[name].mesh)
        points, _ = ibi.io.read_cloud(folder / f"{SCANS[name].file or name}.ply")
        poses = labels(folder, name)
        yield Case("scan", name, None, mesh, points, poses, np.ones(len(poses)), SCANS[name].is_complete)


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


def row(
    case: Case,
    method: str,
    model: ibi.Model,
    found: npt.ArrayLike,
    seconds: Sequence[float | None],
    version: str,
) -> dict[str, str]:
    """Return what the record holds of one method on one scan."""
    score, ignored = score_visible(found, case.poses, case.visibility, model.points)
    numbers = {"recall": score.recall}
    if case.is_complete:
        numbers |= {"precision": score.precision, "f1": score.f1}
    return {
        **_head(case, method),
        "points": str(len(case.points)),
        "model_points": str(len(model)),
        "visible": str(score.num_truth),
        "poses": str(score.num_predicted),
        "right": str(score.num_truth_hit),
        "ignored": str(ignored),
        **{key: f"{numbers[key]:.4f}" if key in numbers else "" for key in ("recall", "precision", "f1")},
        **{
            key: "" if value is None else f"{value:.4f}"
            for key, value in zip(("model_s", "match_s", "search_s"), seconds, strict=True)
        },
        "version": version,
        "missing": "",
    }


def missing_row(case: Case, method: str, reason: str) -> dict[str, str]:
    """Return the row of a peer that cannot run."""
    keys = ("points", "model_points", "visible", "poses", "right", "ignored", "recall", "precision", "f1")
    seconds = ("model_s", "match_s", "search_s", "version")
    return {**_head(case, method), **dict.fromkeys((*keys, *seconds), ""), "missing": reason}


def _head(case: Case, method: str) -> dict[str, str]:
    seed = "" if case.seed is None else str(case.seed)
    width = f"{_wall(case.name, case.mesh):.2f}" if case.data == "pile" else ""
    return {"data": case.data, "name": case.name, "seed": seed, "wall": width, "method": method}


_WALLS: dict[str, float] = {}


def _wall(name: str, mesh: tuple[NDArray[np.float64], NDArray[np.int64]]) -> float:
    if name not in _WALLS:
        _WALLS[name] = wall(*mesh)
    return _WALLS[name]


# Runs -----------------------------------------------------------------------------------------------------


def run_ours(case: Case, repeats: int) -> tuple[dict[str, str], ibi.Model, synth.Scene, tuple[float, float]]:
    """Detect; also return the model, what peers are given, and the seconds of the model and of the match."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        model = ibi.Model.from_mesh(*case.mesh)
        made = time.perf_counter()
        matches = model.correspond(case.points, viewpoint=[0, 0, 0])
        matched = time.perf_counter()
        found = model.detect(case.points, viewpoint=[0, 0, 0])
        detected = time.perf_counter()
        # `detect` matches once more.
        times.append((made - start, matched - made, detected - 2 * matched + made))
    of_model, of_match, of_search = (float(value) for value in np.median(times, axis=0))
    scene = synth.Scene(
        model.points,
        matches.tgt,
        matches.corr,
        case.poses,
        case.name,
        similarity=matches.similarity,
        src_normals=model.normals,
        tgt_normals=matches.tgt_normals,
    )
    seconds = (of_model, of_match, max(of_search, 0.0))
    return row(case, OURS, model, found, seconds, ibi.__version__), model, scene, seconds[:2]


def run_peer(
    case: Case, name: str, version: str, model: ibi.Model, scene: synth.Scene, shared_s: tuple[float, float]
) -> dict[str, str]:
    """Run a peer once on what `run_ours` gave."""
    peer = PEERS[name]
    start = time.perf_counter()
    register = peer.module.prepare(scene, **peer.settings, least=peer.least[case.data])
    prepared = time.perf_counter()
    found = register(scene)
    done = time.perf_counter()
    of_match = shared_s[1] if peer.with_matches else None
    seconds = (shared_s[0] + prepared - start, of_match, done - prepared)
    return row(case, name, model, found, seconds, version)


def versions() -> tuple[dict[str, str], dict[str, str]]:
    """Versions of the peers that can run, and why the others cannot."""
    found, missing = {}, {}
    for name, peer in PEERS.items():
        try:
            found[name] = peer.module.version()
        except Missing as reason:
            missing[name] = str(reason)
    return found, missing


def run(case: Case, repeats: int, with_peers: bool) -> list[dict[str, str]]:
    """Run ours and, if asked, the peers on one scan; print a line for each."""
    ours, model, scene, shared_s = run_ours(case, repeats)
    rows = [ours]
    if with_peers:
        available, missing = versions()
        rows += [run_peer(case, name, found, model, scene, shared_s) for name, found in available.items()]
        rows += [missing_row(case, name, reason) for name, reason in missing.items()]
    for one in rows:
        where = f"{case.data} {case.name} {one['seed']}"
        if one["missing"]:
            print(f"{where:32s} {one['method']:20s} missing: {one['missing']}", flush=True)
            continue
        counts = f"{one['right']:>2} of {one['visible']:>2} right, {one['poses']:>2} poses"
        spent = " + ".join(one[key] or "-" for key in ("model_s", "match_s", "search_s"))
        print(f"{where:32s} {one['method']:20s} {counts}, {spent} s", flush=True)
    return rows


def tune(cases: Sequence[Case], with_settings: bool) -> None:
    """Print how each peer does by the threshold of the check, with each of its settings or as it is set."""
    prepared = [run_ours(case, 1)[1:3] for case in cases]
    for name in versions()[0]:
        peer = PEERS[name]
        sweep = peer.sweep if with_settings else {}
        for values in itertools.product(*sweep.values()):
            settings = dict(zip(sweep, values, strict=True))
            scores: dict[float, list[metrics.SceneScore]] = {least: [] for least in LEAST}
            start = time.perf_counter()
            for case, (model, scene) in zip(cases, prepared, strict=True):
                candidates = peer.module.prepare(scene, **peer.settings | settings, least=None)(scene)
                # The check alone differs, so that the candidates are made once.
                radius = 1.5 * model_spacing(scene.src)
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

Row = dict[str, str]


def mean(rows: Sequence[Row], key: str) -> float:
    """Mean of a column."""
    return float(np.mean([float(one[key]) for one in rows]))


def total(rows: Sequence[Row], key: str) -> int:
    """Sum of a column."""
    return sum(int(one[key]) for one in rows)


def median(rows: Sequence[Row], key: str) -> str:
    """Median of a column of seconds; a dash if it is empty."""
    values = [float(one[key]) for one in rows if one[key]]
    return f"{np.median(values):.2f}" if values else "-"


def shape_table(rows: Sequence[Row]) -> str:
    """Return the table of the piles by shape, ours alone, from what the record holds."""
    ours = [one for one in rows if one["data"] == "pile" and one["method"] == OURS]
    lines = [
        "| shape | wall | scans | points | visible | poses | right | recall | precision | F1 | model s "
        "| match s | search s |",
        f"|{'---|' * 13}",
    ]

    def line(name: str, width: str, chosen: Sequence[Row]) -> str:
        counts = [str(total(chosen, key)) for key in ("visible", "poses", "right")]
        scores = [f"{mean(chosen, key):.3f}" for key in ("recall", "precision", "f1")]
        seconds = [median(chosen, key) for key in ("model_s", "match_s", "search_s")]
        points = f"{mean(chosen, 'points'):.0f}"
        return f"| {' | '.join([name, width, str(len(chosen)), points, *counts, *scores, *seconds])} |"

    by_name = {name: list(group) for name, group in itertools.groupby(ours, lambda one: one["name"])}
    lines += [line(name, f"{float(group[0]['wall']):.1f}", group) for name, group in by_name.items()]
    lines += [line(f"**{name}**", "", chosen) for name, chosen in groups(ours).items() if chosen]
    return "\n".join(lines)


def groups(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Return the rows of each mean: shapes are told apart by their walls, never by their scores."""
    by_wall: dict[str, Callable[[float], bool]] = {
        "all": lambda width: True,
        f"walls from {THICK:g} voxels": lambda width: width >= THICK,
        "thinner": lambda width: width < THICK,
    }
    result = {name: [one for one in rows if wanted(float(one["wall"]))] for name, wanted in by_wall.items()}
    return {
        f"{name}, {len({one['name'] for one in chosen})} shapes": chosen for name, chosen in result.items()
    }


def peer_table(rows: Sequence[Row]) -> str:
    """Return the table of all methods on the same clouds, from what the record holds."""
    by_peers = {(one["data"], one["name"], one["seed"]) for one in rows if one["method"] in PEERS}
    rows = [one for one in rows if (one["data"], one["name"], one["seed"]) in by_peers]
    piles, scans = ([one for one in rows if one["data"] == data] for data in ("pile", "scan"))
    lines = [
        "| data | method | right | poses | recall | precision | F1 | model s | match s | search s |",
        f"|{'---|' * 10}",
    ]
    parts = {f"piles: {name}": chosen for name, chosen in groups(piles).items() if chosen}
    parts |= {name: list(group) for name, group in itertools.groupby(scans, lambda one: one["name"])}
    for name, chosen in parts.items():
        for method in (OURS, *PEERS):
            of_method = [one for one in chosen if one["method"] == method]
            done = [one for one in of_method if not one["missing"]]
            if not done:
                reason = of_method[0]["missing"] if of_method else "not run"
                lines.append(f"| {name} | {method} | missing: {reason} |{' |' * 7}")
                continue
            scores = [
                f"{mean(done, key):.3f}" if all(one[key] for one in done) else ""
                for key in ("recall", "precision", "f1")
            ]
            cells = [
                f"{total(done, 'right')} of {total(done, 'visible')}",
                str(total(done, "poses")),
                *scores,
            ]
            cells += [median(done, key) for key in ("model_s", "match_s", "search_s")]
            lines.append(f"| {name} | {method} | {' | '.join(cells)} |")
            name = ""
    return "\n".join(lines)


def read() -> list[Row]:
    """Read the record."""
    with RECORD.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write(rows: Sequence[Row]) -> None:
    """Write the record, and the tables of the page."""
    with RECORD.open("w", newline="", encoding="utf-8") as file:
        out = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        out.writeheader()
        out.writerows(rows)
    page = PAGE.read_text(encoding="utf-8")
    for name, table in (("piles", shape_table(rows)), ("piles-peers", peer_table(rows))):
        text = f"<!-- {name} -->\n{table}\n<!-- end -->"
        page = re.sub(rf"<!-- {name} -->.*?<!-- end -->", lambda _, text=text: text, page, flags=re.DOTALL)
    PAGE.write_text(page, encoding="utf-8")


def main() -> None:
    """Run, print, record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--half", choices=list(FIRST_SEED), default="reporting", help="which seeds")
    parser.add_argument("--seeds", type=int, default=3, help="piles of each shape")
    parser.add_argument(
        "--peer-seeds", type=int, default=1, help="of these, with peers; PPF takes half a minute"
    )
    parser.add_argument("--repeats", type=int, default=3, help="of ours, for the times")
    parser.add_argument("--shapes", nargs="+", help="some of the shapes, by file name without .ply")
    parser.add_argument("--no-peers", action="store_true", help="ours alone")
    parser.add_argument(
        "--data", nargs="+", choices=DATA, default=DATA, help="the record keeps the rows of the other"
    )
    parser.add_argument("--tune", choices=DATA, help="try settings of the peers, and nothing else")
    parser.add_argument(
        "--docs", action="store_true", help="write the record and the tables of docs/features.md"
    )
    arguments = parser.parse_args()
    root = Path(os.environ["IBI_DATA"]) if "IBI_DATA" in os.environ else None
    folder = root / "models" if root else MODELS
    if arguments.tune == "pile":
        every_sixth = list(shapes(folder).values())[::6]
        tune([pile(path, FIRST_SEED["tuning"]) for path in every_sixth], with_settings=True)
        return
    if arguments.tune == "scan":
        tune(list(real(root)), with_settings=False)
        return
    chosen = shapes(folder)
    if unknown := set(arguments.shapes or ()) - set(chosen):
        parser.error(f"not among the shapes without symmetry: {', '.join(sorted(unknown))}")
    if arguments.docs and (arguments.shapes or arguments.no_peers or arguments.half != "reporting"):
        parser.error("--docs is for all shapes of the reporting half, with the peers")
    rows = []
    for name, path in chosen.items() if "pile" in arguments.data else ():
        if arguments.shapes and name not in arguments.shapes:
            continue
        for i in range(arguments.seeds):
            with_peers = i < arguments.peer_seeds and not arguments.no_peers
            rows += run(pile(path, FIRST_SEED[arguments.half] + i), arguments.repeats, with_peers)
    for case in real(root) if "scan" in arguments.data else ():
        rows += run(case, arguments.repeats, not arguments.no_peers)
    if arguments.docs and len(arguments.data) == 1:
        kept = [one for one in read() if one["data"] not in arguments.data]
        rows = sorted(kept + rows, key=lambda one: one["data"])  # piles first
    print(f"{CORES} cores\n\n{shape_table(rows)}\n\n{peer_table(rows)}")
    if arguments.docs:
        write(rows)


if __name__ == "__main__":
    main()
