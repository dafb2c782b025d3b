"""Says which shapes look the same after a turn: they cannot be scored by a rotation error.

For each mesh of a folder (or each built-in shape) it searches, over random rotations polished by ICP, the
motion more than 20 degrees (ECC's threshold) from the identity that leaves the least deviation: the root mean
square distance to the nearest point of the shape, less what the sampling itself causes, in radii of the
shape. Below 0.03 radii, well under the spacing of a 256-point sample, it counts as symmetric.

Beside it stands the group that `ibi_rs.find_symmetries` finds on the same points, and its seconds. It asks
for more: each point has to find its place, not their mean, and the motions have to be a group.

    python benchmarks/symmetry.py examples/models     # prints the table, writes symmetric into its index.json
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import ibi_rs as ibi
import numpy as np
from frame import cli
from frame.layouts import write_index
from frame.tables import show
from frame.timing import timed
from ibi_rs import synth
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

THRESHOLD = 0.03


def deviation(points: np.ndarray, starts: int = 300) -> tuple[float, float]:
    """Least deviation of another pose in shape radii, and the angle of that pose in degrees."""
    points = points - (points.min(axis=0) + points.max(axis=0)) / 2
    points = np.random.default_rng(0).permutation(points / np.linalg.norm(points, axis=1).max())
    reference, probe = points[:3000], points[3000:3400]
    tree = cKDTree(reference)
    noise_sq = np.mean(tree.query(probe)[0] ** 2)
    centre = reference.mean(axis=0)
    best = (np.inf, 0.0)
    for turn, shift in alignments(probe, tree, centre, starts):
        angle = np.degrees(Rotation.from_matrix(turn).magnitude())
        if angle > 20:
            other_sq = np.mean(tree.query(probe @ turn.T + shift)[0] ** 2)
            best = min(best, (float(np.sqrt(max(other_sq - noise_sq, 0.0))), float(angle)))
    return best


def alignments(
    probe: np.ndarray, tree: cKDTree, centre: np.ndarray, starts: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield motions of the probe onto the tree's points: random rotations about a centre, polished by ICP."""
    for rotation in Rotation.random(starts, random_state=1):
        turn = rotation.as_matrix()
        shift = centre - turn @ centre
        for _ in range(12):
            _, rows = tree.query(probe @ turn.T + shift)
            turn, shift = fit(probe, tree.data[rows])
        yield turn, shift


def fit(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rigid motion of least squares."""
    p, q = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - q).T @ (source - p))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return turn, q - turn @ p


def main() -> None:
    """Run over a folder."""
    what = "folder of PLY meshes; default: the built-in shapes"
    folder = cli.parse(__doc__, cli.option("folder", type=Path, nargs="?", help=what)).folder
    sample = synth.sample_mesh if folder else synth.shape
    paths = sorted(folder.glob("*.ply")) if folder else []
    named = [(path.name, path) for path in paths] if folder else [(name, name) for name in synth.SHAPES]
    symmetric = {}
    for name, shape in named:
        points = sample(shape, 3400, np.random.default_rng(0))[0]
        value, angle = deviation(points)
        symmetric[name] = value < THRESHOLD
        seconds, group = timed(ibi.find_symmetries, points)
        found = f"{value:.3f} radii at {angle:3.0f} degrees {'symmetric' * symmetric[name]:9s}"
        show(f"{name:28s} {found}  {group} in {seconds:.2f} s")
    if folder:
        write_index(folder, "symmetric", symmetric)


if __name__ == "__main__":
    main()
