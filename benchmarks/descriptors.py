"""Time the matching of descriptors that others have made; print a table, write a record.

    python benchmarks/descriptors.py --repeats 5

Learned descriptors have 32 numbers, and a scene has 20,000 keypoints. Each target row is joined to its four
nearest source rows, exactly, in single precision, on all cores. Runs alternate. FAISS's flat index and
PyTorch's `cdist` with `topk` are rows if they are installed, and are named as missing otherwise.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from typing import Any

import ibi_rs as ibi
import numpy as np
from frame import cli, records, tables
from frame.tables import show
from frame.timing import CORES, MACHINE, in_turn
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


def by_numpy(src: NDArray[np.float32], tgt: NDArray[np.float32]) -> NDArray[np.int64]:
    """Products of matrices, and the nearest by partition."""
    half = (src**2).sum(axis=1) / 2
    blocks = []
    for begin in range(0, len(tgt), 2048):
        far = half - tgt[begin : begin + 2048] @ src.T
        near = np.argpartition(far, NEAREST, axis=1)[:, :NEAREST]
        order = np.argsort(np.take_along_axis(far, near, axis=1), axis=1)
        blocks.append(np.take_along_axis(near, order, axis=1))
    return np.concatenate(blocks)


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
    jobs["numpy"] = partial(by_numpy, src, tgt)
    wanted = {name: job() for name, job in jobs.items()}  # warms up, too
    seconds = in_turn(list(jobs.values()), args.repeats)
    rows = []
    for column, (name, told) in enumerate(wanted.items()):
        same = float((told == wanted["ibi_rs.match"]).mean())
        rows.append(
            (name, f"{np.median(seconds[:, column]):.3f}", f"{seconds[:, column].min():.3f}", f"{same:.5f}")
        )
    rows += [(name, "", "", why) for name, why in missing.items()]
    head = ("program", "median s", "least s", "share of the same rows")
    show(f"{COUNT} x {COUNT} x {WIDTH}, the nearest {NEAREST}; {MACHINE}; load {os.getloadavg()[0]:.1f}\n")
    show(tables.markdown(head, rows))
    columns = ("program", "median_s", "least_s", "same", "machine")
    records.write(
        args.records, RECORD, [dict(zip(columns, (*row, MACHINE), strict=True)) for row in rows], columns
    )


if __name__ == "__main__":
    main()
