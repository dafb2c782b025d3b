"""Motions of a model that leave it looking the same: declared, or found on its surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ibi_rs import _core
from ibi_rs._core import InputError
from ibi_rs._files import read_json
from ibi_rs._inputs import Points, _aligned, _floats, _frozen, _number, _optional, _points, _real

__all__ = ["Axis", "Symmetries", "find_symmetries"]

_Floats = npt.NDArray[np.float64]

_ROUNDED = 1e-3
"""How far a rotation may be from one, per entry of R R^T: files hold few digits."""


class Axis(NamedTuple):
    """A line that a model may be turned about by any angle."""

    axis: npt.NDArray[np.float64]
    """(3,), of length 1."""
    offset: npt.NDArray[np.float64]
    """(3,): a point of the line, data units."""


@dataclass(frozen=True, eq=False, init=False)
class Symmetries:
    """The proper symmetries of a model, in its frame: motions, and an axis to turn it about, if there is one.

    What is listed counts as it is, as in BOP, and is not completed to a group: list all.

    Parameters
    ----------
    discrete : (S, 4, 4) array_like, optional
        Rigid motions, of which the identity need not be named. Rotations may be rounded to three digits.
    continuous : sequence of (axis, offset), optional
        Lines to turn about by any angle: a direction, of any length, and a point. Lines that meet stand for
        all rotations about that point: a ball.

    Attributes
    ----------
    discrete : (S, 4, 4) float64
        The identity first; read-only.
    continuous : tuple of Axis
        None, one, or three for a ball.

    Raises
    ------
    InputError
        A shape is wrong, a number is not finite, a matrix is no rigid motion or a reflection, an axis has no
        length, or two of them do not meet.
    TypeError
        An array is not made of real numbers.

    See Also
    --------
    find_symmetries, Model.find_symmetries

    References
    ----------
    Hodan et al., "BOP challenge 2020 on 6D object localization", ECCV workshops 2020.

    Examples
    --------
    >>> import numpy as np, ibi_rs as ibi
    >>> tee = ibi.Symmetries([np.diag([-1, -1, 1, 1])])  # half a turn about z
    >>> flipped = np.diag([-1, -1, 1, 1])
    >>> ibi.metrics.rotation_error_deg(flipped, np.eye(4), symmetries=tee)
    0.0
    >>> can = ibi.Symmetries(continuous=[([0, 0, 1], [0, 0, 0])])
    >>> can
    Symmetries(1 motion, any turn about [0, 0, 1])
    """

    discrete: npt.NDArray[np.float64]
    continuous: tuple[Axis, ...]
    if TYPE_CHECKING:
        _held: _core.Symmetries  # what the core takes; no field

    def __init__(self, discrete: npt.ArrayLike = (), continuous: Sequence[Any] = ()) -> None:
        if not isinstance(continuous, Sequence):
            raise TypeError(f"continuous must be a list of pairs, not {type(continuous).__name__}")
        axes = [_axis(f"continuous[{row}]", given) for row, given in enumerate(continuous)]
        rows = (np.array([axis[k] for axis in axes], dtype=np.float64).reshape(-1, 3) for k in (0, 1))
        self._hold(_core.Symmetries(_motions("discrete", discrete), *rows))

    def _hold(self, core: _core.Symmetries) -> None:
        discrete, axes, offsets = core.arrays()
        lines = (Axis(_frozen(a.copy()), _frozen(p.copy())) for a, p in zip(axes, offsets, strict=True))
        for name, value in (("_held", core), ("discrete", _frozen(discrete)), ("continuous", tuple(lines))):
            object.__setattr__(self, name, value)

    @classmethod
    def _of(cls, core: _core.Symmetries) -> Symmetries:
        made = cls.__new__(cls)
        made._hold(core)
        return made

    @classmethod
    def none(cls) -> Symmetries:
        """Of a model that looks different from everywhere: the identity alone."""
        return cls()

    @classmethod
    def from_bop(
        cls, info: dict[str, Any] | str | Path, obj_id: int | None = None, *, scale: float = 1.0
    ) -> Symmetries:
        """Read what a BOP dataset declares of an object.

        Parameters
        ----------
        info : dict, str or Path
            The entry of one object, or a ``models_info.json``, read or by its path.
        obj_id : int, optional
            Which object; may be left out where there is one.
        scale : float, default 1.0
            Data units per millimetre, in which BOP gives lengths: 0.001 for metres.

        Returns
        -------
        Symmetries
            None, where the object declares none.

        Raises
        ------
        InputError
            The file cannot be read or is of another kind, has no such object or several to choose from, or
            declares what is no symmetry.
        """
        entry = _bop_entry(info, obj_id)
        scale = _number("scale", scale)
        try:
            return cls._from_entry(entry, scale)
        except (InputError, TypeError) as error:
            if isinstance(info, dict):
                raise
            raise InputError(f"{info}: {error}") from None

    @classmethod
    def _from_entry(cls, entry: dict[str, Any], scale: float) -> Symmetries:
        motions = []
        for row, numbers in enumerate(_listed(entry, "symmetries_discrete")):
            matrix = _real(f"symmetries_discrete[{row}]", numbers).astype(np.float64)
            if matrix.size != 16:
                raise InputError(
                    f"symmetries_discrete[{row}] has {matrix.size} numbers; it must be 16, by rows"
                )
            matrix = matrix.reshape(4, 4)
            matrix[:3, 3] *= scale
            motions.append(matrix)
        lines = []
        for row, line in enumerate(_listed(entry, "symmetries_continuous")):
            if not isinstance(line, dict) or not {"axis", "offset"} <= set(line):
                raise InputError(f"symmetries_continuous[{row}] must have an 'axis' and an 'offset'")
            axis, offset = _axis(f"symmetries_continuous[{row}]", (line["axis"], line["offset"]))
            lines.append((axis, scale * offset))
        try:
            return cls(motions, lines)
        except InputError as error:  # of `discrete` or `continuous`
            raise InputError(f"symmetries_{error}") from None

    def to_bop(self, *, scale: float = 1.0) -> dict[str, Any]:
        """Return the two entries of BOP's ``models_info.json``, those that are not empty.

        Parameters
        ----------
        scale : float, default 1.0
            Data units per millimetre, as in :meth:`from_bop`.
        """
        scale = _number("scale", scale)
        motions = self.discrete[1:].copy()
        motions[:, :3, 3] /= scale
        lines = [{"axis": axis.tolist(), "offset": (p / scale).tolist()} for axis, p in self.continuous]
        entry = {"symmetries_discrete": motions.reshape(-1, 16).tolist(), "symmetries_continuous": lines}
        return {name: rows for name, rows in entry.items() if rows}

    @property
    def is_none(self) -> bool:
        """Whether the identity is all there is."""
        return len(self.discrete) == 1 and not self.continuous

    def discretised(self, max_step: float = 0.01) -> npt.NDArray[np.float64]:
        """List them all: each motion with each of the turns about the axis, in small steps.

        Parameters
        ----------
        max_step : float, default 0.01
            No point within half a diameter of the axis moves farther than so many diameters from one turn to
            the next. The default is BOP's, and makes 315 turns. From 1e-5 to 1.

        Returns
        -------
        (S, 4, 4) float64
            The identity first. Of a ball's rotations, which are too many, the turns about three axes.

        Raises
        ------
        InputError
            The step is out of its range.
        """
        return self._held.discretised(_number("max_step", max_step))

    def equivalents(self, pose: npt.ArrayLike, max_step: float = 0.01) -> npt.NDArray[np.float64]:
        """All poses that look like a pose, itself first: it, after each of :meth:`discretised`.

        Parameters
        ----------
        pose : (4, 4) array_like
            A rigid motion; or a :class:`Pose`.
        max_step : float, default 0.01
            As in :meth:`discretised`.

        Returns
        -------
        (S, 4, 4) float64
        """
        poses: _Floats = _pose("pose", pose) @ self.discretised(max_step)
        return poses

    def nearest(self, pose: npt.ArrayLike, reference: npt.ArrayLike | None = None) -> npt.NDArray[np.float64]:
        """Of the poses that look like a pose the one turned least against a reference.

        Turns about an axis are solved for. Of equals it is the one listed first.

        Parameters
        ----------
        pose : (4, 4) or (K, 4, 4) array_like
            Rigid motions; or a :class:`Pose`, or a :class:`Registration`.
        reference : (4, 4) array_like, optional
            Where it would best be: that of the gripper. By default the identity, which makes poses of one
            look one.

        Returns
        -------
        ndarray of the shape of ``pose``

        Raises
        ------
        ValueError
            A shape is wrong, or a matrix no rigid motion.

        Examples
        --------
        >>> import numpy as np, ibi_rs as ibi
        >>> bottle = ibi.Symmetries(continuous=[([0, 0, 1], [0, 0, 0])])
        >>> turned = np.array([[0.0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]])
        >>> np.allclose(bottle.nearest(turned), [[1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]])
        True
        """
        given = _real("pose", getattr(pose, "target_from_source", pose))
        if given.shape[-2:] != (4, 4) or given.ndim not in (2, 3):
            raise InputError(f"pose has shape {given.shape}; it must be (4, 4) or (K, 4, 4)")
        about = np.eye(4) if reference is None else _pose("reference", reference)
        nearest: _Floats = self._held.nearest(_aligned(given.reshape(-1, 4, 4), np.float64), about)
        return nearest.reshape(given.shape)

    def __repr__(self) -> str:
        motions = f"{len(self.discrete)} motion{'s' * (len(self.discrete) > 1)}"
        if self._held.is_ball:
            return f"Symmetries({motions}, any rotation)"
        turns = (
            f"any turn about [{', '.join(f'{x + 0.0:.3g}' for x in axis)}]" for axis, _ in self.continuous
        )
        return f"Symmetries({', '.join([motions, *turns])})"

    def __reduce__(self) -> tuple[Any, ...]:
        return Symmetries, (self.discrete, self.continuous)


def find_symmetries(
    points: Points, normals: npt.ArrayLike | None = None, *, tolerance: float = 0.03
) -> Symmetries:
    """Find the rotations that leave a model looking the same, within a tolerance.

    The surface is registered with itself: turns about 400 axes are polished by ICP, those that fit checked on
    2000 points, both ways, and completed to the largest group of which every member fits. Reflections are
    none.

    Parameters
    ----------
    points : (N, 3) array_like
        Spread over the surface of the model, as in :func:`register`; at least 10.
    normals : (N, 3) array_like, optional
        Their normals, of either sign; estimated by default.
    tolerance : float, default 0.03
        How far the moved surface may be off the unmoved one, in diameters: 98 % of the points by no more,
        none by more than twice that. From 0.001 to 0.05. Points 1/24 of the diameter apart, as those of
        :meth:`Model.from_mesh`, cannot tell less than 0.03; denser ones tell finer details.

    Returns
    -------
    Symmetries
        A group to rounding: the identity alone, finite, turns about an axis, or those of a ball.

    Raises
    ------
    InputError
        There are fewer than 10 points, a value is not finite, or the tolerance is out of its range.

    Examples
    --------
    >>> import numpy as np, ibi_rs as ibi
    >>> rng = np.random.default_rng(0)
    >>> angle, height = rng.uniform(0, 2 * np.pi, 2000), rng.uniform(-1, 1, 2000)
    >>> tube = np.column_stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), height])
    >>> len(ibi.find_symmetries(tube).continuous), len(ibi.find_symmetries(tube).discrete)
    (1, 2)
    """
    core = _core.symmetries_find(
        _points("points", points), _optional("normals", normals), _number("tolerance", tolerance)
    )
    return Symmetries._of(core)


def _motions(name: str, value: npt.ArrayLike) -> _Floats:
    """(S, 4, 4) of exact rotations, from what may be rounded."""
    motions = np.array(_floats(name, value, "S", 4, 4))
    for row, motion in enumerate(motions):
        rotation = motion[:3, :3]
        if not np.isfinite(motion).all():
            raise InputError(f"{name}[{row}] must be finite")
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROUNDED or (motion[3] != [0, 0, 0, 1]).any():
            raise InputError(f"{name}[{row}] is no rigid motion")
        if np.linalg.det(rotation) < 0:
            raise InputError(f"{name}[{row}] is a reflection, of determinant -1; no part can be moved so")
        u, _, vt = np.linalg.svd(rotation)
        motion[:3, :3] = u @ vt
    return motions


def _axis(name: str, given: Any) -> tuple[_Floats, _Floats]:
    if isinstance(given, (dict, str)) or not hasattr(given, "__len__") or len(given) != 2:
        raise InputError(f"{name} must be a pair (axis, offset)")
    arrays = [_real(name, part) for part in given]
    if any(array.shape != (3,) for array in arrays):
        raise InputError(f"{name} must be a pair of shapes (3,) and (3,)")
    axis, offset = (array.astype(np.float64) for array in arrays)
    return axis, offset


def _pose(name: str, value: Any) -> _Floats:
    return _floats(name, getattr(value, "target_from_source", value), 4, 4)


def _listed(entry: dict[str, Any], name: str) -> list[Any]:
    rows = entry.get(name, [])
    if not isinstance(rows, (list, tuple, np.ndarray)):
        raise InputError(f"{name} must be a list, not {type(rows).__name__}")
    return list(rows)


_BOP_KEYS = {"diameter", "symmetries_discrete", "symmetries_continuous"}


def _bop_entry(info: dict[str, Any] | str | Path, obj_id: int | None) -> dict[str, Any]:
    if isinstance(info, dict):
        return _entry_of(info, obj_id, "info")
    if not isinstance(info, (str, Path)):
        raise TypeError(f"info must be a dict or a path, not {type(info).__name__}")
    held = read_json(info)
    if not isinstance(held, dict):
        raise InputError(f"{info}: it must be a JSON object, by the numbers of the objects")
    entry = _entry_of(held, obj_id, str(info))
    if entry and not _BOP_KEYS & set(entry):
        raise InputError(
            f"{info}: is no models_info.json of BOP: it has none of {', '.join(sorted(_BOP_KEYS))}"
        )
    return entry


def _entry_of(info: dict[str, Any], obj_id: int | None, name: str) -> dict[str, Any]:
    objects = {key: entry for key, entry in info.items() if str(key).isdecimal() and isinstance(entry, dict)}
    if not objects:
        return info
    if obj_id is None and len(objects) == 1:
        return next(iter(objects.values()))
    if obj_id is None:
        raise InputError(f"obj_id: {name} has the objects {_some(objects)}; give one of them")
    for key, entry in objects.items():
        if int(key) == obj_id:
            return entry
    raise InputError(f"obj_id is {obj_id}; {name} has {_some(objects)}")


def _some(names: dict[Any, Any]) -> str:
    shown = ", ".join(map(str, list(names)[:20]))
    return f"{shown}, ..." if len(names) > 20 else shown


def _as_symmetries(value: Symmetries | npt.ArrayLike | None) -> _core.Symmetries:
    """Make what the core takes of what metrics are given."""
    if isinstance(value, Symmetries):
        return value._held
    nothing = np.empty((0, 3))
    return _core.Symmetries(_motions("symmetries", () if value is None else value), nothing, nothing)
