"""`register_batch`: many jobs at a time, on any executor."""

from __future__ import annotations

import functools
import operator
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from ibi_rs._inputs import _count, _num_threads
from ibi_rs._job import Job, JobError
from ibi_rs._log import LOGGER
from ibi_rs.registration import Registration

_T = TypeVar("_T")
_R = TypeVar("_R")

_WINDOW = 64
"""Jobs under way in an executor whose workers cannot be counted."""
_TICK_S = 0.5
"""A wait without an end would not see Ctrl-C on Windows."""


def register_batch(
    jobs: Iterable[Job],
    executor: Executor | Callable[[], Executor] | int | None = None,
    *,
    num_threads: int | None = None,
    window: int | None = None,
    retries: int = 1,
    callback: Callable[[int, Registration | JobError], object] | None = None,
) -> Iterator[Registration | JobError]:
    """Run many jobs at a time; give their results one by one, in the order of the jobs.

    Each result has the same bits as ``job.run()``, wherever it was made. Work begins with the first result
    that is asked for: iterate, or take ``list(register_batch(jobs))``.

    Parameters
    ----------
    jobs : iterable of Job
        A list, or a generator, which is asked for no more than ``window`` jobs ahead of the results.
    executor : Executor, callable that makes one, or int; optional
        Where the jobs run. Default: threads of this process, one for each core, or so many. An executor is
        left as it is; one that the callable makes is shut down at the end, and made anew if a worker's death
        breaks it. Dask: ``client.get_executor()``; Ray: :class:`RayExecutor`.
    num_threads : int, optional
        Of each job that does not say itself. Default: in threads of this process what shares the cores among
        the jobs (``IBI_NUM_THREADS``, else those the process may use), in an executor 1, as the executor has
        the workers.
    window : int, optional
        Jobs that are under way, or done and not given yet, at a time. Default: in threads of this process
        four for each, in an executor 64; should be twice its workers or more.
    retries : int, optional
        How often a job is run again that has killed its worker on its own. All jobs that a dying worker takes
        with it are run again, one at a time, so that it is known which. Not in an executor that a death
        breaks and that no callable can make anew, such as a ``ProcessPoolExecutor``: there all jobs from then
        on are errors. Ray and Dask run jobs again by settings of their own, before they give them up.
    callback : callable, optional
        Called with the job's index and its result as soon as a job ends, in any order; in the thread that
        asks for results. What it raises ends the batch.

    Yields
    ------
    Registration or JobError
        An error is a value in its place, and no other job is the worse for it.

    Returns
    -------
    iterator
        Ctrl-C, or closing it, ends the batch. Jobs that wait are dropped; those under way end within a round
        in threads of this process, at once in processes that the callable made, elsewhere when they are
        done.

    Raises
    ------
    TypeError, InputError
        An argument is of another type or value than above. After the results of the jobs before: something
        in ``jobs`` is no :class:`Job`, or what the iterable itself raises.
    ValueError
        ``num_threads`` or ``IBI_NUM_THREADS`` is no integer from 1 to 65535.

    Examples
    --------
    >>> import ibi_rs as ibi
    >>> scene = ibi.synth.outlier_layout(seed=1, num_instances=5)
    >>> model = ibi.Model(scene.src)
    >>> jobs = [ibi.Job(model, scene.tgt, scene.corr), ibi.Job(model, scene.tgt[:1], scene.corr, name="cut")]
    >>> for found in ibi.register_batch(jobs):
    ...     print(found if isinstance(found, ibi.JobError) else len(found))
    5
    job 1, cut: tgt has 1 points; at least 3 are needed
    """
    if callback is not None and not callable(callback):
        raise TypeError(f"callback must be callable, not {type(callback).__name__}")
    if not isinstance(jobs, Iterable):
        raise TypeError(f"jobs must be an iterable of ibi_rs.Job, not {type(jobs).__name__}")
    threads = None if num_threads is None else _num_threads(num_threads)
    stop = threading.Event()
    make: Callable[[], Executor]
    if executor is None or isinstance(executor, (int, np.integer)):
        most = None if executor is None else _count("executor", executor, 1)
        workers, threads = _share(_cores(), operator.length_hint(jobs, 2**31), threads, most)
        make, default = functools.partial(ThreadPoolExecutor, workers, "ibi-batch"), 4 * workers
        call = functools.partial(_run, num_threads=threads, stop=stop)
    else:
        if isinstance(executor, Executor):
            make = functools.partial(_given, executor)
        elif callable(executor):
            make = functools.partial(_made, executor)
        else:
            raise TypeError(
                "executor must be a concurrent.futures.Executor (of Dask client.get_executor(), of Ray "
                f"ibi_rs.RayExecutor()), a callable that makes one, or an int, not {type(executor).__name__}"
            )
        default = _WINDOW
        call = functools.partial(_run, num_threads=threads or 1)
    return iter(
        _Batch(
            call,
            _checked(jobs),
            make,
            is_ours=not isinstance(executor, Executor),
            window=default if window is None else _count("window", window, 1),
            retries=_count("retries", retries, 0),
            callback=callback,
            stop=stop,
        )
    )


def _given(executor: Executor) -> Executor:
    return executor


def _made(make: Callable[[], Executor]) -> Executor:
    made = make()
    if not isinstance(made, Executor):
        raise TypeError(
            f"executor must make a concurrent.futures.Executor, not {type(made).__name__}, when it is called"
        )
    return made


def _run(
    job: Job, _attempt: int, *, num_threads: int | None, stop: threading.Event | None = None
) -> Registration:
    # In a thread Ctrl-C is not seen: the callback ends the run.
    callback = None if stop is None else lambda _round: not stop.is_set()
    return job.run(num_threads=num_threads, callback=callback)


def _checked(jobs: Iterable[Job]) -> Iterator[Job]:
    for index, job in enumerate(jobs):
        if not isinstance(job, Job):
            raise TypeError(f"jobs[{index}] must be ibi_rs.Job, not {type(job).__name__}")
        yield job


def _cores() -> int:
    """How many threads there should be: by IBI_NUM_THREADS, the process's mask and its container's quota."""
    if (given := _num_threads(None)) is not None:
        return given
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text(encoding="ascii").split()
        cores = min(cores, max(1, int(quota) // int(period)))
    except (OSError, ValueError):  # there is none, or it is "max"
        pass
    return cores


def _terminate(executor: Executor) -> bool:
    """End worker processes, which would take up the jobs that they have been sent; say if there are any.

    What waits must not be cancelled then: older Pythons stumble over it.
    """
    processes = list((getattr(executor, "_processes", None) or {}).values())
    for process in processes:
        process.terminate()
    return bool(processes)


def _shut_down(executor: Executor, *, is_broken: bool) -> None:
    # Older Pythons wait for ever to send what nobody reads any more (python/cpython#94777).
    queue = getattr(executor, "_call_queue", None)
    if is_broken and queue is not None and sys.version_info < (3, 11, 5):
        queue._reader.close()
    executor.shutdown(wait=True)


def _share(cores: int, num_jobs: int, num_threads: int | None, most: int | None) -> tuple[int, int]:
    """Jobs at a time, at most so many, and threads of each."""
    workers = max(1, min(num_jobs, most or cores // (num_threads or 1)))
    return workers, num_threads or max(1, cores // workers)


@dataclass
class _Task(Generic[_T]):
    index: int
    item: _T
    is_suspect: bool = False
    """It was under way when a worker died, and is run alone now."""
    num_crashes: int = 0
    """How often a worker died when it ran alone."""


class _Batch(Generic[_T, _R]):
    """One call for each item, on an executor, results in order, within a window."""

    def __init__(
        self,
        call: Callable[[_T, int], _R],
        items: Iterable[_T],
        make: Callable[[], Executor],
        *,
        is_ours: bool,
        window: int,
        retries: int = 1,
        callback: Callable[[int, _R | JobError], object] | None = None,
        stop: threading.Event | None = None,
    ) -> None:
        self._call, self._items, self._make, self._is_ours = call, iter(items), make, is_ours
        self._window, self._retries, self._callback, self._stop = window, retries, callback, stop
        self._num_taken = self._num_failed = 0
        self._is_empty = False
        self._failure: Exception | None = None  # of the iterable itself
        self._running: dict[Future[_R], _Task[_T]] = {}
        self._suspects: deque[_Task[_T]] = deque()
        self._done: dict[int, _R | JobError] = {}

    def __iter__(self) -> Iterator[_R | JobError]:
        self._executor = self._make()
        turn, start = 0, time.perf_counter()
        try:
            while True:
                self._fill()
                if turn in self._done:
                    yield self._done.pop(turn)
                    turn += 1
                elif self._running:
                    self._collect()
                elif self._is_empty and not self._suspects:
                    break
            LOGGER.info(
                "batch: %d jobs, %d failed, %.3f s",
                *(turn, self._num_failed, time.perf_counter() - start),
            )
            if self._failure is not None:
                raise self._failure
        finally:
            if self._stop is not None:
                self._stop.set()
            is_broken = bool(self._running) and self._is_ours and _terminate(self._executor)
            if not is_broken:
                for future in self._running:
                    future.cancel()
            if self._is_ours:
                _shut_down(self._executor, is_broken=is_broken)

    def _fill(self) -> None:
        if any(task.is_suspect for task in self._running.values()):
            return  # alone, so that it is known who is to blame
        if self._suspects:
            if not self._running:
                self._submit(self._suspects.popleft())
            return
        while not self._is_empty and len(self._running) + len(self._done) < self._window:
            try:
                item = next(self._items)
            except StopIteration:
                self._is_empty = True
            except Exception as error:
                self._is_empty, self._failure = True, error
            else:
                self._submit(_Task(self._num_taken, item))
                self._num_taken += 1

    def _submit(self, task: _Task[_T]) -> None:
        try:
            # The attempt makes it another call: Dask remembers how equal ones have ended.
            future = self._executor.submit(self._call, task.item, task.num_crashes + task.is_suspect)
        except Exception as error:  # it cannot be pickled, or the executor is broken or shut down
            future = Future()
            future.set_exception(error)
        self._running[future] = task

    def _collect(self) -> None:
        """Wait for the first to end. If that is by the executor's breaking, all others end by it, too."""
        lost: list[tuple[_Task[_T], BrokenExecutor]] = []
        while self._running:
            ended, _ = wait(self._running, _TICK_S, FIRST_COMPLETED)
            for future in ended:
                task = self._running.pop(future)
                value: _R | JobError
                try:
                    value = future.result()
                except BrokenExecutor as death:
                    lost.append((task, death))
                    continue
                except Exception as error:
                    if type(error).__name__ == "KilledWorker":  # Dask's, which blames all that wait there
                        self._run_again(task, error)
                        continue
                    value = self._as_value(task, error)
                self._finish(task, value)  # out here: what the callback raises is no error of the job
            if ended and not lost:
                return
        for task, cause in sorted(lost, key=lambda pair: pair[0].index):
            if self._is_ours:
                self._run_again(task, cause)
            else:
                self._finish(task, self._as_value(task, cause))
        if lost and self._is_ours:
            _shut_down(self._executor, is_broken=True)
            self._executor = self._make()

    def _run_again(self, task: _Task[_T], error: Exception) -> None:
        LOGGER.debug("batch: job %d lost its worker: %s", task.index, error)
        task.num_crashes += task.is_suspect
        if task.num_crashes > self._retries:
            self._finish(task, self._as_value(task, error))
        else:
            task.is_suspect = True
            self._suspects.append(task)

    def _as_value(self, task: _Task[_T], error: Exception) -> JobError:
        name = getattr(task.item, "name", None) or getattr(task.item, "path", None)
        return JobError(task.index, None if name is None else str(name), error)

    def _finish(self, task: _Task[_T], value: _R | JobError) -> None:
        self._done[task.index] = value
        if isinstance(value, JobError):
            self._num_failed += 1
            LOGGER.warning("batch: %s", value)
        else:
            LOGGER.debug("batch: job %d is done", task.index)
        if self._callback is not None:
            self._callback(task.index, value)
