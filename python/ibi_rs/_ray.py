"""`RayExecutor`: calls as tasks of Ray."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any, TypeVar

from ibi_rs import _interrupts

_R = TypeVar("_R")


class RayExecutor(Executor):
    """Runs calls as tasks of Ray, which has no executor of its own: ``pip install 'ibi_rs[ray]'``.

    A task whose worker dies is run again by Ray, ``max_retries`` times.

    Parameters
    ----------
    **options
        Those of ``ray.remote``: ``num_cpus=2``, ``max_retries=5``, ...

    Raises
    ------
    ImportError
        Ray is not installed; the message names the extra.

    Examples
    --------
    >>> import ray                                                                   # doctest: +SKIP
    >>> ray.init()                                                                   # doctest: +SKIP
    >>> for found in ibi.register_batch(jobs, ibi.RayExecutor()): ...                # doctest: +SKIP
    """

    def __init__(self, **options: Any) -> None:
        try:
            with _interrupts.held():
                import ray
        except ImportError as error:
            raise ImportError(f"Ray is needed: pip install 'ibi_rs[ray]' ({error})") from error
        self._ray = ray
        self._remote = ray.remote(**options)(_call) if options else ray.remote(_call)

    def submit(self, fn: Callable[..., _R], /, *args: Any, **kwargs: Any) -> Future[_R]:
        """Start a task; its future has the result, or the error as it was raised.

        Parameters
        ----------
        fn, *args, **kwargs
            As in :meth:`concurrent.futures.Executor.submit`.

        Returns
        -------
        Future
        """
        task = self._remote.remote(fn, args, kwargs)
        future: Future[_R] = Future()

        def ended(inner: Future[_R]) -> None:
            if not future.set_running_or_notify_cancel():
                return
            error = inner.exception()
            if error is None:
                future.set_result(inner.result())
            else:
                # Ray's own wraps it, with a message of many lines.
                future.set_exception(getattr(error, "cause", None) or error)

        def cancelled(outer: Future[_R]) -> None:
            if outer.cancelled():
                self._ray.cancel(task)

        future.add_done_callback(cancelled)
        task.future().add_done_callback(ended)
        return future


def _call(fn: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    return fn(*args, **kwargs)
