"""How far one pose is from another."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from ibi_rs import _core
from ibi_rs._inputs import _floats, _num_threads, _points
from ibi_rs.symmetries import Symmetries, _as_symmetries


def rotation_error_deg(
    a: npt.ArrayLike, b: npt.ArrayLike, *, symmetries: Symmetries | npt.ArrayLike | None = None
) -> float:
    """Angle of the rotation that leads from one pose to the other, in [0, 180] degrees.

    Computed through an arc tangent: never NaN, and exact to the last digits near 0 and 180 degrees, where
    the usual arc cosine of the trace is not.

    Parameters
    ----------
    a, b : array_like, shape (4, 4)
        Rigid motions.
    symmetries : Symmetries or array_like of shape (S, 4, 4), optional
        Of the model: `a` counts as the pose nearest to `b` of those that look like it.

    Returns
    -------
    float
        Degrees.

    Raises
    ------
    ValueError
        If an argument is not a rigid motion.
    TypeError
        If an argument is not made of real numbers.
    """
    angle = _core.metrics_rotation_error_rad(
        _floats("a", a, 4, 4), _floats("b", b, 4, 4), _as_symmetries(symmetries)
    )
    return math.degrees(angle)


def translation_error(
    a: npt.ArrayLike, b: npt.ArrayLike, *, symmetries: Symmetries | npt.ArrayLike | None = None
) -> float:
    """Distance of the two translations, in the unit of the data.

    Depends on where the model's origin lies; centre the model if its origin means nothing.

    Parameters
    ----------
    a, b : array_like, shape (4, 4)
        Rigid motions.
    symmetries : Symmetries or array_like of shape (S, 4, 4), optional
        As in `rotation_error_deg`.

    Returns
    -------
    float
    """
    return _core.metrics_translation_error(
        _floats("a", a, 4, 4), _floats("b", b, 4, 4), _as_symmetries(symmetries)
    )


def frobenius_distance(a: npt.ArrayLike, b: npt.ArrayLike) -> float:
    """Frobenius norm of the difference of the two matrices.

    By this the poses are assigned one to one. It adds numbers without a unit to lengths, so it depends on
    the unit of the data.

    Parameters
    ----------
    a, b : array_like, shape (4, 4)
        Rigid motions.

    Returns
    -------
    float
    """
    return _core.metrics_frobenius_distance(_floats("a", a, 4, 4), _floats("b", b, 4, 4))


def add(model: npt.ArrayLike, predicted: npt.ArrayLike, truth: npt.ArrayLike) -> float:
    """Mean distance between each model point under one pose and the same point under the other: ADD.

    Parameters
    ----------
    model : array_like, shape (N, 3)
        Points of the model, at least one.
    predicted, truth : array_like, shape (4, 4)
        Rigid motions.

    Returns
    -------
    float
        In the unit of the data.

    Raises
    ------
    ValueError
        If a pose is not a rigid motion, or the model is empty or not finite.
    TypeError
        If an argument is not made of real numbers.

    References
    ----------
    Hinterstoisser et al., "Model based training, detection and pose estimation of texture-less 3D objects
    in heavily cluttered scenes", ACCV 2012.
    """
    return _core.metrics_add(
        _points("model", model), _floats("predicted", predicted, 4, 4), _floats("truth", truth, 4, 4)
    )


def add_s(model: npt.ArrayLike, predicted: npt.ArrayLike, truth: npt.ArrayLike) -> float:
    """Mean distance from each model point under the truth to the *closest* under the prediction: ADD-S.

    Blind to symmetry, with none declared. Exchanging the two poses changes the value, though little when
    it is small.

    Parameters
    ----------
    model, predicted, truth : array_like
        As in `add`, which raises the same.

    Returns
    -------
    float
        In the unit of the data.

    References
    ----------
    Hinterstoisser et al., ACCV 2012, as in `add`; named ADD-S by Xiang et al., "PoseCNN: A convolutional
    neural network for 6D object pose estimation in cluttered scenes", RSS 2018.

    Examples
    --------
    >>> import numpy as np
    >>> from ibi_rs import metrics
    >>> stick = [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    >>> flipped = np.diag([-1.0, -1.0, 1.0, 1.0])
    >>> metrics.add(stick, flipped, np.eye(4)), metrics.add_s(stick, flipped, np.eye(4))
    (2.0, 0.0)
    """
    return _core.metrics_add_s(
        _points("model", model),
        _floats("predicted", predicted, 4, 4),
        _floats("truth", truth, 4, 4),
        _num_threads(None),
    )


def mssd(
    model: npt.ArrayLike,
    predicted: npt.ArrayLike,
    truth: npt.ArrayLike,
    *,
    symmetries: Symmetries | npt.ArrayLike | None = None,
) -> float:
    """Largest distance between corresponding model points, under the symmetry that makes it least: MSSD.

    Parameters
    ----------
    model, predicted, truth : array_like
        As in `add`.
    symmetries : Symmetries or array_like of shape (S, 4, 4), optional
        Motions of the model, in its frame, that leave it looking the same. The identity is always among
        them and need not be named. Turns about an axis are tried in BOP's steps, from the nearest one on; a
        ball is turned to the truth.

    Returns
    -------
    float
        In the unit of the data.

    Raises
    ------
    ValueError
        As of `add`, and if a symmetry is not a rigid motion.

    References
    ----------
    Hodan et al., "BOP challenge 2020 on 6D object localization", ECCV workshops 2020.
    """
    return _core.metrics_mssd(
        _points("model", model),
        _floats("predicted", predicted, 4, 4),
        _floats("truth", truth, 4, 4),
        _as_symmetries(symmetries),
    )


def diameter(points: npt.ArrayLike) -> float:
    """Largest distance between two points, exactly; 0 for fewer than two.

    About O(n log n). Of more than 4096 points all about equally far from their centroid the last one or two
    of its digits may differ.

    Parameters
    ----------
    points : array_like, shape (N, 3)
        Points of the model.

    Returns
    -------
    float
        In the unit of the data.

    Raises
    ------
    ValueError
        If the shape is another, or a point is not finite.
    TypeError
        If `points` is not made of real numbers.
    """
    return _core.metrics_diameter(_points("points", points), _num_threads(None))


def assignment(cost: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """Assign rows to columns at the least total cost, no row and no column twice.

    Parameters
    ----------
    cost : array_like, shape (R, C)
        Finite costs, of either sign.

    Returns
    -------
    ndarray of int64, shape (R,)
        The column of each row, -1 for a row left over (only if R > C).

    Raises
    ------
    ValueError
        If the shape is another, or a cost is not finite.
    TypeError
        If `cost` is not made of real numbers.

    References
    ----------
    Jonker & Volgenant, "A shortest augmenting path algorithm for dense and sparse linear assignment
    problems", Computing 38 (1987).

    Examples
    --------
    >>> from ibi_rs import metrics
    >>> metrics.assignment([[1.0, 2.0], [3.0, 9.0]])  # 2 + 3, where greedy takes 1 + 9
    array([1, 0])
    """
    return _core.metrics_assignment(_floats("cost", cost, "R", "C"))
