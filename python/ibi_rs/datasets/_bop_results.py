"""Results as BOP writes them, and its scores: recall by MSSD, and the precision of BOP-Industrial."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ibi_rs import metrics
from ibi_rs._core import InputError
from ibi_rs._files import written
from ibi_rs.datasets._bop import Bop
from ibi_rs.datasets._scene import Floats, Part, rigid, stacked
from ibi_rs.io._reading import PathLike

HEADER = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")

_AP_MM = tuple(range(2, 21, 2))
"""Where precision is taken, millimetres of MSSD."""
_LEAST_VISIBLE = 0.1
_MOST_ESTIMATES = 100
_RECALLS = np.linspace(0, 1, 101)


@dataclass(frozen=True, eq=False)
class BopImage:
    """What was found in one image: all objects together.

    Attributes
    ----------
    scene_id, im_id : int
        Which image.
    obj_ids : (M,) int64
        Of each pose its object.
    scores : (M,) float64
        Higher is better.
    poses : (M, 4, 4) float64
        camera_from_model, millimetres.
    seconds : float
        For the whole image; -1 where it is not known.
    """

    scene_id: int
    im_id: int
    obj_ids: npt.NDArray[np.int64]
    scores: Floats
    poses: Floats
    seconds: float


@dataclass(frozen=True)
class BopScores:
    """How well a data set was found.

    Attributes
    ----------
    num_images, num_targets : int
        Images, and copies that count as to be found.
    ar_mssd : float
        Mean of ``recalls``: BOP's average recall by MSSD.
    recalls : tuple of float
        Share of the targets found with an MSSD below each of ``metrics.MSSD_DIAMETER_FRACTIONS``.
    ap_mm : float
        Average precision by MSSD below 2, 4 .. 20 mm, the mean of objects and thresholds: what BOP-Industrial
        ranks by.
    ap : float
        The same at the fractions of the diameter.
    ap_mm_of : dict of int to float
        ``ap_mm`` of each object.
    mhf1 : float
        Mean over images of the F1 one to one by ADD-S below a tenth of the diameter, all objects together.
    seconds : float
        Mean of an image; NaN where none is known.
    """

    num_images: int
    num_targets: int
    ar_mssd: float
    recalls: tuple[float, ...]
    ap_mm: float
    ap: float
    ap_mm_of: dict[int, float] = field(repr=False)
    mhf1: float
    seconds: float


def write_bop_results(path: PathLike, images: Sequence[BopImage]) -> None:
    """Write the CSV that BOP takes: a row a pose, t in millimetres, one time for an image.

    An image without a pose has no row. BOP reads method and data set from the name of the file:
    ``METHOD_DATASET-SPLIT.csv``.

    Parameters
    ----------
    path : path
        What is there is replaced, at the end.
    images : sequence of BopImage
        In any order.

    Returns
    -------
    None
    """
    with written(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(HEADER)
        for image in sorted(images, key=lambda one: (one.scene_id, one.im_id)):
            for obj_id, score, pose in zip(image.obj_ids, image.scores, image.poses, strict=True):
                motion = (" ".join(f"{x:.9g}" for x in one.ravel()) for one in (pose[:3, :3], pose[:3, 3]))
                row = (image.scene_id, image.im_id, obj_id, f"{score:.6f}", *motion, f"{image.seconds:.4f}")
                rows.writerow(row)


def read_bop_results(path: PathLike) -> list[BopImage]:
    """Read the CSV of any method.

    Parameters
    ----------
    path : path

    Returns
    -------
    list of BopImage
        By scene and image.

    Raises
    ------
    InputError
        The file cannot be read; a row is no pose; or two rows of an image have other times.
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: is no CSV: {error}") from None
    if not rows or tuple(rows[0]) != HEADER:
        raise InputError(f"{path}: its first line must be {','.join(HEADER)}")
    images: dict[tuple[int, int], tuple[list[int], list[float], list[Floats], float]] = {}
    for number, row in enumerate(rows[1:], 2):
        if not row:
            continue
        try:
            scene_id, im_id, obj_id = (int(word) for word in row[:3])
            score, seconds = float(row[3]), float(row[6])
            turn, shift = (np.array(word.split(), np.float64) for word in row[4:6])
            motion = turn.reshape(3, 3), shift.reshape(3)
        except (ValueError, IndexError):
            raise InputError(f"{path}, line {number}: is no row of {','.join(HEADER)}") from None
        if not all(np.isfinite(one).all() for one in (score, seconds, *motion)):
            raise InputError(f"{path}, line {number}: a number is not finite")
        held = images.setdefault((scene_id, im_id), ([], [], [], seconds))
        if abs(held[3] - seconds) > 1e-3:  # as BOP's own checker
            raise InputError(
                f"{path}, line {number}: time is {seconds:g}, and {held[3]:g} in another row of the image"
            )
        pose = rigid(Path(f"{path}, line {number}"), "R", *motion)
        held[0].append(obj_id)
        held[1].append(score)
        held[2].append(pose)
    return [
        BopImage(*ids, np.array(obj_ids, np.int64), np.array(scores), stacked(poses), seconds)
        for ids, (obj_ids, scores, poses, seconds) in sorted(images.items())
    ]


def score_bop(images: Sequence[BopImage], dataset: Bop) -> BopScores:
    """Score results by the truth of a data set.

    Recall is BOP's of localisation: of each object as many estimates as there are copies asked for, those of
    the highest scores, against as many copies, those seen best. Where the targets do not say how many, all
    estimates count, against the copies of which a tenth is seen. Precision is that of detection: all
    estimates, 100 of an image at most; those that hit a copy of which less than a tenth is seen count neither
    way, and those that hit none are wrong.

    Parameters
    ----------
    images : sequence of BopImage
        Those of images that are no targets do not count; a target without an image was not found.
    dataset : Bop
        With the truth.

    Returns
    -------
    BopScores

    Raises
    ------
    InputError
        The data set has no truth, or two of the images are one.
    """
    of_image = {(image.scene_id, image.im_id): image for image in images}
    if len(of_image) < len(images):
        raise InputError("images: two are of one scene_id and im_id")
    found = _Found()
    f1, seconds = [], []
    for scene in dataset:
        if not scene.has_truth:
            raise InputError(f"{dataset.root}: image {scene.name} has no scene_gt.json; it cannot be scored")
        image = of_image.get((scene.ids[0], scene.ids[1]))
        if image is not None and image.seconds >= 0:
            seconds.append(image.seconds)
        hits = num_true = num_told = 0
        kept = np.empty(0, np.int64) if image is None else _best(image.scores, _MOST_ESTIMATES)
        for part in scene.parts:
            obj_id = int(part.kind.name)
            if image is None:
                scores, poses = np.empty(0), np.empty((0, 4, 4))
            else:
                own = kept[image.obj_ids[kept] == obj_id]
                scores, poses = image.scores[own], image.poses[own]
            is_seen = _is_seen(part)
            if len(poses) or len(part.poses):
                found.add(obj_id, part, scores, poses, is_seen)
            score = metrics.score_scene(
                poses, part.poses[is_seen], criterion=metrics.ADD_S, model=part.kind.points
            )
            hits += score.num_truth_hit
            num_true, num_told = num_true + score.num_truth, num_told + score.num_predicted
        if num_true + num_told:
            f1.append(2 * hits / (num_true + num_told))
    return found.scores(len(dataset), float(np.mean(f1)) if f1 else np.nan, seconds)


def _best(scores: Floats, count: int) -> npt.NDArray[np.int64]:
    return np.argsort(-scores, kind="stable")[:count]


def _is_seen(part: Part) -> npt.NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return ~(part.visibility < _LEAST_VISIBLE)


class _Found:
    """Hits and misses of all images, at each threshold."""

    def __init__(self) -> None:
        self._fractions = metrics.MSSD_DIAMETER_FRACTIONS
        self.num_targets = 0
        self.hits = np.zeros(len(self._fractions), np.int64)
        # Of each object: copies that count, and per threshold (score, whether it is right) of estimates.
        self.num_true: dict[int, int] = {}
        self.told: dict[tuple[int, str], list[list[tuple[float, bool]]]] = {}

    def add(
        self, obj_id: int, part: Part, scores: Floats, poses: Floats, is_seen: npt.NDArray[np.bool_]
    ) -> None:
        order = _best(scores, len(scores))
        scores, poses = scores[order], poses[order]
        errors = np.array(
            [
                [
                    metrics.mssd(part.kind.points, pose, true, symmetries=part.kind.symmetries)
                    for true in part.poses
                ]
                for pose in poses
            ]
        ).reshape(len(poses), len(part.poses))
        in_diameters = [fraction * part.kind.diameter for fraction in self._fractions]
        # Localisation.
        wanted, most = is_seen, len(poses)
        if part.count is not None:
            most = part.count
            seen_best = np.argsort(-np.nan_to_num(part.visibility), kind="stable")[: part.count]
            wanted = np.isin(np.arange(len(part.poses)), seen_best)
        self.num_targets += int(wanted.sum())
        for i, limit in enumerate(in_diameters):
            self.hits[i] += (_matched(errors[:most, wanted], limit) >= 0).sum()
        # Detection.
        self.num_true[obj_id] = self.num_true.get(obj_id, 0) + int(is_seen.sum())
        for unit, limits in (("mm", _AP_MM), ("diameters", in_diameters)):
            told = self.told.setdefault((obj_id, unit), [[] for _ in limits])
            for rows, limit in zip(told, limits, strict=True):
                taken = _matched(errors, limit)
                for score, copy in zip(scores, taken, strict=True):
                    if copy < 0 or is_seen[copy]:
                        rows.append((float(score), bool(copy >= 0)))

    def scores(self, num_images: int, mhf1: float, seconds: list[float]) -> BopScores:
        recalls = tuple((self.hits / max(1, self.num_targets)).tolist())
        ap: dict[str, dict[int, float]] = {"mm": {}, "diameters": {}}
        for (obj_id, unit), told in self.told.items():
            if self.num_true[obj_id]:
                ap[unit][obj_id] = float(np.mean([_precision(rows, self.num_true[obj_id]) for rows in told]))
        mean = {unit: float(np.mean(list(of.values()))) if of else np.nan for unit, of in ap.items()}
        return BopScores(
            num_images=num_images,
            num_targets=self.num_targets,
            ar_mssd=float(np.mean(recalls)) if self.num_targets else np.nan,
            recalls=recalls,
            ap_mm=mean["mm"],
            ap=mean["diameters"],
            ap_mm_of=dict(sorted(ap["mm"].items())),
            mhf1=mhf1,
            seconds=float(np.mean(seconds)) if seconds else np.nan,
        )


def _matched(errors: Floats, limit: float) -> npt.NDArray[np.int64]:
    """Let estimates, the best first, each take the nearest free copy below the limit; -1: none."""
    free = np.ones(errors.shape[1], np.bool_)
    taken = np.full(len(errors), -1, np.int64)
    for row, of in enumerate(errors):
        of = np.where(free & (of < limit), of, np.inf)
        if of.size and np.isfinite(of.min()):
            taken[row] = int(of.argmin())
            free[taken[row]] = False
    return taken


def _precision(told: list[tuple[float, bool]], num_true: int) -> float:
    """Average precision, at 101 recalls as COCO takes it."""
    told = sorted(told, key=lambda one: -one[0])
    is_right = np.array([right for _, right in told], np.bool_)
    right = np.cumsum(is_right)
    precision = right / np.arange(1, len(told) + 1)
    best_from = np.maximum.accumulate(precision[::-1])[::-1]
    first = np.searchsorted(right / num_true, _RECALLS - 1e-12)
    return float(np.append(best_from, 0.0)[first].mean())
