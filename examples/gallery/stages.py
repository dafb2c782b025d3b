"""Stages are swapped by name: three ways to estimate a pose, on the same matches."""

import ibi_rs as ibi

scene = ibi.synth.outlier_layout(seed=3, num_instances=6, num_correspondences=2000)
for_each = {name: ibi.Params(te=name) for name in ("gsac", "irls", "mac")}
found = {name: ibi.register(scene.src, scene.tgt, scene.corr, of) for name, of in for_each.items()}
title = "; ".join(f"{name}: {len(of)} of 6 in {len(of.rounds)} rounds" for name, of in found.items())
ibi.plot.instances(scene.tgt, scene.src, found["mac"], "docs/images/gallery/stages.png", title=title)
