"""`Model`: a part that is checked and prepared once, for any number of scenes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from ibi_rs import _core, _log, _precision
from ibi_rs._box import Box
from ibi_rs._inputs import (
    Points,
    _correspondences,
    _frames,
    _frozen,
    _mesh,
    _num_threads,
    _number,
    _optional,
    _points,
    _vector,
)
from ibi_rs._matches import Matches, scan_arguments
from ibi_rs._numbers import significant
from ibi_rs._view import Viewpoint, _cameras, _preset
from ibi_rs.params import Params, _limited
from ibi_rs.registration import Registration, Round, on_round
from ibi_rs.stages import own_stages
from ibi_rs.symmetries import Symmetries, find_symmetries

_Floats = npt.NDArray[np.float64]


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
        by more than 0.05 of its size) the better one is returned, whatever the parameters; and of the poses
        that look like it the one turned least: :meth:`Registration.canonical`. By default none, and then none
        is dropped, nor turned.

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

    def __init__(
        self,
        src: Points,
        *,
        normals: npt.ArrayLike | None = None,
        frames: npt.ArrayLike | None = None,
        symmetries: Symmetries | None = None,
    ) -> None:
        self._hold(
            _points("src", src),
            _optional("src_normals", normals),
            None if frames is None else _frames("src_frames", frames),
            _symmetries(symmetries),
        )
        _precision.check_step("src", self._points, self.spacing)

    def _hold(
        self,
        points: _Floats,
        normals: _Floats | None,
        frames: _Floats | None,
        symmetries: Symmetries,
        mesh_voxel: tuple[float, bool] | None = None,
        fine: tuple[_Floats, _Floats] | None = None,
    ) -> None:
        self._core = _core.Model(points, normals, frames, symmetries._held, mesh_voxel, fine)
        self._symmetries = symmetries
        # Copies: the caller's arrays may change, the prepared model does not.
        self._points = _frozen(points.copy())
        self._normals = None if normals is None else _frozen(normals.copy())
        self._frames = None if frames is None else _frozen(frames.copy())

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
        if isinstance(symmetries, str) and symmetries != "find":
            raise _core.InputError(f"symmetries is {symmetries!r}; it must be 'find' or Symmetries")
        held = None if isinstance(symmetries, str) else _symmetries(symmetries)
        model = cls.__new__(cls)
        model._core = _core.Model.from_mesh(
            *mesh,
            None if voxel is None else _number("voxel", voxel),
            None if held is None else held._held,
            _num_threads(num_threads),
        )
        model._symmetries = Symmetries._of(model._core.symmetries()) if held is None else held
        model._points, model._frames = _frozen(model._core.points()), None
        normals = model._core.normals()
        model._normals = None if normals is None else _frozen(normals)
        _log.LOGGER.debug(
            "model: %d points on %d faces, voxel %s, %s",
            *(len(model), len(mesh[1]), significant(model.voxel), model.symmetries),
        )
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
        return self._core.spacing

    @property
    def voxel(self) -> float:
        """What :meth:`detect` thins a scene to, data units: the mesh's voxel, or 1.25 times the spacing.

        A scan that is coarser is thinned to what it can carry: ``Matches.voxel``.
        """
        return self._core.voxel

    @property
    def diameter(self) -> float:
        """Largest distance of two points, in data units; measured when first asked for."""
        return self._core.diameter(_num_threads(None))

    def __len__(self) -> int:
        return len(self._points)

    def __repr__(self) -> str:
        normals = "with" if self._normals is not None else "without"
        return f"Model({len(self)} points, {normals} normals, spacing {significant(self.spacing)})"

    def __getstate__(self) -> tuple[Any, ...]:
        core = self._core
        return self._points, self._normals, self._frames, self._symmetries, core.mesh_voxel, core.fine()

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self._hold(*state)

    def correspond(
        self,
        tgt: Points,
        *,
        tgt_normals: npt.ArrayLike | None = None,
        viewpoint: Viewpoint | None = None,
        remove_plane: bool | None = None,
        check_units: bool = True,
        roi: Box | npt.ArrayLike | None = None,
        background: Points | None = None,
        num_threads: int | None = None,
    ) -> Matches:
        """Match a scene with this model, which needs normals: the first half of :meth:`detect`.

        The scene is thinned to :attr:`voxel`, or to what it can carry if it is coarser, its table and walls
        taken away, its normals estimated; both clouds are described by FPFH over 6 voxels, and each scene
        point is joined to the four model points most like it.

        Parameters
        ----------
        tgt, tgt_normals, viewpoint, remove_plane, check_units, roi, background, num_threads
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
        scan = scan_arguments(
            tgt, tgt_normals, viewpoint, remove_plane, check_units, roi, background, num_threads
        )
        matches = Matches._of(_core.correspond(self._core, **scan))
        for warning in matches.warnings:
            _log.LOGGER.warning("correspond: %s", warning)
        _log.LOGGER.info(
            "correspond: %d points of %d left, thinned to a voxel of %s; %d correspondences",
            *(len(matches.tgt), len(scan["tgt"]), significant(matches.voxel), len(matches.corr)),
        )
        return matches

    def detect(
        self,
        tgt: Points,
        params: Params | None = None,
        *,
        tgt_normals: npt.ArrayLike | None = None,
        viewpoint: Viewpoint | None = None,
        remove_plane: bool | None = None,
        check_units: bool = True,
        roi: Box | npt.ArrayLike | None = None,
        background: Points | None = None,
        num_threads: int | None = None,
        max_instances: int | None = None,
        timeout_s: float | None = None,
        callback: Callable[[Round], object] | None = None,
        reference: Registration | npt.ArrayLike | None = None,
    ) -> Registration:
        """Find every instance of this model in a scan: :meth:`correspond`, then :meth:`register`.

        Parameters
        ----------
        tgt : (N, 3) or (H, W, 3) array_like
            The scan, as in :func:`register`, in the unit of the model. Points that are not finite are left
            out.
        params : Params, optional
            By default ``Params.single_view()`` with one to four viewpoints, else ``Params.many_views()``.
        tgt_normals : (N, 3) or (H, W, 3) array_like, optional
            Outwards. By default they are estimated, and face the viewpoint. A point whose normal is 0 or not
            finite gets that of its nearest point; where most are, they are refused.
        viewpoint : (3,) or (E, 3) array_like, View or sequence of View
            Where the depth camera stood, in the frame of ``tgt``: ``[0, 0, 0]`` for most scans. Where ``tgt``
            is not all that it measured, a :class:`View` of all. Of several cameras, or of one that moved,
            the places of all, or a View of each; what one of them sees was seen. It may be left out where
            normals are given: then places from which one could see the scene stand for the cameras.
        remove_plane : bool, optional
            Whether the plane with most points is taken away. By default it is where it looks like a table:
            less than 2 % of the points lie behind it, as the viewpoint sees it. Flat faces that are half as
            long or wide again as any of the model are taken away unless this is False: walls, other parts.
        check_units : bool, default True
            Whether a scan is refused that is 10 times smaller than the model or 300 times larger. What counts
            is the box around all points but the outermost hundredth on each side; fewer than 100 points tell
            nothing.
        roi : Box or (2, 3) array_like, optional
            What of the scan is looked into: a :class:`Box`, or the corners of the least and of the largest
            coordinates of one along the axes of the scan, data units. What lies outside is neither searched
            nor matched, but what was measured there still tells where there is nothing. By default all.
        background : (M, 3) or (H, W, 3) array_like, optional
            What the same camera measured of the empty bin, in the frame of ``tgt``. What lies within a voxel
            of it is neither searched nor matched, as beyond a ``roi``. Points that are not finite are left
            out.
        num_threads, max_instances, callback
            As in :func:`register`.
        timeout_s : float, optional
            Overrides that of ``params``; counted from this call. Where time runs out before the first round,
            the result is empty.
        reference : Registration, (4, 4) or (K, 4, 4) array_like, optional
            Of a model with symmetries, against what poses are turned least: as in
            :meth:`Registration.canonical`.

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
            params = _preset(viewpoint)
        params = _limited(params, max_instances, timeout_s)
        scan = scan_arguments(
            tgt, tgt_normals, viewpoint, remove_plane, check_units, roi, background, num_threads
        )
        own = params._own()
        raw = _core.detect(
            self._core,
            params=params._json,
            on_round=None if callback is None else on_round(callback),
            own=partial(own_stages, own, params.seed, self._points) if own else None,
            **scan,
        )
        if raw["resolution_set"] != params.resolution:
            params = params.replace(resolution=raw["resolution_set"])
        found = Registration._of(raw, params)
        _log.ended("detect", f"{len(scan['tgt'])} points, {len(found.labels)} correspondences", found)
        return self._turned(found, reference)

    def register(
        self,
        tgt: Points,
        corr: Any,
        params: Params | None = None,
        *,
        tgt_normals: npt.ArrayLike | None = None,
        tgt_frames: npt.ArrayLike | None = None,
        similarity: npt.ArrayLike | None = None,
        viewpoint: Viewpoint | None = None,
        num_threads: int | None = None,
        max_instances: int | None = None,
        timeout_s: float | None = None,
        callback: Callable[[Round], object] | None = None,
        reference: Registration | npt.ArrayLike | None = None,
    ) -> Registration:
        """Find every instance of this model in a scene: :func:`register` without the model's arguments.

        Parameters, returns, raises: those of :func:`register`; ``reference``: as in :meth:`detect`.
        """
        params = _limited(params, max_instances, timeout_s)
        eye, measured = _cameras(viewpoint)
        target, pairs = _points("tgt", tgt), _correspondences(corr)
        _precision.check_step("tgt", target)
        if pairs.shape[1] == 6:
            _precision.check_step("corr", pairs[:, :3], self.spacing)
            _precision.check_step("corr", pairs[:, 3:])
        raw = _core.register(
            self._core,
            target,
            pairs,
            params._json,
            tgt_normals=_optional("tgt_normals", tgt_normals),
            tgt_frames=None if tgt_frames is None else _frames("tgt_frames", tgt_frames),
            similarity=None if similarity is None else _vector("similarity", similarity),
            viewpoint=eye,
            measured=measured,
            num_threads=_num_threads(num_threads),
            on_round=None if callback is None else on_round(callback),
            own=own_stages(params._own(), params.seed, self._points, target, pairs),
        )
        found = Registration._of(raw, params)
        _log.ended("register", f"{len(target)} points, {len(pairs)} correspondences", found)
        return self._turned(found, reference)

    def _turned(self, found: Registration, reference: Any) -> Registration:
        """Of the poses that look the same give those turned least."""
        return found if self._symmetries.is_none else found.canonical(self._symmetries, reference)


def _symmetries(value: Symmetries | None) -> Symmetries:
    if value is None:
        return Symmetries.none()
    if not isinstance(value, Symmetries):
        raise TypeError(f"symmetries must be ibi_rs.Symmetries, not {type(value).__name__}")
    return value
