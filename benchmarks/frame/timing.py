"""The clock, calls in turn, and how a time grows with a size."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
"""What a program that takes all cores can get."""
MACHINE = f"{CORES} cores, {platform.machine()}"


def timed(job: Callable[..., T], *arguments: Any) -> tuple[float, T]:
    """Return the seconds of a call, and its result."""
    start = time.perf_counter()
    result = job(*arguments)
    return time.perf_counter() - start, result


def in_turn(jobs: Sequence[Callable[[], Any]], repeats: int) -> NDArray[np.float64]:
    """Return the seconds of calls in turn, (repeats, jobs): what slows the machine down slows all of them."""
    return np.array([[timed(job)[0] for job in jobs] for _ in range(repeats)])


def exponent(x: Sequence[float], y: Sequence[float]) -> tuple[float, float]:
    """Fit y = a x^b by least squares of the logarithms; return b and a."""
    slope, offset = np.polyfit(np.log(x), np.log(y), 1)
    return float(slope), float(np.exp(offset))
