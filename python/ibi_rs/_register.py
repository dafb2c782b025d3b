"""`register`: a model of which nothing is kept, and one scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy.typing as npt

from ibi_rs._inputs import Points
from ibi_rs._model import Model
from ibi_rs._view import Viewpoint
from ibi_rs.params import Params
from ibi_rs.registration import Registration, Round


def register(
    src: Points,
    tgt: Points,
    corr: Any,
    params: Params | None = None,
    *,
    src_normals: npt.ArrayLike | None = None,
    tgt_normals: npt.ArrayLike | None = None,
    src_frames: npt.ArrayLike | None = None,
    tgt_frames: npt.ArrayLike | None = None,
    similarity: npt.ArrayLike | None = None,
    viewpoint: Viewpoint | None = None,
    num_threads: int | None = None,
    max_instances: int | None = None,
    timeout_s: float | None = None,
    callback: Callable[[Round], object] | None = None,
) -> Registration:
    """Find every instance of a model in a scene.

    Parameters
    ----------
    src, tgt : (N, 3) array_like
        The model (source) and the scene (target) in the same unit of length, of any real dtype; or an object
        with ``.points`` (Open3D), ``.vertices`` (trimesh), ``__array__`` or ``__dlpack__`` (tensors, on the
        CPU). At least 3 points each.
    corr : (M, 2) array_like of int, (M, 6) array_like, or pair of (M, 3) arrays
        Putative correspondences: [source row, target row], or the source point and the target point
        themselves.
    params : Params, optional
        Default ``Params()``.
    src_normals, tgt_normals : (N, 3) array_like, optional
        Normals of both clouds, or of neither; any length but 0. Used by the local game (``LocalGtm``) and,
        where ``min_normal_cos`` is set, by inliers, refinement and overlap: :meth:`Params.single_view`.
    src_frames, tgt_frames : (N, 3, 3) array_like, optional
        Local reference frames of both clouds, or of neither: at each point three unit axes, as rows,
        right-handed. Used by :class:`Hough3d`, which computes them where they are not given.
    similarity : (M,) array_like, optional
        How alike the two descriptors of each correspondence are, on any scale; larger is better. Used by
        :class:`Nnsr`, which cannot do without. A good choice is 1 - d1 / d2, with d1 and d2 the distances to
        the nearest and to the second nearest descriptor.
    viewpoint : (3,) or (E, 3) array_like, View or sequence of View, optional
        Where the depth camera stood, in the frame of ``tgt``, or several; a :class:`View` adds all that it
        measured. With normals that count and are oriented, only source points that one of them can see count
        in the overlap: they face it, no other part of the model hides them, and nothing that it measured lies
        before them.
    num_threads : int, optional
        Default: the environment variable ``IBI_NUM_THREADS``, else the cores the process may use. More than
        four for each core, or eight, are not started. The result does not depend on it.
    max_instances, timeout_s : optional
        Override those of ``params``.
    callback : callable, optional
        Called with a :class:`Round` after each round; returning False ends the run and keeps what is found.

    Returns
    -------
    Registration
        The poses, best score first; empty if there is none, and ``stop_reason`` says why the run ended.

    Raises
    ------
    InputError
        An array has a wrong shape, a value that is not finite, or an index out of range, or lies so far from
        the origin that its numbers are as coarse as its points are dense; or a variant needs one that is not
        given, or a stage of your own returns what cannot be used; the message names the argument, the place
        and what is allowed. A ValueError.
    ParamsError
        A parameter is out of range. A ValueError.
    TypeError
        An array has a dtype that cannot be used, or an argument is of another type than above.
    ValueError
        ``num_threads`` or ``IBI_NUM_THREADS`` is no integer from 1 to 65535.

    Notes
    -----
    The GIL is released. Ctrl-C ends the run within 0.1 s. Threads, if not more than the cores, wait for the
    next call that wants as many; a process that was forked starts its own. Stages of your own are called in
    the thread that called this function; an exception in one, Ctrl-C among them, ends the run and is raised
    as it is.

    References
    ----------
    Cao et al., "Instance by Instance: An Iterative Framework for Multi-instance 3D Registration".

    Examples
    --------
    >>> import ibi_rs as ibi
    >>> scene = ibi.synth.outlier_layout(seed=1, num_instances=5)
    >>> found = ibi.register(scene.src, scene.tgt, scene.corr)
    >>> found[0].target_from_source.shape
    (4, 4)
    """
    model = Model(src, normals=src_normals, frames=src_frames)
    return model.register(
        tgt,
        corr,
        params,
        tgt_normals=tgt_normals,
        tgt_frames=tgt_frames,
        similarity=similarity,
        viewpoint=viewpoint,
        num_threads=num_threads,
        max_instances=max_instances,
        timeout_s=timeout_s,
        callback=callback,
    )
