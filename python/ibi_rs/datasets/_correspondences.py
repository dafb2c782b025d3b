"""Correspondences that others have made, and pairs of clouds in the form that their networks read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ibi_rs._core import InputError
from ibi_rs._files import written
from ibi_rs._inputs import _floats, _points
from ibi_rs.datasets._scene import Floats
from ibi_rs.io._reading import PathLike, reading

_NAMES = {
    "src": ("src", "source", "src_corr_points"),
    "tgt": ("tgt", "target", "tgt_corr_points"),
    "corr": ("corr",),
    "score": ("score", "scores", "similarity"),
    "poses": ("poses",),
}


@dataclass(frozen=True, eq=False, repr=False)
class Correspondences:
    """Pairs of points, as others have matched them.

    Attributes
    ----------
    corr : (M, 6) float64
        A source point and its target point: what :func:`ibi_rs.register` takes for ``corr``.
    similarity : (M,) float64 or None
        In [0, 1], higher is better: the scores of the file, and where these leave the interval their ranks.
    poses : (K, 4, 4) float64 or None
        target_from_source, where the file has the truth.
    """

    corr: Floats
    similarity: Floats | None
    poses: Floats | None

    def __len__(self) -> int:
        return len(self.corr)

    def __repr__(self) -> str:
        scores = "with" if self.similarity is not None else "without"
        return f"Correspondences({len(self)} pairs, {scores} scores)"


def read_correspondences(path: PathLike) -> Correspondences:
    """Read pairs of points from NPZ or text.

    Parameters
    ----------
    path : path
        An NPZ file has the source points ``src`` and the target points ``tgt`` (or ``source``, ``target``, or
        ``src_corr_points``, ``tgt_corr_points``), (M, 3) each, row by row a pair; or (M, 6) pairs ``corr``;
        or ``src``, ``tgt`` of any length and ``corr``, (M, 2) rows of them. Perhaps ``score`` (or ``scores``,
        ``similarity``), (M,), and ``poses``, (K, 4, 4). A text file has six or seven numbers a line: source,
        target, score; apart by blanks, tabs, ``,`` or ``;``, behind ``#`` a remark.

    Returns
    -------
    Correspondences

    Raises
    ------
    InputError
        The file cannot be read, or holds something else; the message names it.
    """
    path = Path(path)
    return reading(path, lambda: _npz(path) if path.suffix.lower() == ".npz" else _text(path))


def _npz(path: Path) -> Correspondences:
    with np.load(path, allow_pickle=False) as file:
        held = {
            key: next((file[name] for name in names if name in file), None) for key, names in _NAMES.items()
        }
        there = ", ".join(file.files)
    src, tgt, corr = held["src"], held["tgt"], held["corr"]
    if corr is not None and corr.ndim == 2 and corr.shape[1] == 6:
        pairs = corr
    elif src is None or tgt is None:
        raise InputError(f"has neither src and tgt nor (M, 6) corr, but {there}")
    elif corr is not None:
        pairs = _of_rows(_points("src", src), _points("tgt", tgt), corr)
    else:
        src, tgt = _points("src", src), _points("tgt", tgt)
        if len(src) != len(tgt):
            raise InputError(f"src has {len(src)} points, tgt {len(tgt)}; as pairs they must be as many")
        pairs = np.hstack([src, tgt])
    poses = held["poses"]
    if poses is not None:
        poses = _floats("poses", poses[None] if poses.ndim == 2 else poses, "K", 4, 4)
    return _made(pairs, held["score"], poses)


def _of_rows(src: Floats, tgt: Floats, corr: npt.NDArray[Any]) -> Floats:
    if corr.ndim != 2 or corr.shape[1] != 2 or corr.dtype.kind not in "iu":
        raise InputError(f"corr has {corr.dtype} of shape {corr.shape}; it must be (M, 2) or (M, 6)")
    if len(corr) and (corr.min() < 0 or (corr.max(axis=0) >= (len(src), len(tgt))).any()):
        raise InputError(f"corr names a row that is not there; src has {len(src)}, tgt {len(tgt)}")
    return np.hstack([src[corr[:, 0]], tgt[corr[:, 1]]])


def _text(path: Path) -> Correspondences:
    rows = []
    for number, line in enumerate(path.read_text(encoding="utf-8-sig").splitlines(), 1):
        words = line.partition("#")[0].replace(",", " ").replace(";", " ").split()
        if not words:
            continue
        try:
            rows.append([float(word) for word in words])
        except ValueError:
            raise InputError(f"line {number}: wanted numbers, found {line[:40]!r}") from None
        if len(rows[-1]) not in (6, 7) or len(rows[-1]) != len(rows[0]):
            wanted = len(rows[0]) if len(rows[0]) in (6, 7) else "6 or 7"
            raise InputError(f"line {number}: wanted {wanted} numbers, found {len(rows[-1])}")
    table = np.array(rows, np.float64).reshape(len(rows), -1) if rows else np.empty((0, 6))
    return _made(table[:, :6], table[:, 6] if table.shape[1] == 7 else None, None)


def _made(pairs: npt.NDArray[Any], score: npt.NDArray[Any] | None, poses: Floats | None) -> Correspondences:
    corr = _floats("corr", pairs, "M", 6)
    if not np.isfinite(corr).all():
        raise InputError(f"pair {int(np.flatnonzero(~np.isfinite(corr).all(axis=1))[0])} is not finite")
    return Correspondences(corr, None if score is None else _similarity(score, len(corr)), poses)


def _similarity(score: npt.NDArray[Any], count: int) -> Floats:
    score = _floats("score", score, "M")
    if len(score) != count or not np.isfinite(score).all():
        raise InputError(f"score must be {count} finite numbers, one for each pair")
    if len(score) and (score.min() < 0 or score.max() > 1):  # logits, counts: only their order is known
        rank = np.searchsorted(np.unique(score), score)
        return rank / max(1, int(rank.max()))
    return score


def write_pair(path: PathLike, src: Any, tgt: Any, poses: npt.ArrayLike = ()) -> None:
    """Write a model and a scene as an NPZ file that a network's loader reads in three lines.

    Parameters
    ----------
    path : path
        What is there is replaced, at the end.
    src, tgt : (N, 3) and (Q, 3) array_like
        Model and scene; written as float32 ``src`` and ``tgt``.
    poses : (K, 4, 4) array_like, optional
        target_from_source of all instances, written as float32 ``poses``; and the first again as ``rot``,
        (3, 3), and ``trans``, (3,), as networks for one instance want them.

    Returns
    -------
    None

    Raises
    ------
    InputError, TypeError
        As :func:`ibi_rs.register`, of ``src`` and ``tgt``; or ``poses`` has another shape.
    """
    held = _floats("poses", poses, "K", 4, 4)
    first = held[0] if len(held) else np.eye(4)
    arrays = {
        "src": _points("src", src),
        "tgt": _points("tgt", tgt),
        "poses": held,
        "rot": first[:3, :3],
        "trans": first[:3, 3],
    }
    with written(path) as part, part.open("wb") as file:
        single: dict[str, Any] = {name: array.astype(np.float32) for name, array in arrays.items()}
        np.savez(file, **single)
