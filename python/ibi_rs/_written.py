"""Registrations as plain data: JSON, and CSV of the poses."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import asdict, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ibi_rs._core import InputError, __version__
from ibi_rs._inputs import RIGID_TOLERANCE
from ibi_rs.symmetries import Symmetries

if TYPE_CHECKING:
    from ibi_rs.registration import Pose, Registration, Rejected

FORMAT = "ibi_rs.poses"
VERSION = 1
"""Of the form of the data; counts up where a reader of the one before would be wrong."""

METRES: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "um": 1e-6, "in": 0.0254, "ft": 0.3048}
"""Units of length by their names."""

COLUMNS = ("model", "score", "x", "y", "z", "qx", "qy", "qz", "qw", "overlap", "num_inliers", "inlier_rmse")


def checked_unit(unit: str | None) -> str | None:
    """Refuse a unit that has no name here."""
    if unit is not None and unit not in METRES:
        raise InputError(f"unit is {unit!r}; it must be one of {', '.join(METRES)}, or None")
    return unit


def quaternion(rotation: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(4,): x, y, z, w of a rotation, of length 1, w not below 0; exact for half turns, too."""
    four = np.empty((4, 4))  # 4 q qT, whose rows are all the quaternion q, (w, x, y, z), times something
    four[0, 0] = 1 + np.trace(rotation)
    off = rotation - rotation.T
    four[0, 1:] = four[1:, 0] = off[2, 1], off[0, 2], off[1, 0]
    four[1:, 1:] = rotation + rotation.T + (1 - np.trace(rotation)) * np.eye(3)
    q = four[np.argmax(np.diag(four))]
    q = q / np.linalg.norm(q) * np.copysign(1, q[0])
    return np.array([*q[1:], q[0]])


def registration_dict(found: Registration, unit: str | None, frame: str, run: bool) -> dict[str, Any]:
    """Write a registration as plain data; without `run` what tells of the run is left out."""
    names = found.models or (None,)
    held = found.symmetries or (Symmetries.none(),) * len(names)
    data: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "ibi_rs": __version__,
        "unit": checked_unit(unit),
        "frame": str(frame),
        "models": [{"name": name, "symmetries": of.to_bop()} for name, of in zip(names, held, strict=True)],
        "poses": [pose_dict(pose, run) for pose in found],
        "warnings": list(found.warnings),
        "stop_reason": str(found.stop_reason),
        "resolution": found.resolution,
        "params": found.params.to_dict() if not found.params._own() else None,
    }
    if run:
        data["run"] = {
            "labels": found.labels.tolist(),
            "rejected": [_rejected_dict(one) for one in found.rejected],
            "rounds": json.loads(found._rounds),
            "stop_reason": asdict(found.stop_reason),
            "timings": asdict(found.timings),
            "parts": {name: registration_dict(found.of(name), unit, frame, run) for name in found.models},
        }
    return data


def pose_dict(pose: Pose, run: bool) -> dict[str, Any]:
    """Write a pose as plain data."""
    matrix = pose.target_from_source
    data = {
        "model": pose.model,
        "model_name": pose.model_name,
        "target_from_source": matrix.tolist(),
        "translation": matrix[:3, 3].tolist(),
        "quaternion_xyzw": quaternion(matrix[:3, :3]).tolist(),
        "score": pose.score,
        "overlap": pose.overlap,
        "num_inliers": pose.num_inliers,
        "inlier_rmse": pose.inlier_rmse,
        "closeness": pose.closeness,
        "back_fit": pose.back_fit,
        "evidence": pose.evidence,
        "round": pose.round,
        "centre": pose.centre.tolist(),
        "covariance": None if pose.covariance is None else pose.covariance.tolist(),
        "free_motions": [free.to_dict() for free in pose.free_motions],
        "inliers": pose.inliers.tolist(),
    }
    if run:
        data["measures"] = None if pose.measures is None else asdict(pose.measures)
    return data


def _rejected_dict(one: Rejected) -> dict[str, Any]:
    return {
        "model": one.model,
        "model_name": one.model_name,
        "target_from_source": one.target_from_source.tolist(),
        "score": one.score,
        "objection": one.objection,
        "round": one.round,
        "measures": None if one.measures is None else asdict(one.measures),
    }


def registration_of(data: Any) -> Registration:
    """Read what `registration_dict` has written, of this version or an older one."""
    from ibi_rs import registration as r
    from ibi_rs.params import Params

    if not isinstance(data, Mapping) or data.get("format") != FORMAT:
        raise InputError(f"must be an object with 'format': {FORMAT!r}, as Registration.save writes")
    version = data.get("version")
    if not isinstance(version, int) or not 1 <= version <= VERSION:
        raise InputError(f"version is {version!r}; this ibi_rs reads 1 to {VERSION}")
    try:
        run = data.get("run") or {}
        nothing = {field.name: 0.0 for field in fields(r.Timings)}
        reason = run.get("stop_reason") or {"name": "unknown", "message": data["stop_reason"]}
        poses = [_pose(number, of) for number, of in enumerate(data["poses"])]
        found = r.Registration(
            poses,
            labels=np.array(run.get("labels", ()), np.int32),
            rounds=json.dumps(run.get("rounds", [])),
            stop_reason=r.StopReason(**reason),
            timings=r.Timings(**run.get("timings", nothing)),
            resolution=float(data["resolution"]),
            params=Params() if data["params"] is None else Params.from_dict(data["params"]),
            rejected=[_rejected(number, of) for number, of in enumerate(run.get("rejected", ()))],
            warnings=[str(text) for text in data["warnings"]],
            parts={name: registration_of(of) for name, of in run.get("parts", {}).items()},
        )
        for model, of in enumerate(data["models"]):  # where the run was left out
            if of["name"] is not None and of["name"] not in found._parts:
                part = found._parts[of["name"]] = copy(found)
                part._parts, part.poses = {}, tuple(pose for pose in poses if pose.model == model)
        found.symmetries = tuple(Symmetries.from_bop(of["symmetries"]) for of in data["models"])
        assert len(found.rounds) >= 0  # which are read now, and not when somebody asks for them
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        what = f"has no {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(what) from None
    return found


def _matrix(name: str, value: Any) -> npt.NDArray[np.float64]:
    matrix = np.asarray(value, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(f"{name} is no (4, 4) matrix of finite numbers")
    turn = matrix[:3, :3]
    if np.abs(turn @ turn.T - np.eye(3)).max() > RIGID_TOLERANCE or np.linalg.det(turn) < 0:
        raise InputError(f"{name} is no rigid motion")
    return matrix


def _measures(data: Any) -> Any:
    from ibi_rs.registration import Measures

    return None if data is None else Measures(**{**data, "losses": tuple(data["losses"])})


def _pose(number: int, data: Mapping[str, Any]) -> Pose:
    from ibi_rs.registration import FreeMotion, Pose

    plain = ("model", "model_name", "score", "overlap", "closeness", "back_fit", "evidence", "inlier_rmse")
    return Pose(
        target_from_source=_matrix(f"poses[{number}].target_from_source", data["target_from_source"]),
        **{name: data[name] for name in (*plain, "round")},
        inliers=np.array(data.get("inliers", ()), np.int64),
        measures=_measures(data.get("measures")),
        centre=np.array(data["centre"], np.float64),
        covariance=None if data["covariance"] is None else np.array(data["covariance"], np.float64),
        free_motions=tuple(
            FreeMotion(
                free["kind"],
                np.array(free["direction"], np.float64),
                None if free["point"] is None else np.array(free["point"], np.float64),
                free["pitch"],
            )
            for free in data["free_motions"]
        ),
    )


def _rejected(number: int, data: Mapping[str, Any]) -> Rejected:
    from ibi_rs.registration import Rejected

    return Rejected(
        _matrix(f"rejected[{number}].target_from_source", data["target_from_source"]),
        measures=_measures(data["measures"]),
        **{name: data[name] for name in ("score", "objection", "round", "model", "model_name")},
    )


def poses_csv(found: Sequence[Pose]) -> str:
    """Write a line for each pose below a line of names; lengths in data units."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(COLUMNS)
    for pose in found:
        place = [*pose.target_from_source[:3, 3], *quaternion(pose.target_from_source[:3, :3])]
        numbers = [pose.score, *place, pose.overlap, pose.num_inliers, pose.inlier_rmse]
        name = pose.model if pose.model_name is None else pose.model_name
        rows.writerow([name, *(f"{number:.9g}" for number in numbers)])
    return text.getvalue()
