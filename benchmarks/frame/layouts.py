"""The scenes of the benchmarks: layouts as data, and the shapes and seeds of two halves.

The meshes of examples/models are sorted by name and split alternately into a tuning and a reporting half,
those without symmetry and the symmetric ones apart; the seeds of the halves differ too. Parameters are tuned
on the tuning half and never on the reporting half.

Scenes with a distractor that is a near-copy of the model (benchmarks/near_copies.py) are left out, and have a
layout of their own.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import islice
from pathlib import Path
from typing import Any

import ibi_rs as ibi
import numpy as np
from ibi_rs import synth

MODELS = Path(__file__).parents[2] / "examples/models"
FIRST_SEED = {"tuning": 0, "reporting": 5000}
SEEDS_PER_HALF = 5000
# Without normals as if none were given: the cosines of two angles never differ by more than 2.
NO_NORMALS = {"default, no normals": ibi.Params(min_normal_cos=None, scs=ibi.LocalGtm(normal_tolerance=2))}

Shapes = Mapping[str, tuple[np.ndarray, np.ndarray | None]]


@dataclass(frozen=True)
class Layout:
    """One kind of scene.

    Attributes
    ----------
    make : callable
        ``make(seed, shapes=shapes, **options)`` gives a scene.
    options : dict
        What distinguishes it from the layout's defaults.
    num_scenes : int
        How many make a row of the table.
    sketch : dict
        Further options that leave the choice of shapes as it is and make the rest cheap; empty where there
        are no distractors to look at.
    near_copies : bool
        Whether scenes with a near-copy of the model are those wanted, or those left out.
    shapes : {"plain", "symmetric", "modelnet"}
        Where the shapes come from.
    presets : dict
        Parameters that only this layout is run with, besides `PRESETS`.
    """

    make: Callable[..., synth.Scene]
    options: dict[str, Any] = field(default_factory=dict)
    num_scenes: int = 20
    sketch: dict[str, Any] = field(default_factory=dict)
    near_copies: bool = False
    shapes: str = "plain"
    presets: dict[str, ibi.Params] = field(default_factory=dict)


def outlier(seed: int, shapes: Shapes, **options: Any) -> synth.Scene:
    """Make an outlier layout of one of the shapes."""
    name = list(shapes)[seed % len(shapes)]
    scene = synth.outlier_layout(seed, shape=shapes[name][0], **options)
    return replace(scene, name=f"outlier-{seed:04d}-{name}")


ecc = partial(
    Layout,
    synth.ecc_layout,
    sketch={"num_points": 2, "num_clutter": 0, "descriptors": lambda points, normals: points},
)
fpfh = partial(
    Layout,
    synth.fpfh_layout,
    sketch={"num_points": 50, "num_clutter": 0, "num_key_points": 0, "num_clutter_key_points": 0},
    presets=NO_NORMALS,
)

LAYOUTS = {
    "ecc-0.02": ecc({"descriptor_noise": 0.02}, 40),
    "ecc-0.04": ecc({"descriptor_noise": 0.04}, 40),
    "ecc-0.1": ecc({"descriptor_noise": 0.1}, 40),
    "ecc-0.3": ecc({"descriptor_noise": 0.3}, 40),
    "ecc-near-copies": ecc(near_copies=True),
    "ecc-modelnet": ecc(shapes="modelnet"),
    "outlier-10-50": Layout(outlier, {"outlier_ratio": (0.1, 0.5)}),
    "outlier-50-70": Layout(outlier, {"outlier_ratio": (0.5, 0.7)}),
    "outlier-70-90": Layout(outlier, {"outlier_ratio": (0.7, 0.9)}),
    "outlier-90-99": Layout(outlier, {"outlier_ratio": (0.9, 0.99)}),
    # Of one size, for times: benchmarks/compare.py.
    "outlier-5000": Layout(
        outlier, {"num_instances": 20, "num_correspondences": 5000, "outlier_ratio": (0.7, 0.9)}, 10
    ),
    "outlier-inexact-70-90": Layout(outlier, {"outlier_ratio": (0.7, 0.9), "exact": False}),
    "outlier-inexact-90-99": Layout(outlier, {"outlier_ratio": (0.9, 0.99), "exact": False}),
    "starving": Layout(
        outlier,
        {
            "num_instances": (10, 20),
            "num_correspondences": 5000,
            "true_pairs": (6, 10),
            "jitter_pr": 0.25,
        },
    ),
    "fpfh": fpfh(),
    "fpfh-modelnet": fpfh(shapes="modelnet"),
    "none": ecc({"source_present": False}, 16),
    "none-noise": Layout(outlier, {"num_instances": 0}, 4),
    "symmetric": ecc(shapes="symmetric"),
}
"""Every layout by name. Those of ModelNet clouds need a file that is not part of the repository."""


def scenes(layout: str, half: str, count: int, modelnet: Path | None = None) -> Iterator[synth.Scene]:
    """Make the first scenes of a layout.

    Those of ModelNet need a file with its clouds: arrays (n, 3) named category/name.
    """
    for seed in seeds(layout, half, count, modelnet):
        yield scene_of(layout, half, seed, modelnet)


def scene_of(layout: str, half: str, seed: int, modelnet: Path | None = None) -> synth.Scene:
    """Make one scene."""
    spec = LAYOUTS[layout]
    return spec.make(seed, shapes=shapes(spec.shapes, half, modelnet), **spec.options)


def seeds(layout: str, half: str, count: int, modelnet: Path | None = None) -> Iterator[int]:
    """Seeds of the first scenes: those that have near-copies of the model as the layout wants it."""
    spec = LAYOUTS[layout]
    clouds, like = shapes(spec.shapes, half, modelnet), near_copies(spec.shapes, modelnet)

    def wanted(seed: int) -> bool:
        if not spec.sketch:
            return True
        sketch = spec.make(seed, shapes=clouds, **spec.options, **spec.sketch)
        model = sketch.name.split("-", 2)[2]
        return spec.near_copies == any(name in like[model] for name in sketch.distractors)

    return islice(filter(wanted, range(FIRST_SEED[half], FIRST_SEED[half] + SEEDS_PER_HALF)), count)


@cache
def shapes(kind: str, half: str, modelnet: Path | None = None) -> Shapes:
    """Dense clouds of one half of the shapes, by name; of ModelNet, of one half of the categories."""
    names = sorted(near_copies(kind, modelnet))
    groups = sorted({category(name) for name in names})
    mine = set(groups[list(FIRST_SEED).index(half) :: 2])
    names = [name for name in names if category(name) in mine]
    if kind == "modelnet":
        with np.load(modelnet) as clouds:
            return {name: (clouds[name].astype(np.float64), None) for name in names}
    return {name: synth.sample_mesh(MODELS / name, 10_000, np.random.default_rng(0)) for name in names}


@cache
def near_copies(kind: str, modelnet: Path | None = None) -> dict[str, set[str]]:
    """All shapes of a kind, and the near-copies of each: of ModelNet, the others of its category."""
    if kind == "modelnet":
        with np.load(modelnet) as clouds:
            names = list(clouds)
        return {
            name: {other for other in names if category(other) == category(name)} - {name} for name in names
        }
    return {e["file"]: set(e["like"]) for e in index() if e["symmetric"] == (kind == "symmetric")}


def index(folder: Path = MODELS) -> list[dict[str, Any]]:
    """Return what is known of the meshes of a folder."""
    entries: list[dict[str, Any]] = json.loads((folder / "index.json").read_text(encoding="utf-8"))
    return entries


def write_index(folder: Path, column: str, values: Mapping[str, Any]) -> None:
    """Note something of each mesh of a folder."""
    entries = [entry | {column: values[entry["file"]]} for entry in index(folder)]
    (folder / "index.json").write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")


def category(name: str) -> str:
    """Return what precedes the slash, or the name itself if there is none."""
    return name.partition("/")[0]
