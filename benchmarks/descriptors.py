"""Time the matching of descriptors that others have made; print a table, write a record.

    python benchmarks/descriptors.py --repeats 5

Learned descriptors have 32 numbers, and a scene has 20,000 keypoints. Each target row is joined to its four
nearest source rows, exactly, in single precision, on all cores. Runs alternate. FAISS's flat index and
PyTorch's `cdist` with `topk` are rows if they are installed, and are named as missing otherwise. Where other
programs run beside, the clock tells little; the seconds of processors, over the cores, tell what it would be.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import ibi_rs as ibi
import numpy as np
from frame import cli, records, tables
from frame.tables import show
from frame.timing import CORES, MACHINE
from numpy.typing import NDArray

COUNT, WIDTH, NEAREST = 20_000, 32, 4
RECORD = "descriptors.csv"


def made(seed: int) -> NDArray[np.float32]:
    """Make descriptors of length 1, as networks give them: most of the room is empty."""
    rng = np.random.default_rng(seed)
    centres = np.random.default_rng(0).normal(size=(500, WIDTH))
    rows = centres[rng.integers(len(centres), size=COUNT)] + rng.normal(0, 0.5, (COUNT, WIDTH))
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def ours(src: NDArray[np.float32], tgt: NDArray[np.float32]) -> NDArray[np.int64]:
    """Match; the source rows of each target row."""
    corr, _ = ibi.match(src, tgt, k=NEAREST)
    return corr[:, 0].reshape(len(tgt), NEAREST)


def by_faiss(src: NDArray[np.float32], tgt: NDArray[np.float32]) -> Callable[[], Any]:
    """Prepare FAISS; its index is built within the call, as ours is."""
    import faiss

    faiss.omp_set_num_threads(CORES)

    def run() -> Any:
        index = faiss.IndexFlatL2(WIDTH)
        index.add(src)
        return index.search(tgt, NEAREST)[1]

    return run


def by_torch(src: NDArray[np.float32], tgt: NDArray[np.float32]) -> Callable[[], Any]:
    """Prepare PyTorch, in blocks of rows that fit the memory."""
    import torch

    torch.set_num_threads(CORES)
    a, b = torch.from_numpy(src), torch.from_numpy(tgt)
    return lambda: torch.cat(
        [torch.cdist(block, a).topk(NEAREST, largest=False).indices for block in b.split(4096)]
    ).numpy()


def both(job: Callable[[], Any]) -> tuple[float, float]:
    """Return the seconds of a call by the clock, and those that processors have worked on it."""
    wall, cpu = time.perf_counter(), time.process_time()
    job()
    return time.perf_counter() - wall, time.process_time() - cpu


def main() -> None:
    """Run it."""
    args = cli.parse(__doc__, cli.repeats(5), cli.out())
    src, tgt = made(1), made(2)
    jobs: dict[str, Callable[[], Any]] = {"ibi_rs.match": partial(ours, src, tgt)}
    missing = {}
    for name, make in (("FAISS IndexFlatL2", by_faiss), ("PyTorch cdist, topk", by_torch)):
        try:
            jobs[name] = make(src, tgt)
        except ImportError as error:
            missing[name] = f"not installed: {error.name}"
    wanted = {name: job() for name, job in jobs.items()}  # warms up, too
    seconds = np.array([[both(job) for job in jobs.values()] for _ in range(args.repeats)])
    rows = []
    for column, (name, told) in enumerate(wanted.items()):
        same = float((told == wanted["ibi_rs.match"]).mean())
        wall, cpu = seconds[:, column].T
        times = (f"{np.median(wall):.3f}", f"{wall.min():.3f}", f"{np.median(cpu):.3f}")
        rows.append((name, *times, f"{same:.5f}"))
    rows += [(name, "", "", "", why) for name, why in missing.items()]
    head = ("program", "median s", "least s", "median s of processors", "share of the same rows")
    load = f"{os.getloadavg()[0]:.1f}"
    show(f"{COUNT} x {COUNT} x {WIDTH}, the nearest {NEAREST}; {MACHINE}; load {load}\n")
    show(tables.markdown(head, rows))
    columns = ("program", "median_s", "least_s", "median_cpu_s", "same", "machine", "load")
    records.write(
        args.records,
        RECORD,
        [dict(zip(columns, (*row, MACHINE, load), strict=True)) for row in rows],
        columns,
    )


if __name__ == "__main__":
    main()
