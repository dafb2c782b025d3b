"""How well poses are known: against the truth, in piles of which the noise is drawn anew again and again."""

import pickle

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs.synth.solids import rod
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from small_piles import move, small_pile

VERTICES, FACES = ibi.synth.part_mesh("bracket-a")
MIDDLE = (VERTICES.min(axis=0) + VERTICES.max(axis=0)) / 2
EYE = np.zeros(3)
NOISE = 0.5  # mm; a voxel has 3.5
REPEATS = 20  # of three parts


@pytest.fixture(scope="module")
def part():
    return ibi.Model.from_mesh(VERTICES, FACES)


@pytest.fixture(scope="module")
def pile():
    return small_pile(VERTICES, FACES, num_parts=3, noise=0, pixel=0.6, seed=1)


def scan(pile, rng):
    """What is near a part; less table is less to wait for."""
    points = pile.points
    points = points[
        np.min([np.linalg.norm(points - move(of, MIDDLE), axis=1) for of in pile.poses], axis=0) < 60
    ]
    return points * (
        1 + rng.normal(0, NOISE, (len(points), 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    )


def register(model, points, poses, **how):
    """With correspondences of the truth."""
    matches = model.correspond(points, viewpoint=EYE)
    tree, pairs = cKDTree(matches.tgt), []
    for pose in poses:
        at, normals = move(pose, model.points), model.normals @ pose[:3, :3].T
        far, row = tree.query(at, distance_upper_bound=0.8 * model.voxel)
        near = np.flatnonzero(np.isfinite(far) & (np.sum(normals * at, axis=1) < 0))
        pairs.append(np.stack([near, row[near]], axis=1))
    view = ibi.View(EYE, points)
    params = ibi.Params.single_view()
    told = {"tgt_normals": matches.tgt_normals, "viewpoint": view, **how}
    return model.register(matches.tgt, np.concatenate(pairs), params, **told)


def error(pose, truths):
    """What is left to the nearest truth: rotation vector and shift about the centre."""
    motions = truths @ np.linalg.inv(pose.target_from_source)
    shifts = np.array([move(motion, pose.centre) - pose.centre for motion in motions])
    turns = Rotation.from_matrix(motions[:, :3, :3]).as_rotvec()
    best = np.argmin(np.linalg.norm(shifts, axis=1) + 30 * np.linalg.norm(turns, axis=1))
    return np.concatenate([turns[best], shifts[best]])


@pytest.fixture(scope="module")
def found(part, pile):
    rng = np.random.default_rng(0)
    return [register(part, scan(pile, rng), pile.poses) for _ in range(REPEATS)]


def test_poses_are_as_far_off_as_they_say(found, pile):
    errors, squares = [], []
    for pose in (pose for registration in found for pose in registration):
        off = error(pose, pile.poses)
        if np.linalg.norm(off[:3]) < 0.2 and np.linalg.norm(off[3:]) < 3:
            errors.append(off)
            squares.append(off @ np.linalg.solve(pose.covariance, off))
    assert len(squares) >= 50
    # The mean of six is not had exactly: ends of faces count pixels, which is no normal error.
    assert 3 < np.mean(squares) < 8
    assert np.median(np.linalg.norm(np.array(errors)[:, 3:], axis=1)) < 0.3


def test_a_covariance_is_one(found):
    for pose in found[0]:
        assert (pose.covariance.shape, pose.covariance.dtype) == ((6, 6), np.float64)
        assert (np.linalg.eigvalsh(pose.covariance) > 0).all()
        np.testing.assert_allclose(pose.covariance, pose.covariance.T, rtol=1e-9)
        np.testing.assert_allclose(pose.centre, move(pose.target_from_source, MIDDLE), atol=1)


def test_threads_and_copies_of_the_model_change_nothing(part, pile):
    points = scan(pile, np.random.default_rng(5))
    one, two, copied = (
        register(model, points, pile.poses, num_threads=threads)
        for model, threads in ((part, 1), (part, 3), (pickle.loads(pickle.dumps(part)), 2))
    )
    for a, b, c in zip(one, two, copied, strict=True):
        for other in (b, c):
            assert (a.target_from_source == other.target_from_source).all()
            assert (a.covariance == other.covariance).all()


def test_without_all_that_was_measured_nothing_is_said():
    scene = ibi.synth.outlier_layout(seed=1, num_instances=3)
    for pose in ibi.Model(scene.src).register(scene.tgt, scene.corr):
        assert (pose.covariance, pose.free_motions, pose.centre.shape) == (None, (), (3,))


def test_a_rod_turns_freely_about_its_axis():
    vertices, faces = rod(6, 0, 70)
    model = ibi.Model.from_mesh(vertices, faces)
    made = small_pile(vertices, faces, num_parts=1, noise=0.1, pixel=0.3)
    (pose,) = register(model, made.points, made.poses, max_instances=1)
    (free,) = pose.free_motions
    assert (free.kind, free.point.shape) == ("turn", (3,))
    assert abs(free.direction @ made.poses[0, :3, 2]) > 0.99
    off = free.point - move(made.poses[0], np.zeros(3))
    assert np.linalg.norm(np.cross(off, free.direction)) < 1
