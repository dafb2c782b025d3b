"""`register`: brings what users hold into arrays, calls the core, dresses the answer."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import fields
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from ibi_rs import _core, _detect, _doubts
from ibi_rs._clock import Clock, _left_s
from ibi_rs._detect import Matches
from ibi_rs._inputs import (
    Points,
    _correspondences,
    _frames,
    _frozen,
    _mesh,
    _num_threads,
    _number,
    _points,
    _scan,
    _vector,
)
from ibi_rs._match import match
from ibi_rs._numbers import significant
from ibi_rs._view import View, _camera
from ibi_rs.params import Params
from ibi_rs.registration import Pose, Registration, Round, StopReason, Timings
from ibi_rs.stages import Run
from ibi_rs.symmetries import Symmetries, find_symmetries

_DEFAULT = Params()


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
    viewpoint: npt.ArrayLike | View | None = None,
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
    viewpoint : (3,) array_like or View, optional
        Where the depth camera stood, in the frame of ``tgt``; a :class:`View` adds all that it measured. With
        normals that count and are oriented, only source points that it can see count in the overlap: they
        face it, no other part of the model hides them, and nothing that it measured lies before them.
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


class Model:
    """A model (source), checked and prepared once, to be found in any number of scenes.

    Its spacing and diameter are measured once; :func:`register` measures them anew with every call. A model
    can be pickled, and shared by threads.

    Parameters
    ----------
    src : (N, 3) array_like
        The model, as in :func:`register`.
    normals : (N, 3) array_like, optional
        Its normals; any length but 0.
    frames : (N, 3, 3) array_like, optional
        Its local reference frames, as in :func:`register`.
    symmetries : Symmetries, optional
        What leaves it looking the same. Of two poses found that differ by nothing else (no point of the model
        by more than 0.05 of its size) the better one is returned, whatever the parameters. By default none,
        and then none is dropped.

    Raises
    ------
    InputError
        As :func:`register`, of ``src``, ``src_normals`` and ``src_frames``.
    TypeError
        As :func:`register`.

    Examples
    --------
    >>> import ibi_rs as ibi
    >>> scene = ibi.synth.outlier_layout(seed=1, num_instances=5)
    >>> model = ibi.Model(scene.src)
    >>> len(model.register(scene.tgt, scene.corr))
    5
    """

    _voxel: float
    _is_mesh = False
    _has_hand_voxel = False

    def __init__(
        self,
        src: Points,
        *,
        normals: npt.ArrayLike | None = None,
        frames: npt.ArrayLike | None = None,
        symmetries: Symmetries | None = None,
    ) -> None:
        if symmetries is None:
            symmetries = Symmetries.none()
        if not isinstance(symmetries, Symmetries):
            raise TypeError(f"symmetries must be ibi_rs.Symmetries, not {type(symmetries).__name__}")
        points = _points("src", src)
        of_points = None if normals is None else _points("src_normals", normals)
        axes = None if frames is None else _frames("src_frames", frames)
        self._source = _core.Source(points, of_points, axes, symmetries._held)
        self._symmetries = symmetries
        # Copies: the caller's arrays may change, the prepared source does not.
        self._points = _frozen(points.copy())
        self._normals = None if of_points is None else _frozen(of_points.copy())
        self._frames = None if axes is None else _frozen(axes.copy())
        _doubts.check_step("src", points, self.spacing)
        self._voxel = _detect.VOXELS_PER_SPACING * self.spacing
        self._described: dict[float, _detect.Described] = {}
        self._inward: float | None = None

    @classmethod
    def from_mesh(
        cls,
        vertices: Any,
        faces: npt.ArrayLike | None = None,
        *,
        voxel: float | None = None,
        symmetries: Symmetries | Literal["find"] | None = None,
        num_threads: int | None = None,
    ) -> Model:
        """Make a model of points on the outer surface of a mesh: a CAD file.

        What lies within the part is left out, as no camera sees it.

        Parameters
        ----------
        vertices : (V, 3) array_like
            In the unit of the scenes; or a mesh or Scene of trimesh, or a mesh of Open3D.
        faces : (F, 3) array_like of int
            Rows of ``vertices``; left out where the object has them. Where they are seen from their backs
            only, their normals are turned: it does not matter how the faces of a closed mesh are wound.
        voxel : float, optional
            Spacing of the points, data units; above 0. By default 1/24 of the diagonal of the mesh, and less,
            down to 1/48, where that leaves fewer than 700 points. In a scan that is coarser the model is
            thinned to what the scan can carry, and the result says so.
        symmetries : Symmetries or "find", optional
            As in :class:`Model`; ``"find"`` looks for them on the mesh, by :func:`find_symmetries` on points
            half a voxel apart, which takes 0.1 to 0.5 s.
        num_threads : int, optional
            As in :func:`register`.

        Returns
        -------
        Model
            With normals.

        Raises
        ------
        InputError
            The mesh has no faces, or has a value that is not finite, or a face names no vertex, or none is
            seen from outside; or the voxel is not above 0.
        TypeError
            An argument is of another type than above.

        Examples
        --------
        >>> import ibi_rs as ibi
        >>> corners = [[x, y, z] for x in (0, 3) for y in (0, 2) for z in (0, 1)]
        >>> sides = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        ...          [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
        >>> model = ibi.Model.from_mesh(corners, sides)
        >>> round(model.diameter, 1)
        3.7
        """
        mesh = _mesh(vertices, faces)
        if voxel is not None:
            voxel = _number("voxel", voxel)
            if not 0 < voxel < math.inf:
                raise _core.InputError(f"voxel is {voxel:g}; it must be above 0 and finite")
        if isinstance(symmetries, str) and symmetries != "find":
            raise _core.InputError(f"symmetries is {symmetries!r}; it must be 'find' or Symmetries")
        has_hand_voxel = voxel is not None
        points, normals, voxel = _detect.mesh_points(*mesh, voxel, num_threads)
        if isinstance(symmetries, str):
            dense, of_dense, _ = _detect.mesh_points(*mesh, 0.5 * voxel, num_threads)
            symmetries = find_symmetries(dense, of_dense)
        model = cls(points, normals=normals, symmetries=symmetries)
        model._voxel, model._is_mesh, model._has_hand_voxel = voxel, True, has_hand_voxel
        return model

    @property
    def points(self) -> npt.NDArray[np.float64]:
        """(N, 3), in data units; read-only."""
        return self._points

    @property
    def normals(self) -> npt.NDArray[np.float64] | None:
        """(N, 3) as given, or None; read-only."""
        return self._normals

    @property
    def frames(self) -> npt.NDArray[np.float64] | None:
        """(N, 3, 3) as given, or None; read-only."""
        return self._frames

    @property
    def symmetries(self) -> Symmetries:
        """What leaves it looking the same, as declared or found when it was made."""
        return self._symmetries

    def find_symmetries(self, *, tolerance: float = 0.03) -> Symmetries:
        """Find what leaves it looking the same: :func:`find_symmetries` of its points.

        Nothing of the model changes. ``Model.from_mesh(..., symmetries="find")`` looks more closely, and uses
        what it finds.

        Parameters
        ----------
        tolerance : float, default 0.03
            As in :func:`find_symmetries`.

        Returns
        -------
        Symmetries
        """
        return find_symmetries(self._points, self._normals, tolerance=tolerance)

    @property
    def spacing(self) -> float:
        """Mean distance of a point to its nearest distinct one, data units; far strays do not count."""
        return self._source.spacing

    @property
    def voxel(self) -> float:
        """What :meth:`detect` thins a scene to, data units: the mesh's voxel, or 1.25 times the spacing.

        A scan that is coarser is thinned to what it can carry: ``Matches.voxel``.
        """
        return self._voxel

    @property
    def diameter(self) -> float:
        """Largest distance of two points, in data units; measured when first asked for."""
        return self._source.diameter(_num_threads(None), _left_s())

    def __len__(self) -> int:
        return len(self._points)

    def __repr__(self) -> str:
        normals = "with" if self._normals is not None else "without"
        return f"Model({len(self)} points, {normals} normals, spacing {significant(self.spacing)})"

    def __getstate__(self) -> dict[str, Any]:
        state = {"points": self._points, "normals": self._normals, "frames": self._frames}
        origin = {"voxel": self._voxel, "is_mesh": self._is_mesh, "has_hand_voxel": self._has_hand_voxel}
        return state | origin | {"symmetries": self._symmetries}

    def __setstate__(self, state: dict[str, Any]) -> None:
        arrays = {name: state[name] for name in ("normals", "frames", "symmetries")}
        Model.__init__(self, state["points"], **arrays)
        self._voxel, self._is_mesh = state["voxel"], state["is_mesh"]
        self._has_hand_voxel = state["has_hand_voxel"]

    def correspond(
        self,
        tgt: Points,
        *,
        tgt_normals: npt.ArrayLike | None = None,
        viewpoint: npt.ArrayLike | View | None = None,
        remove_plane: bool | None = None,
        check_units: bool = True,
        num_threads: int | None = None,
    ) -> Matches:
        """Match a scene with this model, which needs normals: the first half of :meth:`detect`.

        The scene is thinned to :attr:`voxel`, or to what it can carry if it is coarser, its table taken away,
        its normals estimated; both clouds are described by FPFH over 6 voxels, and each scene point is joined
        to the four model points most like it.

        Parameters
        ----------
        tgt, tgt_normals, viewpoint, remove_plane, check_units, num_threads
            As in :meth:`detect`.

        Returns
        -------
        Matches
            ``tgt, tgt_normals, corr, similarity``, for :meth:`register`; and as attributes ``voxel`` and
            ``warnings``. Empty where the scan holds nothing but a table or stray points.

        Raises
        ------
        InputError, TypeError, ValueError
            Those of :meth:`detect`.
        """
        return self._match(tgt, tgt_normals, viewpoint, remove_plane, check_units, num_threads)[0]

    def _match(
        self,
        tgt: Points,
        tgt_normals: npt.ArrayLike | None,
        viewpoint: npt.ArrayLike | View | None,
        remove_plane: bool | None,
        check_units: bool,
        num_threads: int | None,
    ) -> tuple[Matches, npt.NDArray[np.float64]]:
        """Match, and return with it the points that were measured."""
        if self._normals is None:
            raise _core.InputError("src_normals: detection needs them; give normals=, or use Model.from_mesh")
        if viewpoint is None and tgt_normals is None:
            raise _core.InputError(
                "viewpoint: give it (the camera's place, [0, 0, 0] in most scans) or tgt_normals: "
                "descriptors have to know which side of a surface is the outer one"
            )
        if remove_plane is not None and not isinstance(remove_plane, (bool, np.bool_)):
            raise TypeError(f"remove_plane must be a bool or None, not {type(remove_plane).__name__}")
        points, normals, num_dropped = _scan("tgt", tgt, tgt_normals)
        _doubts.check_step("tgt", points)
        if check_units:
            _doubts.check_units(self.diameter, points)
        eye = _camera(viewpoint)[0]
        remove_plane = None if remove_plane is None else bool(remove_plane)
        scan = _detect.scan_points(
            points, normals, self._voxel, self.diameter, eye, remove_plane, num_threads
        )
        matches = self._match_scan(scan, num_threads)
        matches.voxel = scan.voxel
        matches.warnings = tuple(self._warnings(scan, len(points), eye, num_dropped))
        return matches, points

    def _match_scan(self, scan: _detect.Scan, num_threads: int | None) -> Matches:
        if self._is_nothing(scan) or not self._is_known_at(scan.voxel):
            return Matches(scan.points, scan.normals, np.empty((0, 2), np.int64), np.empty(0))
        assert self._normals is not None  # `correspond` has looked
        if scan.voxel not in self._described:
            self._described[scan.voxel] = _detect.described(
                self._points, self._normals, self.spacing, self._voxel, scan.voxel, num_threads
            )
        rows, of_model = self._described[scan.voxel]
        described = _detect.describe(scan.points, scan.normals, scan.voxel, num_threads)
        corr, similarity = match(of_model, described, k=_detect.PER_POINT, num_threads=num_threads)
        if rows is not None:
            corr[:, 0] = rows[corr[:, 0]]
        return Matches(scan.points, scan.normals, corr, similarity)

    def _is_nothing(self, scan: _detect.Scan) -> bool:
        """Whether too little is left of a scan for a pose."""
        points = scan.points
        return len(points) < 3 or bool(np.linalg.norm(np.ptp(points, axis=0)) <= self.spacing)

    def _is_known_at(self, voxel: float) -> bool:
        """Whether enough is left of this model in such voxels, unless they are its own."""
        return voxel <= max(self._voxel, self.diameter / _detect.MIN_VOXELS_PER_DIAMETER)

    def _warnings(
        self,
        scan: _detect.Scan,
        num_points: int,
        eye: list[float] | None,
        num_dropped: int,
    ) -> Iterator[str]:
        """Say what is doubtful about a scan, and about this model."""
        if num_dropped:
            given = num_dropped + num_points
            yield f"{num_dropped} of {given} points of the scan are not finite, and were left out"
        if num_points < 3:
            yield f"the scan has {num_points} points"
        elif self._is_nothing(scan):
            yield "the scan is a table, or stray points, and nothing else"
        elif not self._is_known_at(scan.voxel):
            yield (
                f"the scan is too coarse, at a voxel of {scan.voxel:.3g}, for a model {self.diameter:.3g}"
                " across; nothing is looked for"
            )
        elif scan.voxel > self._voxel:
            if self._has_hand_voxel:
                yield (
                    f"the scan is coarser than the voxel of {self._voxel:.3g} that the model was given; "
                    f"{scan.voxel:.3g} was used"
                )
            if scan.voxel * _detect.FEW_VOXELS_PER_DIAMETER > self.diameter:
                yield (
                    f"the scan is coarse, at a voxel of {scan.voxel:.3g}, for a model {self.diameter:.3g}"
                    " across; poses are less sure"
                )
        if eye is not None and scan.table_above:
            yield "viewpoint: nearly all of the scan lies behind its largest plane; is it on the right side?"
        elif eye is not None:
            doubt = _doubts.viewpoint_warning(eye, scan.whole, scan.whole_normals, scan.voxel)
            if doubt is not None:
                yield doubt
        if not self._is_mesh and self._normals is not None:
            if self._inward is None:
                self._inward = _doubts.inward(self._points, self._normals, self.spacing)
            if self._inward > _doubts.MAX_INWARD:
                yield (
                    f"src_normals: {self._inward:.0%} of those that are seen from outside point inwards; they"
                    " have to point outwards"
                )

    def detect(
        self,
        tgt: Points,
        params: Params | None = None,
        *,
        tgt_normals: npt.ArrayLike | None = None,
        viewpoint: npt.ArrayLike | View | None = None,
        remove_plane: bool | None = None,
        check_units: bool = True,
        num_threads: int | None = None,
        max_instances: int | None = None,
        timeout_s: float | None = None,
        callback: Callable[[Round], object] | None = None,
    ) -> Registration:
        """Find every instance of this model in a scan: :meth:`correspond`, then :meth:`register`.

        Parameters
        ----------
        tgt : (N, 3) or (H, W, 3) array_like
            The scan, as in :func:`register`, in the unit of the model. Points that are not finite are left
            out.
        params : Params, optional
            By default ``Params.single_view()`` with a viewpoint and ``Params()`` without one.
        tgt_normals : (N, 3) or (H, W, 3) array_like, optional
            Outwards. By default they are estimated, and face the viewpoint. A point whose normal is 0 or not
            finite gets that of its nearest point; where most are, they are refused.
        viewpoint : (3,) array_like or View
            Where the depth camera stood, in the frame of ``tgt``: ``[0, 0, 0]`` for most scans. Where ``tgt``
            is not all that it measured, a :class:`View` of all. It may be left out where normals are given,
            for scenes that are seen from all sides.
        remove_plane : bool, optional
            Whether the plane with most points is taken away. By default it is where it looks like a table:
            less than 2 % of the points lie behind it, as the viewpoint sees it.
        check_units : bool, default True
            Whether a scan is refused that is 10 times smaller than the model or 300 times larger. What counts
            is the box around all points but the outermost hundredth on each side; fewer than 100 points tell
            nothing.
        num_threads, max_instances, callback
            As in :func:`register`.
        timeout_s : float, optional
            Overrides that of ``params``; counted from this call. Where time runs out before the first round,
            the result is empty.

        Returns
        -------
        Registration
            Its ``labels`` and ``inliers`` are rows of the correspondences of :meth:`correspond`; its
            ``warnings`` tell what is doubtful: points left out, a scan coarser than the voxel that was asked
            for, a viewpoint that the scan contradicts, normals of the model that point inwards, and, where
            nothing is found, the factor between two units that would explain it. Empty, and no error, for a
            scan that holds nothing.

        Raises
        ------
        InputError
            As :func:`register`; the model has no normals, neither a viewpoint nor normals are given, or the
            scene cannot be in the unit of the model (``check_units``).
        TypeError, ValueError
            As :func:`register`.

        Examples
        --------
        >>> import ibi_rs as ibi, trimesh                                          # doctest: +SKIP
        >>> part = ibi.Model.from_mesh(trimesh.load("part.stl"))                   # doctest: +SKIP
        >>> found = part.detect(trimesh.load("scan.ply"), viewpoint=[0, 0, 0])     # doctest: +SKIP
        """
        if params is None:
            params = Params() if viewpoint is None else Params.single_view()
        params, num_threads = _limited(params, max_instances, timeout_s), _num_threads(num_threads)
        clock = Clock(params.timeout_s)
        try:
            with clock:
                matches, points = self._match(
                    tgt, tgt_normals, viewpoint, remove_plane, check_units, num_threads
                )
        except TimeoutError:
            return _nothing(params, self.spacing, clock)
        if matches.voxel > self._voxel and params.resolution is None:
            params = params.replace(resolution=matches.voxel / _detect.VOXELS_PER_SPACING)
        if viewpoint is not None and not isinstance(viewpoint, View):
            viewpoint = View(viewpoint, points)
        if clock.left_s == 0.0 or len(matches.corr) == 0:
            found = _nothing(params, self.spacing, clock)
        else:
            spent_s = clock.spent_s
            found = self.register(
                matches.tgt,
                matches.corr,
                params if clock.left_s is None else params.replace(timeout_s=clock.left_s),
                tgt_normals=matches.tgt_normals,
                similarity=matches.similarity,
                viewpoint=viewpoint,
                num_threads=num_threads,
                callback=callback,
            )
            found.params = params
            if found.stop_reason.name == "timeout":
                found.stop_reason = _timeout(found.timings.total_s + spent_s, params)
        found.warnings = matches.warnings
        if len(found) == 0 and len(points) >= _doubts.ENOUGH and found.stop_reason.name not in _STOPPED:
            doubt = _doubts.unit_warning(self.diameter, _detect.standing(points, _camera(viewpoint)[0]))
            found.warnings += () if doubt is None else (doubt,)
        return found

    def register(
        self,
        tgt: Points,
        corr: Any,
        params: Params | None = None,
        *,
        tgt_normals: npt.ArrayLike | None = None,
        tgt_frames: npt.ArrayLike | None = None,
        similarity: npt.ArrayLike | None = None,
        viewpoint: npt.ArrayLike | View | None = None,
        num_threads: int | None = None,
        max_instances: int | None = None,
        timeout_s: float | None = None,
        callback: Callable[[Round], object] | None = None,
    ) -> Registration:
        """Find every instance of this model in a scene: :func:`register` without the model's arguments.

        Parameters, returns, raises: those of :func:`register`.
        """
        params = _limited(params, max_instances, timeout_s)
        if callback is not None and not callable(callback):
            raise TypeError(f"callback must be callable, not {type(callback).__name__}")

        eye, measured = _camera(viewpoint)
        target, pairs, own = _points("tgt", tgt), _correspondences(corr), params._own()
        _doubts.check_step("tgt", target)
        if pairs.shape[1] == 6:
            _doubts.check_step("corr", pairs[:, :3], self.spacing)
            _doubts.check_step("corr", pairs[:, 3:])
        # Copies the scene for them, so only where there is one.
        run = Run(self._points, target, pairs, params.seed) if own else None
        raw = _core.register(
            self._source,
            target,
            pairs,
            params._json,
            tgt_normals=None if tgt_normals is None else _points("tgt_normals", tgt_normals),
            tgt_frames=None if tgt_frames is None else _frames("tgt_frames", tgt_frames),
            similarity=None if similarity is None else _vector("similarity", similarity),
            viewpoint=eye,
            measured=measured,
            num_threads=_num_threads(num_threads),
            on_round=None if callback is None else _on_round(callback),
            **({} if run is None else {name: run.stage(name, stage) for name, stage in own.items()}),
        )
        return _registration(raw, params)


_STOPPED = ("timeout", "cancelled")


def _limited(params: Params | None, max_instances: int | None, timeout_s: float | None) -> Params:
    """Return the parameters of a run."""
    params = params if params is not None else _DEFAULT
    if not isinstance(params, Params):
        raise TypeError(f"params must be ibi_rs.Params, not {type(params).__name__}")
    overrides = {"max_instances": max_instances, "timeout_s": timeout_s}
    overrides = {name: value for name, value in overrides.items() if value is not None}
    return params.replace(**overrides) if overrides else params


def _nothing(params: Params, spacing: float, clock: Clock) -> Registration:
    """Return what a scan gives that holds nothing to register, or for which there was no time."""
    message = f"few_correspondences: 0 alive, {_MIN_CORRESPONDENCES} needed"
    spent_s = clock.spent_s
    return Registration(
        [],
        labels=np.empty(0, np.int32),
        rounds="[]",
        stop_reason=_timeout(spent_s, params)
        if clock.left_s == 0.0
        else StopReason("few_correspondences", message, 0, _MIN_CORRESPONDENCES),
        timings=Timings(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, spent_s),
        resolution=spacing if params.resolution is None else params.resolution,
        params=params,
    )


_MIN_CORRESPONDENCES = 3


def _timeout(spent_s: float, params: Params) -> StopReason:
    """Say it in the words of the core."""
    message = f"timeout: {spent_s:.3f} s passed, {params.timeout_s:g} s allowed"
    return StopReason("timeout", message, spent_s, params.timeout_s)


def _on_round(callback: Callable[[Round], object]) -> Callable[[str], bool]:
    """Bring a round from the core to the user, and back whether to go on: unless the answer is False."""

    def on_round(text: str) -> bool:
        answer = callback(Round._from_dict(json.loads(text)))
        return bool(answer) if isinstance(answer, (bool, np.bool_)) else True

    return on_round


def _registration(raw: dict[str, Any], params: Params) -> Registration:
    columns = [raw[field.name] for field in fields(Pose)]
    return Registration(
        list(map(Pose, *columns)),
        labels=raw["labels"],
        rounds=raw["rounds"],
        stop_reason=StopReason(message=raw["stop_message"], **json.loads(raw["stop_reason"])),
        timings=Timings(**json.loads(raw["timings"])),
        resolution=raw["resolution"],
        params=params,
    )
