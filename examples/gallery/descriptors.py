"""Descriptors of your own: the nearest in their space are joined, four for each point of the scene."""

import ibi_rs as ibi

scene = ibi.synth.outlier_layout(seed=1, num_instances=3, num_correspondences=600)
clouds = scene.src, scene.tgt
mine = [ibi.features.fpfh(xyz, ibi.features.estimate_normals(xyz, 0.3), 0.5, 60) for xyz in clouds]
corr, similarity = ibi.match(*mine, k=4)
found = ibi.register(*clouds, corr, similarity=similarity)
title = f"{len(corr)} matches of descriptors; {len(found)} found"
ibi.plot.instances(scene.tgt, scene.src, found, "docs/images/gallery/descriptors.png", title=title)
