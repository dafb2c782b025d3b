"""What makes a pair of prediction and truth a hit, by the thresholds of the field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np


def _positive(value: float, name: str) -> None:
    # A string read from a file has no order; bool is an int to Python and never meant.
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError(f"{name} must be a number, not {type(value).__name__}")
    if not value > 0.0:
        raise ValueError(f"{name} must be above 0, not {value}")


@dataclass(frozen=True)
class PoseThresholds:
    """A pair is a hit if both its errors are below these.

    One to one, pairs are assigned by `frobenius_distance`.

    Parameters
    ----------
    rotation_deg : float
        Upper bound of the rotation error, in degrees; above 0.
    translation : float
        Upper bound of the translation error, in the unit of the data; above 0.
    """

    rotation_deg: float
    translation: float

    def __post_init__(self) -> None:
        _positive(self.rotation_deg, "rotation_deg")
        _positive(self.translation, "translation")


@dataclass(frozen=True)
class AddS:
    """A pair is a hit if its ADD-S is below a part of the model's diameter.

    For parts with symmetry, which pose errors punish for what cannot be seen. One to one, pairs are
    assigned by ADD-S.

    Parameters
    ----------
    diameter_fraction : float, default 0.1
        The part of the diameter; above 0.
    """

    diameter_fraction: float = 0.1

    def __post_init__(self) -> None:
        _positive(self.diameter_fraction, "diameter_fraction")


Criterion: TypeAlias = PoseThresholds | AddS
"""What makes a pair of prediction and truth a hit."""

ECC: Final = PoseThresholds(rotation_deg=20.0, translation=0.5)
"""20 deg and 0.5 data units: model radii on unit-sphere models, metres on scans.

Of ECC (Tang & Zou, "Multi-instance point cloud registration by efficient correspondence clustering",
CVPR 2022) and IBI, with ``matching="one_to_one"``.
"""

POINTCLM_SCAN: Final = PoseThresholds(rotation_deg=15.0, translation=0.1)
"""15 deg and 0.1 m, on real scans in metres.

Of PointCLM (Yuan et al., ECCV 2022), with ``matching="any"``.
"""

ADD_S: Final = AddS(diameter_fraction=0.1)
"""ADD-S below a tenth of the diameter (Hinterstoisser et al., ACCV 2012)."""

MSSD_DIAMETER_FRACTIONS: Final = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5)
"""The parts of the diameter at which MSSD recall is taken (Hodan et al., "BOP challenge 2020")."""


def pointclm_voxels(voxel: float) -> PoseThresholds:
    """15 deg and 4 voxels: PointCLM's thresholds, and after it MIRETR's, with ``matching="any"``.

    Parameters
    ----------
    voxel : float
        Size of the voxels the clouds were downsampled to, in the unit of the data.

    Returns
    -------
    PoseThresholds
    """
    _positive(voxel, "voxel")
    return PoseThresholds(rotation_deg=15.0, translation=4.0 * voxel)


def strict(resolution: float) -> PoseThresholds:
    """5 deg and one point resolution: whether a pose can be used as it is. From no paper.

    Parameters
    ----------
    resolution : float
        Mean distance of neighbouring points, in the unit of the data.

    Returns
    -------
    PoseThresholds
    """
    _positive(resolution, "resolution")
    return PoseThresholds(rotation_deg=5.0, translation=resolution)
