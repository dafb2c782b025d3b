"""What each part of the default preset is worth: leaves out one at a time, prints a table, draws one scene.

    python benchmarks/ablation.py                      # or: make tables
    python benchmarks/ablation.py --half tuning --scenes 3

The scenes and the scores are those of benchmarks/accuracy.py, one to one. A cell holds MHF1, the number of
poses returned and of instances present, and the median time in ms. Where there is nothing to find, MHF1 is
the share of scenes in which nothing was found.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import accuracy
import ibi_rs as ibi
import numpy as np
from frame import cli, plots, records, runs
from frame.layouts import LAYOUTS, NO_NORMALS, scene_of
from frame.ours import register
from frame.runs import Outcome
from frame.tables import head, line, show
from ibi_rs import metrics, synth
from scipy.spatial import ConvexHull

DEFAULT = ibi.Params()
VARIANTS = {
    "default": DEFAULT,
    "no second order": DEFAULT.replace(scs=ibi.LocalGtm(second_order=False)),
    # The joint check shares out the scene points and so relies on claims.
    "no exclusive claims": DEFAULT.replace(hv=ibi.Evidence(exclusive=False), joint_check=False),
    "dense removal": DEFAULT.replace(removal="dense"),
    "no joint check": DEFAULT.replace(joint_check=False),
    "no refinement": DEFAULT.replace(refine="none"),
    "no contest": DEFAULT.replace(n_contest=1),
    "overlap 0.7, no evidence": DEFAULT.replace(hv=ibi.Overlap(t_overlap=0.7, exclusive=True)),
}
NORMALS = {"no normals": NO_NORMALS["default, no normals"]}
ABLATED = ("ecc-0.1", "outlier-inexact-90-99", "fpfh", "symmetric", "none")
PICTURED = ("ecc-0.3", 5014)
"""The layout and the seed of the picture: a scene on which most variants differ."""


def variants(layout: str) -> dict[str, ibi.Params]:
    """Return the variants that differ on a layout."""
    return VARIANTS | NORMALS if LAYOUTS[layout].presets is NO_NORMALS else VARIANTS


# Table ----------------------------------------------------------------------------------------------------


def cell(outcomes: Sequence[Outcome]) -> str:
    """Sum up one variant on one layout."""
    if not outcomes:
        return "–"
    poses, truths = runs.num_poses(outcomes), runs.num_truths(outcomes)
    return f"{runs.mean(outcomes).mhf1:.3f} · {poses}/{truths} · {runs.median_ms(outcomes):.0f}"


# Picture --------------------------------------------------------------------------------------------------

SCENE, RIGHT, WRONG, MISSED = "0.8", "tab:blue", "tab:red", "black"


def view(poses: np.ndarray) -> np.ndarray:
    """Return the projection onto a plane, (3, 2), on which the instances lie farthest apart."""
    centers = poses[:, :3, 3]
    rotations = np.linalg.qr(np.random.default_rng(0).normal(size=(500, 3, 3)))[0]

    def gap(plane: np.ndarray) -> float:
        flat = centers @ plane
        apart = np.linalg.norm(flat[:, None] - flat, axis=2)
        return float(np.min(apart[np.triu_indices(len(flat), 1)]))

    planes: list[np.ndarray] = [rotation[:, :2] for rotation in rotations]
    return max(planes, key=gap)


def draw(scene: synth.Scene, found: dict[str, ibi.Registration], path: Path) -> None:
    """Draw the scene once for each variant: right poses, wrong ones, missed instances."""
    columns = 4
    rows = -(-len(found) // columns)
    size = (3.5 * columns, 3.9 * rows + 0.4)
    figure, panels = plots.panels(size, columns, rows, count=len(found))
    plane = view(scene.poses)
    # All instances and poses, and a margin: the clutter goes on beyond.
    middles = np.vstack([scene.poses, *(np.asarray(registration) for registration in found.values())])
    flat = middles[:, :3, 3] @ plane
    limits = flat.min(axis=0) - 1.2, flat.max(axis=0) + 1.2
    for axes, (name, registration) in zip(panels, found.items(), strict=True):
        draw_one(axes, scene, registration, plane)
        axes.set(xlim=(limits[0][0], limits[1][0]), ylim=(limits[0][1], limits[1][1]))
        score = metrics.score_scene(registration, scene.poses)
        right, wrong = score.num_predicted_hit, score.num_predicted - score.num_predicted_hit
        missed = score.num_truth - score.num_truth_hit
        axes.set_title(f"{name}\n{right} right, {wrong} wrong, {missed} missed")
    handles = panels[0].get_legend_handles_labels()[0]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    plots.save(figure, path, 90)
    print(f"\npicture: {path.name}, {scene.name}")


def draw_one(axes: Any, scene: synth.Scene, found: ibi.Registration, plane: np.ndarray) -> None:
    """Draw one result."""
    score = metrics.score_scene(found, scene.poses)
    hits = [match is not None and match.is_hit for match in score.matches]
    reached = {match.truth for match in score.matches if match is not None and match.is_hit}
    poses = np.asarray(found)

    def put(poses: Any, colour: str, label: str, style: dict[str, Any], fill: bool) -> None:
        for pose in poses:
            flat = (scene.src @ pose[:3, :3].T + pose[:3, 3]) @ plane
            if fill:
                axes.scatter(*flat.T, s=0.6, color=colour, linewidths=0, zorder=2)
            hull = flat[ConvexHull(flat).vertices]
            axes.fill(*hull.T, fill=False, edgecolor=colour, zorder=3, **style)
        axes.plot([], [], color=colour, label=label, **style)

    flat = scene.tgt @ plane
    axes.scatter(*flat.T, s=1.2, color=SCENE, linewidths=0, zorder=1)
    axes.plot([], [], "o", color=SCENE, label="scene")
    put(poses[np.flatnonzero(hits)], RIGHT, "right pose", {"linewidth": 1.2}, True)
    put(poses[np.flatnonzero(np.logical_not(hits))], WRONG, "wrong pose", {"linewidth": 1.8}, True)
    missed = [pose for k, pose in enumerate(scene.poses) if k not in reached]
    put(missed, MISSED, "missed instance", {"linewidth": 1.5, "linestyle": "--"}, False)
    axes.set_aspect("equal")
    axes.set_axis_off()


def main() -> None:
    """Run, print, record, draw."""
    seed = cli.option("--seed", type=int, default=PICTURED[1], help="of the scene in the picture")
    args = cli.parse(__doc__, cli.HALF, cli.scenes(10), cli.JOBS, seed, cli.out())
    cli.machine(f"{args.half} half", f"{args.scenes} scenes a layout")
    results = {
        layout: accuracy.run(layout, args.half, args.scenes, variants(layout), jobs=args.jobs)
        for layout in ABLATED
    }
    print("\nMHF1 · poses returned / instances present · median ms\n")
    show(head(["", *results]))
    for name in VARIANTS | NORMALS:
        show(line([name, *(cell(of_layout.get(name, ())) for of_layout in results.values())]))
    if args.records:
        rows = [runs.rows(of, "params", layout=name, half=args.half) for name, of in results.items()]
        records.write(args.records, "ablation.csv", [*chain(*rows)], accuracy.COLUMNS)
        scene = scene_of(PICTURED[0], args.half, args.seed)
        found = {name: register(scene, params) for name, params in variants(PICTURED[0]).items()}
        draw(scene, found, args.pictures / "ablation.png")


if __name__ == "__main__":
    main()
