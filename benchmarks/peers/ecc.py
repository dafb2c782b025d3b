"""ECC, efficient correspondence clustering, written from the paper's description; numpy alone.

W. Tang and D. Zou, "Multi-instance Point Cloud Registration by Efficient Correspondence Clustering", CVPR
2022. The defaults are the paper's, in data units: shapes lie in the unit sphere. The published program was
not looked at.

It is to be a fair opponent in speed, too: all pairs at once through BLAS, a product with the few non-zero
rows for each merge, and the nearest neighbour of each cluster is kept and not searched for anew.
"""

from __future__ import annotations

import numpy as np
from ibi_rs import synth
from numpy.typing import NDArray

from .contract import Register

Array = NDArray[np.float64]


def version() -> str:
    """Name what stands here: no published program."""
    return "own, from the paper"


def prepare(
    scene: synth.Scene,
    *,
    samples: int = 1024,
    consistency: float = 0.9,
    reach: float = 2.0,
    t_merge: float = 0.2,
    inlier: float = 0.3,
    t_iou: float = 0.8,
    min_members: int = 10,
    t_count: float = 0.5,
) -> Register:
    """Cluster correspondences by what they are compatible with.

    Parameters
    ----------
    samples : int
        So many correspondences, drawn at random, are clustered.
    consistency, reach : float
        See `compatibility`.
    t_merge : float
        Clusters nearer than this are merged.
    inlier : float
        Largest distance of a correspondence from its model.
    t_iou : float
        Of two models whose inliers overlap more than this, the earlier is dropped.
    min_members, t_count : int, float
        A pose has at least so many correspondences, and at least this share of the first pose's.
    """
    del scene

    def register(scene: synth.Scene) -> Array:
        src, tgt = scene.src[scene.corr[:, 0]], scene.tgt[scene.corr[:, 1]]
        drawn = np.random.default_rng(0).permutation(len(src))[:samples]
        label = clusters(compatibility(src[drawn], tgt[drawn], consistency, reach), t_merge)
        label, number = _compact(label, 3)
        if number == 0:
            return np.empty((0, 4, 4))
        models = fit(src[drawn], tgt[drawn], label, number)
        models = models[distinct(residuals(models, src, tgt) < inlier, t_iou)]
        for least in (*(min(3 * 3**i, len(src) / 100) for i in range(3)), min_members):
            label, number = _compact(assign(residuals(models, src, tgt), inlier), max(3, least))
            if number == 0:
                return np.empty((0, 4, 4))
            models = fit(src, tgt, label, number)
        count = np.bincount(label[label >= 0])
        order = np.argsort(-count, kind="stable")
        return models[order[count[order] >= t_count * count.max()]]

    return register


def compatibility(
    src: Array, tgt: Array, consistency: float = 0.9, reach: float = 2.0
) -> NDArray[np.float32]:
    """How well two correspondences can belong to one instance.

    (g / consistency)^2 max(0, 1 - (mean length / reach)^2), divided by its maximum, where g is the ratio of
    the shorter to the longer of the two distances, between the source points and between the target points.
    `consistency` therefore cancels out; it is here because the paper has it.

    Parameters
    ----------
    src, tgt : (n, 3) float64
        Matched points.
    consistency, reach : float

    Returns
    -------
    (n, n) float32
    """
    a, b = _distances(src), _distances(tgt)
    longer = np.maximum(a, b)
    g = np.divide(np.minimum(a, b), longer, out=np.zeros_like(a), where=longer > 0)
    np.fill_diagonal(g, 1)
    g /= consistency
    g *= g
    a += b
    a *= 0.5 / reach
    g *= np.maximum(0, 1 - a * a)
    return g / g.max()


def _distances(points: Array) -> NDArray[np.float32]:
    # Axis by axis: as fast as through a product, and exact near zero in single precision, too.
    total = np.zeros((len(points), len(points)), dtype=np.float32)
    for axis in (points - points.mean(axis=0)).T.astype(np.float32):
        apart = axis[:, None] - axis
        apart *= apart
        total += apart
    return np.sqrt(total, out=total)


def clusters(preference: NDArray[np.float32], t_merge: float = 0.2) -> NDArray[np.int64]:
    """Merge the two nearest clusters again and again, while they are nearer than `t_merge`.

    A cluster is a row of the matrix, that of two merged is their element-wise minimum. The distance is
    Tanimoto's, 1 - uv / (uu + vv - uv), and 1 between two rows of zeros.

    Parameters
    ----------
    preference : (n, m) float32
        Not negative. For ECC the compatibility with each other, for T-Linkage the preference of hypotheses.
    t_merge : float

    Returns
    -------
    (n,) int64
        The cluster of each, numbered by a member.
    """
    n = len(preference)
    by_row = preference.T.copy()  # a cluster is a column here: its few non-zero rows are taken whole
    by_cluster = preference.copy()  # and a row here
    product = preference @ preference.T
    norm = np.diagonal(product).copy()
    union = norm[:, None] + norm - product
    dist = 1 - np.divide(product, union, out=np.zeros_like(union), where=union > 0)
    np.fill_diagonal(dist, np.inf)
    nearest = dist.argmin(axis=1)
    least = dist[np.arange(n), nearest]
    label, dead = np.arange(n), np.zeros(n, dtype=bool)
    for _ in range(n - 1):
        i = int(least.argmin())
        if not least[i] < t_merge:
            break
        j = int(nearest[i])
        merged = np.minimum(by_cluster[i], by_cluster[j])
        rows = np.flatnonzero(merged)
        was = np.flatnonzero(by_cluster[i])
        by_row[was, i] = merged[was]
        by_cluster[i] = merged
        label[label == j] = i
        dead[j] = True

        product = merged[rows] @ by_row[rows]
        norm[i] = merged[rows] @ merged[rows]
        union = norm[i] + norm - product
        row = 1 - np.divide(product, union, out=np.zeros_like(union), where=union > 0)
        row[i] = row[dead] = np.inf
        dist[i] = dist[:, i] = row
        dist[j] = dist[:, j] = np.inf

        # Those that lost their nearest look for a new one, unless the merged cluster is nearer still.
        nearer = row <= least
        lost = np.flatnonzero(((nearest == i) | (nearest == j)) & ~nearer & ~dead)
        nearest[nearer], least[nearer] = i, row[nearer]
        if len(lost):
            nearest[lost] = dist[lost].argmin(axis=1)
            least[lost] = dist[lost, nearest[lost]]
        nearest[i] = row.argmin()
        least[i], least[j] = row[nearest[i]], np.inf
    return label


def fit(src: Array, tgt: Array, label: NDArray[np.int64], number: int) -> Array:
    """Fit a pose to each label's pairs by least squares.

    Parameters
    ----------
    src, tgt : (n, 3) float64
        Matched points.
    label : (n,) int64
        Below 0 for none.
    number : int
        Of labels; each has pairs.

    Returns
    -------
    (number, 4, 4) float64
    """
    rows = np.flatnonzero(label >= 0)
    rows = rows[np.argsort(label[rows], kind="stable")]
    starts = np.searchsorted(label[rows], np.arange(number))
    count = np.diff(np.append(starts, len(rows)))
    p, q = src[rows], tgt[rows]
    p_mean, q_mean = (np.add.reduceat(x, starts) / count[:, None] for x in (p, q))
    p, q = p - np.repeat(p_mean, count, axis=0), q - np.repeat(q_mean, count, axis=0)
    covariance = np.add.reduceat(q[:, :, None] * p[:, None, :], starts)
    u, _, vt = np.linalg.svd(covariance)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    poses = np.tile(np.eye(4), (number, 1, 1))
    poses[:, :3, :3] = u @ vt
    poses[:, :3, 3] = q_mean - np.einsum("kij,kj->ki", poses[:, :3, :3], p_mean)
    return poses


def fit_groups(src: Array, tgt: Array, label: NDArray[np.int64], least: int) -> Array:
    """Fit a pose to each label of at least so many pairs, the largest group first, (K, 4, 4)."""
    count = np.bincount(label[label >= 0], minlength=1)
    kept = np.flatnonzero(count >= least)
    kept = kept[np.argsort(-count[kept], kind="stable")]
    if not len(kept):
        return np.empty((0, 4, 4))
    number = np.full(len(count), -1)
    number[kept] = np.arange(len(kept))
    return fit(src, tgt, np.where(label >= 0, number[label], -1), len(kept))


def residuals(models: Array, src: Array, tgt: Array) -> Array:
    """Transfer error of each pair (columns) under each model (rows).

    The paper's is symmetric; a rigid pose keeps lengths, so that both directions have the same error.
    """
    # |Rp + t - q|^2 multiplied out is linear in q p', p and q: one product for all models.
    center = tgt.mean(axis=0)
    tgt, shift = tgt - center, models[:, :3, 3] - center
    rotation = models[:, :3, :3]
    of_model = [
        -2 * rotation.reshape(-1, 9),
        2 * np.einsum("ki,kij->kj", shift, rotation),
        -2 * shift,
        np.sum(shift**2, axis=1, keepdims=True),
        np.ones((len(models), 1)),
    ]
    of_pair = [
        (tgt[:, :, None] * src[:, None, :]).reshape(-1, 9),
        src,
        tgt,
        np.ones((len(src), 1)),
        np.sum(src**2, axis=1, keepdims=True) + np.sum(tgt**2, axis=1, keepdims=True),
    ]
    dist_sq: Array = np.hstack(of_model) @ np.hstack(of_pair).T
    return np.sqrt(np.maximum(dist_sq, 0, out=dist_sq), out=dist_sq)


def distinct(inliers: NDArray[np.bool_], t_iou: float = 0.8) -> NDArray[np.bool_]:
    """Mark the models, rows of `inliers`, that no later one overlaps by more than `t_iou`."""
    members = inliers.astype(np.float32)
    common = members @ members.T
    count = np.diagonal(common)
    union = count[:, None] + count - common
    return ~np.any(np.triu(common > t_iou * union, k=1), axis=1)


def assign(residual: Array, inlier: float) -> NDArray[np.int64]:
    """Nearest model of each pair, -1 where none is nearer than `inlier`."""
    label = residual.argmin(axis=0)
    return np.where(residual[label, np.arange(residual.shape[1])] < inlier, label, -1)


def _compact(label: NDArray[np.int64], least: float) -> tuple[NDArray[np.int64], int]:
    """Renumber the labels of at least so many members from 0; the rest become -1."""
    count = np.bincount(label[label >= 0], minlength=1)
    kept = count >= least
    number = np.where(kept, np.cumsum(kept) - 1, -1)
    return np.where(label >= 0, number[label], -1), int(kept.sum())
