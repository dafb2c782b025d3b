"""What lies between a scan and its poses: what is to be found all the same, refused in one line, or told of.

A pile of six parts, as one camera sees it, and what may be odd about it or about the model.
"""

import pickle
import re

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import features, metrics
from small_piles import DISTANCE, move, small_pile
from test_detect import EXAMPLES
from test_features import box

VERTICES, FACES = ibi.io.read_mesh(EXAMPLES / "models/ind_small_part.ply")
VERTICES = 1000 * VERTICES  # millimetres
SIZE = float(np.linalg.norm(np.ptp(VERTICES, axis=0)))
EYE = np.zeros(3)
SEED = 3
"""Of a pile in which each part is found beyond doubt, and none turned about."""
RNG = np.random.default_rng(5)


@pytest.fixture(scope="module")
def pile():
    return small_pile(VERTICES, FACES, seed=SEED)


@pytest.fixture(scope="module")
def coarse():
    return small_pile(VERTICES, FACES, pixel=1.2)


@pytest.fixture(scope="module")
def table():
    return small_pile(VERTICES, FACES[:1], num_parts=0)


@pytest.fixture(scope="module")
def part():
    return ibi.Model.from_mesh(VERTICES, FACES)


@pytest.fixture(scope="module")
def matches(part, pile):
    return part.correspond(pile.points, viewpoint=EYE)


def num_right(found, poses, part):
    """How many parts are found; no pose may be wrong."""
    score = metrics.score_scene(found, poses, criterion=metrics.ADD_S, model=part.points)
    assert score.precision == 1 or len(found) == 0
    return score.num_truth_hit


def test_the_pile_is_found_without_a_doubt(pile, part):
    found = part.detect(pile.points, viewpoint=EYE)
    assert num_right(found, pile.poses, part) == 6
    assert found.warnings == ()
    assert "warning" not in repr(found)


# Nothing, and far pixels ------------------------------------------------------------------------------------


@pytest.mark.parametrize("spread", [1.0, 0.02], ids=["scattered", "in a clump"])
@pytest.mark.parametrize("num_stray", [0, 1, 3, 10, 30])
def test_an_empty_table_is_empty(table, part, num_stray, spread):
    stray = SIZE * (spread * RNG.uniform(-1, 1, (num_stray, 3)) * [1, 1, 0.1] + [0, 0, 0.2])
    found = part.detect(np.concatenate([table.points, move(table.camera_from_world, stray)]), viewpoint=EYE)
    assert len(found) == 0
    assert found.stop_reason.name in ("few_correspondences", "few_seeds", "max_rejections")
    assert found.labels.dtype == np.int32


def test_a_flat_part_is_no_table():
    plate = ibi.Model.from_mesh(*box(np.array([1.0, 0.6, 0.02])))
    seen = plate.points[plate.normals[:, 2] > 0.9] * [1, -1, -1] + [0, 0, 6]
    matches = plate.correspond(seen, viewpoint=EYE)
    assert len(matches.tgt) > 0.9 * len(seen)
    assert matches.warnings == ()


@pytest.mark.parametrize(
    ("scan", "warning"),
    [
        (np.empty((0, 3)), "the scan has 0 points"),
        (np.empty((4, 5, 3))[:0], "the scan has 0 points"),
        (np.ones((2, 3)), "the scan has 2 points"),
        (np.full((5, 3), np.nan), "5 of 5 points of the scan are not finite, and were left out"),
        (np.full((6, 7, 3), np.nan), "42 of 42 points"),
    ],
)
def test_a_scan_without_points_is_an_empty_result(part, scan, warning):
    found = part.detect(scan, viewpoint=EYE, max_instances=3)
    assert len(found) == 0
    assert str(found.stop_reason) == "few_correspondences: 0 alive, 3 needed"
    assert any(line.startswith(warning) for line in found.warnings)
    assert found.rounds == ()
    assert found.params.max_instances == 3
    matches = part.correspond(scan, viewpoint=EYE)
    assert matches.corr.shape == (0, 2)
    with pytest.raises(TypeError, match="params must be"):
        part.detect(scan, {}, viewpoint=EYE)


@pytest.mark.parametrize("num_far", [1, 10, 100])
def test_far_pixels_change_nothing(pile, part, num_far):
    far = np.column_stack([100 * np.arange(num_far), np.zeros(num_far), np.full(num_far, 22_000)])
    found = part.detect(np.concatenate([pile.points, far]), viewpoint=EYE)
    assert num_right(found, pile.poses, part) >= 5


@pytest.mark.parametrize("unit", [0.001, 1000.0])
def test_units_are_judged_on_the_whole_scan_and_the_check_can_be_turned_off(pile, part, unit):
    with pytest.raises(ibi.InputError, match=r"in the same unit\?.*check_units off"):
        part.detect(unit * pile.points, viewpoint=EYE)
    found = part.detect(unit * pile.points, viewpoint=EYE, check_units=False)
    assert len(found) == 0
    few = unit * pile.points[:: len(pile.points) // 90][:99]
    assert len(part.detect(few, viewpoint=EYE)) == 0


# Twins ------------------------------------------------------------------------------------------------------


def twice(rows, share=1.0, off=0.0):
    again = rows[: int(share * len(rows))]
    return np.concatenate([rows, again + off * np.random.default_rng(5).uniform(-1, 1, again.shape)])


TWINS = [(1.0, 0.0), (1.0, 1e-6), (0.8, 0.0), (0.8, 1e-6)]


@pytest.mark.parametrize(("share", "off"), TWINS)
def test_rows_given_twice_change_nothing(pile, part, matches, share, off):
    found = part.detect(twice(pile.points, share, off), viewpoint=EYE)
    assert num_right(found, pile.poses, part) == 6

    found = part.register(
        twice(matches.tgt, share, off),
        matches.corr,
        ibi.Params.single_view(),
        tgt_normals=twice(matches.tgt_normals, share),
        similarity=matches.similarity,
        viewpoint=ibi.View(EYE, pile.points),
    )
    assert num_right(found, pile.poses, part) == 6

    model = ibi.Model(twice(part.points, share, off), normals=twice(part.normals, share))
    assert model.spacing == pytest.approx(part.spacing, rel=0.01)
    assert model.voxel == pytest.approx(1.25 * part.spacing, rel=0.01)
    assert num_right(model.detect(pile.points, viewpoint=EYE), pile.poses, part) == 6


# The voxel --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("voxel", [0.5, 0.7, 1.0, 1.5])
def test_a_model_finer_than_the_scan_is_matched_at_what_the_scan_can_carry(pile, part, voxel):
    fine = ibi.Model.from_mesh(VERTICES, FACES, voxel=voxel)
    found = fine.detect(pile.points, viewpoint=EYE)
    assert num_right(found, pile.poses, part) >= 5
    (warning,) = found.warnings
    matches = fine.correspond(pile.points, viewpoint=EYE)
    assert warning == (
        f"the scan is coarser than the voxel of {voxel:.3g} that the model was given;"
        f" {matches.voxel:.3g} was used"
    )
    assert found.resolution == pytest.approx(matches.voxel / 1.25)
    assert fine.voxel == voxel
    # Rows are those of the model as it is, for whoever registers by hand.
    assert matches.corr[:, 0].max() < len(fine)
    assert warning in repr(found)
    assert matches.warnings == found.warnings
    again = pickle.loads(pickle.dumps(matches))
    assert (again.voxel, again.warnings) == (matches.voxel, matches.warnings)
    np.testing.assert_array_equal(again.corr, matches.corr)


def test_a_fine_cloud_as_model_is_thinned_for_a_coarse_scan(pile, coarse, part):
    points, normals = features.sample_mesh(VERTICES, FACES, spacing=0.7)
    seen = features.outer_surface(points, normals, VERTICES, FACES)
    model = ibi.Model(points[seen], normals=normals[seen])
    found = model.detect(pile.points, viewpoint=EYE)
    assert num_right(found, pile.poses, part) >= 5
    assert found.warnings == ()  # nobody set a voxel
    assert (
        model.correspond(coarse.points, viewpoint=EYE).voxel
        > 1.5 * model.correspond(pile.points, viewpoint=EYE).voxel
    )


def test_a_resolution_that_is_given_stays(pile):
    fine = ibi.Model.from_mesh(VERTICES, FACES, voxel=1.0)
    params = ibi.Params.single_view().replace(resolution=1.7)
    assert fine.detect(pile.points, params, viewpoint=EYE).resolution == 1.7


# What lies there always -------------------------------------------------------------------------------------


@pytest.mark.parametrize("is_grid", [False, True])
def test_what_lies_in_the_empty_bin_is_not_searched(pile, part, is_grid):
    empty = small_pile(VERTICES, FACES, num_parts=2, seed=SEED)
    np.testing.assert_array_equal(empty.poses, pile.poses[:2])
    found = part.detect(pile.points, viewpoint=EYE, background=empty.grid if is_grid else empty.points)
    assert num_right(found, pile.poses[2:], part) == 4
    assert found.warnings == ()
    # Table and fixtures are told of, at the voxel.
    held = move(pile.poses[0], part.points)
    gaps = np.linalg.norm(found.background[:, None] - held, axis=2).min(axis=1)
    assert (gaps < part.voxel).sum() > 50
    for pose in pile.poses[2:]:
        upper = move(pose, part.points)
        upper = upper[upper[:, 2] < np.median(upper[:, 2])]
        gaps = np.linalg.norm(found.background[:, None] - upper, axis=2).min(axis=1)
        assert (gaps < part.voxel / 2).sum() < 10


def test_an_empty_bin_is_empty(part):
    empty = small_pile(VERTICES, FACES, num_parts=2, seed=SEED)
    again = empty.points + RNG.normal(0, 0.1, empty.points.shape)
    found = part.detect(again, viewpoint=EYE, background=empty.points)
    assert len(found) == 0
    assert len(part.detect(again, viewpoint=EYE)) == 2


def test_a_background_without_a_point_is_none(pile, part):
    with pytest.raises(ibi.InputError, match="background: it holds no point"):
        part.detect(pile.points, viewpoint=EYE, background=np.full((4, 3), np.nan))
    with pytest.raises(ibi.InputError, match=r"background has shape \(3,\)"):
        part.detect(pile.points, viewpoint=EYE, background=[0, 0, 0])


# The scan that a camera has smoothed ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tee():
    mesh = ibi.io.read_mesh(EXAMPLES / "tee/model_tee_mesh.ply")
    return mesh, ibi.io.read_cloud(EXAMPLES / "tee/tee6.ply")[0]


@pytest.mark.parametrize("voxel", [0.003, 0.0038, 0.0042, 0.005])
def test_any_voxel_finds_them(tee, voxel):
    mesh, scan = tee
    assert len(ibi.Model.from_mesh(*mesh, voxel=voxel).detect(scan, viewpoint=EYE)) == 6


@pytest.mark.parametrize(
    "more",
    [
        lambda scan: scan,
        lambda scan: scan + 1e-6,
        lambda scan: scan[::2],
        lambda scan: scan[::10],
        lambda scan: np.zeros((50, 3)),
        lambda scan: np.random.default_rng(0).uniform(scan.min(axis=0), scan.max(axis=0), (30, 3)),
    ],
    ids=["twice", "twins", "half twice", "a tenth twice", "pixels of nothing", "strays"],
)
def test_rows_that_are_none_change_nothing(tee, more):
    mesh, scan = tee
    found = ibi.Model.from_mesh(*mesh).detect(np.concatenate([scan, more(scan)]), viewpoint=EYE)
    assert len(found) == 6


# Which side is out ------------------------------------------------------------------------------------------


def turned(kind):
    faces = FACES.copy()
    side = VERTICES[FACES].mean(axis=1)[:, 0]
    chosen = {
        "all": np.ones(len(faces), dtype=bool),
        "half at random": np.random.default_rng(1).random(len(faces)) < 0.5,
        "one half": side > np.median(side),
        "a tenth": np.random.default_rng(2).random(len(faces)) < 0.1,
    }[kind]
    faces[chosen] = faces[chosen][:, ::-1]
    return faces


@pytest.mark.parametrize("kind", ["all", "half at random", "one half", "a tenth"])
def test_faces_that_are_turned_inwards_lose_nothing(pile, part, kind):
    model = ibi.Model.from_mesh(VERTICES, turned(kind))
    assert len(model) == pytest.approx(len(part), rel=0.03)
    nearest = np.linalg.norm(model.points[:, None] - part.points, axis=2).argmin(axis=1)
    assert np.mean(np.einsum("ij,ij->i", model.normals, part.normals[nearest]) < -0.5) < 0.01
    found = model.detect(pile.points, viewpoint=EYE)
    assert num_right(found, pile.poses, part) == 6
    assert found.warnings == ()


@pytest.mark.parametrize("name", ["ind_box_electronics", "ind_gear_part", "cat", "oven", "bench"])
def test_a_mesh_that_is_wound_rightly_is_as_seen_from_its_fronts(name):
    mesh = ibi.io.read_mesh(EXAMPLES / f"models/{name}.ply")
    model = ibi.Model.from_mesh(*mesh)
    points, normals = features.sample_mesh(*mesh, spacing=model.voxel / 2)
    seen = features.outer_surface(points, normals, *mesh)
    points, normals = features.voxel_downsample(points[seen], model.voxel, normals=normals[seen])
    np.testing.assert_array_equal(model.points, points)
    np.testing.assert_array_equal(model.normals, normals)


def test_a_sheet_keeps_the_side_that_it_was_given():
    sheet = [[0.0, 0, 0], [3, 0, 0], [3, 2, 0], [0, 2, 0]]
    for faces, z in (([[0, 1, 2], [0, 2, 3]], 1), ([[2, 1, 0], [3, 2, 0]], -1)):
        np.testing.assert_array_equal(ibi.Model.from_mesh(sheet, faces).normals[:, 2], z)


@pytest.mark.parametrize(
    ("sign", "words"),
    [
        (lambda points: 1, None),
        (lambda points: -1, r"src_normals: 9\d% of those that are seen from outside point inwards"),
        (lambda points: np.sign(points[:, :1] - np.median(points[:, 0]) + 1e-9), r"src_normals: [45]\d% of"),
    ],
    ids=["outwards", "inwards", "half of them"],
)
def test_a_cloud_with_normals_inwards_is_told_of(pile, part, sign, words):
    model = ibi.Model(part.points, normals=part.normals * sign(part.points))
    warnings = [line for line in model.detect(pile.points, viewpoint=EYE).warnings if "src_normals" in line]
    assert len(warnings) == (words is not None)
    if words is not None:
        assert re.match(words, warnings[0])


# Rows that are not finite -----------------------------------------------------------------------------------


def test_rows_that_are_not_finite_are_left_out_and_counted(pile, part):
    clean = part.detect(pile.points, viewpoint=EYE)
    bad = np.repeat(pile.points, 2, axis=0)
    bad[1::2] = [np.nan, np.inf, -np.inf]
    found = part.detect(bad, viewpoint=EYE)
    np.testing.assert_array_equal(found, clean)
    n = len(pile.points)
    assert found.warnings == (f"{n} of {2 * n} points of the scan are not finite, and were left out",)


def test_organised_scans_are_taken(pile, part):
    found = part.detect(pile.grid, viewpoint=EYE)
    np.testing.assert_array_equal(found, part.detect(pile.points, viewpoint=EYE))
    num_empty = np.isnan(pile.grid).any(axis=-1).sum()
    assert bool(found.warnings) == bool(num_empty)


def test_normals_go_with_their_points(pile, part):
    normals = features.estimate_normals(pile.points, 5, viewpoint=EYE)
    clean = part.detect(pile.points, tgt_normals=normals, viewpoint=EYE)
    bad = np.insert(pile.points, 100, np.nan, axis=0)
    found = part.detect(bad, tgt_normals=np.insert(normals, 100, 7, axis=0), viewpoint=EYE)
    np.testing.assert_array_equal(found, clean)
    with pytest.raises(ibi.InputError, match="tgt_normals has 5 rows"):
        part.detect(bad, tgt_normals=normals[:5], viewpoint=EYE)


def test_register_refuses_them_with_the_row(part, matches):
    tgt = matches.tgt.copy()
    tgt[7, 1] = np.nan
    with pytest.raises(ibi.InputError, match=r"tgt\[7\]"):
        part.register(tgt, matches.corr, tgt_normals=matches.tgt_normals)


# Where the camera stood -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("eye", "words"),
    [
        ([0, 0, 0], None),
        ([0.05, 0, 0], None),
        ([0, -1, 0], "viewpoint: 2[0-9]% of the scan lie behind other points"),
        ([1, 0, 1], "viewpoint: [3-5][0-9]% of the scan lie behind other points"),
        ([0, 0, 2], "viewpoint: nearly all of the scan lies behind its largest plane"),
    ],
    ids=["the true one", "a little aside", "above", "beside", "behind"],
)
def test_a_viewpoint_that_the_scan_contradicts_is_told_of(pile, part, eye, words):
    matches = part.correspond(pile.points, viewpoint=np.multiply(eye, DISTANCE * SIZE))
    if words is None:
        assert matches.warnings == ()
    else:
        (warning,) = matches.warnings
        assert re.match(words, warning)


@pytest.mark.parametrize("tilts", [(-30,), (-50,), (10, -20, -50)])
def test_a_fused_scan_with_normals_is_told_of(pile, part, tilts):
    def of_one(scan):
        return scan.points, features.estimate_normals(scan.points, 2 * part.voxel, viewpoint=EYE)

    points, normals = of_one(pile)
    assert part.correspond(points, tgt_normals=normals, viewpoint=EYE).warnings == ()
    for tilt in tilts:
        other = small_pile(VERTICES, FACES, tilt_deg=tilt)
        motion = pile.camera_from_world @ np.linalg.inv(other.camera_from_world)
        more, of_more = of_one(other)
        points = np.concatenate([points, move(motion, more)])
        normals = np.concatenate([normals, of_more @ motion[:3, :3].T])
    (warning,) = part.correspond(points, tgt_normals=normals, viewpoint=EYE).warnings
    assert re.match(r"viewpoint: \d% of the normals face away from it", warning)
    assert part.correspond(points, tgt_normals=normals).warnings == ()


# Units ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("factor", "is_larger"), [(25.4, False), (10, False), (25.4, True), (10, True), (2.54, True)]
)
def test_where_nothing_is_found_the_factor_that_would_fit_is_named(pile, factor, is_larger):
    model = ibi.Model.from_mesh(VERTICES * factor if is_larger else VERTICES / factor, FACES)
    found = model.detect(pile.points, viewpoint=EYE)
    assert len(found) == 0
    words = f"1/{factor:g}" if is_larger else f"{factor:g}"
    assert found.warnings[-1].endswith(f"in the same unit? The model times {words} would fit")


def test_a_part_that_is_not_there_is_no_matter_of_units(pile):
    other = ibi.Model.from_mesh(*box(np.array([0.9, 0.3, 0.2]) * SIZE))
    found = other.detect(pile.points, viewpoint=EYE, max_instances=1)
    assert not any("unit" in line for line in found.warnings)


# Numbers that are too coarse --------------------------------------------------------------------------------


def at(offset, points, dtype):
    return (points + offset).astype(dtype)


@pytest.mark.parametrize("as_double", [False, True], ids=["float32", "float32 held as float64"])
@pytest.mark.parametrize("distance", [1e2, 1e4, 1e6, 1e7, 1e8])
def test_single_precision_is_refused_where_its_steps_are_as_wide_as_the_spacing(
    pile, part, matches, distance, as_double
):
    offset = np.array([distance, -distance, distance / 2])
    step = float(np.spacing(np.float32(distance)))
    tgt = at(offset, matches.tgt, np.float32)
    scan = at(offset, pile.points, np.float32)
    src = at(offset, part.points, np.float32)
    if as_double:
        tgt, scan, src = (cloud.astype(np.float64) for cloud in (tgt, scan, src))
    calls = {
        "tgt": lambda: part.register(tgt, matches.corr, tgt_normals=matches.tgt_normals, max_instances=1),
        "tgt ": lambda: part.correspond(scan, viewpoint=offset),
        "src": lambda: ibi.Model(src),
        "corr": lambda: part.register(
            matches.tgt + offset,
            (part.points[matches.corr[:, 0]], tgt[matches.corr[:, 1]]),
            tgt_normals=matches.tgt_normals,
            max_instances=1,
        ),
    }
    for name, call in calls.items():
        if step > 2 * part.spacing:
            with pytest.raises(ibi.InputError, match=rf"^{name.strip()}: .*float32\) are {step:.3g} apart"):
                call()
        elif step < 0.1 * part.spacing:
            call()


@pytest.mark.parametrize("distance", [1e6, 1e9])
def test_double_precision_far_off_is_as_near_by(pile, part, distance):
    offset = np.full(3, distance)
    found = part.detect(pile.points + offset, viewpoint=offset)
    poses = pile.poses.copy()
    poses[:, :3, 3] += offset
    assert num_right(found, poses, part) == 6


def test_whole_numbers_are_not_taken_for_single_precision():
    grid = np.stack(np.meshgrid(*3 * [np.arange(12.0)]), axis=-1).reshape(-1, 3)
    assert ibi.Model(grid + 5_000_000).spacing == 1


@pytest.mark.parametrize(("offset", "is_refused"), [(1e9, False), (1e11, False), (1e14, True), (1e16, True)])
def test_offsets_beyond_double_precision_are_refused(offset, is_refused):
    scene = ibi.synth.outlier_layout(seed=1, num_instances=3)
    scale = 1 / ibi.Model(scene.src).spacing
    src, tgt = scale * scene.src, scale * scene.tgt
    if is_refused:
        for name, clouds in (("src", (src + offset, tgt)), ("tgt", (src, tgt + offset))):
            with pytest.raises(ibi.InputError, match=rf"{name} .*(numbers are|coincide)"):
                ibi.register(*clouds, scene.corr)
    else:
        assert len(ibi.register(src + offset, tgt, scene.corr)) == 3
        assert len(ibi.register(src, tgt + offset, scene.corr)) == 3


# The result -------------------------------------------------------------------------------------------------


def test_warnings_stay_with_a_result(part):
    found = part.detect(np.empty((0, 3)), viewpoint=EYE)
    for other in (pickle.loads(pickle.dumps(found)), found.canonical(ibi.Symmetries.none())):
        assert other.warnings == found.warnings == ("the scan has 0 points",)
    assert repr(found).endswith("\n  warning: the scan has 0 points")
