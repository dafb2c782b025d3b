"""Seeded synthetic scenes with known truth, for tests, examples and benchmarks.

`outlier_layout` mixes true pairs with random outliers; `ecc_layout` matches noisy descriptors of clean
shapes: your own, or FPFH; `fpfh_layout` matches FPFH of the target as it is. Lengths are in radii of the
source shape, which lies in the unit sphere. The others give no correspondences but scans, in the unit of the
meshes: `pile_scene` of a heap, `bin_scene` and `row_scene` of a bin, `room_scene` of a room; `part_mesh` and
`furniture_mesh` give meshes for them. FPFH and scans need Open3D (``pip install 'ibi_rs[open3d]'``).
This package imports nothing else of `ibi_rs`.

Examples
--------
>>> from ibi_rs import synth
>>> synth.outlier_layout(7, num_instances=8).num_instances
8
"""

from .bins import Bin, bin_scene, row_scene
from .camera import DepthImage
from .ecc import ecc_layout
from .fpfh import fpfh_layout
from .outlier import outlier_layout
from .piles import Pile, pile_scene
from .rooms import Room, room_scene
from .scene import INLIER_DISTANCE, Scene
from .shapes import SHAPES, sample_mesh, shape
from .solids import FURNITURE, PARTS, furniture_mesh, part_mesh

__all__ = [
    "FURNITURE",
    "INLIER_DISTANCE",
    "PARTS",
    "SHAPES",
    "Bin",
    "DepthImage",
    "Pile",
    "Room",
    "Scene",
    "bin_scene",
    "ecc_layout",
    "fpfh_layout",
    "furniture_mesh",
    "outlier_layout",
    "part_mesh",
    "pile_scene",
    "room_scene",
    "row_scene",
    "sample_mesh",
    "shape",
]
