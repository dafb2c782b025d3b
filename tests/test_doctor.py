"""What `ibi doctor` says."""

import os
import re
from pathlib import Path

import ibi_rs as ibi
import numpy as np
from ibi_rs.cli import doctor
from test_cli import run

ROOT = Path(__file__).parents[1]


def test_it_says_what_is_there(monkeypatch):
    monkeypatch.setenv("IBI_NUM_THREADS", "2")
    monkeypatch.setitem(doctor.EXTRAS, "ray", ("no-such-package",))
    result = run("doctor")
    assert result.exit_code == 0
    said = dict(re.findall(r"(?m)^(\w+) +(.*)$", result.stdout))
    assert said["ibi_rs"].split()[0] == ibi.__version__
    assert said["numpy"] == np.__version__
    assert re.fullmatch(rf"\d+ of {os.cpu_count()}, IBI_NUM_THREADS=2", said["cores"])
    assert said["SIMD"]
    assert re.match(r"typer \d", said["cli"])
    assert said["ray"] == "no no-such-package  (pip install 'ibi_rs[ray]')"


def test_extras_are_those_of_the_package():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    block = text.partition("[project.optional-dependencies]\n")[2].partition("\n\n")[0]
    wanted = {}
    for extra, packages in re.findall(r"(?m)^(\w+) = \[(.*)\]$", block):
        names = re.findall(r'"([\w-]+)(?:\[\w+\])?>=', packages)
        if names:  # else it brings those of another one
            wanted[extra] = tuple(names)
    assert wanted == doctor.EXTRAS
