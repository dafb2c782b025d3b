"""Multi-instance 3D registration: the 6-DoF pose of every copy of a model in a scene.

Start with :func:`register`. Lengths in :class:`Params` are multiples of the resolution ``pr`` of the clouds.
"""

from ibi_rs import datasets, features, io, metrics, plot, ros, stages, synth, viz
from ibi_rs._batch import register_batch
from ibi_rs._box import Box
from ibi_rs._core import InputError, ParamsError, __version__
from ibi_rs._detector import Detector
from ibi_rs._job import Job, JobError
from ibi_rs._match import match
from ibi_rs._matches import Matches
from ibi_rs._model import Model
from ibi_rs._models import Models, detect
from ibi_rs._ray import RayExecutor
from ibi_rs._register import register
from ibi_rs._view import View
from ibi_rs.params import Params
from ibi_rs.registration import (
    FreeMotion,
    Measures,
    Pose,
    Registration,
    Rejected,
    Round,
    StopReason,
    Timings,
    Verdict,
)
from ibi_rs.symmetries import Symmetries, find_symmetries
from ibi_rs.variants import (
    Evidence,
    Gsac,
    Gtm,
    Hough3d,
    InlierCount,
    Irls,
    LocalGtm,
    Mac,
    Nnsr,
    None_,
    Off,
    Overlap,
    Ransac,
    SacCot,
    Voting,
)

__all__ = [
    "Box",
    "Detector",
    "Evidence",
    "FreeMotion",
    "Gsac",
    "Gtm",
    "Hough3d",
    "InlierCount",
    "InputError",
    "Irls",
    "Job",
    "JobError",
    "LocalGtm",
    "Mac",
    "Matches",
    "Measures",
    "Model",
    "Models",
    "Nnsr",
    "None_",
    "Off",
    "Overlap",
    "Params",
    "ParamsError",
    "Pose",
    "Ransac",
    "RayExecutor",
    "Registration",
    "Rejected",
    "Round",
    "SacCot",
    "StopReason",
    "Symmetries",
    "Timings",
    "Verdict",
    "View",
    "Voting",
    "__version__",
    "datasets",
    "detect",
    "features",
    "find_symmetries",
    "io",
    "match",
    "metrics",
    "plot",
    "register",
    "register_batch",
    "ros",
    "stages",
    "synth",
    "viz",
]
