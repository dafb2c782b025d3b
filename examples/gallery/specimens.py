"""Test specimens one on the other, in a real scan."""

import ibi_rs as ibi

part = ibi.Model.from_mesh(*ibi.io.read_mesh("examples/provete2/model_provete2_mesh.ply"))
scan = ibi.io.read_scan("examples/provete2/multi.ply")
found = part.detect(scan.points, viewpoint=[0, 0, 0])
title = f"{len(found)} specimens in a real scan"
ibi.plot.instances(scan.points, part.points, found, "docs/images/gallery/specimens.png", title=title)
