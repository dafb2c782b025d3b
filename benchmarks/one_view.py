"""Whether the score of a pose in a scan is the probability that it is right: prints a table.

    IBI_DATA=FOLDER python benchmarks/one_view.py         # also: without IBI_DATA, of what is shipped
    IBI_DATA=FOLDER python benchmarks/one_view.py --fit   # the weights anew

`Model.detect` runs with a threshold near 0, so that it returns poses of all scores: on the piles of
benchmarks/piles.py, tuning half, on the real scans whose labels are complete, and on real scans of another
part, where every pose is wrong. A pose is right by ADD-S below a tenth of the diameter, one to one.

With --fit a logistic regression over these poses gives the weights of 1 and of the closeness that
crates/ibi-core/src/evidence/support.rs has for scenes seen from one side; that of the evidence is kept small.
Poses of another part make 7 % of all there.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise, product

import ibi_rs as ibi
import numpy as np
from calibration import Judged, judged, logistic
from frame import cli
from frame.layouts import FIRST_SEED
from frame.scans import Case, pile, real
from frame.tables import markdown
from ibi_rs import metrics
from piles import shapes

PARAMS = ibi.Params.single_view().replace(hv=ibi.Evidence(t_score=0.02, t_sure=1.0))
BINS = (0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 1)
KINDS = ("piles", "scans", "another part")
EVIDENCE_WEIGHT = 0.05
OTHER_SHARE = 0.07
"""How often somebody looks for a part that is not there, as --fit has it."""


def judge(data: str, model: ibi.Model, case: Case) -> Iterator[Judged]:
    """Detect the parts of a scan and judge every pose; all that are of another part are wrong."""
    found = model.detect(case.points, PARAMS, viewpoint=[0, 0, 0])
    poses = case.poses[:0] if data == "another part" else case.poses
    score = metrics.score_scene(found, poses, criterion=metrics.ADD_S, model=model.points)
    return judged(data, case.name, found, score)


def judge_all(num_seeds: int) -> Iterator[Judged]:
    """Judge piles, real scans, real scans of another part."""
    first = FIRST_SEED["tuning"]
    for path, seed in product(shapes().values(), range(first, first + num_seeds)):
        case = pile(path, seed)
        yield from judge("piles", ibi.Model.from_mesh(*case.mesh), case)
    scans = list(real())
    parts = {case.mesh[0].tobytes(): ibi.Model.from_mesh(*case.mesh) for case in scans}
    for case, (part, model) in product(scans, parts.items()):
        if part != case.mesh[0].tobytes():
            yield from judge("another part", model, case)
        elif case.is_complete:
            yield from judge("scans", model, case)


def fit(poses: list[Judged]) -> str:
    """Return the weights of 1, of the evidence and so on, beside what they are fitted to."""
    closeness = np.array([[pose.closeness] for pose in poses])
    offset = EVIDENCE_WEIGHT * np.log1p([pose.evidence for pose in poses])
    is_right = np.array([pose.is_right for pose in poses])
    is_other = np.array([pose.layout == "another part" for pose in poses])
    share = np.where(is_other, OTHER_SHARE / is_other.sum(), (1 - OTHER_SHARE) / (~is_other).sum())
    beta = logistic(closeness, is_right, share, ridge=0, offset=offset)
    return f"[{beta[0]:.1f}, {EVIDENCE_WEIGHT}, {beta[1]:.1f}, 0.0] from {len(poses)} poses"


def main() -> None:
    """Run and print."""
    seeds = cli.option("--seeds", type=int, default=2, help="piles of each shape")
    args = cli.parse(__doc__, seeds, cli.flag("--fit", "print the weights"))
    poses = list(judge_all(args.seeds))
    if args.fit:
        print(fit(poses))
    lines = []
    for low, high in pairwise(BINS):
        within = [pose for pose in poses if low <= pose.score < high or pose.score == high == 1]
        by_kind = [[pose.is_right for pose in within if pose.layout == kind] for kind in KINDS]
        share = f"{np.mean([pose.is_right for pose in within]):.2f}" if within else "-"
        lines.append([f"{low} to {high}", *(f"{sum(of)} of {len(of)}" for of in by_kind), share])
    print(markdown(("score", *KINDS, "right of all"), lines))


if __name__ == "__main__":
    main()
