"""The built-in features: against Open3D where it is installed, on any threads, and what they refuse."""

import json
from pathlib import Path

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import features

try:
    import open3d as o3d
except ImportError:  # or one of the system libraries that it loads
    o3d = None
NO_OPEN3D = "large, so not in the group of the tests: `make test-all` installs it and has these run"
needs_open3d = pytest.mark.skipif(o3d is None, reason=NO_OPEN3D)


def cloud_of(seed=0, count=4000):
    """A wavy sheet with a ball on it, noisy; normals by their formulas."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-1, 1, (2, count // 2))
    sheet = np.stack([x, y, 0.1 * np.sin(4 * x) * np.cos(3 * y)], axis=1)
    slopes = [-0.4 * np.cos(4 * x) * np.cos(3 * y), 0.3 * np.sin(4 * x) * np.sin(3 * y), np.ones_like(x)]
    ball = rng.normal(size=(count - count // 2, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    points = np.concatenate([sheet, 0.4 * ball + [0, 0, 0.5]]) + rng.normal(0, 0.005, (count, 3))
    normals = np.concatenate([np.stack(slopes, axis=1), ball])
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


POINTS, NORMALS = cloud_of()
RADIUS = 0.15


def in_open3d(points, normals=None):
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(points, float)))
    if normals is not None:
        cloud.normals = o3d.utility.Vector3dVector(np.asarray(normals, float))
    return cloud


def open3d_fpfh(points, normals, radius, max_neighbors):
    search = o3d.geometry.KDTreeSearchParamHybrid(radius, max_neighbors)
    found = o3d.pipelines.registration.compute_fpfh_feature(in_open3d(points, normals), search)
    return np.asarray(found.data).T


# Thinning ------------------------------------------------------------------------------------------------


def naive_voxels(points, normals, voxel):
    """By voxel, in order: the mean of the points and the direction of the mean of the normals."""
    keys = np.floor((points - (points.min(axis=0) - voxel / 2)) / voxel).astype(int)
    voxels = {}
    for row, key in enumerate(map(tuple, keys)):
        voxels.setdefault(key, []).append(row)
    means = [normals[rows].mean(axis=0) for _, rows in sorted(voxels.items())]
    return (
        np.array([points[rows].mean(axis=0) for _, rows in sorted(voxels.items())]),
        np.array([mean / np.linalg.norm(mean) for mean in means]),
    )


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_voxels_hold_the_means_of_their_points(offset):
    points = POINTS + offset
    thin, normals = features.voxel_downsample(points, 0.1, normals=3 * NORMALS)
    expected, expected_normals = naive_voxels(points, NORMALS, 0.1)
    np.testing.assert_allclose(thin, expected, rtol=0, atol=1e-12 + 1e-15 * offset)
    np.testing.assert_allclose(normals, expected_normals, rtol=0, atol=1e-12)
    assert features.voxel_downsample(points, 0.1)[1] is None


def test_voxels_do_not_care_for_the_order_of_the_rows():
    order = np.random.default_rng(1).permutation(len(POINTS))
    plain = features.voxel_downsample(POINTS, 0.07, normals=NORMALS)
    shuffled = features.voxel_downsample(POINTS[order], 0.07, normals=NORMALS[order])
    for a, b in zip(plain, shuffled, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)


def test_the_normals_of_a_thin_wall_do_not_vanish():
    _, normals = features.voxel_downsample(np.zeros((2, 3)), 1, normals=[[0, 0, 2], [0, 0, -2]])
    np.testing.assert_array_equal(normals, [[0, 0, 1]])


@needs_open3d
@pytest.mark.parametrize("voxel", [0.03, 0.1, 3.0])
def test_voxels_are_those_of_open3d(voxel):
    theirs = np.asarray(in_open3d(POINTS).voxel_down_sample(voxel).points)
    ours, _ = features.voxel_downsample(POINTS, voxel)
    assert ours.shape == theirs.shape
    rows = [np.lexsort(np.round(cloud, 9).T) for cloud in (ours, theirs)]
    np.testing.assert_allclose(ours[rows[0]], theirs[rows[1]], rtol=0, atol=1e-12)


# Normals -------------------------------------------------------------------------------------------------


@needs_open3d
@pytest.mark.parametrize("max_neighbors", [8, 30, 1000])
def test_normals_are_those_of_open3d(max_neighbors):
    eye = np.array([0.3, -0.2, 4.0])
    cloud = in_open3d(POINTS)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(RADIUS, max_neighbors))
    cloud.orient_normals_towards_camera_location(eye)
    ours = features.estimate_normals(POINTS, RADIUS, max_neighbors, viewpoint=eye)
    np.testing.assert_allclose(ours, np.asarray(cloud.normals), rtol=0, atol=1e-6)


def test_normals_of_what_has_no_plane():
    lonely = [[0, 0, 0], [9, 0, 0], [9.1, 0, 0]]
    np.testing.assert_array_equal(features.estimate_normals(lonely, 1), [[0, 0, 1]] * 3)
    seen = features.estimate_normals(lonely, 1, viewpoint=[0, -2, 0])
    np.testing.assert_array_equal(seen[0], [0, -1, 0])
    # Points on a line, or all at one place.
    line = np.arange(5)[:, None] * [0.1, 0.2, 0.3]
    normals = features.estimate_normals(line, 9)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    np.testing.assert_allclose(normals @ [1, 2, 3], 0, atol=1e-6)
    np.testing.assert_array_equal(features.estimate_normals(np.ones((4, 3)), 9), [[0, 0, 1]] * 4)
    assert features.estimate_normals(np.empty((0, 3)), 1).shape == (0, 3)


# FPFH ----------------------------------------------------------------------------------------------------


def assert_equal_but_for_flips(ours, theirs, most):
    """Equal up to rounding but in a share of the rows, at `most`, where an angle changed its bin."""
    assert ours.shape == theirs.shape
    off = np.abs(ours - theirs).max(axis=1)
    flipped = off > 1e-3
    assert flipped.mean() <= most, f"{flipped.sum()} of {len(off)} rows differ"
    assert off.max() < 20, "more than an angle at the edge of a bin"


@needs_open3d
@pytest.mark.parametrize(("radius", "max_neighbors"), [(RADIUS, 100), (RADIUS, 20), (0.05, 50), (0.3, 300)])
def test_fpfh_is_that_of_open3d(radius, max_neighbors):
    theirs = open3d_fpfh(POINTS, NORMALS, radius, max_neighbors)
    ours = features.fpfh(POINTS, NORMALS, radius, max_neighbors)
    assert ours.dtype == np.float32
    assert_equal_but_for_flips(ours, theirs, 0.02)


def test_fpfh_is_what_open3d_once_gave():
    """So that a machine without Open3D compares, too."""
    record = json.loads((Path(__file__).parent / "golden/features/fpfh.json").read_text(encoding="utf-8"))
    ours = features.fpfh(record["points"], record["normals"], record["radius"], record["max_neighbors"])
    np.testing.assert_allclose(ours, record["fpfh"], rtol=0, atol=1e-3)


@needs_open3d
def test_fpfh_of_points_that_coincide_is_that_of_open3d():
    points, normals = np.repeat(POINTS[:300], 2, axis=0), np.repeat(NORMALS[:300], 2, axis=0)
    points[::2] += 7
    normals[1::4] *= -1
    points[:20] = points[0]
    assert_equal_but_for_flips(
        features.fpfh(points, normals, 0.4, 600), open3d_fpfh(points, normals, 0.4, 600), 0.02
    )


def test_fpfh_does_not_care_where_the_cloud_lies():
    plain = features.fpfh(POINTS, NORMALS, RADIUS)
    turn, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    # Far off, coordinates keep 1e-10 of a unit.
    for offset in (0, 1e6):
        moved = features.fpfh(POINTS @ turn.T + offset, NORMALS @ turn.T, RADIUS)
        assert_equal_but_for_flips(moved, plain, 0.02)
    assert_equal_but_for_flips(features.fpfh(1e3 * POINTS, 2 * NORMALS, 1e3 * RADIUS), plain, 0.02)
    order = np.random.default_rng(3).permutation(len(POINTS))
    np.testing.assert_allclose(
        features.fpfh(POINTS[order], NORMALS[order], RADIUS), plain[order], rtol=0, atol=1e-4
    )


def test_fpfh_of_key_points_is_that_of_their_rows():
    plain = features.fpfh(POINTS, NORMALS, RADIUS)
    rows = np.array([7, 3999, 7, 12, 0])
    np.testing.assert_array_equal(features.fpfh(POINTS, NORMALS, RADIUS, keypoints=rows), plain[rows])
    np.testing.assert_array_equal(
        features.fpfh(POINTS, NORMALS, RADIUS, keypoints=np.arange(len(POINTS))), plain
    )
    assert features.fpfh(POINTS, NORMALS, RADIUS, keypoints=[]).shape == (0, 33)


def test_fpfh_without_neighbours_is_zero():
    assert not features.fpfh([[0, 0, 0], [9, 9, 9]], [[0, 0, 1]] * 2, 1).any()
    assert not features.fpfh([[0, 0, 0]], [[0, 0, 1]], 1).any()
    assert features.fpfh(np.empty((0, 3)), np.empty((0, 3)), 1).shape == (0, 33)


# Matching ------------------------------------------------------------------------------------------------


def naive_match(src, tgt, k, mutual, ratio):
    src, tgt = (np.asarray(a, np.float32).astype(float) for a in (src, tgt))
    dist_sq = ((tgt[:, None] - src[None]) ** 2).sum(axis=2)
    order = np.argsort(dist_sq, axis=1, kind="stable")
    back = np.argsort(dist_sq, axis=0, kind="stable")[:k]
    corr, similarity = [], []
    for t in range(len(tgt)):
        left_out = np.sqrt(dist_sq[t, order[t, k]]) if k < len(src) else np.inf
        for s in order[t, :k]:
            d = np.sqrt(dist_sq[t, s])
            part = d / left_out if left_out > 0 else 1.0
            if (not mutual or t in back[:, s]) and (ratio is None or part <= ratio):
                corr.append([s, t])
                similarity.append(1 - part)
    return np.array(corr, np.int64).reshape(-1, 2), np.array(similarity)


@pytest.mark.parametrize(
    ("k", "mutual", "ratio"), [(1, False, None), (3, True, None), (2, False, 0.9), (1, True, 1)]
)
@pytest.mark.parametrize(
    ("n", "q", "d"), [(1, 3, 1), (16, 5, 3), (17, 40, 33), (400, 150, 33), (70, 30, 256)]
)
def test_matches_are_the_nearest(n, q, d, k, mutual, ratio):
    rng = np.random.default_rng(n + q + d)
    src, tgt = rng.normal(size=(n, d)), rng.normal(size=(q, d))
    src[n // 2 :] = np.round(src[n // 2 :])  # ties among them
    tgt[::3] = src[rng.integers(n, size=len(tgt[::3]))]
    corr, similarity = ibi.match(src, tgt, k=k, mutual=mutual, ratio=ratio)
    expected, expected_similarity = naive_match(src, tgt, k, mutual, ratio)
    np.testing.assert_array_equal(corr, expected)
    np.testing.assert_allclose(similarity, expected_similarity, rtol=0, atol=1e-12)


def test_matches_of_few_and_of_none():
    corr, similarity = ibi.match([[1.0], [2.0]], [[1.2]], k=5)
    assert corr.tolist() == [[0, 0], [1, 0]]
    assert similarity.tolist() == [1, 1]
    for src, tgt in ((np.empty((0, 4)), np.ones((3, 4))), (np.ones((3, 4)), np.empty((0, 4)))):
        corr, similarity = ibi.match(src, tgt, mutual=True)
        assert corr.shape == (0, 2)
        assert similarity.shape == (0,)
    # Nothing tells two equal rows apart.
    assert ibi.match([[1.0], [1.0]], [[1.0]])[1].tolist() == [0]


# Planes --------------------------------------------------------------------------------------------------


def table_scene(seed=0, offset=(0.0, 0.0, 0.0)):
    """A tilted table with a ball on it; which points are of the table, its normal and a place on it."""
    rng = np.random.default_rng(seed)
    normal = np.array([0.1, -0.2, 0.97]) / np.linalg.norm([0.1, -0.2, 0.97])
    across = np.linalg.svd(normal[None])[2][1:]
    table = rng.uniform(-1, 1, (3000, 2)) @ across + rng.normal(0, 0.002, (3000, 1)) * normal
    ball = rng.normal(size=(2000, 3))
    ball = 0.2 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + 0.21 * normal
    return np.concatenate([table, ball]) + offset, np.arange(5000) < 3000, normal, np.array(offset)


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (1e4, -1e5, 30.0)])
def test_the_table_is_found_and_taken_away(offset):
    points, of_table, normal, place = table_scene(0, offset)
    plane = features.dominant_plane(points, 0.01)
    assert plane.normal @ normal > np.cos(np.radians(0.1)), "to the side of the ball"
    assert abs(plane.offset - plane.normal @ place) < 1e-3
    assert (plane.inliers[of_table]).mean() > 0.999
    assert plane.inliers[~of_table].mean() < 0.05
    distance = np.abs(points @ plane.normal - plane.offset)
    np.testing.assert_array_equal(plane.inliers, distance <= 0.01)
    assert plane.behind == 0
    below = features.dominant_plane(points, 0.01, viewpoint=place - 5 * normal)
    np.testing.assert_array_equal(below.normal, -plane.normal)
    assert below.behind == pytest.approx((~plane.inliers).mean())
    assert below.offset == pytest.approx(-plane.offset)


def test_a_plane_needs_its_share():
    points, *_ = table_scene()
    assert features.dominant_plane(points, 0.01, min_share=0.59) is not None
    assert features.dominant_plane(points, 0.01, min_share=0.65) is None
    assert features.dominant_plane(points[:2], 0.01) is None
    assert features.dominant_plane(np.ones((50, 3)), 0.01) is None
    assert features.dominant_plane(np.arange(30.0)[:, None] * [1, 1, 0], 0.01) is None  # a line
    ball = points[3000:]
    assert features.dominant_plane(ball, 0.001) is None


# Meshes --------------------------------------------------------------------------------------------------


def box(size, inwards=False):
    """A box about the origin, twelve faces wound outwards."""
    corners = (np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) - 0.5) * size
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))])
    return corners, faces[:, ::-1] if inwards else faces


def gaps(points):
    distances = np.linalg.norm(points[:, None] - points, axis=2)
    np.fill_diagonal(distances, np.inf)
    return distances.min(axis=1)


def test_samples_lie_on_the_mesh_and_are_spread():
    size = np.array([4.0, 2.0, 1.0])
    points, normals = features.sample_mesh(*box(size), n=700, seed=3)
    assert points.shape == normals.shape == (700, 3)
    # On the side that the normal names, and within the others.
    side = np.abs(normals).argmax(axis=1)
    rows = np.arange(len(points))
    np.testing.assert_allclose(points[rows, side], 0.5 * size[side] * normals[rows, side], atol=1e-12)
    assert (np.abs(points) <= 0.5 * size + 1e-12).all()
    areas = np.array([2.0, 4.0, 8.0])
    np.testing.assert_allclose(np.bincount(side) / 700, areas / areas.sum(), atol=0.03)
    # As far apart as the nodes of a lattice would be: 0.215. Drawn without a look at others, 0.003.
    assert gaps(points).min() > 0.55 * np.sqrt(28 / 700 / np.sqrt(0.75))


def test_samples_keep_their_distance_and_leave_no_hole():
    vertices, faces = box(np.array([2.0, 2.0, 2.0]))
    points, _ = features.sample_mesh(vertices, faces, spacing=0.15)
    assert gaps(points).min() >= 0.15
    probes, _ = features.sample_mesh(vertices, faces, n=2000, seed=9)
    assert np.linalg.norm(probes[:, None] - points, axis=2).min(axis=1).max() < 0.25


def test_both_sides_of_a_thin_wall_are_sampled():
    vertices, faces = box(np.array([2.0, 2.0, 0.01]))
    _, normals = features.sample_mesh(vertices, faces, spacing=0.1)
    up, down = (normals[:, 2] > 0.5).sum(), (normals[:, 2] < -0.5).sum()
    assert min(up, down) > 0.6 * 4 / 0.1**2


def test_samples_are_determined_by_their_seed():
    mesh = box(np.ones(3))
    same, other = (features.sample_mesh(*mesh, n=90, seed=seed)[0].tobytes() for seed in (1, 2))
    assert same == features.sample_mesh(*mesh, n=90, seed=1)[0].tobytes() != other


def test_the_inner_walls_of_a_hollow_part_go():
    outer, inner = box(np.full(3, 2.0)), box(np.full(3, 1.6), inwards=True)
    vertices = np.concatenate([outer[0], inner[0]])
    faces = np.concatenate([outer[1], inner[1] + 8])
    points, normals = features.sample_mesh(vertices, faces, n=2000)
    is_outer = np.abs(points).max(axis=1) > 0.99
    assert 500 < is_outer.sum() < 1500
    np.testing.assert_array_equal(features.outer_surface(points, normals, vertices, faces), is_outer)
    # Without its lid one sees the floor.
    is_lid = (vertices[faces][:, :, 2] > 0).all(axis=1)
    seen = features.outer_surface(points, normals, vertices, faces[~is_lid], num_views=200)
    floor = np.abs(points[:, 2] + 0.8) < 1e-9
    assert floor.sum() > 100
    assert seen[floor].mean() > 0.9
    assert features.outer_surface(np.empty((0, 3)), np.empty((0, 3)), vertices, faces).shape == (0,)


def naive_outer(points, normals, vertices, faces, views):
    """A ray from every point against every face (Moller & Trumbore 1997)."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    seen = np.zeros(len(points), bool)
    for eye in views:
        across = np.cross(eye, c - a)
        det = np.einsum("fi,fi->f", b - a, across)
        for i in np.flatnonzero(~seen & (normals @ eye >= np.cos(1.309))):
            with np.errstate(divide="ignore", invalid="ignore"):
                from_a = points[i] + 1e-3 * normals[i] - a
                u = np.einsum("fi,fi->f", from_a, across) / det
                q = np.cross(from_a, b - a)
                v = q @ eye / det
                t = np.einsum("fi,fi->f", q, c - a) / det
                hit = (det != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9)
            seen[i] = not hit.any()
    return seen


def test_what_is_seen_is_what_rays_reach():
    rng = np.random.default_rng(4)
    boxes = [box(rng.uniform(0.3, 1.5, 3)) for _ in range(5)]
    vertices = np.concatenate([corners + rng.uniform(-0.6, 0.6, 3) for corners, _ in boxes])
    faces = np.concatenate([faces + 8 * i for i, (_, faces) in enumerate(boxes)])
    points, normals = features.sample_mesh(vertices, faces, n=400)
    golden = np.pi * (3 - np.sqrt(5)) * np.arange(40)
    z = 1 - (2 * np.arange(40) + 1) / 40
    r = np.sqrt(1 - z**2)
    views = np.stack([r * np.cos(golden), r * np.sin(golden), z], axis=1)
    expected = naive_outer(points, normals, vertices, faces, views)
    found = features.outer_surface(points, normals, vertices, faces, num_views=40, lift=1e-3)
    assert 0.2 < expected.mean() < 0.9
    np.testing.assert_array_equal(found, expected)


# All -----------------------------------------------------------------------------------------------------


def everything(num_threads):
    options = {"num_threads": num_threads}
    normals = features.estimate_normals(POINTS, RADIUS, viewpoint=[0, 0, 9], **options)
    described = features.fpfh(POINTS, normals, RADIUS, **options)
    corr, similarity = ibi.match(described[::5], described, k=2, mutual=True, **options)
    mesh = box(np.ones(3))
    is_outer = features.outer_surface(*features.sample_mesh(*mesh, n=600), *mesh, **options)
    plane = features.dominant_plane(POINTS, 0.05, min_share=0.1, **options)
    found = (normals, described, corr, similarity, is_outer, plane.normal, plane.inliers)
    return [array.tobytes() for array in found]


def test_any_number_of_threads_gives_the_same_bits():
    assert everything(1) == everything(2) == everything(3)


def put(array, place, value):
    array = np.array(array)
    array[place] = value
    return array


A, T = ibi.InputError, TypeError
NAN = float("nan")
BOX = box(np.ones(3))
GOOD = {
    "voxel_downsample": {"points": POINTS, "voxel": 0.1, "normals": NORMALS},
    "estimate_normals": {"points": POINTS, "radius": RADIUS},
    "fpfh": {"points": POINTS, "normals": NORMALS, "radius": RADIUS},
    "dominant_plane": {"points": POINTS, "distance": 0.1},
    "sample_mesh": {"vertices": BOX[0], "faces": BOX[1], "spacing": 0.1},
    "outer_surface": {"points": POINTS, "normals": NORMALS, "vertices": BOX[0], "faces": BOX[1]},
    "match": {"src_feat": np.eye(4), "tgt_feat": np.eye(4)},
}
SIZE = r" is .*; it must be above 0 and finite"
POSITIVE = [
    (name, value) for name in ("voxel", "radius", "distance", "spacing") for value in (0, -1.0, NAN, np.inf)
]

# The function, what is given, the exception and a pattern that its message must begin with.
REFUSED = [
    *(
        (function, {"points": points}, error, message)
        for function in ("voxel_downsample", "estimate_normals", "fpfh", "dominant_plane", "outer_surface")
        for points, error, message in [
            (
                put(POINTS, (5, 1), NAN),
                A,
                r"points\[5\] is \[.*NaN.*; coordinates must be finite",
            ),
            (
                put(POINTS, (6, 0), -1e101),
                A,
                r"points\[6\] is \[-1.*; coordinates must be finite",
            ),
            (POINTS[:, :2], A, r"points has shape \(4000, 2\); it must be \(N, 3\)"),
            (POINTS.astype(str), T, "points has dtype <U"),
        ]
    ),
    *(
        (function, {name: value}, A, name + SIZE)
        for function, good in GOOD.items()
        for name, value in POSITIVE
        if name in good
    ),
    (
        "voxel_downsample",
        {"voxel": 1e-9},
        A,
        r"voxel is 1e-9 and the points are .* across; at most",
    ),
    ("voxel_downsample", {"voxel": [1, 2]}, T, r"voxel has shape \(2,\); it must be a number"),
    ("voxel_downsample", {"normals": put(NORMALS, 3, 0)}, A, r"normals\[3\] has length 0"),
    (
        "voxel_downsample",
        {"normals": NORMALS[1:]},
        A,
        "normals has 3999 rows; it must have one for each",
    ),
    ("estimate_normals", {"max_neighbors": 2}, A, "max_neighbors is 2; it must be at least 3"),
    ("estimate_normals", {"max_neighbors": 9.5}, T, "max_neighbors must be an integer, not float"),
    (
        "estimate_normals",
        {"viewpoint": [0, 0]},
        A,
        r"viewpoint has shape \(2,\); it must be \(3,\)",
    ),
    (
        "estimate_normals",
        {"viewpoint": [0, NAN, 0]},
        A,
        r"viewpoint\[0\] is \[0, NaN, 0\]; coord",
    ),
    ("estimate_normals", {"num_threads": 0}, ValueError, "num_threads is 0; it must be an integer from 1"),
    ("fpfh", {"normals": put(NORMALS, (9, 2), NAN)}, A, r"normals\[9\] is \[.*NaN\]"),
    ("fpfh", {"normals": put(NORMALS, 2, 0)}, A, r"normals\[2\] has length 0"),
    (
        "fpfh",
        {"normals": NORMALS[:9]},
        A,
        "normals has 9 rows; it must have one for each of the 4000",
    ),
    ("fpfh", {"max_neighbors": 1}, A, "max_neighbors is 1; it must be at least 2"),
    ("fpfh", {"keypoints": [0, 4000]}, A, r"keypoints\[1\] is 4000; points has rows 0 to 3999"),
    ("fpfh", {"keypoints": [-1]}, A, r"keypoints\[0\] is -1; points has rows 0 to 3999"),
    ("fpfh", {"keypoints": [[1]]}, A, r"keypoints has shape \(1, 1\); it must be \(K,\)"),
    ("fpfh", {"keypoints": [1.0]}, T, "keypoints has dtype float64; rows must be integers"),
    ("dominant_plane", {"min_share": 0}, A, "min_share is 0; it must be above 0 and at most 1"),
    ("dominant_plane", {"min_share": NAN}, A, "min_share is NaN; it must be above 0 and at most 1"),
    ("dominant_plane", {"viewpoint": [NAN, 0, 0]}, A, r"viewpoint\[0\] is \[NaN, 0, 0\]; coord"),
    ("dominant_plane", {"seed": -1}, A, r"seed is -1; it must be from 0 to 2\^64 - 1"),
    ("dominant_plane", {"seed": 1.5}, T, "seed must be an integer, not float"),
    ("sample_mesh", {"vertices": put(BOX[0], (2, 0), NAN)}, A, r"vertices\[2\] is \[NaN, "),
    ("sample_mesh", {"faces": put(BOX[1], (3, 1), 8)}, A, r"faces\[3, 1\] is 8; vertices has rows 0 to 7"),
    ("sample_mesh", {"faces": put(BOX[1], (3, 2), -1)}, A, r"faces\[3, 2\] is -1; vertices has rows 0 to 7"),
    ("sample_mesh", {"faces": BOX[1][:, :2]}, A, r"faces has shape \(12, 2\); it must be \(F, 3\)"),
    ("sample_mesh", {"faces": BOX[1] * 1.0}, T, "faces has dtype float64; rows must be integers"),
    ("sample_mesh", {"faces": []}, A, "the faces of the mesh have no area"),
    ("sample_mesh", {"vertices": np.ones((8, 3))}, A, "the faces of the mesh have no area"),
    ("sample_mesh", {"spacing": 1e-9}, A, "about 200000000 points are asked for; at most 100000000"),
    ("sample_mesh", {"spacing": None, "n": 0}, A, "n is 0; it must be at least 1"),
    ("sample_mesh", {"n": 5}, T, "give either n or spacing"),
    ("sample_mesh", {"spacing": None}, T, "give either n or spacing"),
    ("outer_surface", {"faces": [[0, 1, 9]]}, A, r"faces\[0, 2\] is 9; vertices has rows 0 to 7"),
    ("outer_surface", {"normals": NORMALS[:9]}, A, "normals has 9 rows; it must have one for each"),
    ("outer_surface", {"num_views": 0}, A, "num_views is 0; it must be at least 1"),
    ("outer_surface", {"max_angle_rad": 2}, A, "max_angle_rad is 2; it must be above 0 and below pi/2"),
    ("outer_surface", {"lift": -1}, A, "lift is -1; it must be at least 0 and finite"),
    ("match", {"src_feat": np.ones((2, 3))}, A, "src_feat has 3 columns and tgt_feat has 4"),
    ("match", {"tgt_feat": np.ones(4)}, A, r"tgt_feat has shape \(4,\); it must be \(N, D\)"),
    (
        "match",
        {"src_feat": put(np.eye(4), (2, 1), NAN)},
        A,
        r"src_feat\[2, 1\] is NaN; descriptors",
    ),
    (
        "match",
        {"tgt_feat": put(np.eye(4), (1, 0), 1e99)},
        A,
        r"tgt_feat\[1, 0\] is inf; descriptors",
    ),
    ("match", {"k": 0}, A, "k is 0; it must be at least 1"),
    ("match", {"ratio": 0.0}, A, "ratio is 0; it must be above 0 and at most 1"),
    ("match", {"ratio": NAN}, A, "ratio is NaN; it must be above 0 and at most 1"),
    ("match", {"mutual": 1}, T, "mutual must be a bool, not int"),
]


@pytest.mark.parametrize(("function", "given", "error", "message"), REFUSED)
def test_bad_input_is_refused_by_name(function, given, error, message):
    call = ibi.match if function == "match" else getattr(features, function)
    with pytest.raises(error, match="^" + message) as caught:
        call(**{**GOOD[function], **given})
    assert "\n" not in str(caught.value)
