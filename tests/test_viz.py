"""Recordings are read back, as far as Rerun can; `make test-viz` has these run."""

import sys
from collections import defaultdict

import ibi_rs as ibi
import numpy as np
import pytest

NO_RERUN = "large, so not in the group of the tests: `make test-viz` installs it and has these run"
SCENE = ibi.synth.outlier_layout(0, num_instances=3, num_correspondences=600, num_points=256)
FOUND = ibi.register(SCENE.src, SCENE.tgt, SCENE.corr)


@pytest.fixture
def rr():
    return pytest.importorskip("rerun", reason=NO_RERUN)


def read(path):
    """Each entity's rows: dicts of its columns, by the last word of their names."""
    RrdReader = pytest.importorskip("rerun.chunk", reason="needs Rerun 0.41, and so Python 3.11").RrdReader
    rows = defaultdict(list)
    for chunk in RrdReader(path).stream().to_chunks():
        for row in chunk.to_record_batch().to_pylist():
            named = {name.rpartition(":")[2]: value for name, value in row.items() if value is not None}
            rows[chunk.entity_path].append(named)
    return rows


def column(rows, name):
    (value,) = [row[name] for row in rows if name in row]
    return np.array(value)


@pytest.mark.parametrize("form", ["rows", "points", None])
def test_a_recording_holds_scene_instances_lines_and_rounds(rr, tmp_path, form):
    corr = SCENE.corr
    if form == "points":
        corr = np.hstack([SCENE.src[corr[:, 0]], SCENE.tgt[corr[:, 1]]])
    path = tmp_path / "found.rrd"
    ibi.viz.record(SCENE.tgt, SCENE.src, FOUND, path, corr=None if form is None else corr, max_outliers=50)
    rows = read(path)
    np.testing.assert_allclose(column(rows["/scene"], "positions"), SCENE.tgt, atol=1e-5)
    for k, pose in enumerate(FOUND):
        here = rows[f"/instances/{k}"]
        turn = column(here, "mat3x3").reshape(3, 3).T  # Rerun keeps columns
        np.testing.assert_allclose(turn, pose.target_from_source[:3, :3], atol=1e-6)
        np.testing.assert_allclose(column(here, "translation")[0], pose.target_from_source[:3, 3], atol=1e-5)
        assert column(here, "score") == pytest.approx(pose.score)
        assert {row["round"] for row in here} == {pose.round}
        np.testing.assert_allclose(column(rows[f"/instances/{k}/model"], "positions"), SCENE.src, atol=1e-5)
        if form is not None:
            strips = column(rows[f"/correspondences/{k}"], "strips")
            assert len(strips) == (FOUND.labels == k).sum()
            ends = SCENE.tgt[SCENE.corr[FOUND.labels == k, 1]]
            np.testing.assert_allclose(strips[:, 1], ends, atol=1e-5)
            begins = SCENE.src[SCENE.corr[FOUND.labels == k, 0]] + column(rows["/model"], "translation")
            np.testing.assert_allclose(strips[:, 0], begins, atol=1e-5)
    if form is None:
        assert not [name for name in rows if name.startswith("/correspondences")]
    else:
        assert len(column(rows["/correspondences/none"], "strips")) == 50
    seeds = {row["round"]: row["scalars"][0] for row in rows["/rounds/seeds"]}
    assert seeds == {played.index: played.num_seeds for played in FOUND.rounds}
    words = {row["round"]: row["text"][0] for row in rows["/rounds/log"]}
    for played in FOUND.rounds:
        assert ("accepted" in words[played.index]) == played.accepted


def test_a_recording_of_nothing_found(rr, tmp_path):
    found = ibi.register(SCENE.src, SCENE.tgt, SCENE.corr[:0])
    ibi.viz.record(SCENE.tgt, SCENE.src, found, tmp_path / "none.rrd", corr=SCENE.corr[:0])
    rows = read(tmp_path / "none.rrd")
    assert "/scene" in rows
    assert not [name for name in rows if name.startswith("/instances")]


def test_what_cannot_be_recorded_is_refused(rr, tmp_path):
    path = tmp_path / "found.rrd"
    with pytest.raises(ibi.InputError, match=r"^corr has 9 rows; the registration has 600 labels$"):
        ibi.viz.record(SCENE.tgt, SCENE.src, FOUND, path, corr=SCENE.corr[:9])
    with pytest.raises(ibi.InputError, match=r"^corr\[0, 1\] is \d+; tgt has rows 0 to 2$"):
        ibi.viz.record(SCENE.tgt[:3], SCENE.src, FOUND, path, corr=SCENE.corr)
    with pytest.raises(OSError, match="nowhere"):
        ibi.viz.record(SCENE.tgt, SCENE.src, FOUND, tmp_path / "nowhere" / "found.rrd")


def test_without_rerun_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ImportError, match=r"^recordings need Rerun: pip install 'ibi_rs\[viz\]'"):
        ibi.viz.record(SCENE.tgt, SCENE.src, FOUND, "found.rrd")
