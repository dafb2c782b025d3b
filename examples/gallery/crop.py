"""A part of a scan: what lies outside is not searched, and still tells where there is nothing."""

import ibi_rs as ibi

part = ibi.Model.from_mesh(*ibi.io.read_mesh("examples/tee/model_tee_mesh.ply"))
scan = ibi.io.read_scan("examples/tee/tee6.ply")
left = ibi.Box.between([-0.2, -0.15, 0.6], [-0.02, 0.15, 0.8])
found = part.detect(scan.points, viewpoint=[0, 0, 0], roi=left)
title = f"left of -0.02 m: {len(found)} tees"
ibi.plot.instances(scan.points, part.points, found, "docs/images/gallery/crop.png", title=title, unit="m")
