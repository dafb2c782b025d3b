"""The paper's loop once more, in numpy, to read it in other ways than the library does.

The paper does not say which N_downsample correspondences play, nor on which the seeds vote. The library draws
the players from those alive, anew each round, and lets the seeds vote on all alive. Here the players may also
be the first alive ones of the list, and the votes may go to the players alone. The rest is that of
`Params.paper_synthetic`, written anew: with players at random and votes on all, a naive twin of the library.
Triplets come from the 60 with most votes.
"""

from __future__ import annotations

from itertools import combinations

import ibi_rs as ibi
import numpy as np
from ibi_rs import synth
from ibi_rs.synth.scene import move
from numpy.typing import NDArray
from peers import Register
from peers.contract import model_spacing
from peers.ecc import fit, residuals
from scipy.spatial import cKDTree

Array = NDArray[np.float64]
RANKS = 60


def prepare(params: ibi.Params, *, first: bool = False, alone: bool = False) -> Register:
    """Take the players from the head of the list, or at random.

    Parameters
    ----------
    params : ibi_rs.Params
        With the stages of the paper.
    first : bool
        Whether the first `n_downsample` alive correspondences play.
    alone : bool
        Whether the seeds vote on the players alone.

    Returns
    -------
    callable
    """

    def register(scene: synth.Scene) -> Array:
        src, tgt = scene.src[scene.corr[:, 0]], scene.tgt[scene.corr[:, 1]]
        pr = (model_spacing(scene.src) + model_spacing(scene.tgt)) / 2
        tree, rng = cKDTree(scene.tgt), np.random.default_rng(params.seed)
        alive, found = np.arange(len(src)), []
        while len(alive) >= 3:
            n = min(params.scs.n_downsample, len(alive))
            players = alive[:n] if first else np.sort(rng.permutation(alive)[:n])
            seeds = players[game(src[players], tgt[players], params.delta_r_pr * pr, params.scs.n_gtm)]
            if len(seeds) < params.t_s:
                break
            asked = players if alone else alive
            votes = consistency(src[asked], tgt[asked], src[seeds], tgt[seeds], params.delta_r_pr * pr).sum(1)
            best = np.argsort(-votes, kind="stable")[: params.ce.n_vot]
            best = best[votes[best] > 0]
            dense = asked[best]
            pose = estimate(src, tgt, alive, dense, votes[best], params, pr)
            if pose is not None:
                apart = tree.query(move(pose, scene.src), distance_upper_bound=params.d_op_pr * pr)[0]
                if np.isfinite(apart).mean() > params.hv.t_overlap:
                    found.append(pose)
            if not len(dense):
                break
            alive = np.setdiff1d(alive, dense)
        return np.array(found).reshape(-1, 4, 4)

    return register


def consistency(p: Array, q: Array, p_other: Array, q_other: Array, delta: float) -> Array:
    """exp(-r^2 / delta^2) of each correspondence with each other, 0 where they share a point (Eq. 4, 5)."""
    a = np.linalg.norm(p[:, None] - p_other, axis=2)
    b = np.linalg.norm(q[:, None] - q_other, axis=2)
    return np.where((a > 0) & (b > 0), np.exp(-np.square((a - b) / delta)), 0)


def game(p: Array, q: Array, delta: float, steps: int) -> NDArray[np.bool_]:
    """Replicator dynamics and Otsu's threshold (Eq. 2, 3): mark the seeds."""
    payoff = consistency(p, q, p, q, delta)
    x = np.full(len(p), 1 / len(p))
    for _ in range(steps):
        gain = payoff @ x
        if not x @ gain > 0:
            return np.zeros(len(p), dtype=bool)
        x *= gain / (x @ gain)
    count, edges = np.histogram(x, bins=100, range=(0, x.max()))
    middle, below = (edges[1:] + edges[:-1]) / 2, np.cumsum(count)
    total, mass = below[-1], np.cumsum(count * middle)
    with np.errstate(invalid="ignore", divide="ignore"):
        between = (mass[-1] * below / total - mass) ** 2 / (below * (total - below))
    return x > edges[1:][np.nanargmax(between[:-1])]


def estimate(
    src: Array, tgt: Array, alive: NDArray[np.int64], dense: NDArray[np.int64], votes: Array,
    params: ibi.Params, pr: float,
) -> Array | None:  # fmt: skip
    """Guided sampling: of the triplets with most votes, the pose with the best MAE (Eq. 7, 8)."""
    ranks = np.array(list(combinations(range(min(RANKS, len(dense))), 3))).reshape(-1, 3)
    ranks = ranks[np.argsort(-votes[ranks].sum(axis=1), kind="stable")]
    rows = dense[ranks]
    wide = np.minimum(_height(src[rows]), _height(tgt[rows])) > params.te.min_height_pr * pr
    rows = rows[wide][: params.te.n_gsac]
    if not len(rows):
        return None
    poses = fit(src[rows.ravel()], tgt[rows.ravel()], np.repeat(np.arange(len(rows)), 3), len(rows))
    t_he = params.t_he_pr * pr
    mae = np.maximum(0, 1 - residuals(poses, src[alive], tgt[alive]) / t_he).sum(axis=1)
    return poses[mae.argmax()]


def _height(triangles: Array) -> Array:
    """Least height of triangles (H, 3, 3)."""
    sides = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    area = np.linalg.norm(
        np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1
    )
    return np.divide(area, sides, out=np.zeros_like(area), where=sides > 0)
