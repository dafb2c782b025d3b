"""Numbers as people read them: no exponents where digits do, and no digits that nobody measured."""

from __future__ import annotations

import math
from collections.abc import Iterable

_MOST = 15
"""Digits that a float holds; what needs more is written with an exponent."""


def lengths(values: Iterable[float], scale: float) -> list[str]:
    """Write lengths with decimals down to a hundredth of a scale, such as the spacing of the points."""
    decimals = max(0, 2 - math.floor(math.log10(scale))) if 0 < scale < math.inf else 4
    return [_fixed(float(value), decimals) for value in values]


def significant(value: float, digits: int = 4) -> str:
    """Write a number with so many digits, or all that stand before its point."""
    value = float(value)
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    return _fixed(value, max(0, digits - 1 - math.floor(math.log10(abs(value)))))


def _fixed(value: float, decimals: int) -> str:
    if not math.isfinite(value) or abs(value) >= 10.0**_MOST or decimals > _MOST:
        return f"{value:.4g}"
    return f"{round(value, decimals) + 0.0:.{decimals}f}"  # no -0.00
