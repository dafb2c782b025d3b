"""The command: what it prints, writes and refuses."""

import csv
import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import ibi_rs as ibi
import numpy as np
import pytest
import trimesh
from ibi_rs import cli, io
from scipy.spatial.transform import Rotation
from test_process import LIMIT_S
from test_viz import NO_RERUN
from typer.testing import CliRunner

TEE = Path(__file__).parents[1] / "examples/tee"
MESH, SCAN = str(TEE / "model_tee_mesh.ply"), str(TEE / "tee6.ply")


def run(*arguments):
    return CliRunner().invoke(cli.app, list(map(str, arguments)))


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    folder = tmp_path_factory.mktemp("found")
    paths = [folder / name for name in ("poses.json", "poses.csv", "found.png")]
    result = run("register", MESH, SCAN, "-o", paths[0], "--bop", paths[1], "--plot", paths[2])
    return result, paths


def test_a_mesh_and_a_scan_give_a_table_and_files(found):
    result, (poses, bop, picture) = found
    assert result.exit_code == 0
    assert "6 found in" in result.stdout
    held = json.loads(poses.read_text())["poses"]
    assert len(held) == 6
    with bop.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["scene_id", "im_id", "obj_id", "score", "R", "t", "time"]
    for row, pose in zip(rows, held, strict=True):
        matrix = np.array(pose["target_from_source"])
        np.testing.assert_allclose(np.fromstring(row["R"], sep=" ").reshape(3, 3), matrix[:3, :3], atol=1e-8)
        np.testing.assert_allclose(np.fromstring(row["t"], sep=" "), 1000 * matrix[:3, 3], rtol=1e-7)
    assert sorted(rows, key=lambda row: -float(row["score"])) == rows
    assert picture.read_bytes().startswith(b"\x89PNG")


def shifts(path):
    with path.open(newline="") as file:
        return np.array([np.fromstring(row["t"], sep=" ") for row in csv.DictReader(file)])


@pytest.mark.parametrize(
    ("scale", "unit"), [(1000, ()), (100, ("--unit", "cm")), (1 / 0.0254, ("--unit", "in"))]
)
def test_the_csv_is_in_millimetres_whatever_the_unit(found, tmp_path, scale, unit):
    part, scan = trimesh.load(MESH), ibi.io.read_cloud(SCAN)[0]
    trimesh.Trimesh(part.vertices * scale, part.faces, process=False).export(tmp_path / "part.ply")
    np.save(tmp_path / "scan.npy", scan * scale)
    for words in (("register", "part.ply", "scan.npy"), ("batch", "part.ply", "scan.npy")):
        files = [tmp_path / word if "." in word else word for word in words]
        result = run(*files, "--bop", tmp_path / "a.csv", "--viewpoint", "0,0,0", *unit)
        assert result.exit_code == 0, result.output
        wanted, told = shifts(found[1][1]), shifts(tmp_path / "a.csv")
        assert len(told) == len(wanted)
        assert all(np.linalg.norm(wanted - one, axis=1).min() < 2 for one in told)


def test_a_unit_that_cannot_be_told_is_asked_for(tmp_path):
    part = trimesh.load(MESH)
    trimesh.Trimesh(part.vertices * 50, part.faces, process=False).export(tmp_path / "part.ply")
    result = run("register", tmp_path / "part.ply", SCAN, "--bop", tmp_path / "a.csv")
    assert result.exit_code == 2
    assert "may be in mm or m; say --unit" in result.stderr
    result = run("register", MESH, SCAN, "--bop", tmp_path / "a.csv", "--unit", "ell")
    assert result.exit_code == 2
    assert "--unit: unit is 'ell'; it must be one of m, cm, mm" in result.stderr


def test_eval_scores_what_register_wrote(found, tmp_path):
    _, (poses, *_) = found
    with np.load(TEE / "tee6.npz") as file:
        np.save(tmp_path / "truth.npy", file["poses"])
    result = run("eval", poses, tmp_path / "truth.npy", MESH)
    assert result.exit_code == 0
    assert "recall     1.000  (6 of 6)" in result.stdout
    assert "precision  1.000  (6 of 6)" in result.stdout


def test_own_correspondences_are_registered(tmp_path):
    scene = ibi.synth.outlier_layout(1, num_instances=5)
    for name, array in (("src", scene.src), ("tgt", scene.tgt), ("corr", scene.corr)):
        np.save(tmp_path / f"{name}.npy", array)
    files = [tmp_path / f"{name}.npy" for name in ("src", "tgt")]
    result = run("register", *files, "--corr", tmp_path / "corr.npy", "--max-instances", 3)
    assert result.exit_code == 0
    assert "3 found in" in result.stdout
    assert "stopped by max_instances" in result.stdout


def test_nothing_found_has_a_code_of_its_own(tmp_path):
    x, y = np.mgrid[-0.2:0.2:0.003, -0.2:0.2:0.003]
    np.save(
        tmp_path / "waves.npy",
        np.stack([x, y, 0.7 + 0.02 * np.sin(30 * x) * np.cos(30 * y)], axis=-1).reshape(-1, 3),
    )
    result = run("register", MESH, tmp_path / "waves.npy")
    assert result.exit_code == cli.FOUND_NOTHING
    assert "0 found" in result.stdout


def test_one_value_is_changed_on_what_fits_the_scene(tmp_path):
    """However it is said, the rest stays that of `single_view`, with which six are found."""
    (tmp_path / "hv.toml").write_text("[hv]\nt_score = 0.9")
    (tmp_path / "based.json").write_text('{"base": "single_view", "hv": {"t_score": 0.9}}')
    wanted = ibi.Params.single_view().replace(hv={"t_score": 0.9})
    for number, options in enumerate(
        (
            ("--set", "hv.t_score=0.9"),
            ("--params", tmp_path / "hv.toml"),
            ("--params", tmp_path / "hv.toml", "--preset", "single_view"),
            ("--params", tmp_path / "based.json", "--preset", "default"),
        )
    ):
        result = run("register", MESH, SCAN, "-o", tmp_path / f"{number}.json", *options)
        assert result.exit_code == 0, result.output
        held = json.loads((tmp_path / f"{number}.json").read_text())
        assert held["params"] == wanted.to_dict()
        assert 0 < len(held["poses"]) < 6


def test_set_takes_words_numbers_and_none(tmp_path):
    settings = (
        "te=mac",
        "te.t_cmp=.5",
        "hv=none",
        "max_rejections=none",
        "max_rounds=3",
        "joint_check=False",
    )
    options = [word for setting in settings for word in ("--set", setting)]
    run("register", MESH, SCAN, "-o", tmp_path / "p.json", "--preset", "default", *options)
    wanted = ibi.Params(
        te=ibi.Mac(t_cmp=0.5), hv="none", max_rejections=None, max_rounds=3, joint_check=False
    )
    assert json.loads((tmp_path / "p.json").read_text())["params"] == wanted.to_dict()


def test_poses_are_written_as_csv_in_a_unit(found, tmp_path):
    _, (poses, *_) = found
    held = json.loads(poses.read_text())["poses"]
    options = ("-o", tmp_path / "p.csv", "--bop", tmp_path / "bop.csv", "--unit", "cm")
    assert run("register", MESH, SCAN, *options).exit_code == 0
    rows = list(csv.DictReader((tmp_path / "p.csv").read_text().splitlines()))
    bop = list(csv.DictReader((tmp_path / "bop.csv").read_text().splitlines()))
    for row, mm, pose in zip(rows, bop, held, strict=True):
        place = np.array(pose["target_from_source"])[:3, 3]
        np.testing.assert_allclose([float(row[axis]) for axis in "xyz"], place, rtol=1e-8)
        np.testing.assert_allclose(np.fromstring(mm["t"], sep=" "), 10 * place, rtol=1e-7)
        turn = Rotation.from_quat([float(row[f"q{axis}"]) for axis in "xyzw"]).as_matrix()
        np.testing.assert_allclose(turn, np.array(pose["target_from_source"])[:3, :3], atol=1e-7)


def test_poses_of_low_score_are_left_out(found, tmp_path):
    _, (poses, *_) = found
    scores = [pose["score"] for pose in json.loads(poses.read_text())["poses"]]
    limit = sorted(scores)[2]
    result = run("register", MESH, SCAN, "--min-score", limit, "-o", tmp_path / "some.json")
    assert "4 found" in result.stdout
    held = json.loads((tmp_path / "some.json").read_text())
    assert [pose["score"] for pose in held["poses"]] == [score for score in scores if score >= limit]
    assert held["search"]["min_score"] == limit
    assert run("register", MESH, SCAN, "--min-score", 1).exit_code == cli.FOUND_NOTHING


# What is refused ------------------------------------------------------------------------------------------

EYE = np.eye(4).tolist()
FILES = {
    "empty.json": "",
    "cut.json": '{"poses": [[[1, 0',
    "list.json": "[1, 2]",
    "number.json": "3",
    "null.json": "null",
    "deep.json": "[" * 100_000,
    "garbage.json": bytes(range(128, 256)),
    "none.json": "{}",
    "text_poses.json": '{"poses": "x"}',
    "no_matrix.json": '{"poses": [{"score": 1}]}',
    "ragged.json": '{"poses": [[[1, 2], [3]]]}',
    "small.json": json.dumps({"poses": [np.eye(3).tolist()]}),
    "nan.json": json.dumps({"poses": [EYE, (np.nan * np.eye(4)).tolist()]}),
    "large.json": json.dumps({"poses": [(2 * np.eye(4)).tolist()]}),
    "mirror.json": json.dumps({"poses": [np.diag([1, 1, -1, 1]).tolist()]}),
    "good.json": json.dumps({"poses": [EYE]}),
    "typo.json": '{"t_z": 3}',
    "range.toml": "t_s = 1",
    "word.toml": 'scs = "gmt"',
    "p.yaml": "t_s: 4",
    "flat.json": '{"5": {"diameter": 0}}',
    "negative.json": '{"5": {"diameter": -1}}',
    "words.json": '{"5": {"diameter": "3 mm"}}',
    "tiny.json": '{"5": {"diameter": 1e-300}}',
    "two.json": '{"1": {"diameter": 50}, "2": {"diameter": 50}}',
    "other.json": '{"camera": {"fx": 500}}',
    "discrete.json": '{"5": {"symmetries_discrete": 3}}',
    "rows.json": '{"5": {"symmetries_discrete": ["x"]}}',
    "shear.json": '{"5": {"symmetries_discrete": [[1,1,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]]}}',
    "axis.json": '{"5": {"symmetries_continuous": [{"axis": 1, "offset": 2}]}}',
    "zero.json": '{"5": {"symmetries_continuous": [{"axis": [0, 0, 0], "offset": [0, 0, 0]}]}}',
    "empty.txt": "# nothing\n",
    "header.txt": "src tgt\n",
    "three.txt": "0 0 0\n1 1 1\n",
    "ragged.txt": "0 0\n1\n",
    "half.txt": "0 0\n0.5 1\n",
    "words.txt": "0 0\nx y\n",
    "nan.txt": "0 nan\n",
    "beyond.txt": "0 999\n1 1\n2 2\n",
    "garbage.txt": bytes(range(128, 256)),
    "garbage.npy": bytes(range(256)),
    # A header that says there are 16 TB.
    "huge.npy": b"\x93NUMPY\x01\x00\x76\x00"
    + b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 2), }".ljust(117)
    + b"\n",
}
ARRAYS = {
    "scalar.npy": np.array(3),
    "line.npy": np.arange(2),
    "three.npy": np.zeros((3, 3)),
    "half.npy": np.full((3, 2), 0.5),
    "bool.npy": np.zeros((3, 2), bool),
    "pose.npy": np.eye(4),
    "poses_nan.npy": np.full((1, 4, 4), np.nan),
    "cloud.npy": np.random.default_rng(0).uniform(size=(50, 3)),
}


@pytest.fixture(scope="module")
def bad(tmp_path_factory):
    """A folder of files that are no good."""
    folder = tmp_path_factory.mktemp("bad")
    for name, content in FILES.items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    for name, array in ARRAYS.items():
        np.save(folder / name, array)
    (folder / "folder.json").mkdir()
    return folder


def registering(*options):
    return ("register", MESH, SCAN, *options)


def matching(name):
    return ("register", "cloud.npy", "cloud.npy", "--corr", name)


def scoring(poses, truth="good.json", *options):
    return ("eval", poses, truth, MESH, *options)


NO_POSES = "must be a JSON object with a list 'poses'"
NO_MATRIX = "pose 0 is no (4, 4) matrix of numbers"
ONE_LINE = [
    # Files to be read
    (("register", MESH, "nowhere.ply"), 1, "nowhere.ply: no such file"),
    (("register", SCAN, SCAN), 1, "no faces"),
    (("batch", "nowhere.stl", SCAN), 1, "nowhere.stl: no such file"),
    (registering("--params", "nowhere.toml"), 1, "nowhere.toml: No such file or directory"),
    (registering("--params", "p.yaml"), 1, "p.yaml: a parameter file must end in .toml or .json"),
    (registering("--params", "folder.json"), 1, "folder.json: Is a directory"),
    (registering("--params", "list.json"), 1, "list.json: must be a JSON object, not [1, 2]"),
    (registering("--params", "null.json"), 1, "null.json: must be a JSON object, not None"),
    (registering("--params", "deep.json"), 1, "deep.json: it is nested too deeply"),
    (registering("--params", "cut.json"), 1, "cut.json: is no JSON: "),
    (registering("--params", "garbage.json"), 1, "garbage.json: 'utf-8' codec can't decode"),
    (registering("--params", "typo.json"), 1, "typo.json: params: unknown field `t_z`"),
    (registering("--params", "range.toml"), 1, "range.toml: params.t_s is 1; it must be at least 3"),
    (registering("--params", "word.toml"), 1, "word.toml: params.scs is 'gmt'; it must be one of 'gtm', "),
    (registering("--symmetries", "nowhere.json"), 1, "nowhere.json: cannot be read: No such file"),
    (registering("--symmetries", "folder.json"), 1, "folder.json: cannot be read: Is a directory"),
    (registering("--symmetries", "deep.json"), 1, "deep.json: cannot be read: it is nested too deeply"),
    (registering("--symmetries", "list.json"), 1, "list.json: it must be a JSON object"),
    (registering("--symmetries", "cut.json"), 1, "cut.json: is no JSON: "),
    (registering("--symmetries", "flat.json"), 1, "flat.json: diameter is 0; it must be a length in mm"),
    (registering("--symmetries", "negative.json"), 1, "negative.json: diameter is -1; it must"),
    (registering("--symmetries", "words.json"), 1, "words.json: diameter is '3 mm'; it must"),
    (registering("--symmetries", "tiny.json"), 1, "tiny.json: diameter is 1e-300, that of the model"),
    (registering("--symmetries", "two.json"), 1, "two.json has the objects 1, 2; give one of them"),
    (registering("--symmetries", "two.json:3"), 1, "obj_id is 3; two.json has 1, 2"),
    (registering("--symmetries", "two.json:x"), 1, "two.json:x: cannot be read: No such file"),
    (registering("--symmetries", "other.json"), 1, "other.json: is no models_info.json of BOP"),
    (registering("--symmetries", "discrete.json"), 1, "discrete.json: symmetries_discrete must be a list"),
    (registering("--symmetries", "rows.json"), 1, "rows.json: symmetries_discrete[0] has dtype"),
    (registering("--symmetries", "shear.json"), 1, "shear.json: symmetries_discrete[0] is no rigid motion"),
    (registering("--symmetries", "axis.json"), 1, "axis.json: symmetries_continuous[0] must be a pair"),
    (registering("--symmetries", "zero.json"), 1, "zero.json: symmetries_continuous[0] has an axis of"),
    (matching("nowhere.npy"), 1, "nowhere.npy: cannot be read: No such file"),
    (matching("folder.json"), 1, "folder.json: cannot be read: Is a directory"),
    (matching("empty.txt"), 1, "empty.txt: has no pairs"),
    (matching("header.txt"), 1, "header.txt: has no pairs"),
    (matching("three.txt"), 1, "three.txt: wanted (M, 2) rows or (M, 6) points"),
    (matching("ragged.txt"), 1, "ragged.txt, line 2: wanted 2 numbers as in the first, found 1"),
    (matching("half.txt"), 1, "half.txt: pair 1 is [0.5, 1.0]; rows are whole numbers"),
    (matching("words.txt"), 1, "words.txt, line 2: wanted numbers, found 'x y'"),
    (matching("nan.txt"), 1, "nan.txt: pair 0 is [0.0, nan]; rows are whole numbers"),
    (matching("beyond.txt"), 1, "corr[0, 1] is 999; tgt has rows 0 to 49"),
    (matching("garbage.txt"), 1, "garbage.txt: cannot be read: it is neither NPY nor text"),
    (matching("garbage.npy"), 1, "garbage.npy: cannot be read: "),
    (matching("huge.npy"), 1, "huge.npy: cannot be read: it says that it is larger than the memory"),
    (matching("scalar.npy"), 1, "scalar.npy: wanted (M, 2) rows or (M, 6) points"),
    (matching("line.npy"), 1, "line.npy: wanted (M, 2) rows or (M, 6) points"),
    (matching("three.npy"), 1, "three.npy: wanted (M, 2) rows or (M, 6) points"),
    (matching("half.npy"), 1, "half.npy: pair 0 is [0.5, 0.5]; rows are whole numbers"),
    (matching("bool.npy"), 1, "bool.npy: wanted (M, 2) rows or (M, 6) points, found bool"),
    (scoring("nowhere.json"), 1, "nowhere.json: cannot be read: No such file"),
    (scoring("folder.json"), 1, "folder.json: cannot be read: Is a directory"),
    (scoring("empty.json"), 1, "empty.json: is no JSON: "),
    (scoring("cut.json"), 1, "cut.json: is no JSON: "),
    (scoring("deep.json"), 1, "deep.json: cannot be read: it is nested too deeply"),
    (scoring("garbage.json"), 1, "garbage.json: is no JSON: "),
    *(
        (scoring(f"{name}.json"), 1, f"{name}.json: {NO_POSES}")
        for name in ("list", "number", "null", "none")
    ),
    (scoring("text_poses.json"), 1, f"text_poses.json: {NO_POSES}"),
    (scoring("good.json", "none.json"), 1, f"none.json: {NO_POSES}"),
    *((scoring(f"{name}.json"), 1, f"{name}.json: {NO_MATRIX}") for name in ("no_matrix", "ragged", "small")),
    (scoring("nan.json"), 1, "nan.json: pose 1 is not finite"),
    (scoring("large.json"), 1, "large.json: pose 0 is no rigid motion"),
    (scoring("mirror.json"), 1, "mirror.json: pose 0 is no rigid motion"),
    (
        scoring("good.json", "pose.npy"),
        1,
        "pose.npy: wanted (K, 4, 4) numbers, found float64 of shape (4, 4)",
    ),
    (scoring("good.json", "poses_nan.npy"), 1, "poses_nan.npy: pose 0 is not finite"),
    (scoring("good.json", "garbage.npy"), 1, "garbage.npy: cannot be read: "),
    (scoring("good.json", "huge.npy"), 1, "huge.npy: cannot be read: it says that"),
    (scoring("good.json", "good.json", "--symmetries", "flat.json"), 1, "flat.json: diameter is 0"),
    (("eval", "good.json", "good.json", "nowhere.ply"), 1, "nowhere.ply: no such file"),
    # Outputs, before anything is read
    (("register", MESH, "no.ply", "-o", "no/where.json"), 1, "no/where.json: there is no folder no"),
    (("register", MESH, "no.ply", "-o", "folder.json"), 1, "folder.json: is a folder"),
    (("register", MESH, "no.ply", "--bop", "no/where.csv"), 1, "no/where.csv: there is no folder no"),
    (("register", MESH, "no.ply", "--plot", "x.badext"), 2, "x.badext: pictures are written as"),
    (("register", MESH, "no.ply", "--plot", "x"), 2, "x: pictures are written as"),
    (("register", MESH, "no.ply", "--plot", "no/where.png"), 1, "no/where.png: there is no folder no"),
    (("batch", MESH, "no.ply", "--bop", "folder.json"), 1, "folder.json: is a folder"),
    (("batch", "no.ply", SCAN, "-o", "good.json"), 1, "good.json: is no folder"),
    (("batch", MESH, "a/x.ply", "b/x.pcd", "-o", "out"), 1, "b/x.pcd: has the JSON "),
    (("bench", "-o", "no/where.json"), 1, "no/where.json: there is no folder no"),
    # The command line
    (registering("--preset", "best"), 2, "--preset best: there are default"),
    (registering("--unit", "yd"), 2, "--unit: unit is 'yd'; it must be one of m, cm, mm, um, in, ft"),
    (registering("--set", "hv.t_score"), 2, "--set hv.t_score: must be NAME=VALUE, as hv.t_score=0.97"),
    (registering("--set", "=1"), 2, "--set =1: must be NAME=VALUE"),
    (registering("--set", "hv.t_scor=1"), 2, "--set hv.t_scor=1: there is no parameter 'hv.t_scor'"),
    (registering("--set", "hv.t_score=2"), 2, "--set: params.hv.t_score is 2; it must be between 0 and 1"),
    (registering("--set", "te=mak"), 2, "--set: params.te is 'mak'; it must be one of 'gsac', "),
    (registering("--set", "te.t_cmp=0.5"), 2, "--set: params: unknown field `t_cmp`"),
    (registering("--preset", "best", "--params", "good.json"), 2, "--preset best: there are default"),
    (registering("--voxel", "0"), 2, "--voxel is 0; it must be above 0 and finite"),
    (registering("--voxel", "nan"), 2, "--voxel is nan; it must be above 0 and finite"),
    (registering("--timeout-s", "-1"), 2, "--timeout-s is -1; it must be from 0 to 1e9"),
    (registering("--timeout-s", "inf"), 2, "--timeout-s is inf; it must be from 0 to 1e9"),
    (registering("--viewpoint", "0,nan,0"), 2, "--viewpoint must be three finite numbers"),
    (registering("--corr", "a.npy", "--voxel", "1"), 2, "--corr brings the matches"),
    (registering("--from-all-sides", "--viewpoint", "0,0,0"), 2, "--from-all-sides has no --viewpoint"),
    (registering("--from-all-sides"), 1, "viewpoint: give it"),
    (registering("-o", "same", "--bop", "./same"), 2, "--bop same: that is --output; give another name"),
    (("register", "good.json", SCAN, "-o", "good.json"), 2, "--output good.json: that is MODEL"),
    (registering("--params", "range.toml", "-o", "range.toml"), 1, "range.toml: params.t_s is 1"),
    (("batch", MESH, "cloud.npy", "--bop", "cloud.npy"), 2, "--bop cloud.npy: that is scan cloud.npy"),
    (("batch", MESH, SCAN, "--skip-existing"), 2, "--skip-existing looks into the folder of -o; give it"),
    (("batch", MESH, SCAN, "--preset", "best"), 2, "--preset best: there are default"),
    (("bench", MESH), 2, "give MODEL and SCENE, or neither"),
    (scoring("good.json", "good.json", "--diameters", "nan"), 2, "--diameters is nan; it must be above 0"),
]


@pytest.mark.parametrize(("arguments", "code", "message"), ONE_LINE, ids=lambda value: str(value)[-60:])
def test_errors_are_one_line_that_says_what_to_do(arguments, code, message, bad, monkeypatch):
    monkeypatch.chdir(bad)
    before = sorted(bad.rglob("*"))
    result = run(*arguments)
    assert result.stderr.startswith("ibi: ")
    assert len(result.stderr.strip().splitlines()) == 1
    assert message in result.stderr
    assert (result.exit_code, result.stdout) == (code, "")
    assert [path for path in sorted(bad.rglob("*")) if path.name != "out"] == before


@pytest.mark.parametrize("number", ["-1", "0", "65536", "100000", "9" * 30, "1.5", "nan", "x", ""])
@pytest.mark.parametrize("command", [("register", "--threads"), ("batch", "--threads"), ("batch", "--jobs")])
def test_counts_are_whole_and_not_too_many(command, number):
    result = run(command[0], MESH, SCAN, command[1], number)
    assert result.exit_code == 2
    assert command[1] in result.stderr
    assert isinstance(result.exception, SystemExit)


@pytest.mark.parametrize("value", ["abc", "0", "-3", "100000", "2.5"])
@pytest.mark.parametrize("command", [("register", MESH, SCAN), ("batch", MESH, SCAN), ("bench",)])
def test_the_environment_is_looked_at_first(command, value, monkeypatch):
    monkeypatch.setenv("IBI_NUM_THREADS", value)
    result = run(*command)
    assert result.exit_code == 1
    line = f"ibi: IBI_NUM_THREADS is '{value}'; it must be an integer from 1 to 65535\n"
    assert result.stderr == line.replace(f"'{value}'", value if value.isdecimal() else f"'{value}'")


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (MemoryError(), 1, "out of memory; a larger --voxel, a smaller scan or fewer --jobs need less"),
        (RecursionError("maximum recursion depth exceeded"), 1, "the input is nested too deeply"),
        (OSError(5, "Input/output error", "a.ply"), 1, "a.ply: Input/output error"),
        (ValueError("one\ntwo"), 1, "one"),
        (KeyboardInterrupt(), cli.INTERRUPTED, "interrupted"),
        (BrokenPipeError(), 0, None),
    ],
)
def test_what_a_user_can_do_something_about_is_one_line(error, code, line, monkeypatch):
    def broken(path):
        raise error

    monkeypatch.setattr(ibi.io, "read_scan", broken)
    result = run("register", MESH, SCAN)
    assert result.exit_code == code
    assert result.stderr == ("" if line is None else f"ibi: {line}\n")


def test_the_outputs_extras_are_asked_for_first(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    result = run("register", MESH, "nowhere.ply", "--rerun", "found.rrd")
    assert result.stderr.startswith("ibi: recordings need Rerun: pip install 'ibi_rs[viz]'")
    monkeypatch.setitem(sys.modules, "matplotlib.backend_bases", None)
    result = run("register", MESH, "nowhere.ply", "--plot", "found.png")
    assert result.stderr.startswith("ibi: pictures need matplotlib: pip install 'ibi_rs[plot]'")


# What is taken -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "given",
    [
        ["--viewpoint", "1,-2,3e-1"],
        ["--viewpoint=1,-2,3e-1"],
        ["--viewpoint", "1", "-2", "3e-1"],
        ["--viewpoint", "1,", "-2,", "3e-1"],
        ["--viewpoint", "1, -2, 3e-1"],
        ["--viewpoint=1", "-2", "3e-1"],
    ],
    ids=" ".join,
)
def test_a_viewpoint_has_commas_or_blanks(given, tmp_path):
    poses = tmp_path / "poses.json"
    for arguments in ((MESH, SCAN, *given), (*given, MESH, SCAN)):
        run("register", *arguments, "--timeout-s", 0, "-o", poses)
        assert json.loads(poses.read_text())["search"]["viewpoint"] == [1, -2, 0.3]


@pytest.mark.parametrize("given", [["1,2"], ["1,2,3,4"], ["a,b,c"], ["1", "2"], []], ids=" ".join)
def test_a_viewpoint_has_three_numbers(given):
    assert run("register", MESH, SCAN, "--viewpoint", *given).exit_code == 2


PAIRS = ibi.synth.outlier_layout(1, num_instances=5)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("m.npy", lambda path, corr: np.save(path, corr)),
        ("m.npy", lambda path, corr: np.save(path, corr.astype(np.uint16))),
        ("m.npy", lambda path, corr: np.save(path, corr.astype(float))),
        ("m.txt", lambda path, corr: np.savetxt(path, corr)),  # floats
        ("m.txt", lambda path, corr: np.savetxt(path, corr, "%d")),
        ("m.csv", lambda path, corr: np.savetxt(path, corr, "%d", ",", header="src,tgt", comments="")),
        ("m.csv", lambda path, corr: np.savetxt(path, corr, "%d", ", ", header="src, tgt")),
        ("m.csv", lambda path, corr: np.savetxt(path, corr, "%d", ";", encoding="utf-8-sig")),
        ("m.txt", lambda path, corr: np.savetxt(path, corr, "%d", "\t", newline="\r\n")),
        (
            "m.npy",
            lambda path, corr: np.save(path, np.hstack([PAIRS.src[corr[:, 0]], PAIRS.tgt[corr[:, 1]]])),
        ),
        (
            "m.txt",
            lambda path, corr: np.savetxt(path, np.hstack([PAIRS.src[corr[:, 0]], PAIRS.tgt[corr[:, 1]]])),
        ),
    ],
)
def test_correspondences_come_in_many_forms(name, write, tmp_path):
    write(tmp_path / name, PAIRS.corr)
    read = cli.register._pairs(tmp_path / name)
    wanted = PAIRS.corr
    if read.shape[1] == 6:
        wanted = np.hstack([PAIRS.src[wanted[:, 0]], PAIRS.tgt[wanted[:, 1]]])
    else:
        assert read.dtype.kind in "iu"
    np.testing.assert_array_equal(read, wanted)


@pytest.mark.parametrize("text", ["3 4", "3 4\n", "3,4", "\n# one\n3 4 # that\n"])
def test_one_correspondence_is_a_row(text, tmp_path):
    (tmp_path / "m.txt").write_text(text)
    assert cli.register._pairs(tmp_path / "m.txt").tolist() == [[3, 4]]


def test_own_correspondences_bring_normals_and_a_viewpoint(tmp_path):
    with np.load(TEE / "tee6.npz") as file:
        data = dict(file)
    for side in ("src", "tgt"):
        np.save(tmp_path / f"{side}.npy", np.hstack([data[side], data[f"{side}_normals"]]))
        np.save(tmp_path / f"{side}_bare.npy", data[side])
    np.save(tmp_path / "m.npy", data["corr"])
    poses = tmp_path / "poses.json"

    def found(src, tgt, *options):
        files = [tmp_path / f"{name}.npy" for name in (src, tgt)]
        result = run("register", *files, "--corr", tmp_path / "m.npy", "-o", poses, *options)
        held = json.loads(poses.read_text())["poses"]
        return np.array([pose["target_from_source"] for pose in held]).reshape(-1, 4, 4), result.stderr

    model = ibi.Model(data["src"], normals=data["src_normals"])

    def expected(params, **options):
        return np.asarray(
            model.register(data["tgt"], data["corr"], params, tgt_normals=data["tgt_normals"], **options)
        )

    view = ibi.Params.single_view()
    six = expected(view, viewpoint=[0, 0, 0])
    assert len(six) == 6
    for options in (("--viewpoint", "0,0,0"), ("--preset", "single_view")):
        given, stderr = found("src", "tgt", *options)
        np.testing.assert_array_equal(given, six)
        assert stderr == ""
    plain, stderr = found("src", "tgt")
    np.testing.assert_array_equal(plain, expected(None))
    assert stderr == ""

    given, stderr = found("src", "tgt_bare", "--viewpoint", "0,0,0")
    assert len(given) == 0
    assert stderr == (
        "ibi: warning: MODEL has normals and SCENE has none, so they have no say\n"
        "ibi: warning: --viewpoint has no say where MODEL or SCENE has no normals\n"
    )


def test_warnings_are_told_and_kept(tmp_path):
    np.save(tmp_path / "scan.npy", io.read_cloud(SCAN)[0][:2])
    scan, warning = tmp_path / "scan.npy", "the scan has 2 points"
    result = run("register", MESH, scan, "-o", tmp_path / "poses.json")
    assert result.stderr.splitlines() == [f"ibi: warning: {warning}"]
    assert json.loads((tmp_path / "poses.json").read_text())["warnings"] == [warning]
    result = run("batch", MESH, scan)
    assert result.stderr.splitlines() == [f"ibi: warning: {scan}: {warning}"]


def test_places_are_printed_to_the_digit_that_counts(tmp_path):
    far = np.array([500123.267, 4600456.5, 0])
    for name, array in (("src", PAIRS.src), ("tgt", PAIRS.tgt + far), ("corr", PAIRS.corr)):
        np.save(tmp_path / f"{name}.npy", array)
    src, tgt, corr = (tmp_path / f"{name}.npy" for name in ("src", "tgt", "corr"))
    result = run("register", src, tgt, "--corr", corr, "-o", tmp_path / "poses.json")
    held = json.loads((tmp_path / "poses.json").read_text())
    assert held["poses"]
    rows = [line.split() for line in result.stdout.splitlines()[1 : 1 + len(held["poses"])]]
    for row, pose in zip(rows, held["poses"], strict=True):
        place = np.array(pose["target_from_source"])[:3, 3]
        np.testing.assert_allclose(np.array(row[4:7], float), place, atol=0.01 * held["resolution"])
    assert "e+" not in result.stdout


def test_names_of_files_may_be_odd(tmp_path):
    name = os.fsdecode(b"a [red]$\\b :x: \xff.ply")
    (tmp_path / name).symlink_to(SCAN)
    result = run("batch", MESH, tmp_path / name, "--timeout-s", 0, "-o", tmp_path / "poses")
    assert (result.exit_code, result.stderr) == (0, "")
    assert "[red]$" in result.stdout
    assert ":x:" in result.stdout
    result = run("register", MESH, tmp_path / name, "--timeout-s", 0, "--plot", tmp_path / "a.png")
    assert (result.exit_code, result.stderr) == (cli.FOUND_NOTHING, "")
    result = run("register", MESH, tmp_path / "no :x: [red]\n.ply")
    assert result.stderr == f"ibi: {tmp_path}/no :x: [red] .ply: no such file\n"


def command_line(*arguments):
    return [sys.executable, "-m", "ibi_rs.cli", *map(str, arguments)]


@pytest.mark.parametrize(
    "arguments",
    [
        ("register", MESH, SCAN, "--max-instances", 1, "-o", "poses.json"),
        ("batch", MESH, SCAN, "--max-instances", 1, "--bop", "poses.csv"),
        ("eval", "good.json", "good.json", MESH),
        ("--version",),
    ],
)
def test_nobody_needs_to_read_what_is_printed(arguments, bad, tmp_path):
    """As in `ibi ... | head -1`: no word of a broken pipe, and files are written all the same."""
    (tmp_path / "good.json").write_text(FILES["good.json"])
    reading, writing = os.pipe()
    os.close(reading)
    try:
        ran = subprocess.run(
            command_line(*arguments), cwd=tmp_path, stdout=writing, stderr=subprocess.PIPE, text=True,
            timeout=LIMIT_S, check=False,
        )  # fmt: skip
    finally:
        os.close(writing)
    assert (ran.returncode, ran.stderr) == (0, "")
    for name in ("poses.json", "poses.csv"):
        assert (tmp_path / name).exists() == (name in arguments)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="only Linux has a disk that is always full")
@pytest.mark.parametrize("output", [None, "-o", "--bop"])
def test_a_full_disk_is_one_line(output, tmp_path):
    options = () if output is None else (output, "/dev/full")
    arguments = command_line("register", MESH, SCAN, "--max-instances", 1, *options)
    with open("/dev/full" if output is None else tmp_path / "out", "w") as file:
        ran = subprocess.run(
            arguments, stdout=file, stderr=subprocess.PIPE, text=True, timeout=LIMIT_S, check=False
        )
    assert ran.returncode == 1
    assert len(ran.stderr.splitlines()) == 1
    assert ran.stderr.startswith("ibi: ")
    assert "No space left on device" in ran.stderr
    assert ("/dev/full" in ran.stderr) == (output is not None)


def test_a_recording_is_written(tmp_path):
    pytest.importorskip("rerun", reason=NO_RERUN)
    scene = ibi.synth.outlier_layout(1, num_instances=5)
    for name, array in (("src", scene.src), ("tgt", scene.tgt), ("corr", scene.corr)):
        np.save(tmp_path / f"{name}.npy", array)
    src, tgt, corr = (tmp_path / f"{name}.npy" for name in ("src", "tgt", "corr"))
    result = run("register", src, tgt, "--corr", corr, "--rerun", tmp_path / "own.rrd")
    assert result.exit_code == 0
    result = run("register", MESH, SCAN, "--max-instances", 1, "--rerun", tmp_path / "found.rrd")
    assert result.exit_code == 0
    for name in ("own", "found"):
        assert (tmp_path / f"{name}.rrd").read_bytes().startswith(b"RRF2")


# Many scans ----------------------------------------------------------------------------------------------


@pytest.fixture
def scans(tmp_path):
    """Two good ones and a bad one between them; the folder is a scene of BOP."""
    folder = tmp_path / "000004"
    folder.mkdir()
    for name in ("scan_07.ply", "scan_11.ply"):
        (folder / name).symlink_to(SCAN)
    (folder / "scan_08.ply").write_text("no cloud")
    return [folder / name for name in ("scan_11.ply", "scan_08.ply", "scan_07.ply")]


def test_a_batch_writes_what_register_does_and_tells_what_failed(scans, tmp_path):
    poses, bop = tmp_path / "poses", tmp_path / "poses.csv"
    options = ["-o", poses, "--bop", bop, "--obj-id", 9, "--max-instances", 2]
    result = run("batch", MESH, *scans, *options)
    assert result.exit_code == 1
    assert result.stderr == f"ibi: {scans[1]}: is no PLY file\n"
    assert "4 found in 3 scans, 1 of which failed" in result.stdout

    assert run("register", MESH, scans[0], "-o", tmp_path / "one.json", "--max-instances", 2).exit_code == 0
    alone, one = (json.loads(path.read_text()) for path in (tmp_path / "one.json", poses / "scan_11.json"))
    assert one.pop("seconds") > 0
    assert alone.pop("seconds") > 0
    assert one == alone
    assert sorted(path.name for path in poses.iterdir()) == ["scan_07.json", "scan_11.json"]
    with bop.open(newline="") as file:
        rows = list(csv.DictReader(file))
    ids = [(row["scene_id"], row["im_id"], row["obj_id"]) for row in rows]
    assert ids == [("4", "11", "9")] * 2 + [("4", "7", "9")] * 2
    assert len({row["time"] for row in rows}) == 2

    # Once more: what is there stays, and is in the CSV all the same.
    before, table = (poses / "scan_07.json").stat().st_mtime_ns, bop.read_text()
    (poses / "scan_11.json").write_text("cut off")
    result = run("batch", MESH, scans[0], scans[2], *options, "--skip-existing", "--jobs", 1)
    assert result.exit_code == 0
    assert result.stdout.count("kept") == 1
    assert (poses / "scan_07.json").stat().st_mtime_ns == before
    assert len(bop.read_text().splitlines()) == len(table.splitlines())


def test_ids_of_bop_are_in_the_names_or_counted(tmp_path):
    paths = [tmp_path / name for name in ("000003/000012.png", "000004/a_7.ply")]
    assert cli.batch._bop_ids(paths) == [(3, 12), (4, 7)]
    assert cli.batch._bop_ids([tmp_path / "a1.ply", tmp_path / "b1.ply"]) == [(0, 0), (0, 1)]
    assert cli.batch._bop_ids([tmp_path / "a.ply", tmp_path / "b1.ply"]) == [(0, 0), (0, 1)]


# Deterministic, and over at once: nothing is found.
QUICK = ("--timeout-s", 0)


def skipping(tmp_path, *options, model=MESH, scan=SCAN):
    return run("batch", model, scan, "-o", tmp_path / "poses", "--skip-existing", *QUICK, *options)


@pytest.fixture
def done(tmp_path):
    """A batch that was run, of a model and a scan that can be changed."""
    model, scan = tmp_path / "tee.stl", tmp_path / "scan.npy"
    vertices, faces = ibi.io.read_mesh(MESH)
    trimesh.Trimesh(vertices, faces).export(model)
    np.save(scan, ibi.io.read_cloud(SCAN)[0])
    (tmp_path / "p.toml").write_text("[hv]\nvariant = 'evidence'\nt_score = 0.9\n")
    assert run("batch", model, scan, "-o", tmp_path / "poses", *QUICK).exit_code == 0
    return tmp_path, {"model": model, "scan": scan}


def test_what_would_come_out_the_same_is_kept(done, monkeypatch):
    folder, files = done
    poses = folder / "poses/scan.json"
    before = poses.stat().st_mtime_ns
    result = skipping(folder, **files)
    assert (result.exit_code, result.stderr) == (0, "")
    assert "kept" in result.stdout
    # By another way, and under other names.
    monkeypatch.chdir(folder)
    files["model"].rename("same.stl")
    result = skipping(folder, model="same.stl", scan="scan.npy")
    assert (result.exit_code, result.stderr) == (0, "")
    assert poses.stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (("--max-instances", 3), "made with other parameters (max_instances none for 3)"),
        (("--timeout-s", 0.001), "made with other parameters (timeout_s 0 for 0.001)"),
        (
            ("--preset", "paper_real"),
            "made with other parameters (delta_r_pr 2 for 10, t_he_pr 2 for 1, d_op_pr 1.5 for 3 and ",
        ),
        (("--viewpoint", "0,0,-1"), "made with other options (viewpoint none for 0,0,-1)"),
        (("--voxel", 0.005), "made with other options (voxel none for 0.005)"),
        (("--keep-plane",), "made with other options (remove_plane none for no)"),
        (("--symmetries", "find"), "made with other options (other symmetries)"),
    ],
)
def test_what_was_made_otherwise_is_done_again(done, options, why):
    folder, files = done
    result = skipping(folder, *options, **files)
    assert result.exit_code == 0
    assert result.stderr.startswith(f"ibi: scan.json: {why}")
    assert result.stderr.endswith("; done again\n")
    assert len(result.stderr.splitlines()) == 1
    assert "kept" not in result.stdout
    again = skipping(folder, *options, **files)
    assert (again.stderr, "kept" in again.stdout) == ("", True)


def test_parameters_of_a_file_are_compared(done):
    folder, files = done
    skipping(folder, "--preset", "default", **files)
    result = skipping(folder, "--preset", "default", "--params", folder / "p.toml", **files)
    line = "ibi: scan.json: made with other parameters (hv.t_score 0.5 for 0.9); done again\n"
    assert (result.exit_code, result.stderr) == (0, line)
    (folder / "p.toml").write_text("hv = 'none'")
    result = skipping(folder, "--preset", "default", "--params", folder / "p.toml", **files)
    assert "(hv evidence for none)" in result.stderr


def change_model(folder, files):
    vertices, faces = ibi.io.read_mesh(MESH)
    trimesh.Trimesh(vertices * 1.01, faces).export(files["model"])


def other_model(folder, files):
    change_model(folder, files | {"model": folder / "other.stl"})
    files["model"] = folder / "other.stl"


def change_scan(folder, files):
    np.save(files["scan"], ibi.io.read_cloud(SCAN)[0][:-1])


def other_scan(folder, files):
    (folder / "b").mkdir()
    files["scan"] = folder / "b/scan.npy"
    change_scan(folder, files)


def older(folder, files):
    path = folder / "poses/scan.json"
    data = json.loads(path.read_text())
    for name in ("model_sha256", "scene_sha256", "search", "warnings"):
        del data[name]
    path.write_text(json.dumps(data))


def overwriting(text):
    def overwrite(folder, files):
        (folder / "poses/scan.json").write_text(text)

    return overwrite


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (change_model, "made of another model ({folder}/tee.stl has changed)"),
        (other_model, "made of another model ({folder}/tee.stl for {folder}/other.stl)"),
        (change_scan, "made of another scan ({folder}/scan.npy has changed)"),
        (other_scan, "made of another scan ({folder}/scan.npy for {folder}/b/scan.npy)"),
        (older, "made by an older ibi, which did not write down of what and how"),
        (overwriting("cut off"), "cannot be read"),
        (overwriting("[]"), "cannot be read"),
        (overwriting('{"poses": 3}'), "cannot be read"),
        (overwriting("[" * 100_000), "cannot be read"),
    ],
)
def test_what_was_made_of_something_else_is_done_again(done, change, why):
    folder, files = done
    change(folder, files)
    result = skipping(folder, **files)
    line = f"ibi: scan.json: {why.format(folder=folder)}; done again\n"
    assert (result.exit_code, result.stderr) == (0, line)
    again = skipping(folder, **files)
    assert (again.stderr, "kept" in again.stdout) == ("", True)


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, cli.INTERRUPTED), (signal.SIGTERM, cli.TERMINATED)]
)
def test_what_ends_a_batch_leaves_what_is_done(done, number, code):
    """Its output is piped: the table is printed all the same."""
    folder, files = done
    (folder / "bad.ply").write_text("no cloud")
    for index in range(40):
        (folder / f"long_{index}.npy").symlink_to(files["scan"])
    # Rounds without end, as nothing is ever accepted.
    params = ibi.Params(scs=ibi.Gtm(n_gtm=5000), hv=ibi.Evidence(t_score=1), max_rejections=None)
    params.save(folder / "long.toml")
    held = json.loads((folder / "poses/scan.json").read_text())
    held["params"] = params.to_dict()
    (folder / "poses/scan.json").write_text(json.dumps(held))
    scans = [files["scan"], folder / "bad.ply", *(folder / f"long_{index}.npy" for index in range(40))]
    options = ("--params", folder / "long.toml", "-o", folder / "poses", "--skip-existing", "--jobs", 1)
    child = subprocess.Popen(
        command_line("batch", files["model"], *scans, *options),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"COLUMNS": "300"},
    )
    watchdog = threading.Timer(LIMIT_S, child.kill)
    watchdog.start()
    try:
        assert "bad.ply: is no PLY file" in child.stderr.readline()
        child.send_signal(number)
        stdout, stderr = child.communicate()
    finally:
        watchdog.cancel()
        child.kill()
    assert child.returncode == code
    assert stderr == "ibi: with --skip-existing the batch goes on from here\nibi: interrupted\n"
    _, kept, failed, last = stdout.splitlines()
    assert "scan.npy" in kept
    assert kept.rstrip().endswith("kept")
    assert failed.rstrip().endswith("failed")
    assert last.startswith("0 found in 2 scans, 1 of which failed, 40 not done; ")
    assert os.listdir(folder / "poses") == ["scan.json"]


def test_ctrl_c_while_a_file_is_written_leaves_nothing(tmp_path, monkeypatch):
    def interrupt(source, target):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupt)
    result = run("register", MESH, SCAN, "--max-instances", 1, "-o", tmp_path / "poses.json")
    assert (result.exit_code, result.stderr) == (cli.INTERRUPTED, "ibi: interrupted\n")
    result = run("batch", MESH, SCAN, *QUICK, "-o", tmp_path)
    assert result.exit_code == cli.INTERRUPTED
    assert os.listdir(tmp_path) == []


def test_a_batch_whose_results_cannot_be_written_tells_what_it_has(tmp_path, monkeypatch):
    def full(source, target):
        raise OSError(28, "No space left on device", source)

    monkeypatch.setattr(os, "replace", full)
    result = run("batch", MESH, SCAN, *QUICK, "-o", tmp_path)
    assert (result.exit_code, result.stderr) == (1, f"ibi: {tmp_path}/tee6.json: No space left on device\n")
    assert "0 found in 0 scans, 0 of which failed, 1 not done" in result.stdout
    assert os.listdir(tmp_path) == []


# Times ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("files", [(), (MESH, SCAN)])
def test_bench_times_each_step(files, tmp_path):
    result = run("bench", *files, "--repeats", 2, "--max-instances", 1, "-o", tmp_path / "bench.json")
    assert result.exit_code == 0
    assert "1 found; 2 runs of" in result.stdout
    assert f"numpy {np.__version__}" in result.stdout
    data = json.loads((tmp_path / "bench.json").read_text())
    assert set(data["threads"]) == {"1", str(data["cores"])}
    for steps in data["threads"].values():
        whole = [step for step in steps if step not in (*cli.bench.STAGES.values(), "total")]
        assert whole == (["read", "model", "match", "register"] if files else ["model", "register"])
        for i, total in enumerate(steps["total"]):
            assert total == pytest.approx(sum(steps[step][i] for step in whole))


# -----------------------------------------------------------------------------------------------------------


def test_units_that_differ_are_noticed(tmp_path):
    np.save(tmp_path / "mm.npy", ibi.io.read_cloud(SCAN)[0] * 1000)
    result = run("register", MESH, tmp_path / "mm.npy")
    assert result.exit_code == 1
    assert "same unit" in result.stderr


def test_the_version_is_the_packages():
    assert run("--version").stdout == f"ibi_rs {ibi.__version__}\n"


def test_rotation_vectors_are_scipys():
    rotations = Rotation.random(200, random_state=0)
    half = Rotation.from_rotvec(np.pi * np.eye(3))
    for rotation in [*rotations, *half, Rotation.identity()]:
        ours = Rotation.from_rotvec(cli.outputs._rotation_vector(rotation.as_matrix()))
        assert (ours * rotation.inv()).magnitude() < 1e-7


def test_the_viewpoint_of_a_file_counts_unless_one_is_given(found, tmp_path):
    """A scan in the frame of a robot that stands behind it."""
    pypcd4 = pytest.importorskip("pypcd4")
    points, _ = io.read_cloud(SCAN)
    shift = np.array([0.0, 0.0, -2 * points[:, 2].max()])
    cloud = pypcd4.PointCloud.from_xyz_points((points + shift).astype(np.float32))
    cloud.metadata.viewpoint = (*shift, 1, 0, 0, 0)
    cloud.save(tmp_path / "moved.pcd")
    here = json.loads(found[1][0].read_text())["poses"]
    there = tmp_path / "there.json"
    assert run("register", MESH, tmp_path / "moved.pcd", "-o", there).exit_code == 0
    moved = [np.array(pose["target_from_source"])[:3, 3] for pose in json.loads(there.read_text())["poses"]]
    assert len(moved) == len(here)
    for pose in here:
        apart = np.linalg.norm(moved - np.array(pose["target_from_source"])[:3, 3] - shift, axis=1)
        assert apart.min() < 2
    result = run("register", MESH, tmp_path / "moved.pcd", "--viewpoint", "0,0,0", "-o", there)
    assert len(json.loads(there.read_text())["poses"]) < len(here) or result.exit_code == 3
    result = run("batch", MESH, tmp_path / "moved.pcd", "-o", tmp_path / "batch")
    assert len(json.loads((tmp_path / "batch/moved.json").read_text())["poses"]) == len(here)
