"""How each peer is set, by the family of layouts, and what its settings were chosen from.

Chosen with ``python benchmarks/compare.py --tune``, on the tuning half: the best MHF1, among equals the
fastest. Lengths in ``_pr`` are multiples of the model's spacing. What a parameter means: the peer's file.
"""

from __future__ import annotations

from typing import Any

FAMILIES = ("outlier", "ecc", "fpfh")
"""A layout belongs to the family that its name begins with."""

SETTINGS: dict[str, dict[str, dict[str, Any]]] = {
    "PCL GC": {
        "outlier": {"size_pr": 1.0, "threshold": 24, "refit": True},
        "ecc": {"size_pr": 0.3, "threshold": 8, "refit": True},
        "fpfh": {"size_pr": 2.0, "threshold": 8, "refit": True},
    },
    "PCL GC + check": {
        "outlier": {"size_pr": 1.5, "threshold": 16, "refit": True, "least": 0.6},
        "ecc": {"size_pr": 2.0, "threshold": 6, "refit": True, "least": 0.7},
        "fpfh": {"size_pr": 1.5, "threshold": 4, "refit": True, "least": 0.3},
    },
    "PCL Hough3D": {
        "outlier": {"bin_pr": 8.0, "threshold": 4.0, "frame_pr": 6.0, "neighbors": 24, "refit": True},
        "ecc": {"bin_pr": 4.0, "threshold": 8.0, "frame_pr": 4.0, "neighbors": 24, "refit": True},
        "fpfh": {"bin_pr": 8.0, "threshold": 12.0, "frame_pr": 12.0, "neighbors": 12, "refit": True},
    },
    "PCL Hough3D + check": {
        "outlier": {
            "bin_pr": 8.0, "threshold": 2.0, "frame_pr": 4.0, "neighbors": 12, "refit": True, "least": 0.4,
        },
        "ecc": {
            "bin_pr": 3.0, "threshold": 4.0, "frame_pr": 9.0, "neighbors": 24, "refit": True, "least": 0.6,
        },
        "fpfh": {
            "bin_pr": 12.0, "threshold": 6.0, "frame_pr": 4.0, "neighbors": 12, "refit": True, "least": 0.3,
        },
    },
    "Open3D RANSAC, sequence": {
        "outlier": {
            "inlier_pr": 2.5, "iterations": 100_000, "confidence": 0.999, "edge": 0.8,
            "least": 0.4, "failures": 3,
        },
        "ecc": {
            "inlier_pr": 1.5, "iterations": 100_000, "confidence": 0.999, "edge": 0.8,
            "least": 0.3, "failures": 3,
        },
        "fpfh": {
            "inlier_pr": 1.0, "iterations": 100_000, "confidence": 0.999, "edge": 0.9,
            "least": 0.3, "failures": 3,
        },
    },
    "KISS-Matcher, sequence": {
        "outlier": {"noise_pr": 1.0, "solver_gain": 0.75, "inlier_pr": 3.0, "least": 0.4, "failures": 3},
        "ecc": {"noise_pr": 0.5, "solver_gain": 0.5, "inlier_pr": 1.5, "least": 0.5, "failures": 10},
        "fpfh": {"noise_pr": 1.5, "solver_gain": 1.0, "inlier_pr": 3.0, "least": 0.3, "failures": 3},
    },
    "OpenCV PPF + check": {
        "outlier": {
            "model_step": 0.02, "scene_step": 0.02, "every": 1, "neighbors": 24,
            "candidates": 400, "least": 0.4,
        },
        "ecc": {
            "model_step": 0.05, "scene_step": 0.02, "every": 5, "neighbors": 12,
            "candidates": 100, "least": 0.6,
        },
        "fpfh": {
            "model_step": 0.03, "scene_step": 0.02, "every": 1, "neighbors": 12,
            "candidates": 400, "least": 0.5,
        },
    },
    "ECC": {
        "outlier": {"samples": 1024, "inlier": 0.3, "t_merge": 0.4, "t_count": 0.5, "min_members": 10},
        "ecc": {"samples": 1024, "inlier": 0.15, "t_merge": 0.2, "t_count": 0.5, "min_members": 10},
        "fpfh": {"samples": 1024, "inlier": 0.3, "t_merge": 0.4, "t_count": 0.5, "min_members": 10},
    },
    "T-Linkage": {
        "outlier": {"tau_pr": 0.3, "least": 4, "neighbors": 64},
        "ecc": {"tau_pr": 0.2, "least": 6, "neighbors": 64},
        "fpfh": {"tau_pr": 0.5, "least": 5, "neighbors": None},
    },
    "Progressive-X": {
        "outlier": {"inlier_pr": 2.5, "least": 24, "neighbors": 32},
        "ecc": {"inlier_pr": 1.0, "least": 32, "neighbors": 32},
        "fpfh": {"inlier_pr": 2.5, "least": 16, "neighbors": 128},
    },
}  # fmt: skip

SWEEP: dict[str, dict[str, list[Any]]] = {
    "PCL GC": {
        "size_pr": [0.3, 0.5, 1.0, 1.5, 2.0, 3.0], "threshold": [4, 6, 8, 12, 16, 24, 32],
        "refit": [False, True],
    },
    "PCL GC + check": {
        "size_pr": [0.3, 0.5, 1.0, 1.5, 2.0, 3.0], "least": [0.2, 0.3, 0.4, 0.5, 0.6, 0.7],
        "threshold": [3, 4, 6, 8, 12, 16, 24], "refit": [False, True],
    },
    "PCL Hough3D": {
        "frame_pr": [4.0, 6.0, 9.0, 12.0], "bin_pr": [3.0, 4.0, 6.0, 8.0, 12.0],
        "threshold": [4.0, 6.0, 8.0, 12.0], "neighbors": [12, 24], "refit": [False, True],
    },
    "PCL Hough3D + check": {
        "frame_pr": [4.0, 6.0, 9.0, 12.0], "bin_pr": [2.0, 3.0, 4.0, 6.0, 8.0, 12.0],
        "threshold": [2.0, 3.0, 4.0, 6.0], "least": [0.3, 0.4, 0.5, 0.6], "neighbors": [12, 24],
        "refit": [False, True],
    },
    "Open3D RANSAC, sequence": {
        "inlier_pr": [1.0, 1.5, 2.5], "edge": [0.8, 0.9, 0.95], "least": [0.3, 0.4, 0.5, 0.6],
        "failures": [3, 10],
    },
    "KISS-Matcher, sequence": {
        "noise_pr": [0.25, 0.5, 1.0, 1.5, 2.0, 3.0], "inlier_pr": [1.0, 1.5, 3.0],
        "least": [0.2, 0.3, 0.4, 0.5, 0.6], "failures": [3, 10, 20], "solver_gain": [0.5, 0.75, 1.0],
    },
    "OpenCV PPF + check": {
        "model_step": [0.02, 0.03, 0.05], "scene_step": [0.02, 0.03, 0.05], "least": [0.3, 0.4, 0.5, 0.6],
        "every": [1, 2, 5], "candidates": [100, 400], "neighbors": [12, 24],
    },
    # The number of samples is the paper's: 2048 cost six times as much, and seldom pay.
    "ECC": {
        "inlier": [0.1, 0.15, 0.2, 0.3], "t_merge": [0.1, 0.2, 0.4, 0.6],
        "t_count": [0.1, 0.2, 0.3, 0.5, 0.7], "min_members": [5, 10, 20],
    },
    # The number of samples is ECC's.
    "T-Linkage": {
        "tau_pr": [0.1, 0.2, 0.3, 0.5], "least": [4, 5, 6, 8, 12], "neighbors": [16, 32, 64, None],
    },
    "Progressive-X": {
        "inlier_pr": [0.5, 1.0, 1.5, 2.5], "least": [16, 24, 32], "neighbors": [32, 64, 128],
    },
}  # fmt: skip


def family(layout: str) -> str:
    """Return the family of a layout."""
    return next(name for name in FAMILIES if layout.startswith(name))


def settings(method: str, layout: str) -> dict[str, Any]:
    """Return the settings of a method; ours has none."""
    return SETTINGS[method][family(layout)] if method in SETTINGS else {}


def table() -> str:
    """Return all settings as the Markdown table of docs/peers.md."""
    lines = [f"| method | {' | '.join(f'`{name}`' for name in FAMILIES)} |", "|---|---|---|---|"]
    for method, by_family in SETTINGS.items():
        cells = [", ".join(f"{key} {value}" for key, value in by_family[f].items()) for f in FAMILIES]
        lines.append(f"| {method} | {' | '.join(cells)} |")
    return "\n".join(lines)
