"""Two kinds of parts, looked for together: their poses compete for what was measured."""

import ibi_rs as ibi

meshes = {"specimen": "examples/provete2/model_provete2_mesh.ply", "tee": "examples/tee/model_tee_mesh.ply"}
parts = ibi.Models({name: ibi.io.read_mesh(path) for name, path in meshes.items()})
scan = ibi.io.read_scan("examples/provete2/two.ply")
found = parts.detect(scan.points, viewpoint=[0, 0, 0])
title = ", ".join(f"{len(found.of(name))} of the kind {name}" for name in parts.names)
mine = [pose.target_from_source for pose in found.of("specimen")]
ibi.plot.instances(
    scan.points, parts["specimen"].points, mine, "docs/images/gallery/two_kinds.png", title=title
)
