"""What was rejected: poses that fit the matches and were contradicted by a closer look."""

import ibi_rs as ibi
import numpy as np

mesh = ibi.io.read_mesh("examples/bin/bracket.stl")
camera = ibi.io.read_camera("examples/bin/camera.json")
intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
points = ibi.io.read_depth("examples/bin/depth.png", *intrinsics, scale=0.1)
part = ibi.Model.from_mesh(*mesh)
rejected = part.detect(points, viewpoint=[0, 0, 0]).rejected[:10]
poses = np.array([one.target_from_source for one in rejected])
title = f"rejected, the first {len(poses)}: " + ", ".join(sorted({one.objection for one in rejected}))
ibi.plot.instances(points, part.points, poses, "docs/images/gallery/rejected.png", title=title, unit="mm")
