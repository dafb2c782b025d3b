"""The command line of a benchmark: arguments that several have, and where results go."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import ibi_rs as ibi

from .layouts import FIRST_SEED, LAYOUTS
from .records import FIGURES, RECORDS
from .timing import MACHINE

Option = tuple[str, dict[str, Any]]


def option(name: str, **how: Any) -> Option:
    """Describe an argument as `argparse` takes it."""
    return name, how


def flag(name: str, what: str) -> Option:
    """Describe an argument that is there or not."""
    return option(name, action="store_true", help=what)


def scenes(default: int | None, what: str = "so many of each layout") -> Option:
    """Describe ``--scenes``."""
    return option(
        "--scenes", type=int, default=default, help=f"{what}; default: {default}" if default else what
    )


def several(name: str, choices: Any, what: str | None = None) -> Option:
    """Describe an argument that picks some of many names."""
    return option(name, nargs="+", choices=choices, metavar="NAME", help=what or "; ".join(choices))


HALF = option("--half", choices=FIRST_SEED, default="reporting", help="which shapes and seeds")
LAYOUT = several("--layout", LAYOUTS)
JOBS = option("--jobs", type=int, default=1, help="processes; times are then those of one thread")
MODELNET = option("--modelnet", type=Path, help="npz file: category/name -> (n, 3); adds its layouts")


def repeats(default: int) -> Option:
    """Describe ``--repeats``."""
    return option("--repeats", type=int, default=default, help=f"timed runs of each; default: {default}")


def out(*free: str) -> Option:
    """Describe ``--out``: the folder of all results.

    Without it they go to their places in the repository, and nowhere if what was measured is not the usual:
    if an option has not its default, but those that are named here.
    """
    but = f" but {', '.join(f'--{name}' for name in free)}" if free else ""
    what = "folder for records and pictures; by default benchmarks/records and docs/figures, and none at all"
    return option("--out", type=Path, help=f"{what} where an option{but} is not the default", free=free)


def parse(doc: str | None, *options: Option) -> argparse.Namespace:
    """Read the arguments.

    Returns
    -------
    argparse.Namespace
        Beside the arguments ``usual``, whether they are the usual ones; ``records`` and ``pictures``, the
        folders of the results or None, see `out`; ``error``, which ends with a message.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    free: tuple[str, ...] = ("out", "docs")
    for name, how in options:
        free += how.get("free", ())
        parser.add_argument(name, **{key: value for key, value in how.items() if key != "free"})
    args = parser.parse_args()
    held = {key: value for key, value in vars(args).items() if key not in free}
    args.usual = all(parser.get_default(key) == value for key, value in held.items())
    folder = getattr(args, "out", None)
    args.records, args.pictures = (folder or (usual if args.usual else None) for usual in (RECORDS, FIGURES))
    args.error = parser.error
    return args


def machine(*more: str) -> None:
    """Print what was measured on, and what."""
    print(", ".join([MACHINE, f"ibi_rs {ibi.__version__}", *more]), flush=True)


def layouts(args: argparse.Namespace, usual: Iterable[str]) -> list[str]:
    """Return the layouts asked for, else the usual ones; those of ModelNet need its clouds."""
    chosen = args.layout or [name for name in usual if args.modelnet or LAYOUTS[name].shapes != "modelnet"]
    if args.modelnet is None and any(LAYOUTS[name].shapes == "modelnet" for name in chosen):
        args.error("ModelNet layouts need --modelnet")
    return chosen
