"""Pictures: what they show of many parts, and outlines in depth images."""

import dataclasses

import ibi_rs as ibi
import numpy as np
import pytest
from PIL import Image
from test_cli import run
from test_depth import MESH, K, depth_image

SQUARE = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]]
CAMERA = ibi.io.Camera(100, 100, 60, 40)
SCENE = ibi.synth.outlier_layout(0, num_instances=1, num_correspondences=300, num_points=64)
FOUND = ibi.register(SCENE.src, SCENE.tgt, SCENE.corr)


def registration(places):
    """A part at each place, turned by nothing, of falling scores."""
    poses = []
    for k, place in enumerate(places):
        matrix = np.eye(4)
        matrix[:3, 3] = place
        poses.append(dataclasses.replace(FOUND[0], target_from_source=matrix, score=1 - k / 100))
    found = FOUND.at_least(0)
    found.poses = tuple(poses)
    return found


def wall(depth=12.0):
    """What a camera sees of a wall before it."""
    rows, columns = np.mgrid[:80, :120]
    return np.stack([(columns - 60) / 100, (rows - 40) / 100, np.ones_like(rows)], axis=-1) * depth


def texts(figure):
    return [text for text in figure.axes[0].texts if text.get_bbox_patch() is not None]


@pytest.mark.parametrize("kind", ["instances", "outlines"])
def test_numbers_of_80_parts_do_not_cover_each_other(kind):
    places = np.random.default_rng(0).uniform([-5, -3, 9], [5, 3, 11], (80, 3))
    places[:10] = places[0]  # one behind the other
    found = registration(places)
    if kind == "instances":
        figure = ibi.plot.instances(wall().reshape(-1, 3), SQUARE[0], found, turns_deg=[0])
    else:
        figure = ibi.plot.outlines(wall(), CAMERA, SQUARE, found)
    figure.canvas.draw()
    assert figure.axes[0].get_legend() is None
    shown = texts(figure)
    ends = [f"  {pose.score:.2f}" if kind == "outlines" else "" for pose in found]
    assert [text.get_text() for text in shown] == [f"{k}{end}" for k, end in enumerate(ends)]
    boxes = [text.get_bbox_patch().get_window_extent() for text in shown]
    for k, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:k])


def test_an_outline_is_where_the_camera_sees_the_part():
    figure = ibi.plot.outlines(wall(), CAMERA, SQUARE, registration([[2, 1, 10]]))
    ends = [path.get_extents() for lines in figure.axes[0].collections for path in lines.get_paths()]
    assert len(ends) == 2  # one under the other, so that it stands out
    for end in ends:  # (60, 40) + 100 / 10 * (2 +- 1, 1 +- 1)
        np.testing.assert_allclose(end.get_points(), [[70, 40], [90, 60]], atol=1)


def test_a_hole_has_an_outline_and_what_is_behind_the_camera_has_none():
    ring = 2.0 * np.array(SQUARE[0]), np.array(SQUARE[0])
    vertices = np.concatenate(ring)
    faces = [[i, (i + 1) % 4, 4 + i] for i in range(4)] + [
        [(i + 1) % 4, 4 + (i + 1) % 4, 4 + i] for i in range(4)
    ]
    seen = ibi.plot._projected(vertices + np.array([0, 0, 10]), CAMERA)
    mask, corner, step = ibi.plot._silhouette(seen, np.array(faces))
    inside, outside = (((np.array(at) - corner) / step).round().astype(int) for at in ((60, 40), (75, 40)))
    assert not mask[inside[1], inside[0]]
    assert mask[outside[1], outside[0]]
    figure = ibi.plot.outlines(wall(), CAMERA, SQUARE, registration([[0, 0, -10]]))
    assert not any(len(path.vertices) for lines in figure.axes[0].collections for path in lines.get_paths())


def test_the_heading_says_unit_and_viewpoint():
    found = registration([[0, 0, 10]])
    figure = ibi.plot.instances(
        wall().reshape(-1, 3), SQUARE[0], found, title="bin", unit="mm", viewpoint=[0, 0.5, -1]
    )
    assert figure.get_suptitle() == "bin\nlengths in mm; camera at 0, 0.5, -1"
    scale = [text.get_text() for text in figure.axes[0].texts if text not in texts(figure)]
    assert scale == ["2 mm"]  # of 14.4 that are to be seen
    figure = ibi.plot.outlines(wall(), CAMERA, SQUARE, found, title="bin", unit="m")
    assert figure.get_suptitle().startswith("bin\nas the camera sees it, near is light: depth 12")


def test_a_picture_shows_the_depths():
    scan = wall()
    scan[:, :60] /= 2
    (image,) = ibi.plot.outlines(scan, CAMERA, SQUARE, registration([])).axes[0].images
    shown = np.ma.filled(image.get_array(), np.nan)
    assert set(np.unique(shown)) == {-12.0, -6.0}


@pytest.mark.parametrize(
    ("tgt", "camera", "message"),
    [
        (-wall(), CAMERA, "tgt has no point before the camera"),
        (np.full((4, 4, 3), np.nan), CAMERA, "tgt has no point before the camera"),
        (wall(), ibi.io.Camera(1e6, 1e6, 0, 0), r"camera: tgt would fill \d+ x \d+ pixels"),
        (wall()[..., :2], CAMERA, "tgt has shape"),
    ],
)
def test_what_cannot_be_outlined_is_named(tgt, camera, message):
    with pytest.raises(ibi.InputError, match=f"^{message}"):
        ibi.plot.outlines(tgt, camera, SQUARE, registration([]))


def test_the_command_draws_outlines_of_a_depth_image(tmp_path):
    np.save(tmp_path / "depth.npy", depth_image())
    picture, camera = tmp_path / "found.png", ",".join(map(str, K))
    result = run(
        *("register", MESH, tmp_path / "depth.npy", "--camera", camera, "--plot", picture, "--unit", "m"),
        *("--max-instances", 2),
    )
    assert result.exit_code == 0, result.output
    with Image.open(picture) as image:
        colours = np.asarray(image.convert("RGB")).reshape(-1, 3)
    for blue_or_orange in ((31, 119, 180), (255, 127, 14)):  # the first two
        assert (np.abs(colours.astype(int) - blue_or_orange).max(axis=1) < 12).sum() > 100
