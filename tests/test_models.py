"""Parts of several kinds, looked for together, and a region to look into."""

import json
import pickle
from collections import Counter

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import cli, synth
from scipy.spatial.transform import Rotation
from small_piles import depth_image, move
from typer.testing import CliRunner

BOLT, PIN, BRACKET = (synth.part_mesh(name) for name in ("bolt-a", "pin-a", "bracket-a"))
MIRRORED = BRACKET[0] * [-1, 1, 1], BRACKET[1][:, ::-1]
CORNERS = np.array([[x, y, z] for x in (-20, 20) for y in (-13, 13) for z in (-3, 3)], dtype=float)
PLATE = (
    CORNERS,
    np.array(
        [
            0,
            1,
            3,
            0,
            3,
            2,
            4,
            6,
            7,
            4,
            7,
            5,
            0,
            4,
            5,
            0,
            5,
            1,
            2,
            3,
            7,
            2,
            7,
            6,
            0,
            2,
            6,
            0,
            6,
            4,
            1,
            5,
            7,
            1,
            7,
            3,
        ]
    ).reshape(-1, 3),
)
DISTANCE, FOCAL, SHAPE = 500.0, 700.0, (300, 400)
EYE = [0, 0, 0]


def scan_of(*parts, seed=0, noise=0.1):
    """(N, 3) of meshes in world poses on a table, z = 0, as a camera sees them, and their poses."""
    rng = np.random.default_rng(seed)
    camera = np.diag([1.0, -1, -1, 1])
    camera[:3, :3] = Rotation.from_euler("x", 25, degrees=True).as_matrix() @ camera[:3, :3]
    camera[2, 3] = DISTANCE
    poses = [camera @ pose for _, pose in parts]
    table = move(camera, 400 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float))
    vertices = [*(move(pose, mesh[0]) for (mesh, _), pose in zip(parts, poses, strict=True)), table]
    faces = [*(mesh[1] for mesh, _ in parts), np.array([[0, 1, 2], [0, 2, 3]])]
    starts = np.cumsum([0, *map(len, vertices)])
    rows = [face + start for face, start in zip(faces, starts, strict=False)]
    depth = depth_image(np.concatenate(vertices), np.concatenate(rows), FOCAL, SHAPE)
    depth += rng.normal(0, noise, SHAPE)
    v, u = np.nonzero(np.isfinite(depth))
    z = depth[v, u]
    points = np.stack(
        [(u - (SHAPE[1] - 1) / 2) / FOCAL * z, (v - (SHAPE[0] - 1) / 2) / FOCAL * z, z], axis=-1
    )
    return points, poses


def lying(mesh, place, *turns):
    """A pose in which the mesh lies on the table, its middle at a place; turns are "x", 90 and so on."""
    pose = np.eye(4)
    for axis, angle in zip(turns[::2], turns[1::2], strict=True):
        pose[:3, :3] = Rotation.from_euler(axis, angle, degrees=True).as_matrix() @ pose[:3, :3]
    turned = mesh[0] @ pose[:3, :3].T
    middle = (turned.min(axis=0) + turned.max(axis=0)) / 2
    pose[:3, 3] = [place[0] - middle[0], place[1] - middle[1], -turned[:, 2].min()]
    return pose


def is_right(pose, truth, model):
    return ibi.metrics.add_s(model.points, pose.target_from_source, truth) < 0.1 * model.diameter


def right(found, truths, models):
    """How many poses of each model are right, and how many are not."""
    counts = Counter()
    for pose in found:
        hit = any(is_right(pose, truth, models[pose.model]) for truth in truths.get(pose.model_name, []))
        counts[pose.model_name if hit else "wrong"] += 1
    return dict(counts)


@pytest.fixture(scope="module")
def models():
    return ibi.Models({"bolt": BOLT, "pin": PIN})


@pytest.fixture(scope="module")
def scene():
    """Two bolts and a pin: the scan, and the poses of each by name."""
    parts = [
        (BOLT, lying(BOLT, (-55, 20), "y", 90, "z", 20)),
        (BOLT, lying(BOLT, (45, 35), "y", 90, "z", 100)),
        (PIN, lying(PIN, (10, -35), "y", 90, "z", -15)),
    ]
    points, poses = scan_of(*parts)
    return points, {"bolt": poses[:2], "pin": poses[2:]}


@pytest.fixture(scope="module")
def found(models, scene):
    return models.detect(scene[0], viewpoint=ibi.View(EYE, scene[0]))


def same(a, b):
    np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
    assert [pose.score for pose in a] == [pose.score for pose in b]
    assert [pose.inliers.tolist() for pose in a] == [pose.inliers.tolist() for pose in b]
    assert a.labels.tolist() == b.labels.tolist()
    assert (len(a.rounds), a.warnings, a.params, a.resolution) == (
        len(b.rounds),
        b.warnings,
        b.params,
        b.resolution,
    )
    assert a.stop_reason == b.stop_reason
    assert [(one.score, one.objection) for one in a.rejected] == [
        (one.score, one.objection) for one in b.rejected
    ]


def places(poses):
    return {pose.target_from_source.tobytes() for pose in poses}


# One part ------------------------------------------------------------------------------------------------


def test_one_part_is_found_as_by_its_model(models, scene):
    points, _ = scene
    alone = models["bolt"].detect(points, viewpoint=EYE)
    assert len(alone)
    for one in (
        ibi.Models([models["bolt"]], names=["bolt"]).detect(points, viewpoint=EYE),
        ibi.detect(BOLT, points, viewpoint=EYE),
    ):
        same(one, alone)
        same(one.of(0), alone)
    assert alone.of(0) is alone
    assert alone.models == ()
    assert {(pose.model, pose.model_name) for pose in alone} == {(0, None)}


# Several -------------------------------------------------------------------------------------------------


def test_a_pin_on_the_shank_of_a_bolt_is_outdone_and_a_bolt_on_a_pin(models, scene):
    points, truths = scene
    # As if scores were of no account, so that it shows.
    lenient = ibi.Params.single_view().replace(**{"hv.t_score": 0.05})
    found = models.detect(points, lenient, viewpoint=ibi.View(EYE, points))
    pins = models["pin"].detect(points, lenient, viewpoint=ibi.View(EYE, points))
    on_bolts = [pose for pose in pins if not is_right(pose, truths["pin"][0], models["pin"])]
    assert on_bolts  # else it shows nothing
    bolts = models["bolt"].detect(points, lenient, viewpoint=ibi.View(EYE, points))
    assert len(bolts) > 2  # and where a bolt lies on the pin, which stays
    assert right(found, truths, models) == {"bolt": 2, "pin": 1}
    outdone = [one for one in found.rejected if one.objection == "outdone"]
    gone = places([*pins, *bolts]) - places(found)
    assert gone == places(outdone)
    assert all(0 < one.score < 1 for one in outdone)


def test_a_plate_on_the_face_of_a_bracket_is_outdone_and_so_is_its_mirror_image():
    points, poses = scan_of(
        (BRACKET, lying(BRACKET, (-40, 10), "y", 90, "z", 20)), (PLATE, lying(PLATE, (45, -20), "z", 50))
    )
    models = ibi.Models({"plate": PLATE, "left": MIRRORED, "right": BRACKET})
    found = models.detect(points, viewpoint=ibi.View(EYE, points))
    assert right(found, {"plate": poses[1:], "right": poses[:1]}, models) == {"plate": 1, "right": 1}
    outdone = {one.model_name for one in found.rejected if one.objection == "outdone"}
    assert outdone == {"plate", "left"}


def test_of_the_same_part_given_twice_each_instance_is_found_once(models, scene):
    points, _ = scene
    twice = ibi.Models([models["bolt"], models["bolt"]])
    found = twice.detect(points, viewpoint=ibi.View(EYE, points))
    alone = models["bolt"].detect(points, viewpoint=ibi.View(EYE, points))
    np.testing.assert_array_equal(np.asarray(found), np.asarray(alone))
    assert {pose.model for pose in found} == {0}


def test_threads_do_not_matter_nor_does_pickling(models, scene, found):
    copy = pickle.loads(pickle.dumps(models))
    assert copy.names == models.names
    same(copy.detect(scene[0], viewpoint=ibi.View(EYE, scene[0]), num_threads=1), found)


def test_the_result_is_one_of_all_and_of_each(found, models, scene):
    scores = [pose.score for pose in found]
    assert scores == sorted(scores, reverse=True)
    assert found.models == ("bolt", "pin")
    assert {(pose.model, pose.model_name) for pose in found} == {(0, "bolt"), (1, "pin")}
    assert len(found) == sum(len(found.of(i)) for i in range(2))
    assert found.of("pin") is found.of(1)
    assert "Pose('bolt', score=" in repr(found)
    assert 0 < found.resolution == min(found.of(i).resolution for i in range(2))
    assert len(found.rounds) == sum(len(found.of(i).rounds) for i in range(2))
    assert found.timings.total_s >= max(found.of(i).timings.total_s for i in range(2))
    # Rows of the correspondences of all, one model after the other.
    view = ibi.View(EYE, scene[0])
    lengths = [len(model.correspond(scene[0], viewpoint=view).corr) for model in models]
    assert len(found.labels) == sum(lengths)
    starts = np.cumsum([0, *lengths])
    for k, pose in enumerate(found):
        mine = np.flatnonzero(found.labels == k)
        assert len(mine)
        assert np.isin(mine, pose.inliers).all()
        assert ((starts[pose.model] <= pose.inliers) & (pose.inliers < starts[pose.model + 1])).all()
    with pytest.raises(KeyError, match="model 'nut'; there are 'bolt', 'pin'"):
        found.of("nut")
    with pytest.raises(IndexError):
        found.of(2)
    turned = found.canonical([ibi.Symmetries.none()] * 2)
    np.testing.assert_allclose(np.asarray(turned), np.asarray(found), atol=1e-9)
    with pytest.raises(ibi.InputError, match="symmetries: there are 1 of 2 models"):
        found.canonical(ibi.Symmetries.none())


def test_a_set_is_a_sequence_of_its_models(models):
    assert len(models) == 2
    assert models[1] is models["pin"]
    assert list(models) == [models[0], models[1]]
    assert repr(models).startswith("Models: 2\n  bolt: Model(")
    assert ibi.Models([models[0], PIN]).names == ("0", "1")
    with pytest.raises(KeyError):
        models["nut"]


def test_time_counts_once_and_a_callback_ends_all(models, scene):
    points, _ = scene
    found = models.detect(points, viewpoint=EYE, timeout_s=0)
    assert len(found) == 0
    assert found.stop_reason.name == "timeout"
    assert found.stop_reason.threshold == 0
    rounds = []
    ended = models.detect(points, viewpoint=EYE, callback=lambda done: bool(rounds.append(done)))
    assert len(rounds) == 1
    assert ended.stop_reason.name == "cancelled"
    assert ended.of("pin").stop_reason.name == "cancelled"
    assert len(ended.of("pin").rounds) == 0


def test_a_warning_names_the_parts_it_is_about(models):
    empty = models.detect(np.empty((0, 3)), viewpoint=EYE)
    assert empty.warnings == ("the scan has 0 points",)
    fine = ibi.Models({"fine": ibi.Model.from_mesh(*PIN, voxel=0.5), "coarse": models["pin"]})
    points = np.random.default_rng(0).uniform(-50, 50, (2000, 3)) * [1, 1, 0] + [0, 0, 300]
    warnings = fine.detect(points, viewpoint=EYE, remove_plane=False, max_instances=1).warnings
    assert any(text.startswith("fine: the scan is coarser than the voxel of 0.5") for text in warnings)


NONE = np.empty((0, 3))
BAD = [
    (lambda: ibi.Models([]), ibi.InputError, "models: there is none"),
    (lambda: ibi.Models({}), ibi.InputError, "models: there is none"),
    (lambda: ibi.Models(3), TypeError, "parts must be a sequence or a mapping of models, not int"),
    (lambda: ibi.Models(ibi.Model.from_mesh(*PIN)), TypeError, "parts must be a sequence or a mapping"),
    (
        lambda: ibi.Models([PIN, "part.stl"]),
        TypeError,
        "parts[1] must be a Model, (vertices, faces) or a mesh",
    ),
    (lambda: ibi.Models([PIN, BOLT], names=["a"]), ibi.InputError, "names: there are 1 of 2 parts"),
    (lambda: ibi.Models([PIN, BOLT], names=["a", "a"]), ibi.InputError, 'names: "a" is that of model 0 and'),
    (lambda: ibi.Models([PIN, BOLT], names="ab"), TypeError, "names must be a sequence of str, not str"),
    (lambda: ibi.Models([PIN], names=[3]), TypeError, "names must be str, not int"),
    (lambda: ibi.Models({"a": PIN}, names=["a"]), ibi.InputError, "names: the parts have theirs"),
    (lambda: ibi.Models([ibi.Model(PIN[0])]), ibi.InputError, "parts[0] has no normals"),
    (lambda: ibi.detect([PIN], NONE), ibi.InputError, "viewpoint: give it"),
    (lambda: ibi.detect("part.stl", NONE), TypeError, "parts[0] must be a Model"),
    (lambda: roi([[0, 0, 0]]), ibi.InputError, "roi has shape (1, 3)"),
    (lambda: roi([[0, 0, 0], [1, 1, 0]]), ibi.InputError, "roi: its corners are [0.0, 0.0, 0.0] and"),
    (lambda: roi([[0, 0, 0], [1, 1, np.nan]]), ibi.InputError, "roi: its corners are [0.0, 0.0, 0.0] and"),
    (lambda: roi("all"), TypeError, "roi has dtype"),
    (lambda: ibi.Box([0, 0], [1, 1, 1]), ibi.InputError, "center has shape (2,)"),
    (lambda: ibi.Box([0, 0, np.inf], [1, 1, 1]), ibi.InputError, "center is [0.0, 0.0, inf]; it must be"),
    (lambda: ibi.Box([0, 0, 0], [1, -1, 1]), ibi.InputError, "size is [1.0, -1.0, 1.0]; it must be above 0"),
    (lambda: ibi.Box([0, 0, 0], [1, 1, 1], 2 * np.eye(3)), ibi.InputError, "rotation is no rigid motion"),
]


def roi(value):
    return ibi.detect(PIN, NONE, viewpoint=EYE, roi=value)


@pytest.mark.parametrize(("call", "kind", "start"), BAD, ids=[case[2][:45] for case in BAD])
def test_what_is_wrong_is_named_in_one_line(call, kind, start):
    with pytest.raises(kind) as caught:
        call()
    assert str(caught.value).startswith(start)
    assert "\n" not in str(caught.value)


# A region to look into -----------------------------------------------------------------------------------


def test_only_what_lies_in_the_box_is_matched_and_all_is_measured(models, scene):
    points, truths = scene
    model, view = models["bolt"], ibi.View(EYE, points)
    middle = np.mean(move(truths["bolt"][1], BOLT[0]), axis=0)
    low, high = middle - 40, middle + 40
    found = model.detect(points, viewpoint=view, roi=[low, high])
    assert len(found) == 1
    assert is_right(found[0], truths["bolt"][1], model)
    inside = points[((low <= points) & (points <= high)).all(axis=1)]
    same(found, model.detect(inside, viewpoint=view))
    # The rays beside the box are told of by the view alone.
    assert (
        found[0].measures == model.detect(points, roi=ibi.Box.between(low, high), viewpoint=EYE)[0].measures
    )
    matches = model.correspond(points, viewpoint=view, roi=[low, high])
    assert ((low - model.voxel < matches.tgt) & (matches.tgt < high + model.voxel)).all()
    of_all = ibi.Models([model, PIN]).detect(points, viewpoint=view, roi=[low, high])
    assert [pose.model for pose in of_all] == [0]


def test_a_box_may_be_turned(models, scene):
    points, _ = scene
    model = models["bolt"]
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix().round()
    middle = points.mean(axis=0)
    boxes = ibi.Box(middle, [150, 80, 200]), ibi.Box(middle, [80, 150, 200], turn)
    first, second = (model.correspond(points, viewpoint=EYE, roi=box) for box in boxes)
    np.testing.assert_array_equal(first.tgt, second.tgt)
    turned = model.correspond(points, viewpoint=EYE, roi=ibi.Box(middle, [150, 80, 200], turn))
    assert len(turned.tgt) != len(first.tgt)
    assert repr(boxes[0]).endswith("size=[150, 80, 200])")
    assert repr(boxes[1]).endswith("turned)")


def test_an_empty_box_is_told(models, scene):
    points, _ = scene
    found = models.detect(points, viewpoint=EYE, roi=[[1e4, 0, 0], [1e4 + 100, 100, 100]])
    assert len(found) == 0
    assert found.warnings == (f"roi: 0 of the {len(points)} points of the scan lie in it",)


# The command ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def files(tmp_path_factory, scene):
    folder = tmp_path_factory.mktemp("parts")
    for name, (vertices, faces) in {"bolt": BOLT, "pin": PIN}.items():
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
        lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
        (folder / f"{name}.obj").write_text("\n".join(lines))
    np.save(folder / "scan.npy", scene[0])
    return folder


def run(*arguments):
    return CliRunner().invoke(cli.app, list(map(str, arguments)))


def test_the_command_finds_several_parts(files, scene):
    parts = files / "bolt.obj", files / "pin.obj"
    outputs = files / "poses.json", files / "poses.csv"
    result = run("register", *parts, files / "scan.npy", "-o", outputs[0], "--bop", outputs[1])
    assert result.exit_code == 0, result.output
    assert "part" in result.stdout.splitlines()[0]
    held = json.loads(outputs[0].read_text())
    assert [held["model"], len(held["model_sha256"])] == [[str(part) for part in parts], 2]
    counts = Counter((pose["model"], pose["model_name"]) for pose in held["poses"])
    assert set(counts) <= {(0, "bolt"), (1, "pin")}
    assert counts[0, "bolt"] == 2
    assert f"({counts[0, 'bolt']} bolt, {counts[1, 'pin']} pin)" in result.stdout
    ids = Counter(line.split(",")[2] for line in outputs[1].read_text().splitlines()[1:])
    assert ids == {str(model + 1): count for (model, _), count in counts.items()}


def test_the_command_looks_into_a_box(files, scene):
    middle = np.mean(move(scene[1]["bolt"][1], BOLT[0]), axis=0)
    crop = ",".join(f"{x:.3f}" for x in (*middle - 40, *middle + 40))
    output = files / "one.json"
    result = run("register", files / "bolt.obj", files / "scan.npy", "--crop", crop, "-o", output)
    assert result.exit_code == 0, result.output
    held = json.loads(output.read_text())
    assert len(held["poses"]) == 1
    assert held["poses"][0]["model_name"] is None
    assert len(held["search"]["crop"]) == 6


def test_the_command_leaves_out_what_is_always_there(files, scene):
    scan = np.load(files / "scan.npy")
    middle = np.mean(move(scene[1]["bolt"][1], BOLT[0]), axis=0)
    np.save(files / "empty.npy", scan[np.abs(scan - middle).max(axis=1) > 40])
    output = files / "one.json"
    found = ("register", files / "bolt.obj", files / "scan.npy", "--background", files / "empty.npy")
    result = run(*found, "-o", output)
    assert result.exit_code == 0, result.output
    held = json.loads(output.read_text())
    assert len(held["poses"]) == 1
    assert len(held["search"]["background_sha256"]) == 64
    result = run(*found[:-1], files / "none.npy")
    assert (result.exit_code, "none.npy" in result.stderr) == (1, True), result.output


@pytest.mark.parametrize(
    ("more", "text"),
    [
        (("--corr", "m.npy"), "--corr is of one MODEL; there are several"),
        (("--plot", "a.png"), "--plot is of one MODEL; there are several"),
        (("--symmetries", "info.json"), "--symmetries of several MODELs are find or none"),
        (("--crop", "0,0,0,1,1,0"), "--crop must be six finite numbers, the first three each below"),
    ],
)
def test_the_command_refuses_in_one_line(files, more, text, monkeypatch):
    monkeypatch.chdir(files)
    result = run("register", "bolt.obj", "pin.obj", "scan.npy", *more)
    assert result.exit_code == 2
    assert text in result.stderr
