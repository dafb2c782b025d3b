"""What is wrong is named as the caller knows it, whatever it is."""

from pathlib import Path

import ibi_rs as ibi
import numpy as np
import pytest

TEE = Path(__file__).parents[1] / "examples/tee"
MESH = ibi.io.read_mesh(TEE / "model_tee_mesh.ply")
SCAN, _ = ibi.io.read_cloud(TEE / "tee6.ply")
MODEL = ibi.Model.from_mesh(*MESH)
SCENE = ibi.synth.outlier_layout(1, num_instances=2)
N = len(SCAN)
ARRAY = np.array(["find", "none"])


def register(corr):
    return ibi.register(SCENE.src, SCENE.tgt, corr)


def detect(**options):
    return MODEL.detect(SCAN, **{"viewpoint": [0, 0, 0], "timeout_s": 0, **options})


def score(matching):
    return ibi.metrics.score_scene([np.eye(4)], [np.eye(4)], matching=matching)


CASES = [
    (lambda: register(5), ibi.InputError, "corr has shape ()"),
    (lambda: register(np.array(5)), ibi.InputError, "corr has shape ()"),
    (lambda: register(np.float64(5)), ibi.InputError, "corr has shape ()"),
    (lambda: register(None), TypeError, "corr has dtype object"),
    (lambda: register(np.array(None)), TypeError, "corr has dtype object"),
    (lambda: detect(tgt_normals=5), ibi.InputError, "tgt_normals has shape ()"),
    (lambda: detect(tgt_normals=np.ones((3, 3))), ibi.InputError, "tgt_normals has 3 rows"),
    (lambda: detect(tgt_normals=np.zeros((N, 3))), ibi.InputError, "tgt_normals: 3815 of 3815 are 0"),
    (lambda: detect(remove_plane="no"), TypeError, "remove_plane must be a bool or None, not str"),
    (lambda: detect(remove_plane=0), TypeError, "remove_plane must be a bool or None, not int"),
    (lambda: detect(num_threads="two"), ValueError, "num_threads is 'two'; it must be an integer"),
    (lambda: ibi.Model.from_mesh(*MESH, symmetries=ARRAY), TypeError, "symmetries must be ibi_rs.Symmetries"),
    (lambda: ibi.Model.from_mesh(*MESH, symmetries="all"), ibi.InputError, "symmetries is 'all'; it must be"),
    (lambda: score(ARRAY), ValueError, "matching must be 'one_to_one' or 'any', not array("),
    (lambda: score(np.eye(4)), ValueError, "matching must be 'one_to_one' or 'any', not array("),
    (lambda: ibi.Symmetries(continuous=3), TypeError, "continuous must be a list of pairs, not int"),
    (lambda: ibi.Symmetries(continuous=[3]), ibi.InputError, "continuous[0] must be a pair (axis, offset)"),
    (lambda: ibi.Symmetries(continuous=["ab"]), ibi.InputError, "continuous[0] must be a pair"),
    (lambda: ibi.Symmetries.from_bop(3), TypeError, "info must be a dict or a path, not int"),
]


@pytest.mark.parametrize(("call", "kind", "start"), CASES, ids=[case[2][:45] for case in CASES])
def test_the_argument_is_named_in_one_line(call, kind, start):
    with pytest.raises(kind) as caught:
        call()
    assert str(caught.value).startswith(start)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("plane", [True, False])
def test_a_bool_of_numpy_is_one(plane):
    given, own = (
        detect(remove_plane=kind(plane), timeout_s=None, max_instances=1) for kind in (np.bool_, bool)
    )
    np.testing.assert_array_equal(np.asarray(given), np.asarray(own))
    assert given.labels.tolist() == own.labels.tolist()
