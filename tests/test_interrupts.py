"""Ctrl-C while code of others runs that swallows it: in an import, and in a reader."""

import os
import subprocess
import sys

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import _interrupts, io, plot, viz
from ibi_rs.synth.descriptors import load_open3d
from test_process import LIMIT_S

# A module in whose middle Ctrl-C comes, and which catches all there is to catch.
SWALLOWS = """
import signal
is_whole = False
try:
    signal.raise_signal(signal.SIGINT)
    is_whole = True
except BaseException:
    pass
"""


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """Put `text` in the place of a module that may be installed, and loaded, or not."""
    folder = tmp_path / "modules"
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)

    def make(module, text=SWALLOWS):
        package, *rest = module.split(".")
        for name in [name for name in sys.modules if name.partition(".")[0] == package]:
            monkeypatch.delitem(sys.modules, name)
        path = folder.joinpath(package, *rest)
        path.mkdir(parents=True)
        (folder / package / "__init__.py").touch()
        (path / "__init__.py").write_text(text)
        return folder

    yield make
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", "")).startswith(str(folder)):
            del sys.modules[name]


def depth(path):
    io.read_depth(path, fx=1, fy=1, cx=0, cy=0)


# Three points, one instance where they are.
POINTS, POSE = np.eye(3), np.eye(4)[np.newaxis]


def drawn(path):
    plot.instances(POINTS, POINTS, POSE, path)


def recorded(path):
    viz.record(POINTS, POINTS, POSE, path)


# Each module that is imported when it is needed, the suffix of what needs it, and who does.
LATE = [
    ("trimesh", ".stl", io.read_mesh),
    ("trimesh", ".ply", io.read_cloud),
    ("pypcd4", ".pcd", io.read_cloud),
    ("laspy", ".laz", io.read_cloud),
    ("PIL.Image", ".png", depth),
    ("matplotlib", ".png", drawn),
    ("rerun", ".rrd", recorded),
    ("ray", "", lambda _: ibi.RayExecutor()),
    ("open3d", "", lambda _: load_open3d()),
]


@pytest.mark.parametrize(("module", "suffix", "use"), LATE, ids=[row[0] + row[1] for row in LATE])
def test_ctrl_c_in_an_import_is_raised_after_it(fake, tmp_path, module, suffix, use):
    fake(module)
    path = tmp_path / f"file{suffix}"
    path.touch()
    with pytest.raises(KeyboardInterrupt):
        use(path)
    assert sys.modules[module].is_whole


def test_ctrl_c_in_an_import_of_the_command_ends_it(fake, tmp_path):
    folder = fake("trimesh")
    model, scene, output = tmp_path / "part.stl", tmp_path / "scan.npy", tmp_path / "poses.json"
    model.touch()
    np.save(scene, np.zeros((10, 3)))
    # The folder goes first, and the package is found where it is found here.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *filter(None, sys.path)])}
    command = [sys.executable, "-m", "ibi_rs.cli", "register", model, scene, "--output", output]
    ran = subprocess.run(
        command, capture_output=True, text=True, env=environment, timeout=LIMIT_S, check=False
    )
    assert (ran.stderr, ran.returncode, output.exists()) == ("ibi: interrupted\n", 130, False)


@pytest.mark.parametrize("after", ["pass", "raise ValueError('no such thing')"])
def test_ctrl_c_in_a_reader_is_raised_again_if_it_was_swallowed(fake, tmp_path, after):
    reader = "import signal\ndef load(path, **options):\n"
    reader += f"  try: signal.raise_signal(signal.SIGINT)\n  except BaseException: pass\n  {after}\n"
    fake("trimesh", reader)
    path = tmp_path / "part.ply"
    path.write_text("ply\nformat ascii 1.0\nend_header\n")  # what is none is refused before
    with pytest.raises(KeyboardInterrupt):
        io.read_mesh(path)


@pytest.mark.parametrize("block", [_interrupts.held, _interrupts.remembered])
def test_without_ctrl_c_nothing_is_raised_or_hidden(block):
    with block():
        pass
    with pytest.raises(ZeroDivisionError), block():
        _ = 1 / 0
    with pytest.raises(KeyboardInterrupt), block():
        raise KeyboardInterrupt
