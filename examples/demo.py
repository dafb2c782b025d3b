"""Finds the parts in three real depth scans, prints their poses and draws them.

    make demo                             # or: python examples/demo.py --scene tee6 --normals unsigned

The scans and the models are shipped beside this file (Apache-2.0, see the README in each folder). The
correspondences are real descriptor matches, 4 to 9 % of them right, made once by make_matches.py. Each scan
is of one view: at most half of a part can be seen, so the preset `single_view` counts overlap over the model
points that face the camera, and asks for 0.35 of them. With normals whose sign means nothing, or without any,
it cannot tell which points those are: the overlap is over the whole model then, and 0.2 of it is asked for.
What a pose is turned by against its label is what is left modulo the symmetries found on the model: half a
turn of the tee.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import ibi_rs as ibi
import numpy as np
from ibi_rs import metrics, plot

HERE = Path(__file__).parent
SCENES = {"tee6": "tee/tee6.npz", "two": "provete2/two.npz", "multi": "provete2/multi.npz"}
WHOLE = ibi.Overlap(t_overlap=0.2, exclusive=True)
PARAMS = {
    "oriented": ibi.Params.single_view(),
    "unsigned": ibi.Params.single_view().replace(oriented_normals=False, hv=WHOLE),
    "none": ibi.Params.single_view().replace(hv=WHOLE),
}


def main() -> None:
    """Run the scenes asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", choices=SCENES, help="default: all, one after the other")
    parser.add_argument(
        "--normals", choices=PARAMS, default="oriented", help="what is known of them; default: oriented"
    )
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder of the pictures; default: out")
    arguments = parser.parse_args()
    for scene in [arguments.scene] if arguments.scene else SCENES:
        show(scene, arguments.normals, arguments.out)


def show(scene: str, normals: str, out: Path) -> None:
    """Register one scene, print the poses beside the labels, draw."""
    data = np.load(HERE / SCENES[scene])
    src, tgt, corr = data["src"], data["tgt"], data["corr"]
    given = {} if normals == "none" else {name: data[name] for name in ("src_normals", "tgt_normals")}
    found = ibi.register(src, tgt, corr, PARAMS[normals], viewpoint=data["viewpoint"], **given)

    symmetries = ibi.find_symmetries(src, data["src_normals"])
    labelled = data["poses"].astype(np.float64)
    print(f"{scene}: {len(src)} model points, {len(tgt)} scene points, {len(corr)} correspondences,")
    print(f"{len(labelled)} parts with a label; lengths in mm; the model has {symmetries}")
    print()
    print("pose  score  overlap  inliers     x     y     z   nearest label  distance  turned by")
    reached = set()
    for k, pose in enumerate(found):
        # ADD-S: mean distance from the model at the label to the model at the pose, blind to symmetry.
        distances = [metrics.add_s(src, pose.target_from_source, truth) for truth in labelled]
        label = int(np.argmin(distances))
        turned = metrics.rotation_error_deg(pose.target_from_source, labelled[label], symmetries=symmetries)
        is_hit = distances[label] < metrics.ADD_S.diameter_fraction * metrics.diameter(src)
        if is_hit:
            reached.add(label)
        x, y, z = pose.target_from_source[:3, 3] * 1e3
        print(
            f"{k:4d}  {pose.score:5.2f}  {pose.overlap:7.2f}  {pose.num_inliers:7d}"
            f"  {x:4.0f}  {y:4.0f}  {z:4.0f}  {label if is_hit else '-':>14}"
            f"  {distances[label] * 1e3:8.1f}  {turned:5.0f} deg"
        )
    print()
    seconds = found.timings.total_s
    print(f"{len(found)} parts in {seconds:.2f} s; stopped by {found.stop_reason};")
    print(f"{len(reached)} of {len(labelled)} labels reached (ADD-S below 0.1 diameters)")

    out.mkdir(parents=True, exist_ok=True)
    picture = out / f"{scene}.png"
    plot.instances(tgt, src, found, picture, title=f"{scene}: {len(found)} parts found")
    print(f"picture: {picture}")
    print()


if __name__ == "__main__":
    main()
