"""Rooms of furniture, scanned by a depth camera that is carried through them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from .camera import Flaws, Sight, pinhole, sight, spoilt
from .casting import Solids, checked_mesh
from .common import Layout, Purpose, bounds, stream
from .descriptors import load_open3d
from .scene import Array, move
from .solids import Mesh, box, joined

__all__ = ["Room", "room_scene"]

# Of the camera: pixels, metres.
_SHAPE, _FOCAL = (108, 144), 125.0
_NEAR, _FAR = 0.35, 4.0
_JUMP = 0.05
_AT = 2.0  # where the noise is as asked for
_EYE_HEIGHT = (1.0, 1.75)
_CLEARANCE = 0.25  # of an eye from furniture
_HEIGHT = 2.4  # of the walls
_GAP = 0.04  # between pieces
_MARGIN = 0.9  # of floor about a piece that an empty room would have, metres
_PLACES = 400  # tried for a piece before the room is made larger
_SAMPLES = 4000  # of the surface of each copy, to tell how much of it was seen
_NEIGHBORS = 30  # of a normal


class Walk(NamedTuple):
    """How thoroughly a room is scanned."""

    num_eyes: tuple[int, int]
    arc: tuple[float, float]
    """Share of a way around the room that is walked."""
    sideways: float
    """How far the camera looks aside of the middle of the room, degrees: standard deviation."""


_WALKS = {"little": Walk((20, 26), (0.12, 0.3), 12.0), "well": Walk((50, 60), (1.0, 1.0), 30.0)}


@dataclass(frozen=True, eq=False, repr=False)
class Room:
    """A scanned room, with its truth.

    Lengths are in metres; z is up, and the floor is z = 0.

    Attributes
    ----------
    points : (N, 3) float64
        The scan, fused: one point a voxel, the mean of all that was measured in it.
    normals : (N, 3) float64
        Unit normals, estimated from the points; they face the eyes that saw them.
    labels : (N,) int64
        Copy that most of the measurements of a point lie on, -1 if on none.
    eyes : (E, 3) float64
        Where the camera was, in the order of the walk.
    poses : (K, 4, 4) float64
        target_from_model of all copies.
    visibility : (K,) float64
        Of the surface of a copy that can be seen from outside where it stands alone, the share that was
        measured: that has a measurement of this copy within a voxel.
    voxel : float
        What the scan was fused to.
    """

    points: Array
    normals: Array
    labels: NDArray[np.int64]
    eyes: Array
    poses: Array
    visibility: Array
    voxel: float

    def __repr__(self) -> str:
        """Summarise the room in one line."""
        seen = ", ".join(f"{share:.0%}" for share in self.visibility)
        return (
            f"Room({len(self.poses)} copies, seen {seen}; {len(self.points)} points, {len(self.eyes)} eyes)"
        )


def room_scene(
    mesh: tuple[npt.ArrayLike, npt.ArrayLike],
    distractors: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]] = (),
    *,
    seed: int,
    coverage: Literal["little", "well"] = "well",
    num_instances: int | tuple[int, int] = (2, 5),
    num_distractors: int | tuple[int, int] = (4, 8),
    voxel: float = 0.022,
    noise: float = 0.004,
    quantum: float = 0.003,
    smear: float = 0.3,
    dropout: float = 1.0,
    drift: float = 0.002,
) -> Room:
    """Furnish a room, carry a depth camera through it, and fuse what it measures.

    Copies of a piece and distractors stand on the floor, turned about the vertical at random, and do not run
    into one another; a room is as large as they need. Needs Open3D.

    Parameters
    ----------
    mesh : (vertices, faces)
        Of the piece: (V, 3), metres, standing on z = 0 with z up, and (F, 3) rows of the vertices.
    distractors : sequence of (vertices, faces)
        Other pieces, each of which may be there several times or not at all.
    seed : int
        Non-negative; the same seed and arguments give the same room. Across machines the last bits of Open3D
        may differ.
    coverage : {"little", "well"}
        A walk of 20 to 26 eyes along one side, so that the far side of most pieces is never seen; or one of
        50 to 60 eyes all around.
    num_instances, num_distractors : int or (int, int)
        One number, or a range that includes both ends; the first at least 0. Distractors are drawn only if
        there are meshes of them.
    voxel : float
        To fuse to, above 0.
    noise, quantum : float
        Standard deviation along z and step between two depths, metres at 2 m. They grow with the square of
        the depth.
    smear, dropout : float
        As in `bin_scene`.
    drift : float
        How far the place that the scanner believes in is off that of an eye, metres: standard deviation of
        each coordinate; its direction is off by as much at 1 m.

    Returns
    -------
    Room

    Raises
    ------
    ImportError
        If Open3D is not installed; the message names the extra that brings it.
    ValueError
        If a mesh has no extent or names vertices that do not exist, or an argument is out of range.

    Examples
    --------
    >>> from ibi_rs import synth
    >>> chair, table = (synth.furniture_mesh(name) for name in ("chair-a", "table-a"))
    >>> room = synth.room_scene(chair, [table], seed=1, num_instances=4)     # doctest: +SKIP
    >>> room.poses.shape                                                     # doctest: +SKIP
    (4, 4, 4)
    """
    if coverage not in _WALKS:
        raise ValueError(f"coverage must be one of {', '.join(_WALKS)}, got {coverage!r}")
    if not voxel > 0 or not min(noise, quantum, drift) >= 0:
        raise ValueError("voxel must be above 0, and noise, quantum and drift at least 0")
    if not (0 <= smear <= 1 and 0 <= dropout <= 1):
        raise ValueError("smear and dropout must be within [0, 1]")
    of_copies = bounds("num_instances", num_instances, least=0)
    of_others = bounds("num_distractors", num_distractors, least=0)
    load_open3d("Rooms need")
    piece = checked_mesh(*mesh)
    others = [checked_mesh(*other) for other in distractors]

    draw = stream(seed, Layout.ROOM, Purpose.DRAW)
    num_copies = int(draw.integers(*of_copies, endpoint=True))
    num_others = int(draw.integers(*of_others, endpoint=True)) if others else 0
    chosen = [piece] * num_copies + [others[i] for i in draw.integers(len(others) or 1, size=num_others)]
    poses, half = _furnished(chosen, seed)
    placed = [(move(pose, points), faces) for pose, (points, faces) in zip(poses, chosen, strict=True)]
    solids = Solids([*placed, _shell(half)])

    cameras = _walk(_WALKS[coverage], placed, half, seed)
    flaws = Flaws(noise, quantum, smear, dropout, _AT, _JUMP)
    rng = stream(seed, Layout.ROOM, Purpose.POINTS)
    rays = pinhole(_SHAPE, _FOCAL, _FOCAL, (_SHAPE[1] - 1) / 2, (_SHAPE[0] - 1) / 2)
    measured: list[Array] = []
    owners: list[NDArray[np.int64]] = []
    from_eye: list[NDArray[np.int64]] = []
    for i, camera in enumerate(cameras):
        depth, owner = spoilt(_in_range(sight(solids, camera, rays)), flaws, rng)
        believed = _off(camera, drift, rng)
        is_hit = np.isfinite(depth)
        measured.append(move(believed, rays[is_hit] * depth[is_hit, None]))
        owners.append(np.where(owner < num_copies, owner, -1)[is_hit])
        from_eye.append(np.full(int(is_hit.sum()), i))
    eyes = cameras[:, :3, 3].copy()
    hits, owner, eye = np.concatenate(measured), np.concatenate(owners), np.concatenate(from_eye)
    points, normals, labels = _fused(hits, owner, eyes[eye], voxel)
    visibility = _seen(piece, poses[:num_copies], hits, owner, voxel)
    return Room(points, normals, labels, eyes, poses[:num_copies], visibility, voxel)


# The room ---------------------------------------------------------------------------------------------------


def _furnished(pieces: list[Mesh], seed: int) -> tuple[Array, Array]:
    """Place pieces on the floor; return target_from_model of each, and half the room, (2,)."""
    rng = stream(seed, Layout.ROOM, Purpose.POSES)
    footprints = [np.array([points[:, :2].min(axis=0), points[:, :2].max(axis=0)]) for points, _ in pieces]
    area = sum(float(np.prod(np.ptp(corners, axis=0) + _MARGIN)) for corners in footprints)
    aspect = rng.uniform(1, 1.4)
    half = np.sqrt(max(area, 9.0) * np.array([aspect, 1 / aspect])) / 2
    # The large ones first, as anybody would.
    order = np.argsort([-np.prod(np.ptp(corners, axis=0)) for corners in footprints], kind="stable")
    poses = np.tile(np.eye(4), (len(pieces), 1, 1))
    outlines: list[Array] = []
    for k in order:
        (x0, y0), (x1, y1) = footprints[k]
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        tries = 0
        while True:
            angle = rng.uniform(0, 2 * np.pi)
            if rng.random() < 0.4:  # along a wall
                angle = np.round(angle / (np.pi / 2)) * np.pi / 2
            c, s = np.cos(angle), np.sin(angle)
            turn = np.array([[c, -s], [s, c]])
            turned = corners @ turn.T
            low, high = -half - turned.min(axis=0) + _GAP, half - turned.max(axis=0) - _GAP
            if (low < high).all():
                place = rng.uniform(low, high)
                outline = turned + place
                if not any(_overlap(outline, other, _GAP) for other in outlines):
                    break
            tries += 1
            if tries % _PLACES == 0:
                half = half * 1.1
        outlines.append(outline)
        poses[k, :2, :2], poses[k, :2, 3] = turn, place
        poses[k, 2, 3] = -pieces[k][0][:, 2].min()
    return poses, half


def _overlap(a: Array, b: Array, gap: float) -> bool:
    """Whether two rectangles, corners in order, come nearer than a gap along every one of their axes."""
    for corners in (a, b):
        for k in (0, 1):
            axis = corners[k + 1] - corners[k]
            axis = axis / np.linalg.norm(axis)
            of_a, of_b = a @ axis, b @ axis
            if of_a.max() + gap < of_b.min() or of_b.max() + gap < of_a.min():
                return False
    return True


def _shell(half: Array) -> Mesh:
    """Return floor and walls."""
    (x, y), thick = half, 0.1
    return joined(
        box((-x - thick, -y - thick, -thick), (x + thick, y + thick, 0)),
        box((-x - thick, -y - thick, -thick), (-x, y + thick, _HEIGHT)),
        box((x, -y - thick, -thick), (x + thick, y + thick, _HEIGHT)),
        box((-x - thick, -y - thick, -thick), (x + thick, -y, _HEIGHT)),
        box((-x - thick, y, -thick), (x + thick, y + thick, _HEIGHT)),
    )


# The walk ---------------------------------------------------------------------------------------------------


def _walk(walk: Walk, placed: list[Mesh], half: Array, seed: int) -> Array:
    """Return target_from_camera of each eye, (E, 4, 4), along a part of an oval within the walls."""
    rng = stream(seed, Layout.ROOM, Purpose.SHUFFLE)
    count = int(rng.integers(*walk.num_eyes, endpoint=True))
    start, arc = rng.uniform(0, 2 * np.pi), 2 * np.pi * rng.uniform(*walk.arc)
    # A way around is walked in both directions, as well as nearer to and farther from the middle.
    angles = start + arc * np.arange(count) / count
    heights = _EYE_HEIGHT[0] + (_EYE_HEIGHT[1] - _EYE_HEIGHT[0]) * rng.random(count)
    cameras = np.tile(np.eye(4), (count, 1, 1))
    for camera, angle, height in zip(cameras, angles, heights, strict=True):
        reach = rng.uniform(0.55, 0.85)
        eye = np.array([half[0] * np.cos(angle), half[1] * np.sin(angle)]) * reach
        eye = np.append(_clear(eye, height, placed, half), height)
        # At something near the middle of the room, or past it, down to the furniture.
        aim = np.append(rng.uniform(-0.45, 0.45, 2) * half, rng.uniform(0.1, 0.7))
        aside = np.radians(rng.normal(0, walk.sideways))
        c, s = np.cos(aside), np.sin(aside)
        way = aim - eye
        way[:2] = np.array([[c, -s], [s, c]]) @ way[:2]
        camera[:3, :3], camera[:3, 3] = _towards(way), eye
    return cameras


def _clear(eye: Array, height: float, placed: list[Mesh], half: Array) -> Array:
    """Move an eye out of furniture that reaches up to it, and into the room."""
    for _ in range(20):
        moved = False
        for points, _ in placed:
            if points[:, 2].max() < height - _CLEARANCE:
                continue
            middle = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2
            radius = np.linalg.norm(points[:, :2] - middle, axis=1).max() + _CLEARANCE
            away = eye - middle
            gap = float(np.linalg.norm(away))
            if gap < radius:
                eye = middle + (away / gap if gap > 0 else np.array([1.0, 0.0])) * radius * 1.01
                moved = True
        inside = np.clip(eye, -half + _CLEARANCE, half - _CLEARANCE)
        moved |= bool((inside != eye).any())
        eye = inside
        if not moved:
            break
    return eye


def _towards(way: Array) -> Array:
    """Return the axes, as columns, of a camera that looks along a way; its x axis is level."""
    forward = way / np.linalg.norm(way)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(forward, right), forward])


def _in_range(seen: Sight) -> Sight:
    """Leave what is too near or too far unseen."""
    is_out = (seen.depth < _NEAR) | (seen.depth > _FAR)
    return seen._replace(depth=np.where(is_out, np.inf, seen.depth), owner=np.where(is_out, -1, seen.owner))


def _off(camera: Array, drift: float, rng: np.random.Generator) -> Array:
    """Return a camera's pose as the scanner believes it to be."""
    x, y, z = rng.normal(0, drift, 3)
    small = np.array([[1.0, -z, y], [z, 1.0, -x], [-y, x, 1.0]])
    turn, upper = np.linalg.qr(small)
    off = np.eye(4)
    off[:3, :3] = turn * np.sign(np.diag(upper))
    off[:3, 3] = rng.normal(0, drift, 3)
    # About the eye.
    believed: Array = camera @ off
    return believed


# The scan ---------------------------------------------------------------------------------------------------


def _fused(
    hits: Array, owner: NDArray[np.int64], eyes: Array, voxel: float
) -> tuple[Array, Array, NDArray[np.int64]]:
    """One point a voxel, with normals that face the eyes, and the label of most."""
    cells = np.floor((hits - hits.min(axis=0)) / voxel).astype(np.int64)
    span = cells.max(axis=0) + 1
    key = (cells[:, 0] * span[1] + cells[:, 1]) * span[2] + cells[:, 2]
    _, row, count = np.unique(key, return_inverse=True, return_counts=True)
    row = row.reshape(-1)
    points, to_eye = (
        np.stack([np.bincount(row, of[:, i]) for i in range(3)], axis=1) / count[:, None]
        for of in (hits, _unit(eyes - hits))
    )
    # Most of the measurements: sort the pairs of point and label by how often they occur.
    pair, times = np.unique(row * (owner.max() + 2) + owner + 1, return_counts=True)
    at, label = np.divmod(pair, owner.max() + 2)
    labels = np.empty(len(points), dtype=np.int64)
    often = np.argsort(times, kind="stable")
    labels[at[often]] = label[often] - 1

    o3d = load_open3d("Rooms need")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(3 * voxel, _NEIGHBORS))
    normals = np.asarray(cloud.normals).copy()
    normals[np.sum(normals * to_eye, axis=1) < 0] *= -1
    return points, normals, labels


def _unit(vectors: Array) -> Array:
    unit: Array = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit


def _seen(piece: Mesh, poses: Array, hits: Array, owner: NDArray[np.int64], voxel: float) -> Array:
    """Share of the outer surface of each copy that has a measurement of it within a voxel."""
    o3d = load_open3d("Rooms need")
    surface = _outer(piece)
    shares = np.zeros(len(poses))
    for k, pose in enumerate(poses):
        own = hits[owner == k]
        if len(own):
            cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(own))
            query = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(move(pose, surface)))
            shares[k] = np.mean(np.asarray(query.compute_point_cloud_distance(cloud)) <= voxel)
    return shares


def _outer(piece: Mesh) -> Array:
    """Points spread over the surface that is seen from somewhere around and above, of a piece on a floor."""
    points, faces = piece
    rng = np.random.default_rng(0)
    a, b, c = (points[faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1)
    rows = rng.choice(len(faces), size=_SAMPLES, p=area / area.sum())
    u, v = rng.random((2, _SAMPLES, 1))
    fold = u + v > 1
    u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
    samples = a[rows] + u * (b - a)[rows] + v * (c - a)[rows]
    solid = Solids([piece])
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    is_seen = np.zeros(len(samples), dtype=bool)
    for tilt in np.radians([5, 25, 50, 75]):
        for azimuth in np.arange(0, 2 * np.pi, np.pi / 6):
            eye = middle + 3 * size * np.array(
                [np.cos(azimuth) * np.cos(tilt), np.sin(azimuth) * np.cos(tilt), np.sin(tilt)]
            )
            left = np.flatnonzero(~is_seen)
            starts = np.broadcast_to(eye, (len(left), 3))
            is_seen[left] = ~solid.is_blocked(starts, samples[left])
    outer: Array = samples[is_seen]
    return outer
