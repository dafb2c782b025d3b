"""What a registration returns, when it stops, and that it is the same whoever computes it."""

import copy
import pickle
from dataclasses import asdict, fields
from typing import get_args

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import metrics
from ibi_rs.params import Removal
from ibi_rs.variants import Ce, Hv, Scs, Te

PLAIN = ibi.Params()
# The loop of the paper: each accepted hypothesis becomes an instance at once. Fewer correspondences a round
# than there make several rounds, accepted and rejected ones.
PAPER = ibi.Params.paper_synthetic().replace(t_he_pr=3, ce=ibi.Voting(n_vot=100))


def scene_of(seed):
    return ibi.synth.outlier_layout(
        seed, num_instances=4, num_correspondences=1000, outlier_ratio=0.6, min_spacing=2.0
    )


SCENE = scene_of(0)
# True pairs are the more alike on average.
SIMILARITY = np.random.default_rng(0).random(len(SCENE.corr)) + 0.3 * (SCENE.labels() >= 0)


def register(params=PAPER, *, corr=SCENE.corr, **options):
    if params.scs.variant == "nnsr":
        options.setdefault("similarity", SIMILARITY)
    return ibi.register(SCENE.src, SCENE.tgt, corr, params, **options)


RUNS = {"default": register(PLAIN), "paper": register(PAPER)}
each_run = pytest.mark.parametrize("found", RUNS.values(), ids=RUNS)
FOUND = RUNS["paper"]
NOTHING = register(corr=SCENE.corr[:2])

MEASURES = ("score", "overlap", "closeness", "back_fit", "evidence", "inlier_rmse")


def content(found):
    """Everything but the seconds, in a form that == compares to the bit."""
    poses = [
        (p.target_from_source.tobytes(), [getattr(p, m) for m in MEASURES], p.inliers.tobytes(), p.round)
        for p in found
    ]
    return poses, found.labels.tobytes(), found.rounds, found.stop_reason, found.resolution, found.params


# Types ---------------------------------------------------------------------------------------------------


@each_run
def test_a_registration_is_typed_throughout(found):
    assert isinstance(found, ibi.Registration)
    assert isinstance(found.poses, tuple)
    assert isinstance(found.rounds, tuple)
    assert isinstance(found.stop_reason, ibi.StopReason)
    assert isinstance(found.timings, ibi.Timings)
    assert type(found.resolution) is float
    assert found.params in (PLAIN, PAPER)
    assert found.labels.dtype == np.int32
    assert found.labels.shape == (len(SCENE.corr),)


@each_run
def test_a_pose_is_typed_throughout(found):
    assert len(found) >= 4
    for pose in found:
        assert isinstance(pose, ibi.Pose)
        assert pose.target_from_source.shape == (4, 4)
        assert pose.target_from_source.dtype == np.float64
        assert pose.transformation is pose.target_from_source
        assert {type(getattr(pose, measure)) for measure in MEASURES} == {float}
        assert type(pose.round) is int
        assert pose.inliers.dtype == np.int64
        assert pose.inliers.shape == (pose.num_inliers,)
        assert (np.diff(pose.inliers) > 0).all()
        assert found.rounds[pose.round].accepted
    assert {field.name for field in fields(ibi.Pose)} == {
        *MEASURES,
        *("target_from_source", "inliers", "round", "measures", "model", "model_name"),
        *("centre", "covariance", "free_motions"),
    }


@each_run
def test_a_round_is_typed_throughout(found):
    assert [entry.index for entry in found.rounds] == list(range(len(found.rounds)))
    accepted = sum(entry.accepted for entry in found.rounds)
    # In a contest several rounds may come to one instance.
    assert accepted == len(found) if found.params.n_contest == 1 else accepted >= len(found)
    counts = {f.name for f in fields(ibi.Round)} - {"capped", "hypothesis_score", "verdict"}
    for entry in found.rounds:
        assert isinstance(entry, ibi.Round)
        assert {type(getattr(entry, name)) for name in counts} == {int}
        assert entry.capped is False
        assert type(entry.hypothesis_score) is float
        assert isinstance(entry.verdict, ibi.Verdict)
        assert entry.accepted == entry.verdict.accepted == (entry.verdict.value > entry.verdict.threshold)
        assert 0 <= entry.num_degenerate <= entry.num_samples
    alive = [entry.num_alive for entry in found.rounds]
    removed = [entry.num_removed for entry in found.rounds]
    assert alive == [len(SCENE.corr) - sum(removed[:i]) for i in range(len(removed))]


@each_run
def test_the_seconds_add_up(found):
    seconds = asdict(found.timings)
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
        assert line.strip().rpartition("translation")[0] == repr(pose).rpartition("translation")[0]
        assert f"num_inliers={pose.num_inliers}" in line
        assert "\n" not in repr(pose)
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


@each_run
def test_poses_are_proper_rotations_with_a_last_row(found):
    matrices = np.asarray(found)
    rotations = matrices[:, :3, :3]
    gram = rotations @ rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-12)
    np.testing.assert_array_equal(matrices[:, 3], np.broadcast_to([0, 0, 0, 1], (len(found), 4)))


@each_run
def test_poses_are_sorted_by_their_score(found):
    scores = [pose.score for pose in found]
    assert scores == sorted(scores, reverse=True)
    for pose in found:
        assert 0 <= pose.score <= 1
        assert 0 <= pose.overlap <= 1
        assert 0 <= pose.back_fit <= 1
        assert pose.closeness <= 1
        assert pose.evidence >= 0


@each_run
def test_inliers_rmse_overlap_and_labels_follow_from_the_poses(found):
    """Recomputed with numpy from the definitions in the docstrings."""
    residuals = np.stack([residuals_of(pose) for pose in found])
    t_he = found.params.t_he_pr * found.resolution
    for pose, residual in zip(found, residuals, strict=True):
        np.testing.assert_array_equal(pose.inliers, np.flatnonzero(residual < t_he))
        rmse = np.sqrt(np.mean(residual[pose.inliers] ** 2))
        assert pose.inlier_rmse == pytest.approx(rmse, rel=1e-9)
        d_op = found.params.d_op_pr * found.resolution
        assert pose.overlap == pytest.approx(np.mean(distances(moved(pose), SCENE.tgt)[0] < d_op), abs=1e-12)
    labels = np.where(residuals.min(axis=0) < t_he, residuals.argmin(axis=0), -1)
    np.testing.assert_array_equal(found.labels, labels)
    assert set(found.labels.tolist()) <= set(range(-1, len(found)))


def moved(pose):
    matrix = pose.target_from_source
    return SCENE.src @ matrix[:3, :3].T + matrix[:3, 3]


def residuals_of(pose):
    return np.linalg.norm(moved(pose)[SCENE.corr[:, 0]] - SCENE.tgt[SCENE.corr[:, 1]], axis=1)


def distances(a, b):
    """From each point of a to the nearest of b, and which that is."""
    dist_sq = (a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * a @ b.T
    return np.sqrt(np.maximum(dist_sq.min(axis=1), 0)), dist_sq.argmin(axis=1)


# Without a joint check every correspondence and every target point is free for every pose.
NOT_SHARED = register(PLAIN.replace(joint_check=False, hv=ibi.Evidence(t_score=0.001)))


def test_evidence_and_back_fit_follow_from_the_poses():
    """Recomputed with numpy: the binomial tail by its bound, the chance by counting neighbours."""
    pr, params = NOT_SHARED.resolution, NOT_SHARED.params
    d_op, t_he = params.d_op_pr * pr, params.t_he_pr * pr
    drawn, targets = SCENE.corr[:, 0], SCENE.tgt[SCENE.corr[:, 1]]
    assert len(NOT_SHARED) >= 4
    for pose in NOT_SHARED:
        distance, nearest = distances(targets, moved(pose))
        near = distance < 2 * d_op
        assert pose.back_fit == pytest.approx(np.mean(1 - distance[near] / (2 * d_op)), rel=1e-6)

        explained = distance < d_op
        gaps = np.linalg.norm(SCENE.src[nearest[explained]][:, None] - SCENE.src[drawn], axis=2)
        n, p = explained.sum(), np.mean(gaps < t_he)
        share = np.mean(residuals_of(pose)[explained] < t_he)
        parts = [a * np.log(a / b) if a > 0 else 0.0 for a, b in ((share, p), (1 - share, 1 - p))]
        assert pose.evidence == pytest.approx(n * sum(parts) / np.log(10), rel=1e-5)


def test_the_score_is_a_probability_of_its_three_measures():
    """Its log odds are linear in them, the same for all scenes; no weight is negative."""
    poses = list(NOT_SHARED)
    for seed in range(1, 5):
        scene = ibi.synth.outlier_layout(seed, num_instances=4, outlier_ratio=0.8, exact=False)
        poses += ibi.register(scene.src, scene.tgt, scene.corr)
    odds = [np.log(pose.score / (1 - pose.score)) for pose in poses]
    features = np.array([[1, np.log1p(p.evidence), p.closeness, p.back_fit] for p in poses])
    weights, _, rank, _ = np.linalg.lstsq(features, odds)
    assert rank == 4
    np.testing.assert_allclose(features @ weights, odds, atol=1e-6)
    assert (weights[1:] > 0).all()


def test_a_better_fit_is_closer():
    """Closeness is 1 where every source point has its own target point, and falls with the noise."""
    rng = np.random.default_rng(0)
    src, clutter = rng.normal(size=(200, 3)), rng.uniform(-20, 20, (500, 3))
    corr = np.stack([np.arange(200)] * 2, axis=1)
    closeness, shift = [], np.array([5, 0, 0])
    for noise in (0, 0.05, 0.1):
        tgt = np.vstack([src + shift + rng.normal(0, noise, src.shape), clutter])
        closeness.append(ibi.register(src, tgt, corr)[0].closeness)
    assert closeness[0] == pytest.approx(1, abs=1e-6)
    assert closeness == sorted(closeness, reverse=True)
    assert closeness[2] < 0.95


@pytest.mark.parametrize("outlier_ratio", [0.6, 0.9])
def test_the_unit_does_not_matter(outlier_ratio):
    """Millimetres for metres: the poses scale, and everything else stays."""
    scene = ibi.synth.outlier_layout(5, num_instances=4, outlier_ratio=outlier_ratio, exact=False)
    found = ibi.register(scene.src, scene.tgt, scene.corr)
    scaled = ibi.register(1000 * scene.src, 1000 * scene.tgt, scene.corr)
    assert len(found) == 4
    back = np.array(scaled)
    back[:, :3, 3] /= 1000
    np.testing.assert_allclose(back, np.asarray(found), atol=1e-9)
    np.testing.assert_array_equal(scaled.labels, found.labels)
    assert scaled.resolution == pytest.approx(1000 * found.resolution)
    assert scaled.stop_reason == found.stop_reason
    assert len(scaled.rounds) == len(found.rounds)
    for a, b in zip(scaled, found, strict=True):
        assert a.inlier_rmse == pytest.approx(1000 * b.inlier_rmse)
        for measure in set(MEASURES) - {"inlier_rmse"}:
            assert getattr(a, measure) == pytest.approx(getattr(b, measure), rel=1e-6)


def spacing(points):
    """Mean distance to the nearest other point."""
    dist_sq = (points**2).sum(1)[:, None] + (points**2).sum(1) - 2 * points @ points.T
    np.fill_diagonal(dist_sq, np.inf)
    return np.sqrt(np.maximum(dist_sq.min(axis=1), 0)).mean()


def test_the_resolution_is_the_mean_spacing_unless_given():
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
    assert min(pose.score for pose in found) > 0.9


@pytest.mark.parametrize("outlier_ratio", [0.6, 0.9, 0.97])
@pytest.mark.parametrize("exact", [True, False])
def test_nothing_is_missed_and_nothing_invented(outlier_ratio, exact):
    scene = ibi.synth.outlier_layout(7, num_instances=5, outlier_ratio=outlier_ratio, exact=exact)
    score = metrics.score_scene(ibi.register(scene.src, scene.tgt, scene.corr), scene.poses)
    assert (score.recall, score.precision) == (1.0, 1.0)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("num_correspondences", [200, 3000])
def test_no_instance_gives_no_pose(seed, num_correspondences):
    scene = ibi.synth.outlier_layout(seed, num_instances=0, num_correspondences=num_correspondences)
    found = ibi.register(scene.src, scene.tgt, scene.corr)
    assert len(found) == 0, found
    assert found.stop_reason.name in ("few_seeds", "max_rejections")


def test_a_threshold_is_exceeded():
    """Nothing has a probability of more than 1; everything one of more than 0."""
    none, some, all_ = (register(PLAIN.replace(hv=ibi.Evidence(t_score=t))) for t in (1, 0.5, 0))
    assert len(none) == 0 < len(some) <= len(all_)
    assert all(pose.score > 0.5 for pose in some)


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
    given = {
        "src_normals": normals[0],
        "tgt_normals": normals[1].tolist(),
        "similarity": np.linspace(0, 1, len(SCENE.corr), dtype=np.float32),
        "viewpoint": (0, 0, 1),
    }
    assert content(register(**given)) == content(FOUND)  # the paper knows none of them
    # The default looks at normals, and these are wrong.
    overlaps = [pose.overlap for pose in register(PLAIN, **given)]
    assert max(overlaps) < 0.9 < min(pose.overlap for pose in RUNS["default"])


# The joint check -----------------------------------------------------------------------------------------

SHAPES = {name: ibi.synth.shape(name, 1000, np.random.default_rng(9)) for name in ("clamp", "mug", "valve")}


def described(points, normals):
    """Where a point lies on its shape, and how it faces: cheap descriptors."""
    return np.hstack([points, 0.1 * normals])


def test_a_round_says_that_a_limit_was_hit():
    for te in (ibi.SacCot(max_triangles=1), ibi.Mac(max_steps=1)):
        assert register(PAPER.replace(te=te)).rounds[0].capped is True


def test_the_joint_check_drops_poses_that_live_on_what_others_own():
    """Almost everything is accepted, at once: wrong early poses, which the right ones then take apart."""
    params = PLAIN.replace(hv=ibi.Evidence(t_score=1e-4), n_contest=1)
    num_dropped = 0
    for seed in (0, 2, 5, 7, 10, 13, 17, 21):  # at 2, 7, 10 and 17 of 0 to 23 it drops one
        scene = ibi.synth.ecc_layout(seed, shapes=SHAPES, descriptors=described, descriptor_noise=0.3)
        kept, everything = (
            ibi.register(scene.src, scene.tgt, scene.corr, params.replace(joint_check=check))
            for check in (True, False)
        )
        matrices = [{pose.target_from_source.tobytes() for pose in found} for found in (kept, everything)]
        assert matrices[0] <= matrices[1]
        num_dropped += len(matrices[1] - matrices[0])
        assert kept.rounds == everything.rounds  # it comes after the last round
        # What it drops is wrong.
        hits = [metrics.score_scene(found, scene.poses).num_predicted_hit for found in (kept, everything)]
        assert hits[0] == hits[1]
    assert num_dropped >= 2


def test_the_joint_check_leaves_what_does_not_touch():
    unchecked = register(PLAIN.replace(joint_check=False))
    for pose, twin in zip(RUNS["default"], unchecked, strict=True):
        assert pose.target_from_source.tobytes() == twin.target_from_source.tobytes()


# Normals -------------------------------------------------------------------------------------------------


def scene_with_normals():
    """Three clamps among outliers: clouds, correspondences, poses, and outward normals of both clouds."""
    rng = np.random.default_rng(0)
    src, src_normals = ibi.synth.shape("clamp", 400, rng)
    poses = SCENE.poses[:3]
    tgt = np.vstack([src @ pose[:3, :3].T + pose[:3, 3] for pose in poses])
    tgt = tgt + rng.normal(0, 0.005, tgt.shape)
    tgt_normals = np.vstack([src_normals @ pose[:3, :3].T for pose in poses])
    rows = rng.choice(1200, 150, replace=False)
    true = np.stack([rows % 400, rows], axis=1)
    wrong = np.stack([rng.integers(400, size=1350), rng.integers(1200, size=1350)], axis=1)
    return src, tgt, rng.permutation(np.vstack([true, wrong])), poses, src_normals, tgt_normals


SRC, TGT, CORR, POSES, SRC_NORMALS, TGT_NORMALS = scene_with_normals()


def with_normals(src_normals, tgt_normals, **changes):
    params = PLAIN.replace(**changes)
    return ibi.register(SRC, TGT, CORR, params, src_normals=src_normals, tgt_normals=tgt_normals)


@pytest.mark.parametrize("oriented", [True, False])
def test_all_is_found_with_normals(oriented):
    found = with_normals(SRC_NORMALS, 3 * TGT_NORMALS, oriented_normals=oriented)
    assert metrics.score_scene(found, POSES).f1 == 1
    assert len(found) == 3


def test_the_sign_of_normals_without_orientation_does_not_matter():
    plain = with_normals(SRC_NORMALS, TGT_NORMALS)
    assert len(plain) == 3
    for seed in range(3):
        rng = np.random.default_rng(seed)
        src_signs, tgt_signs = (rng.choice([-1, 1], (len(cloud), 1)) for cloud in (SRC, TGT))
        found = with_normals(src_signs * SRC_NORMALS, tgt_signs * TGT_NORMALS)
        np.testing.assert_allclose(np.asarray(found), np.asarray(plain), atol=1e-12)
        np.testing.assert_array_equal(found.labels, plain.labels)
        for a, b in zip(found, plain, strict=True):
            assert [getattr(a, m) for m in MEASURES] == pytest.approx([getattr(b, m) for m in MEASURES])


def test_the_sign_of_oriented_normals_does_matter():
    assert len(with_normals(SRC_NORMALS, -TGT_NORMALS, oriented_normals=True)) == 0
    assert len(with_normals(-SRC_NORMALS, -TGT_NORMALS, oriented_normals=True)) == 3


def test_normals_can_be_left_out():
    wrong = np.random.default_rng(0).normal(size=TGT.shape)
    ignored = {"min_normal_cos": None, "scs": ibi.LocalGtm(normal_tolerance=2)}
    bare = ibi.register(SRC, TGT, CORR)
    assert len(bare) == 3
    np.testing.assert_array_equal(np.asarray(with_normals(SRC_NORMALS, wrong, **ignored)), np.asarray(bare))
    assert all(pose.overlap < 0.9 for pose in with_normals(SRC_NORMALS, wrong))


# The same bits -------------------------------------------------------------------------------------------


@each_run
@pytest.mark.parametrize("num_threads", [1, 2, 7, np.int64(3)])
def test_the_number_of_threads_changes_no_bit(found, num_threads):
    assert content(register(found.params, num_threads=num_threads)) == content(found)


EACH_VARIANT = [
    {stage: variant.variant}
    for stage, union in (("scs", Scs), ("ce", Ce), ("te", Te), ("hv", Hv))
    for variant in get_args(union) or (union,)
] + [{"removal": word} for word in get_args(Removal)]


@pytest.mark.parametrize("base", [PLAIN, PAPER], ids=["default", "paper"])
@pytest.mark.parametrize("change", EACH_VARIANT, ids=lambda change: "-".join(*change.items()))
def test_no_variant_depends_on_the_number_of_threads(change, base):
    params = base.replace(**change, max_rounds=8)
    one = register(params, num_threads=1)
    assert one.rounds
    assert content(register(params, num_threads=5)) == content(one)


@pytest.mark.parametrize("text", ["1", "3", ""])
def test_the_environment_changes_no_bit(monkeypatch, text):
    monkeypatch.setenv("IBI_NUM_THREADS", text)
    for found in RUNS.values():
        assert content(register(found.params)) == content(found)


def test_the_seed_changes_the_samples():
    """With fewer players than correspondences another seed draws others."""
    params = [PAPER.replace(seed=seed, scs=ibi.Gtm(n_downsample=300)) for seed in (1, 1, 2)]
    a, b, c = (content(register(p))[2] for p in params)
    assert a == b
    assert a != c


# Why it stops --------------------------------------------------------------------------------------------


# The same rows in other company: nothing is consistent by more than chance.
SHUFFLED = np.stack([np.random.default_rng(0).permutation(SCENE.corr[:, 0]), SCENE.corr[:, 1]], axis=1)


@pytest.mark.parametrize(
    ("name", "value", "threshold", "options"),
    [
        ("few_correspondences", 0, 3, {"corr": np.empty((0, 2), int)}),
        ("few_seeds", 0, 5, {"corr": np.repeat(SCENE.corr[:1], 50, axis=0)}),
        ("few_seeds", 0, 4, {"params": PLAIN, "corr": np.repeat(SCENE.corr[:1], 50, axis=0)}),
        ("max_rejections", 3, 3, {"params": PLAIN.replace(max_rejections=3), "corr": SHUFFLED}),
        ("max_rounds", 2, 2, {"params": PAPER.replace(max_rounds=2)}),
        ("max_rounds", 2, 2, {"params": PLAIN.replace(max_rounds=2)}),
        ("max_rounds", 0, 0, {"params": PAPER.replace(max_rounds=0)}),
        ("max_instances", 1, 1, {"params": PAPER.replace(max_instances=1)}),
        ("max_instances", 2, 2, {"params": PLAIN.replace(max_instances=2)}),
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
    params = PAPER.replace(max_instances=3, timeout_s=100)
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


def test_a_stopped_contest_keeps_the_best_of_what_it_has():
    """Also where the run ends before its first contest does."""
    for limit in (2, 5, 20):
        found = register(PLAIN.replace(max_rounds=limit, hv=ibi.Evidence(t_sure=1)))  # none is sure enough
        assert len(found.rounds) == limit
        assert 1 <= len(found) <= limit
        assert all(pose.round < limit for pose in found)
        assert metrics.score_scene(found, SCENE.poses).precision == 1


# The callback --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("answer", [None, True, np.True_, 1, 0, "", []])
def test_the_callback_sees_every_round_in_order(answer):
    """Only False ends a run: a callback that returns nothing, or a count of nothing, goes on."""
    seen = []

    def callback(entry):
        seen.append(entry)
        return answer

    for run in RUNS.values():
        seen.clear()
        found = register(run.params, callback=callback)
        assert tuple(seen) == found.rounds
        assert content(found) == content(run)


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


# The model that is prepared once -------------------------------------------------------------------------


def test_a_model_finds_what_register_finds_and_again():
    model = ibi.Model(SCENE.src)
    for _ in range(2):
        assert content(model.register(SCENE.tgt, SCENE.corr, PLAIN)) == content(RUNS["default"])
    assert len(model) == len(SCENE.src)
    assert model.spacing == pytest.approx(spacing(SCENE.src), rel=1e-6)
    assert model.diameter == pytest.approx(metrics.diameter(SCENE.src))
    assert "without normals" in repr(model)


def test_a_model_with_normals_wants_those_of_the_scene_too():
    normals = np.tile([0.0, 0.0, 2.0], (len(SCENE.src), 1))
    model = ibi.Model(SCENE.src, normals=normals)
    with pytest.raises(ibi.InputError, match="tgt_normals"):
        model.register(SCENE.tgt, SCENE.corr)
    with pytest.raises(ibi.InputError, match="src_normals"):
        ibi.Model(SCENE.src, normals=normals[1:])


def test_a_model_keeps_its_frames():
    """Exact ones: each a rotation at random, turned with its instance."""
    rng, n = np.random.default_rng(2), len(SCENE.src)
    src_frames = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    src_frames *= np.linalg.det(src_frames)[:, None, None]
    tgt_frames = np.tile(np.eye(3), (len(SCENE.tgt), 1, 1))
    for k, pose in enumerate(SCENE.poses):
        tgt_frames[k * n : (k + 1) * n] = src_frames @ pose[:3, :3].T
    params = PAPER.replace(scs="hough3d")
    direct = register(params, src_frames=src_frames.astype("f4"), tgt_frames=tgt_frames)
    assert direct.rounds[0].num_seeds > 50
    assert metrics.score_scene(direct, SCENE.poses).recall > 0.7
    model = ibi.Model(SCENE.src, frames=src_frames.astype("f4"))
    for one in (model, pickle.loads(pickle.dumps(model))):
        assert content(one.register(SCENE.tgt, SCENE.corr, params, tgt_frames=tgt_frames)) == content(direct)
        assert one.frames.shape == (n, 3, 3)
        with pytest.raises(ibi.InputError, match="tgt_frames"):
            one.register(SCENE.tgt, SCENE.corr, params)


def test_a_model_survives_a_pickle_and_changes_of_the_callers_arrays():
    src = SCENE.src.copy()
    model = ibi.Model(src)
    src[:] = 0
    for one in (model, pickle.loads(pickle.dumps(model))):
        assert content(one.register(SCENE.tgt, SCENE.corr, PLAIN)) == content(RUNS["default"])
        with pytest.raises(ValueError, match="read-only"):
            one.points[0] = 0


@pytest.mark.parametrize("src", [SCENE.src[:2], np.zeros((5, 3)), np.full((5, 3), np.nan), np.zeros((5, 2))])
def test_a_model_of_bad_points_is_refused(src):
    with pytest.raises(ibi.InputError, match="src"):
        ibi.Model(src)
