"""What was found as messages of ROS 2: dicts of their fields, for which no ROS is needed.

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
from ibi_rs._written import METRES, checked_unit, quaternion

if TYPE_CHECKING:
    from ibi_rs._model import Model
    from ibi_rs.registration import Pose, Registration

__all__ = ["detection3d_array", "pose", "pose_with_covariance"]


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
