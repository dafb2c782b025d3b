"""What runs tell the standard `logging`, and what the command prints of it and of its progress."""

import io
import logging
import re
import subprocess
import sys

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import cli
from rich.console import Console
from test_cli import MESH, SCAN, run

terminal = cli.terminal


@pytest.fixture(scope="module")
def part():
    return ibi.Model.from_mesh(*ibi.io.read_mesh(MESH))


@pytest.fixture(scope="module")
def scan():
    return ibi.io.read_scan(SCAN).points


def lines(caplog, level):
    return [record.getMessage() for record in caplog.records if record.levelno == level]


def test_a_call_is_a_line(part, scan, caplog):
    caplog.set_level(logging.INFO, "ibi_rs")
    found = part.detect(scan, viewpoint=[0, 0, 0])
    (line,) = lines(caplog, logging.INFO)
    sizes = f"detect: {len(scan)} points, {len(found.labels)} correspondences; "
    counts = f"{len(found)} found, {len(found.rejected)} rejected in {len(found.rounds)} rounds, "
    assert line.startswith(sizes)
    assert counts in line
    assert line.endswith(f"{found.timings.total_s:.3f} s; stopped by {found.stop_reason}")
    assert {record.name for record in caplog.records} == {"ibi_rs"}


def test_of_several_models_a_call_is_a_line_too(part, scan, caplog):
    caplog.set_level(logging.INFO, "ibi_rs")
    ibi.Models([part, part]).detect(scan, viewpoint=[0, 0, 0], max_instances=1)
    (line,) = lines(caplog, logging.INFO)
    assert line.startswith(f"detect: 2 models, {len(scan)} points, ")


def test_debug_tells_each_pose_and_where_the_time_went(part, scan, caplog):
    caplog.set_level(logging.DEBUG, "ibi_rs")
    ibi.Model.from_mesh(*ibi.io.read_mesh(MESH))
    found = part.detect(scan, viewpoint=[0, 0, 0])
    told = lines(caplog, logging.DEBUG)
    assert re.match(r"model: \d+ points on \d+ faces, voxel 0\.\d+, Symmetries", told[0])
    for number, pose in enumerate(found):
        assert f"detect: pose {number} of round {pose.round}: score {pose.score:.3f}" in "\n".join(told)
    assert any(line.endswith(f"total {found.timings.total_s:.3f} s") for line in told)


def test_matching_tells_what_is_left_of_the_scan(part, scan, caplog):
    caplog.set_level(logging.INFO, "ibi_rs")
    matches = part.correspond(scan, viewpoint=[0, 0, 0])
    (line,) = lines(caplog, logging.INFO)
    assert line.startswith(f"correspond: {len(matches.tgt)} points of {len(scan)} left, ")
    assert line.endswith(f" {len(matches.corr)} correspondences")


def test_what_is_doubtful_is_a_warning(part, scan, caplog):
    holes = np.concatenate([scan, np.full((7, 3), np.nan)])
    found = part.detect(holes, viewpoint=[0, 0, 0], max_instances=1)
    assert found.warnings
    assert lines(caplog, logging.WARNING) == [f"detect: {warning}" for warning in found.warnings]


def test_a_batch_tells_what_failed(caplog):
    caplog.set_level(logging.INFO, "ibi_rs")
    scene = ibi.synth.outlier_layout(seed=1, num_instances=2)
    model = ibi.Model(scene.src)
    jobs = [ibi.Job(model, scene.tgt, scene.corr), ibi.Job(model, scene.tgt[:1], scene.corr, name="cut")]
    _, failed = ibi.register_batch(jobs)
    assert lines(caplog, logging.WARNING) == [f"batch: {failed}"]
    assert lines(caplog, logging.INFO)[-1].startswith("batch: 2 jobs, 1 failed, ")
    assert any(line.startswith("register: ") for line in lines(caplog, logging.INFO))


def test_nothing_is_printed_until_somebody_listens():
    code = f"""
import ibi_rs as ibi
part = ibi.Model.from_mesh(*ibi.io.read_mesh({MESH!r}))
print(part.detect([[0, 0, 1]] * 5 + [[float("nan")] * 3], viewpoint=[0, 0, 0]).warnings != ())
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout == "True\n"
    assert ended.stderr == ""


# The command ----------------------------------------------------------------------------------------------


def test_the_command_tells_as_much_as_is_asked_for():
    quiet, some, more = (run("register", MESH, SCAN, *words) for words in ((), ("-v",), ("-vv",)))
    assert quiet.stderr == ""
    assert [line.split(":")[1] for line in some.stderr.splitlines()] == [" detect"]
    assert "ibi: detect: pose 0 of round" in more.stderr
    before = run("-v", "register", MESH, SCAN, "-v")
    assert len(before.stderr.splitlines()) == 1
    assert run("register", MESH, SCAN).stderr == ""


def test_warnings_are_printed_once(scan, tmp_path):
    np.save(tmp_path / "scan.npy", scan[:2])
    for command in ("register", "batch"):
        told = run(command, MESH, tmp_path / "scan.npy", "-v").stderr
        assert told.count("the scan has 2 points") == 1
        assert "ibi: detect: 2 points, " in told


def test_planes_that_were_taken_away_are_told():
    told = run("register", MESH, SCAN, "--remove-planes", 1, "--max-instances", 1, "-v").stderr
    assert re.search(r"ibi: --remove-planes: \d+ points of 3815 taken away", told)


class Shown(Console):
    """A terminal that keeps what is shown."""

    def __init__(self, is_terminal):
        super().__init__(file=io.StringIO(), force_terminal=is_terminal, width=100)

    @property
    def text(self):
        return self.file.getvalue()


@pytest.mark.parametrize(
    ("is_terminal", "moment_s", "wanted"), [(True, 0, True), (True, 3600, False), (False, 0, False)]
)
def test_progress_is_shown_on_terminals_once_it_takes_long(is_terminal, moment_s, wanted, monkeypatch):
    console = Shown(is_terminal)
    monkeypatch.setattr(terminal, "err", console)
    monkeypatch.setattr(terminal.Progress, "MOMENT_S", moment_s)
    with terminal.Progress("reading") as progress:
        if moment_s == 0:
            progress._timer.join()
        progress.update("detecting: round 7")
    assert ("reading" in console.text) == wanted
    assert ("detecting: round 7" in console.text) == wanted
    with progress._lock:
        assert not progress._shown.live.is_started


def test_register_shows_its_rounds(monkeypatch):
    console = Shown(is_terminal=True)
    monkeypatch.setattr(terminal, "err", console)
    monkeypatch.setattr(terminal.Progress, "MOMENT_S", 0)
    result = run("register", MESH, SCAN)
    assert result.exit_code == 0
    assert re.search(r"detecting: round \d+", console.text)
    assert "round" not in result.stdout
