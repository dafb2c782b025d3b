"""`ibi eval`: poses against true ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import ibi_rs as ibi
from ibi_rs import io, metrics

from .common import SYMMETRIES, app, fail, symmetries_of


@app.command("eval")
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
    try:
        points = _surface(model)
        held = symmetries_of(symmetries or "none", points)
        predicted, true = _poses(poses), _poses(truth)
        criterion = metrics.AddS(diameter_fraction=diameters)
        score = metrics.score_scene(predicted, true, criterion=criterion, model=points, symmetries=held)
        mssd = metrics.mssd_recall(predicted, true, model=points, symmetries=held)
    except (ibi.InputError, ImportError, OSError, TypeError, ValueError) as error:
        fail(error)
    print(f"recall     {score.recall:.3f}  ({score.num_truth_hit} of {score.num_truth})")
    print(f"precision  {score.precision:.3f}  ({score.num_predicted_hit} of {score.num_predicted})")
    print(f"F1         {score.f1:.3f}")
    if symmetries is not None:
        turned = [match.rotation_error_deg for match in score.matches if match and match.is_hit]
        print(f"MSSD       {mssd.average:.3f}  (BOP's average recall, modulo {held!r})")
        if turned:
            print(f"turned by  {np.median(turned):.1f} deg in the median, {max(turned):.1f} at most")


def _surface(model: Path) -> Any:
    """Points of a cloud, or spread over a mesh, whose vertices are few where it is flat."""
    try:
        mesh = io.read_mesh(model)
    except ibi.InputError:
        return io.read_cloud(model)[0]
    return ibi.features.sample_mesh(*mesh, n=2000)[0]


def _poses(path: Path) -> Any:
    if path.suffix == ".npy":
        return np.load(path, allow_pickle=False)
    data = json.loads(path.read_text(encoding="utf-8"))
    rows = [pose["target_from_source"] if isinstance(pose, dict) else pose for pose in data["poses"]]
    return np.array(rows, dtype=np.float64).reshape(-1, 4, 4)
