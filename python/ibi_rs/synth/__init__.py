"""Seeded synthetic scenes with known truth, for tests, examples and benchmarks.

`outlier_layout` mixes true pairs with random outliers; `ecc_layout` matches noisy descriptors of clean
shapes: your own, or FPFH; `fpfh_layout` matches FPFH of the target as it is. For FPFH they need Open3D
(``pip install 'ibi_rs[open3d]'``). Lengths are in radii of the source shape, which lies in the unit sphere.
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
from .scene import INLIER_DISTANCE, Scene
from .shapes import SHAPES, sample_mesh, shape

__all__ = [
    "INLIER_DISTANCE",
    "SHAPES",
    "Scene",
    "ecc_layout",
    "fpfh_layout",
    "outlier_layout",
    "sample_mesh",
    "shape",
]
