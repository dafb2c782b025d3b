"""The paper's own figures, as it prints them, for the column beside ours.

Cao et al., "Instance by Instance": its tables, on its 623 synthetic and 173 real scenes, which cannot be had,
on hardware it does not name. They are nobody's measurement here.
"""

from __future__ import annotations

from typing import NamedTuple


class Cited(NamedTuple):
    """Scores in percent and seconds; None where the paper has none."""

    mhr: float | None = None
    mhp: float | None = None
    mhf1: float | None = None
    seconds: float | None = None


def _mhf1(values: dict[str, float]) -> dict[str, Cited]:
    return {name: Cited(mhf1=value) for name, value in values.items()}


def _timed(values: dict[str, tuple[float, float]]) -> dict[str, Cited]:
    return {name: Cited(mhf1=mhf1, seconds=seconds) for name, (mhf1, seconds) in values.items()}


def _by_band(rows: dict[str, tuple[float, ...]]) -> dict[str, dict[str, Cited]]:
    bands = ("10-50", "50-70", "70-90", "90-99")
    return {
        f"outlier-{band}": {name: Cited(mhf1=values[i]) for name, values in rows.items() if i < len(values)}
        for i, band in enumerate(bands)
    }


IBI = {"synthetic": Cited(61.16, 71.20, 63.82, 6.28), "real": Cited(50.31, 36.30, 39.39, 7.56)}

CITED: dict[str, dict[str, dict[str, Cited]]] = {
    "main": {
        "synthetic": {
            "paper_synthetic": IBI["synthetic"],
            "ECC": Cited(53.39, 61.44, 51.80, 1.28),
            "T-Linkage": Cited(0.19, 0.54, 0.27, 43.46),
            "Progressive-X": Cited(15.90, 31.01, 18.98, 86.39),
            "CONSAC": Cited(0.10, 0.07, 0.08, 7.65),
            "PointCLM": Cited(0.62, 0.18, 0.28, 0.50),
        },
        "real": {
            "paper_real": IBI["real"],
            "ECC": Cited(31.63, 29.23, 27.04, 1.46),
            "T-Linkage": Cited(2.46, 3.79, 2.71, 1655),
            "Progressive-X": Cited(11.58, 6.86, 7.87, 26.32),
            "CONSAC": Cited(2.66, 0.35, 0.62, 21.35),
            "PointCLM": Cited(1.78, 0.73, 1.04, 0.19),
        },
    },
    "modules": {
        "synthetic": {
            "paper preset": IBI["synthetic"],
            **_timed(
                {
                    "SCS nnsr": (11.50, 7.56),
                    "SCS hough3d": (52.51, 66.65),
                    "CE off": (26.53, 0.38),
                    "TE ransac": (59.69, 0.63),
                    "TE sac_cot": (60.68, 304.75),
                    "TE mac": (60.00, 12.04),
                    "HV none": (32.51, 6.35),
                    "HV inlier_count": (54.32, 7.51),
                }
            ),
        },
        "real": {
            "paper preset": IBI["real"],
            **_timed(
                {
                    "SCS nnsr": (28.55, 6.41),
                    "SCS hough3d": (29.69, 46.23),
                    "CE off": (17.62, 0.30),
                    "TE ransac": (26.17, 0.52),
                    "TE sac_cot": (41.28, 291.53),
                    "TE mac": (40.28, 22.46),
                    "HV none": (15.94, 3.80),
                    "HV inlier_count": (48.54, 6.47),
                }
            ),
        },
    },
    "validation": {
        "synthetic": _mhf1(
            {
                "none, t_s 5": 32.68,
                "none, t_s 10": 32.03,
                "none, t_s 15": 31.33,
                "inlier_count 50": 32.03,
                "inlier_count 100": 30.56,
                "inlier_count 150": 23.56,
                "overlap 0.8": 61.55,
                "overlap 0.85": 63.82,
                "overlap 0.9": 64.35,
            }
        )
    },
    "density": {
        "synthetic": _mhf1(
            {
                "N_downsample 256": 9.69,
                "N_downsample 512": 63.42,
                "N_downsample 1024": 63.82,
                "N_downsample 2048": 60.32,
                "N_downsample 5096": 54.14,
                "ECC, 512 samples": 51.26,
                "ECC, 1024 samples": 51.80,
                "ECC, 2048 samples": 50.41,
            }
        ),
        "real": _mhf1(
            {
                "N_downsample 256": 32.43,
                "N_downsample 512": 35.98,
                "N_downsample 1024": 39.39,
                "N_downsample 2048": 40.50,
                "N_downsample 5096": 40.30,
            }
        ),
    },
    # Its lists begin with all inliers, and its program reads the first 1024 rows.
    "outliers": _by_band(
        {"paper_synthetic": (92.36, 91.30, 90.25, 88.51), "ECC": (29.70, 27.87, 22.99)},
    ),
    "ppf": {
        "synthetic": _mhf1({"PPF (Drost)": 5.34, "PPF (central voting)": 3.15}),
        "real": _mhf1({"PPF (Drost)": 1.64, "PPF (central voting)": 0.40}),
    },
}
"""By table, by kind of data, by row."""
