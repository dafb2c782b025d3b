"""What a registration returns: poses, labels, and how the run came to them."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, overload

import numpy as np
import numpy.typing as npt

from ibi_rs import _written
from ibi_rs._core import InputError
from ibi_rs._files import read_json, written
from ibi_rs._numbers import lengths, significant
from ibi_rs.params import Params
from ibi_rs.symmetries import Symmetries


@dataclass(frozen=True)
class Measures:
    """What was measured of a pose close up, on all that one camera measured; numbers of points.

    Attributes
    ----------
    supported, contradicted, buried, hidden, unknown : int
        Model points that the camera could see: measured where they should be; looked through; a little
        behind what was measured; behind something else; where nothing was measured.
    runs_on, ends : int
        Places just beyond the ends of its faces where the scene goes on in the face's plane, and where it
        does not.
    beyond, on : int
        Points of the thinned scan around it that carry its surface on, and points on it.
    losses : tuple of float
        How much worse it fits when it is moved, by 1.5 voxels or more where the scan is noisy, along the
        three motions that are held least: near 0 where nothing holds it.
    noise : float
        Standard deviation of the scan across its surfaces, in voxels.
    blur : float
        The noise times the spacing of the measured points, both in 24ths of the part's diagonal: that of all
        points in a detail together.
    edges : float or None
        How sharp the scan's edges are: near 1 where rays end on one surface or the other, small where the
        camera has smoothed the step between them; None where hardly any edge is near.
    closeness, evidence : float
        As of a :class:`Pose`, among the points that no other pose owned then.
    company : float
        What other poses of the part that are sure by themselves add to the log odds.
    """

    supported: int
    contradicted: int
    buried: int
    hidden: int
    unknown: int
    runs_on: int
    ends: int
    beyond: int
    on: int
    losses: tuple[float, float, float]
    noise: float
    blur: float
    edges: float | None
    closeness: float
    evidence: float
    company: float

    @classmethod
    def _of(cls, raw: dict[str, Any]) -> Measures:
        tally, contour, overrun = raw["tally"], raw["contour"], raw["overrun"]
        return cls(
            supported=tally["supported"],
            contradicted=tally["contradicted"],
            buried=tally["buried"],
            hidden=tally["hidden"],
            unknown=tally["unknown"],
            runs_on=contour["runs_on"],
            ends=contour["ends"],
            beyond=overrun["beyond"],
            on=overrun["on"],
            losses=tuple(raw["losses"]),
            noise=raw["noise"],
            blur=raw["blur"],
            edges=raw["edges"],
            closeness=raw["closeness"],
            evidence=raw["evidence"],
            company=raw["company"],
        )


@dataclass(frozen=True, eq=False)
class FreeMotion:
    """A motion of a pose that nothing holds.

    Attributes
    ----------
    kind : str
        ``slide`` along the direction, or ``turn`` about an axis along it.
    direction : (3,) float64
        Unit vector, up to sign; target's frame.
    point : (3,) float64 or None
        The point of the axis that is nearest to the pose's ``centre``, target's frame, data units; None for a
        slide.
    pitch : float
        How far a turn of one radian slides along the axis, data units: 0 for a slide and a plain turn.
    """

    kind: str
    direction: npt.NDArray[np.float64]
    point: npt.NDArray[np.float64] | None = None
    pitch: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain numbers and lists, for JSON."""
        point = None if self.point is None else self.point.tolist()
        return {"kind": self.kind, "direction": self.direction.tolist(), "point": point, "pitch": self.pitch}

    @classmethod
    def _of(cls, raw: dict[str, Any]) -> FreeMotion:
        ((kind, of),) = raw.items()
        if kind == "slide":
            return cls(kind, np.array(of["along"]))
        return cls(kind, np.array(of["about"]), np.array(of["through"]), of["pitch"])


@dataclass(frozen=True, eq=False)
class Rejected:
    """A pose that passed validation and was given up when it was looked at close up.

    Attributes
    ----------
    target_from_source : (4, 4) float64
        Where it was.
    score : float
        The probability that it is right, 0 to 1.
    objection : str
        What speaks most against it: ``contradicted`` (the camera looked through it), ``runs_on`` (the scene
        goes on where its faces should end), ``overrun`` (points around it carry its surface on), ``slips``
        (moved a little, it fits as well), ``loose`` (its surface lies off what was measured), ``outdone``
        (better poses of other models explain too many of its points: :class:`Models`).
    round : int
        The round that found it.
    measures : Measures or None
        What was measured of it close up; None where an outdone one was not looked at so.
    model : int
        Index of its model, 0 where there is but one.
    model_name : str or None
        Its name in :class:`Models`.
    """

    target_from_source: npt.NDArray[np.float64] = field(repr=False)
    score: float
    objection: str
    round: int
    measures: Measures | None
    model: int = 0
    model_name: str | None = None


@dataclass(frozen=True, eq=False)
class Pose:
    """One instance.

    Attributes
    ----------
    target_from_source : (4, 4) float64
        Moves source points onto this instance; acts on column vectors, translation in data units.
    score : float
        The probability that the pose is right, 0 to 1, by ``evidence``, ``closeness`` and ``back_fit``; what
        poses are ranked by. On a scan of one view it means little, unless normals are oriented and the
        viewpoint is given.
    overlap : float
        Share of source points within ``d_op`` of a target point, 0 to 1.
    closeness : float
        How much closer the source lies to target points that no other pose owns than chance would put it:
        0 as by chance, 1 perfect; below 0 if worse than by chance. In a scene seen from one side 1 is as
        close as its own points lie to each other on average; where a part is smoother than the rest, it is
        more.
    back_fit : float
        Mean over the correspondences whose target point lies within 2 ``d_op`` of this instance, and belongs
        to no other pose, of 1 - d / 2 ``d_op``, d being that distance, 0 to 1.
    evidence : float
        -log10 of the chance that as many correspondences would agree if they knew nothing of their targets.
    inlier_rmse : float
        Root mean square residual of the inliers in data units; 0 without inliers.
    inliers : (I,) int64
        Rows of ``corr`` with a residual below ``t_he``, ascending. A row may be an inlier of several poses.
    round : int
        The round that found it.
    measures : Measures or None
        What was measured of it close up, where the scene is seen from one side and judged by
        :class:`Evidence`; the
        score is theirs then.
    model : int
        Index of its model, 0 where there is but one.
    model_name : str or None
        Its name in :class:`Models`.
    centre : (3,) float64
        c, the centre of the source's bounding box where the pose puts it: ``target_from_source`` applied to
        the middle of the least and the largest source coordinates. Target's frame, data units.
    covariance : (6, 6) float64 or None
        How far the pose may be off, where all that a camera measured was given (:meth:`Model.detect` with a
        viewpoint, or a :class:`View`) and a last polish was made on it; else None. Of a small motion in the
        target's frame about ``centre``, a left perturbation: the true pose is x -> c + exp([w]) (x - c) + t
        after this one. Order: w_x, w_y, w_z (radians), t_x, t_y, t_z (data units). It is for a pose that is
        right, and says nothing of whether it is: that is what ``score`` is for. What nothing holds is known
        to within the size of the part. Not in it is what is the same over a whole scan, as a wrong scale.
    free_motions : tuple of FreeMotion
        The motions that nothing holds, slides first: those whose standard deviation exceeds a voxel, at a
        point as far from the centre as the source reaches. Empty where all are held, and where there is no
        covariance.
    """

    target_from_source: npt.NDArray[np.float64]
    score: float
    overlap: float
    closeness: float
    back_fit: float
    evidence: float
    inlier_rmse: float
    inliers: npt.NDArray[np.int64] = field(repr=False)
    round: int
    measures: Measures | None = field(default=None, repr=False)
    centre: npt.NDArray[np.float64] = field(default_factory=partial(np.zeros, 3), repr=False)
    covariance: npt.NDArray[np.float64] | None = field(default=None, repr=False)
    free_motions: tuple[FreeMotion, ...] = field(default=(), repr=False)
    model: int = 0
    model_name: str | None = None

    @property
    def transformation(self) -> npt.NDArray[np.float64]:
        """``target_from_source`` under Open3D's name."""
        return self.target_from_source

    @property
    def num_inliers(self) -> int:
        """Number of inliers."""
        return len(self.inliers)

    def canonical(self, symmetries: Symmetries, reference: npt.ArrayLike | None = None) -> Pose:
        """Of the poses that look like this one the one turned least against a reference.

        Parameters
        ----------
        symmetries : Symmetries
            Of the model.
        reference : (4, 4) array_like, optional
            As in :meth:`Symmetries.nearest`: by default the identity.

        Returns
        -------
        Pose
            Its measures and ``inliers`` are those of the pose that was found.
        """
        return replace(self, target_from_source=symmetries.nearest(self.target_from_source, reference))

    def __repr__(self) -> str:
        # It does not know the resolution.
        return self._shown(max(self.inlier_rmse, 1e-7 * np.abs(self.target_from_source[:3, 3]).max()))

    def _shown(self, scale: float) -> str:
        """In a line, with lengths that are rounded by a scale."""
        t = ", ".join(lengths(self.target_from_source[:3, 3], scale))
        name = "" if self.model_name is None else f"{self.model_name!r}, "
        return (
            f"Pose({name}score={self.score:.3f}, overlap={self.overlap:.3f}, num_inliers={self.num_inliers}, "
            f"inlier_rmse={significant(self.inlier_rmse, 3)}, translation=[{t}])"
        )


@dataclass(frozen=True)
class Verdict:
    """A measured value against its threshold.

    Attributes
    ----------
    value : float
        What was measured.
    threshold : float
        What it must exceed.
    """

    value: float
    threshold: float

    @property
    def accepted(self) -> bool:
        """Whether the value exceeds the threshold."""
        return self.value > self.threshold


@dataclass(frozen=True)
class Round:
    """One pass through the four stages.

    Attributes
    ----------
    index : int
        Number of the round, from 0.
    num_alive : int
        Correspondences alive at its start.
    num_seeds : int
        N_s, seeds found.
    num_dense : int
        Size of C_d.
    num_samples, num_degenerate : int
        Samples drawn by the transformation estimation, and those of them skipped as degenerate.
    capped : bool
        Whether a limit ended the search for samples early, such as ``max_triangles`` of :class:`SacCot`;
        there may be better ones.
    hypothesis_score : float or None
        Score of the hypothesis; None if there was none.
    verdict : Verdict or None
        What validation measured; None if there was no hypothesis.
    num_removed : int
        Correspondences removed at its end.
    num_barred : int
        Correspondences barred at its end from leading a seed selection.
    """

    index: int
    num_alive: int
    num_seeds: int
    num_dense: int
    num_samples: int
    num_degenerate: int
    capped: bool
    hypothesis_score: float | None
    verdict: Verdict | None
    num_removed: int
    num_barred: int

    @property
    def accepted(self) -> bool:
        """Whether the hypothesis passed validation."""
        return self.verdict is not None and self.verdict.accepted

    @classmethod
    def _from_dict(cls, data: dict[str, Any]) -> Round:
        verdict = data["verdict"]
        return cls(**{**data, "verdict": verdict and Verdict(**verdict)})


def on_round(callback: Callable[[Round], object]) -> Callable[[str], bool]:
    """Bring a round from the core to the user, and back whether to go on: unless the answer is False."""
    if not callable(callback):
        raise TypeError(f"callback must be callable, not {type(callback).__name__}")

    def told(text: str) -> bool:
        answer = callback(Round._from_dict(json.loads(text)))
        return bool(answer) if isinstance(answer, (bool, np.bool_)) else True

    return told


@dataclass(frozen=True)
class StopReason:
    """Why a run ended.

    Attributes
    ----------
    name : str
        ``few_seeds``, ``few_correspondences``, ``max_rejections``, ``max_rounds``, ``max_instances``,
        ``timeout``, ``cancelled`` or ``stalled``.
    value, threshold : float or None
        The measured number and its limit, where there is one.
    message : str
        Both in words.
    """

    name: str
    message: str
    value: float | None = None
    threshold: float | None = None

    @classmethod
    def _of(cls, raw: str, message: str) -> StopReason:
        return cls(message=message, **json.loads(raw))

    def __str__(self) -> str:
        return self.message


@dataclass(frozen=True)
class Timings:
    """Seconds of wall time.

    Attributes
    ----------
    prepare_s : float
        Checking the input, grids, resolution.
    scs_s, ce_s, te_s, refine_s, hv_s : float
        The four stages and the refinement between the last two, all rounds. Where the seeds of a round are
        selected while the one before it is played, they count the seconds of both.
    total_s : float
        From the beginning of the run to its result.
    """

    prepare_s: float
    scs_s: float
    ce_s: float
    te_s: float
    refine_s: float
    hv_s: float
    total_s: float


def _free_motions(text: str) -> list[tuple[FreeMotion, ...]]:
    return [tuple(map(FreeMotion._of, of)) for of in json.loads(text)]


class Registration(Sequence[Pose]):
    """The instances found, best score first: a sequence of :class:`Pose`.

    ``np.asarray(registration)`` is the (K, 4, 4) float64 array of the poses.

    Attributes
    ----------
    labels : (M,) int32
        For each correspondence the pose it fits best with a residual below ``t_he``, -1 for none.
    rounds : tuple of Round
        One entry per round that was played to its end.
    stop_reason : StopReason
        Why the run ended.
    timings : Timings
        Where the time went, in seconds.
    resolution : float
        pr in data units.
    params : Params
        The parameters of the run.
    rejected : tuple of Rejected
        What passed validation and was given up when it was looked at close up, best score first; at most 100.
    warnings : tuple of str
        What is doubtful about the input, one line each: :meth:`Model.detect` looks for it. Mostly empty.
    models : tuple of str
        Names of the models, if they are of :class:`Models`; else empty.
    symmetries : tuple of Symmetries
        Those of each model by which the poses were turned least; empty where none were.
    background : (K, 3) float64
        What of the thinned scan :meth:`Model.detect` took away: table, walls, and what lies on the
        ``background`` that was given. Of several models that of the first. Not in files.
    """

    symmetries: tuple[Symmetries, ...] = ()
    background: npt.NDArray[np.float64] = np.empty((0, 3))

    def __init__(
        self,
        poses: Sequence[Pose],
        *,
        labels: npt.NDArray[np.int32],
        rounds: str,
        stop_reason: StopReason,
        timings: Timings,
        resolution: float,
        params: Params,
        rejected: Sequence[Rejected] = (),
        warnings: Sequence[str] = (),
        parts: Mapping[str, Registration] | None = None,
    ) -> None:
        self.poses = tuple(poses)
        self.labels = labels
        self._rounds = rounds  # JSON: few look at them, and reading them takes as long as the rest of this
        self.stop_reason = stop_reason
        self.timings = timings
        self.resolution = resolution
        self.params = params
        self.rejected = tuple(rejected)
        self.warnings = tuple(warnings)
        self._parts = dict(parts or {})

    @property
    def models(self) -> tuple[str, ...]:
        """Names of the models, if they are of :class:`Models`; else empty."""
        return tuple(self._parts)

    def of(self, model: int | str) -> Registration:
        """Return what was found of one model.

        Parameters
        ----------
        model : int or str
            Its index, or its name in :class:`Models`.

        Returns
        -------
        Registration
            Its ``labels`` and ``inliers`` are rows of the correspondences of that model alone.

        Raises
        ------
        IndexError, KeyError
            There is no such model.
        """
        if isinstance(model, str):
            if model not in self._parts:
                names = ", ".join(map(repr, self._parts)) or "none with a name"
                raise KeyError(f"model {model!r}; there are {names}")
            return self._parts[model]
        return (tuple(self._parts.values()) or (self,))[model]

    @classmethod
    def _of_part(cls, raw: dict[str, Any], params: Params, model: int, name: str) -> Registration:
        """Dress what the core gives of one model of several."""
        if raw["resolution_set"] != params.resolution:
            params = params.replace(resolution=raw["resolution_set"])
        found = cls._of(raw, params)
        found.poses = tuple(replace(pose, model=model, model_name=name) for pose in found.poses)
        found.rejected = tuple(replace(pose, model=model, model_name=name) for pose in found.rejected)
        return found

    @classmethod
    def _of_parts(
        cls,
        names: Sequence[str],
        parts: Sequence[Registration],
        ranking: Sequence[Sequence[int]],
        params: Params,
        stop_reason: StopReason,
        total_s: float,
    ) -> Registration:
        """Put several models together, their poses in the order of `ranking`: pairs of model and pose."""
        starts = np.cumsum([0, *(len(part.labels) for part in parts)])
        place = {(model, pose): at for at, (model, pose) in enumerate(ranking)}
        poses, labels = [], []
        for model, pose in ranking:
            found = parts[model].poses[pose]
            poses.append(replace(found, inliers=found.inliers + starts[model]))
        for model, part in enumerate(parts):
            # -1, of none, is the last of them.
            new = np.array([*(place[model, pose] for pose in range(len(part))), -1], dtype=np.int32)
            labels.append(new[part.labels])
        rejected = sorted((one for part in parts for one in part.rejected), key=lambda one: -one.score)
        seconds = {
            name: sum(getattr(part.timings, name) for part in parts)
            for name in (field.name for field in fields(Timings))
        }
        texts = dict.fromkeys(text for part in parts for text in part.warnings)
        about = {
            text: [name for name, part in zip(names, parts, strict=True) if text in part.warnings]
            for text in texts
        }
        rounds = [part._rounds[1:-1] for part in parts if part._rounds != "[]"]
        whole = cls(
            poses,
            labels=np.concatenate(labels),
            rounds=f"[{','.join(rounds)}]",
            stop_reason=stop_reason,
            timings=Timings(**{**seconds, "total_s": total_s}),
            resolution=min(part.resolution for part in parts),
            params=params if len(parts) > 1 else parts[0].params,
            rejected=rejected,
            warnings=[
                text if len(of) == len(parts) else f"{', '.join(of)}: {text}" for text, of in about.items()
            ],
            parts=dict(zip(names, parts, strict=True)),
        )
        whole.background = parts[0].background
        return whole

    @classmethod
    def _of(cls, raw: dict[str, Any], params: Params) -> Registration:
        """Dress what the core gives."""
        measures = [of and Measures._of(of) for of in json.loads(raw["measures"])]
        raw = {**raw, "measures": measures, "free_motions": _free_motions(raw["free_motions"])}
        columns = [raw[field.name] for field in fields(Pose) if field.name in raw]
        rejected = zip(raw["rejected_poses"], json.loads(raw["rejected"]), strict=True)
        found = cls(
            list(map(Pose, *columns)),
            rejected=[
                Rejected(pose, score, objection, found_in, of and Measures._of(of))
                for pose, (score, objection, found_in, of) in rejected
            ],
            labels=raw["labels"],
            rounds=raw["rounds"],
            stop_reason=StopReason._of(raw["stop_reason"], raw["stop_message"]),
            timings=Timings(**json.loads(raw["timings"])),
            resolution=raw["resolution"],
            params=params,
            warnings=raw.get("warnings", ()),
        )
        found.background = raw.get("background", cls.background)
        return found

    @cached_property
    def rounds(self) -> tuple[Round, ...]:
        """One entry per round that was played to its end."""
        return tuple(Round._from_dict(data) for data in json.loads(self._rounds))

    def at_least(self, score: float) -> Registration:
        """Return the same without the poses of a lower score.

        To get more poses than there are, lower ``hv.t_score`` before the run.

        Parameters
        ----------
        score : float
            0 to 1.

        Returns
        -------
        Registration
            Its ``labels`` of the poses that are left out are -1.

        Raises
        ------
        InputError
            The score is not from 0 to 1.
        """
        if not 0 <= score <= 1:
            raise InputError(f"score is {score}; it must be from 0 to 1")
        kept = copy(self)
        rows = [row for row, pose in enumerate(self) if pose.score >= score]
        new = np.full(len(self) + 1, -1, np.int32)  # the last is of -1, of none
        new[rows] = np.arange(len(rows))
        kept.poses, kept.labels = tuple(self.poses[row] for row in rows), new[self.labels]
        kept._parts = {name: part.at_least(score) for name, part in self._parts.items()}
        return kept

    def canonical(
        self,
        symmetries: Symmetries | Sequence[Symmetries],
        reference: Registration | npt.ArrayLike | None = None,
    ) -> Registration:
        """Return the same with each pose as :meth:`Pose.canonical` gives it.

        Parameters
        ----------
        symmetries : Symmetries or sequence of Symmetries
            Of the model; of :class:`Models` those of each.
        reference : Registration, (4, 4) or (K, 4, 4) array_like, optional
            Against what poses are turned least: by default the identity. Of several poses it is the one whose
            centre is nearest, and of a registration only those of the same model count: with that of the
            last frame a part that has not moved stays as it was.

        Returns
        -------
        Registration
        """
        of = [symmetries] if isinstance(symmetries, Symmetries) else list(symmetries)
        num = max(1, len(self._parts))
        if len(of) != num:
            raise InputError(f"symmetries: there are {len(of)} of {num} models")
        turned = copy(self)
        turned.poses = tuple(
            pose.canonical(of[pose.model], _reference(reference, pose)) for pose in self.poses
        )
        turned.symmetries = tuple(of)
        turned._parts = {}
        for one, (name, part) in zip(of, self._parts.items(), strict=False):
            turned._parts[name] = copy(part)
            turned._parts[name].symmetries = (one,)
            turned._parts[name].poses = tuple(
                pose.canonical(one, _reference(reference, pose)) for pose in part.poses
            )
        return turned

    def to_dict(self, *, unit: str | None = None, frame: str = "scene", run: bool = True) -> dict[str, Any]:
        """Return all of it as plain data, for JSON; the form is that of the page *Poses out*.

        Parameters
        ----------
        unit : str, optional
            What the data are in, which is noted: ``"m"``, ``"cm"``, ``"mm"``, ``"um"``, ``"in"`` or ``"ft"``.
        frame : str
            The name of the frame that the poses lead to, which is noted.
        run : bool
            Whether labels, rounds, measures, timings and what was rejected are in it.

        Returns
        -------
        dict

        Raises
        ------
        InputError
            The unit has no name here.
        """
        return _written.registration_dict(self, unit, frame, run)

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> Registration:
        """Build from what :meth:`to_dict` has returned; InputError says what is wrong with it.

        Where it was written without the run there are no labels and rounds, and timings are 0. Of
        stages that were callables the parameters have the defaults.
        """
        return _written.registration_of(data)

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        unit: str | None = None,
        frame: str = "scene",
        run: bool = True,
    ) -> None:
        """Write it to a file: ``.json`` of :meth:`to_dict`, or ``.csv``, a line for each pose.

        Parameters
        ----------
        path : path
            The columns of a CSV file are model, score, x, y, z, qx, qy, qz, qw and how well the pose fits.
        unit, frame, run
            As in :meth:`to_dict`; a CSV file has no place for them.

        Raises
        ------
        InputError
            The name has another suffix, or the unit has no name here.
        OSError
            The file cannot be written; then nothing of it is left.
        """
        path = Path(path)
        if path.suffix.lower() == ".csv":
            text = _written.poses_csv(self)
        elif path.suffix.lower() == ".json":
            text = json.dumps(self.to_dict(unit=unit, frame=frame, run=run)) + "\n"
        else:
            raise InputError(f"{path}: registrations are written as .json or .csv")
        with written(path) as part:
            part.write_text(text, encoding="utf-8")

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Registration:
        """Read a JSON file that :meth:`save` or ``ibi register -o`` has written; InputError names it."""
        try:
            return _written.registration_of(read_json(path))
        except InputError as error:
            text = str(error)
            raise InputError(text if text.startswith(str(path)) else f"{path}: {text}") from None

    def __len__(self) -> int:
        return len(self.poses)

    @overload
    def __getitem__(self, index: int) -> Pose: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Pose]: ...
    def __getitem__(self, index: int | slice) -> Pose | Sequence[Pose]:
        return self.poses[index]

    def __iter__(self) -> Iterator[Pose]:
        return iter(self.poses)

    def __array__(self, dtype: npt.DTypeLike | None = None, copy: bool | None = None) -> npt.NDArray[Any]:
        if copy is False:
            raise ValueError("the poses are not kept as one array: np.asarray(registration) must copy")
        matrices = [pose.target_from_source for pose in self.poses]
        return np.array(matrices, dtype=dtype or np.float64).reshape(-1, 4, 4)

    def __repr__(self) -> str:
        plural = "instance" if len(self) == 1 else "instances"
        head = (
            f"Registration: {len(self)} {plural} in {len(self.rounds)} rounds, {self.timings.total_s:.3f} s; "
            f"stopped by {self.stop_reason}; resolution {significant(self.resolution)}"
        )
        warnings = (f"  warning: {warning}" for warning in self.warnings)
        poses = (f"  {pose._shown(self.resolution)}" for pose in self.poses)
        return "\n".join([head, *warnings, *poses])


def _reference(given: Any, pose: Pose) -> npt.NDArray[np.float64] | None:
    """Return the one of several poses that is nearest to a pose; None: there is none."""
    if given is None:
        return None
    if isinstance(given, Registration):
        matrices = np.array([one.target_from_source for one in given if one.model == pose.model])
    else:
        matrices = np.asarray(getattr(given, "target_from_source", given), np.float64)
    if matrices.size == 0:
        return None
    if matrices.shape[-2:] != (4, 4) or matrices.ndim not in (2, 3):
        raise InputError(f"reference has shape {matrices.shape}; it must be (4, 4) or (K, 4, 4)")
    if matrices.ndim == 2:
        return matrices
    turn, shift = pose.target_from_source[:3, :3], pose.target_from_source[:3, 3]
    centre = turn.T @ (pose.centre - shift)  # in the model's frame
    places = matrices[:, :3, :3] @ centre + matrices[:, :3, 3]
    nearest: npt.NDArray[np.float64] = matrices[np.argmin(np.linalg.norm(places - pose.centre, axis=1))]
    return nearest
