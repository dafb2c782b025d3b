"""Says which shapes are near-copies of each other: a scene with both has false poses that fit.

For each two meshes of a folder that can share a scene (both symmetric or neither, as benchmarks/symmetry.py
says, which runs before) it searches the motion that leaves the least deviation: the root mean square distance
from the points of either to the nearest point of the other, less what the sampling itself causes. Both are
centred in the unit sphere, as the layouts have them.

Below 0.08 radii two shapes count as near-copies. There is no gap in the values to put the threshold in. It is
about the spacing of the 256 points that stand for a shape in the ECC layout (0.07 radii on average): to the
nearest points of two samples such shapes are one.

    python benchmarks/near_copies.py examples/models     # prints the closest, writes like into its index.json
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from itertools import combinations
from pathlib import Path

import numpy as np
from frame import cli
from frame.layouts import index, write_index
from ibi_rs import synth
from scipy.spatial import cKDTree
from symmetry import alignments

THRESHOLD = 0.08
STARTS = 40
NUM_REFERENCE, NUM_PROBE = 2000, 200


class Shape:
    """Two samples of a mesh in the unit sphere: one to measure to, one to measure from."""

    def __init__(self, path: Path) -> None:
        points = synth.sample_mesh(path, NUM_REFERENCE + NUM_PROBE, np.random.default_rng(0))[0]
        points = points - points.mean(axis=0)
        points = points / np.linalg.norm(points, axis=1).max()
        self.tree, self.probe = cKDTree(points[:NUM_REFERENCE]), points[NUM_REFERENCE:]
        self.noise_sq = np.mean(self.tree.query(self.probe)[0] ** 2)


def deviation(pair: tuple[Shape, Shape]) -> float:
    """Least deviation of two shapes over all motions, in radii."""
    best = np.inf
    for a, b in (pair, pair[::-1]):  # ICP moves one onto the other: a part onto the whole, say
        for turn, shift in alignments(a.probe, b.tree, np.zeros(3), STARTS):
            there = b.tree.query(a.probe @ turn.T + shift)[0]
            back = a.tree.query((b.probe - shift) @ turn)[0]
            best = min(best, np.mean([there**2, back**2]) - (a.noise_sq + b.noise_sq) / 2)
    return float(np.sqrt(max(best, 0.0)))


def main() -> None:
    """Run over a folder."""
    folder = cli.parse(__doc__, cli.option("folder", type=Path, help="of PLY meshes with index.json")).folder
    entries = index(folder)
    shapes = {entry["file"]: Shape(folder / entry["file"]) for entry in entries}
    pairs = [(a["file"], b["file"]) for a, b in combinations(entries, 2) if a["symmetric"] == b["symmetric"]]
    with ProcessPoolExecutor() as pool:
        values = list(pool.map(deviation, [(shapes[a], shapes[b]) for a, b in pairs], chunksize=8))
    like: dict[str, set[str]] = {file: set() for file in shapes}
    for value, (a, b) in sorted(zip(values, pairs, strict=True)):
        if value < THRESHOLD:
            like[a].add(b)
            like[b].add(a)
        if value < 1.25 * THRESHOLD:
            print(f"{a:28s} {b:28s} {value:.3f} radii {'near-copies' * (value < THRESHOLD)}")
    write_index(folder, "like", {file: sorted(others) for file, others in like.items()})


if __name__ == "__main__":
    main()
