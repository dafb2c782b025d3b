"""Make the correspondences of a real scene from its scan: FPFH, each scene point to its nearest model points.

For every scene that `gt_pseudo.json` of the input folder labels, this writes `<scene>.npz`. The folder also
holds `model_<name>_pts.ply` (model points with normals) and `<scene>.ply` (camera at the origin, metres).

The two sets of the examples, each from the folder of its scans:

    python examples/make_matches.py SCANS/provete2 examples/provete2 --voxel 0.004 --feature-voxels 5
    python examples/make_matches.py SCANS/tee examples/tee --voxel 0.003 --feature-voxels 6 --scenes tee6

Needs Open3D: pip install 'ibi_rs[open3d]'.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

NORMAL_VOXELS, NORMAL_NEIGHBORS = 3, 30
FEATURE_NEIGHBORS = 150
INLIER_VOXELS = 3


def read_cloud(path: Path) -> Any:
    """Read a point cloud, or stop: Open3D itself only warns and goes on with an empty one."""
    cloud = o3d.io.read_point_cloud(str(path))
    if cloud.is_empty():
        raise SystemExit(f"{path}: no points could be read")
    return cloud


def downsampled_model(path: Path, voxel: float) -> Any:
    """Model points one per voxel, with the mean of the normals that the file brings."""
    model = read_cloud(path)
    if not model.has_normals():
        raise SystemExit(f"{path}: the model points have no normals")
    return model.voxel_down_sample(voxel).normalize_normals()


def downsampled_scene(path: Path, voxel: float) -> Any:
    """Scene points one per voxel, with PCA normals that face the camera at the origin."""
    scene = read_cloud(path).voxel_down_sample(voxel)
    scene.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(NORMAL_VOXELS * voxel, NORMAL_NEIGHBORS))
    scene.orient_normals_towards_camera_location(np.zeros(3))
    return scene


def fpfh(cloud: Any, radius: float) -> NDArray[np.float64]:
    """FPFH of every point, (N, 33)."""
    search = o3d.geometry.KDTreeSearchParamHybrid(radius, FEATURE_NEIGHBORS)
    histograms: NDArray[np.float64] = o3d.pipelines.registration.compute_fpfh_feature(cloud, search).data
    return np.asarray(histograms).T


def match(
    model: NDArray[np.float64], scene: NDArray[np.float64], k: int
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Join each scene row to its `k` nearest model rows in descriptor space.

    Parameters
    ----------
    model, scene : (N, D) and (Q, D) float64
    k : int
        Matches per scene point: the truth is often not the first one, as walls and edges repeat on a part.

    Returns
    -------
    corr : (Q * k, 2) int32
        [model row, scene row], ordered by scene row.
    similarity : (Q * k,) float32
        1 - (descriptor distance) / (distance to the first neighbour left out), in [0, 1].
    """
    dist_sq = np.sum(scene**2, axis=1)[:, None] + np.sum(model**2, axis=1) - 2 * scene @ model.T
    near = np.argsort(dist_sq, axis=1, kind="stable")[:, : k + 1]
    dist = np.sqrt(np.maximum(np.take_along_axis(dist_sq, near, axis=1), 0))
    similarity = 1 - dist[:, :k] / np.maximum(dist[:, k:], 1e-12)
    rows = np.repeat(np.arange(len(scene)), k)
    corr = np.stack([near[:, :k].ravel(), rows], axis=1)
    return corr.astype(np.int32), similarity.ravel().astype(np.float32)


def is_inlier(
    src: NDArray[Any], tgt: NDArray[Any], corr: NDArray[Any], poses: NDArray[Any], distance: float
) -> NDArray[np.bool_]:
    """Which correspondences each labelled pose explains, (K, M)."""
    moved = np.einsum("kij,mj->kmi", poses[:, :3, :3], src[corr[:, 0]]) + poses[:, None, :3, 3]
    close: NDArray[np.bool_] = np.linalg.norm(moved - tgt[corr[:, 1]], axis=2) <= distance
    return close


def main() -> None:
    """Read the arguments, write one npz per scene and print its figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("input", type=Path, help="folder with the scans, the model points and gt_pseudo.json")
    parser.add_argument("output", type=Path, help="folder for the npz files")
    parser.add_argument("--voxel", type=float, required=True, help="grid of the downsampling, in metres")
    parser.add_argument("--feature-voxels", type=float, default=5, help="FPFH radius in voxels (default 5)")
    parser.add_argument("--k", type=int, default=2, help="model points per scene point (default 2)")
    parser.add_argument("--scenes", nargs="*", help="names of scenes (default: all that are labelled)")
    args = parser.parse_args()

    truth = json.loads((args.input / "gt_pseudo.json").read_text())["scenes"]
    models = sorted(args.input.glob("model_*_pts.ply"))
    if len(models) != 1:
        parser.error(f"{args.input}: expected one model_*_pts.ply, found {len(models)}")
    unknown = sorted(set(args.scenes or ()) - set(truth))
    if unknown:
        parser.error(f"{args.input}: no labels for {', '.join(unknown)}")
    args.output.mkdir(parents=True, exist_ok=True)
    radius = args.feature_voxels * args.voxel
    model = downsampled_model(models[0], args.voxel)
    model_features = fpfh(model, radius)

    for name in args.scenes or truth:
        scene = downsampled_scene(args.input / f"{name}.ply", args.voxel)
        corr, similarity = match(model_features, fpfh(scene, radius), args.k)
        poses = np.array([instance["T"] for instance in truth[name]["instances"]])
        src, tgt = np.asarray(model.points), np.asarray(scene.points)
        np.savez_compressed(
            args.output / f"{name}.npz",
            src=src.astype(np.float32),
            src_normals=np.asarray(model.normals).astype(np.float32),
            tgt=tgt.astype(np.float32),
            tgt_normals=np.asarray(scene.normals).astype(np.float32),
            corr=corr,
            similarity=similarity,
            poses=poses,
            viewpoint=np.zeros(3),
            voxel=np.float64(args.voxel),
        )
        inlier = is_inlier(src, tgt, corr, poses, INLIER_VOXELS * args.voxel)
        print(
            f"{name}: {len(src)} model and {len(tgt)} scene points, {len(corr)} correspondences, "
            f"{inlier.any(axis=0).mean():.1%} within {INLIER_VOXELS} voxels of one of {len(poses)} labels "
            f"({', '.join(map(str, inlier.sum(axis=1)))})"
        )


if __name__ == "__main__":
    main()
