"""Matches of your own: 20 instances, three in four matches wrong."""

import ibi_rs as ibi

scene = ibi.synth.outlier_layout(seed=7, num_instances=20, num_correspondences=5000)
found = ibi.register(scene.src, scene.tgt, scene.corr)
right = ibi.metrics.score_scene(found, scene.poses).num_predicted_hit
title = f"{scene.inlier_ratio():.0%} of {len(scene.corr)} matches right; {len(found)} found, {right} right"
ibi.plot.instances(scene.tgt, scene.src, found, "docs/images/gallery/matches.png", title=title)
