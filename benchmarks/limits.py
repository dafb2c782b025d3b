"""Whether work grows with its input and ends when told to, on the worst inputs known.

    python benchmarks/limits.py                        # or: make bench-limits
    python benchmarks/limits.py --only joint --repeats 1
    python benchmarks/limits.py --only thinning --sizes 4000000 8000000 16000000
    python benchmarks/limits.py --docs                 # writes benchmarks/records/limits.csv

Of each case the time at each size is the least of the repeats, and the exponent the slope of a line through
their logarithms; times below 10 ms say nothing about growth and are left out of it. Then the largest size is
run again with an end: by `timeout_s`, where there is one, and by a signal whose handler raises, as Ctrl-C's
does. Both come after several shares of the time that the whole takes, 0.5 s at most. `late` is how much later
the call was back, at worst.

Half a million points are in the processor's caches and five million are not, so each costs two to three times
as much: the exponents of `many points`, `a ball as model` and `thinning` hold that step. `--sizes` beyond it
tells the growth of the work itself.

A case is one line in `CASES` or, outside of the rounds, in limits_geometry_cases.py; a new one needs a
function that makes a call of a size. On a busy machine `--cpu` counts the seconds of the processor, of all
threads, for the growth.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import ibi_rs as ibi
import numpy as np
from frame import cli, records, timing
from frame.tables import show
from limits_geometry_cases import ROWS

SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)
LONGEST_S = 0.5
LEAST_S = 0.01

Call = Callable[[float | None], object]
"""Does the work; ends by itself after so many seconds, if given and if it knows how to."""


@dataclass(frozen=True)
class Case:
    """One kind of input: what is called at each size."""

    name: str
    call_of: Callable[[int], Call]
    sizes: tuple[int, ...]
    has_timeout: bool = True


def registering(
    src: np.ndarray, tgt: np.ndarray, corr: np.ndarray, params: ibi.Params, **options: Any
) -> Call:
    """Register these."""
    return lambda timeout_s: ibi.register(src, tgt, corr, params, timeout_s=timeout_s, **options)


def ball(rng: np.random.Generator, size: int, radius: float = 1.0) -> np.ndarray:
    """Make points within a ball."""
    rows = rng.normal(size=(size, 3))
    rows *= (radius * rng.random(size) ** (1 / 3) / np.linalg.norm(rows, axis=1))[:, None]
    return rows


def random_rows(rng: np.random.Generator, size: int, num_src: int, num_tgt: int) -> np.ndarray:
    """Make correspondences that know nothing of each other."""
    return np.stack([rng.integers(num_src, size=size), rng.integers(num_tgt, size=size)], axis=1)


# Poses on top of each other -------------------------------------------------------------------------------


def on_top(size: int, hv: Any, **changes: Any) -> Call:
    """Accept what is found, again and again: pairs that agree by threes and fours."""
    rng = np.random.default_rng(1)
    src = 10 * rng.random((60, 3))
    tgt = np.concatenate([src, src + rng.normal(0, 0.3, src.shape), 12 * rng.random((60, 3))])
    right = np.stack([np.arange(60), np.arange(60)], axis=1)
    near = right + np.array([0, 60])
    some = np.concatenate([right, near])[rng.integers(120, size=size // 2)]
    corr = np.concatenate([some, random_rows(rng, size - len(some), 60, 180)])
    params = ibi.Params(
        scs=ibi.LocalGtm(first_look=None),
        ce=ibi.Voting(n_vot=4),
        hv=hv,
        removal="dense",
        n_contest=1,
        max_rejections=None,
    ).replace(**changes)
    return registering(src, tgt, corr, params)


# Correspondences and points in one place ------------------------------------------------------------------


def crowded(size: int, kind: str) -> Call:
    """Put all in one place: the pairs, their source points, their target points, or the scene."""
    rng = np.random.default_rng(2)
    src, tgt = 10 * rng.random((1000, 3)), 100 * rng.random((20_000, 3))
    corr = random_rows(rng, size, len(src), len(tgt))
    if kind == "equal pairs":
        corr[:] = corr[0]
    elif kind == "one source point":
        corr[:, 0] = 0
        tgt = 10 * rng.random((20_000, 3))
    elif kind == "targets in one cell":
        tgt[:5000] = 50 + 0.5 * rng.random((5000, 3))
        corr[:, 1] %= 5000
    elif kind == "equal points":
        tgt = np.concatenate([tgt[:1000], np.broadcast_to(tgt[0], (size, 3))])
        corr[:, 1] = rng.integers(len(tgt), size=size)
    return registering(src, tgt, corr, ibi.Params())


def far_apart(size: int) -> Call:
    """Put two clusters so far apart that a grid over both is as coarse as either."""
    rng = np.random.default_rng(3)
    src = 10 * rng.random((size // 4, 3))
    tgt = 20 * rng.random((size, 3))
    tgt[size // 2 :] += 1e6
    return registering(src, tgt, random_rows(rng, size, len(src), len(tgt)), ibi.Params())


def wide_reach(size: int, **changes: Any) -> Call:
    """Let each point be near all others."""
    rng = np.random.default_rng(4)
    src = ball(rng, size // 4)
    tgt = np.concatenate([src, ball(rng, size - len(src), 3)])
    rows = np.arange(len(src))
    corr = np.stack([rows, rows], axis=1)[:2000]
    return registering(src, tgt, corr, ibi.Params().replace(**{"max_rounds": 3, **changes}))


# Much of what is normal -----------------------------------------------------------------------------------


def all_right(size: int, params: ibi.Params) -> Call:
    """Match one instance without a wrong pair."""
    src = 10 * np.random.default_rng(5).random((size, 3))
    rows = np.arange(size)
    return registering(src, src + np.array([20, 0, 0]), np.stack([rows, rows], axis=1), params)


def many_points(size: int) -> Call:
    """Prepare a large scene for a few correspondences."""
    rng = np.random.default_rng(6)
    src, tgt = 10 * rng.random((1000, 3)), 100 * rng.random((size, 3))
    model = ibi.Model(src)
    corr = random_rows(rng, 100, len(src), len(tgt))
    return lambda timeout_s: model.register(tgt, corr, ibi.Params(), timeout_s=timeout_s)


def many_threads(size: int) -> Call:
    """Ask for so many threads."""
    rng = np.random.default_rng(7)
    src, tgt = 10 * rng.random((1000, 3)), 100 * rng.random((20_000, 3))
    corr = random_rows(rng, 2000, len(src), len(tgt))
    return registering(src, tgt, corr, ibi.Params(), num_threads=size)


PAPER = ibi.Params.paper_synthetic()
CROWDS = ("equal pairs", "one source point", "targets in one cell", "equal points")
CASES = [
    Case(
        "joint check, inlier_count", partial(on_top, hv=ibi.InlierCount(t_inliers=1)), (430, 800, 1180, 2400)
    ),
    Case(
        "joint check, none, coarse",
        partial(on_top, hv=ibi.None_(), resolution=3.0),
        (430, 800, 1180, 2400),
    ),
    Case(
        "joint check, mac",
        partial(on_top, hv=ibi.InlierCount(t_inliers=1), te=ibi.Mac()),
        (430, 800, 1180, 2400),
    ),
    *(Case(kind, partial(crowded, kind=kind), (25_000, 50_000, 100_000, 200_000)) for kind in CROWDS),
    Case("two clusters 1e6 apart", far_apart, (25_000, 50_000, 100_000, 200_000)),
    Case("d_op_pr of 1e6", partial(wide_reach, d_op_pr=1e6), (25_000, 50_000, 100_000, 200_000)),
    Case("t_he_pr of 1e6", partial(wide_reach, t_he_pr=1e6), (25_000, 50_000, 100_000, 200_000)),
    Case(
        "voting, n_vot of 1e6",
        partial(all_right, params=PAPER.replace(ce=ibi.Voting(n_vot=1_000_000), max_rounds=3)),
        (50_000, 100_000, 200_000, 400_000),
    ),
    Case(
        "ransac, n_ransac",
        lambda size: all_right(5000, PAPER.replace(te=ibi.Ransac(n_ransac=size), max_rounds=2)),
        (10_000, 100_000, 1_000_000),
    ),
    # Each takes out 300 pairs, so that all of them are as many as the size: a fixed number of rounds.
    Case(
        "paper_synthetic, all right",
        partial(all_right, params=PAPER.replace(max_rounds=12)),
        (4000, 8000, 16_000, 32_000),
    ),
    Case("many points", many_points, (500_000, 1_000_000, 2_000_000, 5_000_000)),
    Case("many threads", many_threads, (4, 40, 400, 4000)),
]


class Ended(Exception):
    """Raised by the signal."""


def timed(
    call: Call, timeout_s: float | None = None, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Return the seconds of a call."""
    start = clock()
    call(timeout_s)
    return clock() - start


def by_signal(call: Call, after_s: float) -> float:
    """Return the seconds of a call that a signal ends."""

    def end(*_: object) -> None:
        raise Ended

    before = signal.signal(signal.SIGALRM, end)
    start = time.perf_counter()
    try:
        signal.setitimer(signal.ITIMER_REAL, after_s)
        call(None)
    except Ended:
        pass
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    return time.perf_counter() - start


def exponent(sizes: list[int], seconds: list[float]) -> float:
    """Return the slope of log time over log size; NaN where too little takes long enough."""
    points = [(n, s) for n, s in zip(sizes, seconds, strict=True) if s >= LEAST_S]
    return timing.exponent(*zip(*points, strict=True))[0] if len(points) >= 2 else float("nan")


def run(case: Case, repeats: int, longest_s: float, clock: Callable[[], float]) -> list[dict[str, Any]]:
    """Time a case at all its sizes, up to one that takes too long, and with an end at the largest."""
    rows: list[dict[str, Any]] = []
    sizes, seconds = [], []
    for size in case.sizes:
        call = case.call_of(size)
        if not rows:
            timed(call)  # warms up
        seconds.append(min(timed(call, clock=clock) for _ in range(repeats)))
        sizes.append(size)
        rows.append({"case": case.name, "size": size, "seconds": f"{seconds[-1]:.4f}"})
        if seconds[-1] > longest_s:
            break
    ends = [min(share * seconds[-1], LONGEST_S) for share in SHARES]
    ends = sorted(set(ends))
    late = max(by_signal(call, end) - end for end in ends)
    rows[-1]["exponent"] = f"{exponent(sizes, seconds):.2f}"
    rows[-1]["late_by_signal"] = f"{late:.3f}"
    if case.has_timeout:
        rows[-1]["late_by_timeout"] = f"{max(timed(call, end) - end for end in ends):.3f}"
    return rows


def main() -> None:
    """Run what was asked for."""
    args = cli.parse(
        __doc__,
        cli.option("--only", default="", help="cases whose name holds this"),
        cli.repeats(3),
        cli.option("--sizes", type=int, nargs="+", help="sizes in the place of those of the cases"),
        cli.option("--longest", type=float, default=60.0, help="seconds after which no larger size is tried"),
        cli.flag("--docs", "write the record"),
        cli.option("--out", type=Path, help="folder for the record; by default benchmarks/records"),
        cli.flag("--cpu", "seconds of the processor for the growth"),
    )
    clock = time.process_time if args.cpu else time.perf_counter
    cli.machine()
    fields = ["case", "size", "seconds", "exponent", "late_by_signal", "late_by_timeout"]
    print(f"{'case':28s}  {'size':>8s}  {'seconds':>8s}  exponent  late by signal, by timeout")
    record = []
    for case in [*CASES, *(Case(*row) for row in ROWS)]:
        if args.only not in case.name:
            continue
        case = replace(case, sizes=tuple(args.sizes or case.sizes))
        for row in run(case, args.repeats, args.longest, clock):
            cells = [row.get(name, "") for name in fields]
            show("{:28s}  {:>8}  {:>8}  {:>8}  {:>14}  {:>10}".format(*cells))
            record.append(row)
    if args.docs or args.out:
        records.write(args.out or records.RECORDS, "limits.csv", record, fields)


if __name__ == "__main__":
    main()
