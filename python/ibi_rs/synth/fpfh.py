"""The FPFH layout: descriptors of the scene as it is, so that its outliers have structure."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from .common import CLUTTER_SIDE, Layout, Purpose, bounds, jitter_noise, random_poses, spacing, stream
from .descriptors import load_open3d, nearest
from .scene import Array, Scene, move
from .shapes import catalogue

__all__ = ["fpfh_layout"]

_NORMAL_NEIGHBORS = 16
_RADIUS_PR = 5.0
_MAX_NEIGHBORS = 100


def fpfh_layout(
    seed: int,
    *,
    shapes: Mapping[str, tuple[Array, Array | None]] | str | Path | None = None,
    num_instances: int | tuple[int, int] = (5, 12),
    num_distractors: int = 4,
    num_clutter: int = 1000,
    num_points: int = 1024,
    kept: float = 0.7,
    jitter: float = 0.01,
    min_spacing: float = 1.6,
    num_key_points: int = 256,
    num_clutter_key_points: int = 300,
) -> Scene:
    """Describe a crowded target as it is and match its key points to the model.

    Instances of one shape, distractors of others and clutter share a box of side 10. Normals and FPFH [1]_
    are computed on the model and on the whole target, neighbours of other objects and of the clutter
    included, so that wrong matches agree with one another where surfaces look alike: 90 to 99 % of the
    correspondences are outliers, and these have structure.

    Parameters
    ----------
    seed : int
        Non-negative; the same seed and arguments give the same scene. Across machines the last bits of Open3D
        and BLAS may differ, and with them a few of the matches; the points and the poses do not depend on
        either.
    shapes : mapping, str, pathlib.Path or None
        As in `ecc_layout`. What precedes a slash in a name is its category, as in ``"bathtub/bathtub_0107"``:
        distractors are of other categories than the model. A name without a slash is a category of its own.
    num_instances : int or (int, int)
        One number, or a range that includes both ends.
    num_distractors : int
        Objects of other shapes; no shape is taken twice while there are enough.
    num_clutter : int
        Target points uniform in [0, 10]^3.
    num_points : int
        Points of the model, drawn from its cloud.
    kept : float
        Share of the points that an object keeps, drawn anew for each: an instance those of the model, a
        distractor those of `num_points` of its shape.
    jitter : float
        Standard deviation of the noise per coordinate of an object, in shape radii, clipped at 0.05.
    min_spacing : float
        Smallest distance between the centres of objects, which lie in [1, 9]^3. Where no room is left, the
        widest place found is taken.
    num_key_points, num_clutter_key_points : int
        Target points that are matched: of each object, and of the clutter.

    Returns
    -------
    Scene
        With one correspondence per key point, to the model point that is nearest in descriptor space, and
        with normals: by PCA over 16 neighbours, not oriented. FPFH spans 5 times the model's spacing (the
        mean distance to the nearest other point) and at most 100 neighbours. The instances come first in the
        target, then the distractors, then the clutter.

    Raises
    ------
    ImportError
        If Open3D is not installed; the message names the extra that brings it.
    ValueError
        If an argument is out of range, a shape has fewer than `num_points` points, or there is no shape of
        another category for the distractors.

    References
    ----------
    .. [1] R. B. Rusu, N. Blodow and M. Beetz, "Fast Point Feature Histograms (FPFH) for 3D Registration",
       ICRA 2009.
    """
    size = round(kept * num_points)
    if jitter < 0 or num_distractors < 0 or not kept <= 1 or size <= _NORMAL_NEIGHBORS:
        raise ValueError(
            "jitter and num_distractors must be at least 0, kept at most 1, and kept * num_points "
            f"more than {_NORMAL_NEIGHBORS}"
        )
    if not 0 <= num_key_points <= size or not 0 <= num_clutter_key_points <= num_clutter:
        raise ValueError(
            f"key points must be among the {size} points of an object and the {num_clutter} of the clutter"
        )
    load_open3d()
    loaders = catalogue(shapes)
    draw = stream(seed, Layout.FPFH, Purpose.DRAW)
    k = int(draw.integers(*bounds("num_instances", num_instances), endpoint=True))
    chosen = list(loaders)[draw.integers(len(loaders))]
    others = [name for name in loaders if name.partition("/")[0] != chosen.partition("/")[0]]
    if num_distractors and not others:
        raise ValueError(f"no shape of another category than {chosen!r} for the distractors")
    distractors = (
        [others[i] for i in draw.choice(len(others), num_distractors, num_distractors > len(others))]
        if num_distractors
        else []
    )

    points_rng = stream(seed, Layout.FPFH, Purpose.POINTS)

    def sample(name: str) -> Array:
        points, _ = loaders[name]()
        if len(points) < num_points:
            raise ValueError(f"shape {name!r} has {len(points)} points, fewer than num_points = {num_points}")
        drawn: Array = points[points_rng.choice(len(points), num_points, replace=False)]
        return drawn

    src = sample(chosen)
    poses = random_poses(
        k + num_distractors,
        stream(seed, Layout.FPFH, Purpose.POSES),
        min_spacing,
        lambda rng: rng.uniform(1, CLUTTER_SIDE - 1, 3),
    )
    objects = []
    for pose, name in zip(poses, [None] * k + distractors, strict=True):
        points = src if name is None else sample(name)
        part = points[points_rng.choice(num_points, size, replace=False)]
        objects.append(move(pose, part + jitter_noise(part.shape, jitter, points_rng)))
    clutter = stream(seed, Layout.FPFH, Purpose.CLUTTER).uniform(0, CLUTTER_SIDE, (num_clutter, 3))
    tgt = np.vstack([*objects, clutter])

    matches = stream(seed, Layout.FPFH, Purpose.MATCHES)
    keys = [i * size + matches.choice(size, num_key_points, replace=False) for i in range(len(objects))]
    keys.append(len(objects) * size + matches.choice(num_clutter, num_clutter_key_points, replace=False))
    targets = stream(seed, Layout.FPFH, Purpose.SHUFFLE).permutation(np.concatenate(keys))
    radius = _RADIUS_PR * spacing(src)
    src_normals, src_described = _describe(src, radius)
    tgt_normals, tgt_described = _describe(tgt, radius)
    rows, similarity = nearest(tgt_described[targets], src_described)
    return Scene(
        src,
        tgt,
        np.stack([rows, targets], axis=1),
        poses[:k],
        f"fpfh-{seed:04d}-{chosen}",
        similarity,
        src_normals,
        tgt_normals,
        tuple(distractors),
    )


def _describe(points: Array, radius: float) -> tuple[Array, Array]:
    """Estimate the normal and the FPFH of every point."""
    o3d = load_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBORS))
    search = o3d.geometry.KDTreeSearchParamHybrid(radius, _MAX_NEIGHBORS)
    feature = o3d.pipelines.registration.compute_fpfh_feature(cloud, search)
    return np.array(cloud.normals), np.array(feature.data).T
