"""Whether poses are as far off as they say: prints a table, records every pose.

    make bench-covariance
    python benchmarks/covariance.py --half tuning --scenes 6
    python benchmarks/covariance.py --detect --scenes 2

Bins of four kinds with four of each, and each kind alone in a bin (`ibi_rs.synth.bin_scene`); a pixel sees
0.8 mm, the noise is 0.5 mm, half of it shared by neighbouring pixels. Told is of poses within a tenth of the
diameter (root mean square over the points, modulo symmetry): the square of how far each is off in deviations
(Mahalanobis), 6 on average where all is well; how far the centre is off; and the share within 2 degrees.

Correspondences are those of the truth and half as many at random, of what is visible to 0.4: it is asked how
good the poses are and not which are found. With --detect they are found by `Model.detect`.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import ibi_rs as ibi
import numpy as np
from frame import cli, records, tables
from frame.layouts import FIRST_SEED
from frame.records import Row
from ibi_rs import synth
from ibi_rs.synth.casting import inverse
from ibi_rs.synth.scene import move
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

KINDS = {
    "tuning": ("bracket-a", "flange-a", "bolt-a", "clip-a"),
    "reporting": ("bracket-b", "flange-b", "bolt-b", "clip-b"),
}
PIXEL_MM, NOISE_MM = 0.8, 0.5
VISIBLE = 0.4
Array = NDArray[np.float64]


@cache
def model_of(kind: str) -> ibi.Model:
    """Make the model of a part, with the symmetries that are found."""
    return ibi.Model.from_mesh(*synth.part_mesh(kind), symmetries="find")


def bin_of(kinds: tuple[str, ...], seed: int) -> synth.Bin:
    """Fill a bin with four of each of several kinds, or set down one part."""
    meshes = [synth.part_mesh(kind) for kind in kinds]
    voxel = np.mean([np.linalg.norm(np.ptp(points, axis=0)) for points, _ in meshes]) / 24
    crowd = {"num_instances": 4} if len(kinds) > 1 else {"num_instances": 1, "layers": 0.15}
    return synth.bin_scene(meshes, seed=seed, pixel=PIXEL_MM / voxel, noise=NOISE_MM / voxel, **crowd)


def found_with_truth(scene: synth.Bin, kind: int, model: ibi.Model) -> ibi.Registration:
    """Register with correspondences of the truth, and some of none."""
    eye = scene.eyes[0]
    matches = model.correspond(scene.points, viewpoint=eye)
    tree, pairs = cKDTree(matches.tgt), []
    for pose in scene.poses[(scene.kinds == kind) & (scene.visibility > VISIBLE)]:
        points, normals = move(pose, model.points), model.normals @ pose[:3, :3].T
        far, row = tree.query(points, distance_upper_bound=0.8 * model.voxel)
        is_near = np.isfinite(far) & (np.sum(normals * (eye - points), axis=1) > 0)
        of_row = matches.tgt_normals[np.where(is_near, row, 0)]
        is_near &= np.sum(of_row * normals, axis=1) > 0.8
        pairs.append(np.stack([np.flatnonzero(is_near), row[is_near]], axis=1))
    corr = np.concatenate([np.zeros((0, 2), dtype=np.int64), *pairs])
    rng = np.random.default_rng(len(corr))
    strays = rng.integers([len(model.points), len(matches.tgt)], size=(len(corr) // 2, 2))
    return model.register(
        matches.tgt,
        np.concatenate([corr, strays]),
        ibi.Params.single_view(),
        tgt_normals=matches.tgt_normals,
        viewpoint=ibi.View(eye, scene.points),
    )


def rows(where: str, scene: synth.Bin, kinds: tuple[str, ...], detect: bool) -> Iterator[Row]:
    """Tell how far each pose is off that is right."""
    for kind, name in enumerate(kinds):
        model = model_of(name)
        if detect:
            found = model.detect(scene.points, viewpoint=scene.eyes[0])
        elif ((scene.kinds == kind) & (scene.visibility > VISIBLE)).any():
            found = found_with_truth(scene, kind, model)
        else:
            continue
        for pose in found:
            truths = [model.symmetries.nearest(t, pose.target_from_source) for t in scene.of_kind(kind)[0]]
            moved = move(pose.target_from_source, model.points)
            off = [np.sqrt(np.mean(np.sum((move(t, model.points) - moved) ** 2, axis=1))) for t in truths]
            best = int(np.argmin(off))
            if off[best] > 0.1 * model.diameter:
                continue
            motion = truths[best] @ inverse(pose.target_from_source)
            turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
            shift = move(motion, pose.centre[None])[0] - pose.centre
            error = np.concatenate([turn, shift])
            known = pose.covariance
            yield {
                "where": where,
                "part": name,
                "mahalanobis": "" if known is None else f"{error @ np.linalg.solve(known, error):.3f}",
                "shift_mm": f"{np.linalg.norm(shift):.4f}",
                "turn_deg": f"{np.degrees(np.linalg.norm(turn)):.4f}",
                "score": f"{pose.score:.4f}",
                "free": str(len(pose.free_motions)),
                "version": ibi.__version__,
            }


def line(name: str, of: list[Row]) -> tuple[str, ...]:
    """Sum up some poses."""
    column = {
        key: np.array([float(row[key] or "nan") for row in of])
        for key in ("mahalanobis", "shift_mm", "turn_deg")
    }
    far = column["mahalanobis"]
    return (
        name,
        str(len(of)),
        f"{np.nanmean(far):.2f}",
        f"{np.nanmedian(far):.2f}",
        f"{np.nanpercentile(far, 95):.1f}",
        f"{np.median(column['shift_mm']):.3f}",
        f"{np.median(column['turn_deg']):.2f}",
        f"{np.mean(column['turn_deg'] < 2):.2f}",
    )


HEAD = ("poses of", "number", "mean", "median", "95 %", "shift mm", "turn deg", "within 2 deg")


def main() -> None:
    """Run, print, record."""
    detect = cli.flag("--detect", "find the poses by Model.detect")
    args = cli.parse(
        __doc__, cli.HALF, cli.scenes(12, "bins, and as many of each part alone"), detect, cli.out()
    )
    cli.machine()
    kinds, first = KINDS[args.half], FIRST_SEED[args.half]
    told: list[Row] = []
    for seed in range(first, first + args.scenes):
        told += rows("bin", bin_of(kinds, seed), kinds, args.detect)
        for kind in kinds:
            told += rows("alone", bin_of((kind,), seed), (kind,), args.detect)
    lines = []
    for where in ("bin", "alone"):
        here = [row for row in told if row["where"] == where]
        parts = [(f"{where}: {kind}", [row for row in here if row["part"] == kind]) for kind in kinds]
        lines += [line(name, of) for name, of in [*parts, (f"{where}: all", here)] if of]
    print(tables.markdown(HEAD, lines))
    records.write(args.records, "covariance.csv", told)


if __name__ == "__main__":
    main()
