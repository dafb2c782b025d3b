"""Recorded problems with their answers, the same files that the Rust tests read.

Each file of ``tests/golden`` holds ``name``, ``params`` (what differs from the default), ``src``, ``tgt``,
``corr``, ``truth`` and ``expected``: ``poses`` (K, 4, 4) by rank, ``labels`` with -1 for none,
``stop_reason`` by its name, ``num_rounds``.
"""

import json
from pathlib import Path

import ibi_rs as ibi
import numpy as np
import pytest

GOLDEN = Path(__file__).parent / "golden"
FILES = sorted(GOLDEN.glob("*.json"))
RELATIVE = 1e-6  # of the largest entry of a pose: sums may be ordered otherwise on another machine


def check(path, num_threads=None):
    case = json.loads(path.read_text(encoding="utf-8"))
    expected = case["expected"]
    src, tgt = (np.reshape(case[key], (-1, 3)).astype(float) for key in ("src", "tgt"))
    params = ibi.Params.from_dict(case["params"])
    found = ibi.register(src, tgt, case["corr"], params, num_threads=num_threads)

    poses = np.reshape(expected["poses"], (-1, 4, 4))
    assert np.asarray(found).shape == poses.shape, f"{case['name']}: {found}"
    for rank, (pose, recorded) in enumerate(zip(np.asarray(found), poses, strict=True)):
        error = np.abs(pose - recorded).max() / np.abs(recorded).max()
        assert error < RELATIVE, f"{case['name']}: pose {rank} is off by {error:.1e}"
    np.testing.assert_array_equal(found.labels, np.asarray(expected["labels"], dtype=np.int32))
    assert found.stop_reason.name == expected["stop_reason"]
    assert len(found.rounds) == expected["num_rounds"]


@pytest.mark.parametrize("num_threads", [1, 2])
@pytest.mark.parametrize("path", FILES or [GOLDEN / "none.json"], ids=lambda path: path.stem)
def test_the_recorded_answer_is_found(path, num_threads):
    assert FILES, "tests/golden holds no record"
    check(path, num_threads)
