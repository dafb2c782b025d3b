"""A method for one instance, applied again and again: find, check, remove its correspondences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from ibi_rs import synth
from ibi_rs.synth.scene import move
from numpy.typing import NDArray

from .overlap import Claims

Solve = Callable[[NDArray[np.float64], NDArray[np.float64]], "NDArray[np.float64] | None"]
"""Gives the pose of matched points (M, 3) and (M, 3), or None."""


def in_sequence(
    scene: synth.Scene, solve: Solve, claims: Claims, *, least: float, inlier: float, failures: int
) -> NDArray[np.float64]:
    """Find one instance after the other, in this order.

    Parameters
    ----------
    scene : ibi_rs.synth.Scene
    solve : callable
    claims : Claims
        The check of a pose.
    least : float
        Its threshold.
    inlier : float
        Correspondences that a pose brings this near are removed, whether the pose is kept or not: they would
        lead to the same pose again.
    failures : int
        Ends after so many poses in a row that are not kept.

    Returns
    -------
    (K, 4, 4) float64
    """
    src, tgt = scene.src[scene.corr[:, 0]], scene.tgt[scene.corr[:, 1]]
    kept, failed = [], 0
    while len(src) >= 3 and failed < failures:
        pose = solve(src, tgt)
        if pose is None:
            break
        if claims.keep(pose, least):
            kept.append(pose)
            failed = 0
        else:
            failed += 1
        alive = np.linalg.norm(move(pose, src) - tgt, axis=1) > inlier
        src, tgt = src[alive], tgt[alive]
    return np.array(kept).reshape(-1, 4, 4)
