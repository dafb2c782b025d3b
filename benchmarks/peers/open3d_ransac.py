"""Open3D's RANSAC on correspondences, in sequence."""

from __future__ import annotations

from typing import Any

import numpy as np
from ibi_rs import synth
from ibi_rs.synth.descriptors import load_open3d
from numpy.typing import NDArray

from .contract import Missing, Register, model_spacing
from .overlap import Claims
from .sequence import in_sequence


def version() -> str:
    """Return the version of Open3D."""
    try:
        return f"Open3D {load_open3d().__version__}"
    except ImportError as error:
        raise Missing(str(error)) from error


def prepare(
    scene: synth.Scene,
    *,
    inlier_pr: float,
    iterations: int,
    confidence: float,
    edge: float | None,
    least: float,
    failures: int,
) -> Register:
    """RANSAC.

    Parameters
    ----------
    inlier_pr : float
        Inlier distance.
    iterations : int
        At most so many samples for one pose.
    confidence : float
        Ends sooner once an all-inlier sample has been seen with this probability.
    edge : float or None
        Samples whose edges' lengths are less alike than this are skipped; None: all are tried.
    least, failures
        As in `in_sequence`.
    """
    o3d = load_open3d()
    registration = o3d.pipelines.registration
    pr = model_spacing(scene.src)
    distance = inlier_pr * pr
    checkers = [registration.CorrespondenceCheckerBasedOnDistance(distance)]
    if edge is not None:
        checkers.insert(0, registration.CorrespondenceCheckerBasedOnEdgeLength(edge))
    criteria = registration.RANSACConvergenceCriteria(iterations, confidence)

    def cloud(points: NDArray[np.float64]) -> Any:
        return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))

    def solve(src: NDArray[np.float64], tgt: NDArray[np.float64]) -> NDArray[np.float64] | None:
        rows = np.arange(len(src), dtype=np.int32)
        found = registration.registration_ransac_based_on_correspondence(
            cloud(src), cloud(tgt), o3d.utility.Vector2iVector(np.stack([rows, rows], axis=1)), distance,
            registration.TransformationEstimationPointToPoint(False), 3, checkers, criteria,
        )  # fmt: skip
        return None if found.fitness == 0 else np.asarray(found.transformation)

    def register(scene: synth.Scene) -> NDArray[np.float64]:
        o3d.utility.random.seed(0)
        claims = Claims(scene.src, scene.tgt, 1.5 * pr)
        return in_sequence(scene, solve, claims, least=least, inlier=distance, failures=failures)

    return register
