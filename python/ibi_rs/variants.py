"""The variants of the four stages, as their parameters: frozen dataclasses.

Defaults and ranges are the Rust core's; :class:`ibi_rs.Params` takes one for each stage and checks it. What a
parameter means begins as at its field there, and ``docs/parameters.md`` has it from here: tests hold the
three together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal


@dataclass(frozen=True, kw_only=True)
class Gtm:
    """SCS ``gtm``: a sample of the correspondences plays a game of mutual support (Eq. 2-4).

    Parameters
    ----------
    n_downsample
        N_downsample: correspondences that play, drawn anew each round. 3 to 16384. Memory: 4 n^2 bytes.
    n_gtm
        N_gtm: generations of the replicator. At least 1.
    payoff
        What two correspondences gain from each other. ``"gaussian"``: exp(-r^2 / delta_r^2); ``"ratio"``:
        min(a/b, b/a), with a, b the distances of their source and target points and r = abs(a - b).

    References
    ----------
    Rodola et al., "A Scale Independent Selection Process for 3D Object Recognition in Cluttered Scenes",
    2013.
    """

    variant: ClassVar[str] = "gtm"
    n_downsample: int = 1024
    n_gtm: int = 20
    payoff: Literal["gaussian", "ratio"] = "gaussian"


@dataclass(frozen=True, kw_only=True)
class LocalGtm:
    """SCS ``local_gtm``: the game of :class:`Gtm`, played by one neighbourhood at a time.

    The neighbourhoods are those of the sparse second-order compatibility graph of *all* correspondences. One
    instance cannot be pulled apart by twenty equal ones, as in the global game, and nothing is random.

    Parameters
    ----------
    tau_pr
        tau: largest rigidity of compatible correspondences, in pr. > 0.
    min_length_pr
        Correspondences nearer to each other than this, on either side, say nothing about a pose, in pr. >= 0.
    normal_tolerance
        With normals: how far the angles between two oriented points may differ, in cosine. > 0.
    second_order
        Whether an edge is weighed by what its two ends have in common, or by its own rigidity alone.
    max_degree
        Where correspondences have more compatible ones than this around them, only so many of them take part
        that they have about as many. Bounds time and memory, and keeps those down that are compatible with
        all and sundry. At least 8.
    first_look
        Where more correspondences than this lie around one, a first graph holds only so many of them, which
        is enough to find most instances in a fraction of the time. Once nothing more comes of it, a graph of
        all that are left takes its place. None: that one from the beginning. At least 8.
    n_gtm
        N_gtm: generations of the replicator. At least 1.

    References
    ----------
    Chen et al., "SC2-PCR: A Second Order Spatial Compatibility for Efficient and Robust Point Cloud
    Registration", 2022, for the second order.
    """

    variant: ClassVar[str] = "local_gtm"
    tau_pr: float = 0.9
    min_length_pr: float = 1.0
    normal_tolerance: float = 0.5
    second_order: bool = True
    max_degree: int = 80
    first_look: int | None = 256
    n_gtm: int = 20


@dataclass(frozen=True, kw_only=True)
class Nnsr:
    """SCS ``nnsr``: the correspondences with the best nearest-neighbour similarity ratio are the seeds.

    Needs ``similarity``, one for each correspondence. Seeds that may not lead again, with removal
    ``"inliers"``, give way to the next.

    Parameters
    ----------
    n_nnsr
        Seeds of a round. At least 3.

    References
    ----------
    Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", 2004.
    """

    variant: ClassVar[str] = "nnsr"
    n_nnsr: int = 20


@dataclass(frozen=True, kw_only=True)
class Hough3d:
    """SCS ``hough3d``: the correspondences that put the centroid of the source into one place are the seeds.

    Each votes for a place by the local reference frames at its two points. Frames that are not given to
    :func:`register` are computed from the clouds.

    Parameters
    ----------
    bin_pr
        Width of a cell of the accumulator, in pr. > 0.
    frame_radius_pr
        Radius of the neighbourhood that a frame is computed from, in pr. > 0. Unused where frames are given.

    References
    ----------
    Tombari & Di Stefano, "Object Recognition in 3D Scenes with Occlusions and Clutter by Hough Voting", 2010.
    Tombari, Salti & Di Stefano, "Unique Signatures of Histograms for Local Surface Description", 2010, for
    the frames.
    """

    variant: ClassVar[str] = "hough3d"
    bin_pr: float = 2.0
    frame_radius_pr: float = 6.0


@dataclass(frozen=True, kw_only=True)
class Voting:
    """CE ``voting``: every seed votes for every alive correspondence by their consistency (Eq. 5-6).

    Parameters
    ----------
    n_vot
        N_vot: size of C_d. At least 3. With removal ``"dense"`` each round takes the correspondences with the
        most votes out, so it should be about as many as one instance has.

    References
    ----------
    Yang et al., "Ranking 3D Feature Correspondences via Consistency Voting", 2019.
    """

    variant: ClassVar[str] = "voting"
    n_vot: int = 300


@dataclass(frozen=True, kw_only=True)
class Off:
    """CE ``off``: the seeds go on as they are, ranked by their share of the population."""

    variant: ClassVar[str] = "off"


@dataclass(frozen=True, kw_only=True)
class Gsac:
    """TE ``gsac``: the triplets with the largest sum of votes give a pose each; the best MAE wins (Eq. 7-8).

    Parameters
    ----------
    n_gsac
        N_gsac: triplets tried. 1 to 1,000,000.
    min_height_pr
        Triplets whose points are within this distance of one line, on either side, are skipped and counted,
        in pr. >= 0. Noise of one pr turns a thinner triangle by tens of degrees.

    References
    ----------
    Yang et al., "Toward Efficient and Robust Metrics for RANSAC Hypotheses and 3D Rigid Registration", 2021.
    """

    variant: ClassVar[str] = "gsac"
    n_gsac: int = 100
    min_height_pr: float = 2.0


@dataclass(frozen=True, kw_only=True)
class Irls:
    """TE ``irls``: least squares on the correspondences with the most votes, then on the inliers of the fit.

    Parameters
    ----------
    n_refits
        Fits after the first. 1 to 1000. To the alive correspondences within 2, 2, 1, 1, ... ``t_he``.
    """

    variant: ClassVar[str] = "irls"
    n_refits: int = 4


@dataclass(frozen=True, kw_only=True)
class Ransac:
    """TE ``ransac``: triplets drawn uniformly give a pose each; the best MAE wins (Eq. 7-8).

    Parameters
    ----------
    n_ransac
        Triplets drawn. 1 to 10,000,000.
    min_height_pr
        Triplets whose points are within this distance of one line, on either side, are skipped and counted,
        in pr. >= 0.

    References
    ----------
    Fischler & Bolles, "Random Sample Consensus", 1981.
    """

    variant: ClassVar[str] = "ransac"
    n_ransac: int = 1000
    min_height_pr: float = 2.0


@dataclass(frozen=True, kw_only=True)
class SacCot:
    """TE ``sac_cot``: the most compatible triangles give a pose each; the best MAE wins (Eq. 7-8).

    The triangles are those of the compatibility graph over the dense correspondences C_d, of which at most
    the 1024 best-ranked are its nodes.

    Parameters
    ----------
    n_sac_cot
        Triangles tried. 1 to 1,000,000. Those with the largest sum of compatibilities.
    d_cmp_pr
        d_cmp: two correspondences are compatible by exp(-r^2 / d_cmp^2), in pr. > 0.
    t_cmp
        t_cmp: least compatibility of an edge. 0 to 1.
    max_triangles
        Triangles looked at, at most; a round that has come so far is ``capped``. 1 to 1,000,000,000.
    min_height_pr
        Triangles whose points are within this distance of one line, on either side, are skipped and counted,
        in pr. >= 0.

    References
    ----------
    Yang et al., "SAC-COT: Sample Consensus by Sampling Compatibility Triangles in Graphs for 3-D Point Cloud
    Registration", 2021.
    """

    variant: ClassVar[str] = "sac_cot"
    n_sac_cot: int = 100
    d_cmp_pr: float = 10.0
    t_cmp: float = 0.9
    max_triangles: int = 1_000_000
    min_height_pr: float = 2.0


@dataclass(frozen=True, kw_only=True)
class Mac:
    """TE ``mac``: maximal cliques of the compatibility graph give a pose each; the best MAE wins (Eq. 7-8).

    The graph is the second-order compatibility graph over the dense correspondences C_d, of which at most the
    1024 best-ranked are its nodes. Of the maximal cliques that hold a node the heaviest is tried.

    Parameters
    ----------
    d_cmp_pr
        d_cmp: two correspondences are compatible by exp(-r^2 / d_cmp^2), in pr. > 0.
    t_cmp
        t_cmp: least compatibility of an edge of the first order. 0 to 1.
    t_sog
        Least weight of an edge of the second order, as a share of the largest. 0 to 1.
    max_cliques
        Maximal cliques looked at, at most; a round that has come so far is ``capped``. 1 to 1,000,000,000.
    max_steps
        Steps of the search, at most; a round that has come so far is ``capped``. 1 to 1,000,000,000.

    References
    ----------
    Zhang et al., "3D Registration with Maximal Cliques", 2023.
    """

    variant: ClassVar[str] = "mac"
    d_cmp_pr: float = 10.0
    t_cmp: float = 0.9
    t_sog: float = 0.5
    max_cliques: int = 10_000
    max_steps: int = 20_000


@dataclass(frozen=True, kw_only=True)
class Overlap:
    """HV ``overlap``: accepts a pose if enough source points come to lie within ``d_op`` of a target point.

    Parameters
    ----------
    t_overlap
        t_overlap: the share to exceed. 0 to 1. Of all source points, or where normals count, are oriented and
        there is a viewpoint, of those that can be seen from it. Without it a depth camera sees at most about
        half of an object: for scenes from one view 0.3 to 0.4.
    exclusive
        Whether target points that an accepted instance explains support no later one, so that an instance is
        found once.

    References
    ----------
    Quan et al., "Local Voxelized Structure for 3D Binary Feature Representation and Robust Registration",
    2018.
    """

    variant: ClassVar[str] = "overlap"
    t_overlap: float = 0.85
    exclusive: bool = False


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """HV ``evidence``: accepts a pose if it is right with a probability of more than ``t_score``.

    Judged by how unlikely it is that so many correspondences agree by chance, in this scene, and by how much
    closer the two clouds lie than chance would put them. The verdict is given in log odds. In a scene seen
    from one side only what the camera can see counts, and the margin is in proportion to how much of the
    model a pose explains.

    Parameters
    ----------
    t_score
        The probability to exceed. 0 to 1.
    t_sure
        A pose that is right with a probability of more than this becomes an instance at once; the others wait
        for the end of the contest. 0 to 1; 1: all wait.
    exclusive
        Whether target points that an accepted instance explains support no later one, so that an instance is
        found once.
    """

    variant: ClassVar[str] = "evidence"
    t_score: float = 0.5
    t_sure: float = 0.99
    exclusive: bool = True


@dataclass(frozen=True, kw_only=True)
class InlierCount:
    """HV ``inlier_count``: accepts a pose if enough alive correspondences have a residual below ``t_he``.

    Parameters
    ----------
    t_inliers
        The count to exceed; the paper tries 50, 100 and 150. At least 1.
    """

    variant: ClassVar[str] = "inlier_count"
    t_inliers: int = 50


@dataclass(frozen=True, kw_only=True)
class None_:
    """HV ``none``: accepts every pose, as in the paper's ablation."""

    variant: ClassVar[str] = "none"


Scs = Gtm | LocalGtm | Nnsr | Hough3d
Ce = Voting | Off
Te = Gsac | Irls | Ransac | SacCot | Mac
Hv = Evidence | Overlap | InlierCount | None_
