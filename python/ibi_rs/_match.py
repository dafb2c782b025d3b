"""`match`: descriptors in, correspondences out."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ibi_rs import _core
from ibi_rs._inputs import _aligned, _count, _num_threads, _number, _shaped


def match(
    src_feat: npt.ArrayLike,
    tgt_feat: npt.ArrayLike,
    *,
    k: int = 1,
    mutual: bool = False,
    ratio: float | None = None,
    num_threads: int | None = None,
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Join each target row to its nearest source rows in the space of descriptors.

    The nearest by Euclidean distance, exactly; of equally near ones those of lower rows.

    Parameters
    ----------
    src_feat, tgt_feat : (N, D) and (Q, D) array_like
        Descriptors of the model and of the scene, of one kind: :func:`ibi_rs.features.fpfh`, or any other,
        learned ones included. They count in single precision; numbers must be below 1e15.
    k : int
        How many source rows each target row is joined to. The right one is often not the first: walls and
        edges repeat on a part.
    mutual : bool
        Keep a pair only if the target row is among the ``k`` nearest of the source row, too. Not for scenes
        of many instances: each source row has one nearest target row, and so one instance.
    ratio : float, optional
        Keep a pair only if its distance is at most so many times that of the first source row left out
        (Lowe); above 0, at most 1.
    num_threads : int, optional
        As in :func:`ibi_rs.register`. The result does not depend on it.

    Returns
    -------
    corr : (M, 2) int64
        [source row, target row], by target row and then the nearest first.
    similarity : (M,) float64
        1 - d / d', d being the distance and d' that of the nearest source row left out, of rank ``k`` + 1:
        from 0 to 1, higher is better. 1 where none is left out, 0 where d and d' are 0.

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
    Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004.

    Examples
    --------
    >>> import ibi_rs as ibi
    >>> corr, similarity = ibi.match([[0.0], [8.0]], [[1.0], [6.0], [9.0]])
    >>> corr.tolist()
    [[0, 0], [1, 1], [1, 2]]
    >>> similarity.round(2).tolist()
    [0.86, 0.67, 0.89]
    """
    if not isinstance(mutual, (bool, np.bool_)):
        raise TypeError(f"mutual must be a bool, not {type(mutual).__name__}")
    return _core.features_match(
        _descriptors("src_feat", src_feat),
        _descriptors("tgt_feat", tgt_feat),
        _count("k", k, 1),
        bool(mutual),
        None if ratio is None else _number("ratio", ratio),
        _num_threads(num_threads),
    )


def _descriptors(name: str, value: Any) -> npt.NDArray[np.float32]:
    array = _shaped(name, value, "N", "D")
    if array.shape[1] == 0:
        raise _core.InputError(f"{name} has shape {array.shape}; D must be at least 1")
    return _aligned(array, np.float32)
