"""Six tees on a table: from a mesh and a scan to poses."""

import ibi_rs as ibi

part = ibi.Model.from_mesh(*ibi.io.read_mesh("examples/tee/model_tee_mesh.ply"), symmetries="find")
scan = ibi.io.read_scan("examples/tee/tee6.ply")
found = part.detect(scan.points, viewpoint=[0, 0, 0])
title = f"{len(found)} tees in a real scan"
ibi.plot.instances(scan.points, part.points, found, "docs/images/gallery/tees.png", title=title, unit="m")
