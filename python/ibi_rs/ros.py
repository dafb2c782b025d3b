"""Messages of ROS 2: depth images and poses in, what was found out. No ROS is needed.

What is read is a message, or whatever has its fields as attributes. What was found becomes a dict of fields.

A dict has the names of the message's fields, so ``rosidl_runtime_py.set_message_fields(message, data)`` fills
a message with it, and ``json.dumps`` writes it for rosbridge. Messages are in metres: say what the data are
in by ``unit``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ibi_rs._core import InputError
from ibi_rs._inputs import _number
from ibi_rs._written import METRES, checked_unit, quaternion

if TYPE_CHECKING:
    from ibi_rs._model import Model
    from ibi_rs._view import View
    from ibi_rs.registration import Pose, Registration

__all__ = ["detection3d_array", "matrix", "pose", "pose_estimates", "pose_with_covariance", "view"]

_DEPTHS = {"16UC1": ("u2", 0.001), "mono16": ("u2", 0.001), "32FC1": ("f4", 1.0)}
"""Encodings of depth images: what a pixel is, and how many metres a step of it is by REP 118."""


def view(
    image: Any,
    camera_info: Any,
    *,
    unit: str = "m",
    step_m: float | None = None,
    target_from_camera: npt.ArrayLike | None = None,
) -> View:
    """Read a depth image, ``sensor_msgs/Image``, and its camera, ``sensor_msgs/CameraInfo``.

    Parameters
    ----------
    image
        Has ``height``, ``width``, ``encoding`` (``16UC1``, ``mono16`` or ``32FC1``), ``is_bigendian``,
        ``step`` (bytes of a row) and ``data``. Pixels of 0 and those that are not finite have no depth.
    camera_info
        Has ``k``, the nine numbers of the camera's matrix, row by row. The image is taken to be rectified.
    unit : str
        Of the model, as in :func:`pose`: what the points come out in.
    step_m : float, optional
        What a step of a pixel is, metres; above 0. By default what REP 118 says: 0.001 for integers, 1 for
        floats.
    target_from_camera : (4, 4) array_like, optional
        Moves the camera's frame to that of the scene. By default they are the same.

    Returns
    -------
    View
        Its ``points`` are the scan, and itself the viewpoint, for :meth:`ibi_rs.Model.detect`.

    Raises
    ------
    InputError
        The encoding is none of these, the data do not fit height, width and step, ``k`` is no camera's, the
        unit has no name here, or the image has no depth.
    """
    from ibi_rs._view import View

    metres = _metres(unit)
    if image.encoding not in _DEPTHS:
        raise InputError(f"image: encoding is {image.encoding!r}; it must be one of {', '.join(_DEPTHS)}")
    kind, usual = _DEPTHS[image.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if image.is_bigendian else "<")
    height, width, row = int(image.height), int(image.width), int(image.step)
    data = np.frombuffer(bytes(image.data), np.uint8)
    if len(data) != height * row or row < width * dtype.itemsize:
        raise InputError(f"image: {len(data)} bytes, for {height} rows of {row} with {width} pixels each")
    pixels = np.ascontiguousarray(data.reshape(height, row)[:, : width * dtype.itemsize]).view(dtype)
    scale = (usual if step_m is None else _number("step_m", step_m)) / metres
    if not 0 < scale < np.inf:
        raise InputError(f"step_m is {step_m}; it must be above 0 and finite")
    k = np.asarray(camera_info.k, np.float64).ravel()
    if k.shape != (9,):
        raise InputError(f"camera_info: k has {k.size} numbers; it must have 9")
    depth = pixels.astype(np.float64) * scale
    return View.from_depth(depth, k[0], k[4], k[2], k[5], target_from_camera=target_from_camera)


def matrix(pose: Any, *, unit: str = "m") -> npt.NDArray[np.float64]:
    """Return the matrix of a ``geometry_msgs/Pose``: moves its frame into the one that it is given in.

    Parameters
    ----------
    pose
        Has ``position`` in metres and ``orientation``, a quaternion, of which only the direction counts.
    unit : str
        Of the data, as in :func:`pose`.

    Returns
    -------
    (4, 4) float64

    Raises
    ------
    InputError
        The quaternion is 0 or a number is not finite, or the unit has no name here.
    """
    metres = _metres(unit)
    x, y, z, w = (float(getattr(pose.orientation, name)) for name in "xyzw")
    place = np.array([float(getattr(pose.position, name)) for name in "xyz"]) / metres
    length = float(np.linalg.norm([x, y, z, w]))
    if not (0 < length < np.inf and np.isfinite(place).all()):
        raise InputError("pose: its quaternion must not be 0, and all its numbers finite")
    x, y, z, w = x / length, y / length, z / length, w / length
    moves = np.eye(4)
    moves[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    moves[:3, 3] = place
    return moves


def pose_estimates(
    found: Registration,
    obj_ids: Sequence[int],
    *,
    unit: str = "mm",
    frame_from_scene: npt.ArrayLike | None = None,
) -> list[dict[str, Any]]:
    """Return the fields of ``ibpc_interfaces/PoseEstimate`` of the OpenCV bin-picking challenge, one a pose.

    Parameters
    ----------
    found : Registration
        What was found.
    obj_ids : sequence of int
        The object id of each model.
    unit : str
        Of the data, as in :func:`pose`. The messages are in millimetres, as BOP's files, and not in metres.
    frame_from_scene : (4, 4) array_like, optional
        From the frame of the scan to the one that is asked for, data units. By default they are the same.

    Returns
    -------
    list of dict
        ``obj_id``, ``score`` and ``pose`` of each, best score first.

    Raises
    ------
    InputError
        There are more ids than models were looked for, or fewer, the unit has no name here, or
        ``frame_from_scene`` has another shape.
    """
    millimetres = 1000 * _metres(unit)
    num_models = max(1, len(found.models))
    if len(obj_ids) != num_models:
        raise InputError(f"obj_ids: there are {len(obj_ids)}; {num_models} were looked for")
    moves = np.eye(4) if frame_from_scene is None else np.asarray(frame_from_scene, np.float64)
    if moves.shape != (4, 4):
        raise InputError(f"frame_from_scene has shape {moves.shape}; it must be (4, 4)")
    return [
        {
            "obj_id": int(obj_ids[one.model]),
            "score": float(one.score),
            "pose": _pose(moves @ one.target_from_source, millimetres),
        }
        for one in found
    ]


def pose(found: Pose, *, unit: str = "m") -> dict[str, Any]:
    """Return the fields of ``geometry_msgs/Pose``: where the model's frame is in the frame of the scene.

    Parameters
    ----------
    found : Pose
        One that was found.
    unit : str
        Of the data: ``"m"``, ``"cm"``, ``"mm"``, ``"um"``, ``"in"`` or ``"ft"``.

    Returns
    -------
    dict
        ``position`` in metres, and ``orientation``, a quaternion.

    Raises
    ------
    InputError
        The unit has no name here.
    """
    return _pose(found.target_from_source, _metres(unit))


def pose_with_covariance(found: Pose, *, unit: str = "m") -> dict[str, Any]:
    """Return the fields of ``geometry_msgs/PoseWithCovariance``.

    Parameters
    ----------
    found, unit
        As in :func:`pose`.

    Returns
    -------
    dict
        ``pose``, and ``covariance``: 36 numbers, row by row, of x, y, z of ``position`` (metres), then of the
        rotations about the fixed axes x, y, z of the scene's frame through ``position`` (radians). That is
        ``found.covariance`` in another order and about another point: the model's origin and not its
        ``centre``, so that a turn moves the position. All 0 where the pose has no covariance.

    Raises
    ------
    InputError
        The unit has no name here.
    """
    metres = _metres(unit)
    covariance = np.zeros((6, 6))
    if found.covariance is not None:
        # A motion (w, t) about the centre c takes the origin p to p + w x (p - c) + t, and turns by w.
        x, y, z = found.target_from_source[:3, 3] - found.centre
        shift_by_turn = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])
        jacobian = np.block([[metres * shift_by_turn, metres * np.eye(3)], [np.eye(3), np.zeros((3, 3))]])
        covariance = jacobian @ found.covariance @ jacobian.T
        covariance = (covariance + covariance.T) / 2
    return {"pose": _pose(found.target_from_source, metres), "covariance": covariance.ravel().tolist()}


def detection3d_array(
    found: Registration,
    frame_id: str,
    *,
    stamp: tuple[int, int] = (0, 0),
    unit: str = "m",
    models: Model | Sequence[Model] | None = None,
    class_ids: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Return the fields of ``vision_msgs/Detection3DArray``, a detection for each pose, best score first.

    Parameters
    ----------
    found : Registration
        What was found.
    frame_id : str
        Name of the scene's frame, mostly the camera's optical one.
    stamp : (int, int)
        Seconds and nanoseconds of the scan.
    unit : str
        As in :func:`pose`.
    models : Model or sequence of Model, optional
        What was looked for: gives the boxes their sizes, that of the model along its own axes. By default 0.
    class_ids : sequence of str, optional
        What ``class_id`` is for each model. By default the model's name, or "0".

    Returns
    -------
    dict
        ``header`` and ``detections``. Of each ``results`` has one hypothesis, with ``class_id``, ``score``
        and the pose of the model's frame with covariance; the centre of ``bbox`` is that of the model.

    Raises
    ------
    InputError
        The unit has no name here, or there are more models or class ids than were looked for, or fewer.
    """
    metres = _metres(unit)
    names = list(found.models) or ["0"]
    given = [models] if models is not None and not isinstance(models, Sequence) else models
    for what, of in (("models", given), ("class_ids", class_ids)):
        if of is not None and len(of) != len(names):
            raise InputError(f"{what}: there are {len(of)}; {len(names)} were looked for")
    boxes = [np.zeros((2, 3))] * len(names)
    if given is not None:
        boxes = [np.array([part.points.min(axis=0), part.points.max(axis=0)]) for part in given]
    ids = names if class_ids is None else list(class_ids)
    sec, nanosec = stamp
    header = {"stamp": {"sec": int(sec), "nanosec": int(nanosec)}, "frame_id": str(frame_id)}
    detections = []
    for one in found:
        middle = one.target_from_source.copy()
        low, high = boxes[one.model]
        middle[:3, 3] = one.centre if given is None else one.target_from_source[:3] @ [*(low + high) / 2, 1]
        size = dict(zip("xyz", (metres * (high - low)).tolist(), strict=True))
        result = {
            "hypothesis": {"class_id": str(ids[one.model]), "score": float(one.score)},
            "pose": pose_with_covariance(one, unit=unit),
        }
        box = {"center": _pose(middle, metres), "size": size}
        detections.append({"header": header, "results": [result], "bbox": box, "id": ""})
    return {"header": header, "detections": detections}


def _metres(unit: str) -> float:
    checked_unit(unit)
    return METRES[unit]


def _pose(matrix: npt.NDArray[np.float64], metres: float) -> dict[str, Any]:
    position = dict(zip("xyz", (metres * matrix[:3, 3]).tolist(), strict=True))
    return {
        "position": position,
        "orientation": dict(zip("xyzw", quaternion(matrix[:3, :3]).tolist(), strict=True)),
    }
