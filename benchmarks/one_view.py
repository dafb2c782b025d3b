"""Whether the score of a pose in a scan is the probability that it is right: prints a table.

    IBI_DATA=FOLDER python benchmarks/one_view.py         # also: without IBI_DATA, of what is shipped
    IBI_DATA=FOLDER python benchmarks/one_view.py --fit   # the weights anew

`Model.detect` runs with a threshold near 0, so that it returns poses of all scores: on the piles of
benchmarks/piles.py, tuning half, on the real scans whose labels are complete, and on real scans of another
part, where every pose is wrong. A pose is right by ADD-S below a tenth of the diameter, one to one.

With --fit a logistic regression over these poses gives the weights of 1 and of the closeness that
crates/ibi-core/src/kernels/evidence.rs has for scenes seen from one side; that of the evidence is kept small.
Poses of another part make 7 % of all there.
"""

from __future__ import annotations

import argparse
import itertools
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import ibi_rs as ibi
import numpy as np
from ibi_rs import metrics
from layouts import FIRST_SEED, MODELS
from numpy.typing import NDArray
from piles import pile, real, shapes
from scipy.optimize import minimize

PARAMS = ibi.Params.single_view().replace(hv=ibi.Evidence(t_score=0.02, t_sure=1.0))
BINS = (0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 1)
EVIDENCE_WEIGHT = 0.05
OTHER_SHARE = 0.07
"""How often somebody looks for a part that is not there, as --fit has it."""


@dataclass(frozen=True)
class Judged:
    """One pose, and whether it is right."""

    data: str
    score: float
    evidence: float
    closeness: float
    is_right: bool


def judge(data: str, model: ibi.Model, scan: NDArray[np.float64], poses: NDArray[np.float64]) -> list[Judged]:
    """Detect the parts of a scan and judge every pose; without true poses all are wrong."""
    found = model.detect(scan, PARAMS, viewpoint=[0, 0, 0])
    score = metrics.score_scene(found, poses, criterion=metrics.ADD_S, model=model.points)
    hits = [match is not None and match.is_hit for match in score.matches]
    return [
        Judged(data, pose.score, pose.evidence, pose.closeness, hit)
        for pose, hit in zip(found, hits, strict=True)
    ]


def cases(num_seeds: int) -> Iterator[Judged]:
    """Piles, real scans, real scans of another part."""
    root = Path(os.environ["IBI_DATA"]) if "IBI_DATA" in os.environ else None
    for path in shapes(root / "models" if root else MODELS).values():
        for seed in range(FIRST_SEED["tuning"], FIRST_SEED["tuning"] + num_seeds):
            case = pile(path, seed)
            yield from judge("piles", ibi.Model.from_mesh(*case.mesh), case.points, case.poses)
    scans = list(real(root))
    parts = {case.mesh[0].tobytes(): ibi.Model.from_mesh(*case.mesh) for case in scans}
    for case, (part, model) in itertools.product(scans, parts.items()):
        if part != case.mesh[0].tobytes():
            yield from judge("another part", model, case.points, np.empty((0, 4, 4)))
        elif case.is_complete:
            yield from judge("scans", model, case.points, case.poses)


def fit(poses: list[Judged]) -> NDArray[np.float64]:
    """Weights of 1 and of the closeness."""
    features = np.array([(1.0, pose.closeness) for pose in poses])
    offset = EVIDENCE_WEIGHT * np.log1p([pose.evidence for pose in poses])
    sign = np.array([1.0 if pose.is_right else -1.0 for pose in poses])

    is_other = np.array([pose.data == "another part" for pose in poses])
    counts = np.where(is_other, OTHER_SHARE / is_other.sum(), (1 - OTHER_SHARE) / (~is_other).sum())

    def loss(weights: NDArray[np.float64]) -> float:
        return float(counts @ np.logaddexp(0, -sign * (features @ weights + offset)))

    return np.asarray(minimize(loss, np.zeros(2)).x)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=2, help="piles of each shape")
    parser.add_argument("--fit", action="store_true", help="print the weights")
    arguments = parser.parse_args()
    poses = list(cases(arguments.seeds))
    if arguments.fit:
        constant, closeness = fit(poses)
        print(f"[{constant:.1f}, {EVIDENCE_WEIGHT}, {closeness:.1f}, 0.0] from {len(poses)} poses")
    kinds = ("piles", "scans", "another part")
    print(f"| score | {' | '.join(kinds)} | right of all |\n|{'---|' * (len(kinds) + 2)}")
    for low, high in itertools.pairwise(BINS):
        within = [pose for pose in poses if low <= pose.score < high or pose.score == high == 1]
        cells = []
        for kind in kinds:
            of_kind = [pose for pose in within if pose.data == kind]
            cells.append(f"{sum(pose.is_right for pose in of_kind)} of {len(of_kind)}")
        share = f"{np.mean([pose.is_right for pose in within]):.2f}" if within else "-"
        print(f"| {low} to {high} | {' | '.join(cells)} | {share} |")


if __name__ == "__main__":
    main()
