"""Methods on scenes: in turn and timed, in one process or several, and scored.

Scores are those of `ibi_rs.metrics`, in two families that are never to be compared with each other. One to
one: below 20 degrees and 0.5 radii. Any: below 15 degrees and 4 pr. Strict: one to one, below 5 degrees and
1 pr. Here pr is the spacing of the model, the mean distance to the nearest other point. What is symmetric is
scored in both families by ADD-S below a tenth of the diameter. Where there is nothing to find, MHF1 one to
one is the share of scenes in which nothing was found.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

import ibi_rs as ibi
import numpy as np
import numpy.typing as npt
from ibi_rs import metrics, synth
from scipy.spatial import cKDTree

from .timing import timed

Key = TypeVar("Key")
Answer = TypeVar("Answer")

Register = Callable[[synth.Scene], npt.ArrayLike]
"""Gives the poses found in a scene, (K, 4, 4), best first. On the clock."""
Prepare = Callable[[synth.Scene], Register]
"""Does what belongs to the model alone, once. Not on the clock."""


@dataclass
class Outcome:
    """One method on one scene; `strict` is None of symmetric shapes, `seconds` has one of each repeat."""

    scene: str
    num_correspondences: int
    inlier_share: float
    pr: float
    one_to_one: metrics.SceneScore
    any: metrics.SceneScore
    strict: metrics.SceneScore | None
    seconds: list[float] = field(default_factory=list)

    @property
    def median_s(self) -> float:
        """Median of the repeats."""
        return float(np.median(self.seconds))

    def errors(self) -> list[tuple[float, float]]:
        """Rotation error in degrees and translation error in pr of each hit, one to one."""
        hits = [match for match in self.one_to_one.matches if match is not None and match.is_hit]
        return [(hit.rotation_error_deg, hit.translation_error / self.pr) for hit in hits]

    def columns(self) -> dict[str, Any]:
        """Return what records hold of it."""
        scores = ("recall", "precision", "f1")
        return {
            "scene": self.scene,
            "K": self.one_to_one.num_truth,
            "M": self.num_correspondences,
            "inlier_share": f"{self.inlier_share:.4f}",
            "poses": self.one_to_one.num_predicted,
            **{key: f"{getattr(self.one_to_one, key):.4f}" for key in scores},
            **{f"any_{key}": f"{getattr(self.any, key):.4f}" for key in scores},
            "strict_f1": "" if self.strict is None else f"{self.strict.f1:.4f}",
            "seconds": f"{self.median_s:.5f}",
            "ms": f"{1e3 * self.median_s:.0f}",
            "repeats": len(self.seconds),
        }


def spacing(points: npt.NDArray[np.float64]) -> float:
    """Mean distance to the nearest other point, pr."""
    return float(np.mean(cKDTree(points).query(points, k=2)[0][:, 1]))


def score(scene: synth.Scene, found: npt.ArrayLike, is_symmetric: bool = False) -> Outcome:
    """Score poses in both families."""
    pr, strict = spacing(scene.src), None
    in_family = partial(metrics.score_scene, found, scene.poses)
    if is_symmetric:
        in_family = partial(in_family, criterion=metrics.ADD_S, model=scene.src)
        one_to_one, free = in_family(), in_family(matching="any")
    else:
        one_to_one, strict = in_family(criterion=metrics.ECC), in_family(criterion=metrics.strict(pr))
        free = in_family(matching="any", criterion=metrics.pointclm_voxels(pr))
    return Outcome(scene.name, len(scene.corr), scene.inlier_ratio(), pr, one_to_one, free, strict)


def run(
    scenes: Sequence[synth.Scene],
    methods: Mapping[str, Prepare],
    is_symmetric: bool = False,
    repeats: int = 1,
) -> dict[str, list[Outcome]]:
    """Run each method on the first scene, then each on the second, and all of that again.

    So what slows the machine down slows all of them.

    Returns
    -------
    dict
        Of each method the outcomes in the order of the scenes; the scores are those of the first repeat.
    """
    prepared = {name: [prepare(scene) for scene in scenes] for name, prepare in methods.items()}
    outcomes: dict[str, list[Outcome]] = {name: [] for name in methods}
    for repeat in range(repeats):
        for i, scene in enumerate(scenes):
            for name, of_method in outcomes.items():
                seconds, found = timed(prepared[name][i], scene)
                if repeat == 0:
                    of_method.append(score(scene, found, is_symmetric))
                of_method[i].seconds.append(seconds)
    return outcomes


def run_each(
    make: Callable[[Key], synth.Scene],
    keys: Iterable[Key],
    methods: Mapping[str, Prepare],
    is_symmetric: bool = False,
    jobs: int = 1,
) -> dict[str, list[Outcome]]:
    """Make one scene at a time, or one a process, and run each method on it, as `run` does."""
    by_scene = in_processes(partial(_run_one, make, methods, is_symmetric), keys, jobs)
    return {name: [outcomes[name] for outcomes in by_scene] for name in methods}


def _run_one(
    make: Callable[[Key], synth.Scene], methods: Mapping[str, Prepare], is_symmetric: bool, key: Key
) -> dict[str, Outcome]:
    return {name: outcomes[0] for name, outcomes in run([make(key)], methods, is_symmetric).items()}


def in_processes(task: Callable[[Key], Answer], keys: Iterable[Key], jobs: int) -> list[Answer]:
    """Do a task for each key, here or in so many processes."""
    if jobs == 1:
        return list(map(task, keys))
    # Open3D's threads do not survive a fork.
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        return list(pool.map(task, keys))


def rows(outcomes: Mapping[str, Iterable[Outcome]], key: str = "method", **head: Any) -> list[dict[str, Any]]:
    """Return what a record may hold: a line per method and scene, with the method's name in a column."""
    head["version"] = ibi.__version__
    return [{**head, key: name, **one.columns()} for name, of in outcomes.items() for one in of]


# Sums -----------------------------------------------------------------------------------------------------


def mean(outcomes: Iterable[Outcome], family: str = "one_to_one") -> metrics.MeanScore:
    """Return the mean over scenes in a family."""
    return metrics.mean_score(getattr(outcome, family) for outcome in outcomes)


def num_poses(outcomes: Iterable[Outcome]) -> int:
    """Return the number of poses found."""
    return sum(outcome.one_to_one.num_predicted for outcome in outcomes)


def num_truths(outcomes: Iterable[Outcome]) -> int:
    """Return the number of true instances."""
    return sum(outcome.one_to_one.num_truth for outcome in outcomes)


def median_ms(outcomes: Sequence[Outcome]) -> float:
    """Return the median time over scenes."""
    return 1e3 * float(np.median([outcome.median_s for outcome in outcomes]))
