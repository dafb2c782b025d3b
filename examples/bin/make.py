"""Make this folder's depth image, camera and part: a seeded bin of `ibi.synth`. Needs Open3D.

python examples/bin/make.py
"""

import json
from pathlib import Path

import ibi_rs as ibi
import numpy as np
import trimesh
from PIL import Image

FOLDER = Path(__file__).parent

vertices, faces = ibi.synth.part_mesh("bracket-a")
scene = ibi.synth.bin_scene([(vertices, faces)], seed=5, num_instances=12, layers=0.8, pixel=0.45)
camera = scene.cameras[0]
trimesh.Trimesh(vertices, faces, process=False).export(FOLDER / "bracket.stl")
steps = np.nan_to_num(camera.depth / 0.1).round().astype(np.uint16)  # of 0.1 mm; 0: nothing measured
Image.fromarray(steps).save(FOLDER / "depth.png")
numbers = {name: round(getattr(camera, name), 4) for name in ("fx", "fy", "cx", "cy")}
(FOLDER / "camera.json").write_text(json.dumps(numbers | {"depth_scale": 0.1}, indent=1) + "\n")
in_sight = scene.visibility > 0.5
truth = {"unit": "mm", "poses": scene.poses[in_sight].round(9).tolist()}
(FOLDER / "truth.json").write_text(json.dumps(truth) + "\n")
