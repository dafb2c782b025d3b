"""Limits outside of the rounds: time counts from the call, and Ctrl-C is heard wherever a call takes long."""

import signal
import threading
import time

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import _core, features, metrics
from test_process import LIMIT_S


def ball(count, seed=0):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1)[:, None]


def poses(count):
    placed = np.tile(np.eye(4), (count, 1, 1))
    placed[:, :3, 3] = ball(count)
    return placed


# A time limit of detect -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def part():
    corners = [[x, y, z] for x in (0, 3) for y in (0, 2) for z in (0, 1)]
    sides = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    sides += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    return ibi.Model.from_mesh(corners, sides)


@pytest.fixture(scope="module")
def scan(part):
    table = np.stack(np.meshgrid(np.arange(-3, 9, 0.1), np.arange(-3, 9, 0.1), [0.0]), -1).reshape(-1, 3)
    return np.concatenate([part.points, part.points + np.array([4.0, 3.0, 0.0]), table])


def check_out_of_time(found, params):
    assert (len(found), found.rounds) == (0, ())
    assert (found.labels == -1).all()
    assert found.params == params
    reason = found.stop_reason
    assert (reason.name, reason.threshold) == ("timeout", params.timeout_s)
    assert str(reason) == f"timeout: {reason.value:.3f} s passed, {params.timeout_s:g} s allowed"
    assert min(reason.value, found.timings.total_s) > 0
    assert found.resolution >= 0
    assert repr(found).startswith("Registration: 0 instances in 0 rounds")


def test_no_time_at_all(part, scan):
    params = ibi.Params.single_view()
    found = part.detect(scan, viewpoint=[3, 3, 20], timeout_s=0)
    check_out_of_time(found, params.replace(timeout_s=0))
    found = part.detect(scan, params.replace(timeout_s=0), viewpoint=[3, 3, 20])
    check_out_of_time(found, params.replace(timeout_s=0))


def test_the_rounds_have_what_is_left(part, scan):
    start, timeout_s = time.perf_counter(), 2.0

    def until_time_is_up(_round):
        while time.perf_counter() - start < timeout_s:
            pass

    found = part.detect(scan, viewpoint=[3, 3, 20], timeout_s=timeout_s, callback=until_time_is_up)
    assert found.stop_reason.name == "timeout"
    assert found.stop_reason.threshold == timeout_s <= found.stop_reason.value
    assert found.params.timeout_s == timeout_s


def test_what_is_wrong_is_said_before_time_runs_out(part, scan):
    with pytest.raises(_core.ParamsError, match="timeout_s"):
        part.detect(scan, viewpoint=[3, 3, 20], timeout_s=-1)
    with pytest.raises(TypeError, match="params"):
        part.detect(scan, "single_view", viewpoint=[3, 3, 20])


# Ctrl-C -----------------------------------------------------------------------------------------------


def _model():
    return ibi.Model(ball(20_000))


TORUS = np.stack([np.cos(np.arange(48) / 7.6), np.sin(np.arange(48) / 7.6), np.arange(48) % 3], -1)
FACES = np.stack([np.arange(46), np.arange(1, 47), np.arange(2, 48)], -1)

CALLS = {
    "Model": ("Spacing", _model),
    "diameter": ("Diameter", lambda: metrics.diameter(ball(20_000))),
    "diameter of a model": ("Diameter", lambda: _model().diameter),
    "add_s": ("Metrics", lambda: metrics.add_s(ball(20_000), *poses(2))),
    "mssd": ("Metrics", lambda: metrics.mssd(ball(20_000), *poses(2), symmetries=poses(50))),
    "assignment": ("Metrics", lambda: metrics.assignment(np.outer(np.arange(150), np.arange(150)))),
    "score_scene": ("Metrics", lambda: metrics.score_scene(poses(100), poses(100))),
    "score_scene by ADD-S": (
        "Metrics",
        lambda: metrics.score_scene(poses(5), poses(5), criterion=metrics.ADD_S, model=ball(5000)),
    ),
    "mssd_recall": ("Metrics", lambda: metrics.mssd_recall(poses(9), poses(9), model=ball(5000))),
    "find_symmetries": ("Symmetries", lambda: ibi.find_symmetries(ball(1000))),
    "voxel_downsample": ("Thin", lambda: features.voxel_downsample(ball(100_000), 0.01)),
    "estimate_normals": ("Normals", lambda: features.estimate_normals(ball(20_000), 0.1)),
    "fpfh": ("Fpfh", lambda: features.fpfh(ball(20_000), ball(20_000), 0.1)),
    "match": ("Match", lambda: ibi.match(ball(5000), ball(5000, 1))),
    "dominant_plane": ("Plane", lambda: features.dominant_plane(ball(50_000), 0.01)),
    "sample_mesh": ("SampleMesh", lambda: features.sample_mesh(TORUS, FACES, n=3000)),
    "outer_surface": (
        "OuterSurface",
        lambda: features.outer_surface(ball(5000), ball(5000), TORUS, FACES, num_views=500),
    ),
}


@pytest.mark.parametrize("num_threads", ["1", "2"])
@pytest.mark.parametrize("name", CALLS)
def test_ctrl_c_is_heard_within_the_call(monkeypatch, name, num_threads):
    monkeypatch.setenv("IBI_NUM_THREADS", num_threads)
    phase, call = CALLS[name]
    heard, within = threading.Event(), []

    def handler(_signal, _frame):
        heard.set()
        raise KeyboardInterrupt

    def told(begins):
        # The call goes on once the signal was seen: which so happens while it lasts.
        if begins == phase and not within:
            within.append(None)
            signal.raise_signal(signal.SIGINT)
            within[0] = heard.wait(LIMIT_S)

    before = signal.signal(signal.SIGINT, handler)
    _core._watch(told)
    try:
        with pytest.raises(KeyboardInterrupt):
            call()
    finally:
        _core._watch(None)
        signal.signal(signal.SIGINT, before)
    assert within == [True]
