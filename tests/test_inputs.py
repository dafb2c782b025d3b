"""The table of inputs: what is taken as it is meant, what is refused and how, what finds nothing."""

import tempfile
from importlib.util import find_spec
from typing import get_args

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs._core import measured_rows
from ibi_rs._inputs import _scan_rows
from ibi_rs.variants import Ce, Scs, Te

SCENE = ibi.synth.outlier_layout(
    0, num_instances=3, num_correspondences=600, outlier_ratio=0.5, num_points=256, num_clutter=200
)
# Multiples of 1/16 are the same numbers in every dtype below.
SRC, TGT = (np.round(cloud * 16) / 16 for cloud in (SCENE.src, SCENE.tgt))
CORR = SCENE.corr
N, Q, M = len(SRC), len(TGT), len(CORR)


def register(src=SRC, tgt=TGT, corr=CORR, params=None, **options):
    return ibi.register(src, tgt, corr, params, **options)


def content(found):
    poses = [(np.asarray(found).tobytes(), [(p.score, p.inliers.tolist()) for p in found])]
    return poses, found.labels.tolist(), found.rounds, found.stop_reason, found.resolution


PLAIN = register()


NO_OPEN3D = "large, so not in the group of the tests: `make test-all` installs it and has these run"


class Holder:
    """Something with one attribute, as Open3D's point clouds and trimesh's meshes are to us."""

    def __init__(self, name, value):
        setattr(self, name, value)


class Rows:
    """Open3D's Vector3dVector, as far as numpy sees it: a sequence of rows and no array."""

    def __init__(self, array):
        self.array = array

    def __len__(self):
        return len(self.array)

    def __getitem__(self, row):
        return self.array[row]


class Arrayish:
    def __init__(self, array):
        self.array = array

    def __array__(self, dtype=None, copy=None):
        return np.array(self.array, dtype=dtype)


class OfDlpack:
    """An array of another library, that speaks DLPack and nothing else: Open3D's tensors."""

    def __init__(self, array):
        self.array = array

    def __dlpack__(self, **options):
        return self.array.__dlpack__(**options)

    def __dlpack_device__(self):
        return self.array.__dlpack_device__()


class OfTorch:
    """A tensor of PyTorch, as far as numpy sees it; with the errors of those that are no arrays."""

    def __init__(self, array, error=None):
        self.array, self.error = array, error
        self.shape = np.shape(array)

    def __array__(self, dtype=None, copy=None):
        if self.error:
            raise self.error
        return np.array(self.array, dtype=dtype)

    def __dlpack__(self, **options):
        raise BufferError("not to be asked")


GRADIENT = RuntimeError(
    "Can't call numpy() on Tensor that requires grad. Use tensor.detach().numpy() instead."
)
ON_GPU = TypeError(
    "can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy it to host memory first."
)
BFLOAT16 = TypeError("Got unsupported ScalarType BFloat16")


def memory_map(array):
    with tempfile.TemporaryFile() as file:
        mapped = np.memmap(file, array.dtype, "w+", shape=array.shape)
        mapped[:] = array
        return mapped


def read_only(array):
    array = array.copy()
    array.flags.writeable = False
    return array


def strided(array):
    """Every second row and column of something larger."""
    large = np.zeros((2 * len(array), 2 * array.shape[1]), array.dtype)
    large[::2, ::2] = array
    return large[::2, ::2]


def unaligned(array):
    """A field of a packed record."""
    packed = np.zeros(len(array), np.dtype([("tag", "u1"), ("row", array.dtype, array.shape[1])]))
    packed["row"] = array
    return packed["row"]


LAYOUTS = {
    "lists": np.ndarray.tolist,
    "tuples": lambda a: tuple(map(tuple, a.tolist())),
    "list of arrays": list,
    "Fortran order": np.asfortranarray,
    "strided": strided,
    "negative strides": lambda a: a[::-1, ::-1].copy()[::-1, ::-1],
    "unaligned": unaligned,
    "read-only": read_only,
    "big-endian": lambda a: a.astype(a.dtype.newbyteorder(">")),
    "little-endian": lambda a: a.astype(a.dtype.newbyteorder("<")),
    "__array__": Arrayish,
    "sequence of rows": Rows,
    "__dlpack__": OfDlpack,
    "torch": OfTorch,
    "memory map": memory_map,
    "masked, with no mask": np.ma.asarray,
    "memoryview": memoryview,
    "matrix of another class": lambda a: a.view(type("Tracked", (np.ndarray,), {})),
}
CLOUDS = {
    **LAYOUTS,
    "float16": lambda a: a.astype(np.float16),
    "float32": lambda a: a.astype(np.float32),
    "longdouble": lambda a: a.astype(np.longdouble),
    "big-endian float32": lambda a: a.astype(">f4"),
    ".points": lambda a: Holder("points", a),
    ".points of rows": lambda a: Holder("points", Rows(a)),
    ".vertices": lambda a: Holder("vertices", a),
    ".point.positions": lambda a: Holder("point", Holder("positions", OfDlpack(a))),
    ".vertex.positions": lambda a: Holder("vertex", Holder("positions", OfDlpack(a))),
}
ROWS = {
    **LAYOUTS,
    "int16": lambda a: a.astype(np.int16),
    "uint16": lambda a: a.astype(np.uint16),
    "int32": lambda a: a.astype(np.int32),
    "uint64": lambda a: a.astype(np.uint64),
    "big-endian int32": lambda a: a.astype(">i4"),
    ".correspondence_set": lambda a: Holder("correspondence_set", a),
}


@pytest.mark.parametrize("form", CLOUDS.values(), ids=CLOUDS)
def test_clouds_in_any_form_give_the_same(form):
    assert content(register(src=form(SRC))) == content(PLAIN)
    assert content(register(tgt=form(TGT))) == content(PLAIN)


@pytest.mark.parametrize("form", ROWS.values(), ids=ROWS)
def test_correspondences_in_any_form_give_the_same(form):
    assert content(register(corr=form(CORR))) == content(PLAIN)


# The objects themselves ----------------------------------------------------------------------------------


def test_objects_of_trimesh():
    trimesh = pytest.importorskip("trimesh")
    cloud, scene = trimesh.PointCloud(SRC), trimesh.PointCloud(TGT)
    assert content(register(cloud, scene)) == content(PLAIN)
    box = trimesh.creation.box((3, 2, 1))
    by_arrays = ibi.Model.from_mesh(box.vertices, box.faces)
    np.testing.assert_array_equal(ibi.Model.from_mesh(box).points, by_arrays.points)


def test_objects_of_open3d():
    o3d = pytest.importorskip("open3d", reason=NO_OPEN3D)
    vectors = o3d.utility.Vector3dVector
    cloud, scene = o3d.geometry.PointCloud(vectors(SRC)), o3d.geometry.PointCloud(vectors(TGT))
    pairs = o3d.utility.Vector2iVector(CORR.astype(np.int32))
    assert content(register(cloud, scene, pairs)) == content(PLAIN)
    cloud, scene = (o3d.t.geometry.PointCloud(o3d.core.Tensor(a)) for a in (SRC, TGT))
    assert content(register(cloud, scene, o3d.core.Tensor(CORR))) == content(PLAIN)
    assert content(register(cloud.point.positions, scene.point.positions)) == content(PLAIN)
    box = o3d.geometry.TriangleMesh.create_box(3, 2, 1)
    by_arrays = ibi.Model.from_mesh(np.asarray(box.vertices), np.asarray(box.triangles))
    np.testing.assert_array_equal(ibi.Model.from_mesh(box).points, by_arrays.points)


# Gigabytes, so in no group; `OfTorch` stands for it, and above are Open3D's tensors.
if find_spec("torch"):

    def test_tensors_of_torch():
        import torch

        src, tgt, corr = map(torch.from_numpy, (SRC, TGT, CORR))
        assert content(register(src, tgt, corr)) == content(PLAIN)
        points = torch.hstack([src[corr[:, 0]], tgt[corr[:, 1]]])
        assert content(register(src.half(), tgt.float(), points)) == content(PLAIN)
        assert content(register(src, tgt, (points[:, :3], points[:, 3:]))) == content(PLAIN)
        for tensor in (src.clone().requires_grad_(), src.bfloat16(), src.to("meta"), src.to_sparse()):
            with pytest.raises(TypeError, match=r"^src cannot be read as an array: ") as caught:
                register(src=tensor)
            assert "\n" not in str(caught.value)


# -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.int8, np.uint8, np.int16, np.int32, np.int64])
def test_integer_clouds_and_small_indices(dtype):
    rng = np.random.default_rng(1)
    src = rng.integers(0, 100, (100, 3))
    tgt = np.clip(src + rng.integers(-2, 3, src.shape), 0, 127)
    corr = np.stack([np.arange(100)] * 2, axis=1)
    plain = register(src.astype(float), tgt.astype(float), corr)
    assert len(plain) == 1
    found = register(src.astype(dtype), tgt.astype(dtype), corr.astype(dtype))
    assert content(found) == content(plain)


@pytest.mark.parametrize("form", [np.asarray, strided, np.asfortranarray, np.ndarray.tolist, Arrayish])
def test_point_correspondences_in_any_form(form):
    points = np.hstack([SRC[CORR[:, 0]], TGT[CORR[:, 1]]])
    assert content(register(corr=form(points))) == content(PLAIN)
    pair = form(points[:, :3].copy()), form(points[:, 3:].copy())
    if not isinstance(pair[0], Arrayish):
        assert content(register(corr=pair)) == content(PLAIN)


def test_numbers_of_numpy_are_numbers():
    params = ibi.Params(seed=np.uint64(0), t_he_pr=np.float32(1.5), t_s=np.int8(4), n_contest=np.uint16(60))
    options = {"num_threads": np.int32(1), "max_instances": np.int64(9), "timeout_s": np.float32(60)}
    assert content(register(params=params, **options)) == content(PLAIN)


def test_inputs_are_left_as_they_were():
    arrays = [SRC.copy(), TGT.copy(), CORR.copy(), np.ones((N, 3)), np.ones((Q, 3)), np.ones(M)]
    before = [array.tobytes() for array in arrays]
    src, tgt, corr, src_normals, tgt_normals, similarity = arrays
    register(src, tgt, corr, src_normals=src_normals, tgt_normals=tgt_normals, similarity=similarity)
    assert [array.tobytes() for array in arrays] == before


# Refused -------------------------------------------------------------------------------------------------


def put(array, place, value):
    """A copy with one entry changed."""
    array = np.array(array)
    array[place] = value
    return array


A, T, P, V = ibi.InputError, TypeError, ibi.ParamsError, ValueError
NAN, INF = float("nan"), float("inf")
RAGGED = [[0.0, 1.0, 2.0], [3.0]]
REAL = r"; it must be real numbers"
CLOUD = r"; it must be \(N, 3\)"
ROW = r"; rows must be integers"
CORR_SHAPE = r"; it must be \(M, 2\) rows or \(M, 6\) points"
FINITE = r"; coordinates must be finite"
UNITS = r".* apart; are both in the same unit\?"
THREADS = r"; it must be an integer from 1 to"
ONES = {"src_normals": np.ones((N, 3)), "tgt_normals": np.ones((Q, 3))}
FRAMES = {"src_frames": np.tile(np.eye(3), (N, 1, 1)), "tgt_frames": np.tile(np.eye(3), (Q, 1, 1))}

# What is given, the exception, and a pattern that its message must begin with.
REFUSED = [
    *(
        case
        for name, cloud in (("src", SRC), ("tgt", TGT))
        for case in [
            ({name: cloud[:, :2]}, A, rf"{name} has shape \(\d+, 2\){CLOUD}"),
            ({name: cloud[0]}, A, rf"{name} has shape \(3,\){CLOUD}"),
            ({name: cloud[None]}, A, rf"{name} has shape \(1, \d+, 3\){CLOUD}"),
            ({name: cloud.T}, A, rf"{name} has shape \(3, \d+\){CLOUD}"),
            ({name: 3.0}, A, rf"{name} has shape \(\){CLOUD}"),
            ({name: np.empty((4, 0))}, A, rf"{name} has shape \(4, 0\){CLOUD}"),
            ({name: np.full((9, 3), np.longdouble("1e400"))}, A, rf"{name}\[0\] is .*inf.*{FINITE}"),
            ({name: cloud.astype(str)}, T, rf"{name} has dtype <U\d+{REAL}"),
            ({name: "model.ply"}, T, rf"{name} has dtype <U\d+{REAL}"),
            ({name: cloud.astype(complex)}, T, rf"{name} has dtype complex128{REAL}"),
            ({name: cloud > 0}, T, rf"{name} has dtype bool{REAL}"),
            ({name: cloud.astype(object)}, T, rf"{name} has dtype object{REAL}"),
            ({name: np.ones((9, 3), "m8[s]")}, T, rf"{name} has dtype timedelta64\[s\]{REAL}"),
            ({name: None}, T, rf"{name} has dtype object{REAL}"),
            ({name: object()}, T, rf"{name} has dtype object{REAL}"),
            ({name: Holder("points", None)}, T, rf"{name} has dtype object{REAL}"),
            ({name: RAGGED}, A, rf"{name} is not a rectangular array"),
            ({name: OfTorch(cloud, GRADIENT)}, T, rf"{name} cannot be read as an array: .*\.detach\(\)"),
            ({name: OfTorch(cloud, ON_GPU)}, T, rf"{name} cannot be read as an array: .*\.cpu\(\)"),
            ({name: OfTorch(cloud, BFLOAT16)}, T, rf"{name} cannot be read as an array: .*BFloat16"),
            ({name: np.ma.masked_less(cloud, 0)}, A, rf"{name} has masked entries; leave those rows out"),
            ({name: put(cloud, (7, 1), NAN)}, A, rf"{name}\[7\] is .*NaN.*{FINITE}"),
            ({name: put(cloud, (7, 1), INF)}, A, rf"{name}\[7\] is .*inf.*{FINITE}"),
            ({name: put(cloud, (7, 1), -1e200)}, A, rf"{name}\[7\] is .*{FINITE} and below 1e100"),
            ({name: []}, A, rf"{name} has 0 points; at least 3"),
            ({name: np.empty((0, 3))}, A, rf"{name} has 0 points; at least 3"),
            ({name: cloud[:1]}, A, rf"{name} has 1 points; at least 3"),
            ({name: cloud[:2]}, A, rf"{name} has 2 points; at least 3"),
            ({name: cloud[np.zeros(len(cloud), int)]}, A, rf"all points of {name} coincide"),
        ]
    ),
    ({"src": 1e-3 * SRC}, A, rf"src is .* across but the points of tgt are {UNITS}"),
    ({"tgt": 1e-3 * TGT}, A, rf"tgt is .* across but the points of src are {UNITS}"),
    ({"src": 1e3 * SRC}, A, rf"tgt is .* across but the points of src are {UNITS}"),
    ({"tgt": 1e3 * TGT}, A, rf"src is .* across but the points of tgt are {UNITS}"),
    ({"corr": CORR[:, :1]}, A, rf"corr has shape \({M}, 1\){CORR_SHAPE}"),
    ({"corr": CORR[0]}, A, rf"corr has shape \(2,\){CORR_SHAPE}"),
    ({"corr": np.hstack([CORR, CORR])}, A, rf"corr has shape \({M}, 4\){CORR_SHAPE}"),
    ({"corr": CORR[None]}, A, rf"corr has shape \(1, {M}, 2\){CORR_SHAPE}"),
    ({"corr": np.empty((5, 0))}, A, rf"corr has shape \(5, 0\){CORR_SHAPE}"),
    ({"corr": 7}, A, rf"corr has shape \(\){CORR_SHAPE}"),
    ({"corr": None}, T, rf"corr has dtype object{REAL}"),
    ({"corr": CORR.astype(str)}, T, rf"corr has dtype <U\d+{REAL}"),
    ({"corr": CORR > 0}, T, rf"corr has dtype bool{REAL}"),
    ({"corr": CORR.astype(object)}, T, rf"corr has dtype object{REAL}"),
    ({"corr": CORR.astype(float)}, T, rf"corr of shape \(M, 2\) has dtype float64{ROW}"),
    ({"corr": [[0.5, 1]]}, T, rf"corr of shape \(M, 2\) has dtype float64{ROW}"),
    ({"corr": [[0, 1], [2]]}, A, r"corr is not a rectangular array"),
    ({"corr": [[0, 1], [2], [3, 4]]}, A, r"corr is not a rectangular array"),
    ({"corr": ([[0, 1, 2]], RAGGED)}, A, r"corr is not a rectangular array"),
    ({"corr": put(CORR, (5, 0), N)}, A, rf"corr\[5, 0\] is {N}; src has rows 0 to {N - 1}"),
    ({"corr": put(CORR, (5, 1), Q)}, A, rf"corr\[5, 1\] is {Q}; tgt has rows 0 to {Q - 1}"),
    ({"corr": put(CORR, (5, 0), -1)}, A, rf"corr\[5, 0\] is -1; src has rows 0 to {N - 1}"),
    ({"corr": put(CORR, (5, 1), -(2**63))}, A, rf"corr\[5, 1\] is -{2**63}; tgt has rows"),
    ({"corr": put(CORR.astype("u8"), (5, 1), 2**63)}, A, rf"corr\[5, 1\] is \d+; tgt has rows 0 to {Q - 1}"),
    ({"corr": put(np.ones((9, 6)), (2, 1), NAN)}, A, rf"corr\[2\] is .*NaN.*{FINITE}"),
    ({"corr": put(np.ones((9, 6)), (2, 4), INF)}, A, rf"corr\[2\] is .*inf.*{FINITE}"),
    ({"corr": (SRC[:5], TGT[:4])}, A, r"corr is a pair of 5 and 4 points; it must be of equally many"),
    ({"corr": (SRC[:5], TGT[:5] > 0)}, T, rf"corr\[1\] has dtype bool{REAL}"),
    ({"corr": (OfTorch(SRC[:5], GRADIENT), TGT[:5])}, T, r"corr\[0\] cannot be read as an array: .*detach"),
    ({"corr": OfTorch(CORR, ON_GPU)}, T, r"corr cannot be read as an array: .*\.cpu\(\)"),
    ({"src_normals": ONES["src_normals"]}, A, r"src_normals is given but tgt_normals is not; .*both"),
    ({"tgt_normals": ONES["tgt_normals"]}, A, r"tgt_normals is given but src_normals is not; .*both"),
    *(
        case
        for name, cloud, of in (("src_normals", SRC, "src"), ("tgt_normals", TGT, "tgt"))
        for case in [
            ({**ONES, name: 0 * cloud}, A, rf"{name}\[0\] has length 0; a normal must have a direction"),
            ({**ONES, name: put(ONES[name], 3, 0)}, A, rf"{name}\[3\] has length 0; a normal must"),
            (
                {**ONES, name: ONES[name][:-1]},
                A,
                rf"{name} has \d+ rows; it must have one for each .* of {of}",
            ),
            ({**ONES, name: ONES[name][:, :2]}, A, rf"{name} has shape \(\d+, 2\){CLOUD}"),
            ({**ONES, name: put(ONES[name], (3, 2), NAN)}, A, rf"{name}\[3\] is .*NaN.*{FINITE}"),
            ({**ONES, name: ONES[name].astype(str)}, T, rf"{name} has dtype <U\d+{REAL}"),
        ]
    ),
    ({"src_frames": FRAMES["src_frames"]}, A, r"src_frames is given but tgt_frames is not; .*both"),
    (
        {**FRAMES, "tgt_frames": FRAMES["tgt_frames"][1:]},
        A,
        rf"tgt_frames has {Q - 1} rows; .* {Q} rows of tgt",
    ),
    ({**FRAMES, "src_frames": np.eye(3)}, A, r"src_frames has shape \(3, 3\); it must be \(N, 3, 3\)"),
    ({**FRAMES, "src_frames": -FRAMES["src_frames"]}, A, r"src_frames\[0\] is no rotation; its rows must be"),
    ({**FRAMES, "tgt_frames": put(FRAMES["tgt_frames"], (4, 1), NAN)}, A, r"tgt_frames\[4\] is no rotation"),
    ({**FRAMES, "tgt_frames": [["x"]]}, T, rf"tgt_frames has dtype <U1{REAL}"),
    ({"similarity": np.ones(M - 1)}, A, rf"similarity has {M - 1} rows; .* each of the {M} rows of corr"),
    ({"similarity": []}, A, rf"similarity has 0 rows; .* each of the {M} rows of corr"),
    ({"similarity": np.ones((M, 1))}, A, rf"similarity has shape \({M}, 1\); it must be \(M,\)"),
    ({"similarity": 1.0}, A, r"similarity has shape \(\); it must be \(M,\)"),
    ({"similarity": put(np.ones(M), 4, NAN)}, A, r"similarity\[4\] is NaN; it must be finite"),
    ({"similarity": put(np.ones(M), 4, -INF)}, A, r"similarity\[4\] is -inf; it must be finite"),
    ({"similarity": ["high"] * M}, T, rf"similarity has dtype <U4{REAL}"),
    ({"params": ibi.Params(scs="nnsr")}, A, r"similarity is not given, .* params.scs needs it; give it"),
    ({"viewpoint": (0, 0)}, A, r"viewpoint has shape \(2,\); it must be \(3,\)"),
    ({"viewpoint": [[0, 0]]}, A, r"viewpoint has shape \(1, 2\); it must be \(E, 3\)"),
    ({"viewpoint": np.empty((0, 3))}, A, r"viewpoint has shape \(0, 3\); leave it out"),
    ({"viewpoint": (0, NAN, 0)}, A, rf"viewpoint\[0\] is .*NaN.*{FINITE}"),
    ({"viewpoint": "above"}, T, rf"viewpoint has dtype <U5{REAL}"),
    *(({"num_threads": n}, V, rf"num_threads is {n!r}{THREADS}") for n in (0, -1, 1.5, "two", True, 10**30)),
    ({"params": {"t_s": 5}}, T, r"params must be ibi_rs.Params, not dict"),
    ({"params": "paper_real"}, T, r"params must be ibi_rs.Params, not str"),
    ({"params": ibi.Params}, T, r"params must be ibi_rs.Params, not type"),
    ({"params": ibi.Gtm()}, T, r"params must be ibi_rs.Params, not Gtm"),
    ({"max_instances": -1}, P, r"params.max_instances is -1; it must be an integer from 0"),
    ({"max_instances": 1.5}, P, r"params.max_instances is 1.5; it must be an integer from 0"),
    ({"timeout_s": -1}, P, r"params.timeout_s is -1; it must be between 0 and 1e9"),
    ({"timeout_s": NAN}, P, r"params.timeout_s is nan; it must be a finite number"),
    ({"timeout_s": "1 s"}, P, r"params.timeout_s is '1 s'; it must be a finite number"),
    ({"callback": 3}, T, r"callback must be callable, not int"),
]


@pytest.mark.parametrize(
    ("given", "kind", "pattern"), REFUSED, ids=[f"{i}-{case[2][:24]}" for i, case in enumerate(REFUSED)]
)
def test_what_cannot_be_used_is_refused_in_one_line(given, kind, pattern, capfd):
    with pytest.raises(kind, match="^" + pattern) as caught:
        register(**given)
    assert caught.type is kind
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("text", ["0", "-1", "1.5", "two", " ", "99999999999999999999", "70000"])
def test_a_bad_environment_is_refused_by_its_name(monkeypatch, text):
    monkeypatch.setenv("IBI_NUM_THREADS", text)
    with pytest.raises(ValueError, match=rf"^IBI_NUM_THREADS is .*{text}.*{THREADS}"):
        register()
    assert content(register(num_threads=1)) == content(PLAIN)  # not asked where the argument is given


def test_input_errors_are_value_errors():
    assert issubclass(ibi.InputError, ValueError)
    assert issubclass(ibi.ParamsError, ValueError)
    assert (ibi.InputError.__module__, ibi.ParamsError.__module__) == ("ibi_rs", "ibi_rs")


# Nothing to find -----------------------------------------------------------------------------------------

LINE = np.linspace(0, 1, 50)[:, None] * [1.0, 2.0, 3.0]
SAME = np.stack([np.arange(50)] * 2, axis=1)
# Every variant once, and a validation that accepts whatever it is shown.
VARIANTS = [
    (stage, variant.variant)
    for stage, union in (("scs", Scs), ("ce", Ce), ("te", Te))
    for variant in get_args(union) or (union,)
]
BASES = {"default": ibi.Params(), "paper": ibi.Params.paper_synthetic()}
CREDULOUS = {
    f"{name} {stage} {word}": base.replace(**{stage: word}, hv="none")
    for name, base in BASES.items()
    for stage, word in VARIANTS
}

FRUITLESS = {
    "no correspondence": ({"corr": CORR[:0]}, "few_correspondences"),
    "an empty list": ({"corr": []}, "few_correspondences"),
    "an empty array of floats": ({"corr": np.empty((0, 6))}, "few_correspondences"),
    "an empty pair": ({"corr": (np.empty((0, 3)), np.empty((0, 3)))}, "few_correspondences"),
    "one": ({"corr": CORR[:1]}, "few_correspondences"),
    "two": ({"corr": CORR[:2]}, "few_correspondences"),
    "three": ({"corr": CORR[:3]}, None),
    "one, many times": ({"corr": CORR[np.zeros(500, int)]}, None),
    "all to one target point": ({"corr": np.stack([CORR[:, 0], 0 * CORR[:, 0]], axis=1)}, None),
    "all from one source point": ({"corr": np.stack([0 * CORR[:, 0], CORR[:, 1]], axis=1)}, None),
    "a line to a line": ({"src": LINE, "tgt": LINE + 1, "corr": SAME}, None),
    "a line to a scene": ({"src": LINE, "corr": SAME}, None),
    "a scene to a line": ({"tgt": LINE, "corr": SAME}, None),
    "points on a line, not of it": ({"corr": np.hstack([LINE, LINE])}, None),
}


@pytest.mark.parametrize("params", [None, *CREDULOUS.values()], ids=["default", *CREDULOUS])
@pytest.mark.parametrize(("given", "reason"), FRUITLESS.values(), ids=FRUITLESS)
def test_finding_nothing_is_an_answer(given, reason, params, capfd):
    """Even where every pose is accepted what fixes no pose gives none, and above all no identity."""
    is_nnsr = params is not None and isinstance(params.scs, ibi.Nnsr)
    corr = given.get("corr", CORR)
    similarity = np.ones(0 if isinstance(corr, tuple) else len(corr)) if is_nnsr else None
    found = register(**given, params=params, similarity=similarity)
    assert len(found) == 0
    assert np.asarray(found).shape == (0, 4, 4)
    assert (found.labels == -1).all()
    allowed = ("few_seeds", "few_correspondences") if reason is None else (reason,)
    # `gtm` has no leader that a round could bar, and without a hypothesis nothing is removed.
    if reason is None and params and params.removal == "inliers" and isinstance(params.scs, ibi.Gtm):
        allowed += ("stalled",)
    # Nor do seeds that need not agree leave anything to be removed.
    if reason is None and params and isinstance(params.scs, (ibi.Nnsr, ibi.Hough3d)):
        allowed += ("stalled",)
    assert found.stop_reason.name in allowed
    if found.stop_reason.name != "stalled":
        assert found.stop_reason.value < found.stop_reason.threshold
    assert capfd.readouterr() == ("", "")


# Scans, as cameras write them ----------------------------------------------------------------------------

IMAGE = np.arange(60.0).reshape(4, 5, 3)
UP = np.tile([0.0, 0.0, 2.0], (4, 5, 1))
ORGANISED = {
    name: LAYOUTS[name] for name in ("lists", "tuples", "list of arrays", "Fortran order", "read-only")
}
ORGANISED |= {
    name: LAYOUTS[name] for name in ("big-endian", "__array__", "__dlpack__", "torch", "memoryview")
}


BALL = ibi.Model(SRC, normals=SRC)


def scan(points, normals):
    of_points = None if normals is None else _scan_rows("tgt_normals", normals)
    return measured_rows(_scan_rows("tgt", points), of_points)


@pytest.mark.parametrize("form", ORGANISED.values(), ids=ORGANISED)
def test_organised_scans_are_taken_in_any_form(form):
    holed = put(put(IMAGE, (0, 1, 2), NAN), (3, 3), INF)
    points, normals, num_dropped, _ = scan(form(holed), form(UP))
    assert points.tolist() == np.delete(IMAGE.reshape(-1, 3), [1, 18], axis=0).tolist()
    assert (normals.tolist(), num_dropped) == ([[0, 0, 2]] * 18, 2)


@pytest.mark.parametrize("missing", [[0, 0, 0], [NAN, NAN, NAN], [0, INF, 1]])
def test_a_normal_that_is_missing_is_that_of_the_nearest_point(missing):
    """A point is a point, whatever its normal."""
    normals = np.tile([1.0, 0, 0], (20, 1))
    normals[[4, 6]] = missing
    normals[7] = [0, 1, 0]
    points = np.arange(20.0)[:, None] ** 2 * [1.0, 0, 0]
    points[6] = [48, 0, 0]
    held, of_points, num_dropped, _ = scan(points, normals)
    assert (held.tolist(), num_dropped) == (points.tolist(), 0)
    assert of_points[[4, 6]].tolist() == [[1, 0, 0], [0, 1, 0]]
    assert np.array_equal(normals[4], missing, equal_nan=True)  # those of the caller are as they were
    normals[:11] = missing
    with pytest.raises(
        ibi.InputError, match="tgt_normals: 11 of 20 are 0 or not finite; leave tgt_normals out"
    ):
        BALL.detect(points, tgt_normals=normals)


@pytest.mark.parametrize(
    ("points", "normals", "pattern"),
    [
        (IMAGE[..., :2], None, r"tgt has shape \(4, 5, 2\); it must be \(N, 3\) or \(H, W, 3\)"),
        (IMAGE[None], None, r"tgt has shape \(1, 4, 5, 3\)"),
        (IMAGE, UP[:1], r"tgt_normals has 5 rows; it must have one for each of the 20 rows of tgt"),
        (IMAGE, UP[..., 0], r"tgt_normals has shape \(4, 5\)"),
    ],
)
def test_what_is_no_scan_is_refused(points, normals, pattern):
    with pytest.raises(ibi.InputError, match="^" + pattern):
        scan(points, normals)


@pytest.mark.parametrize("num_points", [2, 100, 6000])
@pytest.mark.parametrize("stretch", [(1, 1, 1), (0, 5, 0), (0, 0, 0), (1e-3, 1, 9)])
def test_the_nearest_point_lends_its_normal(num_points, stretch):
    rng = np.random.default_rng(num_points)
    points = rng.normal(size=(num_points, 3)) * stretch + 1000
    normals = np.column_stack([1 + np.arange(num_points), np.ones((num_points, 2))])  # each another one
    without = rng.permutation(num_points)[: num_points // 2]
    normals[without] = 0
    _, completed, _, num_missing = measured_rows(points, normals)
    assert num_missing == len(without)
    lenders = completed[without, 0].astype(int) - 1
    assert np.isin(lenders, without, invert=True).all()
    has = np.setdiff1d(np.arange(num_points), without)
    for block in np.array_split(np.arange(len(without)), 30):
        least = np.linalg.norm(points[has][None] - points[without[block], None], axis=2).min(axis=1)
        found = np.linalg.norm(points[lenders[block]] - points[without[block]], axis=1)
        np.testing.assert_allclose(found, least, rtol=1e-5)
