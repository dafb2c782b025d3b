"""Readers: formats that must come out the same, columns that mean one thing, files that are at fault."""

import io as memory
import os
import zipfile

import numpy as np
import pytest
from ibi_rs import InputError, io

laspy = pytest.importorskip("laspy")
trimesh = pytest.importorskip("trimesh")
pypcd4 = pytest.importorskip("pypcd4")
Image = pytest.importorskip("PIL.Image")

POINTS = np.random.default_rng(0).uniform(-1, 1, (50, 3)).round(3)
NORMALS = np.random.default_rng(1).normal(size=(50, 3))
NORMALS = (NORMALS / np.linalg.norm(NORMALS, axis=1, keepdims=True)).round(4)
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


# Columns --------------------------------------------------------------------------------------------------


def table(columns, head="", separator=" ", end="\n"):
    lines = [separator.join(f"{x:.4f}" for x in row) for row in np.column_stack(columns)]
    return head + end.join(lines) + end


X, Y, Z = POINTS.T
COUNTED = np.arange(50.0)
GREY = np.random.default_rng(2).integers(0, 256, (50, 3)).astype(float)
XYZ, XYZ_N = (POINTS,), (POINTS, NORMALS)
COLUMNS = {
    "zyx.csv": (table((Z, Y, X), "z,y,x\n", ","), False),
    "quoted.csv": (table(XYZ, '"X [mm]","Y [mm]","Z [mm]"\n', ","), False),
    "id.csv": (table((COUNTED, *XYZ), "id,x,y,z\n", ","), False),
    "normals_first.csv": (table((NORMALS, POINTS), "nx,ny,nz,x,y,z\n", ","), True),
    "long.csv": (table((*XYZ, GREY, NORMALS), "x,y,z,r,g,b,normal_x,normal_y,normal_z\n", ","), True),
    "paraview.csv": (
        table((NORMALS, *XYZ), "Normals:0,Normals:1,Normals:2,Points:0,Points:1,Points:2\n", ","),
        True,
    ),
    "semicolons.csv": (table(XYZ, "x;y;z\n", ";"), False),
    "decimal_commas.csv": (table(XYZ, "x;y;z\n", ";").replace(".", ","), False),
    "tabs.txt": (table(XYZ, "x\ty\tz\n", "\t"), False),
    "cloudcompare.txt": (table((POINTS, GREY), "//X Y Z R G B\n"), False),
    "commented.xyz": (table(XYZ, "# made by a scanner\n# x y z\n"), False),
    "unnamed.xyz": (table(XYZ), False),
    "intensity.xyz": (table((*XYZ, GREY[:, 0])), False),
    "colours.xyz": (table((*XYZ, GREY)), False),
    "shades.xyz": (table((*XYZ, GREY / 255)), False),
    "unit.xyz": (table(XYZ_N), True),
    "colours_and_normals.xyz": (table((*XYZ, GREY, NORMALS)), True),
    "counted.pts": (table((*XYZ, GREY[:, 0], GREY), "50\n"), False),
    "mark.csv": ("\ufeff" + table((Z, Y, X), "z,y,x\n", ","), False),
    "trailing.csv": (table(XYZ, "", ",", ",\n"), False),
    "windows.csv": (table(XYZ, "x,y,z\r\n", ",", "\r\n"), False),
    "blank.xyz": ("\n\n" + table(XYZ) + "\n\n", False),
}


@pytest.mark.parametrize("name", COLUMNS)
def test_columns_mean_what_they_are_called(name, tmp_path):
    content, has_normals = COLUMNS[name]
    (tmp_path / name).write_text(content, encoding="utf-8", newline="")
    points, normals = io.read_cloud(tmp_path / name)
    np.testing.assert_allclose(points, POINTS, atol=1e-4)
    assert (normals is not None) == has_normals
    if has_normals:
        np.testing.assert_allclose(normals, NORMALS, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("id.xyz", table((COUNTED, *XYZ)), "the first of its columns counts the rows"),
        ("names.csv", table(XYZ, "a,b,c\n", ","), "names the columns a, b, c; none are x, y and z"),
        ("two.xyz", table((X, Y)), "has 2 columns"),
        ("short.csv", table((*XYZ, X), "x,y,z\n", ","), "names 3 columns"),
        ("cut.pts", table(XYZ, "51\n"), "the header says 51 points, and 50 are there"),
        ("empty.xyz", "", "no points"),
        ("named.csv", "x,y,z\n", "no points"),
        ("ragged.xyz", table(XYZ) + "1 2\n", "cannot be read"),
    ],
)
def test_columns_that_could_mean_anything_are_refused(name, content, message, tmp_path):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=f"{name}: .*{message}"):
        io.read_cloud(tmp_path / name)


@pytest.mark.parametrize("missing", [0.0, np.nan])
def test_a_point_without_a_normal_stays(missing, tmp_path):
    """It gets that of its nearest point; where most have none, none has."""
    rows = BOTH.copy()
    rows[[3, 7], 3:] = missing
    np.savez(tmp_path / "a.npz", points=rows[:, :3], normals=rows[:, 3:])
    points, normals = io.read_cloud(tmp_path / "a.npz")
    np.testing.assert_array_equal(points, POINTS)
    for row in (3, 7):
        apart = np.linalg.norm(POINTS - POINTS[row], axis=1)
        apart[[3, 7]] = np.inf
        np.testing.assert_array_equal(normals[row], NORMALS[apart.argmin()])
    rows[5:, 3:] = missing
    np.savez(tmp_path / "a.npz", points=rows[:, :3], normals=rows[:, 3:])
    points, normals = io.read_cloud(tmp_path / "a.npz")
    assert len(points) == 50
    assert normals is None


# Scans ----------------------------------------------------------------------------------------------------


def test_a_scan_says_where_the_camera_stood_and_what_it_missed(tmp_path):
    head = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 51\nHEIGHT 1\n"
    rows = table((np.concatenate([POINTS, [[np.nan] * 3]]),))
    (tmp_path / "a.pcd").write_text(f"{head}VIEWPOINT 1.5 -2 3 1 0 0 0\nPOINTS 51\nDATA ascii\n{rows}")
    scan = io.read_scan(tmp_path / "a.pcd")
    np.testing.assert_allclose(scan.points, POINTS, atol=1e-4)
    np.testing.assert_array_equal(scan.viewpoint, [1.5, -2, 3])
    assert scan.num_dropped == 1
    np.save(tmp_path / "a.npy", POINTS)
    assert io.read_scan(tmp_path / "a.npy").viewpoint is None


def test_a_scan_of_large_faces_is_drawn_on_them(tmp_path):
    trimesh.creation.box((3, 2, 1)).export(tmp_path / "cad.stl")
    points = io.read_scan(tmp_path / "cad.stl").points
    assert len(points) == 100_000
    on_side = np.isclose(np.abs(points), [1.5, 1, 0.5]).any(axis=1)
    assert on_side.all()
    ball = trimesh.creation.icosphere(4)
    ball.export(tmp_path / "scanned.ply")
    np.testing.assert_allclose(io.read_scan(tmp_path / "scanned.ply").points, ball.vertices, atol=1e-6)


# Files that are cut, or are not what they say --------------------------------------------------------------

BALL = trimesh.creation.icosphere(2)


def exported(suffix, **options):
    data = BALL.export(file_type=suffix, **options)
    return data.encode() if isinstance(data, str) else data


def pcd(encoding):
    file = memory.BytesIO()
    pypcd4.PointCloud.from_xyz_points(POINTS.astype(np.float32)).save(file, pypcd4.Encoding(encoding))
    return file.getvalue()


def las(suffix):
    file = memory.BytesIO()
    made = laspy.create(point_format=3, file_version="1.4")
    made.x, made.y, made.z = POINTS.T
    made.write(file, do_compress=suffix == "laz")
    return file.getvalue()


def npy():
    file = memory.BytesIO()
    np.save(file, POINTS)
    return file.getvalue()


WHOLE = {
    "text.stl": exported("stl_ascii"),
    "binary.stl": exported("stl"),
    "text.ply": exported("ply", encoding="ascii"),
    "binary.ply": exported("ply"),
    "a.off": exported("off"),
    "a.glb": exported("glb"),
    "text.pcd": pcd("ascii"),
    "binary.pcd": pcd("binary"),
    "compressed.pcd": pcd("binary_compressed"),
    "a.las": las("las"),
    "a.laz": las("laz"),
    "a.npy": npy(),
}


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("name", WHOLE)
def test_half_a_file_is_not_read_as_a_whole(name, share, tmp_path):
    whole = WHOLE[name]
    path = tmp_path / name
    path.write_bytes(whole)
    assert len(io.read_cloud(path)[0]) >= 50
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match=name):
        io.read_cloud(path)


@pytest.mark.parametrize("name", ["text.stl", "text.ply", "a.off", "text.pcd"])
def test_a_line_too_few_is_one(name, tmp_path):
    lines = WHOLE[name].splitlines(keepends=True)
    (tmp_path / name).write_bytes(b"".join(lines[:-2]))
    with pytest.raises(InputError, match=name):
        io.read_cloud(tmp_path / name)


def test_a_face_that_is_cut_is_one_too_few(tmp_path):
    text = exported("off").decode().rstrip().rsplit(maxsplit=1)[0]
    (tmp_path / "a.off").write_text(text + "\n")
    with pytest.raises(InputError, match=r"a\.off: the header says 320 whole faces, and 319 are there"):
        io.read_mesh(tmp_path / "a.off")


def test_what_trimesh_logs_is_not_printed(tmp_path, capfd):
    text = exported("stl_ascii").decode().replace("facet normal ", "facet normal x", 1)
    (tmp_path / "a.stl").write_text(text)
    io.read_mesh(tmp_path / "a.stl")
    assert capfd.readouterr() == ("", "")


def test_triangles_without_a_place_are_told_of(tmp_path):
    data = bytearray(exported("stl"))
    data[84 + 12 : 84 + 16] = np.float32(np.nan).tobytes()
    (tmp_path / "a.stl").write_bytes(data)
    with pytest.raises(InputError, match=r"a\.stl: 1 of 320 triangles have a corner that is not finite"):
        io.read_mesh(tmp_path / "a.stl")


def laz_of_noise(seed):
    rng = np.random.default_rng(seed)
    return b"LASF" + rng.bytes(1000)


def boasting_las():
    data = bytearray(las("las"))
    data[247:255] = (2**40).to_bytes(8, "little")
    return bytes(data)


def bomb(shape=(3, 10**9), dtype="<f8"):
    """An archive that says it holds gigabytes."""
    file = memory.BytesIO()
    header = memory.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": dtype, "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", header.getvalue() + bytes(1 << 20))
    return file.getvalue()


def boasting_npy():
    header = memory.BytesIO()
    fields = {"descr": "<f8", "fortran_order": False, "shape": (10**7, 3)}
    np.lib.format.write_array_header_1_0(header, fields)
    return header.getvalue() + bytes(100)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        *((f"noise{seed}.laz", laz_of_noise(seed)) for seed in range(8)),
        *((f"noise{seed}.las", laz_of_noise(seed)) for seed in range(8)),
        ("boast.las", boasting_las()),
        ("bomb.npz", bomb()),
        ("many.npz", bomb((10**9, 3))),
        ("boast.npy", boasting_npy()),
        ("boast.pcd", pcd("binary_compressed").replace(b"POINTS 50", b"POINTS 99")),
        ("text.stl", b"not even a solid"),
        ("garbage.stl", GARBAGE),
        ("objects.npy", b"\x93NUMPY\x01\x00\x10\x00{'descr': 'O'}  \n"),
    ],
)
def test_what_a_file_cannot_hold_is_not_read(name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name) as caught:
        io.read_cloud(tmp_path / name)
    assert "charset" not in str(caught.value)


def test_folders_pipes_and_locked_files_are_refused(tmp_path):
    (tmp_path / "folder.ply").mkdir()
    os.mkfifo(tmp_path / "pipe.ply")
    for name, what in (("folder.ply", "a folder"), ("pipe.ply", "a device or pipe")):
        with pytest.raises(InputError, match=f"{name}: is no file but {what}"):
            io.read_cloud(tmp_path / name)


# Polygons -------------------------------------------------------------------------------------------------

# Arrows, one concave at its second-last corner, one a quad, and a convex pentagon.
OUTLINES = [
    ([[0, 0], [4, 0], [4, 4], [2, 1], [0, 4]], 10.0),
    ([[0, 0], [4, 4], [0, 1], [-4, 4]], 4.0),
    ([[0, 0], [2, 0], [3, 1], [2, 2], [0, 2]], 5.0),
]


def polygon_file(suffix, corners):
    count = len(corners)
    rows = [" ".join(map(repr, map(float, corner))) for corner in corners]
    if suffix == "off":
        face = " ".join(map(str, [count, *range(count)]))
        return "\n".join(["OFF", f"{count} 1 0", *rows, face, ""])
    if suffix == "obj":
        face = " ".join(f"{i + 1}/{i + 1}" for i in range(count))
        return "\n".join([*(f"v {row}" for row in rows), f"f {face}", ""])
    head = [
        "ply",
        "format ascii 1.0",
        f"element vertex {count}",
        *(f"property double {axis}" for axis in "xyz"),
    ]
    head += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    return "\n".join([*head, *rows, " ".join(map(str, [count, *range(count)])), ""])


@pytest.mark.parametrize("suffix", ["off", "obj", "ply"])
@pytest.mark.parametrize(("outline", "area"), OUTLINES)
@pytest.mark.parametrize("seed", range(4))
def test_polygons_are_cut_along_their_outline(suffix, outline, area, seed, tmp_path):
    """In any plane, either way round; triangles run as their polygon does."""
    turn, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    flat = np.column_stack([outline, np.zeros(len(outline))])[:: 1 if seed % 2 else -1]
    corners = flat @ turn.T + [5, 6, 7]
    (tmp_path / f"a.{suffix}").write_text(polygon_file(suffix, corners))
    vertices, faces = io.read_mesh(tmp_path / f"a.{suffix}")
    sides = vertices[faces]
    cross = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
    assert np.linalg.norm(cross, axis=1).sum() / 2 == pytest.approx(area, rel=1e-6)
    whole = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)
    assert (cross @ whole > 0).all()


# Depth images ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dtype", "num_points"), [(np.uint16, 2), (np.int32, 4), (np.float32, 4)])
def test_only_16_bits_saturate(dtype, num_points, tmp_path):
    values = [[1000, 2000, 65535], [0, 0, 65535 if dtype == np.uint16 else 70000]]
    Image.fromarray(np.array(values, dtype)).save(tmp_path / "a.tiff")
    points = io.read_depth(tmp_path / "a.tiff", 1, 1, 0, 0, scale=1)
    assert len(points) == num_points


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({"fx": -1}, "fx and fy are -1 and 1; they must be above 0"),
        ({"fy": 0}, "fx and fy are 1 and 0"),
        ({"fx": np.nan}, "fx and fy are nan and 1"),
        ({"fx": np.inf}, "fx is inf; it must be finite"),
        ({"cx": np.nan}, "cx is nan"),
        ({"cy": -np.inf}, "cy is -inf"),
        ({"scale": 0}, "scale and offset are 0 and 0"),
        ({"scale": np.nan}, "scale and offset are nan and 0"),
        ({"offset": np.inf}, "scale and offset are 0.001 and inf"),
    ],
)
def test_impossible_cameras_are_refused(camera, message, tmp_path):
    Image.fromarray(np.full((2, 2), 9, np.uint16)).save(tmp_path / "a.png")
    with pytest.raises(InputError, match=message):
        io.read_depth(tmp_path / "a.png", **{"fx": 1, "fy": 1, "cx": 0, "cy": 0, **camera})
