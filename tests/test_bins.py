"""`synth.bin_scene` and `synth.row_scene`: parts rest, cameras see what is there and spoil it as they say."""

import sys

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import features, synth
from ibi_rs.synth import bins, solids
from ibi_rs.synth.camera import Flaws, Sight, spoilt
from ibi_rs.synth.scene import move
from scipy.spatial import cKDTree

try:
    import open3d as o3d
except ImportError:
    o3d = None

NO_OPEN3D = "large, so not in the group of the tests: `make test-all` installs it and has these run"
needs_open3d = pytest.mark.skipif(o3d is None, reason=NO_OPEN3D)

NAMES = ("bracket-a", "bolt-a", "clip-a")
MESHES = [synth.part_mesh(name) for name in NAMES]
EXACT = {"noise": 0, "quantum": 0, "smear": 0, "dropout": 0}
ARRAYS = ("points", "labels", "eyes", "poses", "kinds", "visibility", "target_from_bin", "size")


@pytest.fixture(scope="module")
def scene():
    return synth.bin_scene(MESHES, seed=3, num_instances=(3, 3, 4))


@pytest.fixture(scope="module")
def coarse():
    """Few pixels and no flaws, for what is counted naively."""
    return synth.bin_scene(MESHES, seed=3, num_instances=(3, 3, 4), pixel=1.5, **EXACT)


def instances(scene):
    """The mesh of each instance at its place."""
    return [
        (move(pose, MESHES[kind][0]), MESHES[kind][1])
        for pose, kind in zip(scene.poses, scene.kinds, strict=True)
    ]


def diameter(mesh):
    return np.linalg.norm(np.ptp(mesh[0], axis=0))


def naive_cast(meshes, rays):
    """Depth and mesh of each ray (N, 3) from the origin, triangle by triangle (Moller & Trumbore)."""
    depth, owner = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for k, (points, triangles) in enumerate(meshes):
        for a, b, c in points[triangles]:
            across = np.cross(rays, c - a)
            det = across @ (b - a)
            with np.errstate(divide="ignore", invalid="ignore"):
                u = across @ -a / det
                way = np.cross(-a, b - a)
                v = rays @ way / det
                t = (c - a) @ way / det
            nearer = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < depth)
            depth[nearer], owner[nearer] = t[nearer], k
    return depth, owner


def pixel_rays(image):
    v, u = np.mgrid[: image.depth.shape[0], : image.depth.shape[1]]
    return np.stack(
        [(u - image.cx) / image.fx, (v - image.cy) / image.fy, np.ones(u.shape)], axis=-1
    ).reshape(-1, 3)


# Parts ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*synth.PARTS, *synth.FURNITURE])
def test_meshes_are_closed_and_face_outwards(name):
    points, faces = (synth.part_mesh if name in synth.PARTS else synth.furniture_mesh)(name)
    assert points.dtype == np.float64
    assert faces.dtype == np.int64
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ways, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 1).all()
    assert {tuple(edge) for edge in ways} == {tuple(edge[::-1]) for edge in ways}
    a, b, c = (points[faces[:, i]] for i in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 0
    if name in synth.FURNITURE:
        assert points[:, 2].min() == 0


def test_the_families_differ_by_more_than_their_sizes():
    """By how far pairs of points of a surface lie apart, in diameters: that knows no size and no pose."""

    def spread(mesh, seed=1):
        points, _ = features.sample_mesh(*mesh, n=4000, seed=seed)
        return np.sort(np.linalg.norm(points[:2000] - points[2000:], axis=1) / diameter(mesh))

    kinds = sorted({name.rsplit("-", 1)[0] for name in (*synth.PARTS[:10], *synth.FURNITURE)})
    assert len(kinds) == 12
    for kind in kinds:
        make = synth.part_mesh if f"{kind}-a" in synth.PARTS else synth.furniture_mesh
        a, b = (make(f"{kind}-{family}") for family in "ab")
        by_chance = np.abs(spread(a) - spread(a, seed=2)).mean()
        assert np.abs(spread(a) - spread(b)).mean() > 2 * by_chance, kind


def test_near_copies_and_mirror_images_are_of_the_same_kind_and_other_parts():
    for kind in ("bracket", "flange", "bolt", "clip", "pin"):
        for family in "ab":
            own, near = (synth.part_mesh(f"{kind}-{family}{more}") for more in ("", "-near"))
            assert 0.7 < diameter(near) / diameter(own) < 1.4
            assert not np.array_equal(near[0], own[0])
    own, mirror = (synth.part_mesh(f"bracket-a{more}") for more in ("", "-mirror"))
    np.testing.assert_array_equal(own[0] * [1, -1, 1], mirror[0])


def test_an_unknown_name_lists_those_there_are():
    with pytest.raises(ValueError, match="unknown part 'nut'; there are bracket-a"):
        synth.part_mesh("nut")
    with pytest.raises(ValueError, match="unknown piece of furniture 'bed'; there are chair-a"):
        synth.furniture_mesh("bed")


# The bin --------------------------------------------------------------------------------------------------


@needs_open3d
def test_the_seed_makes_the_bin(scene):
    again, other = (synth.bin_scene(MESHES, seed=seed, num_instances=(3, 3, 4)) for seed in (3, 4))
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(again, name), getattr(scene, name))
    np.testing.assert_array_equal(again.cameras[0].depth, scene.cameras[0].depth)
    assert not np.array_equal(other.poses, scene.poses)
    assert repr(scene).startswith("Bin(10 instances of 3 kinds, ")
    assert repr(scene.cameras[0]).startswith("DepthImage(")


@needs_open3d
def test_flaws_leave_the_parts_where_they_are(scene, coarse):
    np.testing.assert_array_equal(scene.poses, coarse.poses)
    np.testing.assert_array_equal(scene.kinds, coarse.kinds)
    assert sorted(scene.kinds) == 3 * [0] + 3 * [1] + 4 * [2]
    poses, visibility = scene.of_kind(2)
    np.testing.assert_array_equal(poses, scene.poses[scene.kinds == 2])
    np.testing.assert_array_equal(visibility, scene.visibility[scene.kinds == 2])


def in_pieces(mesh):
    """The convex pieces that a bracket, a bolt or a clip is joined of, as outward planes (n, 4)."""
    points, faces = mesh
    group = np.arange(len(points))
    for _ in range(len(points)):
        lowest = group[faces].min(axis=1)
        np.minimum.at(group, faces.ravel(), np.repeat(lowest, 3))
    planes = []
    for first in np.unique(group):
        a, b, c = (points[faces[group[faces[:, 0]] == first][:, i]] for i in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        planes.append(np.column_stack([normal, -np.sum(normal * a, axis=1)]))
    return planes


def depth_inside(planes, points):
    """How deep points lie within a union of convex pieces; 0 outside."""
    of_pieces = [-(points @ of[:, :3].T + of[:, 3]).max(axis=1) for of in planes]
    return np.maximum(np.max(of_pieces, axis=0), 0)


@needs_open3d
@pytest.mark.parametrize("layers", [0.6, 1.5])
def test_parts_rest_and_do_not_run_into_one_another(layers):
    scene = synth.bin_scene(MESHES, seed=5, num_instances=5, layers=layers, pixel=2)
    size = np.mean([diameter(mesh) for mesh in MESHES])
    samples = [features.sample_mesh(*mesh, n=4000)[0] for mesh in MESHES]
    planes = [in_pieces(mesh) for mesh in MESHES]
    bin_from_target = np.linalg.inv(scene.target_from_bin)
    placed = [move(pose, samples[kind]) for pose, kind in zip(scene.poses, scene.kinds, strict=True)]
    inner = [move(bin_from_target, points) for points in placed]
    for k, points in enumerate(inner):
        assert np.abs(points[:, :2]).max(axis=0).tolist() < (scene.size[:2] / 2 + 1e-9).tolist()
        assert points[:, 2].min() > -1e-6 * size
        others = [i for i in range(len(inner)) if i != k]
        gap = min(points[:, 2].min(), *(cKDTree(inner[i]).query(points)[0].min() for i in others))
        assert gap < 0.04 * size
        back = np.linalg.inv(scene.poses[k])
        deepest = max(depth_inside(planes[scene.kinds[k]], move(back, placed[i])).max() for i in others)
        assert deepest < 0.015 * size


@needs_open3d
def test_what_tips_over_lies_lower_than_what_stays_as_it_fell(monkeypatch):
    def heights(scene):
        planes = scene.poses[:, :3, 3] @ scene.floor[:3] + scene.floor[3]
        return planes.mean()

    tipped = [
        heights(synth.bin_scene(MESHES[:1], seed=s, flat=0, num_instances=8, pixel=3)) for s in range(3)
    ]
    monkeypatch.setattr(bins, "_TRIES", 0)
    stiff = [heights(synth.bin_scene(MESHES[:1], seed=s, flat=0, num_instances=8, pixel=3)) for s in range(3)]
    assert np.mean(tipped) < np.mean(stiff)


@needs_open3d
@pytest.mark.parametrize("name", ["plate-a", "bracket-a", "bolt-b", "pin-a"])
def test_stable_turns_stand_and_are_as_often_as_their_facets_are_wide(name):
    mesh = synth.part_mesh(name)
    turns, weights = bins.stable_turns(mesh)
    np.testing.assert_allclose(
        turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turns.shape), atol=1e-9
    )
    assert weights.sum() == pytest.approx(1)
    centre = bins.center_of_mass(mesh)
    for turn in turns:
        stood = (mesh[0] - centre) @ turn.T
        feet = stood[stood[:, 2] < stood[:, 2].min() + 1e-6 * diameter(mesh)][:, :2]
        # Whichever way it leans, some foot is on that side of the centre of mass.
        lean = np.stack([np.cos(np.linspace(0, 6.2, 60)), np.sin(np.linspace(0, 6.2, 60))])
        assert (feet @ lean).max(axis=0).min() > -1e-6 * diameter(mesh)
    if name == "plate-a":
        rng = np.random.default_rng(0)
        way = rng.normal(size=(200_000, 3))
        through = np.argmin(np.array([30, 20, 2]) / np.abs(way), axis=1)
        up = np.abs(turns[:, 2])
        for axis in range(3):
            mine = weights[np.argmax(up, axis=1) == axis]
            assert mine.sum() == pytest.approx(np.mean(through == axis), abs=0.005)


def test_the_centre_of_mass_of_what_is_not_closed_is_its_middle():
    sheet = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
    np.testing.assert_allclose(bins.center_of_mass(sheet), [0.5, 0.5, 0])
    np.testing.assert_allclose(bins.center_of_mass(synth.part_mesh("cube-a")), [15, 15, 15])


# What is seen ---------------------------------------------------------------------------------------------


@needs_open3d
def test_depths_are_those_of_a_naive_ray_cast(coarse):
    (image,) = coarse.cameras
    surround = bins.walls(
        coarse.size, 0.05 * np.mean([diameter(mesh) for mesh in MESHES]), 10 * coarse.size.max()
    )
    meshes = [*instances(coarse), (move(coarse.target_from_bin, surround[0]), surround[1])]
    depth, owner = naive_cast(meshes, pixel_rays(image))
    owner = np.where(owner == len(meshes) - 1, -1, owner)
    assert np.isfinite(image.depth).all()
    same = owner == image.labels.ravel()
    assert same.mean() > 0.995  # a ray that grazes an edge may fall to either side in single precision
    off = np.abs(depth - image.depth.ravel())[same]
    assert np.quantile(off, 0.995) < 1e-4 * coarse.voxel * 24


@needs_open3d
def test_visibility_is_a_naive_count(coarse):
    (image,) = coarse.cameras
    rays, meshes = pixel_rays(image), instances(coarse)
    for k, mesh in enumerate(meshes):
        alone = np.isfinite(naive_cast([mesh], rays)[0]).sum()
        assert coarse.visibility[k] == pytest.approx((image.labels == k).sum() / alone, abs=2 / alone)


@needs_open3d
def test_images_are_the_points(scene):
    (image,) = scene.cameras
    np.testing.assert_array_equal(image.points, scene.points)
    np.testing.assert_array_equal(image.grid[np.isfinite(image.depth)], scene.points)
    np.testing.assert_array_equal(image.labels[np.isfinite(image.depth)], scene.labels)
    assert (image.labels[np.isnan(image.depth)] == -1).all()
    view = ibi.View.from_depth(
        image.depth, image.fx, image.fy, image.cx, image.cy, target_from_camera=image.target_from_camera
    )
    np.testing.assert_allclose(view.points, scene.points, atol=1e-9)
    np.testing.assert_array_equal(view.eye, image.eye)
    footprint = np.median(scene.points[scene.labels >= 0, 2]) / image.fx / scene.voxel
    assert footprint == pytest.approx(0.3, rel=0.15)


@needs_open3d
@pytest.mark.parametrize("num_cameras", [2, 4])
def test_several_cameras_see_one_bin(num_cameras):
    scene = synth.bin_scene(MESHES, seed=3, num_instances=3, num_cameras=num_cameras, **EXACT, pixel=0.8)
    one = synth.bin_scene(MESHES, seed=3, num_instances=3, **EXACT, pixel=0.8)
    np.testing.assert_array_equal(scene.poses, one.poses)
    np.testing.assert_array_equal(scene.cameras[0].depth, one.cameras[0].depth)
    assert scene.eyes.shape == (num_cameras, 3)
    assert len(scene.points) == len(scene.labels) == sum(len(image.points) for image in scene.cameras)
    size = scene.voxel * 24
    for k, (points, triangles) in enumerate(instances(scene)):
        surface = o3d.t.geometry.RaycastingScene()
        surface.add_triangles(
            o3d.core.Tensor(points.astype(np.float32)), o3d.core.Tensor(triangles.astype(np.uint32))
        )
        own = scene.points[scene.labels == k].astype(np.float32)
        if len(own):
            assert surface.compute_distance(own).numpy().max() < 1e-4 * size
    on_floor = np.abs(scene.points @ scene.floor[:3] + scene.floor[3]) < 1e-4 * size
    assert on_floor[scene.labels < 0].any()
    # Each camera looks down, and they stand around the bin.
    assert (scene.eyes @ scene.floor[:3] + scene.floor[3] > scene.size[2]).all()


@needs_open3d
def test_table_and_walls_are_in_the_image(scene):
    height = scene.points @ scene.floor[:3] + scene.floor[3]
    inside = scene.is_inside(scene.points)
    assert inside[scene.labels >= 0].mean() > 0.98
    assert (~inside & (height < 0)).mean() > 0.1
    on_rim = ~inside & (np.abs(height - scene.size[2]) < scene.voxel) & (scene.labels < 0)
    assert on_rim.sum() > 50
    assert not scene.is_inside(scene.points, margin=scene.size.max()).any()


# Flaws of a camera ----------------------------------------------------------------------------------------

SHAPE = (200, 300)


def flat(depth=2.0, slant=1.0):
    return Sight(
        np.full(SHAPE, depth), np.zeros(SHAPE, np.int64), np.full(SHAPE, slant), np.zeros(SHAPE, bool)
    )


def rng():
    return np.random.default_rng(7)


def test_noise_grows_with_the_square_of_the_depth_and_is_shared_by_neighbours():
    flaws = Flaws(0.01, 0, 0, 0, at=2.0, jump=0.1)
    for depth in (1.0, 2.0, 4.0):
        measured, _ = spoilt(flat(depth), flaws, rng())
        off = measured - depth
        assert off.std() == pytest.approx(0.01 * (depth / 2) ** 2, rel=0.05)
        assert off.mean() == pytest.approx(0, abs=0.1 * off.std())
        beside, far = (np.corrcoef(off[:, :-n].ravel(), off[:, n:].ravel())[0, 1] for n in (1, 30))
        assert beside == pytest.approx(0.5 * np.exp(-1 / 16), abs=0.05)
        assert abs(far) < 0.05


def test_depths_have_even_steps_of_disparity():
    flaws = Flaws(0.05, 0.02, 0, 0, at=2.0, jump=9.0)
    measured, _ = spoilt(flat(), flaws, rng())
    steps = 1 / measured / (0.02 / 2.0**2)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert 5 < len(np.unique(measured)) < 40


def test_pixels_beside_a_step_are_smeared_and_no_others():
    seen = flat()
    seen.depth[:, 150:] = 3.0
    seen.owner[:, 150:] = 1
    measured, owner = spoilt(seen, Flaws(0, 0, 0.4, 0, at=2.0, jump=0.1), rng())
    between = (measured != 2.0) & (measured != 3.0)
    assert not between[:, :149].any()
    assert not between[:, 151:].any()
    # One of four neighbours is across the step.
    assert between[:, 149:151].mean() == pytest.approx(0.4 / 4, abs=0.05)
    assert ((measured[between] > 2) & (measured[between] < 3)).all()
    np.testing.assert_array_equal(owner == -1, between)


def test_slanting_shaded_and_stray_pixels_are_lost():
    flaws = Flaws(0, 0, 0, 1.0, at=2.0, jump=0.1)

    def lost(seen, flaws=flaws):
        measured, owner = spoilt(seen, flaws, rng())
        np.testing.assert_array_equal(owner == -1, np.isnan(measured))
        return np.isnan(measured)

    assert lost(flat()).mean() == pytest.approx(0.005, abs=0.002)
    assert lost(flat(slant=np.cos(np.radians(70)))).mean() == pytest.approx(0.005, abs=0.002)
    half = np.cos(np.radians(75)) / 2
    assert lost(flat(slant=half)).mean() == pytest.approx(0.5, abs=0.02)
    shaded = flat()
    shaded.in_shadow[:, :100] = True
    assert lost(shaded)[:, :100].all()
    assert lost(shaded)[:, 100:].mean() < 0.01
    assert not lost(shaded, flaws._replace(dropout=0.0)).any()


def test_without_flaws_nothing_is_spoilt():
    seen = flat()
    seen.depth[:50] = np.inf
    seen.owner[:50] = -1
    measured, owner = spoilt(seen, Flaws(0, 0, 0, 0, at=2.0, jump=0.1), rng())
    np.testing.assert_array_equal(measured, np.where(np.isfinite(seen.depth), seen.depth, np.nan))
    np.testing.assert_array_equal(owner, seen.owner)


@needs_open3d
def test_the_far_side_of_a_step_is_in_the_shadow_of_the_second_eye():
    block, floor = solids.box([-10, -10, 40], [10, 10, 60]), solids.box([-300, -300, 100], [300, 300, 110])
    from ibi_rs.synth.camera import pinhole, sight
    from ibi_rs.synth.casting import Solids

    rays = pinhole((101, 101), 100.0, 100.0, 50.0, 50.0)
    seen = sight(Solids([block, floor]), np.eye(4), rays)
    # The second eye is on the right: it does not see the floor on the left of the block.
    row = seen.in_shadow[50]
    left = np.flatnonzero(seen.owner[50] == 0)[0]
    assert row[left - 3 : left].all()
    assert not row[: left // 2].any()
    assert not row[left:].any()


# Rows -----------------------------------------------------------------------------------------------------


@needs_open3d
@pytest.mark.parametrize("gap", [0.0, 1.0, 10.0])
def test_rows_have_the_gap(gap):
    mesh = synth.part_mesh("carton-a")
    scene = synth.row_scene(mesh, seed=2, gap=gap, rows=2, columns=3, pixel=1)
    back = np.linalg.inv(scene.target_from_bin)
    corners = [move(back @ pose, mesh[0]) for pose in scene.poses]
    low, high = (np.array([getattr(of, way)(axis=0) for of in corners]).round(6) for way in ("min", "max"))
    np.testing.assert_allclose(low[:, 2], 0, atol=1e-6)
    for axis, count in ((0, 3), (1, 2)):
        starts, ends = np.unique(low[:, axis]), np.unique(high[:, axis])
        assert len(starts) == len(ends) == count
        np.testing.assert_allclose(starts[1:] - ends[:-1], gap, atol=1e-5)
        np.testing.assert_allclose(
            [starts[0] - gap, ends[-1] + gap], np.array([-1, 1]) * scene.size[axis] / 2, atol=1e-5
        )
    assert (scene.visibility > 0.5).all()


@needs_open3d
def test_places_of_a_row_can_be_empty_and_the_seed_makes_it():
    mesh = synth.part_mesh("carton-b")
    one, again, other = (synth.row_scene(mesh, seed=s, num_empty=5, pixel=1) for s in (1, 1, 2))
    assert one.poses.shape == (7, 4, 4)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(one, name), getattr(again, name))
    assert not np.array_equal(one.poses, other.poses)


def test_the_turns_of_a_cube_are_all_different_rotations():
    turns = bins._cube_turns()
    assert len({tuple(turn.ravel()) for turn in turns}) == 24
    np.testing.assert_array_equal(np.linalg.det(turns).round(9), 1)
    assert len({tuple(turn.T[2]) for turn in turns[::4]}) >= 1
    assert len({tuple(turn[2]) for turn in turns[::4]}) == 6


# Input ----------------------------------------------------------------------------------------------------


@needs_open3d
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"meshes": []}, "at least one"),
        ({"num_instances": 0}, "num_instances must be at least 1"),
        ({"num_instances": -1}, "num_instances must be at least 1"),
        ({"layers": 0}, "layers above 0"),
        ({"flat": 1.5}, "flat must be within"),
        ({"tilt_deg": (30, 10)}, "tilt_deg must be a range"),
        ({"num_cameras": 0}, "num_cameras must be at least 1"),
        ({"pixel": 0}, "pixel above 0"),
        ({"noise": -1}, "noise and quantum"),
        ({"quantum": -1}, "noise and quantum"),
        ({"smear": 2}, "smear and dropout"),
        ({"dropout": -0.1}, "smear and dropout"),
        ({"meshes": [(np.ones((3, 3)), [[0, 1, 2]])]}, "no extent"),
        ({"meshes": [(np.eye(3), [[0, 1, 5]])]}, "faces must be rows"),
    ],
)
def test_bad_bins_are_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        synth.bin_scene(**{"meshes": MESHES, "seed": 0, **change})


@needs_open3d
@pytest.mark.parametrize(
    ("change", "message"),
    [({"gap": -1}, "gap at least 0"), ({"rows": 0}, "rows and columns"), ({"num_empty": 12}, "num_empty")],
)
def test_bad_rows_are_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        synth.row_scene(MESHES[0], seed=0, **change)


def test_without_open3d_the_message_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    for make in (lambda: synth.bin_scene(MESHES, seed=0), lambda: synth.row_scene(MESHES[0], seed=0)):
        with pytest.raises(ImportError, match=r"Bins need Open3D: pip install 'ibi_rs\[open3d\]'"):
            make()
