"""`Detector`: dicts of arrays in, dicts of arrays out."""

import pickle

import ibi_rs as ibi
import numpy as np
import pytest
import tiny_sets
from ibi_rs.synth.scene import move
from tiny_sets import BOX

MODEL = ibi.Model.from_mesh(*BOX)


def scan(seed):
    """Points of a box that is turned at random, as a camera at the origin sees it; its pose."""
    place = tiny_sets.pose(seed, 10 * (seed % 5), -10, 350)
    points, normals = ibi.features.sample_mesh(*BOX, n=1500, seed=seed)
    points, normals = move(place, points), normals @ place[:3, :3].T
    return points[(points * normals).sum(axis=1) < 0], place


def batch(seeds):
    """Scans of different lengths, as data frames hold them; read-only."""
    points = np.empty(len(seeds), object)
    for i, seed in enumerate(seeds):
        points[i] = scan(seed)[0]
        points[i].flags.writeable = False
    points.flags.writeable = False
    names = np.array([f"scan {seed}" for seed in seeds])
    return {"scan_id": names, "points": points, "viewpoint": np.zeros((len(seeds), 3)), "colour": names}


DETECT = ibi.Detector(MODEL, max_instances=1)


def test_a_row_is_a_pose():
    rows = DETECT(batch([1, 2, 3]))
    assert rows["scan_id"].tolist() == ["scan 1", "scan 2", "scan 3"]
    assert {name: column.dtype.kind for name, column in rows.items()} == {
        "scan_id": "U", "model": "U", "score": "f", "target_from_source": "f", "error": "U",
    }  # fmt: skip
    for seed, pose, score in zip(range(1, 4), rows["target_from_source"], rows["score"], strict=True):
        points, place = scan(seed)
        assert ibi.metrics.add_s(BOX[0], pose, place) < 4
        alone = MODEL.detect(points, viewpoint=[0, 0, 0], max_instances=1)
        np.testing.assert_array_equal(pose, alone[0].target_from_source)
        assert score == alone[0].score


def test_what_is_pickled_finds_the_same():
    again = pickle.loads(pickle.dumps(DETECT))
    for name, column in again(batch([3])).items():
        np.testing.assert_array_equal(column, DETECT(batch([3]))[name])
    assert repr(again) == "Detector(0)"


def test_several_kinds_are_told_by_their_names():
    detect = ibi.Detector({"tee": ibi.Model.from_mesh(*tiny_sets.tee()), "box": MODEL}, max_instances=1)
    assert "box" in detect(batch([4]))["model"].tolist()


@pytest.mark.parametrize("form", [np.ravel, np.ndarray.tolist, lambda x: np.array(list(x), object)])
def test_points_may_be_in_a_row_or_in_lists(form):
    held = batch([5])
    wanted = DETECT(held)["target_from_source"]
    points, normals = held["points"][0], np.empty(1, object)
    rows = DETECT({"points": [form(points)], "viewpoint": [[0.0, 0.0, 0.0]]})
    np.testing.assert_array_equal(rows["target_from_source"], wanted)
    assert rows["scan_id"].tolist() == [0]
    normals[0] = -points / np.linalg.norm(points, axis=1, keepdims=True)
    rows = DETECT({"points": [form(points)], "normals": [form(normals[0])], "viewpoint": np.zeros((1, 3))})
    assert rows["error"].tolist() in ([], [""])  # they were read, wrong as they are


def test_a_scan_that_is_wrong_costs_no_other():
    held = batch([6, 7])
    points = held["points"].copy()
    points[0] = np.ones((5, 2))
    rows = DETECT({**held, "points": points})
    assert rows["scan_id"].tolist() == ["scan 6", "scan 7"]
    assert rows["error"][0].startswith("tgt has shape (5, 2)")
    assert rows["error"][1] == ""
    assert np.isnan(rows["score"][0])
    assert np.isnan(rows["target_from_source"][0]).all()
    with pytest.raises(ibi.InputError, match=r"tgt has shape \(5, 2\)"):
        ibi.Detector(MODEL, errors="raise")({**held, "points": points})


def test_nothing_found_is_no_row():
    held = batch([8])
    rows = DETECT({**held, "points": [np.zeros((0, 3))]})
    assert {name: len(column) for name, column in rows.items()} == dict.fromkeys(rows, 0)
    assert rows["target_from_source"].shape == (0, 4, 4)
    assert len(DETECT({"points": []})["score"]) == 0


@pytest.mark.parametrize(
    ("call", "kind", "match"),
    [
        (lambda: DETECT({"scan": []}), ibi.InputError, "batch has no column 'points', but 'scan'"),
        (lambda: DETECT({"points": [], "scan_id": [1]}), ibi.InputError, "scan_id has 1 rows, points 0"),
        (lambda: ibi.Detector(MODEL, errors="skip"), ibi.InputError, "errors is 'skip'"),
        (lambda: ibi.Detector(MODEL, viewpoint=[0, 0, 0]), ibi.InputError, "viewpoint is no option"),
        (lambda: ibi.Detector(MODEL, {}), TypeError, "params must be ibi_rs.Params, not dict"),
        (lambda: ibi.Detector(ibi.Model(MODEL.points)), ibi.InputError, "has no normals"),
    ],
)
def test_what_is_wrong_is_named(call, kind, match):
    with pytest.raises(kind, match=match):
        call()
