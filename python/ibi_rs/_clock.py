"""A limit of time that counts for all that is called within it."""

from __future__ import annotations

import time
from contextvars import ContextVar, Token

_CLOCK: ContextVar[Clock | None] = ContextVar("ibi_rs_clock", default=None)


class Clock:
    """A limit of time, counted from when it was made.

    Within a ``with`` of it the features raise a ``TimeoutError`` once no time is left.
    """

    def __init__(self, timeout_s: float | None) -> None:
        self.timeout_s = timeout_s
        self._start = time.perf_counter()
        self._outer: Token[Clock | None] | None = None

    @property
    def spent_s(self) -> float:
        return time.perf_counter() - self._start

    @property
    def left_s(self) -> float | None:
        """Seconds, 0 if none is left, None without a limit."""
        return None if self.timeout_s is None else max(0.0, self.timeout_s - self.spent_s)

    def __enter__(self) -> Clock:
        self._outer = _CLOCK.set(self)
        return self

    def __exit__(self, *_: object) -> None:
        if self._outer is not None:
            _CLOCK.reset(self._outer)


def _left_s() -> float | None:
    """Return what the innermost clock leaves, if there is one."""
    clock = _CLOCK.get()
    return None if clock is None else clock.left_s
