"""Brackets in a bin: a depth image, its camera, and outlines of what was found."""

import ibi_rs as ibi

mesh = ibi.io.read_mesh("examples/bin/bracket.stl")
camera = ibi.io.read_camera("examples/bin/camera.json")
points = ibi.io.read_depth("examples/bin/depth.png", camera.fx, camera.fy, camera.cx, camera.cy, scale=0.1)
found = ibi.Model.from_mesh(*mesh).detect(points, viewpoint=[0, 0, 0])
title = f"{len(found)} brackets in a depth image"
ibi.plot.outlines(points, camera, mesh, found, "docs/images/gallery/bin.png", title=title, unit="mm")
