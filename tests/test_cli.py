"""The command: what it prints, writes and refuses."""

import csv
import json
from pathlib import Path

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import cli
from scipy.spatial.transform import Rotation
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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((MESH, "nowhere.ply"), "nowhere.ply: no such file"),
        ((SCAN, SCAN), "no faces"),
        ((MESH, SCAN, "--preset", "best"), "--preset best: there are default"),
        ((MESH, SCAN, "--params", "nowhere.toml"), "nowhere.toml"),
        ((MESH, SCAN, "--voxel", "0"), "voxel is 0"),
        ((MESH, SCAN, "--corr", "nowhere.npy"), "nowhere.npy: cannot be read"),
        ((MESH, SCAN, "--corr", "corr.npy", "--voxel", "1"), "--corr brings the matches"),
        ((MESH, SCAN, "--from-all-sides"), "viewpoint: give it"),
    ],
)
def test_errors_are_one_line_that_says_what_to_do(arguments, message):
    result = run("register", *arguments)
    assert result.exit_code == 1
    assert result.stderr.startswith("ibi: ")
    assert len(result.stderr.strip().splitlines()) == 1
    assert message in result.stderr


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
        ours = Rotation.from_rotvec(cli._rotation_vector(rotation.as_matrix()))
        assert (ours * rotation.inv()).magnitude() < 1e-7
