"""`synth.pile_scene`: what the camera sees is what was piled; and how benchmarks/piles.py scores it."""

import sys
from pathlib import Path

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import features, metrics, synth
from ibi_rs.synth.scene import move

try:
    import open3d as o3d
except ImportError:
    o3d = None

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

import piles  # noqa: E402
from frame import records  # noqa: E402

MESH = ibi.io.read_mesh(ROOT / "examples/models/cat.ply")
SIZE = np.linalg.norm(np.ptp(MESH[0], axis=0))
NO_OPEN3D = "large, so not in the group of the tests: `make test-all` installs it and has these run"
needs_open3d = pytest.mark.skipif(o3d is None, reason=NO_OPEN3D)


@pytest.fixture(scope="module")
def pile():
    return synth.pile_scene(*MESH, seed=4)


def surface(vertices, pose):
    """Open3D's scene of one instance."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(move(pose, vertices).astype(np.float32)), o3d.core.Tensor(MESH[1].astype(np.uint32))
    )
    return scene


def height(pile, points):
    return points @ pile.table[:3] + pile.table[3]


@needs_open3d
def test_the_seed_makes_the_pile(pile):
    again, other = (synth.pile_scene(*MESH, seed=seed) for seed in (4, 5))
    for name in ("points", "labels", "depth", "poses", "visibility", "table"):
        np.testing.assert_array_equal(getattr(again, name), getattr(pile, name))
    assert not np.array_equal(other.poses, pile.poses)
    assert repr(pile).startswith("Pile(10 instances, visible ")


@needs_open3d
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_the_points_lie_on_what_their_labels_say(noise):
    pile = synth.pile_scene(*MESH, seed=4, noise=noise)
    far = 1e-5 * SIZE + 5 * noise * pile.voxel  # float32 of the rays, and noise that is seldom more
    assert set(pile.labels) == {-1, *np.flatnonzero(pile.visibility)}
    for k in np.unique(pile.labels[pile.labels >= 0]):
        points = pile.points[pile.labels == k].astype(np.float32)
        assert surface(MESH[0], pile.poses[k]).compute_distance(points).numpy().max() < far
    assert np.abs(height(pile, pile.points[pile.labels < 0])).max() < far


@needs_open3d
def test_noise_is_along_the_ray(pile):
    clean = synth.pile_scene(*MESH, seed=4, noise=0)
    way = np.linalg.norm(pile.points, axis=1) - np.linalg.norm(clean.points, axis=1)
    assert way.std() == pytest.approx(0.3 * pile.voxel, rel=0.03)
    directions = [
        points / np.linalg.norm(points, axis=1, keepdims=True) for points in (pile.points, clean.points)
    ]
    np.testing.assert_allclose(*directions, atol=1e-9)


@needs_open3d
def test_the_depth_image_is_the_points(pile):
    rows, columns = np.nonzero(np.isfinite(pile.depth))
    z = pile.depth[rows, columns]
    points = np.stack([(columns - pile.cx) / pile.fx * z, (rows - pile.cy) / pile.fy * z, z], axis=1)
    np.testing.assert_allclose(points, pile.points, atol=1e-9 * SIZE)
    footprint = np.median(pile.points[pile.labels >= 0, 2]) / pile.fx / pile.voxel
    assert 0.4 < footprint < 0.5
    # The camera stands above the table, and the far end of the table is at the top of the image.
    assert pile.table[3] > 0
    assert np.nanmean(pile.depth[0]) > np.nanmean(pile.depth[-1])


@needs_open3d
def test_what_stands_alone_is_seen_wholly():
    assert synth.pile_scene(*MESH, seed=4, num_instances=1).visibility == [1.0]


@needs_open3d
def test_some_are_hidden_by_others():
    shares = np.concatenate([synth.pile_scene(*MESH, seed=s, layers=4).visibility for s in range(4)])
    assert (shares < piles.VISIBLE).any()
    assert ((shares > piles.VISIBLE) & (shares < 0.9)).any()


@needs_open3d
def test_instances_touch_and_do_not_run_into_one_another(pile):
    points, _ = features.sample_mesh(*MESH, n=3000)
    samples = [move(pose, points) for pose in pile.poses]
    assert height(pile, np.concatenate(samples)).min() > -0.002 * SIZE
    for k, own in enumerate(samples):
        scene = surface(MESH[0], pile.poses[k])
        gap = height(pile, own).min()
        for other in (*samples[:k], *samples[k + 1 :]):
            signed = scene.compute_signed_distance(other.astype(np.float32)).numpy()
            assert signed.min() > -0.005 * SIZE
            gap = min(gap, signed.min())
        assert gap < 0.03 * SIZE


@needs_open3d
def test_a_pile_scales_with_its_mesh(pile):
    large = synth.pile_scene(1000 * MESH[0], MESH[1], seed=4)
    np.testing.assert_allclose(large.poses[:, :3, 3], 1000 * pile.poses[:, :3, 3], rtol=1e-6)
    assert large.voxel == pytest.approx(1000 * pile.voxel)


@needs_open3d
def test_an_open_mesh_will_do():
    sheet = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [9, 9, 9]])  # the last is of no face
    pile = synth.pile_scene(sheet, [[0, 1, 2], [0, 2, 3]], seed=0, num_instances=4)
    assert pile.voxel == pytest.approx(np.sqrt(2) / 24)
    assert pile.visibility.max() == 1


@needs_open3d
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_instances": 0}, "num_instances must be at least 1"),
        ({"layers": 0}, "layers"),
        ({"pixel": 0}, "pixel"),
        ({"noise": -0.1}, "noise"),
        ({"noise": np.nan}, "noise"),
        ({"tilt_deg": (40, 20)}, "tilt_deg must be a range"),
        ({"tilt_deg": (0, 80)}, "tilt_deg must be a range"),
        ({"distance": 0.8}, "reaches up to the camera"),
        ({"vertices": np.full((3, 3), np.nan)}, "vertices must be"),
        ({"vertices": np.zeros((3, 2))}, "vertices must be"),
        ({"vertices": np.ones((3, 3)), "faces": [[0, 1, 2]]}, "no extent"),
        ({"faces": np.empty((0, 3), dtype=int)}, "faces must be"),
        ({"faces": [[0.0, 1.0, 2.0]]}, "faces must be"),
        ({"faces": [[0, 1, 10**6]]}, "faces must be rows"),
        ({"faces": [[-1, 0, 1]]}, "faces must be rows"),
    ],
)
def test_bad_input_is_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        synth.pile_scene(**{"vertices": MESH[0], "faces": MESH[1], "seed": 0, **change})


def test_without_open3d_the_message_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(ImportError, match=r"Piles need Open3D: pip install 'ibi_rs\[open3d\]'"):
        synth.pile_scene(*MESH, seed=0)


# The benchmark --------------------------------------------------------------------------------------------


def test_a_pose_of_a_hidden_instance_is_neither_right_nor_wrong():
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = 0, 2 * SIZE, 4 * SIZE
    wrong = np.eye(4)
    wrong[0, 3] = 9 * SIZE
    visibility = np.array([1.0, 0.29, 0.5])
    model = MESH[0]

    score, ignored = piles.score_visible(poses, poses, visibility, model)
    assert (score.num_truth, score.num_truth_hit, score.precision, ignored) == (2, 2, 1.0, 1)
    # A second pose of the hidden one is a duplicate, and excused no more.
    score, ignored = piles.score_visible(poses[[0, 1, 1]], poses, visibility, model)
    assert (score.num_truth_hit, score.num_predicted, ignored) == (1, 2, 1)
    score, ignored = piles.score_visible([wrong], poses, visibility, model)
    assert (score.num_predicted, score.precision, ignored) == (1, 0.0, 0)
    score, ignored = piles.score_visible([], poses, visibility, model)
    assert (score.recall, score.num_predicted, ignored) == (0.0, 0, 0)


def recorded():
    return records.read(records.RECORDS / piles.RECORD)


def test_the_page_has_the_figures_of_the_record():
    page, rows = (ROOT / "docs/features.md").read_text(encoding="utf-8"), recorded()
    for table in (piles.shape_table(rows), piles.peer_table(rows)):
        assert table in page, "run benchmarks/piles.py --docs"


def test_a_missing_peer_is_a_row_that_says_so():
    rows = [row for row in recorded() if row["name"] in ("koala", "two") and row["method"] == piles.OURS]
    cases = [piles.Case(row["data"], row["name"], None, MESH, *3 * [np.empty(0)]) for row in rows[-1:]]
    rows += [piles.row(cases[0], name, missing="no driver") for name in piles.PEERS]
    assert "| PCL GC + check | missing: no driver |" in piles.peer_table(rows)


def test_no_shape_without_symmetry_is_left_out_of_the_record():
    names = {row["name"] for row in recorded() if row["data"] == "pile"}
    assert names >= set(piles.shapes(piles.MODELS))
    assert len(names) >= 8


@needs_open3d
def test_detection_of_a_pile_has_no_wrong_poses(pile):
    model = ibi.Model.from_mesh(*MESH)
    found = model.detect(pile.points, viewpoint=[0, 0, 0])
    score, _ = piles.score_visible(found, pile.poses, pile.visibility, model.points)
    assert score.num_truth_hit >= 1
    assert score.precision >= 0.8
    assert isinstance(score, metrics.SceneScore)
