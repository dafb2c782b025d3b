"""How accurate and how fast registration is on synthetic scenes: prints tables, records every scene.

    python benchmarks/accuracy.py                      # or: make tables
    python benchmarks/accuracy.py --half tuning --layout ecc-0.1 fpfh --scenes 5

The scenes are those of benchmarks/frame/layouts.py. Parameters are tuned on its tuning half and never on its
reporting half, which the tables are made from.

Scores are told in benchmarks/frame/runs.py. Milliseconds are those of the whole call.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import ibi_rs as ibi
import numpy as np
from frame import cli, ours, records, runs
from frame.layouts import LAYOUTS, NO_NORMALS, scene_of, seeds
from frame.runs import Outcome
from frame.tables import show

PRESETS = {
    "default": ibi.Params(),
    "paper_synthetic, t_he 3 pr": ibi.Params.paper_synthetic().replace(t_he_pr=3),
    "paper_synthetic": ibi.Params.paper_synthetic(),
    "paper_real": ibi.Params.paper_real(),
}
COLUMNS = (
    *("version", "layout", "params", "half", "scene", "K", "M", "inlier_share", "poses"),
    *("recall", "precision", "f1", "any_recall", "any_precision", "any_f1", "strict_f1", "ms"),
)


def run(
    layout: str,
    half: str,
    count: int | None,
    presets: Mapping[str, ibi.Params],
    *,
    modelnet: Path | None = None,
    jobs: int = 1,
) -> dict[str, list[Outcome]]:
    """Register the scenes of a layout, at most as many as it has, with each of the presets.

    With several processes, each registration has one thread.
    """
    spec, threads = LAYOUTS[layout], 1 if jobs > 1 else None
    todo = seeds(layout, half, min(count or spec.num_scenes, spec.num_scenes), modelnet)
    methods = {name: partial(ours.prepare, params=of, num_threads=threads) for name, of in presets.items()}
    make = partial(scene_of, layout, half, modelnet=modelnet)
    return runs.run_each(make, todo, methods, spec.shapes == "symmetric", jobs)


HEAD = (
    f"{'':26s}  one to one            any                   strict  error of hits  poses  no    \n"
    f"{'params':26s}  MHR    MHP    MHF1   MHR    MHP    MHF1   MHF1    deg    pr     per K  pose     ms"
)


def print_table(layout: str, half: str, outcomes: Mapping[str, Sequence[Outcome]]) -> None:
    """Print one layout: a line per preset."""
    first = next(iter(outcomes.values()))
    facts = [(o.one_to_one.num_truth, o.num_correspondences, o.inlier_share) for o in first]
    k, m, inliers = np.mean(facts, axis=0)
    head = f"{layout}, {half} half: {len(first)} scenes"
    print(f"\n{head}, K {k:.1f}, {m:.0f} correspondences, {inliers:.2%} inliers\n{HEAD}")
    for name, of in outcomes.items():
        cells = [name.ljust(26)]
        for family in ("one_to_one", "any"):
            mean = runs.mean(of, family)
            cells += [f"{mean.mhr:.3f}", f"{mean.mhp:.3f}", f"{mean.mhf1:.3f}"]
        is_strict = of[0].strict is not None
        cells.append(f"{runs.mean(of, 'strict').mhf1:.3f} " if is_strict else "  -   ")
        errors = [error for o in of for error in o.errors()]
        measured = is_strict and errors  # the pose error of a symmetric shape means nothing
        cells += [f"{e:5.2f}" for e in np.median(errors, axis=0)] if measured else ["  -  ", "  -  "]
        truths = runs.num_truths(of)
        cells.append(f"{runs.num_poses(of) / truths:5.2f}" if truths else "  -  ")
        empty = sum(runs.num_poses([o]) == 0 for o in of)
        show("  ".join([*cells, f"{empty:2d}/{len(of):2d}", f"{runs.median_ms(of):5.0f}"]))


def main() -> None:
    """Run, print, record."""
    params = cli.several("--params", [*PRESETS, *NO_NORMALS])
    options = (cli.HALF, cli.LAYOUT, params, cli.scenes(None, "at most so many of each layout"))
    args = cli.parse(__doc__, *options, cli.MODELNET, cli.JOBS, cli.out("layout", "modelnet"))
    chosen = cli.layouts(args, LAYOUTS)
    cli.machine()
    for layout in chosen:
        presets = {**PRESETS, **LAYOUTS[layout].presets}
        presets = {name: presets[name] for name in args.params or presets if name in presets}
        if not presets:
            continue
        outcomes = run(layout, args.half, args.scenes, presets, modelnet=args.modelnet, jobs=args.jobs)
        print_table(layout, args.half, outcomes)
        # Not everybody has the clouds of ModelNet.
        folder = args.records if args.out or LAYOUTS[layout].shapes != "modelnet" else None
        rows = runs.rows(outcomes, "params", layout=layout, half=args.half)
        records.write(folder, f"{layout}.csv", rows, COLUMNS)


if __name__ == "__main__":
    main()
