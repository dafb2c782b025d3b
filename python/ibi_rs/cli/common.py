"""What the commands share: options, the search they describe, tables, files, errors."""

from __future__ import annotations

import csv
import errno
import hashlib
import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

import numpy as np

import ibi_rs as ibi
from ibi_rs import _interrupts, io, metrics
from ibi_rs._files import try_writing, written
from ibi_rs._inputs import _MAX_THREADS, _num_threads
from ibi_rs._numbers import lengths
from ibi_rs.symmetries import _bop_entry as bop_entry

try:
    with _interrupts.held():
        import typer
        from rich.console import Console
        from rich.measure import Measurement
        from rich.table import Table
        from typer.core import TyperCommand, TyperGroup
except ImportError as error:
    raise SystemExit(f"ibi: the command needs more: pip install 'ibi_rs[cli]' ({error})") from None

FOUND_NOTHING = 3
"""Exit code of `ibi register` where nothing is found; 1: the input is at fault; 2: the command line is."""
MAX_THREADS = _MAX_THREADS
INTERRUPTED = 130
TERMINATED = 143

SYMMETRIES = "find, none, or BOP's models_info.json, with :ID where it has several objects"

PRESETS = {
    "default": ibi.Params,
    "single_view": ibi.Params.single_view,
    "paper_synthetic": ibi.Params.paper_synthetic,
    "paper_real": ibi.Params.paper_real,
}

_F = TypeVar("_F", bound=Callable[..., Any])

ERRORS = (ValueError, TypeError, ImportError, OSError)
"""What a user can do something about: one line. InputError and ParamsError are among them."""


class Terminated(KeyboardInterrupt):
    """SIGTERM, which ends a run as Ctrl-C does."""


class _Console(Console):
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


class _Command(TyperCommand):
    """Takes `--viewpoint 0,0,0` for `--viewpoint 0 0 0`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        split: list[str] = []
        wanted = 0  # numbers that the option still lacks
        for argument in args:
            name, equals, value = argument.partition("=")
            if name == "--viewpoint":
                split, wanted = [*split, name], 3
                argument = value if equals else ""
            elif not wanted:
                split.append(argument)
                continue
            numbers = [number for number in argument.replace(",", " ").split() if number]
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


out = _Console(emoji=False)
err = _Console(stderr=True, emoji=False)  # a file may be called scan:x:


@app.callback(invoke_without_command=True)
def main(
    version: Annotated[bool, typer.Option("--version", help="Print the version and end.")] = False,
) -> None:
    """Find every copy of a part in a scan: poses in six degrees of freedom."""
    if version:
        print(f"ibi_rs {ibi.__version__}")
        raise typer.Exit


# Options that commands share.
ModelFile = Annotated[
    Path, typer.Argument(help="Mesh of the part: STL, PLY, OBJ, OFF or GLB.", metavar="MODEL")
]
SceneFile = Annotated[
    Path, typer.Argument(help="Scan: PLY, PCD, LAS, XYZ, CSV, NPY ... in the same unit.", metavar="SCENE")
]
Viewpoint = Annotated[
    tuple[float, float, float] | None,
    typer.Option(
        help="Where the depth camera stood, in the frame of SCENE: X,Y,Z or three numbers. "
        "Default: what a PCD file says, else 0,0,0.",
        metavar="X Y Z",
    ),
]
FromAllSides = Annotated[
    bool, typer.Option("--from-all-sides", help="SCENE is no depth scan but a whole cloud, with normals.")
]
Voxel = Annotated[
    float | None,
    typer.Option(
        help="Spacing of what is looked at. Default: 1/24 of the model, less where that leaves few points."
    ),
]
RemovePlane = Annotated[
    bool | None,
    typer.Option(
        "--remove-plane/--keep-plane",
        help="Take the largest plane away, or not. Default: if it looks like a table.",
    ),
]
SymmetriesOf = Annotated[
    str, typer.Option(help=f"{SYMMETRIES}. Of poses that look the same the one turned least is given.")
]
Preset = Annotated[str | None, typer.Option(help=f"{', '.join(PRESETS)}; by default what fits the scene.")]
ParamsFile = Annotated[Path | None, typer.Option(help="Parameters as TOML or JSON.")]
MaxInstances = Annotated[int | None, typer.Option(min=1, max=2**32 - 1, help="No more than so many.")]
TimeoutS = Annotated[float | None, typer.Option(help="Seconds, then what was found is kept.")]


@dataclass(frozen=True)
class Search:
    """How to look for a part in a scan, from the options of the command line."""

    viewpoint: tuple[float, float, float] | None
    from_all_sides: bool
    voxel: float | None
    remove_plane: bool | None
    params: ibi.Params | None
    max_instances: int | None
    timeout_s: float | None
    symmetries: str = "none"

    def __post_init__(self) -> None:
        """Refuse now what would be refused once the files are read."""
        if self.from_all_sides and self.viewpoint is not None:
            misused("--from-all-sides has no --viewpoint; leave one of them out")
        if self.viewpoint is not None and not np.isfinite(self.viewpoint).all():
            misused("--viewpoint must be three finite numbers")
        if self.voxel is not None and not 0 < self.voxel < np.inf:
            misused(f"--voxel is {self.voxel:g}; it must be above 0 and finite")
        if self.timeout_s is not None and not 0 <= self.timeout_s <= 1e9:
            misused(f"--timeout-s is {self.timeout_s:g}; it must be from 0 to 1e9")
        _num_threads(None)  # IBI_NUM_THREADS

    def model(self, path: Path, num_threads: int | None) -> ibi.Model:
        """Read and prepare the part."""
        mesh = io.read_mesh(path)
        wanted = None if self.symmetries == "find" else symmetries_of(self.symmetries, mesh[0])
        return ibi.Model.from_mesh(
            *mesh, voxel=self.voxel, symmetries=wanted or "find", num_threads=num_threads
        )

    def sight(self, normals: Any, viewpoint: Any) -> dict[str, Any]:
        """Those arguments of `Model.correspond` that `Model.detect` has, too, by what a file says."""
        place = (0.0, 0.0, 0.0) if viewpoint is None else tuple(viewpoint)
        return {
            "tgt_normals": normals if self.from_all_sides else None,
            "viewpoint": None if self.from_all_sides else self.viewpoint or place,
            "remove_plane": self.remove_plane,
        }

    def params_for(self, default: ibi.Params | None = None) -> ibi.Params:
        """Return those that a run will have: the chosen ones, or those that fit the scene, and the limits."""
        if default is None:
            default = ibi.Params() if self.from_all_sides else ibi.Params.single_view()
        limits = {"max_instances": self.max_instances, "timeout_s": self.timeout_s}
        given = {name: value for name, value in limits.items() if value is not None}
        return (self.params or default).replace(**given)

    def recorded(self, symmetries: ibi.Symmetries) -> dict[str, Any]:
        """Return what a result depends on beside the parameters and the files, for the JSON."""
        return {
            "viewpoint": None if self.viewpoint is None else list(self.viewpoint),
            "from_all_sides": self.from_all_sides,
            "voxel": self.voxel,
            "remove_plane": self.remove_plane,
            "symmetries": symmetries.to_bop(),
        }

    def limits(self, num_threads: int | None) -> dict[str, Any]:
        """Return what ends a run, and its threads."""
        return {
            "max_instances": self.max_instances,
            "timeout_s": self.timeout_s,
            "num_threads": num_threads,
        }


def symmetries_of(given: str, points: Any, normals: Any = None) -> ibi.Symmetries:
    """Read, find or leave out the symmetries of a model."""
    if given in ("find", "none"):
        return ibi.find_symmetries(points, normals) if given == "find" else ibi.Symmetries.none()
    path, _, number = given.rpartition(":")
    path, obj_id = (path, int(number)) if path and number.isdecimal() else (given, None)
    # BOP's lengths are in mm; what the model's are is seen by its diameter.
    entry, scale = bop_entry(path, obj_id), 1.0
    if "diameter" in entry:
        declared, own = entry["diameter"], metrics.diameter(points)
        is_number = isinstance(declared, (int, float)) and not isinstance(declared, bool)
        if not is_number or not 0 < declared < np.inf:
            raise ibi.InputError(f"{path}: diameter is {declared!r}; it must be a length in mm, above 0")
        if own == 0:
            raise ibi.InputError("the model's diameter is 0; it has no symmetries")
        ratio = own / declared
        if not 1e-9 < ratio < 1e9:
            raise ibi.InputError(
                f"{path}: diameter is {declared:g}, that of the model {own:g}; in what unit?"
            )
        scale = 10.0 ** round(np.log10(ratio))
    try:
        return ibi.Symmetries.from_bop(entry, scale=scale)
    except (ValueError, TypeError) as error:
        raise ibi.InputError(f"{path}: {error}") from error


def chosen_params(preset: str | None, path: Path | None) -> ibi.Params | None:
    """Read the parameters of a preset or a file; None where neither is given."""
    if preset is not None and path is not None:
        misused("give --preset or --params, not both")
    if preset is not None:
        if preset not in PRESETS:
            misused(f"--preset {preset}: there are {', '.join(PRESETS)}")
        return PRESETS[preset]()
    return None if path is None else ibi.Params.load(path)


def try_outputs(outputs: dict[str, Path | None], inputs: dict[str, Path | None]) -> None:
    """See before a run that what it finds can be written, and costs no other file.

    Parameters
    ----------
    outputs, inputs
        Files, by what the command line calls them.
    """
    taken = {os.path.realpath(path): name for name, path in inputs.items() if path is not None}
    for name, path in outputs.items():
        if path is None:
            continue
        if name == "--plot":
            ibi.plot._format(path)
        if name == "--rerun":
            ibi.viz._rerun()
        try_writing(path)
        if path.exists() and not path.is_file():
            continue  # of /dev/null there is no end
        other = taken.setdefault(os.path.realpath(path), name)
        if other != name:
            misused(f"{name} {path}: that is {other}; give another name")


def show(found: ibi.Registration, seconds: float) -> None:
    """Print a table of the poses."""
    table = Table(box=None, pad_edge=False)
    for column in ("", "score", "overlap", "inliers", "x", "y", "z", "rx", "ry", "rz"):
        table.add_column(column, justify="right", no_wrap=True)
    for number, pose in enumerate(found):
        place = lengths(pose.target_from_source[:3, 3], found.resolution)
        turn = [f"{x:.1f}" for x in np.degrees(_rotation_vector(pose.target_from_source[:3, :3]))]
        quality = [f"{pose.score:.2f}", f"{pose.overlap:.2f}", str(pose.num_inliers)]
        table.add_row(str(number), *quality, *place, *turn)
    if len(found):
        print_table(table)
        out.print("x, y, z in the unit of the scene; rx, ry, rz: rotation vector, degrees", style="dim")
    out.print(
        f"{len(found)} found in {seconds:.2f} s; stopped by {found.stop_reason}",
        highlight=False,
        markup=False,
    )


def print_table(table: Table) -> None:
    """Print a table as wide as it has to be: half a number is none, and half a path in a pipe."""
    needed = Measurement.get(out, out.options.update(width=10_000), table).maximum
    is_folded = any(column.overflow == "fold" for column in table.columns) and out.is_terminal
    console = out if is_folded else _Console(emoji=False, width=max(needed, out.width))
    console.print(table, crop=False)


def _rotation_vector(rotation: Any) -> Any:
    """Axis times angle, by the quaternion: exact for half turns, too."""
    four = np.empty((4, 4))  # 4 q qT, whose rows are all the quaternion q, (w, x, y, z), times something
    four[0, 0] = 1 + np.trace(rotation)
    off = rotation - rotation.T
    four[0, 1:] = four[1:, 0] = off[2, 1], off[0, 2], off[1, 0]
    four[1:, 1:] = rotation + rotation.T + (1 - np.trace(rotation)) * np.eye(3)
    quaternion = four[np.argmax(np.diag(four))]
    quaternion = quaternion / np.linalg.norm(quaternion) * np.copysign(1, quaternion[0])
    sine = float(np.linalg.norm(quaternion[1:]))
    return quaternion[1:] * (2 * np.arctan2(sine, quaternion[0]) / max(sine, 1e-300))


def sha256(path: Path) -> str:
    """Tell a file's content from any other."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def as_dict(
    found: ibi.Registration,
    seconds: float,
    *,
    model: Path,
    model_sha256: str,
    scene: Path,
    scene_sha256: str,
    search: dict[str, Any],
) -> dict[str, Any]:
    """Bring the poses into the form of the JSON files, with all that they depend on."""
    return {
        "ibi_rs": ibi.__version__,
        "model": str(model),
        "model_sha256": model_sha256,
        "scene": str(scene),
        "scene_sha256": scene_sha256,
        "search": search,
        "poses": [
            {
                "target_from_source": pose.target_from_source.tolist(),
                "score": pose.score,
                "overlap": pose.overlap,
                "num_inliers": pose.num_inliers,
                "inlier_rmse": pose.inlier_rmse,
            }
            for pose in found
        ],
        "warnings": list(found.warnings),
        "stop_reason": str(found.stop_reason),
        "seconds": round(seconds, 4),
        "resolution": found.resolution,
        "params": found.params.to_dict(),
    }


def write_json(path: Path, data: dict[str, Any]) -> None:
    """All of it or nothing, so that what is there after Ctrl-C can be relied on."""
    with written(path) as part:
        part.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def write_bop(
    path: Path, images: Sequence[tuple[int, int, Any, list[float], float]], obj_id: int = 1
) -> None:
    """Rows of images: scene_id, im_id, (K, 4, 4) poses, their scores, and seconds."""
    with written(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["scene_id", "im_id", "obj_id", "score", "R", "t", "time"])
        for scene_id, im_id, poses, scores, seconds in images:
            for pose, score in zip(poses, scores, strict=True):
                parts = pose[:3, :3], 1000 * pose[:3, 3]
                numbers = (" ".join(f"{x:.9g}" for x in part.ravel()) for part in parts)
                rows.writerow([scene_id, im_id, obj_id, f"{score:.6f}", *numbers, f"{seconds:.4f}"])
