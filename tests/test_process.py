"""Forks, spawned workers, threads, Ctrl-C, time limits, and what an import costs.

What could hang runs in a process of its own with a time limit, so that a hang is a failure.
"""

import json
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import warnings
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import fields
from typing import get_args

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs.variants import Ce, Hv, Scs, Te

LIMIT_S = 30  # for what takes about a second


def scene_of(seed):
    return ibi.synth.outlier_layout(seed, num_instances=3, num_correspondences=600, num_points=256)


def solve(seed):
    """The bytes of a result; at module level, so that workers can be sent here."""
    scene = scene_of(seed)
    found = ibi.register(scene.src, scene.tgt, scene.corr, num_threads=2)
    return np.asarray(found).tobytes(), found.labels.tobytes(), found.rounds


def solve_whole(seed):
    scene = scene_of(seed)
    return ibi.register(scene.src, scene.tgt, scene.corr, num_threads=2)


def fail(kind):
    scene = scene_of(0)
    if kind == "input":
        ibi.register(scene.src[:1], scene.tgt, scene.corr)
    ibi.Params(t_s=1)


# A registration of minutes, for what ends one early. Each keeps another stage busy.
LONG = {
    "scs, many steps": ibi.Params(scs=ibi.Gtm(n_gtm=10_000_000)),
    "scs, many players": ibi.Params(scs=ibi.Gtm(n_downsample=16_384, n_gtm=10_000)),
    "scs, dense graph": ibi.Params(scs=ibi.LocalGtm(tau_pr=3, max_degree=1_000_000, first_look=None)),
    "te, many samples": ibi.Params(te=ibi.Ransac(n_ransac=10_000_000)),
    "te, many triangles": ibi.Params(
        ce=ibi.Voting(n_vot=1024), te=ibi.SacCot(n_sac_cot=1_000_000, t_cmp=0, max_triangles=1_000_000_000)
    ),
    "te, many cliques": ibi.Params(te=ibi.Mac(t_sog=0, max_cliques=1_000_000_000, max_steps=1_000_000_000)),
}
each_long = pytest.mark.parametrize("name", LONG)


def run_long(name, **options):
    # Each correspondence many times: enough for the largest sample, and for a graph that takes seconds.
    copies = 8 if name == "scs, dense graph" else 20
    scene = ibi.synth.outlier_layout(0, num_instances=3, num_correspondences=1000, outlier_ratio=0.7)
    return ibi.register(scene.src, scene.tgt, np.tile(scene.corr, (copies, 1)), LONG[name], **options)


# Other processes -----------------------------------------------------------------------------------------


def test_a_forked_child_can_register():
    """A fork copies the parent's memory but not its threads: a shared thread pool would wait for ever."""
    expected = solve(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12: threads may be about
        context = multiprocessing.get_context("fork")
        queue = context.SimpleQueue()
        child = context.Process(target=lambda: queue.put(solve(0) == expected))
        child.start()
    child.join(LIMIT_S)
    hangs = child.is_alive()
    if hangs:
        child.kill()
    assert not hangs
    assert child.exitcode == 0
    assert queue.get() is True


def test_a_bare_fork_can_register():
    solve(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        try:
            os._exit(0 if solve(0) else 1)
        finally:
            os._exit(2)
    deadline = time.monotonic() + LIMIT_S
    while (status := os.waitpid(child, os.WNOHANG)) == (0, 0) and time.monotonic() < deadline:
        time.sleep(0.01)
    if status == (0, 0):
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    assert status == (child, 0)


def test_spawned_workers_send_results_and_errors():
    seeds = [0, 1, 2]
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        found = list(pool.map(solve_whole, seeds, timeout=LIMIT_S))
        errors = [pool.submit(fail, kind).exception(LIMIT_S) for kind in ("input", "params")]
    for twin, seed in zip(found, seeds, strict=True):
        assert (np.asarray(twin).tobytes(), twin.labels.tobytes(), twin.rounds) == solve(seed)
        assert pickle.loads(pickle.dumps(twin)).params == twin.params
    assert [type(error) for error in errors] == [ibi.InputError, ibi.ParamsError]
    assert str(errors[0]).startswith("src has 1 points")


# Threads -------------------------------------------------------------------------------------------------


def test_registrations_side_by_side_are_those_one_by_one():
    seeds = list(range(6)) * 3
    serial = {seed: solve(seed) for seed in set(seeds)}
    with ThreadPoolExecutor(6) as pool:
        assert list(pool.map(solve, seeds, timeout=LIMIT_S)) == [serial[seed] for seed in seeds]


def test_python_runs_on_while_a_registration_does():
    """Without the GIL released the ticks would stop for as long as the registration lasts."""
    ticks, done = [], threading.Event()

    def tick():
        while not done.wait(0.005):
            ticks.append(time.monotonic())

    ticker = threading.Thread(target=tick)
    ticker.start()
    start = time.monotonic()
    found = run_long("scs, many steps", timeout_s=0.5)
    end = time.monotonic()
    done.set()
    ticker.join(LIMIT_S)
    assert found.stop_reason.name == "timeout"
    assert sum(start < t < end for t in ticks) >= 20  # of about 100


def test_a_registration_in_a_thread_ends_by_its_limit_or_an_error():
    """Signals reach the main thread only; elsewhere the rest must still work."""
    with ThreadPoolExecutor(1) as pool:
        assert (
            pool.submit(run_long, "scs, many steps", timeout_s=0.05).result(LIMIT_S).stop_reason.name
            == "timeout"
        )
        with pytest.raises(ibi.InputError):
            pool.submit(fail, "input").result(LIMIT_S)


# Ending early --------------------------------------------------------------------------------------------

INTERRUPTED = """
import sys, time
sys.path.insert(0, sys.argv[1])
import test_process
print("ready", flush=True)
try:
    test_process.run_long(sys.argv[2])
    print("ran to its end")
except KeyboardInterrupt:
    print(time.monotonic(), flush=True)
"""


@each_long
@pytest.mark.parametrize("after_s", [0.3, 1.0])
def test_ctrl_c_ends_a_registration_at_once(name, after_s):
    """About 0.1 s is promised; 1 s is asked, for a machine that is busy with something else."""
    command = [sys.executable, "-c", INTERRUPTED, os.path.dirname(__file__), name]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert child.stdout.readline() == "ready\n"
        time.sleep(after_s)
        child.send_signal(signal.SIGINT)
        sent = time.monotonic()
        out, err = child.communicate(timeout=LIMIT_S)
    finally:
        child.kill()
    assert (err, child.returncode) == ("", 0)
    latency_s = float(out) - sent
    print(f"{name}: KeyboardInterrupt {latency_s:.3f} s after Ctrl-C")
    assert latency_s < 1


@each_long
@pytest.mark.parametrize("timeout_s", [0.05, 0.3])
def test_a_time_limit_is_kept_within_a_stage(name, timeout_s):
    start = time.monotonic()
    found = run_long(name, timeout_s=timeout_s)
    late_s = time.monotonic() - start - timeout_s
    print(f"{name}: {late_s:.3f} s after the limit of {timeout_s} s")
    assert found.stop_reason.name == "timeout"
    assert found.stop_reason.threshold == timeout_s
    assert found.stop_reason.value >= timeout_s
    assert found.rounds == ()
    assert late_s < 1


# The largest number of everything that is counted, in the way that a typing error or a search over
# parameters gives it: it may be refused and it may take long, but not for ever and not all memory.
COUNTS = [
    (stage, variant.variant, field.name)
    for stage, union in (("scs", Scs), ("ce", Ce), ("te", Te), ("hv", Hv))
    for variant in get_args(union)
    for field in fields(variant)
    if isinstance(field.default, int)
]
WITHIN_4_GB = """
import resource, sys
sys.path.insert(0, sys.argv[1])
import ibi_rs as ibi
from test_process import scene_of
resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
scene, (stage, variant, field) = scene_of(0), sys.argv[2:]
try:
    params = ibi.Params.from_dict({stage: {"variant": variant, field: 2**32 - 1}})
except ibi.ParamsError as error:
    print(error)
else:
    similarity = [1.0] * len(scene.corr)
    print(ibi.register(scene.src, scene.tgt, scene.corr, params, similarity=similarity, timeout_s=0.5))
"""


@pytest.mark.parametrize("count", COUNTS, ids="-".join)
def test_an_enormous_number_is_survived(count):
    command = [sys.executable, "-c", WITHIN_4_GB, os.path.dirname(__file__), *count]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S / 2, check=False)
    assert (ran.stderr, ran.returncode) == ("", 0)
    assert ran.stdout.startswith(("Registration: ", f"params.{count[0]}.{count[2]} is 4294967295; it must"))


# Importing -----------------------------------------------------------------------------------------------

IMPORT = """
import json, sys, time
start = time.perf_counter()
import numpy
between = time.perf_counter()
import ibi_rs
end = time.perf_counter()
print(json.dumps([between - start, end - between, sorted({name.partition(".")[0] for name in sys.modules})]))
"""


def imported():
    """Seconds of numpy, seconds of ibi_rs on top of it, and what was imported; without sitecustomize."""
    # -S also drops site-packages, so the path is handed over.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-S", "-c", IMPORT]
    ran = subprocess.run(
        command, capture_output=True, text=True, env=environment, timeout=LIMIT_S, check=True
    )
    return json.loads(ran.stdout)


def test_importing_is_quick_and_brings_nothing_but_numpy():
    runs = [imported() for _ in range(5)]
    numpy_s, own_s = (min(run[i] for run in runs) for i in (0, 1))
    print(f"import numpy {numpy_s:.3f} s, then ibi_rs {own_s:.3f} s")
    assert own_s < max(0.2, numpy_s)
    foreign = set(runs[0][2]) - sys.stdlib_module_names - {"numpy", "ibi_rs", "__main__", "__mp_main__"}
    assert not {
        name for name in foreign if not name.startswith(("_distutils", "sitecustomize", "_sysconfig"))
    }
