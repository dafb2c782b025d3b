"""`Detector`: dicts of arrays in, dicts of arrays out, for data frames that are spread over machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from ibi_rs._core import InputError
from ibi_rs._inputs import _num_threads
from ibi_rs._job import JobError
from ibi_rs._model import Model
from ibi_rs._models import Models
from ibi_rs.params import Params

_COLUMNS = ("scan_id", "points", "normals", "viewpoint")


class Detector:
    """Finds parts in batches of scans: a dict of arrays in, a dict of arrays out, a row a pose.

    For ``map_batches`` of Ray Data and of Daft, ``map_partitions`` of Dask bags, or any loop. It can be
    pickled, keeps nothing between calls, and takes arrays that are read-only.

    Parameters
    ----------
    models : Model, Models, or what :class:`Models` takes
        What is looked for.
    params : Params, optional
        As in :meth:`Model.detect`.
    errors : {"row", "raise"}
        A scan that cannot be searched is a row with ``error``, or ends the batch.
    num_threads : int, default 1
        Of each scan. Ray and Dask have a worker for each core.
    **options
        ``remove_plane``, ``check_units``, ``roi``, ``background``, ``max_instances`` and ``timeout_s`` of
        :meth:`Model.detect`, the same for all scans.

    Raises
    ------
    InputError, TypeError, ValueError
        As :class:`Models`; or an option is none of those, or ``errors`` neither of these.

    Examples
    --------
    >>> import ibi_rs as ibi, numpy as np
    >>> detect = ibi.Detector(ibi.Model(np.eye(3), normals=np.eye(3)))
    >>> rows = detect({"scan_id": ["empty"], "points": [np.empty((0, 3))], "viewpoint": [[0, 0, 0]]})
    >>> {name: column.shape for name, column in rows.items()}["target_from_source"]
    (0, 4, 4)
    """

    def __init__(
        self,
        models: Any,
        params: Params | None = None,
        *,
        errors: Literal["row", "raise"] = "row",
        num_threads: int = 1,
        **options: Any,
    ) -> None:
        if errors not in ("row", "raise"):
            raise InputError(f"errors is {errors!r}; it must be 'row' or 'raise'")
        known = {"remove_plane", "check_units", "roi", "background", "max_instances", "timeout_s"}
        wrong = set(options) - known
        if wrong:
            raise InputError(f"{min(wrong)} is no option of all scans; see Detector")
        if params is not None and not isinstance(params, Params):
            raise TypeError(f"params must be ibi_rs.Params, not {type(params).__name__}")
        if not isinstance(models, Models):
            models = Models([models] if isinstance(models, Model) else models)
        self.models, self.params, self.errors = models, params, errors
        self._options = {**options, "num_threads": _num_threads(num_threads)}

    def __call__(self, batch: Mapping[str, Any]) -> dict[str, npt.NDArray[Any]]:
        """Find the parts in each scan of a batch.

        Parameters
        ----------
        batch : mapping
            Columns of one length. ``points``: of each scan (N, 3) numbers, or N * 3 in a row; and perhaps
            ``scan_id``, anything, by default the scan's row; ``normals``, as ``points``; ``viewpoint``, (3,)
            or (E, 3). Other columns are left out.

        Returns
        -------
        dict of ndarray
            A row a pose, the best of a scan first: ``scan_id``; ``model``, the name of its kind; ``score``;
            ``target_from_source``, (M, 4, 4) float64; ``error``, empty. A scan in which nothing is found has
            no row; one that cannot be searched has one, with a score and a pose of NaN and a line in
            ``error``.

        Raises
        ------
        InputError
            The batch has no ``points``, or two columns are of different lengths; or ``errors`` is "raise" and
            a scan cannot be searched.
        """
        if "points" not in batch:
            raise InputError(f"batch has no column 'points', but {', '.join(map(repr, batch)) or 'none'}")
        columns = {name: batch[name] for name in _COLUMNS if name in batch}
        count = len(columns["points"])
        for name, column in columns.items():
            if len(column) != count:
                raise InputError(f"batch: {name} has {len(column)} rows, points {count}")
        ids = np.asarray(columns.get("scan_id", np.arange(count)))
        rows: list[int] = []
        names, scores, poses, errors = [], [], [], []
        for i in range(count):
            try:
                found = self.models.detect(
                    _triples(columns["points"][i], one_is_many=True),
                    self.params,
                    tgt_normals=_triples(columns["normals"][i], one_is_many=True)
                    if "normals" in columns
                    else None,
                    viewpoint=_triples(columns["viewpoint"][i]) if "viewpoint" in columns else None,
                    **self._options,
                )
            except Exception as error:
                if self.errors == "raise":
                    raise
                rows.append(i)
                names.append("")
                scores.append(np.nan)
                poses.append(np.full((4, 4), np.nan))
                errors.append(JobError(i, None, error).reason)
                continue
            for pose in found:
                rows.append(i)
                names.append(str(pose.model_name))
                scores.append(pose.score)
                poses.append(pose.target_from_source)
                errors.append("")
        return {
            "scan_id": ids[np.array(rows, np.int64)],
            "model": np.array(names, np.str_),
            "score": np.array(scores, np.float64),
            "target_from_source": np.array(poses, np.float64).reshape(-1, 4, 4),
            "error": np.array(errors, np.str_),
        }

    def __repr__(self) -> str:
        return f"Detector({', '.join(self.models.names)})"


def _triples(value: Any, *, one_is_many: bool = False) -> Any:
    """Numbers in rows of three; data frames hold them in one row, or as arrays of arrays."""
    if value is None:
        return None
    if (isinstance(value, np.ndarray) and value.dtype == object) or isinstance(value, Sequence):
        value = np.array([np.asarray(one) for one in value], np.float64) if len(value) else np.empty((0, 3))
    value = np.asarray(value)
    if value.ndim == 1 and (one_is_many or len(value) != 3) and len(value) % 3 == 0:
        return value.reshape(-1, 3)
    return value
