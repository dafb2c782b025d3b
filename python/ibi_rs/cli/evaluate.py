"""`ibi eval`: poses against true ones."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import ibi_rs as ibi
from ibi_rs import io, metrics
from ibi_rs._files import read_json, read_npy

from .search import SYMMETRIES, symmetries_of
from .terminal import command, misused, out


@command("eval")
def evaluate(
    poses: Annotated[Path, typer.Argument(help="JSON that `ibi register -o` has written.")],
    truth: Annotated[Path, typer.Argument(help="True poses: JSON with 'poses', or a (K, 4, 4) NPY.")],
    model: Annotated[Path, typer.Argument(help="Mesh or cloud of the part, for ADD-S and its diameter.")],
    diameters: Annotated[float, typer.Option(help="A pose is right within so many diameters.")] = 0.1,
    symmetries: Annotated[
        str | None, typer.Option(help=f"{SYMMETRIES}: adds rotation errors and MSSD, modulo these.")
    ] = None,
) -> None:
    """Score poses against true ones: one to one, by ADD-S below a tenth of the model's diameter."""
    if not 0 < diameters < np.inf:
        misused(f"--diameters is {diameters:g}; it must be above 0 and finite")
    predicted, true = _poses(poses), _poses(truth)
    points = _surface(model)
    held = symmetries_of(symmetries or "none", points)
    criterion = metrics.AddS(diameter_fraction=diameters)
    score = metrics.score_scene(predicted, true, criterion=criterion, model=points, symmetries=held)
    mssd = metrics.mssd_recall(predicted, true, model=points, symmetries=held)
    lines = [
        f"recall     {score.recall:.3f}  ({score.num_truth_hit} of {score.num_truth})",
        f"precision  {score.precision:.3f}  ({score.num_predicted_hit} of {score.num_predicted})",
        f"F1         {score.f1:.3f}",
    ]
    if symmetries is not None:
        turned = [match.rotation_error_deg for match in score.matches if match and match.is_hit]
        lines.append(f"MSSD       {mssd.average:.3f}  (BOP's average recall, modulo {held!r})")
        if turned:
            lines.append(f"turned by  {np.median(turned):.1f} deg in the median, {max(turned):.1f} at most")
    for line in lines:
        out.print(line, highlight=False, markup=False, soft_wrap=True)


def _surface(model: Path) -> Any:
    """Points of a cloud, or spread over a mesh, whose vertices are few where it is flat."""
    try:
        mesh = io.read_mesh(model)
    except ibi.InputError:
        return io.read_cloud(model)[0]
    return ibi.features.sample_mesh(*mesh, n=2000)[0]


_ROUNDED = 1e-3
"""How far a rotation may be from one, per entry of R R^T: files hold few digits."""


def _poses(path: Path) -> Any:
    """(K, 4, 4) rigid motions; what is none is refused under the name of its file."""
    poses = read_npy(path) if path.suffix == ".npy" else _listed(path)
    if poses.size == 0:
        return np.empty((0, 4, 4))
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or poses.dtype.kind not in "fiu":
        raise ibi.InputError(f"{path}: wanted (K, 4, 4) numbers, found {poses.dtype} of shape {poses.shape}")
    poses = poses.astype(np.float64)
    for number, pose in enumerate(poses):
        if not np.isfinite(pose).all():
            raise ibi.InputError(f"{path}: pose {number} is not finite")
        turn = pose[:3, :3]
        with np.errstate(over="ignore", invalid="ignore"):
            off = np.abs(turn @ turn.T - np.eye(3)).max()
            is_rigid = off <= _ROUNDED and np.linalg.det(turn) > 0 and (pose[3] == [0, 0, 0, 1]).all()
        if not is_rigid:
            raise ibi.InputError(f"{path}: pose {number} is no rigid motion")
    return poses


def _listed(path: Path) -> Any:
    data = read_json(path)
    rows = data.get("poses") if isinstance(data, dict) else None
    if not isinstance(rows, list):
        raise ibi.InputError(
            f"{path}: must be a JSON object with a list 'poses', as `ibi register -o` writes"
        )
    matrices = []
    for number, row in enumerate(rows):
        matrix = row.get("target_from_source") if isinstance(row, dict) else row
        try:
            matrices.append(np.asarray(matrix, np.float64))
        except (ValueError, TypeError):
            matrices.append(np.empty(0))
        if matrices[-1].shape != (4, 4):
            raise ibi.InputError(f"{path}: pose {number} is no (4, 4) matrix of numbers")
    return np.array(matrices)
