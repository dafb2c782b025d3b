"""The command itself: its app, what it prints, and errors in one line."""

from __future__ import annotations

import errno
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Annotated, Any, NoReturn, TypeVar

import ibi_rs as ibi
from ibi_rs import _interrupts
from ibi_rs._inputs import _MAX_THREADS

try:
    with _interrupts.held():
        import rich.progress
        import typer
        from rich.console import Console
        from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn
        from typer.core import TyperCommand, TyperGroup
except ImportError as error:
    raise SystemExit(f"ibi: the command needs more: pip install 'ibi_rs[cli]' ({error})") from None

FOUND_NOTHING = 3
"""Exit code of `ibi register` where nothing is found; 1: the input is at fault; 2: the command line is."""
MAX_THREADS = _MAX_THREADS
INTERRUPTED = 130
TERMINATED = 143

_F = TypeVar("_F", bound=Callable[..., Any])

ERRORS = (ValueError, TypeError, ImportError, OSError)
"""What a user can do something about: one line. InputError and ParamsError are among them."""


class Terminated(KeyboardInterrupt):
    """SIGTERM, which ends a run as Ctrl-C does."""


class Printer(Console):
    """Prints as long as somebody reads."""

    def on_broken_pipe(self) -> None:
        """Go on without a reader, as `| head -1` is: files are written all the same."""
        self.quiet = True
        _discard(self.file)


def _discard(stream: Any) -> None:
    """Send what is still to come, and what Python flushes at its end, nowhere."""
    with suppress(OSError, ValueError):
        devnull = os.open(os.devnull, os.O_WRONLY)
        os.dup2(devnull, stream.fileno())
        os.close(devnull)


class _Group(TyperGroup):
    def invoke(self, ctx: Any) -> Any:
        with _in_one_line():
            return super().invoke(ctx)


_NUMBERS = {"--viewpoint": 3, "--crop": 6}  # --camera is numbers or a file


class _Command(TyperCommand):
    """Takes `--viewpoint 0,0,0` for `--viewpoint 0 0 0`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        split: list[str] = []
        wanted = 0  # numbers that the option still lacks
        for argument in args:
            name, equals, value = argument.partition("=")
            if name in _NUMBERS:
                split, wanted = [*split, name], _NUMBERS[name]
                argument = value if equals else ""
            elif not wanted:
                split.append(argument)
                continue
            numbers = [number for number in argument.replace(",", " ").split() if number]
            if len(numbers) > wanted:
                misused(f"{argument}: too many numbers")
            split, wanted = split + numbers, max(0, wanted - len(numbers))
        return super().parse_args(ctx, split)


@contextmanager
def _in_one_line() -> Iterator[None]:
    """Turn what a user can do something about into one line and an exit code."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")  # names of files may be of any bytes
    try:
        with _terminable():
            yield
            if sys.stdout is not None:
                sys.stdout.flush()
    except KeyboardInterrupt as signalled:
        say("interrupted")
        raise typer.Exit(TERMINATED if isinstance(signalled, Terminated) else INTERRUPTED) from None
    except BrokenPipeError:
        _discard(sys.stdout)
    except MemoryError:
        fail("out of memory; a larger --voxel, a smaller scan or fewer --jobs need less")
    except RecursionError:
        fail("the input is nested too deeply")
    except ERRORS as error:
        if isinstance(error, OSError) and error.errno == errno.ENOSPC and error.filename is None:
            _discard(sys.stdout)  # else Python would try again, and fail again, at its end
            fail(f"cannot print: {error.strerror}")
        fail(error)


@contextmanager
def _terminable() -> Iterator[None]:
    """Raise Terminated on SIGTERM, so that nothing half done is left."""

    def terminate(*_: Any) -> NoReturn:
        raise Terminated

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def reason(error: object) -> str:
    """Say what is wrong in one line, which names the file where there is one."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror if error.filename is None else f"{error.filename}: {error.strerror}"
    lines = str(error).strip().splitlines() or [type(error).__name__]
    # Ours have one line; but a file may have a name of two.
    return " ".join(lines) if isinstance(error, (ibi.InputError, ibi.ParamsError)) else lines[0]


def say(text: str) -> None:
    """Print a line on stderr."""
    line = f"ibi: {' '.join(text.splitlines())}"
    if err.is_terminal:
        err.print(line, highlight=False, markup=False, soft_wrap=True)  # above a bar
    elif sys.stderr is not None:
        with suppress(OSError):  # nobody reads it
            # Rich would print it again with the next, if Ctrl-C came in between.
            print(line, file=sys.stderr, flush=True)


def warn(text: str) -> None:
    """Print a warning on stderr."""
    say(f"warning: {text}")


def fail(error: object, code: int = 1) -> NoReturn:
    """End with an error of one line."""
    say(reason(error))
    raise typer.Exit(code)


def misused(text: str) -> NoReturn:
    """End with an error of one line that the command line is to blame for."""
    fail(text, 2)


class _Said(logging.Handler):
    """Prints what runs log, but for what the commands say by themselves: warnings and errors."""

    def __init__(self) -> None:
        super().__init__()
        self.addFilter(lambda record: record.levelno < logging.WARNING)

    def emit(self, record: logging.LogRecord) -> None:
        say(self.format(record))


def _listen(ctx: typer.Context, count: int) -> int:
    """Print what runs log until the command ends."""
    logger = logging.getLogger("ibi_rs")
    is_on = any(isinstance(handler, _Said) for handler in logger.handlers)
    if count and not is_on:  # before the command's name, or behind it, or both
        handler, before = _Said(), logger.level

        def end() -> None:
            logger.removeHandler(handler)
            logger.setLevel(before)

        ctx.call_on_close(end)
        logger.addHandler(handler)
    if count:
        logger.setLevel(logging.INFO if count == 1 else logging.DEBUG)
    return count


Verbose = Annotated[
    int,
    typer.Option(
        "-v",
        "--verbose",
        count=True,
        callback=_listen,
        show_default=False,
        metavar="",
        help="Tell on stderr what is done; -vv tells more.",
    ),
]


class Progress:
    """Says on a terminal what is being done, once that takes longer than a moment.

    Attributes
    ----------
    MOMENT_S : float
        Seconds without a word.
    """

    MOMENT_S = 1.0

    def __init__(self, what: str) -> None:
        columns = SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
        # Results are printed to stdout: they are not to go where this is.
        options: dict[str, Any] = {"transient": True, "redirect_stdout": False}
        self._shown = rich.progress.Progress(*columns, console=err, disable=not err.is_terminal, **options)
        self._task = self._shown.add_task(what, total=None)
        self._lock, self._is_over = threading.Lock(), False
        self._timer = threading.Timer(self.MOMENT_S, self._show)
        self._timer.daemon = True

    def __enter__(self) -> Progress:
        self._timer.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._timer.cancel()
        with self._lock:  # the timer may be at it
            self._is_over = True
            self._shown.stop()

    def update(self, what: str) -> None:
        """Say what is being done now."""
        self._shown.update(self._task, description=what)

    def _show(self) -> None:
        with self._lock:
            if not self._is_over:
                self._shown.start()


app = typer.Typer(
    cls=_Group,
    add_completion=False,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Find every copy of a part in a scan: poses in six degrees of freedom.",
)


def command(name: str | None = None) -> Callable[[_F], _F]:
    """Add a command to the app."""
    return app.command(name, cls=_Command)


out = Printer(emoji=False)
err = Printer(stderr=True, emoji=False)  # a file may be called scan:x:


@app.callback(invoke_without_command=True)
def main(
    version: Annotated[bool, typer.Option("--version", help="Print the version and end.")] = False,
    verbose: Verbose = 0,
) -> None:
    """Find every copy of a part in a scan: poses in six degrees of freedom."""
    if version:
        print(f"ibi_rs {ibi.__version__}")
        raise typer.Exit
