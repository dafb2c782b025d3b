"""Ctrl-C while code of others runs that swallows ``KeyboardInterrupt``, as some readers catch all."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def held() -> Iterator[None]:
    """Ctrl-C waits for the end of the block: for imports, of which half would stay behind."""
    with _caught(passes=False):
        yield


@contextmanager
def remembered() -> Iterator[None]:
    """Ctrl-C is raised within the block, and again at its end if it was swallowed."""
    with _caught(passes=True):
        yield


@contextmanager
def _caught(passes: bool) -> Iterator[None]:
    before = signal.getsignal(signal.SIGINT)
    # Signals are handled in the main thread; what is no function ends the process at once, or ignores them.
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return
    came = False

    def catch(number: int, frame: FrameType | None) -> None:
        nonlocal came
        came = True
        if passes:
            before(number, frame)

    signal.signal(signal.SIGINT, catch)
    try:
        yield
    except KeyboardInterrupt:
        came = False
        raise
    finally:
        signal.signal(signal.SIGINT, before)
        if came:
            signal.raise_signal(signal.SIGINT)
