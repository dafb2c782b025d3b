"""ibi_rs itself, behind the contract of the peers (benchmarks/peers)."""

from __future__ import annotations

from typing import Any

import ibi_rs as ibi
from ibi_rs import synth

from .runs import Register


def version() -> str:
    """Return the version of this package."""
    return ibi.__version__


def register(
    scene: synth.Scene, params: ibi.Params, num_threads: int | None = None, **inputs: Any
) -> ibi.Registration:
    """Register a scene by its clouds, its correspondences and, where the layout has them, its normals."""
    return ibi.register(
        scene.src,
        scene.tgt,
        scene.corr,
        params,
        src_normals=scene.src_normals,
        tgt_normals=scene.tgt_normals,
        num_threads=num_threads,
        **inputs,
    )


def prepare(scene: synth.Scene, *, params: ibi.Params, num_threads: int | None = None) -> Register:
    """Prepare nothing: a registration begins from the clouds."""
    del scene
    return lambda scene: register(scene, params, num_threads)
