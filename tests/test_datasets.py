"""`ibi_rs.datasets`: the formats of others, on tiny sets that are made here."""

import json
import pickle

import ibi_rs as ibi
import numpy as np
import pytest
import tiny_sets
from ibi_rs import datasets
from ibi_rs.synth.scene import move
from scipy.spatial import cKDTree
from tiny_sets import BOX, PLACES


@pytest.fixture(scope="module")
def bop(tmp_path_factory):
    return tiny_sets.bop(tmp_path_factory.mktemp("bop"))


def is_on(points, kinds, poses, limit=1.5):
    """Whether all points lie on the surfaces of the parts, millimetres."""
    surface = np.concatenate(
        [move(pose, tiny_sets.sampled(kind.mesh)) for kind, pose in zip(kinds, poses, strict=True)]
    )
    return cKDTree(surface).query(points)[0].max() < limit


# BOP -----------------------------------------------------------------------------------------------------


def test_a_bop_set_has_its_images_with_their_truth(bop):
    scenes = datasets.Bop(bop)
    assert repr(scenes).endswith(", test: 3 images, 2 objects)")
    assert [scene.ids for scene in scenes] == list(PLACES)
    first = scenes[0]
    assert [(part.kind.name, len(part.poses), part.count) for part in first.parts] == [
        ("1", 2, 2),
        ("5", 1, 1),
    ]
    np.testing.assert_allclose(first.parts[0].poses, [place for _, place, _ in PLACES[1, 3][:2]], atol=1e-12)
    assert first.parts[0].visibility.tolist() == [0.9, 0.8]
    kind = first.parts[1].kind
    assert len(kind.symmetries.discrete) == 4
    assert kind.diameter == pytest.approx(ibi.metrics.diameter(BOX[0]))
    assert kind is scenes[2].parts[0].kind
    kinds = [part.kind for part in first.parts for _ in part.poses]
    poses = [pose for part in first.parts for pose in part.poses]
    assert is_on(first.points, kinds, poses)
    assert first.viewpoint.eye.tolist() == [0, 0, 0]
    assert [scene.ids for scene in scenes[1:]] == list(PLACES)[1:]


def test_the_scale_of_the_depth_does_not_matter(bop, tmp_path):
    coarse = datasets.Bop(tiny_sets.bop(tmp_path, scale=1.0))[0].points
    fine = datasets.Bop(bop)[0].points
    assert len(coarse) == len(fine)
    np.testing.assert_allclose(coarse, fine, atol=0.6)


def test_several_cameras_see_one_scene(tmp_path):
    root = tiny_sets.bop(tmp_path, cameras=("_cam1", "_cam2"), targets="bop24")
    with pytest.raises(ibi.InputError, match="several cameras; camera must be of cam1, cam2"):
        datasets.Bop(root)
    with pytest.raises(ibi.InputError, match="there is no camera 'photoneo'; there are cam1, cam2"):
        datasets.Bop(root, camera="photoneo")
    one, both = (datasets.Bop(root, camera=camera)[0] for camera in ("cam1", ["cam1", "cam2"]))
    assert [part.count for part in one.parts] == [None, None]  # objects are not told: all of the set
    assert [view.eye.tolist() for view in both.viewpoint] == [[0, 0, 0], [100, 0, 0]]
    assert len(both.points) > 1.5 * len(one.points)
    kinds = [part.kind for part in both.parts for _ in part.poses]
    assert is_on(both.points, kinds, [pose for part in both.parts for pose in part.poses])


def test_splits_objects_and_targets_are_chosen(bop, tmp_path):
    assert [scene.ids for scene in datasets.Bop(bop, objects=[5])] == [(1, 3), (2, 0)]
    assert len(datasets.Bop(bop, targets="all")[1].parts) == 2
    (bop / "one.json").write_text(json.dumps([{"scene_id": 1, "im_id": 4, "obj_id": 1}]))
    assert [scene.ids for scene in datasets.Bop(bop, targets="one.json")] == [(1, 4)]
    root = tiny_sets.bop(tmp_path, split="val")
    assert len(datasets.Bop(root, split="val")) == 3


def test_a_set_without_truth_is_read(tmp_path):
    root = tiny_sets.bop(tmp_path)
    for path in root.glob("test/*/scene_gt*.json"):
        path.unlink()
    scene = datasets.Bop(root)[0]
    assert not scene.has_truth
    assert len(scene.parts[0].poses) == 0
    with pytest.raises(ibi.InputError, match=r"has no scene_gt\.json; it cannot be scored"):
        datasets.score_bop([], datasets.Bop(root))


def test_scenes_and_sets_can_be_pickled(bop):
    scenes = pickle.loads(pickle.dumps(datasets.Bop(bop)))
    scene = scenes[0]
    assert len(scene.points) == len(pickle.loads(pickle.dumps(scene)).points)


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("test/000001/scene_camera.json", "{}", "has no image 3"),
        ("test/000001/scene_camera.json", '{"3": {}}', "an entry has no 'cam_K'"),
        ("test/000001/scene_camera.json", "[]", "must be a JSON object, not list"),
        (
            "test/000001/scene_gt.json",
            '{"3": [{"obj_id": 1, "cam_R_m2c": [1, 2]}, {}, {}]}',
            "must be 9 finite numbers",
        ),
        ("test/000001/scene_gt_info.json", '{"3": [{}]}', "has 1 entries, scene_gt.json 3"),
        ("test_targets_bop19.json", '[{"im_id": 3}]', "lacks a number scene_id or im_id"),
        ("models/models_info.json", "{}", "has no object 1"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_with_its_name(tmp_path, name, text, match):
    root = tiny_sets.bop(tmp_path)
    (root / name).write_text(text)
    with pytest.raises(ibi.InputError, match=match) as caught:
        datasets.Bop(root)[0].points  # noqa: B018
    assert str(root) in str(caught.value)


def test_a_folder_that_is_no_bop_set_is_refused(tmp_path):
    with pytest.raises(ibi.InputError, match="there is no such folder"):
        datasets.Bop(tmp_path / "none")
    (tmp_path / "test").mkdir()
    with pytest.raises(ibi.InputError, match=r"there is no models or models_cad or models_eval"):
        datasets.Bop(tmp_path)


# Results of BOP ------------------------------------------------------------------------------------------


def of_truth(seconds=0.5):
    """What a method would find that finds all, the best seen first."""
    images = []
    for (scene_id, im_id), held in PLACES.items():
        ids = np.array([of for of, _, _ in held])
        poses = np.array([place for _, place, _ in held])
        scores = np.array([share for _, _, share in held])
        images.append(datasets.BopImage(scene_id, im_id, ids, scores, poses, seconds))
    return images


def test_the_truth_as_results_has_recall_and_precision_1(bop, tmp_path):
    path = tmp_path / "truth_tiny-test.csv"
    datasets.write_bop_results(path, of_truth())
    scores = datasets.score_bop(datasets.read_bop_results(path), datasets.Bop(bop))
    assert (scores.num_images, scores.num_targets) == (3, 5)
    assert (scores.ar_mssd, scores.ap_mm, scores.ap, scores.seconds) == (1, 1, 1, 0.5)
    assert scores.recalls == (1,) * 10
    assert scores.ap_mm_of == {1: 1, 5: 1}
    # The copy of which a twentieth is seen is no target; told all the same, it is one too many one to one.
    assert scores.mhf1 == pytest.approx(np.mean([1, 2 / 3, 1]))


def test_a_csv_comes_back_as_it_was_written(tmp_path):
    path = tmp_path / "a.csv"
    datasets.write_bop_results(path, of_truth())
    lines = path.read_text().splitlines()
    assert lines[0] == "scene_id,im_id,obj_id,score,R,t,time"
    assert lines[1].split(",")[5] == "-60 -20 400"
    for image, back in zip(of_truth(), datasets.read_bop_results(path), strict=True):
        assert (image.scene_id, image.im_id, image.seconds) == (back.scene_id, back.im_id, back.seconds)
        np.testing.assert_allclose(back.poses, image.poses, atol=1e-6)
        assert back.obj_ids.tolist() == image.obj_ids.tolist()


def test_a_symmetry_is_no_error_and_a_shift_is_one(bop):
    images = of_truth()
    images[2].poses[0] = images[2].poses[0] @ np.diag([1.0, -1, -1, 1])  # half a turn of the box
    assert datasets.score_bop(images, datasets.Bop(bop)).ap_mm == 1
    images[2].poses[0, 2, 3] += 7  # below 8 mm and above 6; the diameter is 74.8
    scores = datasets.score_bop(images, datasets.Bop(bop, targets="all", objects=[5]))
    assert scores.recalls == (0.5,) + (1,) * 9
    # Of two boxes one is found below 2, 4 and 6 mm, and told first in half of the order; see the next test.
    assert 0.7 + 0.3 * 0.5 <= scores.ap_mm < 1


def test_precision_is_that_of_a_curve_drawn_by_hand(bop):
    images = of_truth()
    wrong = images[0].poses[2].copy()
    wrong[0, 3] += 100
    # Boxes: right with 0.9, wrong with 0.8, right with 0.7; then precision is 1 up to a recall of a half,
    # and 2/3 beyond.
    images[0] = datasets.BopImage(
        1, 3, np.array([5, 5]), np.array([0.9, 0.8]), np.array([images[0].poses[2], wrong]), 1.0
    )
    images[2].scores[0] = 0.7
    scores = datasets.score_bop(images, datasets.Bop(bop, targets="all", objects=[5]))
    assert scores.ap_mm == pytest.approx((51 * 1 + 50 * 2 / 3) / 101)
    assert scores.ar_mssd == 1
    # A copy counts once: the second estimate of it is wrong.
    twice = [datasets.BopImage(2, 0, np.array([5, 5]), np.array([0.9, 0.8]), images[2].poses[[0, 0]], 1.0)]
    scores = datasets.score_bop(twice, datasets.Bop(bop, targets="all", objects=[5]))
    assert (scores.ar_mssd, scores.num_targets) == (0.5, 2)
    assert scores.ap_mm == pytest.approx(51 / 101)


def test_as_many_estimates_count_as_copies_are_asked_for(bop):
    images = of_truth()
    scored_low = images[2].poses[0]
    wrong = scored_low.copy()
    wrong[2, 3] += 500
    images[2] = datasets.BopImage(
        2, 0, np.array([5, 5]), np.array([0.9, 0.2]), np.array([wrong, scored_low]), 1.0
    )
    assert datasets.score_bop(images, datasets.Bop(bop)).ar_mssd == pytest.approx(4 / 5)
    assert datasets.score_bop(images, datasets.Bop(bop, targets="all")).ar_mssd == 1


@pytest.mark.parametrize(
    ("row", "match"),
    [
        ("1,3,1,0.5,1 0 0 0 1 0 0 0 1,0 0,1", "line 2: is no row of scene_id"),
        ("1,3,1,nan,1 0 0 0 1 0 0 0 1,0 0 0,1", "line 2: a number is not finite"),
        (
            "1,3,1,0.5,1 0 0 0 1 0 0 0 1,0 0 0,1\n1,3,1,0.5,1 0 0 0 1 0 0 0 1,0 0 0,2",
            "line 3: time is 2, and 1",
        ),
        ("1,3,1,0.5,2 0 0 0 1 0 0 0 1,0 0 0,1", "line 2: 'R' is no rotation"),
    ],
)
def test_a_csv_that_is_wrong_is_refused(tmp_path, row, match):
    (tmp_path / "a.csv").write_text(f"scene_id,im_id,obj_id,score,R,t,time\n{row}\n")
    with pytest.raises(ibi.InputError, match=match):
        datasets.read_bop_results(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text("a,b\n")
    with pytest.raises(ibi.InputError, match="its first line must be"):
        datasets.read_bop_results(tmp_path / "a.csv")


# Scan2CAD ------------------------------------------------------------------------------------------------


def test_a_room_has_its_copies_with_the_scale_in_the_model(tmp_path):
    root = tiny_sets.scan2cad(tmp_path)
    scenes = datasets.Scan2Cad(root / "full_annotations.json", root / "scannet", root / "shapenet")
    assert repr(scenes) == "Scan2Cad(1 rooms, 1 scenes)"
    (scene,) = scenes
    (part,) = scene.parts
    assert scene.name == "scene0000_00/0300/abc"
    np.testing.assert_allclose(part.kind.mesh[0], BOX[0] / 100 * [2.05, 1, 1], atol=1e-6)
    # By hand: scan = Rz(-90) (world - (0, 0, -1)), so (1, 0, 0) comes to (0, -1, 1), (0, 2, 0) to (2, 0, 1).
    np.testing.assert_allclose(part.poses[:, :3, 3], [[0, -1, 1], [2, 0, 1]], atol=1e-9)
    np.testing.assert_allclose(part.poses[0, :3, :3], [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-9)
    assert len(part.kind.symmetries.discrete) == 2  # a quarter turn is none once x is twice z
    assert scene.views == ()
    assert scene.viewpoint is None
    outwards = (scene.normals * scene.points).sum(axis=1)
    assert (outwards > 0).all()
    np.testing.assert_allclose(np.linalg.norm(scene.normals, axis=1), 1)


def test_the_scale_of_a_scan_is_taken_back(tmp_path):
    root = tiny_sets.scan2cad(tmp_path)
    path = root / "full_annotations.json"
    before = datasets.Scan2Cad(path, root / "scannet", root / "shapenet")[0].parts[0]
    held = json.loads(path.read_text())
    held[0]["trs"]["scale"] = [2, 2, 2]
    path.write_text(json.dumps(held))
    after = datasets.Scan2Cad(path, root / "scannet", root / "shapenet")[0].parts[0]
    np.testing.assert_allclose(after.poses[:, :3, 3], before.poses[:, :3, 3] / 2)
    np.testing.assert_allclose(after.kind.mesh[0], before.kind.mesh[0] / 2)
    held[0]["trs"]["scale"] = [2, 1, 2]
    path.write_text(json.dumps(held))
    with pytest.raises(ibi.InputError, match="not alike along its axes"):
        datasets.Scan2Cad(path, root / "scannet", root / "shapenet")


def test_rooms_are_chosen_by_their_copies(tmp_path):
    root = tiny_sets.scan2cad(tmp_path)
    folders = root / "full_annotations.json", root / "scannet", root / "shapenet"
    assert len(datasets.Scan2Cad(*folders, min_copies=3)) == 0
    assert [scene.name for scene in datasets.Scan2Cad(*folders, min_copies=1)] == [
        "scene0000_00/0300/abc",
        "scene0000_00/0400/def",
    ]
    assert len(datasets.Scan2Cad(*folders, min_copies=1, skip_missing=True)) == 1


# ROBI ----------------------------------------------------------------------------------------------------


def test_views_of_robi_are_scenes(tmp_path):
    root = tiny_sets.robi(tmp_path)
    scenes = datasets.Robi(root, "Tee", root / "cad/Tee.ply")
    assert [scene.ids for scene in scenes] == [(1, 0), (1, 10)]
    for scene in scenes:
        (part,) = scene.parts
        assert is_on(scene.points, [part.kind] * 2, part.poses)
    assert scenes[1].parts[0].poses[0, 0, 3] == pytest.approx(scenes[0].parts[0].poses[0, 0, 3] - 30)
    with pytest.raises(ibi.InputError, match="no such folder"):
        datasets.Robi(root, "Gear", root / "cad/Tee.ply")
    (root / "cam/Ensenso_DEPTH.yml").write_text("fx: 3\n")
    with pytest.raises(ibi.InputError, match="lacks fy, cx, cy, depth_unit"):
        datasets.Robi(root, "Tee", root / "cad/Tee.ply")


# ModelNet40 ----------------------------------------------------------------------------------------------


def test_meshes_of_modelnet_fill_the_unit_sphere(tmp_path):
    shapes = datasets.ModelNet40(tiny_sets.modelnet(tmp_path))
    assert [shape.name for shape in shapes] == ["chair_0001", "chair_0002"]
    for shape in shapes:
        vertices, faces = shape.mesh
        assert np.linalg.norm(vertices, axis=1).max() == pytest.approx(1)
        np.testing.assert_allclose(vertices.min(axis=0) + vertices.max(axis=0), 0, atol=1e-12)
        assert len(faces) == 12
    with pytest.raises(ibi.InputError, match="there is no CATEGORY/train"):
        datasets.ModelNet40(tmp_path, split="train")
    with pytest.raises(ibi.InputError, match="no such folder"):
        datasets.ModelNet40(tmp_path, categories=["sofa"])


# Correspondences of others -------------------------------------------------------------------------------

SCENE = ibi.synth.outlier_layout(seed=1, num_instances=3)
PAIRS = np.hstack([SCENE.src[SCENE.corr[:, 0]], SCENE.tgt[SCENE.corr[:, 1]]])
SCORE = np.linspace(0, 1, len(PAIRS))


@pytest.mark.parametrize(
    "arrays",
    [
        {"corr": PAIRS, "score": SCORE, "poses": SCENE.poses},
        {"src": SCENE.src, "tgt": SCENE.tgt, "corr": SCENE.corr, "scores": SCORE, "poses": SCENE.poses},
        {"source": PAIRS[:, :3], "target": PAIRS[:, 3:], "similarity": SCORE, "poses": SCENE.poses},
        {
            "src_corr_points": PAIRS[:, :3],
            "tgt_corr_points": PAIRS[:, 3:],
            "scores": SCORE,
            "poses": SCENE.poses,
        },
    ],
)
def test_pairs_of_others_are_read(tmp_path, arrays):
    np.savez(tmp_path / "a.npz", **arrays)
    held = datasets.read_correspondences(tmp_path / "a.npz")
    np.testing.assert_array_equal(held.corr, PAIRS)
    np.testing.assert_array_equal(held.similarity, SCORE)
    np.testing.assert_array_equal(held.poses, SCENE.poses)


def test_pairs_in_text_are_read_and_registered(tmp_path):
    text = "# source, target, score\n" + "\n".join(
        ", ".join(f"{x:.9g}" for x in [*pair, score]) for pair, score in zip(PAIRS, 10 * SCORE, strict=True)
    )
    (tmp_path / "a.txt").write_text(text)
    held = datasets.read_correspondences(tmp_path / "a.txt")
    assert (held.similarity.min(), held.similarity.max()) == (0, 1)  # by rank: they left the interval
    assert (np.diff(held.similarity) > 0).all()
    found = ibi.register(SCENE.src, SCENE.tgt, held.corr)
    assert ibi.metrics.score_scene(found, SCENE.poses).f1 == 1


@pytest.mark.parametrize(
    ("arrays", "match"),
    [
        ({"points": PAIRS}, "has neither src and tgt nor"),
        ({"src": PAIRS[:5, :3], "tgt": PAIRS[:4, 3:]}, "as pairs they must be as many"),
        ({"src": SCENE.src, "tgt": SCENE.tgt, "corr": SCENE.corr + 10**6}, "names a row that is not there"),
        ({"corr": PAIRS, "score": SCORE[1:]}, "one for each pair"),
        ({"corr": np.full((2, 6), np.nan)}, "pair 0 is not finite"),
    ],
)
def test_pairs_that_are_wrong_are_refused(tmp_path, arrays, match):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(ibi.InputError, match=match) as caught:
        datasets.read_correspondences(tmp_path / "a.npz")
    assert str(tmp_path) in str(caught.value)


def test_a_line_that_is_wrong_is_named(tmp_path):
    (tmp_path / "a.txt").write_text("1 2 3 4 5 6\n1 2 3 4 5 6 7\n")
    with pytest.raises(ibi.InputError, match=r"a\.txt: line 2: wanted 6 numbers, found 7"):
        datasets.read_correspondences(tmp_path / "a.txt")


def test_a_pair_is_written_as_networks_read_it(tmp_path):
    datasets.write_pair(tmp_path / "a.npz", SCENE.src, SCENE.tgt, SCENE.poses)
    with np.load(tmp_path / "a.npz") as file:
        assert {name: file[name].dtype for name in file.files} == dict.fromkeys(
            ("src", "tgt", "poses", "rot", "trans"), np.float32
        )
        np.testing.assert_allclose(file["poses"], SCENE.poses, atol=1e-6)
        np.testing.assert_array_equal(file["rot"], file["poses"][0, :3, :3])
