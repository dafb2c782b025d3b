"""Messages of ROS 2 read and written, and the node of the examples, with stand-ins for what is of ROS."""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import ros
from PIL import Image
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).parents[1]
BIN = ROOT / "examples/bin"
STEPS = np.asarray(Image.open(BIN / "depth.png")).astype(np.uint16)  # 0.1 mm each
CAMERA = json.loads((BIN / "camera.json").read_text(encoding="utf-8"))
INFO = SimpleNamespace(k=[CAMERA["fx"], 0.0, CAMERA["cx"], 0.0, CAMERA["fy"], CAMERA["cy"], 0.0, 0.0, 1.0])
HEADER = SimpleNamespace(stamp=SimpleNamespace(sec=12, nanosec=34), frame_id="camera_depth_optical_frame")


def image(pixels, encoding, big=False, padding=0, **changes):
    """A message with rows that are padded."""
    pixels = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<"))
    rows = pixels.view(np.uint8).reshape(len(pixels), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=7)
    fields = {
        "header": HEADER,
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "encoding": encoding,
        "is_bigendian": int(big),
        "step": rows.shape[1],
        "data": rows.tobytes(),
    }
    return SimpleNamespace(**fields | changes)


METRES = (STEPS / 10_000).astype(np.float32)


@pytest.fixture(scope="module")
def points():
    return ibi.io.read_depth(
        BIN / "depth.png", *(CAMERA[name] for name in ("fx", "fy", "cx", "cy")), scale=0.1
    )


@pytest.mark.parametrize(
    ("message", "options"),
    [
        (image(STEPS, "16UC1"), {"step_m": 1e-4}),
        (image(STEPS, "mono16", big=True, padding=6), {"step_m": 1e-4}),
        (image(METRES, "32FC1"), {}),
        (image(np.where(METRES == 0, np.nan, METRES).astype(np.float32), "32FC1", big=True, padding=3), {}),
    ],
)
def test_a_depth_image_gives_the_points_of_the_file(points, message, options):
    view = ros.view(message, INFO, unit="mm", **options)
    np.testing.assert_allclose(view.points, points, rtol=1e-6)
    np.testing.assert_array_equal(view.eye, [0, 0, 0])


def test_integers_are_millimetres_and_a_camera_may_stand_elsewhere():
    place = np.eye(4)
    place[:3, 3] = [0, 0, -5]
    view = ros.view(image(np.full((2, 3), 2000, np.uint16), "16UC1"), INFO, target_from_camera=place)
    np.testing.assert_allclose(view.points[:, 2], -3)
    np.testing.assert_array_equal(view.eye, place[:3, 3])


@pytest.mark.parametrize(
    ("message", "info", "options", "error"),
    [
        (image(STEPS, "rgb8"), INFO, {}, "image: encoding is 'rgb8'"),
        (image(STEPS, "16UC1", data=b"123"), INFO, {}, "image: 3 bytes"),
        (image(STEPS, "16UC1", step=10), INFO, {}, r"image: \d+ bytes"),
        (image(STEPS, "16UC1", width=10**6), INFO, {}, r"image: \d+ bytes, for \d+ rows"),
        (image(STEPS, "16UC1"), SimpleNamespace(k=[1.0]), {}, "camera_info: k has 1 numbers"),
        (image(STEPS, "16UC1"), SimpleNamespace(k=[0.0] * 9), {}, "fx and fy are 0 and 0"),
        (image(STEPS, "16UC1"), INFO, {"step_m": 0}, "step_m is 0"),
        (image(STEPS, "16UC1"), INFO, {"unit": "ell"}, "unit is 'ell'"),
        (image(0 * STEPS, "16UC1"), INFO, {}, "depth: no pixel has one"),
    ],
)
def test_what_is_no_depth_image_is_named(message, info, options, error):
    with pytest.raises(ibi.InputError, match=f"^{error}"):
        ros.view(message, info, **options)


def as_message(fields):
    return json.loads(json.dumps(fields), object_hook=lambda of: SimpleNamespace(**of))


def test_a_pose_is_read_as_it_was_written():
    moves = np.eye(4)
    moves[:3, :3] = Rotation.from_rotvec([0.3, -2, 1]).as_matrix()
    moves[:3, 3] = [100, -20, 3]
    message = as_message(ros._pose(moves, 0.001))
    np.testing.assert_allclose(ros.matrix(message, unit="mm"), moves, atol=1e-12)
    for name in "xyzw":  # of which only the direction counts
        setattr(message.orientation, name, 3 * getattr(message.orientation, name))
    np.testing.assert_allclose(ros.matrix(message, unit="mm"), moves, atol=1e-12)
    for name in "xyzw":
        setattr(message.orientation, name, 0.0)
    with pytest.raises(ibi.InputError, match="quaternion"):
        ros.matrix(message)


@pytest.fixture(scope="module")
def found(points):
    part = ibi.Model.from_mesh(*ibi.io.read_mesh(BIN / "bracket.stl"))
    return part.detect(points, viewpoint=[0, 0, 0], max_instances=3)


def test_estimates_of_the_challenge_are_in_millimetres(found):
    moves = np.eye(4)
    moves[:3, 3] = [1, 2, 3]
    rows = ros.pose_estimates(found, [18], frame_from_scene=moves)
    assert [(row["obj_id"], row["score"]) for row in rows] == [(18, pose.score) for pose in found]
    for row, pose in zip(rows, found, strict=True):
        read = ros.matrix(as_message(row["pose"]))  # its numbers as they are
        np.testing.assert_allclose(read, moves @ pose.target_from_source, atol=1e-9)
    in_metres = ros.pose_estimates(found, [18], unit="m")
    assert in_metres[0]["pose"]["position"]["x"] == pytest.approx(1000 * found[0].target_from_source[0, 3])


@pytest.mark.parametrize(
    ("ids", "options", "error"),
    [
        ([], {}, "obj_ids: there are 0"),
        ([1, 2], {}, "obj_ids: there are 2"),
        ([1], {"unit": "ell"}, "unit is 'ell'"),
        ([1], {"frame_from_scene": np.eye(3)}, "frame_from_scene has shape"),
    ],
)
def test_what_is_no_estimate_is_named(found, ids, options, error):
    with pytest.raises(ibi.InputError, match=f"^{error}"):
        ros.pose_estimates(found, ids, **options)


# The node -------------------------------------------------------------------------------------------------


class Node:
    """What the node uses of rclpy's."""

    values = {}  # noqa: RUF012

    def __init__(self, name):
        self.name, self.published, self.log = name, [], []

    def declare_parameter(self, name, value):
        return SimpleNamespace(value=self.values.get(name, value))

    def create_publisher(self, kind, topic, depth):
        assert topic == "detections"
        return SimpleNamespace(publish=self.published.append)

    def get_logger(self):
        return SimpleNamespace(error=self.log.append, warning=self.log.append)

    def destroy_node(self):
        self.is_destroyed = True


class Synchronizer:
    def __init__(self, subscribers, queue_size):
        self.subscribers = subscribers

    def registerCallback(self, callback):
        self.callback = callback


def fill(message, fields):
    message.__dict__.update(fields)


@pytest.fixture
def node(monkeypatch):
    """The module of the example, among modules that stand in for those of ROS."""
    events = []
    modules = {
        "rclpy": {"init": lambda: events.append("init"), "try_shutdown": lambda: events.append("shutdown")},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"QoSProfile": dict, "ReliabilityPolicy": SimpleNamespace(BEST_EFFORT=2)},
        "rosidl_runtime_py": {"set_message_fields": fill},
        "message_filters": {
            "Subscriber": lambda node, kind, topic, qos_profile: topic,
            "TimeSynchronizer": Synchronizer,
        },
        "sensor_msgs": {},
        "sensor_msgs.msg": {"Image": object, "CameraInfo": object},
        "vision_msgs": {},
        "vision_msgs.msg": {"Detection3DArray": SimpleNamespace},
    }
    for name, held in modules.items():
        module = ModuleType(name)
        module.__dict__.update(held)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(
        Node, "values", {"model": str(BIN / "bracket.stl"), "timeout_s": 600.0, "min_score": 0.5}
    )
    spec = importlib.util.spec_from_file_location("ibi_node", ROOT / "examples/ros2/ibi_node.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.events = events
    return module


def test_the_node_publishes_what_is_in_an_image(node, found):
    finder = node.Finder()
    assert finder.images.subscribers == ["depth", "camera_info"]
    finder.images.callback(image(METRES, "32FC1"), INFO)
    (message,) = finder.published
    assert message.header["frame_id"] == HEADER.frame_id
    assert message.header["stamp"] == {"sec": 12, "nanosec": 34}
    assert len(message.detections) >= len(found)
    places = [list(one["results"][0]["pose"]["pose"]["position"].values()) for one in message.detections]
    for pose in found:  # metres
        assert np.linalg.norm(np.array(places) - pose.target_from_source[:3, 3] / 1000, axis=1).min() < 0.002


def test_the_node_goes_on_after_an_image_that_cannot_be_searched(node):
    finder = node.Finder()
    finder.images.callback(image(STEPS, "rgb8"), INFO)
    assert finder.published == []
    assert "encoding is 'rgb8'" in finder.log[0]


@pytest.mark.parametrize("ends_by", [KeyboardInterrupt, None])
def test_the_node_ends_cleanly(node, ends_by):
    seen = []

    def spin(finder):
        seen.append(finder)
        if ends_by is not None:
            raise ends_by

    node.rclpy.spin = spin
    node.main()
    assert node.events == ["init", "shutdown"]
    assert seen[0].is_destroyed
