"""How good predicted poses are: pose errors, and the scores of the field.

Two families of scores are in use, and their numbers cannot be compared. Each result carries its
``matching``, and `mean_score` refuses to mix them.

========== ============================================ =====================================
           ``"one_to_one"`` (ECC, IBI)                  ``"any"`` (PointCLM, MIRETR, 3DFMNet)
========== ============================================ =====================================
pairs      one optimal assignment, before any threshold every prediction with every truth
duplicates false positives                              free
MHF1       mean of the scenes' F1                       harmonic mean of MHR and MHP
========== ============================================ =====================================

A pose is a 4x4 rigid motion that moves the model into the scene (target_from_source), K of them an array
of shape (K, 4, 4); a `Registration` can be given in its place. Rates are fractions in [0, 1].

Examples
--------
>>> import numpy as np
>>> from ibi_rs import metrics
>>> truth = np.stack([np.eye(4), np.eye(4)])
>>> truth[1, 0, 3] = 5.0
>>> predicted = truth[[0, 0]]  # the first instance twice, the second not at all
>>> strict = metrics.score_scene(predicted, truth)
>>> strict.recall, strict.precision, strict.f1
(0.5, 0.5, 0.5)
>>> lenient = metrics.score_scene(predicted, truth, matching="any")
>>> lenient.recall, lenient.precision
(0.5, 1.0)
>>> metrics.mean_score([strict]).mhf1
0.5
"""

from ibi_rs.metrics._criteria import (
    ADD_S,
    ECC,
    MSSD_DIAMETER_FRACTIONS,
    POINTCLM_SCAN,
    AddS,
    Criterion,
    PoseThresholds,
    pointclm_voxels,
    strict,
)
from ibi_rs.metrics._errors import (
    add,
    add_s,
    assignment,
    diameter,
    frobenius_distance,
    mssd,
    rotation_error_deg,
    translation_error,
)
from ibi_rs.metrics._scores import (
    Matching,
    MeanScore,
    MssdRecall,
    PoseMatch,
    SceneScore,
    mean_score,
    mssd_recall,
    score_scene,
)

__all__ = [
    "ADD_S",
    "ECC",
    "MSSD_DIAMETER_FRACTIONS",
    "POINTCLM_SCAN",
    "AddS",
    "Criterion",
    "Matching",
    "MeanScore",
    "MssdRecall",
    "PoseMatch",
    "PoseThresholds",
    "SceneScore",
    "add",
    "add_s",
    "assignment",
    "diameter",
    "frobenius_distance",
    "mean_score",
    "mssd",
    "mssd_recall",
    "pointclm_voxels",
    "rotation_error_deg",
    "score_scene",
    "strict",
    "translation_error",
]
