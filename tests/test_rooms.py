"""`synth.room_scene`: what stands in the room, what the walk saw of it, and how that is fused."""

import sys

import numpy as np
import pytest
from ibi_rs import features, synth
from ibi_rs.synth import rooms, solids
from ibi_rs.synth.scene import move
from scipy.spatial import cKDTree

try:
    import open3d as o3d
except ImportError:
    o3d = None

NO_OPEN3D = "large, so not in the group of the tests: `make test-all` installs it and has these run"
needs_open3d = pytest.mark.skipif(o3d is None, reason=NO_OPEN3D)

CHAIR = synth.furniture_mesh("chair-a")
OTHERS = [synth.furniture_mesh(name) for name in ("table-a", "sofa-a", "cabinet-a")]
EXACT = {"noise": 0, "quantum": 0, "smear": 0, "dropout": 0, "drift": 0}


@pytest.fixture(scope="module")
def room():
    return synth.room_scene(CHAIR, OTHERS, seed=2, num_instances=4)


@pytest.fixture(scope="module")
def exact():
    return synth.room_scene(CHAIR, OTHERS, seed=2, num_instances=4, **EXACT)


@needs_open3d
def test_the_seed_makes_the_room(room):
    again, other = (synth.room_scene(CHAIR, OTHERS, seed=seed, num_instances=4) for seed in (2, 3))
    for name in ("points", "normals", "labels", "eyes", "poses", "visibility"):
        np.testing.assert_array_equal(getattr(again, name), getattr(room, name))
    assert not np.array_equal(other.poses, room.poses)
    assert repr(room).startswith("Room(4 copies, seen ")


@needs_open3d
def test_copies_stand_on_the_floor_and_clear_of_one_another(room):
    low, high = CHAIR[0].min(axis=0), CHAIR[0].max(axis=0)
    points, _ = features.sample_mesh(*CHAIR, n=3000)
    for k, pose in enumerate(room.poses):
        np.testing.assert_allclose(pose[2], [0, 0, 1, 0], atol=1e-12)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        for other in np.delete(room.poses, k, axis=0):
            inner = move(np.linalg.inv(pose), move(other, points))
            assert not ((inner > low) & (inner < high)).all(axis=1).any()


def test_rectangles_overlap_if_no_axis_of_theirs_parts_them():
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    turn = np.array([[1, -1], [1, 1]]) / np.sqrt(2)
    assert rooms._overlap(square, square + 0.9, 0.0)
    assert not rooms._overlap(square, square + np.array([1.1, 0]), 0.05)
    assert rooms._overlap(square, square + np.array([1.1, 0]), 0.2)
    # Corner to corner: their boxes overlap, they do not.
    assert not rooms._overlap(square, (square - 0.5) @ turn.T + [1.6, 1.6], 0.0)
    assert rooms._overlap(square, (square - 0.5) @ turn.T + [1.2, 1.2], 0.0)


@needs_open3d
def test_labelled_points_lie_on_their_copies_and_the_rest_does_not(exact):
    for k, pose in enumerate(exact.poses):
        surface = o3d.t.geometry.RaycastingScene()
        surface.add_triangles(
            o3d.core.Tensor(move(pose, CHAIR[0]).astype(np.float32)),
            o3d.core.Tensor(CHAIR[1].astype(np.uint32)),
        )
        apart = surface.compute_distance(exact.points.astype(np.float32)).numpy()
        # A point is the mean of a voxel, which may hold two sides of an edge.
        assert apart[exact.labels == k].max() < exact.voxel
        assert (apart[(exact.labels < 0) & (exact.points[:, 2] > 0.05)] > 0.2 * exact.voxel).mean() > 0.99


@needs_open3d
def test_noise_and_drift_move_the_points_by_as_much_as_they_say(room, exact):
    """The floor is 1 to 4 m from the eyes, so that noise of 4 mm at 2 m is 1 to 16 mm there."""

    def off(of):
        near_floor = of.points[(np.abs(of.points[:, 2]) < 0.05) & (of.labels < 0)]
        return np.median(np.abs(near_floor[:, 2]))

    assert 0.001 < off(room) < 0.016
    assert off(exact) < 1e-5


@needs_open3d
def test_a_voxel_has_one_point_and_normals_face_the_eyes(room):
    cells = np.floor((room.points - room.points.min(axis=0)) / room.voxel)
    # The lattice begins at the least measurement and not at the least point.
    assert len(np.unique(cells, axis=0)) > 0.6 * len(cells)
    np.testing.assert_allclose(np.linalg.norm(room.normals, axis=1), 1, atol=1e-9)
    floor = (np.abs(room.points[:, 2]) < 0.01) & (room.labels < 0)
    assert (room.normals[floor, 2] > 0.9).mean() > 0.9
    some = np.arange(0, len(room.points), 50)
    way = room.eyes[None] - room.points[some, None]
    assert (np.einsum("nej,nj->ne", way, room.normals[some]) > 0).any(axis=1).mean() > 0.99


@needs_open3d
def test_fused_points_are_naive_means():
    rng = np.random.default_rng(1)
    hits, owner = rng.uniform(0, 0.2, (600, 3)), rng.integers(-1, 2, 600)
    eyes = np.tile([0.1, 0.1, 5.0], (600, 1))
    points, normals, labels = rooms._fused(hits, owner, eyes, 0.05)
    by_cell = {}
    for hit, label in zip(hits, owner, strict=True):
        by_cell.setdefault(tuple(((hit - hits.min(axis=0)) // 0.05).astype(int)), []).append((hit, label))
    assert len(points) == len(by_cell)
    tree = cKDTree(points)
    for held in by_cell.values():
        mean = np.mean([hit for hit, _ in held], axis=0)
        apart, row = tree.query(mean)
        assert apart < 1e-12
        counts = np.bincount([label + 1 for _, label in held], minlength=3)
        assert counts[labels[row] + 1] == counts.max()
    assert (np.sum(normals * (eyes[0] - points), axis=1) >= 0).all()


@needs_open3d
def test_the_outer_surface_of_a_box_on_the_floor_is_all_but_its_bottom():
    outer = rooms._outer(solids.box([0, 0, 0], [1, 0.6, 0.4]))
    # A ray that ends within a ten-thousandth of its length from a rim has met nothing before.
    assert np.mean(outer[:, 2] == 0) < 0.002
    on_side = [
        np.mean(np.abs(outer[:, axis] - at) < 1e-9)
        for axis, at in ((0, 0), (0, 1), (1, 0), (1, 0.6), (2, 0.4))
    ]
    area = np.array([0.24, 0.24, 0.4, 0.4, 0.6])
    np.testing.assert_allclose(on_side, area / area.sum(), atol=0.03)


@needs_open3d
def test_the_share_that_is_seen_is_a_naive_count():
    box = solids.box([0, 0, 0], [1, 0.6, 0.4])
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, 3] = [5, 0, 0]
    outer = rooms._outer(box)
    rng = np.random.default_rng(0)
    hits = np.concatenate([outer[rng.permutation(len(outer))[:150]], outer[:40] + np.array([5, 0, 0])])
    owner = np.repeat([0, 1], [150, 40])
    shares = rooms._seen(box, poses, hits, owner, 0.05)
    for k in range(2):
        apart = np.linalg.norm(move(poses[k], outer)[:, None] - hits[owner == k][None], axis=2).min(axis=1)
        assert shares[k] == np.mean(apart <= 0.05)
    assert 0 < shares[1] < shares[0] < 1


@needs_open3d
def test_the_share_tells_where_the_points_are(room):
    """From the fused points, which are a little fewer than the measurements."""
    outer = rooms._outer(CHAIR)
    for k, pose in enumerate(room.poses):
        own = room.points[room.labels == k]
        apart = cKDTree(own).query(move(pose, outer))[0] if len(own) else np.full(len(outer), np.inf)
        assert np.mean(apart <= room.voxel) <= room.visibility[k] + 0.02
        assert np.mean(apart <= 2 * room.voxel) >= room.visibility[k] - 0.05


@needs_open3d
def test_a_room_that_is_little_covered_is_seen_less_and_from_fewer_places():
    little, well = (
        [synth.room_scene(CHAIR, OTHERS, seed=seed, coverage=name) for seed in range(4)]
        for name in ("little", "well")
    )
    assert all(20 <= len(room.eyes) <= 26 for room in little)
    assert all(50 <= len(room.eyes) <= 60 for room in well)
    shares = [np.concatenate([room.visibility for room in of]).mean() for of in (little, well)]
    assert shares[0] < 0.6
    assert shares[1] > shares[0] + 0.15
    assert all(2 <= len(room.poses) <= 5 for room in little)


@needs_open3d
def test_eyes_keep_clear_of_what_reaches_up_to_them():
    shelf = synth.furniture_mesh("shelf-a")
    for seed in range(4):
        room = synth.room_scene(shelf, seed=seed, num_instances=6)
        for pose in room.poses:
            inner = move(np.linalg.inv(pose), room.eyes)
            inside = (inner > shelf[0].min(axis=0)) & (inner < shelf[0].max(axis=0))
            assert not inside.all(axis=1).any()


@needs_open3d
def test_a_room_may_be_empty():
    room = synth.room_scene(CHAIR, seed=0, num_instances=0)
    assert room.poses.shape == (0, 4, 4)
    assert room.visibility.shape == (0,)
    assert (room.labels == -1).all()


@needs_open3d
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"coverage": "some"}, "coverage must be one of little, well"),
        ({"voxel": 0}, "voxel must be above 0"),
        ({"noise": -1}, "noise, quantum and drift"),
        ({"quantum": -1}, "noise, quantum and drift"),
        ({"drift": -1}, "noise, quantum and drift"),
        ({"smear": 2}, "smear and dropout"),
        ({"dropout": 2}, "smear and dropout"),
        ({"num_instances": (5, 2)}, "num_instances"),
        ({"num_distractors": -1}, "num_distractors"),
        ({"mesh": (np.ones((3, 3)), [[0, 1, 2]])}, "no extent"),
        ({"distractors": [(np.eye(3), [[0, 1, 5]])]}, "faces must be rows"),
    ],
)
def test_bad_rooms_are_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        synth.room_scene(**{"mesh": CHAIR, "seed": 0, **change})


def test_without_open3d_the_message_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(ImportError, match=r"Rooms need Open3D: pip install 'ibi_rs\[open3d\]'"):
        synth.room_scene(CHAIR, seed=0)
