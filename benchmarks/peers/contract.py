"""The contract of a peer."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from ibi_rs import synth
from numpy.typing import NDArray

Register = Callable[[synth.Scene], NDArray[np.float64]]
"""Gives the poses found in a scene, (K, 4, 4), best first."""

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
"""What a peer that takes all cores can get."""


class Missing(Exception):
    """A peer cannot run here; the message says why."""


@dataclass(frozen=True)
class Method:
    """One row of the table.

    Attributes
    ----------
    module : module
        The peer's, with `version` and `prepare`.
    threads : int
        How many it may use.
    fixed : dict
        Settings that tell this row from others of the same peer.
    needs_normals : bool
        Whether it makes sense only in layouts with normals.
    """

    module: ModuleType
    threads: int = CORES
    fixed: dict[str, object] | None = None
    needs_normals: bool = False

    def prepare(self, scene: synth.Scene, settings: dict[str, object]) -> Register:
        """Prepare for the model of a scene."""
        register: Register = self.module.prepare(scene, **{**settings, **(self.fixed or {})})
        return register


def model_spacing(points: NDArray[np.float64]) -> float:
    """Mean distance to the nearest other point: the pr that settings are multiples of."""
    from scipy.spatial import cKDTree

    return float(np.mean(cKDTree(points).query(points, k=2)[0][:, 1]))
