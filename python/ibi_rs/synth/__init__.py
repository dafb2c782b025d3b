"""Seeded synthetic scenes with known truth, for tests, examples and benchmarks.

`outlier_layout` mixes true pairs with random outliers; `ecc_layout` matches noisy descriptors of clean
shapes: your own, or FPFH; `fpfh_layout` matches FPFH of the target as it is. Lengths are in radii of the
source shape, which lies in the unit sphere. `pile_scene` gives no correspondences but the scan of a heap, in
the unit of its mesh. FPFH and piles need Open3D (``pip install 'ibi_rs[open3d]'``).
This package imports nothing else of `ibi_rs`.

Examples
--------
>>> from ibi_rs import synth
>>> synth.outlier_layout(7, num_instances=8).num_instances
8
"""

from .ecc import ecc_layout
from .fpfh import fpfh_layout
from .outlier import outlier_layout
from .piles import Pile, pile_scene
from .scene import INLIER_DISTANCE, Scene
from .shapes import SHAPES, sample_mesh, shape

__all__ = [
    "INLIER_DISTANCE",
    "SHAPES",
    "Pile",
    "Scene",
    "ecc_layout",
    "fpfh_layout",
    "outlier_layout",
    "pile_scene",
    "sample_mesh",
    "shape",
]
