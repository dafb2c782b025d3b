"""Depth images and cameras on the command line, and planes that are taken away."""

import json

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import io
from PIL import Image
from test_cli import MESH, SCAN, run

K = (600.0, 610.0, 320.5, 200.25)


def depth_image():
    """The tees of the example as a camera with K would see them, metres."""
    points = io.read_scan(SCAN).points
    column = np.rint(points[:, 0] / points[:, 2] * K[0] + K[2]).astype(int)
    row = np.rint(points[:, 1] / points[:, 2] * K[1] + K[3]).astype(int)
    fits = (row >= 0) & (column >= 0)
    image = np.zeros((row.max() + 1, column.max() + 1))
    for i in np.flatnonzero(fits)[np.argsort(-points[fits, 2])]:
        image[row[i], column[i]] = points[i, 2]
    return image


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("depth")
    image = depth_image()
    np.save(folder / "metres.npy", image)
    np.save(folder / "steps_0007.npy", (image / 2e-4).round().astype(np.uint16))
    Image.fromarray((image * 10000).round().astype(np.uint16)).save(folder / "steps_0007.png")
    return folder


CAMERAS = {
    "bop": ({"fx": K[0], "fy": K[1], "cx": K[2], "cy": K[3], "depth_scale": 0.1}, 1e-4, False),
    "bop_scene": (
        {
            "6": {"cam_K": [9, 0, 1, 0, 9, 1, 0, 0, 1], "depth_scale": 1.0},
            "7": {"cam_K": [K[0], 0, K[2], 0, K[1], K[3], 0, 0, 1], "depth_scale": 0.1},
        },
        1e-4,
        False,
    ),
    "realsense": (
        {"fx": K[0], "fy": K[1], "ppx": K[2], "ppy": K[3], "depth_scale": 0.0001, "coeffs": [0.0] * 5},
        1e-4,
        False,
    ),
    "open3d": ({"intrinsic_matrix": [K[0], 0, 0, 0, K[1], 0, K[2], K[3], 1]}, None, False),
    "ros": ({"k": [K[0], 0, K[2], 0, K[1], K[3], 0, 0, 1], "d": [0.1, 0, 0, 0, 0]}, None, True),
    "ros1": (
        {
            "camera_matrix": {"rows": 3, "data": [K[0], 0, K[2], 0, K[1], K[3], 0, 0, 1]},
            "distortion_coefficients": {"data": [0, 0, 0, 0, 0]},
        },
        None,
        False,
    ),
}


@pytest.mark.parametrize("kind", CAMERAS)
def test_a_camera_is_read(kind, tmp_path):
    data, metres, is_distorted = CAMERAS[kind]
    (tmp_path / "camera.json").write_text(json.dumps(data))
    assert io.read_camera(tmp_path / "camera.json", "a/depth_0007.png") == io.Camera(*K, metres, is_distorted)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ([], "must be a JSON object, as BOP's, RealSense's, Open3D's or ROS's CameraInfo"),
        ({}, "has no fx; wanted is a camera"),
        ({"fx": 1, "fy": 1, "cx": 1}, "has no cy"),
        ({"fx": "wide", "fy": 1, "cx": 1, "cy": 1}, "is no camera as BOP's"),
        ({"fx": 0, "fy": 1, "cx": 1, "cy": 1}, "fx and fy are 0 and 1; they must be above 0"),
        ({"K": [1, 2, 3]}, "is no camera as BOP's"),
        ({"K": [1, 2, 3, 0, 1, 3, 0, 0, 1]}, "its matrix is no pinhole camera"),
        ({"fx": 1, "fy": 1, "cx": 1, "cy": 1, "depth_scale": -1}, "its depth_scale must be above 0"),
        ({"1": {}, "2": {}}, "has 2 cameras by numbers of images, and none for no image"),
    ],
)
def test_what_is_no_camera_is_refused(data, message, tmp_path):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(data))
    with pytest.raises(ibi.InputError, match=f"camera.json: {message}"):
        io.read_camera(path)


@pytest.fixture(scope="module")
def expected(folder):
    points = io.read_depth(folder / "steps_0007.png", *K, scale=1e-4)
    return np.asarray(ibi.Model.from_mesh(*io.read_mesh(MESH)).detect(points, viewpoint=[0, 0, 0]))


NUMBERS = ",".join(map(str, K))


@pytest.mark.parametrize(
    ("image", "camera", "options"),
    [
        ("steps_0007.png", "bop_scene", ()),
        ("steps_0007.png", NUMBERS, ("--depth-scale", 10000)),
        ("steps_0007.png", "ros", ("--depth-scale", 10000)),
    ],
)
def test_an_image_gives_what_its_points_give(folder, expected, image, camera, options, tmp_path):
    if camera in CAMERAS:
        (folder / f"{camera}.json").write_text(json.dumps(CAMERAS[camera][0]))
        camera = folder / f"{camera}.json"
    result = run("register", MESH, folder / image, "--camera", camera, *options, "-o", tmp_path / "p.json")
    assert result.exit_code == 0, result.output
    assert ("names distortions" in result.stderr) == ("ros" in str(camera))
    held = json.loads((tmp_path / "p.json").read_text())
    assert len(expected) > 3
    np.testing.assert_array_equal([pose["target_from_source"] for pose in held["poses"]], expected)
    assert held["search"]["camera"] == str(camera)


def test_images_in_a_batch(folder, expected, tmp_path):
    options = ("--camera", NUMBERS, "--depth-scale", 10000, "-o", tmp_path / "poses")
    assert run("batch", MESH, folder / "steps_0007.png", *options).exit_code == 0
    held = json.loads((tmp_path / "poses/steps_0007.json").read_text())
    np.testing.assert_array_equal([pose["target_from_source"] for pose in held["poses"]], expected)
    again = run("batch", MESH, folder / "steps_0007.png", *options, "--skip-existing")
    assert "kept" in again.stdout
    options = ("--camera", NUMBERS, "--depth-scale", 9999, *options[4:])
    again = run("batch", MESH, folder / "steps_0007.png", *options, "--skip-existing")
    assert "depth_scale 10000 for 9999" in again.stderr


def search(**options):
    from ibi_rs.cli.search import Changes, Search

    return Search(None, False, None, None, Changes(None, None, {}), None, None, **options)


def test_steps_are_millimetres_and_floats_units(folder):
    """Unless it is said otherwise; the unit is that of the model."""
    steps = io.read_depth(folder / "steps_0007.png", *K, scale=1)
    for options, scale in (
        ({}, 0.001),
        ({"unit": "mm"}, 1),
        ({"unit": "in"}, 1 / 25.4),
        ({"depth_scale": 4}, 0.25),
    ):
        held = search(camera=NUMBERS, **options).read(folder / "steps_0007.png")
        np.testing.assert_allclose(held.points, steps * scale, rtol=1e-12)
        assert held.viewpoint.tolist() == [0, 0, 0]
    (folder / "bop.json").write_text(json.dumps(CAMERAS["bop"][0]))
    held = search(camera=str(folder / "bop.json"), unit="mm").read(folder / "steps_0007.png")
    np.testing.assert_allclose(held.points, steps * 0.1, rtol=1e-12)
    floats = io.read_depth(folder / "metres.npy", *K, scale=1)
    np.testing.assert_array_equal(
        search(camera=NUMBERS, unit="mm").read(folder / "metres.npy").points, floats
    )
    whole = search(camera=NUMBERS, depth_scale=5000).read(folder / "steps_0007.npy")
    np.testing.assert_allclose(whole.points, floats, atol=3e-4)


def test_planes_are_taken_away():
    """Floor and two walls, as one sees into the corner of a bin, and a ball."""
    rng = np.random.default_rng(0)
    flat = rng.uniform(0, 100, (3, 3000, 3))
    for axis in range(3):
        flat[axis, :, axis] = 100
    ball = rng.normal(size=(400, 3))
    ball = 50 + 10 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    scan = io.Scan(np.concatenate([*flat, ball]), None, None, 0)
    assert search().look(scan, 2.0)[0] is scan.points
    tgt, sight = search(remove_planes=3).look(scan, 2.0)
    np.testing.assert_array_equal(tgt, ball)
    assert sight["remove_plane"] is False
    assert len(sight["viewpoint"].points) == len(scan.points)
    # No more than there are, and none beyond what is looked into.
    np.testing.assert_array_equal(search(remove_planes=9).look(scan, 2.0)[0], ball)
    assert len(search(remove_planes=0).look(scan, 2.0)[0]) == len(scan.points)
    tgt, _ = search(remove_planes=3, crop=(0, 0, 90, 100, 100, 110)).look(scan, 2.0)
    assert len(tgt) < len(scan.points) - 3000
    assert (tgt[:, 0] == 100).sum() > 2000


def test_parts_are_found_without_planes(tmp_path):
    result = run("register", MESH, SCAN, "--remove-planes", 0, "-o", tmp_path / "p.json")
    assert result.exit_code == 0
    assert "6 found" in result.stdout


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--depth-scale", 1000), "--depth-scale is of a depth image; give its --camera"),
        (("--camera", "1,2,3"), "--camera 1,2,3: must be four numbers"),
        (("--camera", "600,-600,3,4"), "--camera 600,-600,3,4: must be finite, FX and FY above 0"),
        (("--camera", "600,600,nan,4"), "must be finite, FX and FY above 0"),
        (("--camera", NUMBERS, "--depth-scale", 0), "--depth-scale is 0; it must be above 0"),
        (("--camera", NUMBERS, "--viewpoint", "0,0,0"), "--camera says where it stood"),
        (("--remove-planes", 2, "--keep-plane"), "give --remove-planes or --remove-plane, not both"),
        (("--corr", SCAN, "--camera", NUMBERS), "--corr brings the matches: --camera has no say then"),
    ],
)
def test_what_has_no_meaning_is_refused(options, message):
    result = run("register", MESH, SCAN, *options)
    assert (result.exit_code, message in result.stderr) == (2, True), result.stderr


def test_an_image_without_a_camera_says_what_it_wants(folder):
    result = run("register", MESH, folder / "steps_0007.png")
    assert result.exit_code == 1
    assert "is an image; with a camera read_depth reads it, or ibi with --camera" in result.stderr


@pytest.mark.parametrize("eye", ["0,0,0", "0, 0, 0", "0 0 0"])
def test_a_viewpoint_takes_commas_and_spaces(eye):
    words = eye.split(" ") if eye == "0 0 0" else [eye]
    result = run("register", MESH, SCAN, "--viewpoint", *words, "--max-instances", 1)
    assert result.exit_code == 0, result.stderr


def test_an_organised_pcd_is_a_scan(tmp_path):
    """As cameras' drivers write them: rows of pixels, NaN where nothing was measured."""
    image = depth_image()
    row, column = np.mgrid[: image.shape[0], : image.shape[1]]
    z = np.where(image > 0, image, np.nan)
    points = np.stack([(column - K[2]) / K[0] * z, (row - K[3]) / K[1] * z, z], axis=-1).astype("<f4")
    head = (
        "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {image.shape[1]}\nHEIGHT {image.shape[0]}\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {image.size}\nDATA binary\n"
    )
    (tmp_path / "scan.pcd").write_bytes(head.encode() + points.tobytes())
    scan = io.read_scan(tmp_path / "scan.pcd")
    assert scan.num_dropped == (image == 0).sum()
    assert scan.viewpoint.tolist() == [0, 0, 0]
    result = run("register", MESH, tmp_path / "scan.pcd")
    assert result.exit_code == 0
