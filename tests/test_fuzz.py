"""The Python face under anything: each call answers soundly, or refuses in one line that names the argument.

The same few hundred examples each time; `make fuzz` draws others for as long as it is told.
"""

import io as memory
import os
import warnings

import ibi_rs as ibi
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from ibi_rs import features, io, metrics

EXAMPLES = int(os.environ.get("IBI_FUZZ_EXAMPLES", "0"))
"""How many random ones; by default a few, always the same."""

settings.register_profile(
    "ibi",
    max_examples=EXAMPLES or 60,
    derandomize=not EXAMPLES,
    database=None,
    deadline=None,  # no test knows how fast a machine is
    suppress_health_check=list(HealthCheck),
)
settings.load_profile("ibi")

REFUSED = (ValueError, TypeError)
"""What a user did wrong. InputError and ParamsError are ValueErrors."""

DTYPES = ["f8", "f4", "f2", ">f8", "i4", "i8", "u1", "u8", "i2", "longdouble"]
ODD_DTYPES = ["?", "c16", "U3", "O", "m8[s]", "S2"]


# Arrays ---------------------------------------------------------------------------------------------------

tame = st.floats(-8, 8, width=16)
extreme = st.one_of(
    st.sampled_from([0.0, -0.0, 1e-300, 1e300, -1e300, 5e-324, 1e9, 1e-9, 5e5, 1e14]),
    st.floats(allow_nan=False, allow_infinity=False),
)
anything = st.one_of(extreme, st.sampled_from([np.nan, np.inf, -np.inf]))


@st.composite
def clouds(draw, columns=3, most=40):
    """(N, columns): tame mostly; scaled, offset, repeated, of another dtype or stride, or hopeless."""
    count = draw(st.integers(0, most))
    elements = draw(st.sampled_from([tame, tame, tame, tame, extreme, anything]))
    rows = draw(arrays.arrays(np.float64, (count, columns), elements=elements))
    if count and draw(st.integers(0, 3)) == 0:
        rows = rows[draw(arrays.arrays(np.intp, count, elements=st.integers(0, count - 1)))]
    with np.errstate(all="ignore"):
        rows = rows * draw(st.sampled_from([1, 1, 1, 1e-6, 1e6, 1e-300, 1e300]))
        rows = rows + draw(st.sampled_from([0, 0, 0, 5e5, -1e9, 1e14]))
    return strided(draw, rows)


def strided(draw, rows):
    """The same numbers, or as near as their dtype comes, in memory of another kind."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rows = rows.astype(draw(st.sampled_from(["f8"] * 8 + DTYPES + ODD_DTYPES)))
    kind = draw(st.integers(0, 9))
    if kind == 0:
        return np.asfortranarray(rows)
    if kind == 1:
        return np.repeat(rows, 2, axis=0)[::2]
    if kind == 2:
        return rows[::-1]
    if kind == 3:
        packed = np.zeros(len(rows), dtype=[("pad", "u1"), ("at", rows.dtype, rows.shape[1:])])
        packed["at"] = rows
        return packed["at"]
    if kind == 4:
        rows.flags.writeable = False
    if kind == 5:
        return draw(st.sampled_from([rows.tolist(), rows.T, rows.ravel(), rows[None], None, 3, "src"]))
    return rows


@st.composite
def scenes(draw):
    """A model, a scene with instances of it, and correspondences, right and wrong."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    count = draw(st.integers(3, 40))
    src = rng.normal(size=(count, 3)) * draw(st.sampled_from([1, 1, 50, 1e-3, 1e5]))
    src += draw(st.sampled_from([0, 0, 0, 1e3, 1e6, 1e12]))
    size = np.ptp(src)
    tgt, corr = [rng.normal(size=(draw(st.integers(0, 20)), 3)) * size], []
    for _ in range(draw(st.integers(0, 3))):
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        turn *= np.sign(np.linalg.det(turn))
        start = sum(map(len, tgt))
        corr.append(np.column_stack([np.arange(count), start + np.arange(count)]))
        tgt.append(src @ turn.T + rng.normal(size=3) * size)
    tgt = np.concatenate(tgt)
    wrong = draw(st.integers(0, 40))
    corr.append(rng.integers(0, [count, max(len(tgt), 1)], size=(wrong, 2)))
    return src, tgt, np.concatenate(corr)


def normals(draw, count):
    rows = np.random.default_rng(draw(st.integers(0, 9))).normal(size=(count, 3))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


PRESETS = [ibi.Params(), ibi.Params.single_view(), ibi.Params.paper_synthetic(), ibi.Params.paper_real()]


@st.composite
def options(draw, num_src, num_tgt, num_corr):
    """Any of the optional arguments, fitting mostly."""
    given = {}
    if draw(st.booleans()):
        given["src_normals"], given["tgt_normals"] = normals(draw, num_src), normals(draw, num_tgt)
        if draw(st.integers(0, 9)) == 0:
            given[draw(st.sampled_from(sorted(given)))] = draw(clouds())
    if draw(st.booleans()):
        given["viewpoint"] = draw(
            st.one_of(
                st.just([0, 0, 0]), arrays.arrays(np.float64, 3, elements=anything), clouds().map(as_view)
            )
        )
    if draw(st.booleans()):
        given["similarity"] = draw(arrays.arrays(np.float64, num_corr, elements=tame))
    given["num_threads"] = draw(st.sampled_from([None, 1, 2, 3]))
    given["max_instances"] = draw(st.sampled_from([None, 1, 2, 0, -1, "2"]))
    return given


def as_view(rows):
    try:
        return ibi.View([0, 0, 0], rows)
    except REFUSED:
        return None


# What holds of every result -------------------------------------------------------------------------------


def check_refusal(error):
    """One line, and no words of Rust or numpy about what nobody has given."""
    text = str(error)
    assert text
    assert "\n" not in text
    assert "panicked" not in text


def check_found(found, num_corr):
    poses = np.asarray(found)
    assert poses.shape == (len(found), 4, 4)
    assert np.isfinite(poses).all()
    turns = poses[:, :3, :3]
    np.testing.assert_allclose(
        turns @ turns.transpose(0, 2, 1), np.tile(np.eye(3), (len(found), 1, 1)), atol=1e-9
    )
    assert (np.linalg.det(turns) > 0).all()
    assert (poses[:, 3] == [0, 0, 0, 1]).all()
    for pose in found:
        assert 0 <= pose.score <= 1
        assert 0 <= pose.overlap <= 1
        assert np.isfinite(pose.closeness)
        assert 0 <= pose.back_fit <= 1
    assert [pose.score for pose in found] == sorted((pose.score for pose in found), reverse=True)
    assert found.labels.shape == (num_corr,)
    assert ((found.labels >= -1) & (found.labels < len(found))).all()


def refused_or(call):
    """What `call` answers; None where it refuses, as it should."""
    try:
        return call()
    except REFUSED as error:
        check_refusal(error)
        return None


# Registrations --------------------------------------------------------------------------------------------


@given(
    clouds(),
    clouds(),
    st.one_of(clouds(2), clouds(6), arrays.arrays(np.int64, (9, 2))),
    st.sampled_from(PRESETS),
)
def test_any_arrays_are_registered_or_refused(src, tgt, corr, params):
    found = refused_or(lambda: ibi.register(src, tgt, corr, params, timeout_s=0.5))
    if found is not None:
        check_found(found, len(corr))


@given(scenes(), st.sampled_from(PRESETS), st.data())
def test_any_scene_is_registered_soundly(scene, params, data):
    src, tgt, corr = scene
    given = data.draw(options(len(src), len(tgt), len(corr)))
    found = refused_or(lambda: ibi.register(src, tgt, corr, params, timeout_s=5, **given))
    if found is not None:
        check_found(found, len(corr))


@given(scenes(), st.sampled_from(PRESETS), st.sampled_from([2, 3, 7]))
def test_any_scene_gives_the_same_bits_on_any_number_of_threads(scene, params, num_threads):
    def run(num_threads):
        found = ibi.register(*scene, params, num_threads=num_threads)
        return np.asarray(found).tobytes(), [pose.score for pose in found], found.labels.tobytes()

    one = refused_or(lambda: run(1))
    assert refused_or(lambda: run(num_threads)) == one


# From a mesh and a scan -----------------------------------------------------------------------------------

SIDES = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]])
SIDES = np.concatenate([SIDES, [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]])
CORNERS = np.array([[x, y, z] for x in (0, 3) for y in (0, 2) for z in (0, 1)], dtype=float)
BOX = ibi.Model.from_mesh(CORNERS, SIDES)


@given(clouds(most=300), st.one_of(st.none(), st.just([0, 0, 9.0]), clouds(1, 4)), st.booleans())
def test_any_scan_is_searched_or_refused(scan, viewpoint, removes_plane):
    found = refused_or(
        lambda: BOX.detect(scan, viewpoint=viewpoint, remove_plane=removes_plane, timeout_s=0.5)
    )
    if found is not None:
        check_found(found, len(found.labels))


@given(
    clouds(most=12),
    arrays.arrays(np.int64, st.tuples(st.integers(0, 20), st.just(3)), elements=st.integers(-1, 12)),
)
def test_any_mesh_is_a_model_or_refused(vertices, faces):
    model = refused_or(lambda: ibi.Model.from_mesh(vertices, faces))
    if model is not None:
        assert np.isfinite(model.points).all()
        np.testing.assert_allclose(np.linalg.norm(model.normals, axis=1), 1, atol=1e-9)
        assert np.isfinite([model.diameter, model.spacing, model.voxel]).all()


@given(
    arrays.arrays(np.float64, st.tuples(st.integers(0, 6), st.integers(0, 6)), elements=anything),
    arrays.arrays(np.float64, 4, elements=anything),
    st.one_of(st.none(), arrays.arrays(np.float64, (4, 4), elements=tame), st.just(np.eye(4))),
)
def test_any_depth_image_is_a_view_or_refused(depth, intrinsics, motion):
    view = refused_or(lambda: ibi.View.from_depth(depth, *intrinsics, target_from_camera=motion))
    if view is not None:
        assert np.isfinite(view.eye).all()
        assert np.isfinite(view.points).all()


# Features and metrics -------------------------------------------------------------------------------------

numbers = st.one_of(tame, extreme, anything, st.integers(-2, 50))


@given(clouds(), numbers, st.integers(-1, 60), st.data())
def test_any_features_are_computed_or_refused(points, radius, count, data):
    normals = data.draw(clouds())
    calls = {
        "voxel": lambda: features.voxel_downsample(points, radius)[0],
        "normals": lambda: features.estimate_normals(points, radius, count),
        "fpfh": lambda: features.fpfh(points, normals, radius, count),
        "plane": lambda: features.dominant_plane(points, radius),
    }
    with np.errstate(all="ignore"):
        answer = refused_or(calls[data.draw(st.sampled_from(sorted(calls)))])
    if isinstance(answer, np.ndarray):
        assert np.isfinite(answer).all()


@given(clouds(4), clouds(4), st.integers(-1, 60), st.booleans(), st.one_of(st.none(), numbers))
def test_any_descriptors_are_matched_or_refused(src, tgt, k, mutual, ratio):
    answer = refused_or(lambda: ibi.match(src, tgt, k=k, mutual=mutual, ratio=ratio))
    if answer is not None:
        corr, similarity = answer
        assert (corr >= 0).all()
        assert (corr < [max(len(src), 1), max(len(tgt), 1)]).all()
        assert ((similarity >= 0) & (similarity <= 1)).all()


@given(clouds(), st.data())
def test_any_poses_are_scored_or_refused(model, data):
    shapes = st.tuples(st.integers(0, 4), st.just(4), st.just(4))
    some = st.one_of(
        arrays.arrays(np.float64, shapes, elements=anything),
        st.integers(0, 4).map(lambda count: np.tile(np.eye(4), (count, 1, 1))),
    )
    predicted, truth = data.draw(some), data.draw(some)
    score = refused_or(lambda: metrics.score_scene(predicted, truth, criterion=metrics.ADD_S, model=model))
    if score is not None:
        assert 0 <= score.f1 <= 1
    if len(predicted) and len(truth):
        error = refused_or(lambda: metrics.add_s(model, predicted[0], truth[0]))
        assert error is None or error >= 0


# Files ----------------------------------------------------------------------------------------------------

trimesh = pytest.importorskip("trimesh")


def written(suffix):
    """The bytes of a small file of each kind that is read."""
    rows = np.random.default_rng(0).normal(size=(9, 3)).round(2)
    if suffix == ".npy":
        file = memory.BytesIO()
        np.save(file, rows)
        return file.getvalue()
    if suffix == ".npz":
        file = memory.BytesIO()
        np.savez(file, points=rows)
        return file.getvalue()
    if suffix in (".xyz", ".csv", ".txt"):
        return "\n".join(("," if suffix == ".csv" else " ").join(map(str, row)) for row in rows).encode()
    if suffix == ".pcd":
        head = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 9\nHEIGHT 1\n"
        return (head + "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 9\nDATA ascii\n").encode() + written(".xyz")
    mesh = trimesh.Trimesh(CORNERS, SIDES)
    data = mesh.export(file_type=suffix[1:])
    return data.encode() if isinstance(data, str) else data


FILES = {
    suffix: written(suffix)
    for suffix in (".npy", ".npz", ".xyz", ".csv", ".txt", ".pcd", ".ply", ".stl", ".off", ".obj", ".glb")
}


@pytest.mark.parametrize("suffix", FILES)
@given(st.data())
@settings(max_examples=EXAMPLES or 15)
def test_any_file_is_read_or_refused(suffix, tmp_path_factory, data):
    content = bytearray(FILES[suffix])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, max(len(content) - 1, 0)))
        match data.draw(st.integers(0, 3)):
            case 0:
                del content[at:]
            case 1:
                content[at : at + 1] = data.draw(st.binary(min_size=1, max_size=4))
            case 2:
                del content[at : at + data.draw(st.integers(1, 20))]
            case _:
                content[at:at] = data.draw(st.binary(max_size=8))
    path = tmp_path_factory.mktemp("fuzz") / f"a{suffix}"
    path.write_bytes(content)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")  # of readers, over what the file holds
        cloud = refused_or(lambda: io.read_cloud(path))
        if cloud is not None:
            assert np.isfinite(cloud[0]).all()
            assert cloud[0].shape[1] == 3
        if suffix in (".ply", ".stl", ".off", ".obj", ".glb"):
            mesh = refused_or(lambda: io.read_mesh(path))
            if mesh is not None:
                vertices, faces = mesh
                assume(len(vertices))
                assert faces.max() < len(vertices)


# Parameters -----------------------------------------------------------------------------------------------

plain = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=2), st.dictionaries(st.text(max_size=5), inner, max_size=2)
    ),
    max_leaves=4,
)


@given(st.data())
def test_any_parameters_are_taken_or_refused(data):
    held = data.draw(st.sampled_from(PRESETS)).to_dict()
    for _ in range(data.draw(st.integers(1, 3))):
        block = held
        key = data.draw(st.sampled_from(sorted(block)))
        if isinstance(block[key], dict) and data.draw(st.booleans()):
            block, key = block[key], data.draw(st.sampled_from(sorted(block[key])))
        block[key] = data.draw(st.one_of(plain, numbers))
    params = refused_or(lambda: ibi.Params.from_dict(held))
    if params is not None:
        assert ibi.Params.from_dict(params.to_dict()) == params
        assert ibi.Params.from_toml(params.to_toml()) == params


@given(st.text())
def test_any_text_is_parameters_or_refused(text):
    refused_or(lambda: ibi.Params.from_toml(text))
