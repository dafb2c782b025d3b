"""`View`: what a depth camera saw, and what it changes."""

import pickle

import ibi_rs as ibi
import numpy as np
import pytest
from test_detect import CAMERA, example


def test_an_organised_depth_image_is_a_view():
    depth = np.full((4, 6), 2.0)
    depth[0, 0], depth[1, 1], depth[2, 2] = 0, np.nan, np.inf
    motion = np.eye(4)
    motion[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    motion[:3, 3] = [1, 2, 3]
    plain = ibi.View.from_depth(depth, 100, 200, 2.5, 1.5)
    moved = ibi.View.from_depth(depth, 100, 200, 2.5, 1.5, target_from_camera=motion)
    assert plain.points.shape == (21, 3)
    np.testing.assert_array_equal(plain.eye, [0, 0, 0])
    np.testing.assert_allclose(plain.points[-1], [2.5 / 100 * 2, 1.5 / 200 * 2, 2])
    np.testing.assert_array_equal(moved.eye, [1, 2, 3])
    np.testing.assert_allclose(moved.points, plain.points @ motion[:3, :3].T + motion[:3, 3])
    again = pickle.loads(pickle.dumps(moved))
    np.testing.assert_array_equal(again.points, moved.points)
    assert not moved.points.flags.writeable
    assert repr(moved) == "View(21 points from [1, 2, 3])"


def test_all_that_was_measured_tells_more_than_the_target():
    # The part in front of a measured wall: half a metre before it there is nothing.
    mesh, scan, labels = example("two")
    model = ibi.Model.from_mesh(*mesh)
    matches = model.correspond(scan, viewpoint=CAMERA)
    through = np.array(labels[0])
    through[:3, 3] *= 0.6  # nearer to the camera, where nothing is

    def overlap(pose, viewpoint):
        params = ibi.Params.single_view().replace(
            te=lambda context, dense: pose, hv="none", refine="none", max_rounds=1
        )
        found = model.register(
            matches.tgt, matches.corr, params, tgt_normals=matches.tgt_normals, viewpoint=viewpoint
        )
        return found[0].overlap

    view = ibi.View(CAMERA, scan)
    assert overlap(labels[0], view) > 0.9
    assert overlap(through, view) == 0
    # Behind a board nothing counts that the board hides, and nothing else lies on anything.
    x, y = np.mgrid[-0.1:0.1:0.001, -0.1:0.1:0.001]
    board = np.stack([x, y, np.full_like(x, 0.3)], axis=-1).reshape(-1, 3)
    assert overlap(labels[0], ibi.View(CAMERA, board)) == 0
    # Points at the place of the target say the same as the target itself.
    own = overlap(labels[0], ibi.View(CAMERA, matches.tgt))
    assert own == overlap(labels[0], CAMERA)


def test_detection_takes_the_camera_either_way():
    mesh, scan, _ = example("two")
    model = ibi.Model.from_mesh(*mesh)
    plain = model.detect(scan, viewpoint=CAMERA)
    np.testing.assert_array_equal(model.detect(scan, viewpoint=ibi.View(CAMERA, scan)), plain)
    assert len(plain) == 2


def moved_by(motion):
    return ibi.View.from_depth(np.ones((2, 2)), 1, 1, 0, 0, target_from_camera=motion)


SHIFTED = np.eye(4)
SHIFTED[:3, 3] = [1, 2, 3]
MOTIONS = [
    (SHIFTED.T, "no rigid motion"),
    (2 * np.eye(4), "no rigid motion"),
    (np.diag([2.0, 2, 2, 1]), "no rigid motion"),
    (np.diag([-1.0, 1, 1, 1]), "no rigid motion"),
    (np.zeros((4, 4)), "no rigid motion"),
    (np.full((4, 4), 1e300), "no rigid motion"),
    (np.full((4, 4), np.nan), "a value that is not finite"),
]
CAMERAS = [
    ((np.nan, 1, 0, 0), "fx and fy are nan and 1"),
    ((np.inf, 1, 0, 0), "fx is inf; it must be finite"),
    ((1, 1, np.nan, 0), "cx is nan"),
    ((1, 1, 0, np.inf), "cy is inf"),
]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ibi.View([0, 0], np.zeros((3, 3))), r"viewpoint has shape \(2,\)"),
        (lambda: ibi.View(CAMERA, np.zeros((3, 2))), r"viewpoint.points has shape \(3, 2\)"),
        (lambda: ibi.View.from_depth(np.ones(3), 1, 1, 0, 0), r"depth has shape \(3,\)"),
        (lambda: ibi.View.from_depth(np.zeros((2, 2)), 1, 1, 0, 0), "depth: no pixel has one"),
        (lambda: ibi.View.from_depth(np.ones((2, 2)), 0, 1, 0, 0), "fx and fy are 0 and 1"),
        (
            lambda: ibi.View.from_depth(np.ones((2, 2)), 1, 1, 0, 0, target_from_camera=np.eye(3)),
            r"target_from_camera has shape \(3, 3\)",
        ),
        (
            lambda: ibi.View([np.nan, 0, 0], np.zeros((3, 3))),
            r"viewpoint is \[nan, 0.0, 0.0\]; it must be finite",
        ),
        *((lambda motion=motion: moved_by(motion), message) for motion, message in MOTIONS),
        *(
            (lambda camera=camera: ibi.View.from_depth(np.ones((2, 2)), *camera), message)
            for camera, message in CAMERAS
        ),
    ],
)
def test_bad_views_are_refused_by_name(call, message):
    with pytest.raises(ibi.InputError, match=message):
        call()


def test_points_that_are_not_finite_were_not_measured():
    view = ibi.View(CAMERA, [[0, 0, 1], [np.nan, 0, 1], [0, np.inf, 1]])
    assert (len(view.points), view.num_dropped) == (1, 2)
    view = ibi.View.from_depth([[0, np.nan, 1], [np.inf, 2, -1]], 1, 1, 0, 0)
    assert (len(view.points), view.num_dropped) == (2, 4)
    assert pickle.loads(pickle.dumps(view)).num_dropped == 4


def test_organised_points_are_taken():
    image = np.arange(24.0).reshape(2, 4, 3)
    np.testing.assert_array_equal(ibi.View(CAMERA, image).points, image.reshape(-1, 3))
