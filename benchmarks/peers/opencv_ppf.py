"""OpenCV's voting on point pair features. It needs normals, and uses no correspondences.

B. Drost et al., "Model globally, match locally: efficient and robust 3D object recognition", CVPR 2010.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from ibi_rs import synth
from numpy.typing import NDArray

from .contract import Missing, Register, model_spacing
from .overlap import checked


def version() -> str:
    """Return the version of OpenCV."""
    try:
        import cv2
    except ImportError as error:
        raise Missing(f"OpenCV cannot be loaded: {error}") from error
    if not hasattr(cv2, "ppf_match_3d_PPF3DDetector"):
        raise Missing("this OpenCV is without ppf_match_3d: opencv-contrib-python-headless has it")
    return f"OpenCV {cv2.__version__}"


def prepare(
    scene: synth.Scene,
    *,
    model_step: float,
    scene_step: float,
    every: int,
    neighbors: int,
    candidates: int,
    least: float | None,
) -> Register:
    """Point pair features; the detector is trained on the model beforehand.

    Parameters
    ----------
    model_step, scene_step : float
        Sampling of the model and of the scene, relative to the model's diameter.
    every : int
        Every so-many-th point of the sampled scene is a reference point.
    neighbors : int
        Of OpenCV's normal estimation, where the scene has no normals.
    candidates : int
        So many poses, those with most votes, are taken.
    least : float or None
        Threshold of the overlap check; None: OpenCV's poses as they are.
    """
    import cv2

    def with_normals(points: NDArray[Any], normals: NDArray[Any] | None) -> NDArray[np.float32]:
        if normals is not None:
            return np.ascontiguousarray(np.hstack([points, normals]), dtype=np.float32)
        cloud = np.ascontiguousarray(points, dtype=np.float32)
        return cv2.ppf_match_3d.computeNormalsPC3d(cloud, neighbors, False, (0, 0, 0))[1]

    pr = model_spacing(scene.src)
    detector = cv2.ppf_match_3d_PPF3DDetector(model_step, model_step, 30)
    detector.trainModel(with_normals(scene.src, scene.src_normals))

    def register(scene: synth.Scene) -> NDArray[np.float64]:
        found = detector.match(with_normals(scene.tgt, scene.tgt_normals), 1 / every, scene_step)
        found = sorted(found, key=lambda pose: -pose.numVotes)[:candidates]
        poses = np.array([pose.pose for pose in found]).reshape(-1, 4, 4)
        return checked(poses, scene, pr, least)

    return register
