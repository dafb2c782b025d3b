"""The extension module, written in Rust in ``crates/ibi-py``. Users call the faces in front of it."""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, final

import numpy as np
import numpy.typing as npt

__all__ = [
    "InputError",
    "Model",
    "Models",
    "ParamsError",
    "Symmetries",
    "__version__",
    "check_params",
    "correspond",
    "detect",
    "detect_together",
    "features_dominant_plane",
    "features_estimate_normals",
    "features_fpfh",
    "features_match",
    "features_outer_surface",
    "features_sample_mesh",
    "features_voxel_downsample",
    "measured_rows",
    "metrics_add",
    "metrics_add_s",
    "metrics_assignment",
    "metrics_diameter",
    "metrics_frobenius_distance",
    "metrics_mean_score",
    "metrics_mssd",
    "metrics_mssd_recall",
    "metrics_rotation_error_rad",
    "metrics_score_add_s",
    "metrics_score_pose",
    "metrics_translation_error",
    "params_from_toml",
    "params_to_toml",
    "preset",
    "register",
    "symmetries_find",
    "toml_to_json",
]

_Floats: TypeAlias = npt.NDArray[np.float64]
_Ints: TypeAlias = npt.NDArray[np.int64]

__version__: str

class InputError(ValueError):
    """An array that cannot be used; the message says which and why."""

class ParamsError(ValueError):
    """A parameter that is unknown or out of range."""

# Parameters: complete and checked JSON, or TOML, as text.

def preset(name: str) -> str: ...
def check_params(json: str) -> str: ...
def params_to_toml(json: str) -> str: ...
def params_from_toml(text: str) -> str: ...
def toml_to_json(text: str) -> str: ...

# Registration.

@final
class Model:
    """A model that was checked and prepared; ``mesh_voxel``: that of a mesh, and whether it was given."""

    def __new__(
        cls,
        points: _Floats,
        normals: _Floats | None = None,
        frames: _Floats | None = None,
        symmetries: Symmetries | None = None,
        mesh_voxel: tuple[float, bool] | None = None,
        fine: tuple[_Floats, _Floats] | None = None,
    ) -> Model: ...
    @staticmethod
    def from_mesh(
        vertices: _Floats,
        faces: _Ints,
        voxel: float | None,
        symmetries: Symmetries | None,  # None: they are looked for
        num_threads: int | None,
    ) -> Model: ...
    @property
    def spacing(self) -> float: ...
    @property
    def voxel(self) -> float: ...
    @property
    def mesh_voxel(self) -> tuple[float, bool] | None: ...
    def points(self) -> _Floats: ...
    def normals(self) -> _Floats | None: ...
    def fine(self) -> tuple[_Floats, _Floats] | None: ...
    def symmetries(self) -> Symmetries: ...
    def diameter(self, num_threads: int | None) -> float: ...

@final
class Models:
    """Models with their names, which are different."""

    def __new__(cls, parts: Sequence[tuple[str, Model]]) -> Models: ...

def register(
    model: Model,
    tgt: _Floats,
    corr: npt.NDArray[Any],  # (M, 2) int64 or (M, 6) float64
    params: str,
    *,
    tgt_normals: _Floats | None = None,
    tgt_frames: _Floats | None = None,
    similarity: _Floats | None = None,
    viewpoint: Sequence[Sequence[float]] | None = None,
    measured: Sequence[_Floats] | None = None,
    num_threads: int | None = None,
    on_round: Callable[[str], object] | None = None,
    own: dict[str, Callable[..., object]] | None = None,  # stages, by their names
) -> dict[str, Any]:
    """Arrays, one entry per pose: target_from_source (K, 4, 4), score, overlap, inlier_rmse, inliers, round.

    Then of the run: labels (M,) int32, resolution and stop_message; and as JSON text rounds, stop_reason and
    timings.
    """

# Detection.

def measured_rows(
    points: _Floats, normals: _Floats | None = None
) -> tuple[_Floats, _Floats | None, int, int]:
    """Rows that are finite, and normals, completed or None; how many rows went, how many had no normal."""

def correspond(
    model: Model,
    tgt: _Floats,
    tgt_normals: _Floats | None,
    viewpoint: Sequence[Sequence[float]] | None,
    measured: Sequence[_Floats] | None,
    remove_plane: bool | None,
    check_units: bool,
    roi: tuple[_Floats, Sequence[float]] | None,
    background: _Floats | None,
    num_threads: int | None,
) -> tuple[_Floats, _Floats, _Ints, _Floats, _Floats, float, list[str]]:
    """Points, normals, [row of the model, row of the points], similarity, background, voxel, warnings."""

def detect(
    model: Model,
    tgt: _Floats,
    params: str,
    tgt_normals: _Floats | None,
    viewpoint: Sequence[Sequence[float]] | None,
    measured: Sequence[_Floats] | None,
    remove_plane: bool | None,
    check_units: bool,
    roi: tuple[_Floats, Sequence[float]] | None,
    background: _Floats | None,
    num_threads: int | None,
    on_round: Callable[[str], object] | None,
    own: Callable[[_Floats, _Ints], dict[str, Callable[..., object]]] | None,
) -> dict[str, Any]:
    """As `register`; and ``warnings``, ``background``, and ``resolution_set``, that of the parameters."""

def detect_together(
    models: Models,
    tgt: _Floats,
    params: str,
    tgt_normals: _Floats | None,
    viewpoint: Sequence[Sequence[float]] | None,
    measured: Sequence[_Floats] | None,
    remove_plane: bool | None,
    check_units: bool,
    roi: tuple[_Floats, Sequence[float]] | None,
    background: _Floats | None,
    num_threads: int | None,
    on_round: Callable[[str], object] | None,
    own: Sequence[Callable[[_Floats, _Ints], dict[str, Callable[..., object]]]],
) -> tuple[list[dict[str, Any]], list[list[int]], str, str, float]:
    """Of each as `detect`; [model, its pose], best first; why it ended, as JSON and words; seconds."""

# Symmetries.

@final
class Symmetries:
    """Motions (S, 4, 4), and axes and points of them, (A, 3) each; checked."""

    def __new__(cls, discrete: _Floats, axes: _Floats, offsets: _Floats) -> Symmetries: ...
    def arrays(self) -> tuple[_Floats, _Floats, _Floats]: ...
    @property
    def is_ball(self) -> bool: ...
    def nearest(self, poses: _Floats, reference: _Floats) -> _Floats: ...
    def discretised(self, max_step: float) -> _Floats: ...

def symmetries_find(points: _Floats, normals: _Floats | None, tolerance: float) -> Symmetries: ...

# Features.

def features_voxel_downsample(
    points: _Floats,
    normals: _Floats | None,
    voxel: float,
    num_threads: int | None,
) -> tuple[_Floats, _Floats | None]: ...
def features_estimate_normals(
    points: _Floats,
    radius: float,
    max_neighbors: int,
    viewpoint: Sequence[float] | None,
    num_threads: int | None,
) -> _Floats: ...
def features_fpfh(
    points: _Floats,
    normals: _Floats,
    radius: float,
    max_neighbors: int,
    keypoints: _Ints | None,
    num_threads: int | None,
) -> npt.NDArray[np.float32]: ...
def features_match(
    src_feat: npt.NDArray[np.float32],
    tgt_feat: npt.NDArray[np.float32],
    k: int,
    mutual: bool,
    ratio: float | None,
    num_threads: int | None,
) -> tuple[_Ints, _Floats]: ...
def features_dominant_plane(
    points: _Floats,
    distance: float,
    min_share: float,
    viewpoint: Sequence[float] | None,
    seed: int,
    num_threads: int | None,
) -> tuple[list[float], float, npt.NDArray[np.bool_], float] | None: ...
def features_sample_mesh(
    vertices: _Floats, faces: _Ints, count: int | None, spacing: float, seed: int
) -> tuple[_Floats, _Floats]: ...
def features_outer_surface(
    points: _Floats,
    normals: _Floats,
    vertices: _Floats,
    faces: _Ints,
    num_views: int,
    max_angle_rad: float,
    lift: float | None,
    num_threads: int | None,
) -> npt.NDArray[np.bool_]: ...

# Metrics.

# ((truth hit, predicted hit), (recall, precision, f1), then one entry per prediction: truth row or -1,
# rotation error rad, translation error, distance, is hit)
_Scored: TypeAlias = tuple[
    tuple[int, int],
    tuple[float, float, float],
    _Ints,
    _Floats,
    _Floats,
    _Floats,
    npt.NDArray[np.bool_],
]

def metrics_rotation_error_rad(a: _Floats, b: _Floats, symmetries: Symmetries) -> float: ...
def metrics_translation_error(a: _Floats, b: _Floats, symmetries: Symmetries) -> float: ...
def metrics_frobenius_distance(a: _Floats, b: _Floats) -> float: ...
def metrics_add(model: _Floats, predicted: _Floats, truth: _Floats) -> float: ...
def metrics_add_s(model: _Floats, predicted: _Floats, truth: _Floats, num_threads: int | None) -> float: ...
def metrics_mssd(model: _Floats, predicted: _Floats, truth: _Floats, symmetries: Symmetries) -> float: ...
def metrics_diameter(points: _Floats, num_threads: int | None) -> float: ...
def metrics_assignment(cost: _Floats) -> _Ints: ...
def metrics_score_pose(
    predicted: _Floats,
    truth: _Floats,
    matching: str,
    rotation_rad: float,
    translation: float,
    symmetries: Symmetries,
    num_threads: int | None,
) -> _Scored: ...
def metrics_score_add_s(
    predicted: _Floats,
    truth: _Floats,
    matching: str,
    model: _Floats,
    diameter_fraction: float,
    symmetries: Symmetries,
    num_threads: int | None,
) -> _Scored: ...
def metrics_mssd_recall(
    predicted: _Floats,
    truth: _Floats,
    matching: str,
    model: _Floats,
    symmetries: Symmetries,
    num_threads: int | None,
) -> tuple[float, _Floats]: ...
def metrics_mean_score(
    matching: str, counts: Sequence[tuple[int, int, int, int]]
) -> tuple[float, float, float]: ...
