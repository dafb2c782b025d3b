"""One part to pick: the one that lies most open among those that are sure."""

import ibi_rs as ibi
import numpy as np

part = ibi.Model.from_mesh(*ibi.io.read_mesh("examples/tee/model_tee_mesh.ply"))
scan = ibi.io.read_scan("examples/tee/tee6.ply")
sure = part.detect(scan.points, viewpoint=[0, 0, 0]).at_least(0.7)
first = max(sure, key=lambda pose: pose.overlap)
poses, title = np.array([first.target_from_source]), f"to be picked first: overlap {first.overlap:.2f}"
ibi.plot.instances(scan.points, part.points, poses, "docs/images/gallery/first_pick.png", title=title)
