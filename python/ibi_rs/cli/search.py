"""The search that the options of a command describe."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, get_args

import numpy as np
import typer

import ibi_rs as ibi
from ibi_rs import features, io, metrics
from ibi_rs import params as parameters
from ibi_rs._files import read_npy
from ibi_rs._inputs import _num_threads
from ibi_rs._log import LOGGER
from ibi_rs._written import METRES, checked_unit
from ibi_rs.symmetries import _bop_entry as bop_entry

from .outputs import sha256
from .terminal import misused, warn

SYMMETRIES = "find, none, or BOP's models_info.json, with :ID where it has several objects"

PRESETS = get_args(parameters.Preset)

ModelFile = Annotated[
    Path, typer.Argument(help="Mesh of the part: STL, PLY, OBJ, OFF or GLB.", metavar="MODEL")
]
ModelFiles = Annotated[
    list[Path],
    typer.Argument(
        help="Mesh of the part, or of each of several: STL, PLY, OBJ, OFF or GLB.", metavar="MODEL"
    ),
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
Crop = Annotated[
    tuple[float, float, float, float, float, float] | None,
    typer.Option(
        help="Look only into a box along the axes of SCENE: its least corner and its largest one, "
        "x0,y0,z0,x1,y1,z1 or six numbers.",
        metavar="X0 Y0 Z0 X1 Y1 Z1",
    ),
]
Background = Annotated[
    Path | None,
    typer.Option(
        help="The empty bin as the same camera measured it: what lies on it is not searched.",
    ),
]
CameraOf = Annotated[
    str | None,
    typer.Option(
        "--camera",
        help="SCENE is a depth image (PNG, TIFF, NPY): FX,FY,CX,CY in pixels, or a JSON file "
        "of BOP, RealSense, Open3D or ROS.",
        metavar="FX,FY,CX,CY|FILE",
    ),
]
DepthScale = Annotated[
    float | None,
    typer.Option(
        help="So many steps of a pixel of the depth image are one unit. Default: what the file of --camera "
        "says, else a step is a millimetre, and in an image of floats the unit. See --unit.",
    ),
]
RemovePlanes = Annotated[
    int | None,
    typer.Option(
        min=0,
        max=20,
        help="Take so many of the largest planes away: floor and walls of a bin. What was measured there "
        "still tells where there is nothing. Instead of --remove-plane.",
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
ParamsFile = Annotated[
    Path | None,
    typer.Option(help="Parameters as TOML or JSON. What FILE leaves out is of its base, else of the preset."),
]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set", help="One parameter, as hv.t_score=0.97 or te=mac; may be given again.", metavar="NAME=VALUE"
    ),
]
MinScore = Annotated[
    float | None, typer.Option(min=0, max=1, help="Leave out poses that are right with a lower probability.")
]
Unit = Annotated[
    str | None,
    typer.Option(
        help=f"What MODEL and the scan are in: {', '.join(METRES)}. For the JSON, and for the mm of --bop, "
        "which otherwise takes parts below 1 across to be in m, and above 10 in mm."
    ),
]
MaxInstances = Annotated[int | None, typer.Option(min=1, max=2**32 - 1, help="No more than so many.")]
TimeoutS = Annotated[float | None, typer.Option(help="Seconds, then what was found is kept.")]


@dataclass(frozen=True)
class Changes:
    """What the options say of parameters; of the rest the scene decides."""

    preset: str | None
    path: Path | None
    settings: dict[str, Any]

    @property
    def is_any(self) -> bool:
        """Whether the options say anything."""
        return self.preset is not None or self.path is not None or bool(self.settings)

    def on(self, fitting: ibi.Params) -> ibi.Params:
        """Lay the file over the preset, or over what fits the scene, and single values over that."""
        params = fitting if self.preset is None else ibi.Params.preset(self.preset)  # type: ignore[arg-type]
        if self.path is not None:
            params = ibi.Params.load(self.path, base=params)
        try:
            return params.replace(**self.settings)
        except (ibi.ParamsError, TypeError) as error:
            misused(f"--set: {error}")


def _is_of_floats(path: Path) -> bool:
    """Whether the pixels of an image are no integers."""
    if path.suffix.lower() == ".npy":
        return bool(read_npy(path).dtype.kind == "f")
    from PIL import Image

    try:
        with Image.open(path) as image:
            return bool(image.mode == "F")
    except OSError:  # of which `read_depth` tells
        return False


def _without_planes(points: Any, voxel: float, count: int, crop: Any, eye: Any) -> Any:
    """(N,): which points are on none of the largest planes, one after the other, of what is looked into."""
    is_left = np.ones(len(points), bool)
    least = 0.0
    for _ in range(count):
        rows = np.flatnonzero(is_left)
        if crop is not None:
            rows = rows[((points[rows] >= crop[:3]) & (points[rows] <= crop[3:])).all(axis=1)]
        if len(rows) < 3:
            break
        thinned, _ = features.voxel_downsample(points[rows], voxel)
        least = least or 0.1 * len(thinned)  # of all: the faces of few parts that are left are no walls
        share = least / len(thinned)
        if share > 1:
            break
        plane = features.dominant_plane(thinned, 1.5 * voxel, min_share=share, viewpoint=eye)
        if plane is None:
            break
        is_left[rows] = np.abs(points[rows] @ plane.normal - plane.offset) > 1.5 * voxel
    return is_left


def unit_of(unit: str | None) -> str | None:
    """See that a unit has a name."""
    try:
        return checked_unit(unit)
    except ibi.InputError as error:
        misused(f"--unit: {error}")


def changes_of(preset: str | None, path: Path | None, settings: list[str] | None) -> Changes:
    """Read what the options say of parameters, and see that they can be used."""
    if preset is not None and preset not in PRESETS:
        misused(f"--preset {preset}: there are {', '.join(PRESETS)}")
    values = {}
    for setting in settings or ():
        name, equals, text = setting.partition("=")
        if not equals or not name.strip() or not text.strip():
            misused(f"--set {setting}: must be NAME=VALUE, as hv.t_score=0.97")
        if name.strip() not in {*parameters._HINTS, *parameters._STAGES, *VARIANTS}:
            misused(f"--set {setting}: there is no parameter {name.strip()!r}")
        values[name.strip()] = _value(text.strip())
    changes = Changes(preset, path, parameters._with_nulls(values))
    changes.on(ibi.Params())
    return changes


VARIANTS = {f"{stage}.variant" for stage in parameters._STAGES}


def _value(text: str) -> Any:
    """Read a number, true, false or a word."""
    for read in (int, float):
        try:
            return read(text)
        except ValueError:
            pass
    return {"true": True, "false": False}.get(text.lower(), text)


@dataclass(frozen=True)
class Search:
    """How to look for a part in a scan, from the options of the command line."""

    viewpoint: tuple[float, float, float] | None
    from_all_sides: bool
    voxel: float | None
    remove_plane: bool | None
    changes: Changes
    max_instances: int | None
    timeout_s: float | None
    symmetries: str = "none"
    crop: tuple[float, ...] | None = None
    min_score: float | None = None
    camera: str | None = None
    depth_scale: float | None = None
    remove_planes: int | None = None
    unit: str | None = None
    background: Path | None = None

    def __post_init__(self) -> None:
        """Refuse now what would be refused once the files are read."""
        if self.camera is None and self.depth_scale is not None:
            misused("--depth-scale is of a depth image; give its --camera")
        if self.depth_scale is not None and not 0 < self.depth_scale < np.inf:
            misused(f"--depth-scale is {self.depth_scale:g}; it must be above 0 and finite")
        if self.camera is not None and (self.from_all_sides or self.viewpoint is not None):
            misused("--camera says where it stood, at 0,0,0: leave --viewpoint and --from-all-sides out")
        if self.remove_plane is not None and self.remove_planes is not None:
            misused("give --remove-planes or --remove-plane, not both")
        _ = self._numbers  # of --camera
        if self.from_all_sides and self.viewpoint is not None:
            misused("--from-all-sides has no --viewpoint; leave one of them out")
        if self.viewpoint is not None and not np.isfinite(self.viewpoint).all():
            misused("--viewpoint must be three finite numbers")
        if self.crop is not None and not (
            np.isfinite(self.crop).all() and np.less(self.crop[:3], self.crop[3:]).all()
        ):
            misused("--crop must be six finite numbers, the first three each below one of the last three")
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

    @cached_property
    def _numbers(self) -> list[float] | None:
        """FX, FY, CX, CY; None: --camera is a file."""
        if self.camera is None:
            return None
        words = self.camera.replace(",", " ").split()
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            return None
        if len(numbers) != 4:
            misused(f"--camera {self.camera}: must be four numbers, FX,FY,CX,CY, or a file")
        if not (np.isfinite(numbers).all() and min(numbers[:2]) > 0):
            misused(f"--camera {self.camera}: must be finite, FX and FY above 0")
        return numbers

    def read(self, path: Path) -> io.Scan:
        """Read a scan, or the depth image of a camera."""
        if self.camera is None:
            return io.read_scan(path)
        camera = self.camera_of(path)
        metres = 0.001 if camera.metres is None else camera.metres
        if camera.is_distorted:
            warn(f"{self.camera}: names distortions, which are not undone; give rectified images")
        scale = metres / METRES[self.unit or "m"] if self.depth_scale is None else 1 / self.depth_scale
        if self.depth_scale is None and camera.metres is None and _is_of_floats(path):
            scale = 1.0
        points = io.read_depth(path, camera.fx, camera.fy, camera.cx, camera.cy, scale=scale)
        return io.Scan(points, None, np.zeros(3), 0)

    def camera_of(self, path: Path) -> io.Camera:
        """Return that of --camera, of the depth image of a path."""
        assert self.camera is not None
        if self._numbers is None:
            return io.read_camera(self.camera, path)
        fx, fy, cx, cy = self._numbers
        return io.Camera(fx, fy, cx, cy)

    def look(self, scan: io.Scan, voxel: float) -> tuple[Any, dict[str, Any]]:
        """Return the points to be searched, and the arguments of `Model.detect` that go with them."""
        sight = self.sight(scan.normals, scan.viewpoint)
        if self.remove_planes is None:
            return scan.points, sight
        is_left = _without_planes(scan.points, voxel, self.remove_planes, self.crop, sight["viewpoint"])
        if not is_left.any():
            raise ibi.InputError(f"--remove-planes {self.remove_planes}: nothing of the scan is left")
        LOGGER.info("--remove-planes: %d points of %d taken away", (~is_left).sum(), len(is_left))
        sight["remove_plane"] = False
        if sight["viewpoint"] is not None:
            sight["viewpoint"] = ibi.View(sight["viewpoint"], scan.points)
        if sight["tgt_normals"] is not None:
            sight["tgt_normals"] = sight["tgt_normals"][is_left]
        return scan.points[is_left], sight

    def sight(self, normals: Any, viewpoint: Any) -> dict[str, Any]:
        """Those arguments of `Model.correspond` that `Model.detect` has, too, by what a file says."""
        place = (0.0, 0.0, 0.0) if viewpoint is None else tuple(viewpoint)
        return {
            "tgt_normals": normals if self.from_all_sides else None,
            "viewpoint": None if self.from_all_sides else self.viewpoint or place,
            "remove_plane": self.remove_plane,
            "roi": None if self.crop is None else np.reshape(self.crop, (2, 3)),
            "background": self._empty,
        }

    @cached_property
    def _empty(self) -> Any:
        """The points of --background."""
        return None if self.background is None else self.read(self.background).points

    @cached_property
    def params(self) -> ibi.Params | None:
        """The parameters of a detection; None: what fits the scene, as it is."""
        if not self.changes.is_any:
            return None
        return self.changes.on(ibi.Params.many_views() if self.from_all_sides else ibi.Params.single_view())

    def params_for(self) -> ibi.Params:
        """Return those that a detection will have: chosen, or what fits the scene, and the limits."""
        default = ibi.Params.many_views() if self.from_all_sides else ibi.Params.single_view()
        limits = {"max_instances": self.max_instances, "timeout_s": self.timeout_s}
        given = {name: value for name, value in limits.items() if value is not None}
        return (self.params or default).replace(**given)

    def kept(self, found: ibi.Registration) -> ibi.Registration:
        """Leave out what has too low a score."""
        return found if self.min_score is None else found.at_least(self.min_score)

    def recorded(self, *symmetries: ibi.Symmetries) -> dict[str, Any]:
        """Return what a result depends on beside the parameters and the files, for the JSON."""
        of = [held.to_bop() for held in symmetries]
        return {
            "viewpoint": None if self.viewpoint is None else list(self.viewpoint),
            "from_all_sides": self.from_all_sides,
            "voxel": self.voxel,
            "remove_plane": self.remove_plane,
            "symmetries": of[0] if len(of) == 1 else of,
            "crop": None if self.crop is None else list(self.crop),
            "min_score": self.min_score,
            "camera": self.camera,
            "depth_scale": self.depth_scale,
            "remove_planes": self.remove_planes,
            "background_sha256": None if self.background is None else sha256(self.background),
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
