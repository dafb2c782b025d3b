"""The ECC layout: the paper preset with either payoff, on 16 seeded scenes. Prints a table, records scenes.

    python benchmarks/ecc_layout.py            # or: make tables

Shapes are the meshes of examples/models without symmetry, which a rotation error cannot score
(benchmarks/symmetry.py says which). Metric: one to one, 20 degrees, 0.5 radii. Means over the scenes and over
four seeds of the sampler, whose draws alone move the mean of 16 scenes by a few points.
"""

from __future__ import annotations

import csv
import json
import os
import platform
from pathlib import Path

import ibi_rs as ibi
import numpy as np
from ibi_rs import metrics, synth

ROOT = Path(__file__).parents[1]
MODELS = ROOT / "examples/models"
SCENES = range(16)
SAMPLER_SEEDS = range(4)

ROWS = {
    "paper_synthetic, t_he 3 pr, gaussian": ibi.Params.paper_synthetic().replace(t_he_pr=3),
    "paper_synthetic, t_he 3 pr, ratio": ibi.Params.paper_synthetic().replace(
        t_he_pr=3, scs=ibi.Gtm(payoff="ratio")
    ),
    "paper_synthetic, gaussian": ibi.Params.paper_synthetic(),
    "paper_synthetic, ratio": ibi.Params.paper_synthetic().replace(scs=ibi.Gtm(payoff="ratio")),
}


def shapes() -> dict[str, tuple[np.ndarray, np.ndarray | None]]:
    """Dense clouds of the meshes without symmetry."""
    entries = json.loads((MODELS / "index.json").read_text(encoding="utf-8"))
    files = sorted(entry["file"] for entry in entries if not entry["symmetric"])
    return {file: synth.sample_mesh(MODELS / file, 10_000, np.random.default_rng(0)) for file in files}


def main() -> None:
    """Run, print, record."""
    clouds = shapes()
    scenes = [synth.ecc_layout(seed, shapes=clouds) for seed in SCENES]
    k = np.mean([scene.num_instances for scene in scenes])
    inliers = np.mean([scene.inlier_ratio() for scene in scenes])
    print(f"{len(scenes)} scenes of {len(clouds)} shapes, K {k:.1f}, inliers {inliers:.1%}")
    print(f"{os.cpu_count()} cores, {platform.machine()}")
    print(f"{'preset':40s}  MHR   MHP   MHF1  +-    ms")
    record = ROOT / "benchmarks/records/ecc_layout.csv"
    with record.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["version", "params", "sampler_seed", "scene", "K", "recall", "precision", "f1"])
        for name, params in ROWS.items():
            means, seconds = [], []
            for sampler_seed in SAMPLER_SEEDS:
                scores = []
                for scene in scenes:
                    found = ibi.register(scene.src, scene.tgt, scene.corr, params.replace(seed=sampler_seed))
                    score = metrics.score_scene(found, scene.poses)
                    seconds.append(found.timings.total_s)
                    scores.append(score)
                    rates = [f"{rate:.4f}" for rate in (score.recall, score.precision, score.f1)]
                    out.writerow(
                        [ibi.__version__, name, sampler_seed, scene.name, scene.num_instances, *rates]
                    )
                means.append(metrics.mean_score(scores))
            mhr, mhp, mhf1 = (np.mean([getattr(m, key) for m in means]) for key in ("mhr", "mhp", "mhf1"))
            spread = np.std([m.mhf1 for m in means])
            ms = 1e3 * np.median(seconds)
            print(f"{name:40s}  {mhr:.3f} {mhp:.3f} {mhf1:.3f} {spread:.3f} {ms:4.0f}", flush=True)
    print(f"per scene: {record.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
