"""The outlier-ratio layout: true pairs mixed with random outliers."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .common import CLUTTER_SIDE, Layout, Purpose, bounds, jitter_noise, random_poses, spacing, stream
from .descriptors import nearest
from .scene import INLIER_DISTANCE, Array, Scene, labels, move
from .shapes import DENSE_POINTS, SHAPES, shape, to_unit_sphere

__all__ = ["outlier_layout"]

_MIN_TRUE = 10  # true pairs per instance
_OUTLIER_RATIO = (0.7, 0.9)


def outlier_layout(
    seed: int,
    *,
    outlier_ratio: float | tuple[float, float] | None = None,
    true_pairs: int | tuple[int, int] | None = None,
    num_instances: int | tuple[int, int] = (5, 20),
    num_correspondences: int | tuple[int, int] = (1000, 5000),
    shape: str | ArrayLike | None = None,
    exact: bool = True,
    jitter: float = 0.01,
    jitter_pr: float | None = None,
    num_points: int = 1024,
    num_clutter: int = 1000,
    min_spacing: float = 1.0,
) -> Scene:
    """Mix true pairs with random outliers, at a given ratio or with so many true pairs per instance.

    The ratio, the number of instances and the number of correspondences are drawn uniformly from their
    ranges. Each instance gets at least 10 true pairs. Where a draw cannot give that, the range of the number
    of correspondences is narrowed first; only if its end is reached is the ratio moved, never out of its
    range. A random outlier that happens to be a true pair (within `INLIER_DISTANCE`) is drawn again, so the
    ratio holds exactly. With `true_pairs` no ratio is asked for: what is not a true pair is an outlier.

    Parameters
    ----------
    seed : int
        Non-negative; the same seed and arguments give the same scene.
    outlier_ratio : float, (float, float) or None
        Share of outliers, at least 0 and below 1. None: 0.7 to 0.9, or what `true_pairs` leaves.
    true_pairs : int, (int, int) or None
        True pairs of each instance, drawn for each from this range, both ends included; in place of
        `outlier_ratio`.
    num_instances, num_correspondences : int or (int, int)
        One number, or a range that includes both ends. Without instances the target is nothing but clutter
        and every correspondence random, whatever the ratio.
    shape : str, (n, 3) array_like or None
        Name of a built-in shape, a cloud (moved into the unit sphere), or None: the seed chooses a built-in
        shape.
    exact : bool
        True: an instance is the moved source plus jitter, and a true pair joins a source row with its own
        copy. False: source and instances share no surface point, and a true pair joins an instance point with
        the nearest source point, if within `INLIER_DISTANCE`, as in real scans.
    jitter : float
        Standard deviation of the noise per coordinate of the target, in shape radii, clipped at 0.05.
    jitter_pr : float or None
        The same as a multiple of the source's spacing (the mean distance to the nearest other point), in
        place of `jitter`; still clipped at 0.05 radii.
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
        If an argument is out of range, if both `outlier_ratio` and `true_pairs` are given, or if no number of
        correspondences and no ratio within the ranges gives every instance its true pairs.

    Examples
    --------
    >>> from ibi_rs import synth
    >>> scene = synth.outlier_layout(0, outlier_ratio=0.9, num_instances=5, num_correspondences=1000)
    >>> scene.num_instances, scene.corr.shape
    (5, (1000, 2))
    """
    if outlier_ratio is not None and true_pairs is not None:
        raise ValueError("outlier_ratio and true_pairs exclude each other: give one of them")
    band = _OUTLIER_RATIO if outlier_ratio is None else outlier_ratio
    ratio_lo, ratio_hi = band if isinstance(band, (tuple, list)) else (band, band)
    if not 0 <= ratio_lo <= ratio_hi < 1:
        raise ValueError(f"outlier_ratio must lie in [0, 1), got {outlier_ratio}")
    if min(jitter, jitter_pr or 0) < 0 or num_points < _MIN_TRUE or num_clutter < 0:
        raise ValueError(f"jitter and num_clutter must be at least 0 and num_points at least {_MIN_TRUE}")
    draw = stream(seed, Layout.OUTLIER, Purpose.DRAW)
    k = int(draw.integers(*bounds("num_instances", num_instances, least=0), endpoint=True))
    if k == 0 and num_clutter < 1:
        raise ValueError("num_clutter must be at least 1 in a scene without instances")
    ratio = draw.uniform(ratio_lo, ratio_hi)
    chosen = SHAPES[draw.integers(len(SHAPES))] if shape is None else shape

    pool, label = _pool(chosen, stream(seed, Layout.OUTLIER, Purpose.POINTS, 0))
    src = pool[:num_points] if exact else pool[: min(num_points, len(pool) // 2)]
    sigma = jitter if jitter_pr is None else jitter_pr * spacing(src)
    poses = random_poses(k, stream(seed, Layout.OUTLIER, Purpose.POSES), min_spacing)
    points_rng = stream(seed, Layout.OUTLIER, Purpose.POINTS, 1)
    instances, pairs = [], []
    for i, pose in enumerate(poses):
        if exact:
            model, rows = src, np.arange(len(src))
        else:
            model = pool[len(src) + points_rng.choice(len(pool) - len(src), len(src), replace=False)]
            rows, _ = nearest(model, src)
        moved = move(pose, model) + jitter_noise(model.shape, sigma, points_rng)
        candidates = np.stack([rows, i * len(src) + np.arange(len(model))], axis=1)
        close = np.linalg.norm(move(pose, src[rows]) - moved, axis=1) <= INLIER_DISTANCE
        instances.append(moved)
        pairs.append(candidates[close])
    clutter = stream(seed, Layout.OUTLIER, Purpose.CLUTTER).uniform(0, CLUTTER_SIDE, (num_clutter, 3))
    tgt = np.vstack([*instances, clutter])

    matches = stream(seed, Layout.OUTLIER, Purpose.MATCHES)
    true = np.empty((0, 2), dtype=np.int64)
    if true_pairs is not None or k == 0:
        m = int(draw.integers(*bounds("num_correspondences", num_correspondences), endpoint=True))
        counts = _counts(1 if true_pairs is None else true_pairs, pairs, m, draw)
        true = np.vstack([true, *(matches.permutation(p)[:n] for p, n in zip(pairs, counts, strict=True))])
    else:
        m, num_true = _plan(ratio, (ratio_lo, ratio_hi), num_correspondences, pairs, draw)
        pairs = [matches.permutation(p) for p in pairs]
        rest = matches.permutation(np.vstack([p[_MIN_TRUE:] for p in pairs]))
        true = np.vstack([*(p[:_MIN_TRUE] for p in pairs), rest])[:num_true]
    corr = np.vstack([true, _outliers(m - len(true), src, tgt, poses, matches)])
    corr = stream(seed, Layout.OUTLIER, Purpose.SHUFFLE).permutation(corr)
    return Scene(src, tgt, corr, poses, f"outlier-{seed:04d}-{label}")


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


def _counts(
    true_pairs: int | tuple[int, int], pairs: list[NDArray[np.int64]], m: int, rng: np.random.Generator
) -> list[int]:
    """How many true pairs each instance gets."""
    counts: list[int] = rng.integers(*bounds("true_pairs", true_pairs), len(pairs), endpoint=True).tolist()
    if sum(counts) > m or any(n > len(p) for n, p in zip(counts, pairs, strict=True)):
        raise ValueError(
            f"{m} correspondences cannot give {len(pairs)} instances {true_pairs} true pairs each out of "
            f"{sum(map(len, pairs))}; change one of these, or num_points"
        )
    return counts


def _plan(
    ratio: float,
    band: tuple[float, float],
    num_correspondences: int | tuple[int, int],
    pairs: list[NDArray[np.int64]],
    rng: np.random.Generator,
) -> tuple[int, int]:
    """How many correspondences, and how many of them true; `outlier_layout` tells what yields first."""
    lo, hi = bounds("num_correspondences", num_correspondences)
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
