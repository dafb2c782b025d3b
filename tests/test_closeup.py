"""Poses looked at close up, on all that was measured: a pile of six parts with the table left in."""

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import metrics
from small_piles import small_pile
from test_detect import EXAMPLES
from test_features import box

VERTICES, FACES = ibi.io.read_mesh(EXAMPLES / "models/ind_small_part.ply")
VERTICES = 1000 * VERTICES  # millimetres
EYE = np.zeros(3)


@pytest.fixture(scope="module")
def pile():
    return small_pile(VERTICES, FACES, noise=0.05, pixel=0.3)


@pytest.fixture(scope="module")
def part():
    return ibi.Model.from_mesh(VERTICES, FACES)


@pytest.fixture(scope="module")
def found(pile, part):
    return part.detect(pile.points, viewpoint=EYE)


def test_parts_are_found_and_settled_at_full_resolution(pile, part, found):
    score = metrics.score_scene(found, pile.poses, criterion=metrics.ADD_S, model=part.points)
    assert (score.num_truth_hit, score.precision) == (6, 1.0)
    # Voxels are a 24th of the size; all points tell more. One lies so that it looks much the same turned.
    assigned = [min(metrics.add_s(part.points, p.target_from_source, t) for t in pile.poses) for p in found]
    assert np.median(assigned) < 0.01 * part.diameter


def test_a_pose_says_what_was_measured(found):
    for pose in found:
        of = pose.measures
        assert of.supported > 10 * (of.contradicted + of.buried)
        assert of.ends > of.runs_on
        assert of.on > 10 * of.beyond
        assert len(of.losses) == 3
        assert 0.01 < of.noise < 0.12
        assert pose.score > 0.5


def test_a_slab_on_the_table_is_not_believed(pile):
    # As thick as a voxel: the table has the face, and goes on where the slab ends.
    size = np.linalg.norm(np.ptp(VERTICES, axis=0))
    corners, faces = box(size * np.array([0.6, 0.4, 0.05]))
    found = ibi.Model.from_mesh(corners, faces).detect(pile.points, viewpoint=EYE, remove_plane=False)
    assert len(found) == 0
    objections = {"contradicted", "runs_on", "overrun", "slips", "loose"}
    assert {pose.objection for pose in found.rejected} <= objections
    scores = [pose.score for pose in found.rejected]
    assert scores == sorted(scores, reverse=True)
    assert 0 < len(scores) <= 100
    assert max(scores) < 0.5


@pytest.mark.parametrize("num_threads", [1, 2, 7])
def test_the_same_bits_on_any_number_of_threads(pile, part, found, num_threads):
    again = part.detect(pile.points, viewpoint=EYE, num_threads=num_threads)
    assert np.array_equal(np.asarray(again), np.asarray(found))
    assert [pose.score for pose in again] == [pose.score for pose in found]
    assert [pose.measures for pose in again] == [pose.measures for pose in found]
    assert [pose.score for pose in again.rejected] == [pose.score for pose in found.rejected]


def test_where_no_more_than_the_target_was_measured_there_is_nothing_to_look_at(pile, part):
    matched = part.correspond(pile.points, viewpoint=EYE)
    result = part.register(
        matched.tgt, matched.corr, ibi.Params.single_view(), tgt_normals=matched.tgt_normals, viewpoint=EYE
    )
    assert len(result) > 0
    assert result.rejected == ()
    assert all(pose.measures is None for pose in result)
