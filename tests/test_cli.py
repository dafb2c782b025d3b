"""The command: what it prints, writes and refuses."""

import csv
import json
import sys
from pathlib import Path

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import cli
from scipy.spatial.transform import Rotation
from test_process import ended, python
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


def test_without_rerun_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    result = run("register", MESH, SCAN, "--max-instances", 1, "--rerun", tmp_path / "found.rrd")
    assert result.exit_code == 1
    assert result.stderr.startswith("ibi: recordings need Rerun: pip install 'ibi_rs[viz]'")


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
    assert result.stderr == f"ibi: {scans[1]}: cannot be read: Not a ply file!\n"
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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((MESH, SCAN, "--skip-existing"), "--skip-existing looks into the folder of -o; give it"),
        ((MESH, "a/x.ply", "b/x.pcd", "-o", "out"), "b/x.pcd: has the JSON "),
        (("nowhere.stl", SCAN), "nowhere.stl: no such file"),
        ((MESH, SCAN, "--preset", "best"), "--preset best: there are default"),
    ],
)
def test_what_stops_a_batch_is_one_line(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = run("batch", *arguments)
    assert result.exit_code == 1
    assert result.stderr.startswith("ibi: ")
    assert len(result.stderr.strip().splitlines()) == 1
    assert message in result.stderr


INTERRUPTED = """
import glob, signal
from ibi_rs import _core, cli

def told(phase):
    # The second scan has begun, and is not yet through.
    if phase == "Estimate" and glob.glob("poses/*.json"):
        _core._watch(None)
        signal.raise_signal(signal.SIGINT)

_core._watch(told)
sys.exit(cli.app(["batch", *sys.argv[1:], "-o", "poses", "--jobs", "1"]))
"""


def test_ctrl_c_ends_a_batch_and_what_is_done_stays(tmp_path, monkeypatch):
    scans = []
    for number in range(4):
        scans.append(tmp_path / f"scan_{number}.ply")
        scans[-1].symlink_to(SCAN)
    monkeypatch.chdir(tmp_path)
    stdout, stderr, code = ended(python(INTERRUPTED, MESH, *scans))
    assert (code, stdout) == (cli.INTERRUPTED, "")
    assert stderr == "ibi: interrupted; with --skip-existing the batch goes on from here\n"
    (done,) = tmp_path.glob("poses/*")
    assert len(json.loads(done.read_text())["poses"]) == 6


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


def test_bench_wants_both_files_or_neither():
    result = run("bench", MESH)
    assert (result.exit_code, result.stderr) == (1, "ibi: give MODEL and SCENE, or neither\n")


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
        ours = Rotation.from_rotvec(cli.common._rotation_vector(rotation.as_matrix()))
        assert (ours * rotation.inv()).magnitude() < 1e-7
