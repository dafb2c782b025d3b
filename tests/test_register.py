"""What a registration returns, when it stops, and that it is the same whoever computes it."""

import copy
import pickle
from dataclasses import asdict, fields
from typing import get_args

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import metrics
from ibi_rs.params import Ce, Hv, Removal, Scs, Te

# Fewer correspondences a round than the default: several rounds, accepted and rejected ones.
SMALL_ROUNDS = ibi.Params(ce=ibi.Voting(n_vot=100))


def scene_of(seed):
    return ibi.synth.outlier_layout(
        seed, num_instances=4, num_correspondences=1000, outlier_ratio=0.6, min_spacing=2.0
    )


SCENE = scene_of(0)


def register(params=SMALL_ROUNDS, *, corr=SCENE.corr, **options):
    return ibi.register(SCENE.src, SCENE.tgt, corr, params, **options)


FOUND = register()
NOTHING = register(corr=SCENE.corr[:2])


def content(found):
    """Everything but the seconds, in a form that == compares to the bit."""
    poses = [
        (p.target_from_source.tobytes(), p.score, p.overlap, p.inlier_rmse, p.inliers.tobytes(), p.round)
        for p in found
    ]
    return poses, found.labels.tobytes(), found.rounds, found.stop_reason, found.resolution, found.params


# Types ---------------------------------------------------------------------------------------------------


def test_a_registration_is_typed_throughout():
    assert isinstance(FOUND, ibi.Registration)
    assert isinstance(FOUND.poses, tuple)
    assert isinstance(FOUND.rounds, tuple)
    assert isinstance(FOUND.stop_reason, ibi.StopReason)
    assert isinstance(FOUND.timings, ibi.Timings)
    assert type(FOUND.resolution) is float
    assert FOUND.params == SMALL_ROUNDS
    assert FOUND.labels.dtype == np.int32
    assert FOUND.labels.shape == (len(SCENE.corr),)


def test_a_pose_is_typed_throughout():
    assert len(FOUND) >= 4
    for pose in FOUND:
        assert isinstance(pose, ibi.Pose)
        assert pose.target_from_source.shape == (4, 4)
        assert pose.target_from_source.dtype == np.float64
        assert pose.transformation is pose.target_from_source
        assert {type(pose.score), type(pose.overlap), type(pose.inlier_rmse)} == {float}
        assert type(pose.round) is int
        assert pose.inliers.dtype == np.int64
        assert pose.inliers.shape == (pose.num_inliers,)
        assert (np.diff(pose.inliers) > 0).all()
        assert FOUND.rounds[pose.round].accepted


def test_a_round_is_typed_throughout():
    assert [entry.index for entry in FOUND.rounds] == list(range(len(FOUND.rounds)))
    assert sum(entry.accepted for entry in FOUND.rounds) == len(FOUND)
    counts = {f.name for f in fields(ibi.Round)} - {"hypothesis_score", "verdict"}
    for entry in FOUND.rounds:
        assert isinstance(entry, ibi.Round)
        assert {type(getattr(entry, name)) for name in counts} == {int}
        assert type(entry.hypothesis_score) is float
        assert isinstance(entry.verdict, ibi.Verdict)
        assert entry.accepted == entry.verdict.accepted == (entry.verdict.value > entry.verdict.threshold)
        assert 0 <= entry.num_degenerate <= entry.num_samples
    alive = [entry.num_alive for entry in FOUND.rounds]
    removed = [entry.num_removed for entry in FOUND.rounds]
    assert alive == [len(SCENE.corr) - sum(removed[:i]) for i in range(len(removed))]


def test_the_seconds_add_up():
    seconds = asdict(FOUND.timings)
    assert all(type(s) is float and s >= 0 for s in seconds.values())
    assert sum(seconds.values()) - seconds["total_s"] <= seconds["total_s"]
    assert NOTHING.timings.scs_s == 0


# A sequence of poses, and an array -----------------------------------------------------------------------


def test_a_registration_is_a_sequence_of_poses():
    poses = list(FOUND)
    assert len(FOUND) == len(poses)
    assert FOUND[0] is poses[0]
    assert FOUND[-1] is poses[-1]
    assert list(FOUND[1:3]) == poses[1:3]
    assert poses[1] in FOUND
    assert FOUND.index(poses[2]) == 2
    assert list(reversed(FOUND)) == poses[::-1]
    assert bool(FOUND)
    assert not NOTHING
    with pytest.raises(IndexError):
        FOUND[len(FOUND)]


def test_a_registration_is_an_array_of_matrices():
    array = np.asarray(FOUND)
    assert array.shape == (len(FOUND), 4, 4)
    assert array.dtype == np.float64
    for matrix, pose in zip(array, FOUND, strict=True):
        np.testing.assert_array_equal(matrix, pose.target_from_source)
    assert np.asarray(FOUND, dtype=np.float32).dtype == np.float32
    assert np.array(FOUND, np.float16).shape == array.shape
    array[:] = 0  # a copy: the poses keep their numbers
    assert FOUND[0].target_from_source[3, 3] == 1
    with pytest.raises(ValueError, match="must copy"):
        FOUND.__array__(copy=False)
    assert np.asarray(NOTHING).shape == (0, 4, 4)
    assert np.asarray(NOTHING).dtype == np.float64
    assert np.asarray(NOTHING, np.float32).dtype == np.float32


def test_reprs_take_one_line_a_pose():
    head, *lines = repr(FOUND).splitlines()
    assert len(lines) == len(FOUND)
    assert f"{len(FOUND)} instances in {len(FOUND.rounds)} rounds" in head
    assert str(FOUND.stop_reason) in head
    for line, pose in zip(lines, FOUND, strict=True):
        assert line.strip() == repr(pose)
        assert f"num_inliers={pose.num_inliers}" in line
    assert "\n" not in repr(NOTHING)
    assert "0 instances" in repr(NOTHING)
    assert "few_correspondences: 2 alive, 3 needed" in repr(NOTHING)


@pytest.mark.parametrize("twin_of", [lambda x: pickle.loads(pickle.dumps(x)), copy.deepcopy, copy.copy])
@pytest.mark.parametrize("found", [FOUND, NOTHING])
def test_results_can_be_pickled_and_copied(found, twin_of):
    twin = twin_of(found)
    assert type(twin) is ibi.Registration
    assert content(twin) == content(found)
    assert twin.timings == found.timings
    assert repr(twin) == repr(found)


def test_results_cannot_be_changed_by_accident():
    for frozen in (FOUND[0], FOUND.rounds[0], FOUND.stop_reason, FOUND.timings, FOUND.params):
        with pytest.raises(AttributeError, match="cannot assign"):
            setattr(frozen, fields(frozen)[0].name, None)


# What the numbers mean -----------------------------------------------------------------------------------


def test_poses_are_proper_rotations_with_a_last_row():
    matrices = np.asarray(FOUND)
    rotations = matrices[:, :3, :3]
    gram = rotations @ rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-12)
    np.testing.assert_array_equal(matrices[:, 3], np.broadcast_to([0, 0, 0, 1], (len(FOUND), 4)))


def test_poses_are_sorted_by_their_score():
    scores = [pose.score for pose in FOUND]
    assert scores == sorted(scores, reverse=True)
    assert all(0 <= pose.overlap <= 1 for pose in FOUND)
    assert all(pose.score == pose.overlap for pose in FOUND)


def test_inliers_rmse_overlap_and_labels_follow_from_the_poses():
    """Recomputed with numpy from the definitions in the docstrings."""
    residuals = np.stack(
        [
            np.linalg.norm(moved(pose)[SCENE.corr[:, 0]] - SCENE.tgt[SCENE.corr[:, 1]], axis=1)
            for pose in FOUND
        ]
    )
    t_he = FOUND.params.t_he_pr * FOUND.resolution
    for pose, residual in zip(FOUND, residuals, strict=True):
        np.testing.assert_array_equal(pose.inliers, np.flatnonzero(residual < t_he))
        rmse = np.sqrt(np.mean(residual[pose.inliers] ** 2))
        assert pose.inlier_rmse == pytest.approx(rmse, rel=1e-9)
        assert pose.overlap == pytest.approx(overlap(pose), abs=1e-12)
    labels = np.where(residuals.min(axis=0) < t_he, residuals.argmin(axis=0), -1)
    np.testing.assert_array_equal(FOUND.labels, labels)
    assert set(FOUND.labels.tolist()) <= set(range(-1, len(FOUND)))


def moved(pose):
    matrix = pose.target_from_source
    return SCENE.src @ matrix[:3, :3].T + matrix[:3, 3]


def overlap(pose):
    points, d_op = moved(pose), FOUND.params.d_op_pr * FOUND.resolution
    dist_sq = (points**2).sum(1)[:, None] + (SCENE.tgt**2).sum(1) - 2 * points @ SCENE.tgt.T
    return np.mean(dist_sq.min(axis=1) < d_op**2)


def test_the_resolution_is_the_mean_spacing_unless_given():
    def spacing(points):
        dist_sq = (points**2).sum(1)[:, None] + (points**2).sum(1) - 2 * points @ points.T
        np.fill_diagonal(dist_sq, np.inf)
        return np.sqrt(np.maximum(dist_sq.min(axis=1), 0)).mean()

    assert FOUND.resolution == pytest.approx((spacing(SCENE.src) + spacing(SCENE.tgt)) / 2, rel=1e-6)
    assert register(ibi.Params(resolution=0.1)).resolution == 0.1


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_truth_is_found(seed):
    scene = scene_of(seed)
    found = ibi.register(scene.src, scene.tgt, scene.corr)
    score = metrics.score_scene(found, scene.poses)
    assert (score.recall, score.precision) == (1.0, 1.0)
    # Each pose explains the correspondences of its own instance.
    truth = scene.labels()
    for label, match in enumerate(score.matches):
        assert np.mean(truth[found.labels == label] == match.truth) > 0.9


@pytest.mark.parametrize("jitter", [0, 1e-6, 1e-3])
@pytest.mark.parametrize("n", [10, 100, 1000])
def test_a_perfect_match_is_found(n, jitter):
    """The first thing a user tries: one copy, each point matched to itself, nothing to sort out."""
    rng = np.random.default_rng(0)
    src = rng.normal(size=(n, 3))
    tgt = src @ SCENE.poses[0][:3, :3].T + SCENE.poses[0][:3, 3] + rng.normal(0, jitter, src.shape)
    found = ibi.register(src, tgt, np.stack([np.arange(n)] * 2, axis=1))
    assert len(found) >= 1, found
    np.testing.assert_allclose(found[0].target_from_source, SCENE.poses[0], atol=1e-9 + 10 * jitter)
    assert found[0].num_inliers == n


def test_point_correspondences_give_what_row_correspondences_give():
    """Points and rows name the same pairs, so everything but the way they are named is the same."""
    s, t = SCENE.src[SCENE.corr[:, 0]], SCENE.tgt[SCENE.corr[:, 1]]
    for corr in (np.hstack([s, t]), (s, t), [s, t], (s.tolist(), t.tolist())):
        assert content(register(corr=corr)) == content(FOUND)


def test_optional_arrays_are_taken():
    normals = [np.random.default_rng(0).normal(size=cloud.shape) for cloud in (SCENE.src, SCENE.tgt)]
    found = register(
        src_normals=normals[0],
        tgt_normals=normals[1].tolist(),
        similarity=np.linspace(0, 1, len(SCENE.corr), dtype=np.float32),
        viewpoint=(0, 0, 1),
    )
    assert content(found) == content(FOUND)  # no variant uses them yet


# The same bits -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("num_threads", [1, 2, 7, np.int64(3)])
def test_the_number_of_threads_changes_no_bit(num_threads):
    assert content(register(num_threads=num_threads)) == content(FOUND)


EACH_VARIANT = [
    {stage: variant.variant}
    for stage, union in (("scs", Scs), ("ce", Ce), ("te", Te), ("hv", Hv))
    for variant in get_args(union) or (union,)
] + [{"removal": word} for word in get_args(Removal)]


@pytest.mark.parametrize("change", EACH_VARIANT, ids=lambda change: "-".join(*change.items()))
def test_no_variant_depends_on_the_number_of_threads(change):
    params = SMALL_ROUNDS.replace(**change, max_rounds=8)
    one = register(params, num_threads=1)
    assert one.rounds
    assert content(register(params, num_threads=5)) == content(one)


@pytest.mark.parametrize("text", ["1", "3", ""])
def test_the_environment_changes_no_bit(monkeypatch, text):
    monkeypatch.setenv("IBI_NUM_THREADS", text)
    assert content(register()) == content(FOUND)


def test_the_seed_changes_the_samples():
    """With fewer players than correspondences another seed draws others."""
    params = [ibi.Params(seed=seed, scs=ibi.Gtm(n_downsample=300)) for seed in (1, 1, 2)]
    a, b, c = (content(register(p))[2] for p in params)
    assert a == b
    assert a != c


# Why it stops --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "threshold", "options"),
    [
        ("few_correspondences", 0, 3, {"corr": np.empty((0, 2), int)}),
        ("few_seeds", 0, 5, {"corr": np.repeat(SCENE.corr[:1], 50, axis=0)}),
        ("max_rounds", 2, 2, {"params": SMALL_ROUNDS.replace(max_rounds=2)}),
        ("max_rounds", 0, 0, {"params": SMALL_ROUNDS.replace(max_rounds=0)}),
        ("max_instances", 1, 1, {"params": SMALL_ROUNDS.replace(max_instances=1)}),
        ("max_instances", 2, 2, {"max_instances": 2}),
        ("timeout", None, 0.0, {"timeout_s": 0}),
        ("cancelled", None, None, {"callback": lambda _: False}),
    ],
)
def test_every_stop_reason_carries_its_measure(name, value, threshold, options):
    found = register(**options)
    reason = found.stop_reason
    assert reason.name == name
    assert reason.threshold == threshold
    assert str(reason) == reason.message
    assert reason.message.startswith(f"{name}: ")
    if name == "timeout":
        assert reason.value >= 0
    else:
        assert reason.value == value
    if name == "max_instances":
        assert len(found) == threshold
    if name == "max_rounds":
        assert len(found.rounds) == threshold


def test_arguments_override_params():
    params = SMALL_ROUNDS.replace(max_instances=3, timeout_s=100)
    assert register(params, max_instances=1).params == params.replace(max_instances=1)
    assert register(params, timeout_s=50).params == params.replace(timeout_s=50)
    assert len(register(params, max_instances=1)) == 1
    assert len(register(params)) == 3
    assert params.max_instances == 3


def test_a_stopped_run_keeps_what_the_full_run_found_first():
    full = sorted(FOUND, key=lambda pose: pose.round)
    for limit in range(1, len(full) + 1):
        early = sorted(register(max_instances=limit), key=lambda pose: pose.round)
        assert [p.target_from_source.tobytes() for p in early] == [
            p.target_from_source.tobytes() for p in full[:limit]
        ]


# The callback --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("answer", [None, True, np.True_, 1, 0, "", []])
def test_the_callback_sees_every_round_in_order(answer):
    """Only False ends a run: a callback that returns nothing, or a count of nothing, goes on."""
    seen = []

    def callback(entry):
        seen.append(entry)
        return answer

    found = register(callback=callback)
    assert tuple(seen) == found.rounds
    assert content(found) == content(FOUND)


@pytest.mark.parametrize("no", [False, np.False_])
def test_false_ends_the_run_and_keeps_what_is_found(no):
    found = register(callback=lambda entry: no if entry.index == 1 else None)
    assert found.stop_reason.name == "cancelled"
    assert found.rounds == FOUND.rounds[:2]
    assert len(found) == sum(entry.accepted for entry in FOUND.rounds[:2])


def test_an_exception_in_the_callback_comes_out_as_it_is():
    class Mine(Exception):
        pass

    error, seen = Mine("from the callback"), []

    def callback(entry):
        seen.append(entry.index)
        if entry.index == 1:
            raise error

    with pytest.raises(Mine) as caught:
        register(callback=callback)
    assert caught.value is error
    assert seen == [0, 1]


def test_a_callback_may_be_any_callable():
    class Recorder(list):  # callable, and false while empty
        def __call__(self, entry):
            self.append(entry)

    recorder = Recorder()
    found = register(callback=recorder)
    assert tuple(recorder) == found.rounds
    with pytest.raises(TypeError, match="callback must be callable, not str"):
        register(callback="print")


def test_a_callback_may_register():
    """The core holds no lock while it calls back."""
    inner = []
    register(max_instances=1, callback=lambda _: inner.append(register()))
    assert [content(found) for found in inner] == [content(FOUND)]
