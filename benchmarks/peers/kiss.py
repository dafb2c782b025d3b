"""KISS-Matcher's pruning and solver on given correspondences, in sequence.

H. Lim et al., "KISS-Matcher: fast and robust point cloud registration revisited", ICRA 2025.
"""

from __future__ import annotations

from importlib.metadata import version as version_of

import numpy as np
from ibi_rs import synth
from numpy.typing import NDArray

from .contract import Missing, Register, model_spacing
from .overlap import Claims
from .sequence import in_sequence


def version() -> str:
    """Return the version of KISS-Matcher."""
    try:
        import kiss_matcher
    except ImportError as error:
        raise Missing(f"kiss-matcher cannot be loaded: {error}") from error
    if not hasattr(kiss_matcher.KISSMatcher, "prune_and_solve"):
        raise Missing("this kiss-matcher takes no correspondences; 1.0 and later do")
    return f"KISS-Matcher {version_of('kiss-matcher')}"


def prepare(
    scene: synth.Scene, *, noise_pr: float, solver_gain: float, inlier_pr: float, least: float, failures: int
) -> Register:
    """Pruning to a maximum core of the compatibility graph, then graduated non-convexity.

    Parameters
    ----------
    noise_pr : float
        Noise bound of the pruning.
    solver_gain : float
        Noise bound of the solver as a multiple of it.
    inlier_pr : float
        Correspondences this near to a pose are removed.
    least, failures
        As in `in_sequence`.
    """
    import kiss_matcher

    pr = model_spacing(scene.src)
    # Its noise bounds are multiples of a voxel size; with gain 1 the voxel size is the pruning's.
    config = kiss_matcher.KISSMatcherConfig(
        noise_pr * pr,
        robin_noise_bound_gain=1.0,
        solver_noise_bound_gain=solver_gain,
        enable_noise_bound_clamping=False,
    )
    matcher = kiss_matcher.KISSMatcher(config)

    def solve(src: NDArray[np.float64], tgt: NDArray[np.float64]) -> NDArray[np.float64] | None:
        matcher.reset()
        found = matcher.prune_and_solve(list(src.astype(np.float32)), list(tgt.astype(np.float32)))
        if not found.valid:
            return None
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = found.rotation, np.ravel(found.translation)
        return pose

    def register(scene: synth.Scene) -> NDArray[np.float64]:
        claims = Claims(scene.src, scene.tgt, 1.5 * pr)
        return in_sequence(scene, solve, claims, least=least, inlier=inlier_pr * pr, failures=failures)

    return register
