"""What benchmarks/peers has of its own: methods written from papers, the overlap check, the sequence."""

import dataclasses
import re
import sys
from itertools import combinations
from pathlib import Path

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import metrics, synth
from ibi_rs.synth.scene import move

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import paper_loop  # noqa: E402
import paper_rows  # noqa: E402
import paper_tables  # noqa: E402
from frame import records  # noqa: E402
from peers import METHODS, consac, ecc, pcl, pointclm, progx, tlinkage, triplets  # noqa: E402
from peers.contract import Missing, model_spacing  # noqa: E402
from peers.methods import LEARNED  # noqa: E402
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


# T-Linkage and Progressive-X ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "change"), [("T-Linkage", {"tau_pr": 0.5, "least": 8}), ("Progressive-X", {"least": 12})]
)
def test_multi_model_fitting_finds_all_instances_among_few_outliers(name, change):
    scene = synth.outlier_layout(3, outlier_ratio=0.4, num_instances=4, num_correspondences=800)
    found = METHODS[name].prepare(scene, {**settings(name, "outlier-10-50"), **change})(scene)
    score = metrics.score_scene(found, scene.poses)
    assert score.recall == 1
    assert score.precision == 1


@pytest.mark.parametrize("name", ["T-Linkage", "Progressive-X"])
@pytest.mark.parametrize("rows", [0, 2, 40])
def test_multi_model_fitting_of_little_or_noise_is_nothing(name, rows):
    scene = synth.outlier_layout(3, num_instances=0, num_correspondences=40, num_clutter=500)
    scene = dataclasses.replace(scene, corr=scene.corr[:rows])
    found = METHODS[name].prepare(scene, {**settings(name, "outlier-10-50"), "least": 8})(scene)
    assert found.shape == (0, 4, 4)


def test_sampled_triplets_are_near_and_may_be_rigid(scene):
    src, tgt = scene.src[scene.corr[:, 0]], scene.tgt[scene.corr[:, 1]]
    sampler = triplets.Sampler(src, tgt, 20, 0.1, np.random.default_rng(0))
    rows = sampler.triplets(20_000)
    assert len(rows) > 20
    distance = np.linalg.norm(tgt[:, None] - tgt, axis=2)
    farthest = np.sort(distance, axis=1)[:, 20]  # not by rank: target points repeat
    for i, *others in rows:
        assert all(distance[i, j] <= farthest[i] for j in others)
        for a, b in combinations((i, *others), 2):
            of_src, of_tgt = np.linalg.norm(src[a] - src[b]), np.linalg.norm(tgt[a] - tgt[b])
            assert abs(of_src - of_tgt) <= 0.2
            assert min(of_src, of_tgt) > 0.1


def test_a_triplet_passed_over_has_no_rigid_pose():
    # With its pose of least squares, one of the three always stays farther than `inlier`.
    rng = np.random.default_rng(0)
    src, tgt = rng.normal(size=(500, 3, 3)), rng.normal(size=(500, 3, 3))
    passed = ~triplets.may_be_rigid(src, tgt, 0.3)
    short = np.minimum(*(np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2).min(axis=1) for x in (src, tgt)))
    for p, q in zip(src[passed & (short > 0.3)], tgt[passed & (short > 0.3)], strict=True):
        pose = ecc.fit(p, q, np.zeros(3, dtype=int), 1)[0]
        assert np.linalg.norm(move(pose, p) - q, axis=1).max() > 0.3


def test_preferences_are_the_formula():
    residual = np.array([[0.0, 0.1, 0.5, 2.0], [0.3, 0.49, 0.51, 0.2]])
    slow = [[np.exp(-r / 0.1) if r < 0.5 else 0 for r in column] for column in residual.T]
    np.testing.assert_allclose(tlinkage.preferences(residual, 0.1), slow, rtol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_clusters_of_preferences_end_when_nothing_is_shared(seed):
    rng = np.random.default_rng(seed)
    residual = rng.exponential(size=(30, 40)) * np.repeat(rng.permuted([0.1, 1, 1, 1]), 10)
    preference = tlinkage.preferences(residual + 2 * (rng.random((30, 40)) < 0.8), 0.2)
    preference[:3] = 0  # of nothing
    label = ecc.clusters(preference, 1)
    held = [preference[label == k].min(axis=0).astype(float) for k in np.unique(label)]
    for a, b in combinations(held, 2):
        assert a @ b == pytest.approx(0, abs=1e-6)
    assert len(np.unique(label[:3])) == 3
    assert len(held) < 40
    for k in np.unique(label):
        assert np.count_nonzero(label == k) == 1 or preference[label == k].min(axis=0).max() > 0


def test_quality_counts_what_is_not_explained():
    rng = np.random.default_rng(0)
    residual, explained = rng.exponential(size=(6, 50)), rng.exponential(size=50)
    gamma = 0.8
    slow = np.zeros(6)
    for k in range(6):
        for r, of_compound in zip(residual[k], explained, strict=True):
            slow[k] += 1 - min(1, max(r**2 / gamma**2, 1 - of_compound**2 / gamma**2))
    compound = progx.preference(explained[None], gamma)
    np.testing.assert_allclose(progx.quality(residual, compound, gamma), slow)


def test_likeness_is_tanimotos():
    a, b = np.array([1.0, 0.5, 0, 0]), np.array([1.0, 0, 0.5, 0])
    assert progx.alike(a, b, 0.66)  # 1 / (1.25 + 1.25 - 1)
    assert not progx.alike(a, b, 0.67)
    assert not progx.alike(a, np.zeros(4), 0)


def test_competing_models_keep_what_is_theirs(scene):
    src, tgt = scene.src[scene.corr[:, 0]], scene.tgt[scene.corr[:, 1]]
    gamma = 2 * model_spacing(scene.src)
    rough = np.concatenate([scene.poses, scene.poses[:2]])
    rough[:, :3, 3] += np.random.default_rng(0).normal(size=(7, 3)) * gamma / 4
    fitted = progx.compete(rough, src, tgt, gamma, 12)
    label = np.where(
        ecc.residuals(fitted, src, tgt).min(axis=0) < gamma,
        ecc.residuals(fitted, src, tgt).argmin(axis=0),
        -1,
    )
    assert np.bincount(label[label >= 0]).min() >= 12
    assert metrics.score_scene(fitted, scene.poses).recall == 1


def test_the_end_is_ransacs():
    compound = np.zeros(100)
    compound[:20] = 0.5
    size = progx.undetected(compound, 1000, 0.95)
    assert 1 - (1 - (size / 80) ** 3) ** 1000 == pytest.approx(0.95)
    assert progx.undetected(compound, 0, 0.95) == 80


# Networks -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("peer", "name"), [(consac, "CONSAC"), (pointclm, "PointCLM")])
def test_a_network_without_weights_is_missing(peer, name, scene, monkeypatch, tmp_path):
    monkeypatch.delenv(peer.VARIABLE, raising=False)
    for ask in (peer.version, lambda: peer.prepare(scene)):
        with pytest.raises(Missing, match=f"no weights of {name}; set {peer.VARIABLE}"):
            ask()
    with pytest.raises(Missing, match="no file"):
        peer.prepare(scene, checkpoint=str(tmp_path / "none.pt"))


@pytest.mark.parametrize("peer", [consac, pointclm])
def test_a_network_that_knows_the_truth_finds_all(peer, scene, monkeypatch):
    label = scene.labels()
    weights = {
        # True pairs of the instance that is explained least.
        consac: lambda x: np.where(
            label == np.bincount(label[(label >= 0) & (x[:, 6] == 0)]).argmax(), 0, -50
        ),
        pointclm: lambda x: np.where(label[:, None] < 0, 0, label[:, None] == np.arange(5)),
    }
    monkeypatch.setattr(peer.weights, "find", lambda *_: Path("fake"))
    monkeypatch.setattr(peer.weights, "load", lambda _: weights[peer])
    # In the order of the list, which the fake network knows.
    monkeypatch.setattr(
        np.random, "default_rng", lambda seed, make=np.random.default_rng: Unshuffled(make(seed))
    )
    score = metrics.score_scene(peer.prepare(scene)(scene), scene.poses)
    assert score.recall == 1
    assert score.precision == 1


class Unshuffled:
    def __init__(self, rng):
        self.choice = rng.choice

    def permutation(self, n):
        return np.arange(n)


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
    peers = {name for name in METHODS if not name.startswith("ibi")} - set(LEARNED)
    assert peers == set(SETTINGS) == set(SWEEP)
    for name in peers:
        assert set(SETTINGS[name]) == set(FAMILIES)
        for values in SETTINGS[name].values():
            assert set(SWEEP[name]) <= set(values)
    assert settings("ECC", "ecc-0.02") is SETTINGS["ECC"]["ecc"]


def test_the_documentation_has_these_settings():
    page = (BENCHMARKS.parent / "docs/peers.md").read_text(encoding="utf-8")
    assert table() in page, "paste what peers.settings.table() returns"


# The paper's tables ---------------------------------------------------------------------------------------


def test_the_naive_loop_finds_what_the_library_finds():
    scene = synth.outlier_layout(3, outlier_ratio=0.3, num_instances=3, num_correspondences=1000)
    params = ibi.Params.paper_synthetic()
    for first in (False, True):
        found = paper_loop.prepare(params, first=first)(scene)
        assert metrics.score_scene(found, scene.poses).f1 == 1
    assert metrics.score_scene(ibi.register(scene.src, scene.tgt, scene.corr, params), scene.poses).f1 == 1


def test_reordering_keeps_rows_together(scene):
    scene = dataclasses.replace(scene, similarity=np.arange(len(scene.corr), dtype=float))
    changed = paper_tables.reorder(scene, "by target point, inliers first, first 300")
    assert len(changed.corr) == 300
    np.testing.assert_array_equal(changed.corr, scene.corr[changed.similarity.astype(int)])
    is_true = changed.labels() >= 0
    assert is_true.sum() == min(300, (scene.labels() >= 0).sum())
    assert np.all(np.diff(is_true.astype(int)) <= 0)
    assert np.all(np.diff(changed.corr[is_true, 1]) >= 0)
    assert paper_tables.reorder(scene, "").corr is not scene.corr


def test_every_row_of_the_tables_can_be_made():
    for name, shown in paper_rows.TABLES.items():
        for data in shown.data:
            rows = list(shown.rows(data))
            assert len({row.name for row in rows}) == len(rows)
            for row in rows:
                assert row.missing or (row.params is None) != (row.peer is None)
                assert row.peer is None or row.peer in METHODS
            assert set(paper_rows.cited(name, data)) <= {row.name for row in rows}


def test_the_page_has_the_figures_of_the_record():
    page = paper_tables.PAGE.read_text(encoding="utf-8")
    held = records.read(records.RECORDS / paper_tables.RECORD)
    tables = paper_tables.page_tables(held)
    assert records.filled(page, tables) == page, "run benchmarks/paper_tables.py --docs"
    places = set(re.findall(r"<!-- begin ([^,]+), (.+?) -->", page))
    assert places == {paper_tables.block(row) for row in held}
