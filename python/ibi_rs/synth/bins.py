"""Bins of parts, jumbled or in flush rows, as depth cameras see them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from .camera import DepthImage, Flaws, pinhole, sight, spoilt
from .casting import Ground, Solids, checked_mesh, inverse, looking_at, sides
from .common import Layout, Purpose, random_poses, stream
from .descriptors import load_open3d
from .scene import Array, move
from .solids import Mesh, box, joined

__all__ = ["Bin", "bin_scene", "row_scene"]

_VOXELS_PER_DIAMETER = 24  # of Model.from_mesh
_CELLS_PER_DIAMETER = 96  # of the height maps
_PLACES = 10  # drawn for each instance; it falls to the lowest
_TRIES = 14  # to lie lower, by tilting and sliding a little
_TILT_DEG, _SLIDE = 25.0, 0.15  # of a try: standard deviations; of the slide in diameters
_WALL = 0.05  # thickness, diameters
_TABLE = 0.4  # that is in the image beyond the walls, widths of the bin
_DISTANCE = 2.2  # of a camera from the bin, widths


@dataclass(frozen=True, eq=False, repr=False)
class Bin:
    """A bin of parts as seen by depth cameras, with its truth.

    Lengths are in the unit of the meshes. The frame of the scene is that of the first camera.

    Attributes
    ----------
    cameras : tuple of DepthImage
        What each camera measured, and from where.
    points : (N, 3) float64
        All points of all cameras, camera by camera, row by row.
    labels : (N,) int64
        Instance that each point lies on, -1 if on none.
    eyes : (E, 3) float64
        Where the cameras stood.
    poses : (K, 4, 4) float64
        target_from_model of all instances, in the order in which they fell; also of those that are hidden.
    kinds : (K,) int64
        Row of the mesh of each.
    visibility : (K,) float64
        Of the pixels that would see an instance if it were alone, without the bin, the share that sees it;
        over all cameras.
    target_from_bin : (4, 4) float64
        From the frame of the bin: its middle on the floor, z up, x and y along the walls.
    size : (3,) float64
        The inside of the bin: width, depth, height of the walls.
    voxel : float
        1/24 of the mean diagonal of the meshes' bounding boxes: the unit of the noise and of the pixels.
    """

    cameras: tuple[DepthImage, ...]
    points: Array
    labels: NDArray[np.int64]
    eyes: Array
    poses: Array
    kinds: NDArray[np.int64]
    visibility: Array
    target_from_bin: Array
    size: Array
    voxel: float

    def __repr__(self) -> str:
        """Summarise the bin in one line."""
        seen = np.sum(self.visibility >= 0.5)
        return (
            f"Bin({len(self.poses)} instances of {len(np.unique(self.kinds))} kinds, {seen} at least half "
            f"visible; {len(self.cameras)} cameras, {len(self.points)} points)"
        )

    @property
    def floor(self) -> Array:
        """Unit normal n, upwards, and d of the floor, (4,): its points have n . x + d = 0."""
        normal = self.target_from_bin[:3, 2]
        return np.append(normal, -normal @ self.target_from_bin[:3, 3])

    def of_kind(self, kind: int) -> tuple[Array, Array]:
        """Poses and visibility of the instances of one mesh.

        Parameters
        ----------
        kind : int
            Row of the mesh.

        Returns
        -------
        poses : (k, 4, 4) float64
        visibility : (k,) float64
        """
        rows = self.kinds == kind
        return self.poses[rows], self.visibility[rows]

    def is_inside(self, points: npt.ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """Whether points lie between the walls, at any height above the floor.

        Parameters
        ----------
        points : (N, 3) array_like
            In the frame of the scene.
        margin : float
            So much farther in, from walls and floor.

        Returns
        -------
        (N,) bool
        """
        inner = move(inverse(self.target_from_bin), np.asarray(points, dtype=np.float64))
        half = self.size[:2] / 2 - margin
        inside: NDArray[np.bool_] = (
            (np.abs(inner[:, 0]) <= half[0]) & (np.abs(inner[:, 1]) <= half[1]) & (inner[:, 2] >= margin)
        )
        return inside


def bin_scene(
    meshes: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]],
    *,
    seed: int,
    num_instances: int | Sequence[int] = 4,
    flat: float = 0.6,
    layers: float = 0.6,
    num_cameras: int = 1,
    tilt_deg: tuple[float, float] = (5.0, 30.0),
    pixel: float = 0.3,
    noise: float = 0.1,
    quantum: float = 0.03,
    smear: float = 0.3,
    dropout: float = 1.0,
) -> Bin:
    """Fill a bin with parts of several kinds, and look into it with depth cameras.

    The bin has a floor and four walls and stands on a table, which the image shows, too. Parts fall into it
    one after the other, in any order of the kinds: some lie as they would on a floor, the others are turned
    at random and tip over by small steps, as long as that brings them lower. What falls is held against
    height maps, so that parts touch and do not run into one another. Needs Open3D.

    Parameters
    ----------
    meshes : sequence of (vertices, faces)
        One for each kind: (V, 3) in one unit for all, and (F, 3) rows of the vertices.
    seed : int
        Non-negative; the same seed and arguments give the same bin. Across machines the last bits of Open3D
        may differ.
    num_instances : int or sequence of int
        Of each kind; at least 1 in all.
    flat : float
        Share of the instances that come down in a stable pose, 0 to 1.
    layers : float
        Area of all instances, as seen from above, over that of the floor. Above 0.
    num_cameras : int
        At least 1; evenly about the bin, each tilted by itself.
    tilt_deg : (float, float)
        Range from which the angle between each line of sight and the vertical is drawn, degrees, within
        [0, 60].
    pixel : float
        Width of what a pixel sees in the middle of the bin, voxels (1/24 of the mean diagonal).
    noise, quantum : float
        Standard deviation along z, half of it shared by neighbouring pixels, and step between two depths;
        both in voxels, in the middle of the bin. They grow with the square of the depth.
    smear : float
        Share of the pixels beside a step in depth that measure something between its sides, 0 to 1.
    dropout : float
        1: pixels are lost where a surface is seen at more than 75 degrees, where the second eye of a stereo
        camera would not see it, and here and there. 0: none are.

    Returns
    -------
    Bin

    Raises
    ------
    ImportError
        If Open3D is not installed; the message names the extra that brings it.
    ValueError
        If a mesh has no extent or names vertices that do not exist, or an argument is out of range.

    Examples
    --------
    >>> from ibi_rs import synth
    >>> kinds = [synth.part_mesh("bracket-a"), synth.part_mesh("bolt-a")]
    >>> scene = synth.bin_scene(kinds, seed=1, num_instances=5)              # doctest: +SKIP
    >>> scene.poses.shape                                                    # doctest: +SKIP
    (10, 4, 4)
    """
    solids = _checked(meshes)
    counts = np.broadcast_to(num_instances, (len(solids),))
    if (counts < 0).any() or not counts.sum() or not layers > 0:
        raise ValueError("num_instances must be at least 1 in all, none of them below 0, and layers above 0")
    if not 0 <= flat <= 1:
        raise ValueError(f"flat must be within [0, 1], got {flat}")
    look = _Look(num_cameras, tilt_deg, pixel, noise, quantum, smear, dropout)
    look.check()
    kinds = stream(seed, Layout.BIN, Purpose.MATCHES).permutation(np.repeat(np.arange(len(solids)), counts))
    poses, inside = _filled(solids, kinds, flat, layers, seed)
    return _photographed(solids, kinds, poses, inside, look, seed)


def row_scene(
    mesh: tuple[npt.ArrayLike, npt.ArrayLike],
    *,
    seed: int,
    gap: float = 0.0,
    rows: int = 3,
    columns: int = 4,
    num_empty: int = 0,
    num_cameras: int = 1,
    tilt_deg: tuple[float, float] = (0.0, 12.0),
    pixel: float = 0.3,
    noise: float = 0.1,
    quantum: float = 0.03,
    smear: float = 0.3,
    dropout: float = 1.0,
) -> Bin:
    """Set parts into a tray in rows, and look at it from above.

    All stand alike, on a side that the seed chooses among those on which a box about the mesh can stand, half
    of them turned by 180 degrees about the vertical. The tray has low walls, which the outer parts touch with
    the same gap. Needs Open3D.

    Parameters
    ----------
    mesh : (vertices, faces)
        As in `bin_scene`.
    seed : int
        As in `bin_scene`.
    gap : float
        Between neighbours, in the unit of the mesh; at least 0: flush.
    rows, columns : int
        At least 1.
    num_empty : int
        Places without a part, fewer than there are places.
    num_cameras, tilt_deg, pixel, noise, quantum, smear, dropout
        As in `bin_scene`.

    Returns
    -------
    Bin

    Raises
    ------
    ImportError
        As `bin_scene`.
    ValueError
        As `bin_scene`.
    """
    solids = _checked([mesh])
    if min(rows, columns) < 1 or not 0 <= num_empty < rows * columns or not gap >= 0:
        raise ValueError(
            "rows and columns must be at least 1, num_empty below their product and gap at least 0"
        )
    look = _Look(num_cameras, tilt_deg, pixel, noise, quantum, smear, dropout)
    look.check()
    points, _ = solids[0]
    rng = stream(seed, Layout.ROWS, Purpose.POSES)
    turn = _cube_turns()[rng.integers(6) * 4]
    lying = points @ turn.T
    low, extent = lying.min(axis=0), np.ptp(lying, axis=0)
    step = extent[:2] + gap
    inside = np.array([columns, rows]) * step + gap
    kept = np.sort(rng.permutation(rows * columns)[num_empty:])
    poses = np.tile(np.eye(4), (len(kept), 1, 1))
    half_turn = np.diag([-1.0, -1.0, 1.0])
    for pose, place in zip(poses, kept, strict=True):
        corner = np.append(np.array([place % columns, place // columns]) * step + gap - inside / 2, 0.0)
        middle = low + extent / 2
        turned = half_turn if rng.random() < 0.5 else np.eye(3)
        pose[:3, :3] = turned @ turn
        pose[:3, 3] = corner + extent / 2 - turned @ middle
    size = np.append(inside, 0.5 * extent[2])
    return _photographed(solids, np.zeros(len(kept), dtype=np.int64), poses, size, look, seed)


def _checked(meshes: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]]) -> list[Mesh]:
    if not len(meshes):
        raise ValueError("meshes must have at least one")
    load_open3d("Bins need")
    return [checked_mesh(*mesh) for mesh in meshes]


def _diameter(points: Array) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0)))


# The bin, in its own frame: z up, the floor is z = 0, its middle the origin ---------------------------------


def _filled(
    solids: list[Mesh], kinds: NDArray[np.int64], flat: float, layers: float, seed: int
) -> tuple[Array, Array]:
    """Let instances fall into the bin; return bin_from_model, (K, 4, 4), and the inside, (3,)."""
    rng = stream(seed, Layout.BIN, Purpose.POSES)
    sizes = [_diameter(points) for points, _ in solids]
    size = float(np.mean(sizes))
    cell = size / _CELLS_PER_DIAMETER
    stable = [stable_turns(solid) for solid in solids]
    turns = random_poses(len(kinds), rng, 0.0)[:, :3, :3]
    is_flat = rng.random(len(kinds)) < flat
    for k in np.flatnonzero(is_flat):
        ways, weights = stable[kinds[k]]
        turns[k] = _about_z(rng.uniform(0, 2 * np.pi)) @ ways[rng.choice(len(ways), p=weights)]

    fallers = [_Faller(solids[kind], cell) for kind in kinds]
    area = sum(np.isfinite(faller.maps(turn)[2]).sum() for faller, turn in zip(fallers, turns, strict=True))
    aspect = rng.uniform(1, 1.5)
    wide = max(math.sqrt(area * cell**2 / layers), 1.1 * max(sizes))
    half = np.ceil(wide / 2 * np.array([math.sqrt(aspect), 1 / math.sqrt(aspect)]) / cell).astype(np.int64)
    half = np.maximum(half, math.ceil(0.55 * max(sizes) / cell))
    ground = Ground(half)

    poses = np.tile(np.eye(4), (len(kinds), 1, 1))
    for pose, faller, turn, lies_flat in zip(poses, fallers, turns, is_flat, strict=True):
        best = faller.fall(ground, turn, half, rng.uniform(-1, 1, (_PLACES, 2)) * half)
        # What lies on the floor in a stable pose has nowhere to go.
        for _ in range(0 if lies_flat and best.is_on_floor else _TRIES):
            turn = _small_turn(rng, np.radians(_TILT_DEG)) @ best.turn
            slide = rng.normal(0, _SLIDE * faller.size / cell, (1, 2))
            tried = faller.fall(ground, turn, half, best.cells + slide)
            if tried.height < best.height:
                best = tried
        ground.add(best.first + best.cells, best.upper, best.height)
        pose[:3, :3] = best.turn
        pose[:3, 3] = np.append(best.cells * cell, best.height) - best.turn @ faller.center
    heap = float(ground.top.max())
    height = max(0.4 * size, heap * rng.uniform(0.5, 1.1))
    return poses, np.append(2 * half * cell, height)


class _Place(NamedTuple):
    """Where an instance has come down: its turn, whole cells and height of its centre, and its maps."""

    turn: Array
    cells: NDArray[np.int64]
    height: float
    first: NDArray[np.int64]
    upper: Array
    is_on_floor: bool


class _Faller:
    """A mesh about its centre of mass, with its last maps."""

    def __init__(self, solid: Mesh, cell: float) -> None:
        self.center = center_of_mass(solid)
        self.size = _diameter(solid[0])
        self._points, self._triangles, self._cell = solid[0] - self.center, solid[1], cell
        self._last: tuple[bytes, tuple[NDArray[np.int64], Array, Array]] | None = None

    def maps(self, turn: Array) -> tuple[NDArray[np.int64], Array, Array]:
        key = turn.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = key, sides(self._points @ turn.T, self._triangles, self._cell)
        return self._last[1]

    def fall(self, ground: Ground, turn: Array, half: NDArray[np.int64], places: Array) -> _Place:
        """Come down at the lowest of some places, (n, 2) cells, moved to where the walls let it be."""
        first, under, upper = self.maps(turn)
        # One empty cell is about the maps; what is left must lie between the walls.
        low, high = -half - first, half - (first + under.shape)
        cells = np.clip(np.round(places).astype(np.int64), low, np.maximum(low, high))
        heights = [ground.rest(first + at, under) for at in cells]
        best = int(np.argmin(heights))
        is_on_floor = heights[best] + float(under.min()) <= 0
        return _Place(turn, cells[best], heights[best], first, upper, is_on_floor)


def center_of_mass(solid: Mesh) -> Array:
    """Centre of a closed mesh, by its volume; of an open one, of its corners."""
    a, b, c = (solid[0][solid[1][:, i]] for i in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    total = volume.sum()
    if not total > 1e-6 * _diameter(solid[0]) ** 3:
        middle: Array = (solid[0].min(axis=0) + solid[0].max(axis=0)) / 2
        return middle
    center: Array = volume @ (a + b + c) / 4 / total
    return center


def stable_turns(solid: Mesh) -> tuple[Array, Array]:
    """Return the turns by which a part stands on a floor, (n, 3, 3), and how often it falls so, (n,).

    It stands on a facet of its convex hull with its centre of mass above it, and falls so as often as the
    facet is wide, seen from there.
    """
    o3d = load_open3d("Bins need")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(solid[0]))
    hull, _ = cloud.compute_convex_hull(joggle_inputs=False)
    corners, faces = np.asarray(hull.vertices), np.asarray(hull.triangles)
    center = center_of_mass(solid)
    a, b, c = (corners[faces[:, i]] - center for i in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    keep = area > 1e-9 * area.max()
    a, b, c, normal = a[keep], b[keep], c[keep], normal[keep] / area[keep, None]
    outwards = np.sum(normal * a, axis=1) >= 0
    normal = np.where(outwards[:, None], normal, -normal)
    b, c = np.where(outwards[:, None], b, c), np.where(outwards[:, None], c, b)
    # The foot of the centre of mass lies within the triangle if it is on the inner side of all three edges.
    foot = normal * np.sum(normal * a, axis=1, keepdims=True)
    is_within = np.ones(len(a), dtype=bool)
    for p, q in ((a, b), (b, c), (c, a)):
        side = np.sum(np.cross(q - p, foot - p) * normal, axis=1)
        is_within &= side >= -1e-9 * area.max()
    # Solid angle of a triangle (Van Oosterom & Strackee 1983).
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    spread = (
        la * lb * lc + np.sum(a * b, axis=1) * lc + np.sum(b * c, axis=1) * la + np.sum(c * a, axis=1) * lb
    )
    angle = 2 * np.arctan2(np.abs(np.einsum("ij,ij->i", a, np.cross(b, c))), spread)
    ways, weights = [], []
    left = np.ones(len(a), dtype=bool)
    for k in np.flatnonzero(is_within):
        if left[k]:
            same = left & (normal @ normal[k] > 1 - 1e-9)
            left &= ~same
            ways.append(_downwards(normal[k]))
            weights.append(angle[same].sum())
    return np.array(ways), np.array(weights) / np.sum(weights)


def _downwards(normal: Array) -> Array:
    """Return the least turn that makes a direction point down."""
    x, y, z = -normal
    if z < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    turn: Array = np.eye(3) + cross + cross @ cross / (1 + z)
    return turn


def _about_z(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _small_turn(rng: np.random.Generator, sigma: float) -> Array:
    """Turn about a random axis by a normal angle."""
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    angle = rng.normal(0, sigma)
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn: Array = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return turn


def _cube_turns() -> Array:
    """Return the 24 turns of a cube, four for each side that points up."""
    ups = [np.eye(3)]
    for angle in (90, 180, 270):
        c, s = round(math.cos(math.radians(angle))), round(math.sin(math.radians(angle)))
        ups.append(np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]]))
    for s in (1, -1):
        ups.append(np.array([[0.0, 0, s], [0, 1, 0], [-s, 0, 0]]))
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    return np.array([np.linalg.matrix_power(quarter, k) @ up for up in ups for k in range(4)])


# The view ---------------------------------------------------------------------------------------------------


class _Look(NamedTuple):
    """How it is looked at: arguments of `bin_scene`."""

    num_cameras: int
    tilt_deg: tuple[float, float]
    pixel: float
    noise: float
    quantum: float
    smear: float
    dropout: float

    def check(self) -> None:
        lo, hi = self.tilt_deg
        if not 0 <= lo <= hi <= 60:
            raise ValueError(f"tilt_deg must be a range in order within [0, 60], got {self.tilt_deg}")
        if self.num_cameras < 1 or not self.pixel > 0:
            raise ValueError("num_cameras must be at least 1 and pixel above 0")
        if not min(self.noise, self.quantum) >= 0:
            raise ValueError("noise and quantum must be at least 0")
        if not (0 <= self.smear <= 1 and 0 <= self.dropout <= 1):
            raise ValueError("smear and dropout must be within [0, 1]")


def _photographed(
    solids: list[Mesh], kinds: NDArray[np.int64], poses: Array, inside: Array, look: _Look, seed: int
) -> Bin:
    """Look at instances in their bin, poses as bin_from_model."""
    size = float(np.mean([_diameter(points) for points, _ in solids]))
    voxel = size / _VOXELS_PER_DIAMETER
    wide = float(inside[:2].max())
    distance = _DISTANCE * wide + inside[2]
    meshes = [(move(pose, solids[kind][0]), solids[kind][1]) for pose, kind in zip(poses, kinds, strict=True)]
    world = Solids([*meshes, walls(inside, _WALL * size, 10 * wide)])

    draw = stream(seed, Layout.BIN, Purpose.DRAW)
    first, count = draw.uniform(0, 2 * np.pi), look.num_cameras
    middle = np.array([0.0, 0.0, inside[2] / 3])
    focal = distance / (look.pixel * voxel)
    flaws = Flaws(look.noise * voxel, look.quantum * voxel, look.smear, look.dropout, distance, voxel)
    rim = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, 1)]) * inside / [2, 2, 1]
    images: list[DepthImage] = []
    seen, alone = np.zeros(len(poses)), np.zeros(len(poses))
    target_from_bin = np.eye(4)
    for i in range(count):
        tilt = np.radians(draw.uniform(*look.tilt_deg))
        camera_from_bin = looking_at(middle, tilt, first + 2 * np.pi * i / count, distance)
        if i == 0:
            target_from_bin = camera_from_bin
        bin_from_camera = inverse(camera_from_bin)
        corners = move(camera_from_bin, rim)
        spread = np.abs(corners[:, :2] / corners[:, 2:]).max(axis=0) + _TABLE / 2 * wide / distance
        half = np.ceil(spread * focal)
        shape = 2 * int(half[1]) + 1, 2 * int(half[0]) + 1
        rays = pinhole(shape, focal, focal, *half)
        exact = sight(world, bin_from_camera, rays)
        owner = np.where(exact.owner < len(poses), exact.owner, -1)
        for k, mesh in enumerate(meshes):
            seen[k] += np.sum(owner == k)
            alone[k] += _silhouette(mesh, camera_from_bin, rays, focal, half)
        depth, labels = spoilt(
            exact._replace(owner=owner), flaws, stream(seed, Layout.BIN, Purpose.POINTS, i)
        )
        at = target_from_bin @ bin_from_camera if i else np.eye(4)
        images.append(DepthImage(depth, labels, focal, focal, float(half[0]), float(half[1]), at))
    return Bin(
        tuple(images),
        np.concatenate([image.points for image in images]),
        np.concatenate([image.labels[np.isfinite(image.depth)] for image in images]),
        np.array([image.eye for image in images]),
        target_from_bin @ poses,
        kinds.astype(np.int64),
        seen / np.maximum(alone, 1),
        target_from_bin,
        inside,
        voxel,
    )


def _silhouette(mesh: Mesh, camera_from_bin: Array, rays: Array, focal: float, half: Array) -> int:
    """Count the pixels that see a mesh if there is nothing else."""
    points = move(camera_from_bin, mesh[0])
    places = points[:, :2] / points[:, 2:] * focal + half
    (u0, v0), (u1, v1) = np.floor(places.min(axis=0)), np.ceil(places.max(axis=0)) + 1
    window = rays[max(int(v0), 0) : max(int(v1), 0), max(int(u0), 0) : max(int(u1), 0)]
    t, _ = Solids([(points, mesh[1])]).cast(np.concatenate([np.zeros_like(window), window], axis=-1))
    return int(np.isfinite(t).sum())


def walls(inside: Array, thick: float, reach: float) -> Mesh:
    """Return a floor, four walls and the table that they stand on."""
    (x, y), height = inside[:2] / 2, inside[2]
    return joined(
        box((-x - thick, -y - thick, -thick), (x + thick, y + thick, 0)),
        box((-x - thick, -y - thick, -thick), (-x, y + thick, height)),
        box((x, -y - thick, -thick), (x + thick, y + thick, height)),
        box((-x - thick, -y - thick, -thick), (x + thick, -y, height)),
        box((-x - thick, y, -thick), (x + thick, y + thick, height)),
        box((-reach, -reach, -2 * thick), (reach, reach, -thick)),
    )
