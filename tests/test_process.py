"""Forks, spawned workers, threads, Ctrl-C, time limits, the end of the process, and what an import brings.

What could hang runs in a process of its own with a time limit, so that a hang is a failure. Nothing else is
timed: a test waits until the run says what it has begun.
"""

import json
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import time
import warnings
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import fields
from typing import get_args

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs.variants import Ce, Hv, Scs, Te

LIMIT_S = 1200  # of what takes about a second: that long is a hang on any machine


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


# A registration of minutes, for what ends one early, and the phase that it spends them in.
LONG = {
    "scs, many steps": ("Select", ibi.Params(scs=ibi.Gtm(n_gtm=10_000_000))),
    "scs, many players": ("Select", ibi.Params(scs=ibi.Gtm(n_downsample=16_384, n_gtm=10_000))),
    "te, many samples": ("Estimate", ibi.Params(te=ibi.Ransac(n_ransac=10_000_000))),
    "te, many triangles": (
        "Estimate",
        ibi.Params(
            ce=ibi.Voting(n_vot=1024),
            te=ibi.SacCot(n_sac_cot=1_000_000, t_cmp=0, max_triangles=1_000_000_000),
        ),
    ),
    "te, many cliques": (
        "Estimate",
        ibi.Params(te=ibi.Mac(t_sog=0, max_cliques=1_000_000_000, max_steps=1_000_000_000)),
    ),
}
# And one that has a phase of a second or so.
DENSE = "scs, dense graph"
LONG[DENSE] = ("Select", ibi.Params(scs=ibi.LocalGtm(tau_pr=3, max_degree=1_000_000, first_look=None)))
each_long = pytest.mark.parametrize("name", LONG)


def run_long(name, **options):
    # Each correspondence many times: enough for the largest sample, and for a graph that takes a while.
    copies = 8 if name == DENSE else 20
    scene = ibi.synth.outlier_layout(0, num_instances=3, num_correspondences=1000, outlier_ratio=0.7)
    return ibi.register(scene.src, scene.tgt, np.tile(scene.corr, (copies, 1)), LONG[name][1], **options)


@contextmanager
def watched(told):
    """Have all runs call `told` with the name of each phase as it begins."""
    ibi._core._watch(told)
    try:
        yield
    finally:
        ibi._core._watch(None)


def python(code, *arguments):
    """A Python of its own that runs `code`, in which the modules of this folder can be imported."""
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {os.path.dirname(__file__)!r})\n{code}"]
    return subprocess.Popen(
        [*command, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def ended(child):
    """What it printed, what it complained of, and its code."""
    try:
        out, err = child.communicate(timeout=LIMIT_S)
    finally:
        child.kill()
    return out, err, child.returncode


def interrupted(child):
    """The same of one that gets Ctrl-C once it prints "ready"."""
    line = child.stdout.readline()
    if line != "ready\n":
        child.kill()
        pytest.fail(f"{line!r}: {child.communicate()}")
    child.send_signal(signal.SIGINT)
    return ended(child)


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


RUNS_ON = """
import signal, threading
import test_process as t

begun = threading.Event()

def go_on():
    begun.wait()
    print(sum(range(100)))
    signal.raise_signal(signal.SIGINT)

threading.Thread(target=go_on).start()
try:
    with t.watched(lambda phase: phase == "Select" and begun.set()):
        t.run_long("scs, many steps")
except KeyboardInterrupt:
    print("interrupted")
"""


def test_python_runs_on_while_a_registration_does():
    """Without the GIL released the other thread, which alone ends the registration, would wait for it."""
    assert ended(python(RUNS_ON)) == ("4950\ninterrupted\n", "", 0)


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
import test_process as t
phase, params = t.LONG[sys.argv[1]]
begun = []

def told(name):
    begun.append(name)
    if begun.count(phase) == 1 and name == phase:
        print("ready", flush=True)

try:
    with t.watched(told):
        t.run_long(sys.argv[1])
    print("ran to its end")
except KeyboardInterrupt:
    print("interrupted")
"""


@each_long
def test_ctrl_c_ends_a_registration(name):
    assert interrupted(python(INTERRUPTED, name)) == ("interrupted\n", "", 0)


@each_long
@pytest.mark.parametrize("timeout_s", [0.05, 0.3])
def test_a_time_limit_ends_a_stage(name, timeout_s):
    long_phase, _ = LONG[name]
    limit = time.monotonic() + timeout_s

    def told(phase):
        # The limit strikes within the phase, however quick that is.
        if phase == long_phase and name == DENSE:
            time.sleep(max(0.0, limit - time.monotonic()))

    with watched(told):
        found = run_long(name, timeout_s=timeout_s)
    print(f"{name}: {time.monotonic() - limit:.3f} s after the limit of {timeout_s} s")
    assert found.stop_reason.name == "timeout"
    assert found.stop_reason.threshold == timeout_s
    assert found.stop_reason.value >= timeout_s
    assert found.rounds == ()


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
import json, resource
import ibi_rs as ibi
from test_process import scene_of
resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
scene = scene_of(0)
similarity = [1.0] * len(scene.corr)
for stage, variant, field in json.loads(sys.argv[1]):
    print(stage, variant, field, end=": ", flush=True)
    try:
        params = ibi.Params.from_dict({stage: {"variant": variant, field: 2**32 - 1}})
    except ibi.ParamsError as error:
        print(error)
    else:
        found = ibi.register(
            scene.src, scene.tgt, scene.corr, params, similarity=similarity, timeout_s=0.3
        )
        print(str(found).splitlines()[0])
"""


def test_an_enormous_number_is_survived():
    out, err, code = ended(python(WITHIN_4_GB, json.dumps(COUNTS)))
    assert (err, code) == ("", 0), out
    for (stage, variant, field), line in zip(COUNTS, out.splitlines(), strict=True):
        start = f"{stage} {variant} {field}: "
        refused = f"params.{stage}.{field} is 4294967295; it must"
        assert line.startswith((f"{start}Registration: ", start + refused))


# The end of the process ----------------------------------------------------------------------------------

ENDS = """
import os, threading
import ibi_rs as ibi
import test_process as t

scene = t.scene_of(0)
going = threading.Event()

def callback(round_):
    going.set()

def scs(context):
    going.set()
    return context.alive

def work(how):
    if how == "callback":
        ibi.register(scene.src, scene.tgt, scene.corr, callback=callback)
    elif how == "stage":
        ibi.register(scene.src, scene.tgt, scene.corr, ibi.Params(scs=scs))
    elif how == "register":
        t.run_long("scs, many steps")
    elif how == "features":
        going.set()
        ibi.features.fpfh(scene.src, scene.src, radius=10.0)

def loop(how, again):
    work(how)
    while again:
        work(how)

def end(how, again):
    # Whether this is the parent; a child comes to its end, in the middle of the work.
    child = os.fork()
    if child:
        print(how, again, os.waitpid(child, 0)[1], flush=True)
        return True
    if how == "register":
        ibi._core._watch(lambda phase: going.set())
    threading.Thread(target=loop, args=(how, again), daemon=True).start()
    going.wait()
    return False

all(end(how, again) for how in sys.argv[1:] for again in (False, True) for _ in range(10))
"""


def test_a_process_ends_while_a_daemon_is_at_work():
    """Of 20 runs 5 aborted: a stage returned to an interpreter that was being taken apart."""
    hows = ["callback", "stage", "register", "features"]
    lines = [f"{how} {again} 0\n" for how in hows for again in (False, True) for _ in range(10)]
    assert ended(python(ENDS, *hows)) == ("".join(lines), "", 0)


LAST = """
import atexit

def last():
    print(t.solve(0) == expected)

atexit.register(last)  # before the package has: it is called after it
import test_process as t
expected = t.solve(0)
"""


def test_at_the_end_of_the_process_the_main_thread_can_still_register():
    assert ended(python(LAST)) == ("True\n", "", 0)


# Importing -----------------------------------------------------------------------------------------------

IMPORT = """
import json, sys
import ibi_rs
print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))
"""


def test_importing_brings_nothing_but_numpy():
    # Without sitecustomize: -S also drops site-packages, so the path is handed over.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-S", "-c", IMPORT]
    ran = subprocess.run(
        command, capture_output=True, text=True, env=environment, timeout=LIMIT_S, check=True
    )
    foreign = set(json.loads(ran.stdout)) - sys.stdlib_module_names
    foreign -= {"numpy", "ibi_rs", "__main__", "__mp_main__"}
    assert not {
        name for name in foreign if not name.startswith(("_distutils", "sitecustomize", "_sysconfig"))
    }
