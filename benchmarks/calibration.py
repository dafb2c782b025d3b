"""Whether the score of a pose is the probability that it is right: prints a table, draws the curve.

    python benchmarks/calibration.py                   # or: make tables
    python benchmarks/calibration.py --fit             # the weights anew, from the tuning half

The default preset runs with a threshold near 0, so that it returns poses of all scores, on every layout of
benchmarks/frame/layouts.py whose shapes have neither symmetries nor near-copies. A pose is right if it is a
hit one to one, below 20 degrees and 0.5 radii. Wrong poses above 0.9 are listed, each with what it is.

With --fit nothing is drawn: a logistic regression over the poses of the tuning half gives the weights that
crates/ibi-core/src/evidence/support.rs turns evidence, closeness and back_fit into log odds with. Each layout
weighs the same; scenes of which each object has lost 30 to 60 % of its points to a plane are among them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import cycle, pairwise
from pathlib import Path

import ibi_rs as ibi
import numpy as np
from frame import cli, plots, records
from frame.layouts import FIRST_SEED, LAYOUTS, scenes
from frame.ours import register
from frame.tables import markdown, show
from matplotlib.ticker import PercentFormatter
from scipy.spatial import cKDTree

PARAMS = ibi.Params(hv=ibi.Evidence(t_score=0.01))
PLAIN = [name for name, spec in LAYOUTS.items() if spec.shapes == "plain" and not spec.near_copies]
BINS = (0, 0.1, 0.5, 0.7, 0.9, 0.99, 1)
NUM_CLUTTER = 1000  # of every layout, at the end of its target
RIDGE = 1e-3  # keeps the weights finite where a layout can be separated without a mistake


@dataclass(frozen=True)
class Judged:
    """One pose, and what it is."""

    layout: str
    scene: str
    score: float
    evidence: float
    closeness: float
    back_fit: float
    what: str

    @property
    def is_right(self) -> bool:
        """Whether it is a hit, one to one."""
        return self.what == "right"


def judged(
    layout: str,
    scene: str,
    found: ibi.Registration,
    score: ibi.metrics.SceneScore,
    mistake: Callable[[ibi.Pose], str] = lambda pose: "wrong",
) -> Iterator[Judged]:
    """Judge every pose by what it was scored."""
    for pose, match in zip(found, score.matches, strict=True):
        what = "right" if match is not None and match.is_hit else mistake(pose)
        yield Judged(layout, scene, pose.score, pose.evidence, pose.closeness, pose.back_fit, what)


def judge(layout: str, scenes: Iterable[ibi.synth.Scene]) -> Iterator[Judged]:
    """Register scenes and judge every pose."""
    for scene in scenes:
        found = register(scene, PARAMS)
        score = ibi.metrics.score_scene(found, scene.poses)
        yield from judged(layout, scene.name, found, score, partial(mistake, scene, found.resolution))


def mistake(scene: ibi.synth.Scene, pr: float, pose: ibi.Pose) -> str:
    """Say what a wrong pose is."""
    matrix, middle = pose.target_from_source, np.append(scene.src.mean(axis=0), 1)
    if len(scene.poses):
        apart = np.linalg.norm((scene.poses @ middle - matrix @ middle)[:, :3], axis=1)
        nearest = int(np.argmin(apart))
        truth = scene.poses[nearest]
        angle = ibi.metrics.rotation_error_deg(matrix, truth)
        if apart[nearest] < 0.5 and angle < 20:
            return f"instance {nearest} a second time"
        if apart[nearest] < 1:
            gap = ibi.metrics.add_s(scene.src, matrix, truth) / ibi.metrics.diameter(scene.src)
            return f"instance {nearest} turned by {angle:.0f} deg, ADD-S {gap:.3f} diameters"
    moved = scene.src @ matrix[:3, :3].T + matrix[:3, 3]
    rows = np.flatnonzero(np.isfinite(cKDTree(moved).query(scene.tgt, distance_upper_bound=1.5 * pr)[0]))
    clutter = np.mean(rows >= len(scene.tgt) - NUM_CLUTTER) if len(rows) else 1.0
    return "clutter" if clutter > 0.5 else f"a distractor, of {', '.join(scene.distractors)}"


# Calibration ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Bin:
    """The poses of a range of scores."""

    name: str
    num: int
    mean_score: float
    share_right: float

    def interval(self) -> tuple[float, float]:
        """Where the true share lies with 95 % confidence (Wilson 1927)."""
        z, n, share = 1.96, self.num, self.share_right
        middle = (share + z**2 / (2 * n)) / (1 + z**2 / n)
        half = z / (1 + z**2 / n) * np.sqrt(share * (1 - share) / n + z**2 / (4 * n**2))
        return middle - half, middle + half


def summary(name: str, poses: list[Judged]) -> Bin:
    """Sum up poses, at least one."""
    return Bin(
        name,
        len(poses),
        float(np.mean([pose.score for pose in poses])),
        float(np.mean([pose.is_right for pose in poses])),
    )


def by_score(poses: list[Judged]) -> list[Bin]:
    """Sum up poses by their score; empty bins are left out."""
    groups = {
        f"{low:g}-{high:g}": [pose for pose in poses if low < pose.score <= high]
        for low, high in pairwise(BINS)
    }
    return [summary(name, group) for name, group in groups.items() if group]


def print_bins(title: str, bins: list[Bin]) -> None:
    """Print a table as Markdown."""
    lines = [(b.name, b.num, f"{b.mean_score:.3f}", f"{b.share_right:.3f}") for b in bins]
    show(f"\n{markdown((title, 'poses', 'mean score', 'share right'), lines)}")


def draw(bins: list[Bin], path: Path) -> None:
    """Draw the share of right poses over the score."""
    figure, (axes,) = plots.panels((6, 5.4), 1)
    axes.plot([0, 1], [0, 1], color="0.6", linestyle="--", zorder=1, label="perfectly calibrated")
    x, y = [b.mean_score for b in bins], [b.share_right for b in bins]
    low, high = np.transpose([b.interval() for b in bins])
    errors = [np.maximum(y - low, 0), np.maximum(high - y, 0)]
    axes.errorbar(x, y, errors, marker="o", capsize=3, zorder=2, label="measured, with 95 % interval")
    for b, offset in zip(bins, cycle([(6, -14), (6, 7)]), strict=False):
        axes.annotate(str(b.num), (b.mean_score, b.share_right), offset, textcoords="offset points")
    axes.set(xlabel="score", ylabel="share of poses that are right", xlim=(-0.05, 1.1), ylim=(-0.06, 1.09))
    axes.xaxis.set_major_formatter(PercentFormatter(1))
    axes.yaxis.set_major_formatter(PercentFormatter(1))
    axes.set_aspect("equal")
    axes.grid(color="0.9")
    axes.legend(loc="lower right", title="numbers: poses in the bin")
    plots.save(figure, path, 100)


def calibrate(half: str, count: int) -> list[Judged]:
    """Print the tables; return the poses."""
    poses = [pose for name in PLAIN for pose in judge(name, scenes(name, half, count))]
    by_layout = [(name, [p for p in poses if p.layout == name]) for name in PLAIN]
    bins = by_score(poses)
    print_bins("score", bins)
    print_bins("layout", [summary(name, group) for name, group in by_layout if group])
    off = sum(b.num * abs(b.mean_score - b.share_right) for b in bins) / max(len(poses), 1)
    print(f"\nscore and share differ by {off:.3f} on average, weighed by poses")

    sure = sorted((p for p in poses if p.score > 0.9 and not p.is_right), key=lambda p: -p.score)
    print(f"\nwrong poses above 0.9: {len(sure)} of {sum(p.score > 0.9 for p in poses)}")
    for p in sure:
        measured = f"evidence {p.evidence:.1f}, closeness {p.closeness:.2f}, back_fit {p.back_fit:.2f}"
        print(f"{p.score:.3f}  {p.layout:22s} {p.scene:34s} {measured}: {p.what}")
    return poses


# Fit ------------------------------------------------------------------------------------------------------


def cut(scene: ibi.synth.Scene, seed: int, num_points: int = 256) -> ibi.synth.Scene:
    """Cut 30 to 60 % of the points off each object of an ECC layout, by a plane in a random direction."""
    rng = np.random.default_rng(seed)
    keep = np.ones(len(scene.tgt), bool)
    for first in range(0, len(scene.tgt) - NUM_CLUTTER, num_points):
        rows = slice(first, first + num_points)
        depth = scene.tgt[rows] @ rng.normal(size=3)
        keep[rows] = depth >= np.quantile(depth, rng.uniform(0.3, 0.6))
    corr = scene.corr[keep[scene.corr[:, 1]]]
    corr[:, 1] = (np.cumsum(keep) - 1)[corr[:, 1]]
    return replace(scene, tgt=scene.tgt[keep], corr=corr, similarity=None)


def logistic(
    features: np.ndarray,
    is_right: np.ndarray,
    weight: np.ndarray,
    ridge: float = RIDGE,
    offset: np.ndarray | float = 0,
) -> np.ndarray:
    """Weights of a constant and the features, by Newton's method; the offset is added to their sum."""
    x = np.column_stack([np.ones(len(features)), features])
    hold = ridge * np.diag([0.0, *np.var(features, axis=0)])
    beta = np.zeros(x.shape[1])
    for _ in range(100):
        p = 1 / (1 + np.exp(-x @ beta - offset))
        gradient = x.T @ (weight * (is_right - p)) - hold @ beta
        hessian = (x.T * (weight * p * (1 - p))) @ x + hold
        step = np.linalg.solve(hessian, gradient)
        beta += step * min(1.0, 5.0 / np.abs(step).max())
        if np.abs(step).max() < 1e-8:
            break
    return beta


def fit(half: str, count: int) -> None:
    """Fit the weights and print them beside what they are fitted to."""
    chosen = [name for name in PLAIN if name != "ecc-0.3"]
    sources: dict[str, Iterable[ibi.synth.Scene]] = {name: scenes(name, half, count) for name in chosen}
    for name in ("ecc-0.02", "ecc-0.1"):
        sources[f"{name}, cut"] = map(cut, scenes(name, half, count), range(count))
    poses = [pose for name, of_name in sources.items() for pose in judge(name, of_name)]
    by_layout = {name: [p for p in poses if p.layout == name] for name in sources}
    print_bins("layout", [summary(name, group) for name, group in by_layout.items() if group])

    num_layouts = sum(bool(group) for group in by_layout.values())
    weight = np.array([1 / (num_layouts * len(by_layout[p.layout])) for p in poses])
    is_right = np.array([p.is_right for p in poses])
    features = np.array([[np.log1p(p.evidence), p.closeness, p.back_fit] for p in poses])
    beta = logistic(features, is_right, weight)

    def loss(score: np.ndarray) -> float:
        score = np.clip(score, 1e-9, 1 - 1e-9)
        return float(-np.sum(weight * np.log(np.where(is_right, score, 1 - score))))

    fitted = 1 / (1 + np.exp(-beta[0] - features @ beta[1:]))
    print(f"\n{len(poses)} poses, {is_right.sum()} right")
    print("weights of 1, ln(1 + evidence), closeness, back_fit:", [round(float(b), 2) for b in beta])
    print(
        f"log loss: {loss(np.array([p.score for p in poses])):.4f} of the scores, {loss(fitted):.4f} fitted"
    )


def main() -> None:
    """Run, print, record, draw; or fit."""
    args = cli.parse(
        __doc__,
        cli.flag("--fit", "fit the weights to the tuning half instead"),
        cli.option("--half", choices=FIRST_SEED, help="default: reporting; with --fit tuning"),
        cli.scenes(None, "so many of each layout; default: 6, with --fit 10"),
        cli.out(),
    )
    half = args.half or ("tuning" if args.fit else "reporting")
    count = args.scenes or (10 if args.fit else 6)
    cli.machine(f"{half} half", f"at most {count} scenes a layout", str(PARAMS.hv))
    if args.fit:
        fit(half, count)
        return
    poses = calibrate(half, count)
    if args.records:
        columns = [
            {key: round(v, 4) if isinstance(v, float) else v for key, v in asdict(pose).items()}
            for pose in poses
        ]
        records.write(args.records, "calibration.csv", columns)
        draw(by_score(poses), args.pictures / "calibration.png")


if __name__ == "__main__":
    main()
