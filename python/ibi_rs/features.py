"""From a mesh and a scan to correspondences: points, normals, descriptors.

The two clouds and the correspondences that :func:`ibi_rs.register` wants can be had without any other
program. The model: draw points on the mesh (:func:`sample_mesh`), drop those within (:func:`outer_surface`),
thin them (:func:`voxel_downsample`). The scan: thin it, take its normals (:func:`estimate_normals`), drop the
table (:func:`dominant_plane`). Then describe both (:func:`fpfh`) and join them (:func:`ibi_rs.match`).
Lengths are in the unit of the data.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ibi_rs import _core
from ibi_rs._inputs import (
    Points,
    _count,
    _faces,
    _num_threads,
    _number,
    _optional,
    _points,
    _rows,
    _seed,
    _viewpoint,
)

__all__ = [
    "Plane",
    "dominant_plane",
    "estimate_normals",
    "fpfh",
    "outer_surface",
    "sample_mesh",
    "voxel_downsample",
]


def voxel_downsample(
    points: Points, voxel: float, *, normals: npt.ArrayLike | None = None
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64] | None]:
    """Thin a cloud to the mean of the points in each voxel.

    The lattice begins half a voxel below the least coordinates, as that of Open3D's ``voxel_down_sample``:
    both give the same points. The order of the rows changes the result by rounding only.

    Parameters
    ----------
    points : (N, 3) array_like
        Any real dtype, or an object with ``.points`` or ``.vertices``, as in :func:`ibi_rs.register`.
    voxel : float
        Width of a voxel, data units; above 0. At most 2^21 fit along an axis.
    normals : (N, 3) array_like, optional
        Averaged with the points and brought to length 1; any length but 0. Where those of a voxel cancel (a
        thin wall), the one of its first row stands for all.

    Returns
    -------
    points : (M, 3) float64
        Sorted by voxel: x first, then y, then z.
    normals : (M, 3) float64 or None
        None if none were given.

    Raises
    ------
    InputError
        An array has a wrong shape or a value that is not finite, or the voxel is not above 0 or too small.
    TypeError
        An argument is of another type than above.

    Notes
    -----
    The GIL is released. Ctrl-C ends the call within 0.1 s.

    Examples
    --------
    >>> import ibi_rs as ibi
    >>> points, _ = ibi.features.voxel_downsample([[0, 0, 0], [0, 0, 0.2], [0, 0, 5]], voxel=1)
    >>> points.tolist()
    [[0.0, 0.0, 0.1], [0.0, 0.0, 5.0]]
    """
    return _core.features_voxel_downsample(
        _points("points", points),
        _optional("normals", normals),
        _number("voxel", voxel),
        _num_threads(None),
    )


def estimate_normals(
    points: Points,
    radius: float,
    max_neighbors: int = 30,
    *,
    viewpoint: npt.ArrayLike | None = None,
    num_threads: int | None = None,
) -> npt.NDArray[np.float64]:
    """Take the normal of each point from the plane through its neighbours.

    By PCA over the nearest ``max_neighbors`` nearer than ``radius``, the point itself among them: what
    Open3D's ``estimate_normals`` does with ``KDTreeSearchParamHybrid``. A point without at least two
    neighbours apart from it has no plane; its normal is the direction to the viewpoint, or +z.

    Parameters
    ----------
    points : (N, 3) array_like
        As in :func:`voxel_downsample`.
    radius : float
        Data units; above 0. Two to three voxels do well.
    max_neighbors : int
        At least 3.
    viewpoint : (3,) array_like, optional
        Where the depth camera stood: normals face it. Without one they are unoriented, and of the two
        directions that with z above 0 is returned.
    num_threads : int, optional
        As in :func:`ibi_rs.register`. The result does not depend on it.

    Returns
    -------
    (N, 3) float64
        Of length 1.

    Raises
    ------
    InputError
        An array has a wrong shape or a value that is not finite, or a number is out of its range.
    TypeError
        An argument is of another type than above.
    ValueError
        ``num_threads`` or ``IBI_NUM_THREADS`` is no integer from 1 to 65535.

    Notes
    -----
    The GIL is released. Ctrl-C ends the call within 0.1 s.

    References
    ----------
    Hoppe et al., "Surface reconstruction from unorganized points", SIGGRAPH 1992.

    Examples
    --------
    >>> import ibi_rs as ibi
    >>> square = [[0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]]
    >>> ibi.features.estimate_normals(square, radius=2, viewpoint=[0, 0, 0])[0].round(12).tolist()
    [-0.0, -0.0, -1.0]
    """
    return _core.features_estimate_normals(
        _points("points", points),
        _number("radius", radius),
        _count("max_neighbors", max_neighbors, 3),
        None if viewpoint is None else _viewpoint(viewpoint),
        _num_threads(num_threads),
    )


def fpfh(
    points: Points,
    normals: npt.ArrayLike,
    radius: float,
    max_neighbors: int = 100,
    *,
    keypoints: npt.ArrayLike | None = None,
    num_threads: int | None = None,
) -> npt.NDArray[np.float32]:
    """Describe each point by the histograms of the angles between its normal and those around: FPFH.

    Equal to Open3D's ``compute_fpfh_feature`` with ``KDTreeSearchParamHybrid(radius, max_neighbors)`` up to
    rounding: an angle at the edge of a bin may fall into the next one. Each of the three histograms of eleven
    bins has a sum of 200; of 100 for a point whose neighbours all lie at its own place, 0 for one without.

    Parameters
    ----------
    points : (N, 3) array_like
        As in :func:`voxel_downsample`; best thinned, as the number of points around counts.
    normals : (N, 3) array_like
        Any length but 0. All on the same side of the surface: turned ones give another descriptor.
    radius : float
        Data units; above 0. About five voxels do well.
    max_neighbors : int
        The nearest of those within the radius that count, the point itself among them; at least 2.
    keypoints : (K,) array_like of int, optional
        Rows of ``points`` to describe, in any order. All points count as neighbours all the same.
    num_threads : int, optional
        As in :func:`ibi_rs.register`. The result does not depend on it.

    Returns
    -------
    (N, 33) or (K, 33) float32

    Raises
    ------
    InputError
        An array has a wrong shape or a value that is not finite, a key point is no row of ``points``, or a
        number is out of its range.
    TypeError
        An argument is of another type than above.
    ValueError
        ``num_threads`` or ``IBI_NUM_THREADS`` is no integer from 1 to 65535.

    Notes
    -----
    The GIL is released. Ctrl-C ends the call within 0.1 s.

    References
    ----------
    Rusu, Blodow, Beetz, "Fast Point Feature Histograms (FPFH) for 3D registration", ICRA 2009.

    Examples
    --------
    >>> import ibi_rs as ibi
    >>> cloud = [[0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]]
    >>> features = ibi.features.fpfh(cloud, [[0, 0, 1]] * 4, radius=2)
    >>> features.shape, features[0, 5].item()
    ((4, 33), 200.0)
    """
    return _core.features_fpfh(
        _points("points", points),
        _points("normals", normals),
        _number("radius", radius),
        _count("max_neighbors", max_neighbors, 2),
        None if keypoints is None else _rows("keypoints", keypoints),
        _num_threads(num_threads),
    )


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane, and the points that lie in it.

    Attributes
    ----------
    normal : (3,) float64
        n, of length 1.
    offset : float
        The points x of the plane have n . x = offset; data units.
    inliers : (N,) bool
        Which points lie within the distance that was asked for.
    behind : float
        Share of all points that lie behind the plane, farther than that distance. A table hides what is
        behind it: a plane with more than a few stray points there is a face of the parts.
    """

    normal: npt.NDArray[np.float64]
    offset: float
    inliers: npt.NDArray[np.bool_]
    behind: float


def dominant_plane(
    points: Points,
    distance: float,
    *,
    min_share: float = 0.2,
    viewpoint: npt.ArrayLike | None = None,
    seed: int = 0,
    num_threads: int | None = None,
) -> Plane | None:
    """Find the plane that holds the most points: the table that parts lie on, or the floor of a bin.

    Drawn through three points at random, again and again, and fitted by least squares to what lies near
    it. What is left of a scan without it: ``points[~plane.inliers]``. Look at ``plane.behind`` first:
    where the scan shows no table, the faces of parts that lie side by side are the largest plane.

    Parameters
    ----------
    points : (N, 3) array_like
        As in :func:`voxel_downsample`; best thinned, so that what is near the camera counts no more.
    distance : float
        How far from the plane its points may lie, data units; above 0. One to two voxels do well.
    min_share : float
        The least share of all points; above 0, at most 1. Of what is below 0.08 a plane may be missed.
    viewpoint : (3,) array_like, optional
        Where the depth camera stood: the normal points to its side. Without one, to the side on which more of
        the other points lie.
    seed : int
        Of the draws, from 0 to 2^64 - 1. The same seed gives the same plane.
    num_threads : int, optional
        As in :func:`ibi_rs.register`. The result does not depend on it.

    Returns
    -------
    Plane or None
        None if no plane holds such a share.

    Raises
    ------
    InputError
        An array has a wrong shape or a value that is not finite, or a number is out of its range.
    TypeError
        An argument is of another type than above.
    ValueError
        ``num_threads`` or ``IBI_NUM_THREADS`` is no integer from 1 to 65535.

    Notes
    -----
    The GIL is released. Ctrl-C ends the call within 0.1 s.

    References
    ----------
    Fischler, Bolles, "Random sample consensus", CACM 1981.

    Examples
    --------
    >>> import ibi_rs as ibi
    >>> table = [[x, y, 2] for x in range(9) for y in range(9)]
    >>> plane = ibi.features.dominant_plane([*table, [4, 4, 3]], 0.1)
    >>> plane.normal.round(12).tolist(), round(plane.offset, 12), plane.inliers.sum().item()
    ([0.0, 0.0, 1.0], 2.0, 81)
    """
    found = _core.features_dominant_plane(
        _points("points", points),
        _number("distance", distance),
        _number("min_share", min_share),
        None if viewpoint is None else _viewpoint(viewpoint),
        _seed(seed),
        _num_threads(num_threads),
    )
    if found is None:
        return None
    normal, offset, inliers, behind = found
    return Plane(np.array(normal), offset, inliers, behind)


def sample_mesh(
    vertices: Points,
    faces: npt.ArrayLike,
    *,
    n: int | None = None,
    spacing: float | None = None,
    seed: int = 0,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Draw points on a mesh, evenly spread.

    At random by area, and none too near to another one on the same side of the surface: closer ones may face
    each other across a thin wall, their normals turned by more than 120 degrees.

    Parameters
    ----------
    vertices : (V, 3) array_like
        As in :func:`voxel_downsample`.
    faces : (F, 3) array_like of int
        Rows of ``vertices``, counter-clockwise as seen from outside: that is where normals point.
    n : int, optional
        How many points, as far apart as they come; at most 10^8.
    spacing : float, optional
        The least distance of two points, data units; above 0. As many are drawn as find room. Give ``n`` or
        this.
    seed : int
        From 0 to 2^64 - 1. The same seed gives the same points.

    Returns
    -------
    points : (N, 3) float64
        In no particular order.
    normals : (N, 3) float64
        Those of the faces that the points lie on, of length 1.

    Raises
    ------
    InputError
        An array has a wrong shape or a value that is not finite, a face names no vertex, the faces have no
        area, or a number is out of its range.
    TypeError
        An argument is of another type than above, or both ``n`` and ``spacing`` are given, or neither.

    Notes
    -----
    The GIL is released. Ctrl-C ends the call within 0.1 s.

    References
    ----------
    McCool, Fiume, "Hierarchical Poisson disk sampling distributions", Graphics Interface 1992.

    Examples
    --------
    >>> import ibi_rs as ibi
    >>> points, normals = ibi.features.sample_mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], n=50)
    >>> points.shape, normals[0].tolist()
    ((50, 3), [0.0, 0.0, 1.0])
    """
    if (n is None) == (spacing is None):
        raise TypeError("give either n or spacing")
    return _core.features_sample_mesh(
        _points("vertices", vertices),
        _faces(faces),
        None if n is None else _count("n", n, 1),
        0.0 if spacing is None else _number("spacing", spacing),
        _seed(seed),
    )


def outer_surface(
    points: Points,
    normals: npt.ArrayLike,
    vertices: Points,
    faces: npt.ArrayLike,
    *,
    num_views: int = 64,
    max_angle_rad: float = 1.309,
    lift: float | None = None,
    num_threads: int | None = None,
) -> npt.NDArray[np.bool_]:
    """Tell which points on a mesh can be seen from outside: what lies within a hollow part is in no scan.

    By rays from directions that are evenly spread over the sphere. A point is seen if from one of them no
    face of the mesh hides it.

    Parameters
    ----------
    points, normals : (N, 3) array_like
        On the mesh, normals outwards: those of :func:`sample_mesh`.
    vertices, faces : (V, 3) array_like and (F, 3) array_like of int
        The mesh, as in :func:`sample_mesh`. Here it does not matter how faces are wound.
    num_views : int
        How many directions; from 1 to 100000. A hole that is seen through from few of them may be missed.
    max_angle_rad : float
        How aslant a surface may be seen, the angle between its normal and the direction; above 0, below pi/2.
        By default 75 degrees.
    lift : float, optional
        How far above its surface a point is looked for, data units: more than points may lie below the mesh.
        By default 1e-4 of the diagonal of the mesh.
    num_threads : int, optional
        As in :func:`ibi_rs.register`. The result does not depend on it.

    Returns
    -------
    (N,) bool

    Raises
    ------
    InputError
        An array has a wrong shape or a value that is not finite, a face names no vertex, or a number is out
        of its range.
    TypeError
        An argument is of another type than above.
    ValueError
        ``num_threads`` or ``IBI_NUM_THREADS`` is no integer from 1 to 65535.

    Notes
    -----
    The GIL is released. Ctrl-C ends the call within 0.1 s.

    Examples
    --------
    >>> import ibi_rs as ibi
    >>> vertices, faces = [[0, 0, 0], [9, 0, 0], [0, 9, 0]], [[0, 1, 2]]
    >>> points, normals = [[3, 3, 0], [3, 3, -0.5]], [[0, 0, 1]] * 2
    >>> ibi.features.outer_surface(points, normals, vertices, faces).tolist()
    [True, False]
    """
    return _core.features_outer_surface(
        _points("points", points),
        _points("normals", normals),
        _points("vertices", vertices),
        _faces(faces),
        _count("num_views", num_views, 1),
        _number("max_angle_rad", max_angle_rad),
        None if lift is None else _number("lift", lift),
        _num_threads(num_threads),
    )
