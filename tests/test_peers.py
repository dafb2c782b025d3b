"""What benchmarks/peers has of its own: ECC from its paper, the overlap check, the sequence."""

import sys
from pathlib import Path

import numpy as np
import pytest
from ibi_rs import metrics, synth
from ibi_rs.synth.scene import move

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

from peers import METHODS, ecc, pcl  # noqa: E402
from peers.contract import Missing, model_spacing  # noqa: E402
from peers.overlap import Claims, keep_best  # noqa: E402
from peers.sequence import in_sequence  # noqa: E402
from peers.settings import FAMILIES, SETTINGS, SWEEP, settings, table  # noqa: E402


@pytest.fixture(scope="module")
def scene():
    return synth.outlier_layout(3, outlier_ratio=0.6, num_instances=5, num_correspondences=800)


@pytest.fixture
def pairs():
    rng = np.random.default_rng(0)
    return rng.normal(size=(40, 3)), rng.normal(size=(40, 3))


# ECC ------------------------------------------------------------------------------------------------------


def test_ecc_finds_all_instances(scene):
    found = ecc.prepare(scene)(scene)
    score = metrics.score_scene(found, scene.poses)
    assert score.recall == 1
    assert score.precision == 1


def test_ecc_of_noise_is_little_or_nothing():
    scene = synth.outlier_layout(3, num_instances=0, num_correspondences=50, num_clutter=500)
    assert ecc.prepare(scene)(scene).shape == (0, 4, 4)


def test_compatibility_is_the_formula(pairs):
    src, tgt = pairs
    fast = ecc.compatibility(src, tgt)
    slow = np.empty((40, 40))
    for i in range(40):
        for j in range(40):
            a, b = np.linalg.norm(src[i] - src[j]), np.linalg.norm(tgt[i] - tgt[j])
            g = 1 if i == j else min(a / b, b / a)
            slow[i, j] = (g / 0.9) ** 2 * max(0, 1 - ((a + b) / 2) ** 2 / 2**2)
    np.testing.assert_allclose(fast, slow / slow.max(), atol=1e-5)


def test_compatibility_of_two_matches_of_one_point():
    src, tgt = np.zeros((2, 3)), np.array([[0.0, 0, 0], [1, 0, 0]])
    np.testing.assert_allclose(ecc.compatibility(src, tgt), np.eye(2))


def naive_clusters(similarity, t_merge):
    """Search all pairs for the nearest, at each merge."""
    columns = {i: similarity[:, i].astype(float) for i in range(len(similarity))}
    label = np.arange(len(similarity))
    while True:
        best = (t_merge, None, None)
        for i in columns:
            for j in columns:
                if i < j:
                    u, v = columns[i], columns[j]
                    distance = 1 - u @ v / (u @ u + v @ v - u @ v)
                    best = min(best, (distance, i, j), key=lambda entry: entry[0])
        _, i, j = best
        if i is None:
            return label
        columns[i] = np.minimum(columns[i], columns.pop(j))
        label[label == j] = i


@pytest.mark.parametrize("t_merge", [0.2, 0.6])
@pytest.mark.parametrize("seed", range(3))
def test_clusters_are_those_of_a_full_search(seed, t_merge):
    rng = np.random.default_rng(seed)
    src = rng.normal(size=(45, 3))
    tgt = src + np.repeat([[0.0, 0, 0], [4, 0, 0], [0, 5, 0]], 15, axis=0) + rng.normal(size=(45, 3)) * 0.05
    tgt[::4] = rng.normal(size=(12, 3)) * 3
    similarity = ecc.compatibility(src, tgt)
    fast, slow = ecc.clusters(similarity, t_merge), naive_clusters(similarity, t_merge)
    same = fast[:, None] == fast
    np.testing.assert_array_equal(same, slow[:, None] == slow)
    assert same.sum() > len(same)


def test_fit_gives_back_each_pose(scene):
    rng = np.random.default_rng(0)
    label = rng.integers(-1, 5, size=300)
    src = rng.normal(size=(300, 3))
    tgt = np.array([move(scene.poses[k], p[None])[0] for k, p in zip(label, src, strict=True)])
    np.testing.assert_allclose(ecc.fit(src, tgt, label, 5), scene.poses[:5], atol=1e-9)


def test_fit_never_mirrors(pairs):
    src, tgt = pairs
    pose = ecc.fit(src, tgt * [1, 1, -1], np.zeros(40, dtype=int), 1)[0]
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)


def test_residuals_are_distances_both_ways(scene, pairs):
    src, tgt = pairs
    fast = ecc.residuals(scene.poses, src, tgt)
    for k, pose in enumerate(scene.poses):
        np.testing.assert_allclose(fast[k], np.linalg.norm(move(pose, src) - tgt, axis=1), atol=1e-9)
        back = np.linalg.norm(move(np.linalg.inv(pose), tgt) - src, axis=1)
        np.testing.assert_allclose(fast[k], back, atol=1e-9)


def test_distinct_drops_the_earlier_of_two_alike():
    inliers = np.zeros((4, 20), dtype=bool)
    inliers[0, :10] = inliers[1, 10:] = inliers[2, :9] = True  # 0 and 2 share 9 of 10
    np.testing.assert_array_equal(ecc.distinct(inliers), [False, True, True, True])


# The overlap check ----------------------------------------------------------------------------------------


def naive_keep_best(poses, scene, radius, least):
    free, kept = np.ones(len(scene.tgt), dtype=bool), []
    for pose in poses:
        near = np.linalg.norm(move(pose, scene.src)[:, None] - scene.tgt, axis=2) < radius
        if np.mean(np.any(near[:, free], axis=1)) > least:
            free[np.any(near, axis=0)] = False
            kept.append(pose)
    return np.array(kept).reshape(-1, 4, 4)


def test_overlap_check_is_that_of_all_distances():
    scene = synth.outlier_layout(1, num_instances=4, num_correspondences=200, num_points=100, num_clutter=300)
    rng = np.random.default_rng(0)
    candidates = np.concatenate([scene.poses] * 4)
    candidates[:, :3, 3] += rng.normal(size=(16, 3)) * np.repeat([0.02, 0.1, 0.2, 1.0], 4)[:, None]
    candidates = candidates[rng.permutation(16)]
    radius = 1.5 * model_spacing(scene.src)
    for least in (0.3, 0.5, 0.8):
        kept = keep_best(candidates, Claims(scene.src, scene.tgt, radius), least)
        np.testing.assert_array_equal(kept, naive_keep_best(candidates, scene, radius, least))
        assert 0 < len(kept) < 16


def test_a_kept_pose_claims_its_points(scene):
    claims = Claims(scene.src, scene.tgt, 1.5 * model_spacing(scene.src))
    assert claims.keep(scene.poses[0], 0.5)
    assert claims.free[: len(scene.src)].mean() < 0.1  # the first instance, but for its noisiest points
    assert claims.free[len(scene.src) :].all()
    assert not claims.keep(scene.poses[0], 0.5)
    assert claims.keep(scene.poses[1], 0.5)


def test_sequence_ends_after_failures_in_a_row(scene):
    radius = 1.5 * model_spacing(scene.src)
    away = np.eye(4)
    away[:3, 3] = 1e3
    asked = []

    def solve(src, tgt):
        asked.append(len(src))
        return {1: scene.poses[0], 2: away, 3: scene.poses[1]}.get(len(asked), away)

    claims = Claims(scene.src, scene.tgt, radius)
    found = in_sequence(scene, solve, claims, least=0.5, inlier=radius, failures=3)
    np.testing.assert_array_equal(found, scene.poses[:2])
    assert len(asked) == 6
    assert asked[0] > asked[1] == asked[2] > asked[3]


# The table of methods -------------------------------------------------------------------------------------


def test_a_missing_peer_says_why(monkeypatch, tmp_path):
    monkeypatch.setattr(pcl, "LIBRARY", tmp_path / "_pcl.so")
    pcl._library.cache_clear()
    with pytest.raises(Missing, match="libpcl-dev"):
        pcl.version()


def test_every_peer_has_settings_for_every_family():
    peers = {name for name in METHODS if not name.startswith("ibi")}
    assert peers == set(SETTINGS) == set(SWEEP)
    for name in peers:
        assert set(SETTINGS[name]) == set(FAMILIES)
        for values in SETTINGS[name].values():
            assert set(SWEEP[name]) <= set(values)
    assert settings("ECC", "ecc-0.02") is SETTINGS["ECC"]["ecc"]


def test_the_documentation_has_these_settings():
    page = (BENCHMARKS.parent / "docs/peers.md").read_text(encoding="utf-8")
    assert table() in page, "paste what peers.settings.table() returns"
