"""`Model.from_mesh` and `Model.detect`: from a mesh and a scan to poses, and what they refuse."""

import pickle
import sys
from pathlib import Path
from types import SimpleNamespace

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import metrics
from test_features import box

EXAMPLES = Path(__file__).parents[1] / "examples"
CAMERA = [0, 0, 0]


def example(name):
    """Mesh, scan as it was taken, labelled poses."""
    folder = EXAMPLES / ("tee" if name == "tee6" else "provete2")
    with np.load(folder / f"{name}.npz") as file:
        poses = file["poses"]
    mesh = ibi.io.read_mesh(next(folder.glob("model_*_mesh.ply")))
    return mesh, ibi.io.read_cloud(folder / f"{name}.ply")[0], poses


@pytest.fixture(scope="module")
def tee():
    return ibi.Model.from_mesh(*ibi.io.read_mesh(EXAMPLES / "tee/model_tee_mesh.ply"))


@pytest.mark.parametrize(("name", "hits", "most"), [("tee6", 6, 6), ("two", 1, 2), ("multi", 4, 6)])
def test_the_labelled_parts_are_found(name, hits, most):
    # In `multi` parts without a label can be seen. In `two` the second pose is wrong: half a turn about the
    # normal of the face that it lies on, and 30 mm off.
    mesh, scan, labels = example(name)
    model = ibi.Model.from_mesh(*mesh)
    found = model.detect(scan, viewpoint=CAMERA)
    score = metrics.score_scene(found, labels, criterion=metrics.ADD_S, model=model.points)
    assert score.num_truth_hit >= hits
    assert len(found) <= most


def test_detect_is_correspond_and_register(tee):
    _, scan, _ = example("tee6")
    tgt, tgt_normals, corr, similarity = tee.correspond(scan, viewpoint=CAMERA)
    assert len(tgt) < len(scan)
    assert corr.shape == (4 * len(tgt), 2)
    assert similarity.shape == (len(corr),)
    np.testing.assert_allclose(np.linalg.norm(tgt_normals, axis=1), 1)
    assert np.einsum("ij,ij->i", tgt_normals, tgt).max() <= 1e-12  # towards the camera
    by_hand = tee.register(
        tgt,
        corr,
        ibi.Params.single_view(),
        tgt_normals=tgt_normals,
        similarity=similarity,
        viewpoint=ibi.View(CAMERA, scan),
    )
    np.testing.assert_array_equal(tee.detect(scan, viewpoint=CAMERA), by_hand)


def test_a_stage_of_ones_own_sees_what_is_registered(tee):
    _, scan, _ = example("tee6")
    matches = tee.correspond(scan, viewpoint=CAMERA)
    seen = []

    def nothing(context, dense):
        seen.append((context.tgt_points, context.src, context.tgt))

    params = ibi.Params.single_view().replace(te=nothing, max_rounds=2)
    found = tee.detect(scan, params, viewpoint=CAMERA)
    assert (len(found), found.stop_reason.name, found.params) == (0, "max_rounds", params)
    assert len(seen) == 2
    for points, src, tgt in seen:
        np.testing.assert_array_equal(points, matches.tgt)
        np.testing.assert_array_equal(src, tee.points[matches.corr[:, 0]])
        np.testing.assert_array_equal(tgt, matches.tgt[matches.corr[:, 1]])

    def broken(context, dense):
        raise KeyError("broken")

    with pytest.raises(KeyError, match="broken"):
        tee.detect(scan, params.replace(te=broken), viewpoint=CAMERA)


def test_a_callback_sees_the_rounds_and_may_end_them(tee):
    _, scan, _ = example("tee6")
    rounds = []
    found = tee.detect(scan, viewpoint=CAMERA, callback=lambda one: rounds.append(one) or len(rounds) < 3)
    assert (found.rounds, found.stop_reason.name) == (tuple(rounds), "cancelled")
    with pytest.raises(TypeError, match="callback must be callable"):
        tee.detect(scan, viewpoint=CAMERA, callback=3)


def test_threads_and_pickling_change_nothing(tee):
    _, scan, _ = example("tee6")
    found = tee.detect(scan, viewpoint=CAMERA, num_threads=2)
    again = pickle.loads(pickle.dumps(tee))
    assert again.voxel == tee.voxel
    np.testing.assert_array_equal(again.detect(scan, viewpoint=CAMERA, num_threads=1), found)


def test_a_scan_in_millimetres_gives_the_same_parts():
    (vertices, faces), scan, labels = example("multi")
    model = ibi.Model.from_mesh(1000 * vertices, faces)
    found = np.array(model.detect(1000 * scan, viewpoint=CAMERA))
    found[:, :3, 3] /= 1000
    score = metrics.score_scene(found, labels, criterion=metrics.ADD_S, model=model.points / 1000)
    assert score.num_truth_hit == 4


def on_a_table(scan, share=1.0):
    """The scan with a table below: a grid behind all of it, as the camera sees it."""
    low, high = scan.min(axis=0), scan.max(axis=0)
    x, y = np.mgrid[low[0] : high[0] : 0.003, low[1] : high[1] : 0.003]
    return np.concatenate([scan, np.column_stack([x.ravel(), y.ravel(), np.full(x.size, high[2] + 0.004)])])


def test_a_table_goes_and_parts_stay(tee):
    _, scan, labels = example("tee6")
    matches = tee.correspond(on_a_table(scan), viewpoint=CAMERA)
    assert matches.tgt[:, 2].max() < scan[:, 2].max() + 0.002
    kept = tee.correspond(on_a_table(scan), viewpoint=CAMERA, remove_plane=False)
    assert len(kept.tgt) > len(matches.tgt)
    # Without a table nothing goes, unless it is asked for.
    whole = tee.correspond(scan, viewpoint=CAMERA)
    assert len(whole.tgt) == len(tee.correspond(scan, viewpoint=CAMERA, remove_plane=False).tgt)
    assert len(whole.tgt) > len(tee.correspond(scan, viewpoint=CAMERA, remove_plane=True).tgt)
    found = tee.detect(on_a_table(scan), viewpoint=CAMERA)
    score = metrics.score_scene(found, labels, criterion=metrics.ADD_S, model=tee.points)
    assert score.num_truth_hit >= 5


def test_a_mesh_is_an_object_or_arrays():
    vertices, faces = box(np.array([3.0, 2.0, 1.0]))
    of_arrays = ibi.Model.from_mesh(vertices, faces)
    of_trimesh = ibi.Model.from_mesh(SimpleNamespace(vertices=vertices, faces=faces))
    of_open3d = ibi.Model.from_mesh(SimpleNamespace(vertices=vertices, triangles=faces))
    np.testing.assert_array_equal(of_arrays.points, of_trimesh.points)
    np.testing.assert_array_equal(of_arrays.points, of_open3d.points)
    assert of_arrays.voxel == pytest.approx(of_arrays.diameter / 24, rel=0.05)
    assert of_arrays.normals.shape == of_arrays.points.shape


def test_a_model_of_points_has_a_voxel_too():
    points, _ = ibi.features.voxel_downsample(
        np.random.default_rng(0).uniform(size=(40_000, 3)) * [1, 1, 0], 0.05
    )
    assert ibi.Model(points).voxel == pytest.approx(0.05, rel=0.3)


MODEL = ibi.Model.from_mesh(*box(np.ones(3)))
SCAN = np.random.default_rng(0).normal(size=(500, 3))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ibi.Model.from_mesh(SCAN), "faces: the mesh has none"),
        (lambda: ibi.Model.from_mesh(SimpleNamespace(vertices=SCAN, faces=[])), "faces: the mesh has none"),
        (lambda: ibi.Model.from_mesh(SCAN, [[0, 1, 500]]), "faces"),
        (lambda: ibi.Model.from_mesh(*box(np.ones(3)), voxel=0), "voxel"),
        (lambda: ibi.Model.from_mesh(*box(np.ones(3)), voxel=1e-9), "voxel: at 1e-09 about [0-9]+ points"),
        (lambda: ibi.Model(SCAN).detect(SCAN, viewpoint=CAMERA), "src_normals: detection needs them"),
        (lambda: MODEL.detect(SCAN), "viewpoint: give it"),
        (lambda: MODEL.detect(SCAN * 1000, viewpoint=CAMERA), "same unit"),
        (lambda: MODEL.detect(SCAN * 0.001, viewpoint=CAMERA), "same unit"),
        (lambda: MODEL.detect(SCAN, viewpoint=[0, 0]), "viewpoint"),
    ],
)
def test_bad_input_is_refused_by_name(call, message):
    with pytest.raises(ibi.InputError, match=message):
        call()


def test_the_page_has_the_figures_of_the_record():
    root = Path(__file__).parents[1]
    sys.path.insert(0, str(root / "benchmarks"))
    from detect import RECORD, markdown
    from frame import records

    table = markdown(records.read(records.RECORDS / RECORD))
    assert table in (root / "docs/features.md").read_text(encoding="utf-8"), "run benchmarks/detect.py --docs"


@pytest.mark.parametrize("count", [3, 4, 1001])
def test_numbers_at_the_end_of_the_floats_do_not_overflow(tee, count):
    # Found by `make fuzz`: the mean of the middle two of an even number is beyond them.
    points = np.full((count, 3), np.finfo(float).max / 2)
    with pytest.raises(ibi.InputError, match="below 1e100"):
        tee.detect(points, viewpoint=CAMERA)
