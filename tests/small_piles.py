"""Six parts on a table, as one depth camera sees them. By a depth buffer, so that it needs no Open3D."""

from dataclasses import dataclass

import numpy as np

TILT_DEG, DISTANCE = 30, 6
"""Of the line of sight against the vertical; from the camera to the table, diagonals of the mesh."""


@dataclass(frozen=True)
class SmallPile:
    """A scan in the frame of its camera, and its truth."""

    grid: np.ndarray
    """(H, W, 3), NaN where nothing is."""
    poses: np.ndarray
    """(K, 4, 4)."""
    camera_from_world: np.ndarray
    """The table is z = 0 of the world."""

    @property
    def points(self):
        return self.grid[np.isfinite(self.grid).all(axis=-1)]


def depth_image(vertices, faces, focal, shape):
    """z of the nearest face at each pixel of a pinhole camera at the origin; inf without one."""
    height, width = shape
    depth = np.full(shape, np.inf)
    places = vertices[:, :2] / vertices[:, 2:] * focal + [(width - 1) / 2, (height - 1) / 2]
    inverse = 1 / vertices[:, 2]
    for face in faces:
        p, q, r = places[face]
        low = np.maximum(np.ceil(np.min([p, q, r], axis=0)), 0).astype(int)
        high = np.minimum(np.floor(np.max([p, q, r], axis=0)), [width - 1, height - 1]).astype(int)
        area = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])
        if (low > high).any() or area == 0:
            continue
        x, y = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
        of_q = ((x - p[0]) * (r[1] - p[1]) - (y - p[1]) * (r[0] - p[0])) / area
        of_r = ((q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])) / area
        shares = np.stack([1 - of_q - of_r, of_q, of_r], axis=-1)
        inside = (shares >= -1e-9).all(axis=-1)
        z = 1 / np.where(inside, shares @ inverse[face], 1)
        view = depth[low[1] : high[1] + 1, low[0] : high[0] + 1]
        np.minimum(view, np.where(inside, z, np.inf), out=view)
    return depth


def small_pile(vertices, faces, *, num_parts=6, pixel=0.6, tilt_deg=TILT_DEG, noise=0.3, seed=0):
    """Parts side by side, each turned at random; `pixel` and `noise` are in voxels, 1/24 of the diagonal."""
    rng = np.random.default_rng(seed)
    size = np.linalg.norm(np.ptp(vertices, axis=0))
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    world = np.tile(np.eye(4), (num_parts, 1, 1))
    for k, pose in enumerate(world):
        turn, upper = np.linalg.qr(rng.normal(size=(3, 3)))
        turn = turn * np.sign(np.diag(upper))
        turn[:, 0] *= np.linalg.det(turn)
        lowest = ((vertices - middle) @ turn.T)[:, 2].min()
        place = [0.9 * size * (k % 3 - 1), 0.9 * size * (k // 3 - 0.5), -lowest]
        pose[:3, :3], pose[:3, 3] = turn, place - turn @ middle
    tilt = np.radians(tilt_deg)
    forward, right = -np.array([0, np.sin(tilt), np.cos(tilt)]), np.array([1.0, 0, 0])
    camera = np.eye(4)
    camera[:3, :3], camera[:3, 3] = [right, np.cross(forward, right), forward], [0, 0, DISTANCE * size]
    poses = camera @ world

    corners = 4 * size * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    meshes = [*(move(pose, vertices) for pose in poses), move(camera, corners)]
    rows = [faces + k * len(vertices) for k in range(num_parts)]
    rows.append(np.array([[0, 1, 2], [0, 2, 3]]) + num_parts * len(vertices))
    width = size / 24 * pixel
    focal = DISTANCE * size / width
    shape = int(3 * size / width), int(4 * size / width)
    depth = depth_image(np.concatenate(meshes), np.concatenate(rows), focal, shape)
    v, u = np.mgrid[: shape[0], : shape[1]]
    rays = np.stack(
        [(u - (shape[1] - 1) / 2) / focal, (v - (shape[0] - 1) / 2) / focal, np.ones(shape)], axis=-1
    )
    along = rng.normal(0, noise * size / 24, shape) / np.linalg.norm(rays, axis=-1)
    depth = np.where(np.isfinite(depth), depth + along, np.nan)
    return SmallPile(rays * depth[..., None], poses, camera)


def move(pose, points):
    return points @ pose[:3, :3].T + pose[:3, 3]
