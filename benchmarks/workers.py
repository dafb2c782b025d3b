"""Scans a second over the number of workers: threads, processes, Dask and Ray Data on this machine.

    python benchmarks/workers.py --workers 1 2 4

Each scan shows a tee from one side, and a `Detector` of one thread looks for it. The seconds until the first
results, in which a cluster starts its workers and each of these its detector, stand in a column of their own;
scans a second are those after them. Dask and Ray are rows if they are installed (`make test-clusters`
installs them), and are named as missing otherwise. More workers than free cores bring nothing.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import ibi_rs as ibi
import numpy as np
from frame import cli, records, tables
from frame.tables import show
from frame.timing import MACHINE
from ibi_rs.synth.common import random_poses
from ibi_rs.synth.scene import move
from numpy.typing import NDArray

TEE = Path(__file__).parents[1] / "examples/tee/model_tee_mesh.ply"
BATCH = 5
RECORD = "workers.csv"

Batch = dict[str, NDArray[Any]]
Run = Callable[[list[Batch], int], Iterator[Batch]]


class Tees(ibi.Detector):
    """Makes its model where it works."""

    def __init__(self) -> None:
        super().__init__(ibi.Model.from_mesh(*ibi.io.read_mesh(TEE)), max_instances=1)


def scan(seed: int) -> NDArray[np.float64]:
    """Sample the side of a tee that a camera at the origin sees."""
    points, normals = ibi.features.sample_mesh(*ibi.io.read_mesh(TEE), n=4000, seed=seed)
    pose = random_poses(1, np.random.default_rng(seed), 0)[0]
    pose[:3, 3] = 0, 0, 0.5
    points, normals = move(pose, points), normals @ pose[:3, :3].T
    return points[np.sum(points * normals, axis=1) < 0]


def batches(count: int) -> list[Batch]:
    """Make the scans, cut into batches."""
    made = []
    for first in range(0, count, BATCH):
        ids = np.arange(first, min(first + BATCH, count))
        points = np.empty(len(ids), object)
        points[:] = [scan(int(i)).ravel() for i in ids]
        made.append({"scan_id": ids, "points": points, "viewpoint": np.zeros((len(ids), 3))})
    return made


# Where they run -------------------------------------------------------------------------------------------

_here: list[Tees] = []


def detect(batch: Batch) -> Batch:
    """Detect, with the detector of this process."""
    if not _here:
        _here.append(Tees())
    return _here[0](batch)


def in_pool(make: Callable[[int], Executor], held: list[Batch], workers: int) -> Iterator[Batch]:
    """Run in threads or processes."""
    with make(workers) as pool:
        yield from pool.map(detect, held)


def on_dask(held: list[Batch], workers: int) -> Iterator[Batch]:
    """Run on a local cluster of Dask."""
    from distributed import Client, LocalCluster, as_completed

    with (
        LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        for future in as_completed(client.map(detect, held, pure=False)):
            yield future.result()


def on_ray(held: list[Batch], workers: int) -> Iterator[Batch]:
    """Run on a local Ray, by Ray Data; half a core each, or none is left to its readers."""
    os.environ.setdefault("RAY_AUTH_MODE", "disabled")  # it would leave a token in the home directory
    import ray

    ray.init(num_cpus=workers, include_dashboard=False, log_to_driver=False, configure_logging=False)
    ray.data.DataContext.get_current().enable_progress_bars = False
    try:
        rows = [
            {name: column[i] for name, column in batch.items()}
            for batch in held
            for i in range(len(batch["scan_id"]))
        ]
        data = ray.data.from_items(rows, override_num_blocks=len(held)).map_batches(
            Tees, batch_size=BATCH, compute=ray.data.ActorPoolStrategy(size=workers), num_cpus=0.5
        )
        yield from data.iter_batches(batch_size=None, prefetch_batches=0)
    finally:
        ray.shutdown()


RUNS: dict[str, Run] = {
    "threads": partial(in_pool, ThreadPoolExecutor),
    "processes": partial(in_pool, partial(ProcessPoolExecutor, mp_context=get_context("spawn"))),
    "Dask": on_dask,
    "Ray Data": on_ray,
}


def measured(run: Iterable[Batch]) -> tuple[float, float, int]:
    """Return the seconds until the first results, scans a second after them, and how many have a pose."""
    start = time.perf_counter()
    ends, counts = [], []
    for rows in run:
        ends.append(time.perf_counter())
        counts.append(len(set(rows["scan_id"].tolist())))
    return ends[0] - start, sum(counts[1:]) / (ends[-1] - ends[0]), sum(counts)


def main() -> None:
    """Run it."""
    args = cli.parse(
        __doc__,
        cli.scenes(200, "scans"),
        cli.option("--workers", type=int, nargs="+", default=[1, 2], help="numbers of them"),
        cli.several("--on", RUNS),
        cli.flag("--docs", "fill the table into docs/batch.md"),
        cli.out(),
    )
    if args.docs and not args.usual:
        args.error("--docs fills in what is measured without other options")
    cli.machine(f"{args.scenes} scans in batches of {BATCH}")
    held = batches(args.scenes)
    rows = []
    for name in args.on or RUNS:
        one = 0.0
        for workers in args.workers:
            try:
                first, rate, found = measured(RUNS[name](held, workers))
            except ImportError as error:
                rows.append((name, workers, "", "", "", "", f"not installed: {error.name}"))
                continue
            one = one or rate
            load = f"{os.getloadavg()[0]:.1f}"
            rows.append((name, workers, f"{first:.1f}", f"{rate:.1f}", f"{rate / one:.2f}", found, load))
            show(" ".join(map(str, rows[-1])))
    head = ("on", "workers", "s to the first", "scans a second", "times as many", "scans with a pose", "load")
    table = tables.markdown(head, rows)
    show(f"\n{table}")
    columns = ("on", "workers", "first_s", "scans_per_s", "ratio", "found", "load", "machine")
    held_rows = [dict(zip(columns, (*row, MACHINE), strict=True)) for row in rows]
    records.write(args.records, RECORD, held_rows, columns)
    if args.docs:
        records.fill(records.DOCS / "batch.md", {"workers": table})


if __name__ == "__main__":
    main()
