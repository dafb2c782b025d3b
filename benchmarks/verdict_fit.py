"""Fit the weights of a close look, `SHARP`, `COARSE`, `FUSED` of odds.rs, to the tuning half of verdict.py.

IBI_DATA=... python benchmarks/verdict_fit.py

Each search gives the poses on which it was decided: those returned and those rejected. Right are those that
are one to one with a truth. Others near the same truth are left out, and so are poses that are nearly right,
and models of nearly the right size: neither answer would be wrong. A scan of one camera is sharp or coarse;
where it is blurred other weights hold, which are not fitted here. What other poses add to a coarse one
(`COMPANY`) is not among the terms.
"""

from collections.abc import Iterator

import ibi_rs as ibi
import numpy as np
from frame import cli, tables
from frame.tables import show
from scipy.optimize import minimize
from verdict_metrics import HIDDEN, RIGHT, RIGHT_BELOW
from verdict_searches import ROWS, Models, Search

TERMS = (
    "1",
    "contradicted",
    "runs on",
    "beyond",
    "second loss",
    "third loss",
    "closeness",
    "supported",
    "ends",
    "evidence",
)
SHARP, COARSE, SHARP_EDGES = 0.1, 0.13, 0.44
"""As in odds.rs: up to which blur a scan is sharp and from which it is coarse, and from which sharpness on
its edges are sharp."""
NEARLY = 0.7 * RIGHT_BELOW, 1.4 * RIGHT_BELOW
REGIMES = ("boxes", "scans", "bins", "rows", "piles", "rooms", "mirror", "sizes", "absent")
POWER = {"SHARP": 0.5, "COARSE": 0.2, "FUSED": 0.2}
"""A class of n poses in a regime weighs n to 1 minus this. In rooms nothing may be invented, and in coarse
scans company brings back what is lost."""
SIGNS = [(None, None), *[(None, 0)] * 3, *[(0, None)] * 6]
"""What speaks against a pose may not speak for it."""


def terms(of: ibi.Measures) -> list[float]:
    """Return what `Measures::log_odds` weighs in a sharp scan."""
    known = of.supported + of.contradicted + of.buried
    ends = of.runs_on + of.ends
    held = np.sqrt(np.clip(of.losses, 0, 1))
    return [
        1.0,
        min(of.contradicted / (known + 20), 0.1),
        (of.runs_on - 0.5 * ends) / (ends + 15),
        min(of.beyond / (of.on + 20), 0.2),
        held[1],
        held[2],
        float(np.clip(of.closeness, -0.5, 1.1)),
        of.supported / (known + of.hidden + 20),
        float(np.log1p(of.ends)),
        float(np.log1p(of.evidence)),
    ]


def kind(search: Search, of: ibi.Measures) -> str | None:
    """Return which weights hold for a scan, if one set does; what was fused from many views has normals."""
    if "tgt_normals" in search.scan.told:
        return "FUSED"
    if of.blur < SHARP:
        return "SHARP"
    return "COARSE" if of.blur > COARSE and (of.edges or 0) > SHARP_EDGES else None


def decided(search: Search, models: Models) -> Iterator[tuple[str, list[float], bool]]:
    """Search, and return the weights that hold for each pose, its terms, and whether it is right."""
    model, symmetries = models.of(search)
    found = model.detect(search.scan.points, **search.scan.told)
    all_ = [*found, *found.rejected]
    poses = np.array([pose.target_from_source for pose in all_]).reshape(-1, 4, 4)
    judgement = search.judge(poses, model, symmetries)
    for pose, state, distance in zip(all_, judgement.states, judgement.distances, strict=True):
        is_right = state in (RIGHT, HIDDEN)
        is_other = distance < RIGHT_BELOW and not is_right
        is_nearly = search.scale == 1 and NEARLY[0] < distance < NEARLY[1]
        weights = kind(search, pose.measures) if pose.measures else None
        if weights and not is_other and not is_nearly:
            yield weights, terms(pose.measures), is_right


def main() -> None:
    """Collect, fit, print."""
    args = cli.parse(__doc__, cli.flag("--quick", "one or two scenes of each kind"))
    models = Models()
    rows: dict[str, list[tuple[str, list[float], bool]]] = {weights: [] for weights in POWER}
    for regime in REGIMES:
        for search in ROWS[regime]("tuning", args.quick):
            is_nearly_size = search.scale != 1 and 0.85 < search.scale < 1.15
            if search.scan.half == "tuning" and not is_nearly_size:
                for weights, *pose in decided(search, models):
                    rows[weights].append((regime, *pose))
    for weights, poses in rows.items():
        show(f"\n{weights}, {len(poses)} poses")
        fit(poses, POWER[weights])


def fit(rows: list[tuple[str, list[float], bool]], power: float) -> None:
    """Fit and print the weights of poses: regime, terms, whether it is right."""
    if len({right for _, _, right in rows}) < 2:
        show("none of them right, or all: no fit")
        return
    of, right = np.array([row[1] for row in rows]), np.array([row[2] for row in rows], dtype=float)
    regimes = np.array([row[0] for row in rows])
    weight = np.zeros(len(rows))
    for regime in set(regimes):
        for answer in (0, 1):
            of_class = (regimes == regime) & (right == answer)
            weight[of_class] = of_class.sum() ** -power if of_class.any() else 0.0
    spread = np.r_[1.0, of[:, 1:].std(axis=0)]

    def loss(b: np.ndarray) -> float:
        odds = of / spread @ b
        return float(
            np.average(np.logaddexp(0, odds) - right * odds, weights=weight) + 1.5e-3 * b[1:] @ b[1:]
        )

    weights = minimize(loss, np.zeros(len(TERMS)), method="L-BFGS-B", bounds=SIGNS).x / spread
    show(tables.markdown(TERMS, [[f"{w:.2f}" for w in weights]]))
    accepted = of @ weights > 0
    lines = []
    for regime in dict.fromkeys(row[0] for row in rows):
        ours = regimes == regime
        hits = int((accepted & ours & (right > 0)).sum())
        lines.append(
            (regime, f"{hits} of {int(accepted[ours].sum())}", f"{hits} of {int(right[ours].sum())}")
        )
    show(tables.markdown(("regime", "right of accepted", "accepted of right"), lines))


if __name__ == "__main__":
    main()
