"""What is run, in the order of the table."""

from __future__ import annotations

from collections.abc import Iterable

import ibi_rs as ibi
from frame import ours
from frame.layouts import NO_NORMALS

from . import consac, ecc, kiss, open3d_ransac, opencv_ppf, pcl, pointclm, progx, tlinkage
from .contract import CORES, Method, Missing


def _ours(params: ibi.Params, num_threads: int, *, needs_normals: bool = False) -> Method:
    fixed: dict[str, object] = {"params": params, "num_threads": num_threads}
    return Method(ours, num_threads, fixed, needs_normals)


OURS = "ibi default, 1 thread"
"""Times are compared with this one's."""

METHODS = {
    OURS: _ours(ibi.Params(), 1),
    "ibi default, 2 threads": _ours(ibi.Params(), 2),
    "ibi default, no normals, 2 threads": _ours(*NO_NORMALS.values(), 2, needs_normals=True),
    "ibi paper_synthetic, 2 threads": _ours(ibi.Params.paper_synthetic(), 2),
    "PCL GC": Method(pcl, 1, {"method": "gc", "least": None}),
    "PCL GC + check": Method(pcl, 1, {"method": "gc"}),
    "PCL Hough3D": Method(pcl, 1, {"method": "hough", "least": None}),
    "PCL Hough3D + check": Method(pcl, 1, {"method": "hough"}),
    "Open3D RANSAC, sequence": Method(open3d_ransac, CORES),
    "KISS-Matcher, sequence": Method(kiss, CORES),
    "OpenCV PPF + check": Method(opencv_ppf, CORES),
    "ECC": Method(ecc, CORES),
    "T-Linkage": Method(tlinkage, CORES),
    "Progressive-X": Method(progx, CORES),
    "CONSAC": Method(consac, CORES),
    "PointCLM": Method(pointclm, CORES),
}
"""Every method by the name of its row."""

PAPER_ONLY = ("T-Linkage", "Progressive-X", "CONSAC", "PointCLM")
"""Run by paper_tables.py, beside the paper's figures; compare.py runs them only when they are named."""

LEARNED = ("CONSAC", "PointCLM")
"""Need weights and have their defaults for settings: there is nothing to choose them with."""


def available(names: Iterable[str]) -> tuple[dict[str, str], dict[str, str]]:
    """Return the versions of the methods that can run, and why the others cannot."""
    versions, missing = {}, {}
    for name in names:
        try:
            versions[name] = METHODS[name].module.version()
        except Missing as reason:
            missing[name] = str(reason)
    return versions, missing
