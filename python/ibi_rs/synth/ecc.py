"""The ECC layout: objects of several classes, described and matched to one of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .common import CLUTTER_SIDE, Layout, Purpose, jitter_noise, random_poses, stream
from .descriptors import dense_descriptors, nearest
from .scene import Array, Scene, move
from .shapes import catalogue

__all__ = ["ecc_layout"]


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
    source_present: bool = True,
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
    source_present : bool
        False: the source is a shape that no object has, and there is no pose to find (K = 0).

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
        If an argument is out of range, a shape has fewer than `num_points` points, `descriptors` gives no
        (n, D) array of finite numbers, or `source_present` is False and there is only one shape.

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
    draw = stream(seed, Layout.ECC, Purpose.DRAW)
    available = len(loaders) if source_present else len(loaders) - 1
    if available < 1:
        raise ValueError("without the source among the objects there must be at least two shapes")
    num_classes = min(int(draw.integers(1, draw.integers(5, 10, endpoint=True), endpoint=True)), available)
    names = [list(loaders)[i] for i in draw.choice(len(loaders), num_classes, replace=False)]
    object_class = draw.integers(num_classes, size=num_objects)
    used: list[int] = np.unique(object_class).tolist()
    if source_present:
        source_class = int(draw.choice(used))
    else:
        unused = [name for name in loaders if name not in {names[c] for c in used}]
        names.append(unused[draw.integers(len(unused))])
        source_class = num_classes

    dense = {c: loaders[names[c]]() for c in {*used, source_class}}
    describe = dense_descriptors if descriptors is None else descriptors
    dense_described: dict[int, NDArray[Any]] = {}
    points_rng, noise_rng = (
        stream(seed, Layout.ECC, Purpose.POINTS),
        stream(seed, Layout.ECC, Purpose.MATCHES),
    )

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
        return points[rows] + jitter_noise((num_points, 3), jitter, points_rng), described + noise

    src, src_described = sample(source_class)
    poses = random_poses(num_objects, stream(seed, Layout.ECC, Purpose.POSES), 0.0)
    objects, objects_described = [], []
    for pose, c in zip(poses, object_class.tolist(), strict=True):
        points, described = sample(c)
        objects.append(move(pose, points))
        objects_described.append(described)
    clutter_rng = stream(seed, Layout.ECC, Purpose.CLUTTER)
    tgt = np.vstack([*objects, clutter_rng.uniform(0, CLUTTER_SIDE, (num_clutter, 3))])

    rows, similarity = nearest(np.vstack(objects_described), src_described)
    rows = np.concatenate([rows, clutter_rng.integers(len(src), size=num_clutter)])
    similarity = np.concatenate([similarity, clutter_rng.choice(similarity, num_clutter)])
    order = stream(seed, Layout.ECC, Purpose.SHUFFLE).permutation(len(tgt))
    corr = np.stack([rows, np.arange(len(tgt))], axis=1)[order]
    return Scene(
        src,
        tgt,
        corr,
        poses[object_class == source_class],
        f"ecc-{seed:04d}-{names[source_class]}",
        similarity[order],
        distractors=tuple(names[c] for c in used if c != source_class),
    )


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
