"""Files of each format that are odd but right, and those that are cut, boast or mean nothing."""

import io as memory
import json
import struct
import subprocess
import sys
import zipfile

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import InputError, io
from test_io import BALL, NORMALS, POINTS, Image, exported, las, table, trimesh
from test_process import LIMIT_S


def written(folder, name, content):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


# Refused --------------------------------------------------------------------------------------------------

OBJ = exported("obj").decode()
V = [line for line in OBJ.splitlines() if line.startswith("v ")]
F = [line for line in OBJ.splitlines() if line.startswith("f ")]
STL = exported("stl_ascii").decode()
PLY = exported("ply", encoding="ascii").decode().splitlines()
BODY = PLY.index("end_header") + 1


def lines(*parts):
    return "\n".join(line for part in parts for line in ([part] if isinstance(part, str) else part)) + "\n"


def pcd(rows, said=None, fields="x y z", viewpoint="", height=1):
    said = len(rows) if said is None else said
    head = (
        f"VERSION .7\nFIELDS {fields}\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {said}\nHEIGHT {height}\n"
    )
    return lines(f"{head}{viewpoint}POINTS {said}\nDATA ascii", rows)


def ply(faces, vertices=5, order="<"):
    """Of polygons of any number of corners, as Blender writes it."""
    kind = "little" if order == "<" else "big"
    head = lines(
        "ply",
        f"format binary_{kind}_endian 1.0",
        f"element vertex {vertices}",
        *(f"property float {axis}" for axis in "xyz"),
        f"element face {len(faces)}",
        "property list uchar uint vertex_indices",
        "property uchar flags",
        "end_header",
    )
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 2, 0]], f"{order}f4")
    rows = b"".join(struct.pack(f"{order}B{len(face)}IB", len(face), *face, 7) for face in faces)
    return head.encode() + corners.tobytes() + rows


def with_numbers(suffix, kind, places):
    """A LAS or LAZ file, with other numbers at some bytes."""
    data = bytearray(las(suffix))
    for at, *numbers in places:
        struct.pack_into(f"<{kind}", data, at, *numbers)
    return bytes(data)


def chunk_table(data):
    """Where a LAZ file says that its table of chunks is; and where it is."""
    (start,) = struct.unpack_from("<I", data, 96)
    return start, struct.unpack_from("<q", data, start)[0]


def archive(member, header_bytes=b"", zeros=0):
    """An NPZ file that unpacks to so many zeros."""
    file = memory.BytesIO()
    with (
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as made,
        made.open(member, "w", force_zip64=True) as part,
    ):
        part.write(header_bytes)
        for _ in range(zeros >> 20):
            part.write(bytes(1 << 20))
    return file.getvalue()


def npy_header(shape):
    file = memory.BytesIO()
    fields = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, fields)
    return file.getvalue()


def glb(change):
    """A ball whose description is changed."""
    data = exported("glb")
    (length,) = struct.unpack_from("<I", data, 12)
    held = json.loads(data[20 : 20 + length])
    change(held)
    text = json.dumps(held).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return b"glTF" + struct.pack("<III", 2, 20 + len(text) + len(rest), len(text)) + b"JSON" + text + rest


def zeros_of_nothing(held):
    for accessor in held["accessors"]:
        accessor.pop("bufferView")
        accessor["count"] = 10**8


def many_instances(held):
    number = next(node["mesh"] for node in held["nodes"] if "mesh" in node)
    held["nodes"] = [{"children": [1] * 9}] + [{"mesh": number}] * 1_000_000
    held["scenes"] = [{"nodes": [0]}]


CUT = r"the header says \d+ {}, and \d+ are there; the file is cut"
LAZ_START, LAZ_TABLE = chunk_table(las("laz"))
REFUSED = [
    # What has no counts is cut where a line is.
    ("number.obj", lines(V)[:-12], "line 162 is a vertex of 2 numbers"),
    ("middle.obj", lines(V[0], "v 1 2", V[1:], F), "line 2 is a vertex of 2 numbers"),
    ("corner.obj", lines(V, F, "f 1 2"), r"line \d+ is a face of 2 corners"),
    ("one.obj", lines(V, F, "f 1"), r"line \d+ is a face of 1 corners"),
    ("half.obj", lines(V[:80], F), "half.obj: "),
    ("binary.obj", exported("stl"), "is no OBJ file"),
    # More than it says, or rows that are not whole.
    (
        "row.ply",
        lines(PLY[:BODY], "1 2", PLY[BODY + 1 :]),
        "row 0 of its vertices has 2 numbers; it must have 3",
    ),
    ("face.ply", lines(PLY[:-1], "3 0 1"), "row 319 of its faces has 3 numbers; it must have 4"),
    ("word.ply", lines(PLY[:BODY], "a b c", PLY[BODY + 1 :]), "word.ply: "),
    ("more.ply", lines(PLY, "3 0 1 2"), "the header says 482 rows, and 483 are there"),
    ("fewer.ply", lines(PLY[:-1]), CUT.format("faces")),
    ("points.ply", lines(PLY[: BODY + 9]), CUT.format("vertices")),
    ("head.ply", lines(PLY[: BODY - 1]), "its header does not end; the file is cut"),
    ("type.ply", lines(PLY).replace("float", "flaot", 1), "a line that means nothing: property flaot x"),
    ("count.ply", lines(PLY).replace("vertex 162", "vertex 99999999999"), "has 99999999999 points"),
    ("follows.ply", exported("ply") + b"\n", "1 bytes follow what the header says"),
    ("mixed.ply", ply([(0, 1, 2, 3), (3, 2, 4)])[:-9], CUT.format("faces")),
    ("vertices.ply", ply([(0, 1, 2)], vertices=900), CUT.format("vertices")),
    ("beyond.ply", ply([(0, 1, 2, 3), (3, 2, 9)]), "face 1 names a vertex that is not there"),
    ("more.pcd", pcd(["1 2 3"] * 4, said=2), "the header says 2 points, and 4 are there"),
    ("fewer.pcd", pcd(["1 2 3"] * 2, said=4), CUT.format("points")),
    ("row.pcd", pcd(["1 2 3", "1 2"]), "row.pcd: "),
    ("columns.pcd", pcd(["1 2 3 4"] * 2), "the header says 3 numbers a point, and 4 are there"),
    ("height.pcd", pcd(["1 2 3"] * 2, height=7), "2 points, and a width of 2 by a height of 7"),
    ("minus.pcd", pcd([], said=-2), "has no header of a PCD file"),
    ("fields.pcd", pcd(["1 2 3"], fields="a b c"), "has no field x; x, y and z are wanted"),
    ("eye.pcd", pcd(["1 2 3"], viewpoint="VIEWPOINT a b c 1 0 0 0\n"), r"its viewpoint is \['a', 'b', 'c'\]"),
    (
        "eye2.pcd",
        pcd(["1 2 3"], viewpoint="VIEWPOINT nan 0 0 1 0 0 0\n"),
        "its viewpoint is .*; it must be three",
    ),
    # STL, which anything may be called.
    ("padded.stl", exported("stl") + bytes(9), "is no STL file, or is cut"),
    ("ply.stl", exported("ply"), "is no STL file, or is cut"),
    ("solid.stl", b"solid" + exported("stl")[5:-50], "says 320 triangles, and 319 are there"),
    ("corner.stl", STL.replace("vertex", "vortex", 1), "320 facets have 959 corners"),
    ("word.stl", STL.replace("vertex 0", "vertex abc", 1), "word.stl: "),
    # Numbers that a file of this size cannot mean.
    ("vlrs.las", with_numbers("las", "I", [(100, 2**31)]), "its header does not fit"),
    ("scale.las", with_numbers("las", "d", [(131, float("nan"))]), "has a scale that is not above 0"),
    ("zero.las", with_numbers("las", "d", [(139, 0.0)]), "has a scale that is not above 0"),
    ("chunks.laz", with_numbers("laz", "I", [(LAZ_TABLE + 4, 2**31)]), CUT.format("chunks")),
    ("table.laz", with_numbers("laz", "q", [(LAZ_START, 2**60)]), "the table of its chunks is not there"),
    ("nowhere.laz", with_numbers("laz", "q", [(LAZ_START, -1)]), "the table of its chunks is not there"),
    (
        "empty.laz",
        with_numbers("laz", "I", [(las("laz").find(b"laszip encoded") + 64, 0)]),
        "chunks hold 0 points",
    ),
    (
        "vast.laz",
        with_numbers("laz", "I", [(las("laz").find(b"laszip encoded") + 64, 3 * 10**9)]),
        "chunks hold 3",
    ),
    (
        "items.laz",
        with_numbers("laz", "H", [(las("laz").find(b"laszip encoded") + 84, 0)]),
        "points take 0 bytes, and 34",
    ),
    ("name.laz", las("laz").replace(b"laszip encoded", b"laszip mislaid"), "has no record of LASzip"),
    ("points.laz", with_numbers("laz", "Q", [(247, 10**6)]), CUT.format("points")),
    (
        "zeros.npz",
        archive("points.npy", npy_header((4 * 10**6, 3)), 2**27),
        "unpacks to .* times what it takes",
    ),
    (
        "head.npz",
        archive("points.npy", b"\x93NUMPY\x02\0" + struct.pack("<I", 2**25), 2**25),
        "a header of 33554432",
    ),
    ("head.npy", b"\x93NUMPY\x02\0" + struct.pack("<I", 2**31) + bytes(99), "a header of 2147483648 bytes"),
    ("long.glb", exported("glb")[:8] + struct.pack("<I", 2**31) + exported("glb")[12:], CUT.format("bytes")),
    ("zeros.glb", glb(zeros_of_nothing), "says 100000000 numbers, and holds none of them"),
    ("many.glb", glb(many_instances), r"has \d+ points; 134217728 are allowed"),
    ("text.glb", "not a scene at all, this", "is no GLB file"),
    # Text.
    ("gap.txt", "1\t\t3\t4\n" * 9, "line 1 has an empty cell between two tabs"),
    ("later.txt", "1\t2\t3\n" * 9 + "1\t\t3\n", "later.txt: "),
    ("binary.xyz", bytes(range(256)), "is no text"),
    ("columns.csv", "x,y,z\n" + "1,2,3\n" * 5 + "1,2\n", "columns.csv: "),
]


@pytest.mark.parametrize(("name", "content", "message"), REFUSED, ids=[case[0] for case in REFUSED])
def test_what_is_cut_or_boasts_is_refused_in_one_line(name, content, message, tmp_path):
    path = written(tmp_path, name, content)
    with pytest.raises(InputError, match=message) as caught:
        io.read_cloud(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=message):
        io.read_scan(path)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_what_stands_behind_the_points_is_not_looked_at(suffix, tmp_path):
    """Four thousand million records are said to be there, each of which would be looked for."""
    path = written(tmp_path, f"a.{suffix}", with_numbers(suffix, "QI", [(235, len(las(suffix)), 2**32 - 1)]))
    # In a process of its own, as one that went on for hours could not be ended.
    code = "import sys; from ibi_rs import io; print(len(io.read_cloud(sys.argv[1])[0]))"
    done = subprocess.run([sys.executable, "-c", code, path], timeout=LIMIT_S, capture_output=True, text=True)
    assert done.stdout.split() == ["50"], done.stderr


def test_a_panic_of_a_reader_is_an_error_of_one_line(tmp_path, monkeypatch):
    panic = type("PanicException", (BaseException,), {})

    def read(path):
        raise panic("index out of range\nsecond line")

    monkeypatch.setitem(io._READERS, ".xyz", read)
    with pytest.raises(InputError, match=r"a\.xyz: cannot be read: index out of range$"):
        io.read_cloud(written(tmp_path, "a.xyz", "1 2 3"))
    for passing in (KeyboardInterrupt, SystemExit):
        monkeypatch.setitem(io._READERS, ".xyz", lambda path, passing=passing: (_ for _ in ()).throw(passing))
        with pytest.raises(passing):
            io.read_cloud(tmp_path / "a.xyz")


# Read -----------------------------------------------------------------------------------------------------

TRIANGLES = [
    ("name.stl", STL.replace("solid", "solid facet of a vertex", 1)),
    ("latin.stl", STL.replace("solid", "solid Häuschen", 1).encode("latin-1")),
    ("solid.stl", b"solid" + exported("stl")[5:]),
    ("windows.stl", STL.replace("\n", "\r\n")),
    ("latin.obj", ("# Würfel\n" + OBJ).encode("latin-1")),
    ("windows.obj", OBJ.replace("\n", "\r\n")),
    ("more.obj", lines("s off", V, "vt 0 0", "vn 0 0 1", "usemtl a", [f"{line} " for line in F])),
    ("on.obj", lines(V, [line.replace(" ", " \\\n ", 1) for line in F])),
    ("latin.off", ("OFF\n# Würfel\n" + exported("off").decode().split("\n", 1)[1]).encode("latin-1")),
]


@pytest.mark.parametrize(("name", "content"), TRIANGLES, ids=[case[0] for case in TRIANGLES])
def test_odd_files_of_a_mesh_are_read(name, content, tmp_path):
    vertices, faces = io.read_mesh(written(tmp_path, name, content))
    assert (vertices.shape, faces.shape) == ((162, 3), (320, 3))
    assert trimesh.Trimesh(vertices, faces).area == pytest.approx(BALL.area, rel=1e-4)


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(
    ("faces", "area"),
    [
        ([(0, 1, 2, 3), (3, 2, 4)], 1.5),
        ([(3, 2, 4), (0, 1, 2, 3)], 1.5),
        ([(0, 1, 2, 4, 3)], 1.5),
        ([(0, 1, 2), (0, 2, 3)], 1.0),
    ],
)
def test_binary_polygons_of_any_number_of_corners_are_read(faces, area, order, tmp_path):
    path = written(tmp_path, "a.ply", ply(faces, order=order))
    vertices, triangles = io.read_mesh(path)
    assert len(triangles) == sum(len(face) - 2 for face in faces)
    assert trimesh.Trimesh(vertices, triangles).area == pytest.approx(area)
    points, normals = io.read_cloud(path)
    np.testing.assert_array_equal(points, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 2, 0]])
    assert normals is None


def test_far_polygons_are_as_concave_as_near_ones(tmp_path):
    outline = np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [2, 1, 0], [0, 4, 0]]) + 1e6
    text = lines([f"v {x} {y} {z}" for x, y, z in outline], "f 1 2 3 4 5")
    vertices, faces = io.read_mesh(written(tmp_path, "a.obj", text))
    assert trimesh.Trimesh(vertices, faces).area == pytest.approx(10)


CLOUDS = {
    "utf16.csv": table((POINTS,), "x,y,z\n", ",").encode("utf-16"),
    "latin.csv": ("# Wände\n" + table((POINTS,), "x,y,z\n", ",")).encode("latin-1"),
    "inline.xyz": table((POINTS,)).replace("\n", " # a point\n"),
    "slashes.xyz": table((POINTS,)).replace("\n", " // a point\n"),
    "units.csv": table((POINTS,), "x_mm,y_mm,z_mm\n", ","),
    "decimal.txt": table((POINTS,), "", "\t").replace(".", ","),
    "mixed.txt": table((POINTS,), "", "\t ").replace("\t ", " \t "),
    "blanks.pcd": pcd([f"  {x:.4f}  {y:.4f}\t{z:.4f} " for x, y, z in POINTS]),
    "order.pcd": pcd([f"{z:.4f} {y:.4f} {x:.4f}" for x, y, z in POINTS], fields="z y x"),
    "windows.pcd": pcd([f"{x:.4f} {y:.4f} {z:.4f}" for x, y, z in POINTS]).replace("\n", "\r\n"),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_odd_files_of_points_are_read(name, tmp_path):
    points, _ = io.read_cloud(written(tmp_path, name, CLOUDS[name]))
    np.testing.assert_allclose(points, POINTS, atol=1e-4)


CAMERA = lines(
    "ply",
    "format {} 1.0",
    "element vertex 2",
    *(f"property float {axis}" for axis in "xyz"),
    "element camera 1",
    *(f"property float {name}" for name in ("view_px", "view_py", "view_pz", "x_axisx")),
    "end_header",
)


def npz(**arrays):
    file = memory.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


EYES = {
    "text.ply": CAMERA.format("ascii") + "0 0 1\n1 0 1\n1.5 -2 3 1\n",
    "binary.ply": CAMERA.format("binary_little_endian").encode()
    + np.array([0, 0, 1, 1, 0, 1, 1.5, -2, 3, 1], "<f4").tobytes(),
    "a.npz": npz(points=POINTS, viewpoint=[1.5, -2, 3]),
    "b.npz": npz(tgt=POINTS, tgt_normals=NORMALS, viewpoint=[1.5, -2, 3]),
    "a.pcd": pcd(["1 2 3"] * 2, viewpoint="VIEWPOINT 1.5 -2 3 0.5 0.5 0.5 0.5\n"),
}


@pytest.mark.parametrize("name", EYES)
def test_the_viewpoint_is_read_wherever_a_file_has_one(name, tmp_path):
    path = written(tmp_path, name, EYES[name])
    np.testing.assert_array_equal(io.read_scan(path).viewpoint, [1.5, -2, 3])
    np.testing.assert_array_equal(io.read_viewpoint(path), [1.5, -2, 3])


@pytest.mark.parametrize("name", ["a.ply", "a.npz", "a.pcd", "a.npy"])
def test_where_no_viewpoint_is_there_is_none(name, tmp_path):
    content = {"a.ply": exported("ply"), "a.npz": npz(points=POINTS), "a.pcd": pcd(["1 2 3"])}.get(name)
    path = tmp_path / name
    np.save(path, POINTS) if content is None else written(tmp_path, name, content)
    assert io.read_scan(path).viewpoint is None
    assert io.read_viewpoint(path) is None


def test_organised_arrays_are_read_row_by_row(tmp_path):
    image = POINTS.reshape(5, 10, 3).copy()
    image[2, 3] = np.nan
    np.save(tmp_path / "a.npy", image)
    np.savez(tmp_path / "a.npz", points=image, normals=NORMALS.reshape(5, 10, 3))
    kept = np.delete(np.arange(50), 23)
    for name in ("a.npy", "a.npz"):
        scan = io.read_scan(tmp_path / name)
        np.testing.assert_array_equal(scan.points, POINTS[kept])
        assert scan.num_dropped == 1
    np.testing.assert_array_equal(scan.normals, NORMALS[kept])


def test_a_dense_mesh_is_its_vertices_in_every_format(tmp_path):
    ball = trimesh.creation.icosphere(4)
    for suffix in ("ply", "glb", "off"):
        ball.export(tmp_path / f"a.{suffix}")
        points = io.read_scan(tmp_path / f"a.{suffix}").points
        assert len(points) == len(ball.vertices)


def test_pixels_that_are_no_depths_are_refused(tmp_path):
    for mode in ("1", "P"):
        Image.new(mode, (4, 4), 1).save(tmp_path / "a.png")
        with pytest.raises(InputError, match=rf"a\.png: has pixels of mode {mode}, which are no depths"):
            io.read_depth(tmp_path / "a.png", 1, 1, 0, 0)


# Objects --------------------------------------------------------------------------------------------------


def test_a_scene_of_trimesh_is_its_meshes_where_they_stand():
    box = trimesh.creation.box((3, 2, 1))
    scene = trimesh.Scene([trimesh.PointCloud(POINTS), box])
    scene.add_geometry(box, transform=trimesh.transformations.translation_matrix([5, 0, 0]))
    model = ibi.Model.from_mesh(scene)
    np.testing.assert_allclose(np.ptp(model.points, axis=0), [8, 2, 1], atol=0.3)
    for empty in (trimesh.Scene(), trimesh.Scene(trimesh.PointCloud(POINTS))):
        with pytest.raises(InputError, match="faces: the mesh has none"):
            ibi.Model.from_mesh(empty)
