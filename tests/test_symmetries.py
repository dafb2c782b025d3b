"""Symmetries: as they are declared, found, and used."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import metrics

EXAMPLES = Path(__file__).parents[1] / "examples"
IDENTITY = np.eye(4)
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])
TEE = ibi.Symmetries([FLIP])
CAN = ibi.Symmetries([np.diag([1.0, -1.0, -1.0, 1.0])], [([0, 0, 2], [0, 0, 0])])
BALL = ibi.Symmetries(continuous=[([0, 0, 1], [0, 0, 0]), ([1, 0, 0], [0, 0, 0])])


def turn(degrees: float, axis: int = 2) -> np.ndarray:
    """Return a turn about an axis of the frame."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix, (i, j) = np.eye(4), [(axis + k) % 3 for k in (1, 2)]
    matrix[i, i] = matrix[j, j] = cos
    matrix[j, i], matrix[i, j] = sin, -sin
    return matrix


def shift(x: float, y: float, z: float) -> np.ndarray:
    """Return a translation."""
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def test_declared_symmetries_hold_arrays_that_cannot_be_changed():
    assert np.array_equal(TEE.discrete, [IDENTITY, FLIP])
    assert not TEE.continuous
    assert not TEE.is_none
    assert [axis.axis.tolist() for axis in CAN.continuous] == [[0, 0, 1]]
    assert len(BALL.continuous) == 3
    assert ibi.Symmetries.none().is_none
    assert ibi.Symmetries([IDENTITY]).is_none
    with pytest.raises(ValueError, match="read-only"):
        TEE.discrete[0, 0, 0] = 2.0
    with pytest.raises(AttributeError):
        TEE.discrete = IDENTITY
    assert repr(CAN) == "Symmetries(2 motions, any turn about [0, 0, 1])"
    assert repr(BALL) == "Symmetries(1 motion, any rotation)"
    for symmetries in (TEE, CAN, BALL):
        assert repr(pickle.loads(pickle.dumps(symmetries))) == repr(symmetries)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (
            lambda: ibi.Symmetries(FLIP),
            ibi.InputError,
            r"discrete has shape \(4, 4\); it must be \(S, 4, 4\)",
        ),
        (lambda: ibi.Symmetries([np.diag([1, 1, -1, 1])]), ibi.InputError, r"discrete\[0\] is a reflection"),
        (lambda: ibi.Symmetries([2 * IDENTITY]), ibi.InputError, r"discrete\[0\] is no rigid motion"),
        (lambda: ibi.Symmetries([shift(np.nan, 0, 0)]), ibi.InputError, r"discrete\[0\] must be finite"),
        (lambda: ibi.Symmetries([["a"]]), TypeError, "discrete"),
        (lambda: ibi.Symmetries(continuous=[[0, 0, 1]]), ibi.InputError, r"continuous\[0\] must be a pair"),
        (lambda: ibi.Symmetries(continuous=[([0, 0, 0], [0, 0, 0])]), ibi.InputError, "axis of length 0"),
        (
            lambda: ibi.Symmetries(continuous=[([0, 0, 1], [0, 0, 0]), ([0, 0, 1], [1, 0, 0])]),
            ibi.InputError,
            r"continuous\[1\] is a line that does not meet",
        ),
        (lambda: CAN.discretised(0), ibi.InputError, "max_step is 0; it must be from 1e-5 to 1"),
        (lambda: CAN.nearest(np.eye(3)), ibi.InputError, r"pose has shape \(3, 3\)"),
        (lambda: CAN.nearest(2 * IDENTITY), ValueError, r"pose\[0\]"),
        (lambda: ibi.find_symmetries(np.zeros((5, 3))), ibi.InputError, "at least 10"),
        (lambda: ibi.find_symmetries(np.zeros((50, 3)), tolerance=1), ibi.InputError, "tolerance is 1"),
        (lambda: ibi.Model(np.eye(3), symmetries=[FLIP]), TypeError, "symmetries must be ibi_rs.Symmetries"),
    ],
)
def test_what_is_no_symmetry_is_refused_in_one_line(make, error, message):
    with pytest.raises(error, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_bop_declarations_are_read_and_written(tmp_path):
    # As LM declares its glue: an ICP's result, rounded, and only nearly half a turn.
    glue = [-0.999633, 0.026679, 0.00479336, -0.262139, -0.0266744, -0.999644, 0.00100504, -0.0197966]
    glue += [0.00481847, 0.000876815, 0.999988, 0.0341178, 0, 0, 0, 1]
    line = {"axis": [0, 0, 1], "offset": [0, 5, 0]}
    path = tmp_path / "models_info.json"
    path.write_text(
        json.dumps({"1": {"symmetries_discrete": [glue]}, "2": {"symmetries_continuous": [line]}, "3": {}})
    )
    read = ibi.Symmetries.from_bop(path, 1, scale=0.001)
    expected = np.reshape(glue, (4, 4))
    expected[:3, 3] *= 0.001
    assert np.allclose(read.discrete[1], expected, atol=1e-5)
    assert np.allclose(read.discrete[1, :3, :3] @ read.discrete[1, :3, :3].T, np.eye(3), atol=1e-12)
    ((axis, offset),) = ibi.Symmetries.from_bop(path, 2, scale=0.001).continuous
    assert axis.tolist() == [0, 0, 1]
    assert np.allclose(offset, [0, 0.005, 0])
    assert ibi.Symmetries.from_bop(path, 3).is_none
    for symmetries in (TEE, CAN, read):
        again = ibi.Symmetries.from_bop(symmetries.to_bop(scale=0.5), scale=0.5)
        assert np.allclose(again.discrete, symmetries.discrete)
        assert len(again.continuous) == len(symmetries.continuous)
    assert ibi.Symmetries.none().to_bop() == {}
    with pytest.raises(ibi.InputError, match="has the objects 1, 2, 3; give one"):
        ibi.Symmetries.from_bop(path)
    with pytest.raises(ibi.InputError, match="obj_id is 7"):
        ibi.Symmetries.from_bop(path, 7)
    with pytest.raises(ibi.InputError, match="cannot be read"):
        ibi.Symmetries.from_bop(tmp_path / "none.json")
    with pytest.raises(ibi.InputError, match=r"symmetries_discrete\[0\] has 3 numbers"):
        ibi.Symmetries.from_bop({"symmetries_discrete": [[1, 2, 3]]})
    with pytest.raises(ibi.InputError, match=r"symmetries_continuous\[0\] must have"):
        ibi.Symmetries.from_bop({"symmetries_continuous": [{"axis": [0, 0, 1]}]})


def test_listed_turns_are_those_of_bop():
    listed = CAN.discretised()
    assert listed.shape == (2 * 315, 4, 4)
    assert np.array_equal(listed[0], IDENTITY)
    # No point half a diameter from the axis moves more than 0.01 diameters to the next turn.
    at_rim = listed @ [0.5, 0, 0, 1]
    nearest = np.sort(np.linalg.norm(at_rim[:, None] - at_rim, axis=2))[:, 2]
    assert nearest.max() <= 0.01
    pose = shift(1, 2, 3) @ turn(40, axis=0)
    assert np.allclose(CAN.equivalents(pose, 0.1), pose @ CAN.discretised(0.1))


def test_the_nearest_pose_is_the_one_turned_least():
    pose = shift(1, 2, 3) @ turn(170)
    assert np.allclose(TEE.nearest(pose), shift(1, 2, 3) @ turn(-10))
    assert np.allclose(CAN.nearest(pose), shift(1, 2, 3))
    assert np.allclose(CAN.nearest(pose, turn(170)), pose)
    # A can upside down, tilted by 20 degrees.
    assert np.allclose(CAN.nearest(turn(200, axis=0) @ turn(77)), turn(20, axis=0))
    assert np.allclose(BALL.nearest(pose), shift(1, 2, 3))
    several = np.stack([pose, IDENTITY])
    assert np.allclose(TEE.nearest(several), [shift(1, 2, 3) @ turn(-10), IDENTITY])


def test_errors_are_those_of_the_nearest_pose():
    truth, seen = shift(1, 2, 3), shift(1, 2, 3.5) @ turn(183)
    assert metrics.rotation_error_deg(seen, truth) == pytest.approx(177)
    assert metrics.rotation_error_deg(seen, truth, symmetries=TEE) == pytest.approx(3)
    assert metrics.rotation_error_deg(seen, truth, symmetries=[FLIP]) == pytest.approx(3)
    assert metrics.translation_error(seen, truth, symmetries=CAN) == pytest.approx(0.5)
    # About a middle that is not the origin.
    aside = shift(0, 4, 0) @ FLIP @ shift(0, -4, 0)
    assert metrics.translation_error(aside, IDENTITY) == pytest.approx(8)
    assert metrics.translation_error(aside, IDENTITY, symmetries=[aside]) == pytest.approx(0)
    strict = metrics.PoseThresholds(5, 1)
    assert metrics.score_scene([seen], [truth], criterion=strict).num_truth_hit == 0
    score = metrics.score_scene([seen], [truth], criterion=strict, symmetries=TEE)
    assert score.num_truth_hit == 1
    assert score.matches[0].rotation_error_deg == pytest.approx(3)
    points = np.random.default_rng(0).normal(size=(50, 3))
    both = np.concatenate([points, points @ FLIP[:3, :3]])
    score = metrics.score_scene([seen], [truth], criterion=metrics.ADD_S, model=both, symmetries=TEE)
    assert score.matches[0].rotation_error_deg == pytest.approx(3)
    assert metrics.mssd(both, FLIP, IDENTITY, symmetries=TEE) == pytest.approx(0, abs=1e-12)
    assert metrics.mssd(both, turn(123.4), IDENTITY, symmetries=CAN) == pytest.approx(0, abs=1e-7)
    assert metrics.mssd(both, turn(50) @ turn(20, axis=1), IDENTITY, symmetries=BALL) == pytest.approx(0)
    recall = metrics.mssd_recall([turn(123.4)], [IDENTITY], model=both, symmetries=CAN)
    assert recall.average == 1.0


@pytest.fixture(scope="module")
def tee() -> ibi.Model:
    mesh = ibi.io.read_mesh(EXAMPLES / "tee/model_tee_mesh.ply")
    return ibi.Model.from_mesh(*mesh, symmetries="find")


def test_finds_half_a_turn_of_the_tee_and_none_of_the_lopsided_box(tee):
    assert len(tee.symmetries.discrete) == 2
    assert not tee.symmetries.continuous
    assert metrics.rotation_error_deg(tee.symmetries.discrete[1], IDENTITY) == pytest.approx(180)
    found = tee.find_symmetries()
    assert metrics.rotation_error_deg(found.discrete[1], tee.symmetries.discrete[1]) < 2
    assert len(pickle.loads(pickle.dumps(tee)).symmetries.discrete) == 2
    box = ibi.Model.from_mesh(*ibi.io.read_mesh(EXAMPLES / "provete2/model_provete2_mesh.ply"))
    assert box.find_symmetries().is_none
    assert box.symmetries.is_none
    with pytest.raises(ibi.InputError, match="'find' or Symmetries"):
        ibi.Model.from_mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], symmetries="search")


def test_a_search_does_not_depend_on_the_unit(tee):
    found = ibi.find_symmetries(1000 * tee.points + 5, tee.normals)
    assert metrics.rotation_error_deg(found.discrete[1], tee.find_symmetries().discrete[1]) < 0.1


def test_declared_symmetries_change_no_pose_of_the_tee_scan(tee):
    scan, _ = ibi.io.read_cloud(EXAMPLES / "tee/tee6.ply")
    plain = ibi.Model(tee.points, normals=tee.normals)
    matches = tee.correspond(scan, viewpoint=[0, 0, 0])
    options = {"tgt_normals": matches.tgt_normals, "viewpoint": [0, 0, 0]}
    params = ibi.Params.single_view()
    found = [model.register(matches.tgt, matches.corr, params, **options) for model in (plain, tee)]
    # The same look, each turned least.
    turned = found[0].canonical(tee.symmetries)
    assert np.array_equal(np.asarray(turned), np.asarray(found[1]))
    for before, after in zip(found[0], turned, strict=True):
        errors = (metrics.rotation_error_deg(p.target_from_source, IDENTITY) for p in (after, before))
        assert next(errors) <= next(errors) + 1e-9
        assert (
            metrics.add_s(tee.points, before.target_from_source, after.target_from_source)
            < 0.03 * tee.diameter  # of points between which it moves them
        )
        assert after.score == before.score


def test_of_two_poses_that_look_the_same_the_better_stays():
    rng = np.random.default_rng(3)
    half = rng.normal(size=(40, 3)) + np.array([1, 0, 0])
    src = np.concatenate([half, half @ FLIP[:3, :3]])
    tgt = src + np.array([9, 1, 2])
    rows = np.arange(80)
    corr = np.concatenate([np.column_stack([rows, rows]), np.column_stack([(rows + 40) % 80, rows])])
    # As the paper removes duplicates: not at all.
    params = ibi.Params.paper_synthetic().replace(hv=ibi.None_(), ce=ibi.Voting(n_vot=60))
    without, declared = ibi.Model(src), ibi.Model(src, symmetries=TEE)
    found, kept = (model.register(tgt, corr, params) for model in (without, declared))
    assert len(found) > 1
    assert len(kept) == 1
    assert np.array_equal(kept[0].target_from_source, found[0].target_from_source)
    assert kept.labels.max() == 0


def test_the_command_gives_poses_turned_least_and_scores_modulo_symmetry(tmp_path):
    typer_testing = pytest.importorskip("typer.testing")
    cli = pytest.importorskip("ibi_rs.cli")

    def run(*arguments):
        return typer_testing.CliRunner().invoke(cli.app, list(map(str, arguments)))

    mesh, scan = EXAMPLES / "tee/model_tee_mesh.ply", EXAMPLES / "tee/tee6.ply"
    half_turn = [-1, 0, 0, 34, 0, 1, 0, 0, 0, 0, -1, 62, 0, 0, 0, 1]  # mm, and the mesh is in metres
    info = tmp_path / "models_info.json"
    info.write_text(
        json.dumps({"1": {"diameter": 70}, "5": {"diameter": 70, "symmetries_discrete": [half_turn]}})
    )
    poses = tmp_path / "poses.json"
    result = run("register", mesh, scan, "--symmetries", f"{info}:5", "-o", poses)
    assert result.exit_code == 0
    assert "modulo Symmetries(2 motions)" in result.stdout
    held = [np.array(pose["target_from_source"]) for pose in json.loads(poses.read_text())["poses"]]
    symmetries = ibi.Symmetries.from_bop(info, 5, scale=0.001)
    assert len(held) == 6
    assert np.allclose(symmetries.nearest(held), held)
    truth = tmp_path / "truth.npy"
    np.save(truth, symmetries.nearest(held, turn(180)))
    plain = run("eval", poses, truth, mesh)
    assert "MSSD" not in plain.stdout
    for given in ("find", f"{info}:5"):
        scored = run("eval", poses, truth, mesh, "--symmetries", given).stdout
        assert "MSSD       1.000" in scored
        assert float(scored.split("median, ")[1].split()[0]) < 2
    assert "MSSD       0." in run("eval", poses, truth, mesh, "--symmetries", "none").stdout
    failed = run("register", mesh, scan, "--symmetries", info)
    assert failed.exit_code == 1
    assert "has the objects 1, 5; give one of them" in failed.stderr
