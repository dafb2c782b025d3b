"""Tiny data sets in the formats of others, made when a test asks for them."""

import json
from functools import lru_cache
from pathlib import Path

import ibi_rs as ibi
import numpy as np
from ibi_rs.synth.scene import move
from PIL import Image

FOCAL, SHAPE = 200.0, (120, 160)
SAMPLES = {}
TEE = Path(__file__).parents[1] / "examples/tee/model_tee_mesh.ply"
BOX = (
    np.array([[x, y, z] for x in (-30, 30) for y in (-20, 20) for z in (-10, 10)], float),
    np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6],
         [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    ),
)  # fmt: skip


@lru_cache
def tee():
    """The tee in millimetres, its box about the origin."""
    vertices, faces = ibi.io.read_mesh(TEE)
    vertices = 1000 * vertices
    return vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2, faces


def pose(seed, x, y, z):
    """Turned at random, at a place."""
    turn, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    made = np.eye(4)
    made[:3, :3] = turn * np.sign(np.linalg.det(turn))
    made[:3, 3] = x, y, z
    return made


def sampled(mesh):
    """Points all over a mesh, about a millimetre apart."""
    key = mesh[0].tobytes()
    if key not in SAMPLES:
        SAMPLES[key] = ibi.features.sample_mesh(*mesh, n=20_000)[0]
    return SAMPLES[key]


def depth(meshes, poses):
    """Depth along z of what a camera at the origin sees, millimetres; 0 where that is nothing."""
    image = np.full(SHAPE, np.inf)
    for mesh, place in zip(meshes, poses, strict=True):
        points = move(place, sampled(mesh))
        u = np.rint(points[:, 0] / points[:, 2] * FOCAL + SHAPE[1] / 2).astype(int)
        v = np.rint(points[:, 1] / points[:, 2] * FOCAL + SHAPE[0] / 2).astype(int)
        is_in = (u >= 0) & (u < SHAPE[1]) & (v >= 0) & (v < SHAPE[0])
        np.minimum.at(image, (v[is_in], u[is_in]), points[is_in, 2])
    return np.where(np.isfinite(image), image, 0)


def write_ply(path, vertices, faces):
    path.parent.mkdir(parents=True, exist_ok=True)
    head = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [" ".join(f"{x:.6g}" for x in row) for row in vertices] + [f"3 {a} {b} {c}" for a, b, c in faces]
    path.write_text(head + "\n".join(rows) + "\n", encoding="utf-8")


def write_json(path, held):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(held), encoding="utf-8")


def write_depth(path, image, scale):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.rint(image / scale).astype(np.uint16)).save(path)


LENS = [FOCAL, 0, SHAPE[1] / 2, 0, FOCAL, SHAPE[0] / 2, 0, 0, 1]

PLACES = {  # of each image: object, pose, visible share
    (1, 3): [(1, pose(0, -60, -20, 400), 0.9), (1, pose(1, 50, -30, 380), 0.8), (5, pose(2, 0, 50, 420), 1)],
    (1, 4): [(1, pose(3, 0, 0, 350), 1.0), (1, pose(4, 200, 200, 400), 0.05)],
    (2, 0): [(5, pose(5, 10, -10, 350), 1.0)],
}


def bop(root, *, scale=0.1, cameras=("",), split="test", targets="bop19"):
    """Three images of tees (1) and boxes (5); every camera but the first stands 100 mm to the right."""
    meshes = {1: tee(), 5: BOX}
    info = {}
    for number, mesh in meshes.items():
        write_ply(root / f"models/obj_{number:06d}.ply", *mesh)
        info[str(number)] = {"diameter": ibi.metrics.diameter(mesh[0])}
    info["1"] |= ibi.find_symmetries(sampled(tee())).to_bop()
    info["5"]["symmetries_discrete"] = [
        np.diag(turn).ravel().tolist() for turn in ([1, -1, -1, 1], [-1, 1, -1, 1], [-1, -1, 1, 1])
    ]
    write_json(root / "models/models_info.json", info)
    for scene_id in {one for one, _ in PLACES}:
        images = {im_id: held for (one, im_id), held in PLACES.items() if one == scene_id}
        folder = root / split / f"{scene_id:06d}"
        for number, camera in enumerate(cameras):
            camera_from_world = np.eye(4)
            camera_from_world[0, 3] = -100.0 * (number > 0)
            entry = {"cam_K": LENS, "depth_scale": scale}
            if len(cameras) > 1:
                entry["cam_R_w2c"] = np.eye(3).ravel().tolist()
                entry["cam_t_w2c"] = camera_from_world[:3, 3].tolist()
            write_json(folder / f"scene_camera{camera}.json", {str(i): entry for i in images})
            truth, seen = {}, {}
            for im_id, held in images.items():
                poses = [camera_from_world @ place for _, place, _ in held]
                image = depth([meshes[of] for of, _, _ in held], poses)
                write_depth(folder / f"depth{camera}" / f"{im_id:06d}.png", image, scale)
                truth[str(im_id)] = [
                    {
                        "obj_id": of,
                        "cam_R_m2c": one[:3, :3].ravel().tolist(),
                        "cam_t_m2c": one[:3, 3].tolist(),
                    }
                    for (of, _, _), one in zip(held, poses, strict=True)
                ]
                seen[str(im_id)] = [{"visib_fract": share} for _, _, share in held]
            write_json(folder / f"scene_gt{camera}.json", truth)
            write_json(folder / f"scene_gt_info{camera}.json", seen)
    if targets == "bop19":
        listed = []
        for (i, j), held in PLACES.items():
            for of in {one for one, _, _ in held}:
                count = sum(one == of and share > 0.1 for one, _, share in held)
                listed.append({"scene_id": i, "im_id": j, "obj_id": of, "inst_count": count})
    else:
        listed = [{"scene_id": i, "im_id": j} for i, j in PLACES]
    write_json(root / f"test_targets_{targets}.json", listed)
    return root


def trs(translation=(0, 0, 0), rotation=(1, 0, 0, 0), scale=(1, 1, 1)):
    return {"translation": list(translation), "rotation": list(rotation), "scale": list(scale)}


def scan2cad(root):
    """A room with three copies of one model, of which one has another scale, and one of another model."""
    half = np.sqrt(0.5)
    copies = [
        trs((1, 0, 0), scale=(2, 1, 1)),
        trs((0, 2, 0), (half, 0, half, 0), scale=(2.1, 1, 1)),
        trs((0, 0, 3), scale=(2, 2, 1)),
    ]
    models = [
        {"catid_cad": "0300", "id_cad": "abc", "sym": "__SYM_ROTATE_UP_4", "trs": one} for one in copies
    ]
    models.append({"catid_cad": "0400", "id_cad": "def", "sym": "__SYM_NONE", "trs": trs()})
    # From scan to world: a quarter turn about z, a shift.
    room = {"id_scan": "scene0000_00", "trs": trs((0, 0, -1), (half, 0, 0, half)), "aligned_models": models}
    write_json(root / "full_annotations.json", [room])
    vertices, faces = BOX[0] / 100, BOX[1]
    write_ply(root / "scannet/scans/scene0000_00/scene0000_00_vh_clean_2.ply", vertices, faces)
    model = root / "shapenet/0300/abc/models/model_normalized.obj"
    model.parent.mkdir(parents=True)
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    model.write_text("\n".join(lines), encoding="utf-8")
    return root


def modelnet(root):
    """A chair in two files, one with its counts behind the word OFF, as some have them."""
    rows = [f"{x} {y} {z}" for x, y, z in BOX[0] + 7] + [f"3 {a} {b} {c}" for a, b, c in BOX[1]]
    for split, name, head in (("test", "chair_0002", "OFF\n8 12 0"), ("test", "chair_0001", "OFF8 12 0")):
        path = root / "chair" / split / f"{name}.off"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    return root


def robi(root):
    """One scene of two tees, seen from two places."""
    world = [pose(0, -40, 0, 400), pose(1, 50, -10, 380)]
    write_ply(root / "cad/Tee.ply", *tee())
    lens = "".join(
        f"{name}: {x}\n" for name, x in zip(("fx", "fy", "cx", "cy"), (FOCAL, FOCAL, 80.0, 60.0), strict=True)
    )
    (root / "cam").mkdir()
    (root / "cam/Ensenso_DEPTH.yml").write_text(f"depth_unit: 0.03125\nwidth: 160\n{lens}", encoding="utf-8")
    write_json(
        root / "Tee/Scene_1/GT_world2obj.json", {str(k): one.ravel().tolist() for k, one in enumerate(world)}
    )
    for view, shift in ((0, 0.0), (10, 30.0)):
        eye = np.eye(4)
        eye[0, 3] = shift
        image = depth([tee()] * 2, [np.linalg.inv(eye) @ one for one in world])
        path = root / f"Tee/Scene_1/Ensenso/Depth/DEPTH_view_{view}.png"
        write_depth(path, image, 0.03125)
        write_json(path.with_suffix(".json"), {"cam_pose": eye.ravel().tolist()})
    return root
