"""The metrics against hand-made cases and a numpy reference that is too slow to be wrong."""

from itertools import permutations

import numpy as np
import pytest
from ibi_rs import metrics

IDENTITY = np.eye(4)
STICK = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])  # half a turn about z


def at(x, y=0.0, z=0.0):
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def turned(degrees, axis=(0.0, 0.0, 1.0)):
    """Rodrigues' formula."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.radians(degrees)
    pose = np.eye(4)
    pose[:3, :3] += np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return pose


def random_pose(rng, spread=10.0, degrees=180.0):
    pose = turned(rng.uniform(0.0, degrees), rng.normal(size=3))
    pose[:3, 3] = rng.uniform(-spread, spread, 3)
    return pose


def random_scene(rng):
    """Poses near a truth, several near the same one, and some anywhere."""
    truth = [random_pose(rng) for _ in range(rng.integers(0, 6))]
    predicted = [random_pose(rng) for _ in range(rng.integers(0, 3))]
    if truth:
        near = rng.integers(0, len(truth), rng.integers(0, 5))
        predicted += [
            truth[row] @ random_pose(rng, spread=rng.choice([0.05, 0.4]), degrees=25.0) for row in near
        ]
    order = rng.permutation(len(predicted))
    return np.reshape([predicted[i] for i in order], (-1, 4, 4)), np.reshape(truth, (-1, 4, 4))


def moved(points, pose):
    return points @ pose[:3, :3].T + pose[:3, 3]


# The reference -------------------------------------------------------------------------------------------


def reference_angle(a, b):
    relative = a[:3, :3].T @ b[:3, :3]
    sine = np.linalg.norm(relative - relative.T) / np.sqrt(8.0)
    return np.degrees(np.arctan2(sine, (np.trace(relative) - 1.0) / 2.0))


def reference_assignment(cost):
    """The cheapest of all complete assignments, as pairs of row and column."""
    rows, cols = cost.shape
    if rows > cols:
        return [(row, col) for col, row in reference_assignment(cost.T)]
    best = min(
        permutations(range(cols), rows), key=lambda p: sum(cost[row, col] for row, col in enumerate(p))
    )
    return list(enumerate(best))


def reference_add_s(model, predicted, truth):
    apart = moved(model, truth)[:, None] - moved(model, predicted)[None]
    return np.linalg.norm(apart, axis=2).min(axis=1).mean()


def reference_score(predicted, truth, matching, criterion, model):
    """(truth hit, predicted hit), straight from the definitions."""
    if isinstance(criterion, metrics.AddS):
        limit = criterion.diameter_fraction * max(np.linalg.norm(p - q) for p in model for q in model)
        cost = np.array([[reference_add_s(model, p, t) for t in truth] for p in predicted])
        hit = cost < limit
    else:
        cost = np.array([[np.linalg.norm(p - t) for t in truth] for p in predicted])
        hit = np.array(
            [
                [
                    reference_angle(p, t) < criterion.rotation_deg
                    and np.linalg.norm(p[:3, 3] - t[:3, 3]) < criterion.translation
                    for t in truth
                ]
                for p in predicted
            ]
        )
    shape = (len(predicted), len(truth))
    cost, hit = cost.reshape(shape), hit.reshape(shape).astype(bool)
    if matching == "one_to_one":
        hits = sum(hit[pair] for pair in reference_assignment(cost))
        return hits, hits
    return hit.any(axis=0).sum(), hit.any(axis=1).sum()


# Pose errors ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [0.0, 1e-6, 1.0, 90.0, 179.0, 179.999999, 180.0])
def test_rotation_error_is_the_angle_turned_by(degrees):
    rng = np.random.default_rng(1)
    for _ in range(20):
        a = random_pose(rng)
        error = metrics.rotation_error_deg(a, a @ turned(degrees, rng.normal(size=3)))
        assert error == pytest.approx(degrees, abs=1e-12)


def test_pose_errors_agree_with_the_reference():
    rng = np.random.default_rng(2)
    for _ in range(50):
        a, b = random_pose(rng), random_pose(rng)
        assert metrics.rotation_error_deg(a, b) == pytest.approx(reference_angle(a, b), abs=1e-10)
        assert metrics.translation_error(a, b) == pytest.approx(np.linalg.norm(a[:3, 3] - b[:3, 3]))
        assert metrics.frobenius_distance(a, b) == pytest.approx(np.linalg.norm(a - b))


def test_model_errors_agree_with_the_reference():
    rng = np.random.default_rng(3)
    for _ in range(30):
        model = rng.normal(size=(rng.integers(1, 40), 3))
        a, b, s = random_pose(rng), random_pose(rng), random_pose(rng)
        apart = np.linalg.norm(moved(model, a) - moved(model, b), axis=1)
        apart_s = np.linalg.norm(moved(model, a) - moved(moved(model, s), b), axis=1)
        assert metrics.add(model, a, b) == pytest.approx(apart.mean())
        assert metrics.add_s(model, a, b) == pytest.approx(reference_add_s(model, a, b))
        assert metrics.mssd(model, a, b) == pytest.approx(apart.max())
        assert metrics.mssd(model, a, b, symmetries=[s]) == pytest.approx(min(apart.max(), apart_s.max()))


def test_a_flipped_stick():
    # Each end is a length of 2 from where it was, but on the other end.
    assert metrics.add(STICK, FLIP, IDENTITY) == 2.0
    assert metrics.add_s(STICK, FLIP, IDENTITY) == 0.0
    assert metrics.mssd(STICK, FLIP, IDENTITY) == 2.0
    assert metrics.mssd(STICK, FLIP, IDENTITY, symmetries=[FLIP]) == 0.0


def test_add_s_asks_from_the_truth_to_the_prediction():
    # Points at 0, 1, 10; predicted at 9, 10, 19. From the truth 9 + 8 + 0, the other way 1 + 0 + 9.
    model = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [10.0, 0.0, 0.0]]
    assert metrics.add_s(model, at(9.0), IDENTITY) == pytest.approx(17.0 / 3.0)
    assert metrics.add_s(model, IDENTITY, at(9.0)) == pytest.approx(10.0 / 3.0)


def test_add_s_of_a_model_with_repeated_and_coplanar_points():
    # A kd-tree that cannot split equal coordinates would fail here.
    plate = np.zeros((3000, 3))
    plate[:, 0] = np.repeat([0.0, 1.0, 2.0], 1000)
    assert metrics.add_s(plate, at(0.0, 0.0, 0.5), IDENTITY) == pytest.approx(0.5)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 100])
def test_diameter_is_the_largest_of_all_distances(count):
    points = np.random.default_rng(count).normal(size=(count, 3))
    for cloud in (points, points / np.linalg.norm(points, axis=1, keepdims=True), points * [100.0, 1.0, 0.0]):
        apart = np.linalg.norm(cloud[:, None] - cloud[None], axis=2)
        assert metrics.diameter(cloud) == pytest.approx(apart.max(initial=0.0), rel=1e-14)


def test_assignment_agrees_with_all_permutations():
    rng = np.random.default_rng(4)
    for rows in range(6):
        for cols in range(6):
            # Small integers make ties common: the total must be the same, the columns need not.
            cost = rng.integers(-3, 4, (rows, cols)).astype(float)
            columns = metrics.assignment(cost)
            pairs = [(row, col) for row, col in enumerate(columns) if col >= 0]
            assert len({col for _, col in pairs}) == len(pairs) == min(rows, cols)
            assert sum(cost[p] for p in pairs) == sum(cost[p] for p in reference_assignment(cost))


# Scores --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("matching", ["one_to_one", "any"])
@pytest.mark.parametrize("criterion", [metrics.ECC, metrics.POINTCLM_SCAN, metrics.ADD_S])
def test_score_agrees_with_the_reference(matching, criterion):
    rng = np.random.default_rng(5)
    model = rng.normal(size=(20, 3)) * 2.0
    hits = 0
    for _ in range(40):
        predicted, truth = random_scene(rng)
        score = metrics.score_scene(
            predicted,
            truth,
            matching=matching,
            criterion=criterion,
            model=model if isinstance(criterion, metrics.AddS) else None,
        )
        truth_hit, predicted_hit = reference_score(predicted, truth, matching, criterion, model)
        assert (score.num_truth_hit, score.num_predicted_hit) == (truth_hit, predicted_hit)
        assert (score.num_truth, score.num_predicted) == (len(truth), len(predicted))
        assert sum(m is not None and m.is_hit for m in score.matches) == predicted_hit
        if len(truth) and len(predicted):
            assert score.recall == truth_hit / len(truth)
            assert score.precision == predicted_hit / len(predicted)
        hits += truth_hit
    assert hits > 10  # or the scenes say nothing


def test_duplicates_are_false_positives_or_free():
    # Truth at 0 and 10; 0 is found three times. Of the three, 0.1 -> 0 and 0.3 -> 10 cost least, 9.8.
    predicted, truth = [at(0.2), at(0.1), at(0.3)], [at(0.0), at(10.0)]
    strict = metrics.score_scene(predicted, truth)
    assert (strict.recall, strict.precision, strict.f1) == pytest.approx((1 / 2, 1 / 3, 2 / 5))
    assert [m and m.truth for m in strict.matches] == [None, 0, 1]
    lenient = metrics.score_scene(predicted, truth, matching="any")
    assert (lenient.recall, lenient.precision, lenient.f1) == pytest.approx((1 / 2, 1.0, 2 / 3))


def test_pairs_are_assigned_before_the_threshold():
    # 0.4 hits the truth at 0, but 0.4 -> 0 and -0.6 -> 1 cost 2.0, the other way round 1.2, and no hit.
    predicted, truth = [at(0.4), at(-0.6)], [at(0.0), at(1.0)]
    assert metrics.score_scene(predicted, truth).recall == 0.0
    assert metrics.score_scene(predicted, truth, matching="any").recall == 0.5


def test_a_match_says_how_far_off_it_is():
    predicted = at(3.0, 0.3, 0.4) @ turned(10.0)
    (match,) = metrics.score_scene(
        [predicted], [at(3.0)], criterion=metrics.PoseThresholds(20.0, 0.4)
    ).matches
    assert match is not None
    assert match.truth == 0
    assert match.rotation_error_deg == pytest.approx(10.0)
    assert match.translation_error == pytest.approx(0.5)
    # 8 sin^2(5 deg) + 0.25.
    assert match.distance == pytest.approx(np.sqrt(8.0 * np.sin(np.radians(5.0)) ** 2 + 0.25))
    assert not match.is_hit


@pytest.mark.parametrize("matching", ["one_to_one", "any"])
def test_where_there_is_nothing(matching):
    def rates(predicted, truth):
        score = metrics.score_scene(predicted, truth, matching=matching)
        return score.recall, score.precision, score.f1

    assert rates([], [IDENTITY]) == (0.0, 0.0, 0.0)
    assert rates([IDENTITY], []) == (1.0, 0.0, 0.0)
    assert rates(np.empty((0, 4, 4)), []) == (1.0, 1.0, 1.0)


@pytest.mark.parametrize("matching", ["one_to_one", "any"])
def test_a_symmetric_part_is_found_by_add_s_only(matching):
    assert metrics.score_scene([FLIP], [IDENTITY], matching=matching).recall == 0.0
    score = metrics.score_scene([FLIP], [IDENTITY], matching=matching, criterion=metrics.ADD_S, model=STICK)
    assert score.recall == 1.0
    # 0.1 of the diameter 2.
    for y, recall in ((0.19, 1.0), (0.21, 0.0)):
        score = metrics.score_scene([at(0.0, y)], [IDENTITY], criterion=metrics.ADD_S, model=STICK)
        assert score.recall == recall


def test_the_two_families_average_f1_differently():
    # Scene 1: 1 of 4 found by 1 prediction; scene 2: 2 of 2 found, 2 predictions besides.
    first = [at(0.0)], [at(10.0 * i) for i in range(4)]
    second = [at(0.0), at(10.0), at(50.0), at(60.0)], [at(0.0), at(10.0)]
    for matching, mhf1 in (("one_to_one", (2 / 5 + 2 / 3) / 2), ("any", 15 / 22)):
        scenes = [metrics.score_scene(*scene, matching=matching) for scene in (first, second)]
        mean = metrics.mean_score(iter(scenes))
        assert (mean.mhr, mean.mhp, mean.mhf1) == pytest.approx((5 / 8, 3 / 4, mhf1))
        assert (mean.matching, mean.num_scenes) == (matching, 2)


def test_mssd_recall():
    # Diameter 2: 0.14 and 0.84 are 0.07 and 0.42 of it. Found from 0.10 and 0.45 on, the third never:
    # recalls 0, seven times 1/3, twice 2/3.
    predicted, truth = [at(0.14), at(10.84), at(23.0)], [at(0.0), at(10.0), at(20.0)]
    found = metrics.mssd_recall(predicted, truth, model=STICK)
    assert found.recalls == pytest.approx((0,) + (1 / 3,) * 7 + (2 / 3,) * 2)
    assert found.average == pytest.approx(11 / 30)
    assert len(found.recalls) == len(metrics.MSSD_DIAMETER_FRACTIONS)
    assert metrics.mssd_recall([FLIP], [IDENTITY], model=STICK).average == 0.0
    assert metrics.mssd_recall([FLIP], [IDENTITY], model=STICK, symmetries=[FLIP]).average == 1.0


def test_thresholds_are_those_of_the_papers():
    assert metrics.PoseThresholds(20.0, 0.5) == metrics.ECC
    assert metrics.PoseThresholds(15.0, 0.1) == metrics.POINTCLM_SCAN
    assert metrics.pointclm_voxels(0.25) == metrics.PoseThresholds(15.0, 1.0)
    assert metrics.strict(0.02) == metrics.PoseThresholds(5.0, 0.02)
    assert metrics.AddS(0.1) == metrics.ADD_S


# The door ------------------------------------------------------------------------------------------------


class HasPoses:
    """Stands for a Registration: anything that numpy can read."""

    def __array__(self, dtype=None, copy=None):
        return np.stack([IDENTITY]).astype(dtype or float)


def test_what_is_accepted():
    assert metrics.score_scene(HasPoses(), HasPoses()).f1 == 1.0
    assert metrics.score_scene([np.eye(4, dtype=int)], np.eye(4, dtype=np.float32)[None]).f1 == 1.0
    strided = np.asfortranarray(np.stack([at(1.0), at(2.0), at(3.0)]))[::2]
    assert metrics.score_scene(strided, strided).f1 == 1.0
    # A rotation that has been through single precision is still one.
    rounded = random_pose(np.random.default_rng(6)).astype(np.float32)
    assert metrics.rotation_error_deg(rounded, rounded) < 1e-12


SCALED = np.diag([2.0, 2.0, 2.0, 1.0])
MIRRORED = np.diag([1.0, 1.0, -1.0, 1.0])
PROJECTIVE = np.eye(4) + np.eye(4)[[3]].T @ [[0.1, 0.0, 0.0, 0.0]]
NOT_FINITE = at(np.nan)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda: metrics.score_scene(IDENTITY, []),
            ValueError,
            r"predicted has shape \(4, 4\); it must be \(K, 4, 4\)",
        ),
        (lambda: metrics.score_scene([IDENTITY, SCALED], []), ValueError, r"predicted\[1\] .* orthonormal"),
        (lambda: metrics.score_scene([], [MIRRORED]), ValueError, r"truth\[0\] .* reflection"),
        (
            lambda: metrics.score_scene([], [PROJECTIVE]),
            ValueError,
            r"truth\[0\] .* last row must be 0 0 0 1",
        ),
        (lambda: metrics.score_scene([NOT_FINITE], []), ValueError, r"predicted\[0\] must be finite"),
        (
            lambda: metrics.score_scene(["x"], []),
            TypeError,
            "predicted has dtype .*; it must be real numbers",
        ),
        (lambda: metrics.score_scene(None, []), TypeError, "predicted has dtype .*; it must be real numbers"),
        (
            lambda: metrics.score_scene([[1.0], [1.0, 2.0]], []),
            ValueError,
            "predicted is not a rectangular array",
        ),
        (lambda: metrics.score_scene([], [], matching="all"), ValueError, "'one_to_one' or 'any', not 'all'"),
        (lambda: metrics.score_scene([], [], criterion=0.5), TypeError, "PoseThresholds or AddS, not float"),
        (lambda: metrics.score_scene([], [], criterion=metrics.ADD_S), ValueError, "model must be given"),
        (lambda: metrics.score_scene([], [], model=STICK), ValueError, "model must be left out"),
        (
            lambda: metrics.rotation_error_deg(np.eye(3), IDENTITY),
            ValueError,
            r"a has shape .* must be \(4, 4\)",
        ),
        (lambda: metrics.translation_error(IDENTITY, SCALED), ValueError, "b must be a rigid motion"),
        (lambda: metrics.add([], IDENTITY, IDENTITY), ValueError, "the model has no points"),
        (
            lambda: metrics.add_s(STICK[:, :2], IDENTITY, IDENTITY),
            ValueError,
            r"model has shape .* must be \(N, 3\)",
        ),
        (
            lambda: metrics.mssd(STICK, IDENTITY, IDENTITY, symmetries=[SCALED]),
            ValueError,
            r"symmetries\[0\]",
        ),
        (
            lambda: metrics.diameter([[0.0, 0.0, 0.0], [np.inf, 0.0, 0.0]]),
            ValueError,
            r"points\[1\] must be finite",
        ),
        (lambda: metrics.diameter(STICK * 1j), TypeError, "points has dtype .*; it must be real numbers"),
        (lambda: metrics.assignment([1.0]), ValueError, r"cost has shape .* must be \(R, C\)"),
        (lambda: metrics.assignment([[1.0, 2.0], [np.nan, 1.0]]), ValueError, r"cost\[1, 0\] must be finite"),
        (lambda: metrics.mean_score([]), ValueError, "scenes must hold at least one"),
        (lambda: metrics.mean_score([0.5]), TypeError, r"scenes\[0\] must be a SceneScore, not float"),
        (lambda: metrics.PoseThresholds(0.0, 1.0), ValueError, "rotation_deg must be above 0, not 0.0"),
        (
            lambda: metrics.PoseThresholds(20.0, float("nan")),
            ValueError,
            "translation must be above 0, not nan",
        ),
        (lambda: metrics.AddS("0.1"), TypeError, "diameter_fraction must be a number, not str"),
        (lambda: metrics.strict(-1.0), ValueError, "resolution must be above 0"),
        (lambda: metrics.pointclm_voxels(0.0), ValueError, "voxel must be above 0"),
    ],
)
def test_bad_input_is_named_in_one_line(call, error, message):
    with pytest.raises(error, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_no_mean_of_both_families():
    scenes = [metrics.score_scene([], [], matching=matching) for matching in ("any", "one_to_one")]
    with pytest.raises(ValueError, match=r"scenes\[1\] must be scored with 'any'"):
        metrics.mean_score(scenes)
