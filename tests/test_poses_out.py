"""Poses as files, plain data and messages of ROS."""

import json
import re
from dataclasses import replace
from pathlib import Path

import ibi_rs as ibi
import jsonschema
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).parents[1]
SCHEMA = json.loads((ROOT / "docs/poses.schema.json").read_text(encoding="utf-8"))
MESH = ibi.io.read_mesh(ROOT / "examples/tee/model_tee_mesh.ply")
SCAN = ibi.io.read_scan(ROOT / "examples/tee/tee6.ply").points
TEE = ibi.Model.from_mesh(*MESH, symmetries="find")
SCENE = ibi.synth.outlier_layout(1, num_instances=3, num_correspondences=600)


@pytest.fixture(scope="module")
def tees():
    return TEE.detect(SCAN, viewpoint=[0, 0, 0])


@pytest.fixture(scope="module")
def kinds():
    """Of two models, one of which is there."""
    models = ibi.Models({"tee": TEE, "half": ibi.Model.from_mesh(MESH[0] * 0.5, MESH[1])})
    return models.detect(SCAN, viewpoint=[0, 0, 0])


@pytest.fixture(scope="module")
def plain():
    return ibi.register(SCENE.src, SCENE.tgt, SCENE.corr)


def uncertain(seed):
    """A pose with a covariance, and its centre beside the model's origin."""
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3)
    root = rng.normal(size=(6, 6))
    found = ibi.register(SCENE.src, SCENE.tgt, SCENE.corr, max_instances=1)
    centre = matrix[:3, :3] @ [0.3, -0.2, 0.5] + matrix[:3, 3]
    return replace(found[0], target_from_source=matrix, centre=centre, covariance=root @ root.T)


# JSON and CSV --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["tees", "kinds", "plain"])
@pytest.mark.parametrize("run", [True, False])
def test_what_is_written_is_read_again(name, run, request, tmp_path):
    found = request.getfixturevalue(name)
    path = tmp_path / "found.json"
    found.save(path, unit="m", frame="camera", run=run)
    again = ibi.Registration.load(path)
    before, after = found.to_dict(unit="m", run=run), again.to_dict(unit="m", run=run)
    for one, two in zip(before.pop("models"), after.pop("models"), strict=True):
        assert one["name"] == two["name"]
        moved = [of["symmetries"].get("symmetries_discrete", []) for of in (one, two)]
        np.testing.assert_allclose(*moved, atol=1e-12)
    if run:
        parts = [data["run"].pop("parts") for data in (before, after)]
        assert list(parts[0]) == list(parts[1]) == list(found.models)
        assert [len(again.of(part)) for part in again.models] == [
            len(found.of(part)) for part in found.models
        ]
        np.testing.assert_array_equal(again.labels, found.labels)
        assert again.rounds == found.rounds
        assert again.timings == found.timings
        for one, two in zip(found, again, strict=True):
            assert one.measures == two.measures
    assert before == after
    np.testing.assert_array_equal(np.asarray(found), np.asarray(again))


def test_files_are_as_their_schema_says(tees, kinds, plain, tmp_path):
    check = jsonschema.validators.validator_for(SCHEMA)(SCHEMA).validate
    nothing = ibi.register(SCENE.src, SCENE.tgt, SCENE.corr[:0])
    for found in (tees, kinds, plain, nothing):
        for run in (True, False):
            check(json.loads(json.dumps(found.to_dict(unit="mm", run=run), allow_nan=False)))
    data = plain.to_dict()
    for name, value in (("version", 2), ("unit", "yd"), ("poses", [{}]), ("frame", 3)):
        with pytest.raises(Exception, match=r"expected|not one of|required|not of type"):
            check(json.loads(json.dumps(data | {name: value})))


def test_a_quaternion_is_that_of_the_matrix(plain):
    half_turns = [np.diag([1, -1, -1]), np.diag([-1, 1, -1]), np.diag([-1, -1, 1]), np.eye(3)]
    for turn in [*half_turns, *Rotation.random(50, random_state=0).as_matrix()]:
        matrix = np.eye(4)
        matrix[:3, :3] = turn
        plain.poses[0].target_from_source[:] = matrix
        (held, *_) = plain.to_dict()["poses"]
        assert held["quaternion_xyzw"][3] >= 0
        np.testing.assert_allclose(Rotation.from_quat(held["quaternion_xyzw"]).as_matrix(), turn, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "x"}, "must be an object with 'format': 'ibi_rs.poses'"),
        ({"version": 2}, "version is 2; this ibi_rs reads 1 to 1"),
        ({"version": "1"}, "version is '1'"),
        ({"poses": [{}]}, "has no 'target_from_source'"),
        ({"poses": [{"target_from_source": 3}]}, "poses[0].target_from_source is no (4, 4) matrix"),
        (
            {"poses": [{"target_from_source": (2 * np.eye(4)).tolist()}]},
            "poses[0].target_from_source is no rigid",
        ),
        ({"params": {"t_z": 1}}, "params: unknown field `t_z`"),
    ],
)
def test_what_is_no_registration_is_refused(plain, tmp_path, change, message):
    path = tmp_path / "poses.json"
    path.write_text(json.dumps(plain.to_dict() | change))
    with pytest.raises((ibi.InputError, ibi.ParamsError), match=re.escape(message)) as caught:
        ibi.Registration.load(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_names_that_mean_nothing_are_refused(plain, tmp_path):
    with pytest.raises(ibi.InputError, match=r"found\.yaml: registrations are written as \.json or \.csv"):
        plain.save(tmp_path / "found.yaml")
    with pytest.raises(ibi.InputError, match="unit is 'yd'; it must be one of m, cm"):
        plain.to_dict(unit="yd")


def test_a_callable_is_not_written():
    found = ibi.register(SCENE.src, SCENE.tgt, SCENE.corr, ibi.Params(hv=lambda context, pose: False))
    data = found.to_dict()
    assert data["params"] is None
    assert ibi.Registration.from_dict(data).params == ibi.Params()


# Poses that look the same ---------------------------------------------------------------------------------


def test_symmetric_parts_are_turned_least(tees):
    assert len(TEE.symmetries.discrete) == 2
    assert tees.symmetries == (TEE.symmetries,)
    for pose in tees:
        others = TEE.symmetries.equivalents(pose)
        traces = np.trace(others[:, :3, :3], axis1=1, axis2=2)
        assert np.argmax(traces) == 0


def test_parts_do_not_jump_from_frame_to_frame(tees):
    """The frame before had each of them the other way round."""
    flipped = np.array([TEE.symmetries.equivalents(pose)[1] for pose in tees])
    assert len(tees) == 6
    for reference in (flipped, ibi.Registration.from_dict(tees.to_dict())):
        if reference is not flipped:
            for pose, matrix in zip(reference, flipped, strict=True):
                pose.target_from_source[:] = matrix
        now = TEE.detect(SCAN, viewpoint=[0, 0, 0], reference=reference)
        np.testing.assert_allclose(np.asarray(now), flipped, atol=1e-9)
    # Without poses to compare with, as by default.
    again = TEE.detect(SCAN, viewpoint=[0, 0, 0], reference=np.empty((0, 4, 4)))
    np.testing.assert_array_equal(np.asarray(again), np.asarray(tees))
    with pytest.raises(ibi.InputError, match=r"reference has shape \(3, 3\)"):
        tees.canonical(TEE.symmetries, np.eye(3))


def test_low_scores_are_left_out(kinds):
    limit = sorted(pose.score for pose in kinds)[1]
    some = kinds.at_least(limit)
    assert [pose.score for pose in some] == [pose.score for pose in kinds if pose.score >= limit]
    rows = [row for row, pose in enumerate(kinds) if pose.score >= limit]
    for new, old in enumerate(rows):
        np.testing.assert_array_equal(some.labels == new, kinds.labels == old)
    assert sum(len(some.of(name)) for name in some.models) == len(some)
    assert len(kinds.at_least(0)) == len(kinds)
    with pytest.raises(ibi.InputError, match="score is 2; it must be from 0 to 1"):
        kinds.at_least(2)


# ROS -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("unit", ["m", "mm"])
def test_covariance_of_a_message_is_of_position_and_fixed_axes(unit):
    """The message's six numbers, differentiated by the motion that the pose's covariance is of."""
    pose = uncertain(3)
    metres = {"m": 1.0, "mm": 0.001}[unit]
    before = pose.target_from_source

    def six(motion):
        w, t = motion[:3], motion[3:]
        moved = before.copy()
        turn = Rotation.from_rotvec(w).as_matrix()
        moved[:3, 3] = pose.centre + turn @ (before[:3, 3] - pose.centre) + t
        moved[:3, :3] = turn @ before[:3, :3]
        # About the fixed axes of the scene's frame, from where it was.
        angles = Rotation.from_matrix(moved[:3, :3] @ before[:3, :3].T).as_euler("xyz")
        return np.concatenate([metres * moved[:3, 3], angles])

    step = 1e-5
    jacobian = np.column_stack([(six(step * e) - six(-step * e)) / (2 * step) for e in np.eye(6)])
    message = ibi.ros.pose_with_covariance(pose, unit=unit)
    held = np.reshape(message["covariance"], (6, 6))
    np.testing.assert_allclose(held, jacobian @ pose.covariance @ jacobian.T, rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(held, held.T)
    place = [message["pose"]["position"][axis] for axis in "xyz"]
    np.testing.assert_allclose(place, metres * before[:3, 3])
    turn = Rotation.from_quat([message["pose"]["orientation"][axis] for axis in "xyzw"])
    np.testing.assert_allclose(turn.as_matrix(), before[:3, :3], atol=1e-12)


def test_detections_have_the_fields_of_the_message(kinds):
    models = [TEE, ibi.Model.from_mesh(MESH[0] * 0.5, MESH[1])]
    array = ibi.ros.detection3d_array(kinds, "camera", stamp=(7, 8), models=models)
    header = {"stamp": {"sec": 7, "nanosec": 8}, "frame_id": "camera"}
    assert list(array) == ["header", "detections"]
    assert array["header"] == header
    assert len(array["detections"]) == len(kinds) > 0
    for detection, pose in zip(array["detections"], kinds, strict=True):
        assert list(detection) == ["header", "results", "bbox", "id"]
        assert detection["header"] == header
        (result,) = detection["results"]
        assert result["hypothesis"] == {"class_id": pose.model_name, "score": pose.score}
        assert result["pose"] == ibi.ros.pose_with_covariance(pose)
        part = models[pose.model].points
        corners = part @ pose.target_from_source[:3, :3].T + pose.target_from_source[:3, 3]
        box = detection["bbox"]
        turn = Rotation.from_quat([box["center"]["orientation"][axis] for axis in "xyzw"]).as_matrix()
        middle = np.array([box["center"]["position"][axis] for axis in "xyz"])
        size = [box["size"][axis] for axis in "xyz"]
        np.testing.assert_allclose(2 * np.abs((corners - middle) @ turn).max(axis=0), size, rtol=1e-9)
    json.dumps(array, allow_nan=False)


def test_a_pose_without_covariance_has_zeros(plain):
    assert plain[0].covariance is None
    assert ibi.ros.pose_with_covariance(plain[0])["covariance"] == [0.0] * 36


def test_wrong_numbers_of_models_are_refused(kinds, plain):
    with pytest.raises(ibi.InputError, match="models: there are 1; 2 were looked for"):
        ibi.ros.detection3d_array(kinds, "camera", models=TEE)
    with pytest.raises(ibi.InputError, match="class_ids: there are 2; 1 were looked for"):
        ibi.ros.detection3d_array(plain, "camera", class_ids=["a", "b"])
    with pytest.raises(ibi.InputError, match="unit is 'yd'"):
        ibi.ros.pose(plain[0], unit="yd")


def test_a_free_motion_is_read_again(tees):
    free = ibi.FreeMotion("turn", np.array([0.0, 0, 1]), np.array([1.0, 2, 3]), 0.5)
    found = tees.at_least(0)
    found.poses = (replace(found[0], free_motions=(free,), covariance=np.eye(6)),)
    (pose,) = ibi.Registration.from_dict(json.loads(json.dumps(found.to_dict())))
    assert pose.free_motions[0].to_dict() == free.to_dict()
    np.testing.assert_array_equal(pose.covariance, np.eye(6))
