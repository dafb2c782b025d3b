"""Time the built-in features against other programs on the same arrays; print a table, write a record.

    python benchmarks/features.py

Runs alternate, ours and the other's, so that what else the machine does meets both. FPFH, normals and
thinning: Open3D, with the same neighbours; and FPFH is compared number by number. Matching: scipy's kd-tree,
which is exact, too, and the product of matrices.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ibi_rs as ibi
import numpy as np
import open3d as o3d
from ibi_rs import features
from numpy.typing import NDArray
from scipy.spatial import cKDTree

ROOT = Path(__file__).parents[1]
RECORD = ROOT / "benchmarks/records/features.csv"
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


def tasks() -> Iterator[Task]:
    """Make the rows, one after the other."""
    points, normals = sheet_and_ball(30_000)
    data = "sheet and ball, 30000 points"
    yield fpfh_task(data, points, normals, 0.045, 100)
    yield fpfh_task(data, points, normals, 0.07, 150)
    yield fpfh_task(data, points, normals, 0.1, 100)
    with np.load(ROOT / "examples/tee/tee6.npz") as file:
        scan = {name: file[name].astype(np.float64) for name in ("src", "tgt", "src_normals", "tgt_normals")}
        voxel = float(file["voxel"])
    size = f"scan tee6, {len(scan['tgt'])} points"
    yield fpfh_task(size, scan["tgt"], scan["tgt_normals"], 6 * voxel, 150)

    def open3d_normals() -> Any:
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(0.045, 30))
        return cloud

    cloud = in_open3d(points)
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
    described = features.fpfh(points, normals, 0.07, 150)
    k = 2
    for count in (2000, 5000):
        model = features.fpfh(*sheet_and_ball(count), 0.15, 150)
        pair = f"FPFH, {count} x 30000, k {k}"
        tree = cKDTree(model.astype(np.float64))
        yield Task(
            "match",
            pair,
            lambda model=model: ibi.match(model, described, k=k),  # type: ignore[misc]
            "scipy kd-tree",
            lambda tree=tree: tree.query(described, k=k, workers=-1)[1],  # type: ignore[misc]
            equal_rows,
        )
        yield Task(
            "match",
            pair,
            lambda model=model: ibi.match(model, described, k=k),  # type: ignore[misc]
            "numpy",
            lambda model=model: by_matrices(model, described, k),  # type: ignore[misc]
            equal_rows,
        )
    rng = np.random.default_rng(0)
    learned, queries = rng.normal(size=(2000, 256)), rng.normal(size=(6000, 256))
    learned, queries = learned.astype(np.float32), queries.astype(np.float32)
    yield Task(
        "match",
        "random, 256 numbers, 2000 x 6000, k 2",
        lambda: ibi.match(learned, queries, k=k),
        "numpy",
        lambda: by_matrices(learned, queries, k),
        equal_rows,
    )


def timed(job: Callable[[], Any]) -> tuple[float, Any]:
    """Run a job on the clock."""
    start = time.perf_counter()
    result = job()
    return time.perf_counter() - start, result


def main() -> None:
    """Print the table line by line, as Markdown, and write the record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--repeats", type=int, default=7, help="runs of each, after one to warm up (default 7)"
    )
    repeats = parser.parse_args().repeats
    heads = ("what", "data", "ours ms", "other", "other ms", "times as fast", "difference")
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}", flush=True)
    record = []
    for task in tasks():
        difference = task.difference(timed(task.ours)[1], timed(task.theirs)[1])
        runs = np.array([[timed(task.ours)[0], timed(task.theirs)[0]] for _ in range(repeats)])
        ours, theirs = 1e3 * np.median(runs, axis=0)
        cells = (
            task.name,
            task.data,
            f"{ours:.1f}",
            task.other,
            f"{theirs:.1f}",
            f"{np.median(runs[:, 1] / runs[:, 0]):.1f}",
            difference,
        )
        print(f"| {' | '.join(cells)} |", flush=True)
        record.append({"version": ibi.__version__, **dict(zip(heads, cells, strict=True))})
    with RECORD.open("w", newline="", encoding="utf-8") as file:
        out = csv.DictWriter(file, list(record[0]), lineterminator="\n")
        out.writeheader()
        out.writerows(record)


if __name__ == "__main__":
    main()
