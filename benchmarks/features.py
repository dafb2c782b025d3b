"""Time the built-in features against other programs on the same arrays; print a table, write a record.

    python benchmarks/features.py

Runs alternate, ours and the other's, so that what else the machine does meets both. FPFH, normals and
thinning: Open3D, with the same neighbours; and FPFH is compared number by number. Matching: scipy's kd-tree,
which is exact, too, and the product of matrices.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import ibi_rs as ibi
import numpy as np
import open3d as o3d
from frame import cli, records
from frame.tables import head, line, show
from frame.timing import in_turn
from ibi_rs import features
from numpy.typing import NDArray
from scipy.spatial import cKDTree

OFF = 1e-3
"""FPFH counts as equal up to this; a histogram has a sum of 200."""


@dataclass(frozen=True)
class Task:
    """One row of the table: the same work, done twice."""

    name: str
    data: str
    ours: Callable[[], Any]
    other: str
    theirs: Callable[[], Any]
    difference: Callable[[Any, Any], str] = lambda ours, theirs: ""


def sheet_and_ball(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Make a noisy, wavy sheet of 2 x 2 with a ball of radius 0.4 on it, and normals by their formulas."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-1, 1, (2, count // 2))
    sheet = np.stack([x, y, 0.1 * np.sin(4 * x) * np.cos(3 * y)], axis=1)
    slopes = [-0.4 * np.cos(4 * x) * np.cos(3 * y), 0.3 * np.sin(4 * x) * np.sin(3 * y), np.ones_like(x)]
    ball = rng.normal(size=(count - count // 2, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    points = np.concatenate([sheet, 0.4 * ball + [0, 0, 0.5]]) + rng.normal(0, 0.005, (count, 3))
    normals = np.concatenate([np.stack(slopes, axis=1), ball])
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def in_open3d(points: NDArray[np.float64], normals: NDArray[np.float64] | None = None) -> Any:
    """Copy a cloud, beforehand: conversion is not timed."""
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    if normals is not None:
        cloud.normals = o3d.utility.Vector3dVector(normals)
    return cloud


def rows_off(ours: NDArray[np.float32], theirs: NDArray[np.float64]) -> str:
    """Count the rows that an angle at the edge of a bin tells apart, and say how far."""
    off = np.abs(ours - theirs).max(axis=1)
    return f"{(off > OFF).sum()} of {len(off)}, at most {off.max():.2g}"


def turned(ours: NDArray[np.float64], theirs: Any) -> str:
    """Say how far normals differ but for their sign."""
    cos = np.abs(np.einsum("ni,ni->n", ours, np.asarray(theirs.normals)))
    return f"at most {np.arccos(np.minimum(cos, 1)).max():.1g} rad"


def equal_rows(ours: Any, theirs: NDArray[np.int64]) -> str:
    """Count the pairs that differ."""
    return f"{(ours[0][:, 0] != theirs.ravel()).sum()} of {theirs.size} pairs"


def by_matrices(model: NDArray[np.float32], scene: NDArray[np.float32], k: int) -> NDArray[np.int64]:
    """Find the nearest rows by |a|^2 + |b|^2 - 2 a b, in parts that fit into memory."""
    a, b = model.astype(np.float64), scene.astype(np.float64)
    near = []
    for part in np.array_split(b, len(b) // 2000 + 1):
        dist_sq = np.sum(part**2, axis=1)[:, None] + np.sum(a**2, axis=1) - 2 * part @ a.T
        some = np.argpartition(dist_sq, k, axis=1)[:, :k]
        order = np.argsort(np.take_along_axis(dist_sq, some, axis=1), axis=1)
        near.append(np.take_along_axis(some, order, axis=1))
    return np.concatenate(near)


def fpfh_task(
    data: str, points: NDArray[np.float64], normals: NDArray[np.float64], radius: float, most: int
) -> Task:
    """Describe all points."""
    around = np.mean([len(rows) for rows in cKDTree(points).query_ball_point(points[::50], radius)])
    cloud, search = in_open3d(points, normals), o3d.geometry.KDTreeSearchParamHybrid(radius, most)
    return Task(
        "FPFH",
        f"{data}, {around:.0f} around, at most {most}",
        lambda: features.fpfh(points, normals, radius, most),
        "Open3D",
        lambda: np.asarray(o3d.pipelines.registration.compute_fpfh_feature(cloud, search).data).T,
        rows_off,
    )


def match_task(
    data: str,
    model: NDArray[np.float32],
    scene: NDArray[np.float32],
    k: int,
    other: str,
    search: Callable[[], NDArray[np.int64]] | None = None,
) -> Task:
    """Find the nearest descriptors; the other's search is by products of matrices unless it is given."""
    theirs = search or partial(by_matrices, model, scene, k)
    return Task("match", data, partial(ibi.match, model, scene, k=k), other, theirs, equal_rows)


def tasks() -> Iterator[Task]:
    """Make the rows, one after the other."""
    points, normals = sheet_and_ball(30_000)
    data = "sheet and ball, 30000 points"
    yield fpfh_task(data, points, normals, 0.045, 100)
    yield fpfh_task(data, points, normals, 0.07, 150)
    yield fpfh_task(data, points, normals, 0.1, 100)
    with np.load(records.ROOT / "examples/tee/tee6.npz") as file:
        scan = {name: file[name].astype(np.float64) for name in ("src", "tgt", "src_normals", "tgt_normals")}
        voxel = float(file["voxel"])
    size = f"scan tee6, {len(scan['tgt'])} points"
    yield fpfh_task(size, scan["tgt"], scan["tgt_normals"], 6 * voxel, 150)

    cloud = in_open3d(points)

    def open3d_normals() -> Any:
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(0.045, 30))
        return cloud

    yield Task(
        "normals",
        f"{data}, at most 30 around",
        lambda: features.estimate_normals(points, 0.045, 30),
        "Open3D",
        open3d_normals,
        turned,
    )
    many, _ = sheet_and_ball(300_000)
    dense = in_open3d(many)
    yield Task(
        "voxels",
        "sheet and ball, 300000 points, voxel 0.02",
        lambda: features.voxel_downsample(many, 0.02)[0],
        "Open3D",
        lambda: dense.voxel_down_sample(0.02),
        lambda ours, theirs: f"{len(ours)} and {len(theirs.points)} points",
    )
    described, k = features.fpfh(points, normals, 0.07, 150), 2
    for count in (2000, 5000):
        model = features.fpfh(*sheet_and_ball(count), 0.15, 150)
        pair = f"FPFH, {count} x 30000, k {k}"
        search = partial(cKDTree(model.astype(np.float64)).query, described, k=k, workers=-1)
        yield match_task(pair, model, described, k, "scipy kd-tree", lambda search=search: search()[1])
        yield match_task(pair, model, described, k, "numpy")
    rng = np.random.default_rng(0)
    learned, queries = (rng.normal(size=(rows, 256)).astype(np.float32) for rows in (2000, 6000))
    yield match_task("random, 256 numbers, 2000 x 6000, k 2", learned, queries, k, "numpy")


def main() -> None:
    """Print the table line by line, as Markdown, and write the record."""
    args = cli.parse(__doc__, cli.repeats(7))
    heads = ("what", "data", "ours ms", "other", "other ms", "times as fast", "difference")
    show(head(heads))
    record = []
    for task in tasks():
        difference = task.difference(task.ours(), task.theirs())  # and both are warm
        seconds = in_turn([task.ours, task.theirs], args.repeats)
        ours, theirs = (f"{ms:.1f}" for ms in 1e3 * np.median(seconds, axis=0))
        ratio = f"{np.median(seconds[:, 1] / seconds[:, 0]):.1f}"
        cells = (task.name, task.data, ours, task.other, theirs, ratio, difference)
        show(line(cells))
        record.append({"version": ibi.__version__, **dict(zip(heads, cells, strict=True))})
    records.write(records.RECORDS, "features.csv", record)


if __name__ == "__main__":
    main()
