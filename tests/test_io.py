"""Readers: formats that must come out the same, and files that are at fault."""

import numpy as np
import pytest
from ibi_rs import InputError, io

laspy = pytest.importorskip("laspy")
trimesh = pytest.importorskip("trimesh")
pypcd4 = pytest.importorskip("pypcd4")
Image = pytest.importorskip("PIL.Image")

POINTS = np.random.default_rng(0).uniform(-1, 1, (50, 3)).round(3)
NORMALS = np.random.default_rng(1).normal(size=(50, 3)).round(3)
BOTH = np.column_stack([POINTS, NORMALS])


def write_las(path):
    las = laspy.create(point_format=3, file_version="1.4")
    las.header.scales = [0.001] * 3
    las.x, las.y, las.z = POINTS.T
    las.write(path)


def write_ply(path, rows, names):
    head = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property float {n}" for n in names)]
    body = "\n".join(" ".join(map(str, row)) for row in rows)
    path.write_text("\n".join([*head, "end_header", body, ""]))


WRITERS = {
    "a.npy": lambda path: np.save(path, POINTS),
    "a.npz": lambda path: np.savez(path, points=POINTS),
    "a.xyz": lambda path: np.savetxt(path, POINTS),
    "a.csv": lambda path: np.savetxt(path, POINTS, delimiter=",", header="x,y,z", comments=""),
    "a.las": write_las,
    "a.laz": write_las,
    "a.pcd": lambda path: pypcd4.PointCloud.from_xyz_points(POINTS.astype(np.float32)).save(path),
    "a.ply": lambda path: write_ply(path, POINTS, "xyz"),
    "b.ply": lambda path: trimesh.PointCloud(POINTS).export(path),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_cloud_comes_out_of_every_format(name, tmp_path):
    WRITERS[name](tmp_path / name)
    points, normals = io.read_cloud(tmp_path / name)
    np.testing.assert_allclose(points, POINTS, atol=1e-6)
    assert points.dtype == np.float64
    assert normals is None


WITH_NORMALS = {
    "n.npy": lambda path: np.save(path, BOTH),
    "n.npz": lambda path: np.savez(path, points=POINTS, normals=NORMALS),
    "n.xyz": lambda path: np.savetxt(path, BOTH),
    "n.ply": lambda path: write_ply(path, BOTH, ["x", "y", "z", "nx", "ny", "nz"]),
}


@pytest.mark.parametrize("name", WITH_NORMALS)
def test_normals_come_along(name, tmp_path):
    WITH_NORMALS[name](tmp_path / name)
    points, normals = io.read_cloud(tmp_path / name)
    np.testing.assert_allclose(points, POINTS, atol=1e-6)
    np.testing.assert_allclose(normals, NORMALS, atol=1e-6)


def test_points_without_depth_are_left_out(tmp_path):
    np.save(tmp_path / "a.npy", np.concatenate([POINTS, [[np.nan] * 3, [1, np.inf, 2]]]))
    assert len(io.read_cloud(tmp_path / "a.npy")[0]) == len(POINTS)


@pytest.mark.parametrize("suffix", ["stl", "ply", "obj", "off", "glb"])
def test_a_mesh_comes_out_of_every_format(suffix, tmp_path):
    box = trimesh.creation.box((3, 2, 1))
    box.export(tmp_path / f"box.{suffix}")
    vertices, faces = io.read_mesh(tmp_path / f"box.{suffix}")
    assert faces.shape == (12, 3)
    read = trimesh.Trimesh(vertices, faces)
    assert read.volume == pytest.approx(6)
    assert io.read_cloud(tmp_path / f"box.{suffix}")[0].shape[1] == 3


def test_a_depth_image_is_a_cloud(tmp_path):
    depth = np.zeros((4, 6), np.uint16)
    depth[1, 2], depth[3, 5], depth[0, 0] = 1000, 2000, 65535
    Image.fromarray(depth).save(tmp_path / "depth.png")
    points = io.read_depth(tmp_path / "depth.png", fx=2, fy=4, cx=1, cy=2)
    np.testing.assert_allclose(points, [[0.5, -0.25, 1], [4, 0.5, 2]])
    points = io.read_depth(tmp_path / "depth.png", fx=2, fy=4, cx=1, cy=2, scale=1, offset=-999)
    np.testing.assert_allclose(points[:, 2], [1, 1001])


CUT = b"""ply
format binary_little_endian 1.0
element vertex 900
property float x
property float y
property float z
end_header
1234"""
GARBAGE = bytes(range(256)) * 4


@pytest.mark.parametrize("read", [io.read_mesh, io.read_cloud])
@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("empty.ply", b""),
        ("empty.stl", b""),
        ("garbage.ply", GARBAGE),
        ("garbage.obj", GARBAGE),
        ("cut.ply", CUT),
        ("image.jpg", b"x"),
    ],
)
def test_bad_files_are_refused_by_name(read, name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        read(tmp_path / name)


@pytest.mark.parametrize("name", ["garbage.pcd", "garbage.las", "garbage.npy", "garbage.npz", "garbage.xyz"])
def test_bad_clouds_are_refused_by_name(name, tmp_path):
    (tmp_path / name).write_bytes(GARBAGE)
    with pytest.raises(InputError, match=name):
        io.read_cloud(tmp_path / name)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda folder: io.read_cloud(folder / "none.ply"), "none.ply: no such file"),
        (lambda folder: io.read_mesh(folder), "meshes are read from"),
        (lambda folder: io.read_depth(folder / "none.png", 1, 1, 0, 0), "none.png: no such file"),
    ],
)
def test_what_is_no_file_is_refused(call, message, tmp_path):
    with pytest.raises(InputError, match=message):
        call(tmp_path)


def test_a_cloud_is_no_mesh_and_a_photo_no_depth(tmp_path):
    write_ply(tmp_path / "cloud.ply", POINTS, "xyz")
    with pytest.raises(InputError, match=r"cloud\.ply: no faces"):
        io.read_mesh(tmp_path / "cloud.ply")
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "photo.png")
    with pytest.raises(InputError, match=r"photo\.png: a depth image has one channel"):
        io.read_depth(tmp_path / "photo.png", 1, 1, 0, 0)
    Image.fromarray(np.zeros((4, 4), np.uint8)).save(tmp_path / "black.png")
    with pytest.raises(InputError, match=r"black\.png: no pixel has a depth"):
        io.read_depth(tmp_path / "black.png", 1, 1, 0, 0)
    np.save(tmp_path / "wide.npy", np.zeros((3, 4)))
    with pytest.raises(InputError, match=r"wide\.npy: wanted \(N, 3\)"):
        io.read_cloud(tmp_path / "wide.npy")
