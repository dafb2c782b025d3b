"""Seeded scenes with known truth: the outlier-ratio layout and the ECC layout.

References
----------
.. [1] W. Tang and D. Zou, "Multi-instance Point Cloud Registration by Efficient Correspondence Clustering",
   CVPR 2022. Both layouts follow its synthetic data.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .descriptors import dense_descriptors, nearest
from .scene import INLIER_DISTANCE, Array, Scene, labels, move
from .shapes import DENSE_POINTS, SHAPES, catalogue, shape, to_unit_sphere

__all__ = ["ecc_layout", "outlier_layout"]

_JITTER_CLIP = 0.05  # per axis: 0.05 * sqrt(3) = 0.087 < INLIER_DISTANCE, so an exact pair stays a true pair
_CLUTTER_SIDE = 10.0
_DISTANCE = (2.5, 12.5)  # of an object from the origin
_MIN_TRUE = 10  # true pairs per instance

# One stream of random numbers per purpose: changing the descriptor noise, say, leaves the geometry of a seed
# as it was.
_ECC, _OUTLIER = 1, 2
_DRAW, _POSES, _POINTS, _CLUTTER, _MATCHES, _SHUFFLE = range(6)


def outlier_layout(
    seed: int,
    *,
    outlier_ratio: float | tuple[float, float] = (0.7, 0.9),
    num_instances: int | tuple[int, int] = (5, 20),
    num_correspondences: int | tuple[int, int] = (1000, 5000),
    shape: str | ArrayLike | None = None,
    exact: bool = True,
    jitter: float = 0.01,
    num_points: int = 1024,
    num_clutter: int = 1000,
    min_spacing: float = 1.0,
) -> Scene:
    """Mix true pairs with random outliers at a given ratio.

    The ratio, the number of instances and the number of correspondences are drawn uniformly from their
    ranges. Each instance gets at least 10 true pairs. Where a draw cannot give that, the range of the number
    of correspondences is narrowed first; only if its end is reached is the ratio moved, never out of its
    range. A random outlier that happens to be a true pair (within `INLIER_DISTANCE`) is drawn again, so the
    ratio holds exactly.

    Parameters
    ----------
    seed : int
        Non-negative; the same seed and arguments give the same scene.
    outlier_ratio : float or (float, float)
        Share of outliers, at least 0 and below 1.
    num_instances, num_correspondences : int or (int, int)
        One number, or a range that includes both ends.
    shape : str, (n, 3) array_like or None
        Name of a built-in shape, a cloud (moved into the unit sphere), or None: the seed chooses a built-in
        shape.
    exact : bool
        True: an instance is the moved source plus jitter, and a true pair joins a source row with its own
        copy. False: source and instances share no surface point, and a true pair joins an instance point with
        the nearest source point, if within `INLIER_DISTANCE`, as in real scans.
    jitter : float
        Standard deviation of the noise per coordinate of the target, in shape radii, clipped at 0.05.
    num_points : int
        Points of the source and of each instance. A cloud with fewer points gives as many as it has (with
        ``exact=False`` half as many, as it is split).
    num_clutter : int
        Target points uniform in [0, 10]^3.
    min_spacing : float
        Smallest distance between instance centres, in shape radii, so that no two truths can be taken for
        one. Where no room is left, the widest place found is taken.

    Returns
    -------
    Scene
        Target rows [k * n, (k + 1) * n) are instance k.

    Raises
    ------
    ValueError
        If an argument is out of range, or if no number of correspondences and no ratio within the ranges
        gives every instance its 10 true pairs.

    Examples
    --------
    >>> from ibi_rs import synth
    >>> scene = synth.outlier_layout(0, outlier_ratio=0.9, num_instances=5, num_correspondences=1000)
    >>> scene.num_instances, scene.corr.shape
    (5, (1000, 2))
    """
    ratio_lo, ratio_hi = (
        outlier_ratio if isinstance(outlier_ratio, (tuple, list)) else (outlier_ratio, outlier_ratio)
    )
    if not 0 <= ratio_lo <= ratio_hi < 1:
        raise ValueError(f"outlier_ratio must lie in [0, 1), got {outlier_ratio}")
    if jitter < 0 or num_points < _MIN_TRUE or num_clutter < 0:
        raise ValueError(f"jitter and num_clutter must be at least 0 and num_points at least {_MIN_TRUE}")
    draw = _rng(seed, _OUTLIER, _DRAW)
    k = int(draw.integers(*_range("num_instances", num_instances), endpoint=True))
    ratio = draw.uniform(ratio_lo, ratio_hi)
    chosen = SHAPES[draw.integers(len(SHAPES))] if shape is None else shape

    pool, label = _pool(chosen, _rng(seed, _OUTLIER, _POINTS, 0))
    src = pool[:num_points] if exact else pool[: min(num_points, len(pool) // 2)]
    poses = _poses(k, _rng(seed, _OUTLIER, _POSES), min_spacing)
    points_rng = _rng(seed, _OUTLIER, _POINTS, 1)
    instances, pairs = [], []
    for i, pose in enumerate(poses):
        if exact:
            model, rows = src, np.arange(len(src))
        else:
            model = pool[len(src) + points_rng.choice(len(pool) - len(src), len(src), replace=False)]
            rows, _ = nearest(model, src)
        moved = move(pose, model) + _jitter(model.shape, jitter, points_rng)
        candidates = np.stack([rows, i * len(src) + np.arange(len(model))], axis=1)
        close = np.linalg.norm(move(pose, src[rows]) - moved, axis=1) <= INLIER_DISTANCE
        instances.append(moved)
        pairs.append(candidates[close])
    tgt = np.vstack([*instances, _rng(seed, _OUTLIER, _CLUTTER).uniform(0, _CLUTTER_SIDE, (num_clutter, 3))])

    matches = _rng(seed, _OUTLIER, _MATCHES)
    m, num_true = _plan(ratio, (ratio_lo, ratio_hi), num_correspondences, pairs, draw)
    pairs = [matches.permutation(p) for p in pairs]
    rest = matches.permutation(np.vstack([p[_MIN_TRUE:] for p in pairs]))
    true = np.vstack([*(p[:_MIN_TRUE] for p in pairs), rest])[:num_true]
    corr = np.vstack([true, _outliers(m - num_true, src, tgt, poses, matches)])
    corr = _rng(seed, _OUTLIER, _SHUFFLE).permutation(corr)
    return Scene(src, tgt, corr, poses, f"outlier-{seed:04d}-{label}")


def ecc_layout(
    seed: int,
    *,
    shapes: Mapping[str, tuple[Array, Array | None]] | str | Path | None = None,
    descriptors: Callable[[Array, Array | None], NDArray[Any]] | None = None,
    descriptor_noise: float = 0.02,
    jitter: float = 0.01,
    num_objects: int = 20,
    num_points: int = 256,
    num_clutter: int = 1000,
) -> Scene:
    """Scatter objects of several classes and match their descriptors to one of them.

    The synthetic layout of Tang and Zou [1]_. With m drawn from 5 to 10 and the number of classes from 1 to
    m, each object gets a class at random, and one of the classes used is the source; the rest distract. So K
    runs from 1 to 20 and is about 7 on average. Source and objects are drawn independently from the same
    surface: no exact pairs exist. Objects may interpenetrate.

    PAPER: the descriptors there are learned. Here they are FPFH [2]_ of the dense shape at three radii (0.15,
    0.3, 0.5), each scaled to unit length, with noise added for each drawn point: real confusions between like
    surfaces included. Over seeds 0 to 15, K is 6.6 on average (7.3 over 5000 seeds) and the share of true
    correspondences is

    ================  =====  =====  =====
    descriptor noise  0.02   0.1    0.3
    ================  =====  =====  =====
    example meshes    7.5 %  2.5 %  0.8 %
    built-in shapes   10 %   3.0 %  0.8 %
    ================  =====  =====  =====

    Parameters
    ----------
    seed : int
        Non-negative; the same seed and arguments give the same scene. Across machines the last bits of Open3D
        and BLAS may differ, and with them a few of the matches; the points and the poses do not depend on
        either.
    shapes : mapping, str, pathlib.Path or None
        Name -> (points, normals or None) of dense clouds, or a folder of PLY meshes (see `sample_mesh`; the
        repository's ``examples/models`` is one), or None: the built-in shapes. None does not look for files,
        so that a seed means one scene wherever the package is installed.
    descriptors : callable or None
        ``descriptors(points, normals)`` of a dense cloud within the unit sphere, (n, 3) and (n, 3) or None
        where the shape has no normals, gives an (n, D) array of finite numbers: learned descriptors, for
        instance. It must not depend on chance if a seed is to mean one scene. None: the FPFH above, D = 99.
    descriptor_noise : float
        Standard deviation of the noise on each descriptor entry.
    jitter : float
        Standard deviation of the noise per coordinate, in shape radii, clipped at 0.05, on source and objects
        alike.
    num_objects, num_points, num_clutter : int
        Objects in the target, points of the source and of each object, and points uniform in [0, 10]^3.

    Returns
    -------
    Scene
        One correspondence per target point: its nearest source point in descriptor space. A clutter point
        lies on no surface and has no descriptor that could prefer one source point to another: it gets a
        random one, and a similarity drawn from those of the other points. Target rows
        [i * num_points, (i + 1) * num_points) are object i, distractors among them.

    Raises
    ------
    ImportError
        If `descriptors` is None and Open3D is not installed; the message names the extra that brings it.
    ValueError
        If an argument is out of range, a shape has fewer than `num_points` points, or `descriptors` gives no
        (n, D) array of finite numbers.

    References
    ----------
    .. [1] W. Tang and D. Zou, "Multi-instance Point Cloud Registration by Efficient Correspondence
       Clustering", CVPR 2022.
    .. [2] R. B. Rusu, N. Blodow and M. Beetz, "Fast Point Feature Histograms (FPFH) for 3D Registration",
       ICRA 2009.

    Examples
    --------
    >>> from ibi_rs import synth
    >>> scene = synth.ecc_layout(3, descriptors=lambda points, normals: points, num_objects=4)
    >>> scene.corr.shape, scene.similarity.shape
    ((2024, 2), (2024,))
    """
    if descriptor_noise < 0 or jitter < 0 or num_objects < 1 or num_points < 2 or num_clutter < 0:
        raise ValueError("noise, jitter and num_clutter must be at least 0, num_objects 1 and num_points 2")
    loaders = catalogue(shapes)
    draw = _rng(seed, _ECC, _DRAW)
    num_classes = min(int(draw.integers(1, draw.integers(5, 10, endpoint=True), endpoint=True)), len(loaders))
    names = [list(loaders)[i] for i in draw.choice(len(loaders), num_classes, replace=False)]
    object_class = draw.integers(num_classes, size=num_objects)
    source_class = int(draw.choice(np.unique(object_class)))

    dense = {c: loaders[names[c]]() for c in np.unique(object_class).tolist()}
    describe = dense_descriptors if descriptors is None else descriptors
    dense_described: dict[int, NDArray[Any]] = {}
    points_rng, noise_rng = _rng(seed, _ECC, _POINTS), _rng(seed, _ECC, _MATCHES)

    def sample(c: int) -> tuple[Array, Array]:
        points, normals = dense[c]
        if len(points) < num_points:
            raise ValueError(
                f"shape {names[c]!r} has {len(points)} points, fewer than num_points = {num_points}"
            )
        rows = points_rng.choice(len(points), num_points, replace=False)
        if c not in dense_described:
            dense_described[c] = _checked_descriptors(describe(points, normals), len(points))
        described = dense_described[c][rows]
        noise = noise_rng.normal(0, descriptor_noise, described.shape)
        return points[rows] + _jitter((num_points, 3), jitter, points_rng), described + noise

    src, src_described = sample(source_class)
    poses = _poses(num_objects, _rng(seed, _ECC, _POSES), 0.0)
    objects, objects_described = [], []
    for pose, c in zip(poses, object_class.tolist(), strict=True):
        points, described = sample(c)
        objects.append(move(pose, points))
        objects_described.append(described)
    clutter_rng = _rng(seed, _ECC, _CLUTTER)
    tgt = np.vstack([*objects, clutter_rng.uniform(0, _CLUTTER_SIDE, (num_clutter, 3))])

    rows, similarity = nearest(np.vstack(objects_described), src_described)
    rows = np.concatenate([rows, clutter_rng.integers(len(src), size=num_clutter)])
    similarity = np.concatenate([similarity, clutter_rng.choice(similarity, num_clutter)])
    order = _rng(seed, _ECC, _SHUFFLE).permutation(len(tgt))
    corr = np.stack([rows, np.arange(len(tgt))], axis=1)[order]
    name = f"ecc-{seed:04d}-{names[source_class]}"
    return Scene(src, tgt, corr, poses[object_class == source_class], name, similarity[order])


def _rng(seed: int, *keys: int) -> np.random.Generator:
    return np.random.default_rng([seed, *keys])


def _checked_descriptors(value: Any, num_points: int) -> NDArray[Any]:
    described: NDArray[Any] = np.asarray(value)
    if described.ndim != 2 or len(described) != num_points or described.dtype.kind not in "fiu":
        raise ValueError(
            f"descriptors gave shape {described.shape} of {described.dtype}; "
            f"it must be ({num_points}, D) real numbers"
        )
    if not np.isfinite(described).all():
        raise ValueError("descriptors gave numbers that are not finite")
    return described


def _range(name: str, value: int | tuple[int, int]) -> tuple[int, int]:
    lo, hi = value if isinstance(value, (tuple, list)) else (value, value)
    if not 1 <= lo <= hi:
        raise ValueError(f"{name} must be a number from 1 or a range in order, got {value}")
    return int(lo), int(hi)


def _jitter(size: tuple[int, ...], sigma: float, rng: np.random.Generator) -> Array:
    return np.clip(rng.normal(0, sigma, size), -_JITTER_CLIP, _JITTER_CLIP)


def _rotation(rng: np.random.Generator) -> Array:
    """Uniform rotation: a normalised Gaussian quaternion has no preferred direction."""
    q = rng.normal(size=4)
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _poses(k: int, rng: np.random.Generator, min_spacing: float) -> Array:
    """Uniform rotations; centres in a random direction of the positive octant, 2.5 to 12.5 from the origin.

    A centre nearer than `min_spacing` to an earlier one is drawn again, up to 200 times; then the best draw
    is kept.
    """
    poses = np.tile(np.eye(4), (k, 1, 1))
    for i in range(k):
        poses[i, :3, :3] = _rotation(rng)
        best = -1.0
        for _ in range(200):
            direction = np.abs(rng.normal(size=3))
            center = direction / np.linalg.norm(direction) * rng.uniform(*_DISTANCE)
            spacing = np.linalg.norm(poses[:i, :3, 3] - center, axis=1).min(initial=np.inf)
            if spacing > best:
                best, poses[i, :3, 3] = spacing, center
            if spacing >= min_spacing:
                break
    return poses


def _pool(chosen: str | ArrayLike, rng: np.random.Generator) -> tuple[Array, str]:
    """Surface points in random order to draw source and instances from, and the name of the shape."""
    if isinstance(chosen, str):
        return shape(chosen, DENSE_POINTS, rng)[0], chosen
    points = np.asarray(chosen, dtype=np.float64)
    if (
        points.ndim != 2
        or points.shape[1] != 3
        or len(points) < 2 * _MIN_TRUE
        or not np.isfinite(points).all()
    ):
        raise ValueError(f"a shape must be an (n, 3) array of at least {2 * _MIN_TRUE} finite points")
    return rng.permutation(to_unit_sphere(points)), "cloud"


def _plan(
    ratio: float,
    band: tuple[float, float],
    num_correspondences: int | tuple[int, int],
    pairs: list[NDArray[np.int64]],
    rng: np.random.Generator,
) -> tuple[int, int]:
    """How many correspondences, and how many of them true; `outlier_layout` tells what yields first."""
    lo, hi = _range("num_correspondences", num_correspondences)
    need, available = _MIN_TRUE * len(pairs), sum(map(len, pairs))
    fit_lo = max(lo, math.ceil(need / (1 - ratio)))
    fit_hi = min(hi, math.floor(available / (1 - ratio)))
    span = (fit_lo, fit_hi) if fit_lo <= fit_hi else ((hi, hi) if fit_lo > hi else (lo, lo))
    m = int(rng.integers(*span, endpoint=True))
    # Half a pair of slack, as a share given as one number is seldom a whole number of pairs.
    least = max(need, math.ceil(m * (1 - band[1]) - 0.5))
    most = min(available, math.floor(m * (1 - band[0]) + 0.5))
    if least > most or min(map(len, pairs)) < _MIN_TRUE:
        raise ValueError(
            f"{m} correspondences at an outlier ratio of {band[0]} to {band[1]} cannot give {len(pairs)} "
            f"instances {_MIN_TRUE} true pairs each out of {available}; change one of these, or num_points"
        )
    return m, min(max(round(m * (1 - ratio)), least), most)


def _outliers(
    count: int, src: Array, tgt: Array, poses: Array, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Random pairs of rows, none of which a true pose explains."""
    pairs = np.empty((0, 2), dtype=np.int64)
    while len(pairs) < count:
        drawn = rng.integers([len(src), len(tgt)], size=(count - len(pairs), 2))
        pairs = np.vstack([pairs, drawn[labels(src, tgt, drawn, poses, INLIER_DISTANCE) < 0]])
    return pairs
