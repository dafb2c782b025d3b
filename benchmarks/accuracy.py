"""How accurate and how fast registration is on synthetic scenes: prints tables, records every scene.

    python benchmarks/accuracy.py                      # or: make tables
    python benchmarks/accuracy.py --half tuning --layout ecc-0.1 fpfh --scenes 5

The scenes are those of benchmarks/layouts.py. Parameters are tuned on its tuning half and never on its
reporting half, which the tables are made from.

Two families of scores, never to be compared with each other (see `ibi_rs.metrics`): one to one, below 20
degrees and 0.5 radii; any, below 15 degrees and 4 pr. Strict: one to one, below 5 degrees and 1 pr. Here pr
is the spacing of the model, the mean distance to the nearest other point. Symmetric shapes are scored in both
families by ADD-S below a tenth of the diameter. Where there is nothing to find, MHF1 one to one is the share
of scenes in which nothing was found.
"""

from __future__ import annotations

import argparse
import csv
import multiprocessing
import os
import platform
from collections.abc import Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import ibi_rs as ibi
import numpy as np
from ibi_rs import metrics, synth
from layouts import FIRST_SEED, LAYOUTS, NO_NORMALS, scene_of, seeds
from scipy.spatial import cKDTree

RECORDS = Path(__file__).parent / "records"

PRESETS = {
    "default": ibi.Params(),
    "paper_synthetic, t_he 3 pr": ibi.Params.paper_synthetic().replace(t_he_pr=3),
    "paper_synthetic": ibi.Params.paper_synthetic(),
    "paper_real": ibi.Params.paper_real(),
}


@dataclass(frozen=True)
class Result:
    """One registration, scored; `strict` is None for symmetric shapes."""

    layout: str
    half: str
    scene: str
    params: str
    num_correspondences: int
    inlier_share: float
    pr: float
    one_to_one: metrics.SceneScore
    any: metrics.SceneScore
    strict: metrics.SceneScore | None
    ms: float

    def errors(self) -> list[tuple[float, float]]:
        """Rotation error in degrees and translation error in pr of each hit, one to one."""
        hits = [match for match in self.one_to_one.matches if match is not None and match.is_hit]
        return [(hit.rotation_error_deg, hit.translation_error / self.pr) for hit in hits]

    def row(self) -> dict[str, Any]:
        """Return what the record holds."""
        return {
            "version": ibi.__version__,
            "layout": self.layout,
            "params": self.params,
            "half": self.half,
            "scene": self.scene,
            "K": self.one_to_one.num_truth,
            "M": self.num_correspondences,
            "inlier_share": f"{self.inlier_share:.4f}",
            "poses": self.one_to_one.num_predicted,
            **{key: f"{getattr(self.one_to_one, key):.4f}" for key in ("recall", "precision", "f1")},
            **{f"any_{key}": f"{getattr(self.any, key):.4f}" for key in ("recall", "precision", "f1")},
            "strict_f1": "" if self.strict is None else f"{self.strict.f1:.4f}",
            "ms": f"{self.ms:.0f}",
        }


def register(scene: synth.Scene, params: ibi.Params, num_threads: int | None = None) -> ibi.Registration:
    """Register a scene by its clouds, its correspondences and, where the layout has them, its normals."""
    return ibi.register(
        scene.src,
        scene.tgt,
        scene.corr,
        params,
        src_normals=scene.src_normals,
        tgt_normals=scene.tgt_normals,
        num_threads=num_threads,
    )


def score(
    scene: synth.Scene,
    found: ibi.Registration | np.ndarray,
    layout: str,
    half: str,
    params: str,
    ms: float | None = None,
) -> Result:
    """Score a registration, or the poses of another program and its time, in both families."""
    pr = float(np.mean(cKDTree(scene.src).query(scene.src, k=2)[0][:, 1]))
    in_family = partial(metrics.score_scene, found, scene.poses)
    strict = None
    if LAYOUTS[layout].shapes == "symmetric":
        in_family = partial(in_family, criterion=metrics.ADD_S, model=scene.src)
        one_to_one, free = in_family(matching="one_to_one"), in_family(matching="any")
    else:
        one_to_one = in_family(matching="one_to_one", criterion=metrics.ECC)
        free = in_family(matching="any", criterion=metrics.pointclm_voxels(pr))
        strict = in_family(matching="one_to_one", criterion=metrics.strict(pr))
    return Result(
        layout,
        half,
        scene.name,
        params,
        len(scene.corr),
        scene.inlier_ratio(),
        pr,
        one_to_one,
        free,
        strict,
        1e3 * found.timings.total_s if ms is None else ms,
    )


def run(
    layout: str,
    half: str,
    count: int | None = None,
    presets: Mapping[str, ibi.Params] | None = None,
    *,
    modelnet: Path | None = None,
    jobs: int = 1,
) -> list[Result]:
    """Register the scenes of a layout with each preset; every scene is made once.

    Parameters
    ----------
    layout : str
        One of `LAYOUTS`.
    half : {"tuning", "reporting"}
        Which shapes and seeds.
    count : int or None
        How many scenes at most; None: as many as the layout has.
    presets : mapping or None
        Parameters by name; None: `PRESETS` and those of the layout.
    modelnet : pathlib.Path or None
        As in `scenes`.
    jobs : int
        Processes. With more than one, each registration has one thread.

    Returns
    -------
    list of Result
        Preset by preset, each in the order of the scenes.
    """
    spec = LAYOUTS[layout]
    presets = {**PRESETS, **spec.presets} if presets is None else presets
    count = spec.num_scenes if count is None else min(count, spec.num_scenes)
    task = partial(_run_seed, layout, half, modelnet, dict(presets), 1 if jobs > 1 else None)
    todo = list(seeds(layout, half, count, modelnet))
    if jobs > 1:
        # Open3D's threads do not survive a fork.
        with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
            by_scene = list(pool.map(task, todo))
    else:
        by_scene = list(map(task, todo))
    return [results[i] for i in range(len(presets)) for results in by_scene]


def _run_seed(
    layout: str,
    half: str,
    modelnet: Path | None,
    presets: Mapping[str, ibi.Params],
    num_threads: int | None,
    seed: int,
) -> list[Result]:
    scene = scene_of(layout, half, seed, modelnet)
    return [
        score(scene, register(scene, params, num_threads), layout, half, name)
        for name, params in presets.items()
    ]


# Tables ---------------------------------------------------------------------------------------------------

HEAD = (
    f"{'':26s}  one to one            any                   strict  error of hits  poses  no    \n"
    f"{'params':26s}  MHR    MHP    MHF1   MHR    MHP    MHF1   MHF1    deg    pr     per K  pose     ms"
)


def print_table(results: Iterable[Result]) -> None:
    """Print one layout: a line per preset."""
    by_params: dict[str, list[Result]] = {}
    for result in results:
        by_params.setdefault(result.params, []).append(result)
    first = next(iter(by_params.values()))
    k, m, inliers = (
        np.mean(values)
        for values in zip(
            *((r.one_to_one.num_truth, r.num_correspondences, r.inlier_share) for r in first), strict=True
        )
    )
    head = f"{first[0].layout}, {first[0].half} half: {len(first)} scenes"
    print(f"\n{head}, K {k:.1f}, {m:.0f} correspondences, {inliers:.2%} inliers\n{HEAD}")
    for name, rows in by_params.items():
        cells = [name.ljust(26)]
        for family in ("one_to_one", "any"):
            mean = metrics.mean_score(getattr(r, family) for r in rows)
            cells += [f"{mean.mhr:.3f}", f"{mean.mhp:.3f}", f"{mean.mhf1:.3f}"]
        strict = [r.strict for r in rows if r.strict is not None]
        cells.append(f"{metrics.mean_score(strict).mhf1:.3f} " if strict else "  -   ")
        errors = [error for r in rows for error in r.errors()]
        measured = strict and errors  # the pose error of a symmetric shape means nothing
        cells += [f"{e:5.2f}" for e in np.median(errors, axis=0)] if measured else ["  -  ", "  -  "]
        poses = sum(r.one_to_one.num_predicted for r in rows)
        truths = sum(r.one_to_one.num_truth for r in rows)
        cells.append(f"{poses / truths:5.2f}" if truths else "  -  ")
        empty = sum(r.one_to_one.num_predicted == 0 for r in rows)
        cells += [f"{empty:2d}/{len(rows):2d}", f"{np.median([r.ms for r in rows]):5.0f}"]
        print("  ".join(cells), flush=True)


def write_record(path: Path, results: list[Result]) -> None:
    """Write one layout, a line per scene and preset."""
    with path.open("w", newline="", encoding="utf-8") as file:
        out = csv.DictWriter(file, list(results[0].row()), lineterminator="\n")
        out.writeheader()
        out.writerows(result.row() for result in results)


def main() -> None:
    """Run, print, record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = [*PRESETS, *NO_NORMALS]
    parser.add_argument("--half", choices=FIRST_SEED, default="reporting")
    parser.add_argument("--layout", nargs="+", choices=LAYOUTS, metavar="NAME", help=", ".join(LAYOUTS))
    parser.add_argument("--params", nargs="+", choices=names, metavar="NAME", help="; ".join(names))
    parser.add_argument("--scenes", type=int, help="at most so many scenes of each layout")
    parser.add_argument("--modelnet", type=Path, help="npz file: category/name -> (n, 3); adds its layouts")
    parser.add_argument("--jobs", type=int, default=1, help="processes; times are then those of one thread")
    parser.add_argument(
        "--out",
        type=Path,
        help="folder for the records; by default benchmarks/records, and none at all where --half, "
        "--params, --scenes or the data are not the default",
    )
    args = parser.parse_args()
    usual = args.half == "reporting" and args.params is None and args.scenes is None and args.jobs == 1
    chosen = args.layout or [n for n in LAYOUTS if args.modelnet or LAYOUTS[n].shapes != "modelnet"]
    if args.modelnet is None and any(LAYOUTS[name].shapes == "modelnet" for name in chosen):
        parser.error("ModelNet layouts need --modelnet")
    print(f"{os.cpu_count()} cores, {platform.machine()}, ibi_rs {ibi.__version__}")
    for layout in chosen:
        spec = LAYOUTS[layout]
        presets = {**PRESETS, **spec.presets}
        presets = {name: presets[name] for name in args.params or presets if name in presets}
        if not presets:
            continue
        results = run(layout, args.half, args.scenes, presets, modelnet=args.modelnet, jobs=args.jobs)
        print_table(results)
        folder = args.out or (RECORDS if usual and spec.shapes != "modelnet" else None)
        if folder:
            folder.mkdir(parents=True, exist_ok=True)
            write_record(folder / f"{layout}.csv", results)


if __name__ == "__main__":
    main()
