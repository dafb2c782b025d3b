"""The outlier layout: 5000 correspondences, 20 instances, by outlier ratio. Prints a table, records scenes.

    python benchmarks/outlier_layout.py            # or: make tables

Metric: one to one, 20 degrees, 0.5 radii. The time is the median over the scenes of a whole registration,
with as many threads as there are cores.
"""

from __future__ import annotations

import csv
import os
import platform
from pathlib import Path

import ibi_rs as ibi
import numpy as np
from ibi_rs import metrics, synth

ROOT = Path(__file__).parents[1]
SCENES = range(10)
# Above 0.95 there is no room for 10 true pairs for each of 20 instances.
BANDS = {"10-50 %": (0.1, 0.5), "50-70 %": (0.5, 0.7), "70-90 %": (0.7, 0.9), "90-95 %": (0.9, 0.95)}
ROWS = {
    "paper_synthetic, t_he 3 pr (default)": ibi.Params(),
    "paper_synthetic": ibi.Params.paper_synthetic(),
}


def main() -> None:
    """Run, print, record."""
    print(f"{len(SCENES)} scenes a band, {os.cpu_count()} cores, {platform.machine()}")
    print(f"{'preset':38s}  {'outliers':8s}   MHR   MHP   MHF1    ms")
    record = ROOT / "benchmarks/records/outlier_layout.csv"
    with record.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["version", "params", "outliers", "scene", "recall", "precision", "f1"])
        for name, params in ROWS.items():
            for band, outlier_ratio in BANDS.items():
                scores, seconds = [], []
                for seed in SCENES:
                    scene = synth.outlier_layout(
                        seed, outlier_ratio=outlier_ratio, num_instances=20, num_correspondences=5000
                    )
                    found = ibi.register(scene.src, scene.tgt, scene.corr, params)
                    score = metrics.score_scene(found, scene.poses)
                    scores.append(score)
                    seconds.append(found.timings.total_s)
                    rates = [f"{rate:.4f}" for rate in (score.recall, score.precision, score.f1)]
                    out.writerow([ibi.__version__, name, band, scene.name, *rates])
                mean = metrics.mean_score(scores)
                rates = f"{mean.mhr:.3f} {mean.mhp:.3f} {mean.mhf1:.3f}"
                print(f"{name:38s}  {band:8s}  {rates} {1e3 * np.median(seconds):5.0f}", flush=True)
    print(f"per scene: {record.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
