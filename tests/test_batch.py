"""`register_batch`: in order, with errors, with dying workers; tests/test_clusters.py has the clusters."""

import itertools
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import threading
import warnings
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import _batch
from test_process import LIMIT_S, scene_of, watched

TEE = Path(__file__).parents[1] / "examples/tee"
SPAWN = multiprocessing.get_context("spawn")
SCENES = [scene_of(seed) for seed in range(6)]
MODEL = ibi.Model(SCENES[0].src)


def content(found):
    """What must not depend on where it was found."""
    if isinstance(found, ibi.JobError):
        return str(found)
    poses = [(pose.score, pose.inliers.tolist()) for pose in found]
    return np.asarray(found).tobytes(), poses, found.labels.tobytes(), found.rounds, found.stop_reason


def job_of(index, **options):
    scene = SCENES[index % len(SCENES)]
    return ibi.Job(ibi.Model(scene.src), scene.tgt, scene.corr, **options)


JOBS = [
    job_of(0),
    job_of(1),
    job_of(2, name="cut", tgt_normals=[[0, 0]]),
    job_of(3, max_instances=1),
    job_of(4),
]
ERROR = "job 2, cut: tgt_normals has shape (1, 2); it must be (N, 3)"
EXPECTED = [content(job.run(num_threads=2)) if job.name is None else ERROR for job in JOBS]


@dataclass(frozen=True, eq=False, repr=False)
class Deadly(ibi.Job):
    """Kills its worker: always, or, with the name of a file, until that exists."""

    def run(self, **options):
        if self.name and os.path.exists(self.name):
            return super().run(**options)
        if self.name:
            Path(self.name).touch()
        os.kill(os.getpid(), signal.SIGKILL)


OTHERS_HAVE_ENDED = threading.Event()


@dataclass(frozen=True, eq=False, repr=False)
class Last(ibi.Job):
    """Ends after the others, in a thread."""

    def run(self, **options):
        assert OTHERS_HAVE_ENDED.wait(LIMIT_S)
        return super().run(**options)


@dataclass(frozen=True, eq=False, repr=False)
class Telling(ibi.Job):
    """Prints "ready" once its first stage begins."""

    def run(self, **options):
        with watched(lambda phase: phase == "Select" and os.write(1, b"ready\n")):  # `print` is two writes
            return super().run(**options)


def processes(method, workers=2):
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context(method))


def values(jobs, *arguments, **options):
    return [content(found) for found in ibi.register_batch(jobs, *arguments, **options)]


# The same everywhere -------------------------------------------------------------------------------------


def test_a_job_is_register():
    scene = SCENES[1]
    params = ibi.Params(t_s=5)
    job = ibi.Job(ibi.Model(scene.src), scene.tgt, scene.corr, params, max_instances=2)
    whole = ibi.register(scene.src, scene.tgt, scene.corr, params, max_instances=2)
    assert content(job.run()) == content(whole)


@pytest.mark.parametrize("num_threads", [None, 1, 3])
def test_own_threads_give_results_and_errors_in_order(num_threads):
    assert values(JOBS, num_threads=num_threads) == EXPECTED
    assert values(JOBS, 3, num_threads=num_threads) == EXPECTED


def test_any_executor_serves_and_is_left_running():
    with ThreadPoolExecutor(3) as pool:
        assert values(JOBS, pool) == EXPECTED
        assert values(iter(JOBS), pool, window=1) == EXPECTED
        assert pool.submit(int, "3").result() == 3


def test_spawned_workers_serve():
    assert values(JOBS, partial(processes, "spawn")) == EXPECTED


def test_forked_workers_serve():
    values(JOBS[:1])  # so that this process has had threads
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12: threads may be about
        with processes("fork") as pool:
            assert values(JOBS, pool) == EXPECTED


def test_a_mesh_and_files_give_what_detect_does():
    model = ibi.Model.from_mesh(*ibi.io.read_mesh(TEE / "model_tee_mesh.ply"))
    scan, normals = ibi.io.read_cloud(TEE / "tee6.ply")
    jobs = [
        ibi.Job(model, TEE / "tee6.ply", viewpoint=[0, 0, 0], max_instances=1),
        ibi.Job(model, scan, viewpoint=[0, 0, 0], max_instances=1, remove_plane=False),
        ibi.Job(model, str(TEE / "none.ply"), viewpoint=[0, 0, 0]),
        ibi.Job(model, TEE / "tee6.ply"),
    ]
    first, second, missing, blind = ibi.register_batch(jobs)
    assert content(first) == content(model.detect(scan, viewpoint=[0, 0, 0], max_instances=1))
    assert content(second) == content(
        model.detect(scan, viewpoint=[0, 0, 0], max_instances=1, remove_plane=False)
    )
    assert str(missing) == f"job 2: {TEE / 'none.ply'}: no such file"
    assert normals is None
    assert str(blind).startswith(f"job 3, {TEE / 'tee6.ply'}: viewpoint: give it")


def test_the_normals_in_a_file_serve_where_nothing_else_does(tmp_path):
    corners = np.array([[x, y, z] for x in (0, 3) for y in (0, 2) for z in (0, 1)], float)
    sides = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    sides += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    model = ibi.Model.from_mesh(corners, sides)
    np.save(tmp_path / "box.npy", np.hstack([model.points, model.normals]))
    (found,) = ibi.register_batch([ibi.Job(model, tmp_path / "box.npy")])
    assert content(found) == content(model.detect(model.points, tgt_normals=model.normals))


def test_jobs_and_errors_can_be_pickled_and_share_a_model():
    first, second = (pickle.loads(pickle.dumps(ibi.Job(MODEL, SCENES[0].tgt, SCENES[0].corr))) for _ in "ab")
    assert first.model is second.model
    assert content(first.run()) == content(second.run()) == EXPECTED[0]
    error = pickle.loads(pickle.dumps(ibi.JobError(3, "c.ply", ibi.InputError("tgt is bad"))))
    assert (error.index, error.name, type(error.error)) == (3, "c.ply", ibi.InputError)
    assert str(error) == "job 3, c.ply: tgt is bad"
    assert repr(ibi.Job(MODEL, "a.ply")).startswith("Job(a.ply, Model(256 points")


# Windows and progress ------------------------------------------------------------------------------------


def test_a_generator_is_asked_for_no_more_than_the_window():
    taken = 0

    def endless():
        nonlocal taken
        for index in itertools.count():
            taken += 1
            yield job_of(index)

    found = ibi.register_batch(endless(), window=3)
    assert taken == 0
    for turn in range(8):
        assert content(next(found))
        assert taken <= turn + 3
    found.close()
    assert taken <= 10


def test_results_wait_for_their_turn_and_progress_does_not():
    scene, told = SCENES[0], []
    jobs = [Last(MODEL, scene.tgt, scene.corr), *(job_of(0) for _ in range(3))]

    def tell(*ended):
        told.append(ended)
        if len(told) == 3:
            OTHERS_HAVE_ENDED.set()

    OTHERS_HAVE_ENDED.clear()
    with ThreadPoolExecutor(2) as pool:
        found = list(ibi.register_batch(jobs, pool, callback=tell))
    assert [index for index, _ in told][-1] == 0
    assert sorted(index for index, _ in told) == [0, 1, 2, 3]
    assert all(found[index] is value for index, value in told)


def test_what_the_callback_raises_ends_the_batch():
    told = []

    def full(index, found):
        told.append((index, found))
        raise OSError("the disk is full")

    with pytest.raises(OSError, match="the disk is full"):
        list(ibi.register_batch(JOBS[:2], 1, callback=full))
    ((index, found),) = told  # once, and not as an error of the job
    assert (index, content(found)) == (0, EXPECTED[0])


def test_cores_are_shared_and_not_oversubscribed(monkeypatch):
    assert _batch._share(8, 100, None, None) == (8, 1)
    assert _batch._share(8, 3, None, None) == (3, 2)
    assert _batch._share(8, 0, None, None) == (1, 8)
    assert _batch._share(8, 100, 3, None) == (2, 3)
    assert _batch._share(2, 100, 16, None) == (1, 16)
    assert _batch._share(8, 100, None, 3) == (3, 2)
    assert _batch._share(8, 2, 1, 3) == (2, 1)
    assert 1 <= _batch._cores() <= os.cpu_count()
    monkeypatch.setenv("IBI_NUM_THREADS", "5")
    assert _batch._cores() == 5


def test_no_jobs_give_no_results():
    assert values([]) == []
    assert values(iter(()), partial(ThreadPoolExecutor, 1)) == []


# Refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "kind", "message"),
    [
        ({"executor": "3"}, TypeError, "executor must be a concurrent.futures.Executor .* not str"),
        ({"executor": 0}, ibi.InputError, "executor is 0; it must be at least 1"),
        ({"executor": True}, TypeError, "executor must be an integer, not bool"),
        ({"jobs": 3}, TypeError, "jobs must be an iterable of ibi_rs.Job, not int"),
        ({"callback": 3}, TypeError, "callback must be callable, not int"),
        ({"window": 0}, ibi.InputError, "window is 0; it must be at least 1"),
        ({"retries": -1}, ibi.InputError, "retries is -1; it must be at least 0"),
        ({"num_threads": 0}, ValueError, "num_threads is 0; it must be an integer from 1"),
    ],
)
def test_arguments_are_refused_at_once(options, kind, message):
    with pytest.raises(kind, match=message):
        ibi.register_batch(**{"jobs": [], **options})


def test_what_an_executor_is_made_by_must_make_one():
    with pytest.raises(TypeError, match=r"^executor must make a concurrent\.futures\.Executor, not dict"):
        list(ibi.register_batch(JOBS[:1], dict))
    assert values(JOBS[:2], np.int64(2)) == EXPECTED[:2]


def test_a_job_refuses_what_has_no_say():
    with pytest.raises(TypeError, match=r"model must be ibi_rs\.Model, not ndarray"):
        ibi.Job(SCENES[0].src, SCENES[0].tgt)
    with pytest.raises(ibi.InputError, match="similarity has no say without corr"):
        ibi.Job(MODEL, SCENES[0].tgt, similarity=[1])
    with pytest.raises(ibi.InputError, match="remove_plane has no say with corr"):
        ibi.Job(MODEL, SCENES[0].tgt, SCENES[0].corr, remove_plane=True)


def test_what_goes_wrong_in_the_iterable_comes_after_the_results_before_it():
    def broken():
        yield from JOBS[:2]
        raise OSError("the disk is gone")

    for jobs, kind in (([*JOBS[:2], "a.ply"], TypeError), (broken(), OSError)):
        found = ibi.register_batch(jobs)
        assert [content(next(found)), content(next(found))] == EXPECTED[:2]
        with pytest.raises(kind, match=r"^jobs\[2\] must be ibi_rs.Job, not str|^the disk is gone"):
            next(found)


def test_what_cannot_be_sent_is_an_error_in_its_place():
    jobs = [JOBS[0], job_of(1, params=ibi.Params(te=lambda *_: None)), JOBS[1]]
    first, bad, last = ibi.register_batch(jobs, partial(processes, "spawn", 1))
    assert [content(first), content(last)] == EXPECTED[:2]
    assert isinstance(bad, ibi.JobError)
    assert "<lambda>" in str(bad)
    pool = ThreadPoolExecutor(1)
    pool.shutdown()
    assert values(JOBS[:1], pool) == ["job 0: RuntimeError: cannot schedule new futures after shutdown"]


# Dying workers -------------------------------------------------------------------------------------------


def test_only_the_job_that_kills_its_worker_is_lost():
    scene = SCENES[0]
    jobs = [job_of(0), Deadly(MODEL, scene.tgt, scene.corr), *(job_of(index) for index in (1, 0, 1, 0))]
    made = []

    def make():
        made.append(processes("spawn"))
        return made[-1]

    found = list(ibi.register_batch(jobs, make, retries=1))
    lost = found.pop(1)
    assert isinstance(lost, ibi.JobError)
    assert isinstance(lost.error, BrokenProcessPool)
    assert [content(one) for one in found] == [EXPECTED[index] for index in (0, 1, 0, 1, 0)]
    assert len(made) == 4  # once beside others, twice alone
    with pytest.raises(RuntimeError):  # shut down
        made[-1].submit(int)


def test_a_worker_that_dies_once_costs_nothing(tmp_path):
    scene = SCENES[0]
    jobs = [Deadly(MODEL, scene.tgt, scene.corr, name=str(tmp_path / "was here")), *JOBS[1:]]
    assert values(jobs, partial(processes, "spawn"), retries=0) == EXPECTED


def test_a_worker_that_dies_while_large_jobs_are_sent_costs_nothing(tmp_path):
    scene = SCENES[0]
    large = np.concatenate([scene.tgt, np.random.default_rng(0).uniform(-2, 2, (100_000, 3))])
    jobs = [ibi.Job(MODEL, large, scene.corr[:4]) for _ in range(8)]
    jobs[1] = Deadly(MODEL, large, scene.corr[:4], name=str(tmp_path / "was here"))
    found = list(ibi.register_batch(jobs, partial(processes, "spawn")))
    assert [len(one) for one in found] == [0] * 8


def test_with_an_executor_of_the_callers_what_is_lost_is_told():
    scene = SCENES[0]
    with processes("spawn", 1) as pool:
        found = list(ibi.register_batch([Deadly(MODEL, scene.tgt, scene.corr), *JOBS], pool))
    assert len(found) == 1 + len(JOBS)
    assert all(isinstance(one.error, BrokenProcessPool) for one in found)


class Doomed(Executor):
    """Whose every job is cancelled."""

    def submit(self, fn, /, *arguments, **options):
        future = Future()
        future.cancel()
        future.set_running_or_notify_cancel()
        return future


def test_cancelled_jobs_are_errors():
    assert values(JOBS[:2], Doomed()) == ["job 0: CancelledError", "job 1: CancelledError"]


# Ending early --------------------------------------------------------------------------------------------


def long_job(kind=ibi.Job):
    """Thousands of short rounds: a batch ends between two of them."""
    scene = ibi.synth.outlier_layout(0, num_instances=3, num_correspondences=1000, outlier_ratio=0.7)
    params = ibi.Params(
        max_rejections=None, t_s=3, scs=ibi.Gtm(n_gtm=500), ce=ibi.Voting(n_vot=3), removal="dense"
    )
    return kind(ibi.Model(scene.src), scene.tgt, np.tile(scene.corr, (20, 1)), params)


def test_closing_ends_what_is_under_way():
    def jobs():
        yield job_of(0)
        while True:
            yield long_job()

    found = ibi.register_batch(jobs())
    assert len(next(found)) > 0
    with ThreadPoolExecutor(1) as pool:
        pool.submit(found.close).result(LIMIT_S)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("ibi-batch")]


INTERRUPTED = """
import sys
from functools import partial
sys.path.insert(0, sys.argv[1])
import ibi_rs as ibi, test_batch
if __name__ == "__main__":
    executor = partial(test_batch.processes, "spawn") if sys.argv[2] == "processes" else None
    try:
        for found in ibi.register_batch([test_batch.long_job(test_batch.Telling)] * 6, executor):
            print("ran to its end")
    except KeyboardInterrupt:
        print("interrupted")
"""


@pytest.mark.parametrize(("where", "workers"), [("threads", 1), ("processes", 2)])
def test_ctrl_c_ends_a_batch(where, workers, tmp_path):
    script = tmp_path / "interrupted.py"
    script.write_text(INTERRUPTED)
    command = [sys.executable, str(script), os.path.dirname(__file__), where]
    # A session of its own, in which Ctrl-C reaches all processes, as in a terminal.
    child = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        for _ in range(workers):
            assert child.stdout.readline() == "ready\n"
        os.killpg(child.pid, signal.SIGINT)
        out, err = child.communicate(timeout=LIMIT_S)
    finally:
        child.kill()
    print(err)
    assert child.returncode == 0, err
    assert [line for line in out.splitlines() if line != "ready"] == ["interrupted"]
