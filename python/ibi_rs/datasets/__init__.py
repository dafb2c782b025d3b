"""Scenes with their truth from the data sets of the field: readers, which download nothing.

Each reader is an iterable of scenes; meshes, scans and images are read when they are first asked for. Lengths
are those of the files: millimetres in BOP and ROBI, metres in Scan2CAD. Formats differ, a :class:`Scene` does
not: ``scene.points``, ``scene.viewpoint``, and of each kind of part ``part.kind.model()`` and ``part.poses``.

=============================== ==========================================================================
reader                          reads
=============================== ==========================================================================
:class:`Bop`                    folders of BOP, one camera or several
:class:`Scan2Cad`               its annotations, with meshes of ScanNet and models of ShapeNet
:class:`Robi`                   depth images of reflective parts in bins
:class:`ModelNet40`             meshes, scaled into the unit sphere: no scenes
:func:`read_correspondences`    what others have matched: NPZ or text
=============================== ==========================================================================

Images and meshes need ``pip install 'ibi_rs[data]'``.

Examples
--------
>>> from ibi_rs import datasets
>>> for scene in datasets.Bop("bop/ycbv"):                                           # doctest: +SKIP
...     for part in scene.parts:
...         found = part.kind.model().detect(**scene.inputs)
"""

from ibi_rs.datasets._bop import Bop
from ibi_rs.datasets._bop_results import (
    BopImage,
    BopScores,
    read_bop_results,
    score_bop,
    write_bop_results,
)
from ibi_rs.datasets._correspondences import Correspondences, read_correspondences, write_pair
from ibi_rs.datasets._modelnet import ModelNet40
from ibi_rs.datasets._robi import Robi
from ibi_rs.datasets._scan2cad import Scan2Cad
from ibi_rs.datasets._scene import Kind, Part, Scene

__all__ = [
    "Bop",
    "BopImage",
    "BopScores",
    "Correspondences",
    "Kind",
    "ModelNet40",
    "Part",
    "Robi",
    "Scan2Cad",
    "Scene",
    "read_bop_results",
    "read_correspondences",
    "score_bop",
    "write_bop_results",
    "write_pair",
]
