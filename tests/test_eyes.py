"""Several cameras, or one that went about: what one of them sees was seen."""

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import synth

NO_OPEN3D = "large, so not in the group of the tests: `make test-all` installs it and has these run"

MESH = synth.part_mesh("bracket-a")
AWAY = np.array([0.0, 0.0, 900.0])


@pytest.fixture(scope="module")
def model():
    return ibi.Model.from_mesh(*MESH)


@pytest.fixture(scope="module")
def around():
    """Three brackets whose surface was scanned from all sides: points, outward normals, poses."""
    rng = np.random.default_rng(5)
    model = ibi.Model.from_mesh(*MESH)
    poses = np.tile(np.eye(4), (3, 1, 1))
    for i, pose in enumerate(poses):
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        pose[:3, :3] = turn * np.linalg.det(turn)
        pose[:3, 3] = 2.0 * model.diameter * i, 0, 0
    points = np.concatenate([model.points @ pose[:3, :3].T + pose[:3, 3] for pose in poses])
    normals = np.concatenate([model.normals @ pose[:3, :3].T for pose in poses])
    return points, normals, poses


@pytest.fixture(scope="module")
def bin_of_two():
    """A bin seen by two cameras."""
    pytest.importorskip("open3d", reason=NO_OPEN3D)
    return synth.bin_scene([MESH], seed=3, num_instances=5, num_cameras=2)


def views(made):
    return [
        ibi.View.from_depth(
            image.depth, image.fx, image.fy, image.cx, image.cy, target_from_camera=image.target_from_camera
        )
        for image in made.cameras
    ]


def num_right(found, poses, model):
    reach = 0.1 * model.diameter
    return sum(
        min(ibi.metrics.add_s(model.points, pose.target_from_source, one) for one in poses) < reach
        for pose in found
    )


def same(one, other):
    assert np.array_equal(np.asarray(one), np.asarray(other))
    assert [pose.score for pose in one] == [pose.score for pose in other]


def test_without_a_viewpoint_normals_are_enough(model, around):
    points, normals, poses = around
    found = model.detect(points, tgt_normals=normals)
    assert len(found) == num_right(found, poses, model) == 3
    assert found.params == ibi.Params.many_views()
    # Looked at close up, from places that see them.
    assert all(pose.measures.supported > 100 and pose.measures.contradicted == 0 for pose in found)
    assert not found.warnings


def test_many_places_may_be_given(model, around):
    points, normals, poses = around
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(8, 3))
    eyes = points.mean(axis=0) + 9 * model.diameter * ways / np.linalg.norm(ways, axis=1, keepdims=True)
    found = model.detect(points, tgt_normals=normals, viewpoint=eyes)
    assert len(found) == num_right(found, poses, model) == 3
    assert found.params == ibi.Params.many_views()
    for num_threads in (1, 2, 3):
        same(model.detect(points, tgt_normals=normals, viewpoint=eyes, num_threads=num_threads), found)


def test_one_row_is_one_place(model, around):
    points, normals, _ = around
    seen = (AWAY - points) @ AWAY > 0
    seen &= np.einsum("ij,ij->i", normals, AWAY - points) > 0
    one, row = (model.detect(points[seen], viewpoint=eye) for eye in (AWAY, AWAY[None]))
    same(one, row)


def test_two_cameras_find_what_one_does_not_see(model, bin_of_two):
    first, second = views(bin_of_two)
    both = np.concatenate([first.points, second.points])
    found = model.detect(both, viewpoint=[first, second])
    alone = model.detect(first.points, viewpoint=first)
    right = [num_right(one, bin_of_two.poses, model) for one in (found, alone)]
    assert right[0] >= max(right[1], 1)
    assert found.params == ibi.Params.single_view()
    asked = [
        [sum((pose.measures.supported, pose.measures.contradicted, pose.measures.buried)) for pose in one]
        for one in (found, alone)
    ]
    assert np.mean(asked[0]) > np.mean(asked[1]), "two see more of a part than one"


REFUSED = [
    ([[0.0, 0.0]], ibi.InputError, r"viewpoint has shape \(1, 2\); it must be \(E, 3\)"),
    (np.empty((0, 3)), ibi.InputError, r"viewpoint has shape \(0, 3\); leave it out"),
    ([[0.0, 0.0, np.nan], [0.0, 0.0, 1.0]], ibi.InputError, r"viewpoint\[0\] is .*NaN"),
    ([ibi.View(AWAY, np.eye(3)), AWAY], TypeError, "viewpoint: beside a View there can only be others"),
]


@pytest.mark.parametrize(("viewpoint", "kind", "pattern"), REFUSED, ids=[case[2][:30] for case in REFUSED])
def test_what_is_no_place_is_refused(model, around, viewpoint, kind, pattern):
    with pytest.raises(kind, match=pattern):
        model.detect(around[0], viewpoint=viewpoint)
