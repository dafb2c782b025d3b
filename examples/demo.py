"""Finds the parts in a real Kinect scan, prints their poses and draws them.

    make demo                             # or: python examples/demo.py --scene two

The scan and the model are shipped beside this file (Apache-2.0, see the README in each folder). The
correspondences are real descriptor matches, about 6 % of them right, made once by make_matches.py. The scan is of
one view: at most half of a part can be seen, so the preset `single_view` counts overlap over the model points that
face the camera, and asks for 0.35 of them.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import ibi_rs as ibi
import numpy as np
from ibi_rs import metrics, plot

HERE = Path(__file__).parent
SCENES = {"multi": "provete2/multi.npz", "two": "provete2/two.npz", "tee6": "tee/tee6.npz"}


def main() -> None:
    """Register, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", choices=SCENES, default="multi", help="default: multi")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder of the picture; default: out")
    arguments = parser.parse_args()

    data = np.load(HERE / SCENES[arguments.scene])
    src, tgt, corr = data["src"], data["tgt"], data["corr"]
    found = ibi.register(
        src,
        tgt,
        corr,
        ibi.Params.single_view(),
        src_normals=data["src_normals"],
        tgt_normals=data["tgt_normals"],
        viewpoint=data["viewpoint"],
    )

    labelled = data["poses"].astype(np.float64)
    print(f"{arguments.scene}: {len(src)} model points, {len(tgt)} scene points, {len(corr)} correspondences,")
    print(f"{len(labelled)} labelled parts (not every part has a label), lengths in mm")
    print()
    print("pose  score  overlap  inliers   x     y     z    nearest label  distance")
    diameter = metrics.diameter(src)
    reached = set()
    for k, pose in enumerate(found):
        # ADD-S: mean distance of the model at the one pose to the model at the other, blind to symmetry.
        distances = [metrics.add_s(src, pose.target_from_source, truth) for truth in labelled]
        nearest = int(np.argmin(distances))
        hit = distances[nearest] < 0.1 * diameter
        if hit:
            reached.add(nearest)
        x, y, z = pose.target_from_source[:3, 3] * 1e3
        verdict = f"{nearest:8d}       {distances[nearest] * 1e3:5.1f}" if hit else "       -           -"
        print(
            f"{k:4d}  {pose.score:5.2f}  {pose.overlap:7.2f}  {pose.num_inliers:7d}"
            f"  {x:4.0f}  {y:4.0f}  {z:4.0f}  {verdict}"
        )
    print()
    print(f"{len(found)} parts in {found.timings.total_s:.2f} s, {len(reached)} of {len(labelled)} labels found")
    print(f"stopped by {found.stop_reason}")

    arguments.out.mkdir(parents=True, exist_ok=True)
    picture = arguments.out / f"{arguments.scene}.png"
    plot.instances(tgt, src, found, picture, title=f"{arguments.scene}: {len(found)} parts found")
    print(f"picture: {picture}")


if __name__ == "__main__":
    main()
