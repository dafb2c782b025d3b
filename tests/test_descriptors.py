"""Descriptors of others to poses: what networks give, in the forms in which they give it."""

from pathlib import Path

import ibi_rs as ibi
import numpy as np
import pytest

with np.load(Path(__file__).parents[1] / "examples/tee/tee6.npz") as file:
    SRC, TGT, TRUTH = file["src"], file["tgt"], file["poses"]
    SRC_NORMALS, TGT_NORMALS = file["src_normals"], file["tgt_normals"]
MODEL = ibi.Model(SRC, normals=SRC_NORMALS)


class Tensor:
    """What PyTorch hands over: DLPack and nothing else."""

    def __init__(self, array):
        self.array = array

    def __dlpack__(self, **options):
        return self.array.__dlpack__(**options)

    def __dlpack_device__(self):
        return self.array.__dlpack_device__()


def network(points, normals):
    """A random layer over FPFH, in single precision: keypoints off the points, descriptors, scores."""
    weights = np.random.default_rng(0).normal(size=(33, 32))
    features = np.maximum(ibi.features.fpfh(points, normals, 6 * MODEL.spacing) @ weights, 0)
    scores = np.linalg.norm(features, axis=1)
    moved = points + np.random.default_rng(1).normal(0, 1e-4, points.shape)
    return moved.astype(np.float32), (features / np.maximum(scores, 1e-9)[:, None]).astype(np.float32), scores


SRC_KEYS, SRC_FEATURES, _ = network(SRC, SRC_NORMALS)
TGT_KEYS, TGT_FEATURES, TGT_SCORES = network(TGT, TGT_NORMALS)


def num_right(corr, similarity):
    found = MODEL.register(
        TGT,
        corr,
        ibi.Params.single_view(),
        tgt_normals=TGT_NORMALS,
        viewpoint=[0, 0, 0],
        similarity=similarity,
    )
    score = ibi.metrics.score_scene(found, TRUTH, criterion=ibi.metrics.ADD_S, model=SRC)
    assert score.num_predicted == score.num_predicted_hit
    return score.num_truth_hit


@pytest.mark.parametrize("form", [np.asarray, Tensor], ids=["numpy", "DLPack"])
def test_keypoints_with_descriptors_give_poses(form):
    pairs, similarity = ibi.match(form(SRC_FEATURES), form(TGT_FEATURES), k=4)
    corr = np.hstack([SRC_KEYS[pairs[:, 0]], TGT_KEYS[pairs[:, 1]]])
    assert num_right(form(corr), form(similarity)) >= 5


def test_a_batch_is_cut_by_its_lengths():
    lengths = [len(SRC), len(TGT)]
    stacked = np.concatenate([SRC_FEATURES, TGT_FEATURES])
    src, tgt = np.split(stacked, np.cumsum(lengths)[:-1])
    for one, other in zip(ibi.match(src, tgt, k=4), ibi.match(SRC_FEATURES, TGT_FEATURES, k=4), strict=True):
        np.testing.assert_array_equal(one, other)


def test_keypoints_of_high_scores_are_enough():
    best = np.argsort(-TGT_SCORES)[: 3 * len(TGT) // 4]
    pairs, similarity = ibi.match(SRC_FEATURES, TGT_FEATURES[best], k=4)
    assert num_right(np.column_stack([pairs[:, 0], best[pairs[:, 1]]]), similarity) >= 4


def test_matches_of_the_network_itself_are_read(tmp_path):
    pairs, similarity = ibi.match(SRC_FEATURES, TGT_FEATURES, k=4)
    np.savez(
        tmp_path / "a.npz",
        src_corr_points=SRC_KEYS[pairs[:, 0]],
        tgt_corr_points=TGT_KEYS[pairs[:, 1]],
        scores=20 * similarity - 10,  # logits
    )
    held = ibi.datasets.read_correspondences(tmp_path / "a.npz")
    assert num_right(held.corr, held.similarity) >= 5
