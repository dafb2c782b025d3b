"""Stages of the user's own: the results of the variants they mirror, what is refused, and how they end."""

import copy
import json
import os
import pickle
import subprocess
import sys
import threading
import time
import traceback
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import ibi_rs as ibi
import numpy as np
import pytest
from scipy.spatial import cKDTree
from test_process import LIMIT_S, ended, interrupted, python

SCENE = ibi.synth.outlier_layout(
    0, num_instances=4, num_correspondences=1000, outlier_ratio=0.6, min_spacing=2.0
)
PLAIN = ibi.Params()
# Of the paper's loop: no contest, no refinement, dense removal.
PAPER = ibi.Params.paper_synthetic().replace(t_he_pr=3, ce=ibi.Voting(n_vot=100))
STAGES = ("scs", "ce", "te", "hv")
each_stage = pytest.mark.parametrize("stage", STAGES)
each_count = pytest.mark.parametrize("num_threads", [1, 2])


def register(params, num_threads=2, scene=SCENE, **options):
    return ibi.register(scene.src, scene.tgt, scene.corr, params, num_threads=num_threads, **options)


def content(found):
    """What == can compare to the bit, but for the seconds and the parameters."""
    poses = [
        (p.target_from_source.tobytes(), p.score, p.overlap, p.inliers.tobytes(), p.round) for p in found
    ]
    return poses, found.labels.tobytes(), found.rounds, found.stop_reason, found.resolution


# Mirrors of variants -------------------------------------------------------------------------------------


def kabsch(p, q):
    center_p, center_q = p.mean(0), q.mean(0)
    u, _, vt = np.linalg.svd((q - center_q).T @ (p - center_p))
    u[:, -1] *= np.linalg.det(u @ vt)
    pose = np.eye(4)
    pose[:3, :3] = u @ vt
    pose[:3, 3] = center_q - pose[:3, :3] @ center_p
    return pose


def seeds_of_truth(context):
    """Of the instance with most alive correspondences the first 20 that may lead."""
    ids = np.setdiff1d(context.alive, context.barred)
    labels = SCENE.labels()[ids]
    if not (labels >= 0).any():
        return []
    return ids[labels == np.bincount(labels[labels >= 0]).argmax()][:20]


def off(context, seeds):
    return seeds


class Irls:
    """TE ``irls`` in numpy."""

    def __init__(self, params):
        self.params = params

    def __call__(self, context, dense):
        p, q, alive = context.src, context.tgt, context.alive
        t_he = self.params.t_he_pr * context.resolution

        def residuals(pose):
            return np.linalg.norm(p[alive] @ pose[:3, :3].T + pose[:3, 3] - q[alive], axis=1)

        trusted = dense.ids[dense.scores >= 0.5 * dense.scores[0]]
        pose = kabsch(p[trusted], q[trusted])
        for reach in (2, 2, 1, 1):
            inliers = alive[residuals(pose) < reach * t_he]
            if len(inliers) < 3:
                break
            pose = kabsch(p[inliers], q[inliers])
        return pose, np.maximum(0, 1 - residuals(pose) / t_he).sum()


def overlap(context, pose):
    """HV ``overlap`` of 0.85."""
    moved = context.src_points @ pose[:3, :3].T + pose[:3, 3]
    distance, _ = cKDTree(context.tgt_points).query(moved)
    return np.mean(distance <= PLAIN.d_op_pr * context.resolution), 0.85


def everything(context, pose):
    return True


def assert_alike(own, built_in):
    """Equal but for the last bits of poses and scores, which numpy computes in another order."""
    assert len(own) == len(built_in) > 0
    np.testing.assert_allclose(np.asarray(own), np.asarray(built_in), atol=1e-9)
    np.testing.assert_array_equal(own.labels, built_in.labels)
    assert own.stop_reason == built_in.stop_reason
    assert len(own.rounds) == len(built_in.rounds)
    for mine, theirs in zip(own.rounds, built_in.rounds, strict=True):
        for name in ("num_alive", "num_seeds", "num_dense", "accepted", "num_removed", "num_barred"):
            assert getattr(mine, name) == getattr(theirs, name), name
        assert mine.hypothesis_score == pytest.approx(theirs.hypothesis_score, rel=1e-4)


@each_count
@pytest.mark.parametrize("params", [PLAIN, PAPER], ids=["default", "paper"])
def test_an_enhancement_that_does_what_off_does(params, num_threads):
    own = register(params.replace(ce=off), num_threads)
    assert content(own) == content(register(params.replace(ce="off")))
    pairs = register(params.replace(ce=lambda _, seeds: (seeds.ids[::-1], seeds.scores[::-1])), num_threads)
    assert content(pairs) == content(own)


@each_count
@pytest.mark.parametrize("params", [PLAIN, PAPER], ids=["default", "paper"])
def test_an_estimation_that_does_what_irls_does(params, num_threads):
    params = params.replace(te="irls")
    assert_alike(register(params.replace(te=Irls(params)), num_threads), register(params))


@each_count
@pytest.mark.parametrize("params", [PLAIN, PAPER], ids=["default", "paper"])
def test_a_validation_that_does_what_overlap_does(params, num_threads):
    own = register(params.replace(hv=overlap), num_threads)
    assert len(own) >= 4
    assert content(own) == content(register(params.replace(hv="overlap")))


@each_count
def test_a_validation_that_accepts_everything(num_threads):
    own = register(PAPER.replace(hv=everything, max_rounds=6), num_threads)
    assert {round.verdict for round in own.rounds} == {ibi.Verdict(1, 0.5)}
    assert_alike(own, register(PAPER.replace(hv="none", max_rounds=6)))
    nothing = register(PAPER.replace(hv=lambda context, pose: np.False_, max_rounds=6), num_threads)
    assert (len(nothing), nothing.rounds[0].verdict) == (0, ibi.Verdict(0, 0.5))


@each_count
def test_a_selection_that_knows_the_truth(num_threads):
    """There is no variant to mirror: what it picks must be what goes on."""
    picked = []

    def scs(context):
        picked.append(seeds_of_truth(context))
        return picked[-1]

    found = register(PLAIN.replace(scs=scs), num_threads)
    assert ibi.metrics.score_scene(found, SCENE.poses).f1 == 1
    assert found.stop_reason.name == "few_seeds"
    assert [len(ids) for ids in picked] == [round.num_seeds for round in found.rounds] + [0]


@each_count
def test_fixed_sets_of_ids_go_through_the_rounds(num_threads):
    """Seeds and dense ones without scores all count the same: the pose is the fit to all of them."""
    true = np.flatnonzero(SCENE.labels() == 2)
    seen = []

    def te(context, dense):
        seen.append(dense)
        return kabsch(context.src[dense.ids], context.tgt[dense.ids])

    params = PAPER.replace(scs=lambda _: list(true[:5]), ce=lambda _, seeds: true[::-1].astype(np.uint16))
    params = params.replace(te=te, max_rounds=1)
    found = register(params, num_threads)
    np.testing.assert_array_equal(seen[0].ids, true)
    assert (seen[0].scores == 1).all()
    assert found.rounds[0].num_seeds == 5
    assert found.rounds[0].num_dense == len(seen[0]) == len(true)
    assert len(found) == 1
    # Without a score of its own a pose has the MAE of Eq. 7-8.
    p, q = SCENE.src[SCENE.corr[:, 0]], SCENE.tgt[SCENE.corr[:, 1]]
    pose = kabsch(p[seen[0].ids], q[seen[0].ids])
    residual = np.linalg.norm(p @ pose[:3, :3].T + pose[:3, 3] - q, axis=1)
    mae = np.maximum(0, 1 - residual / (params.t_he_pr * found.resolution)).sum()
    assert found.rounds[0].hypothesis_score == pytest.approx(mae, rel=1e-6)


def test_all_four_at_once_are_the_same_for_any_number_of_threads():
    params = PLAIN.replace(scs=seeds_of_truth, ce=off, te=Irls(PLAIN), hv=overlap)
    runs = [content(register(params, num_threads)) for num_threads in (1, 2, 3, None)]
    assert runs[1:] == runs[:-1]
    model = ibi.Model(SCENE.src)
    assert content(model.register(SCENE.tgt, SCENE.corr, params)) == runs[0]
    assert len(runs[0][0]) >= 4


def test_a_pose_that_does_not_exist_is_a_round_without_one():
    found = register(PLAIN.replace(te=lambda context, dense: None, max_rounds=3))
    assert [round.verdict for round in found.rounds] == [None] * 3
    assert [round.num_degenerate for round in found.rounds] == [1] * 3


# The view ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("points", [False, True], ids=["rows", "points"])
def test_what_a_stage_sees(points):
    p, q = SCENE.src[SCENE.corr[:, 0]], SCENE.tgt[SCENE.corr[:, 1]]
    views = []

    def scs(context):
        views.append(context)
        return seeds_of_truth(context)

    params = PLAIN.replace(scs=scs, te=Irls(PLAIN), n_contest=1, seed=7)
    corr = (p, q) if points else SCENE.corr
    found = ibi.register(SCENE.src, SCENE.tgt, corr, params)
    for number, view in enumerate(views):
        assert isinstance(view, ibi.stages.StageContext)
        assert (view.round, view.seed, view.resolution) == (number, 7, found.resolution)
        assert {type(x) for x in (view.round, view.seed)} == {int}
        assert view.src is views[0].src
        assert view.tgt is views[0].tgt
        for name, array, shape, dtype in (
            ("src", p, (1000, 3), np.float64),
            ("tgt", q, (1000, 3), np.float64),
            ("src_points", SCENE.src, SCENE.src.shape, np.float64),
            ("tgt_points", SCENE.tgt, SCENE.tgt.shape, np.float64),
            ("alive", None, (len(view.alive),), np.int64),
            ("barred", None, (len(view.barred),), np.int64),
            ("poses", None, (len(view.poses), 4, 4), np.float64),
        ):
            given = getattr(view, name)
            assert (given.shape, given.dtype) == (shape, dtype), name
            assert not given.flags.writeable
            if array is not None:
                np.testing.assert_array_equal(given, array)
        if number < len(found.rounds):
            assert len(view.alive) == found.rounds[number].num_alive
        assert (np.diff(view.alive) > 0).all()
        assert (np.diff(view.barred) > 0).all()
    assert len(views[0].barred) == len(views[0].poses) == 0
    np.testing.assert_array_equal(views[1].barred[:20], np.sort(views[1].barred)[:20])
    assert len(views[-1].poses) >= len(found)
    assert repr(views[0]) == "StageContext(round=0, 1000 of 1000 alive)"


def test_the_view_is_of_the_arrays_as_they_were():
    tgt, corr = SCENE.tgt.copy(), SCENE.corr.copy()

    def scs(context):
        tgt[:], corr[:] = 0, 0
        return seeds_of_truth(context)

    params = PLAIN.replace(scs=scs, te=Irls(PLAIN))
    found = ibi.register(SCENE.src, tgt, corr, params)
    assert content(found) == content(register(PLAIN.replace(scs=seeds_of_truth, te=Irls(PLAIN))))


# What is refused -----------------------------------------------------------------------------------------

FLIPPED = np.diag([1.0, 1, -1, 1])
ABOUT_IDS = "it must return ids or (ids, scores)"
WRONG = [
    ("scs", None, "returned None; " + ABOUT_IDS),
    ("scs", 3, "returned ids of shape ()"),
    ("scs", [[1, 2, 3]], "returned ids of shape (1, 3)"),
    ("scs", (1, 2), "returned ids of shape ()"),
    ("scs", [[1, 2], [3]], "returned ids of no rectangular shape"),
    ("scs", [0.0, 1.0, 2.0], "returned ids of dtype float64"),
    ("scs", [True, False], "returned ids of dtype bool"),
    ("scs", "ids", "returned ids of dtype <U3"),
    ("scs", [0, 1, -1], "returned the id -1 (at 2), which is not in context.alive; " + ABOUT_IDS),
    ("scs", [0, 1000], "returned the id 1000 (at 1), which is not in context.alive"),
    ("scs", np.array([0, 2**64 - 1], np.uint64), "which is not in context.alive"),
    ("scs", [5, 1, 5, 1], "returned the id 1 more than once"),
    ("scs", ([1, 2, 3], [1, 2]), "returned 3 ids with 2 scores"),
    ("scs", ([1, 2, 3], [1, np.nan, 2]), "returned the score nan (at 1), which is not finite and at least 0"),
    ("scs", ([1, 2, 3], [1, 1e39, 2]), "returned the score 1e+39 (at 1), which is not finite"),
    ("scs", ([1, 2, 3], [1, 2, -1]), "returned the score -1 (at 2), which is not finite and at least 0"),
    ("scs", ([1, 2, 3], ["a", "b", "c"]), "returned scores of dtype <U1"),
    ("scs", ([1, 2, 3], [[1, 2, 3]]), "returned scores of shape (1, 3)"),
    ("ce", [1, 1], "returned the id 1 more than once"),
    ("ce", None, "returned None"),
    ("te", np.eye(3), "returned a pose of shape (3, 3); it must return a (4, 4) pose, (pose, score) or None"),
    ("te", "pose", "returned a pose of dtype <U4"),
    ("te", np.eye(4)[None], "returned a pose of shape (1, 4, 4)"),
    ("te", np.full((4, 4), np.nan), "returned a pose that must be finite"),
    ("te", FLIPPED, "returned a pose that must be a rigid motion: its 3x3 part is a reflection"),
    ("te", np.diag([1.00001, 1, 1, 1]), "returned a pose that must be a rigid motion: its 3x3 part must be"),
    ("te", np.ones((4, 4)), "returned a pose that must be a rigid motion: its last row must be 0 0 0 1"),
    ("te", (np.eye(4), np.inf), "returned a score of inf"),
    ("te", (np.eye(4), "good"), "returned a score of dtype <U4"),
    ("te", (np.eye(4), [1.0]), "returned a score of shape (1,)"),
    ("hv", None, "returned None; it must return (value, threshold), two finite numbers, or a bool"),
    ("hv", 0.9, "returned 0.9; it must return (value, threshold)"),
    ("hv", (0.9, np.nan), "returned a threshold of nan"),
    ("hv", (np.inf, 0.5), "returned a value of inf"),
    ("hv", (True, 0.5), "returned a value of dtype bool"),
    ("hv", (1, 2, 3), "returned (1, 2, 3); it must return"),
]


@each_count
@pytest.mark.parametrize(("stage", "answer", "message"), WRONG)
def test_an_answer_that_cannot_be_used_is_refused(stage, answer, message, num_threads):
    def mine(*arguments):
        return answer

    with pytest.raises(ibi.InputError) as caught:
        register(PLAIN.replace(**{stage: mine}), num_threads)
    text = str(caught.value)
    assert text.startswith(f"params.{stage}: test_an_answer_that_cannot_be_used_is_refused.<locals>.mine")
    assert message in text
    assert "\n" not in text


def test_ids_that_a_round_has_removed_are_refused():
    calls = []

    def scs(context):
        calls.append(context.alive)
        return np.flatnonzero(SCENE.labels() == 1)[:20]

    with pytest.raises(ibi.InputError, match=r"which is not in context\.alive"):
        register(PAPER.replace(scs=scs, ce="off"))
    assert len(calls) == 2


@each_stage
def test_errors_of_the_input_come_before_any_call(stage):
    params = PLAIN.replace(**{stage: lambda *_: pytest.fail("was called")})
    with pytest.raises(ibi.InputError, match="corr"):
        ibi.register(SCENE.src, SCENE.tgt, [[0, -1]] * 5, params)
    found = ibi.register(SCENE.src, SCENE.tgt, SCENE.corr[:2], params)
    assert found.stop_reason.name == "few_correspondences"


# Exceptions ----------------------------------------------------------------------------------------------


class OwnError(Exception):
    pass


@each_count
@each_stage
@pytest.mark.parametrize("kind", [OwnError, KeyboardInterrupt, SystemExit])
def test_an_exception_ends_the_run_and_is_raised_as_it_is(stage, kind, num_threads):
    error, calls, rounds = kind("mine"), [], []

    def deep():
        raise error

    def failing(*arguments):
        calls.append(arguments)
        deep()

    with pytest.raises(kind) as caught:
        register(PLAIN.replace(**{stage: failing}), num_threads, callback=rounds.append)
    assert caught.value is error
    names = [frame.name for frame in traceback.extract_tb(error.__traceback__)]
    assert names[-2:] == ["failing", "deep"]
    assert (len(calls), rounds) == (1, [])


@each_count
def test_an_exception_after_some_rounds_is_raised_too(num_threads):
    """The run has candidates by then, which are validated at its end: without asking again."""
    calls = []

    def hv(context, pose):
        calls.append(context.round)
        if context.round == 3:
            raise OwnError
        return overlap(context, pose)

    with pytest.raises(OwnError):
        register(PLAIN.replace(hv=hv), num_threads)
    assert calls.count(3) == 1
    assert calls[-1] == 3


@each_stage
@each_count
def test_limits_and_the_callback_end_a_run(stage, num_threads):
    own = {"scs": seeds_of_truth, "ce": off, "te": Irls(PLAIN), "hv": overlap}[stage]
    params = PLAIN.replace(**{stage: own})
    assert register(params, num_threads, max_instances=1).stop_reason.name == "max_instances"
    assert register(params, num_threads, callback=lambda _: False).stop_reason.name == "cancelled"

    timeout_s = 0.01

    def slow(*arguments):
        time.sleep(timeout_s)
        return own(*arguments)

    found = register(PLAIN.replace(**{stage: slow}), num_threads, timeout_s=timeout_s)
    assert found.stop_reason.name == "timeout"


# Threads and signals -------------------------------------------------------------------------------------

DEADLOCK = """
import threading
import test_stages as t

def from_thread():
    found = []
    thread = threading.Thread(target=lambda: found.append(t.four(int(sys.argv[2]))))
    thread.start()
    thread.join()
    return found[0]

def two_at_once():
    with t.ThreadPoolExecutor(2) as pool:
        a, b = pool.map(t.four, [int(sys.argv[2])] * 2)
    assert a == b
    return a

def within_a_stage():
    inner = []
    def ce(context, seeds):
        inner or inner.append(t.four(int(sys.argv[2])))
        return seeds
    t.register(t.PLAIN.replace(ce=ce), int(sys.argv[2]))
    return inner[0]

assert locals()[sys.argv[1]]() == t.four(1)
print("done")
"""


def blocking(own):
    """Let go of the GIL, wait for another thread that needs it, and use numpy's threads."""

    def stage(*arguments):
        time.sleep(0.0005)
        worker = threading.Thread(target=lambda: np.ones((64, 64)) @ np.ones((64, 64)))
        worker.start()
        worker.join()
        return own(*arguments)

    return stage


def four(num_threads):
    own = {"scs": seeds_of_truth, "ce": off, "te": Irls(PLAIN), "hv": overlap}
    params = PLAIN.replace(**{name: blocking(stage) for name, stage in own.items()})
    return content(register(params, num_threads))


@each_count
@pytest.mark.parametrize("how", ["from_thread", "two_at_once", "within_a_stage"])
def test_stages_that_wait_do_not_lock_up(how, num_threads):
    assert ended(python(DEADLOCK, how, num_threads)) == ("done\n", "", 0)


@each_count
def test_a_stage_is_called_where_register_was(num_threads):
    seen = set()

    def ce(context, seeds):
        seen.add(threading.current_thread())
        with pytest.raises(FloatingPointError):
            np.float64(1) / np.float64(0)
        return seeds

    def run():
        with np.errstate(all="raise"):
            register(PLAIN.replace(ce=ce), num_threads)
        return {threading.current_thread()} == seen

    assert run()
    seen.clear()
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(run).result(LIMIT_S)


INTERRUPTED = """
import test_stages as t

def slow(*arguments):
    print("ready", flush=True)
    while True:
        pass

def often(context, seeds):
    if context.round == 0 and not said:
        said.append(print("ready", flush=True))
    return seeds

said = []

own = {"slow": {sys.argv[2]: slow}, "often": {"ce": often}}[sys.argv[1]]
scene = t.ibi.synth.outlier_layout(0, num_instances=3, num_correspondences=5000, outlier_ratio=0.99)
try:
    while True:
        t.register(t.PLAIN.replace(max_rejections=None, **own), scene=scene)
except KeyboardInterrupt:
    print("interrupted")
"""


@pytest.mark.parametrize(("how", "stage"), [*(("slow", stage) for stage in STAGES), ("often", "ce")])
def test_ctrl_c_reaches_a_stage(how, stage):
    assert interrupted(python(INTERRUPTED, how, stage)) == ("interrupted\n", "", 0)


# Parameters ----------------------------------------------------------------------------------------------


@each_stage
def test_parameters_with_a_callable_behave_as_it_does(stage, tmp_path):
    own = {"scs": seeds_of_truth, "ce": off, "te": Irls(PLAIN), "hv": overlap}[stage]
    params = PLAIN.replace(**{stage: own}, t_he_pr=np.float32(2))
    assert getattr(params, stage) is own
    assert params == PLAIN.replace(**{stage: own}, t_he_pr=2)
    assert params != PLAIN.replace(t_he_pr=2)
    assert hash(params) == hash(PLAIN.replace(**{stage: own}, t_he_pr=2))
    assert copy.copy(params) == params
    twin = pickle.loads(pickle.dumps(params))
    assert twin == params or stage == "te"  # an object without __eq__ equals itself alone
    assert type(getattr(twin, stage)) is type(own)
    for write in (params.to_dict, params.to_toml, lambda: params.save(tmp_path / "params.json")):
        with pytest.raises(ibi.ParamsError, match=rf"params\.{stage} is <.*; a callable has no text form"):
            write()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ibi.ParamsError, match="t_he_pr"):
        params.replace(t_he_pr=-1)
    found = register(params, max_instances=1)
    assert found.params == params.replace(max_instances=1)
    assert content(pickle.loads(pickle.dumps(found))) == content(found)


def test_a_callable_that_cannot_be_hashed_or_pickled_is_none_the_less_one():
    class Unhashable:
        __hash__ = None

        def __call__(self, context, seeds):
            return seeds

    params = PLAIN.replace(ce=Unhashable())
    with pytest.raises(TypeError, match="unhashable"):
        hash(params)
    with pytest.raises((pickle.PicklingError, AttributeError)):
        pickle.dumps(params)
    assert content(register(params)) == content(register(PLAIN.replace(ce="off")))


@pytest.mark.parametrize("value", [ibi.Irls, int, object()])
def test_a_class_is_no_stage(value):
    with pytest.raises(ibi.ParamsError, match=r"it must be one of Gsac\(\), .*Mac\(\), a callable$"):
        ibi.Params(te=value)


TYPED = """
import numpy as np
import ibi_rs as ibi
from ibi_rs.stages import Ranked, StageContext

def scs(context: StageContext) -> list[int]:
    return [int(i) for i in context.alive[:5]]

def te(context: StageContext, dense: Ranked) -> tuple[np.ndarray, float]:
    return np.eye(4), 1.0

def hv(context: StageContext, pose: np.ndarray) -> bool:
    return True

ibi.Params(scs=scs, ce=lambda context, seeds: seeds, te=te, hv=hv)
ibi.Params(te=ibi.Ransac())
ibi.Params(scs="nnsr", ce="off", te="mac", hv="none")
ibi.Params.preset("single_view").replace(hv={"t_score": 0.97})
"""


def test_types_help(tmp_path):
    api = pytest.importorskip("mypy.api")
    lines = TYPED.replace("np.ndarray", "np.ndarray[tuple[int, int], np.dtype[np.float64]]")
    page, wrong = tmp_path / "page.py", tmp_path / "wrong.py"
    page.write_text(lines)
    wrong.write_text(lines + "ibi.Params(te=hv)\nibi.Params(hv=scs)\nibi.Params(te='mak')\n")
    root = str(Path(ibi.__file__).parents[1])
    options = ["--strict", "--cache-dir", str(tmp_path / "cache"), "--config-file", os.devnull]
    before = os.environ.get("MYPYPATH")
    os.environ["MYPYPATH"] = root
    try:
        fine, bad = api.run([*options, str(page)]), api.run([*options, str(wrong)])
    finally:
        os.environ.pop("MYPYPATH") if before is None else os.environ.update(MYPYPATH=before)
    assert fine[2] == 0, fine[0]
    assert bad[0].count("[arg-type]") == 3, bad[0]


def test_types_help_in_editors_too(tmp_path):
    """Pyright, as the server of many editors is."""
    pytest.importorskip("basedpyright")
    (tmp_path / "pyrightconfig.json").write_text(
        json.dumps({"typeCheckingMode": "standard", "extraPaths": [str(Path(ibi.__file__).parents[1])]})
    )
    wrong = ["ibi.Params(te=hv)", "ibi.Params(hv=scs)", "ibi.Params(te='mak')"]
    (tmp_path / "page.py").write_text(TYPED)
    (tmp_path / "wrong.py").write_text(TYPED + "\n".join(wrong) + "\n")
    command = [sys.executable, "-m", "basedpyright", "--pythonpath", sys.executable, "--outputjson"]
    ended = subprocess.run([*command, "-p", tmp_path], capture_output=True, text=True, cwd=tmp_path)
    told = [one for one in json.loads(ended.stdout)["generalDiagnostics"] if one["severity"] == "error"]
    assert [(Path(one["file"]).name, one["rule"]) for one in told] == [
        ("wrong.py", "reportArgumentType") for _ in wrong
    ], ended.stdout
    first = len(TYPED.splitlines())
    assert [one["range"]["start"]["line"] - first for one in told] == [0, 1, 2]
