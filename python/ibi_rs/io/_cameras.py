"""Pinhole cameras from files: BOP's, RealSense's, Open3D's and ROS's CameraInfo, as JSON."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ibi_rs._core import InputError
from ibi_rs._files import read_json
from ibi_rs._view import _intrinsics

WORDS = "BOP's, RealSense's, Open3D's or ROS's CameraInfo"


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Attributes
    ----------
    fx, fy, cx, cy : float
        Focal lengths and principal point, pixels.
    metres : float or None
        What a step of a depth image is in metres, if the file says so.
    is_distorted : bool
        Whether the file names distortions that are not 0. They are not undone: give rectified images.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    metres: float | None = None
    is_distorted: bool = False


def camera(path: Path, image: Path | None) -> Camera:
    """Read one, of several that of the image's number."""
    data = read_json(path)
    if not isinstance(data, dict):
        raise InputError(f"must be a JSON object, as {WORDS}")
    if data and all(isinstance(of, dict) and key.isdecimal() for key, of in data.items()):
        data = _of_image(data, image)
    try:
        return _camera(data)
    except (TypeError, ValueError, AttributeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"is no camera as {WORDS}: {error}") from None


def _of_image(data: dict[str, Any], image: Path | None) -> dict[str, Any]:
    """Of BOP's scene_camera.json that of the last number in the image's name."""
    numbers = re.findall(r"\d+", "" if image is None else image.stem)
    key = next((key for key in data if numbers and int(key) == int(numbers[-1])), None)
    if key is None and len(data) > 1:
        name = "no image" if image is None else image.name
        raise InputError(f"has {len(data)} cameras by numbers of images, and none for {name}")
    of: dict[str, Any] = data[next(iter(data)) if key is None else key]
    return of


def _camera(data: dict[str, Any]) -> Camera:
    held = {str(key).lower(): value for key, value in data.items()}
    scale = held.get("depth_scale")
    steps = None if scale is None else float(scale)
    if "ppx" in held:  # RealSense, whose scale is in metres
        numbers = [held[name] for name in ("fx", "fy", "ppx", "ppy")]
        return _made(numbers, steps, held.get("coeffs"))
    metres = None if steps is None else steps / 1000  # BOP, whose unit is the millimetre
    if "cam_k" in held:
        return _made(_of_matrix(held["cam_k"]), metres, None)
    if "intrinsic_matrix" in held:  # Open3D, by columns
        return _made(_of_matrix(np.reshape(held["intrinsic_matrix"], (3, 3)).T), metres, None)
    for name in ("k", "camera_matrix"):
        if name in held:
            of = held[name]["data"] if isinstance(held[name], dict) else held[name]
            bent = held.get("d", held.get("distortion_coefficients"))
            return _made(_of_matrix(of), metres, bent["data"] if isinstance(bent, dict) else bent)
    missing = [name for name in ("fx", "fy", "cx", "cy") if name not in held]
    if missing:
        raise InputError(f"has no {missing[0]}; wanted is a camera as {WORDS}")
    return _made([held[name] for name in ("fx", "fy", "cx", "cy")], metres, None)


def _of_matrix(numbers: Any) -> list[float]:
    matrix = np.asarray(numbers, np.float64).reshape(3, 3)
    if matrix[0, 1] != 0 or matrix[1, 0] != 0 or matrix[2].tolist() != [0, 0, 1]:
        raise InputError(f"its matrix is no pinhole camera: {matrix.ravel().tolist()}")
    return [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]


def _made(numbers: Any, metres: float | None, bent: Any) -> Camera:
    if metres is not None and not 0 < metres < np.inf:
        raise InputError("its depth_scale must be above 0 and finite")
    fx, fy, cx, cy = _intrinsics(*(float(number) for number in numbers))
    return Camera(fx, fy, cx, cy, metres, bent is not None and bool(np.any(np.asarray(bent, np.float64))))
