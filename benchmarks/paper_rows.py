"""The rows of the paper's tables: what is run on which data, and what the paper prints there.

A row is parameters of ours, or a peer with its settings, or the reason why neither is here. Synthetic data
are run with `Params.paper_synthetic`, scans with `Params.paper_real`, and one thing changed in each row.

The paper's own figures, for the column beside ours, are in paper_figures.csv: Cao et al., "Instance by
Instance", on its 623 synthetic and 173 real scenes, which cannot be had, on hardware it does not name. They
are nobody's measurement here. (Its lists for the table of outliers begin with all inliers, and its program
reads the first 1024 rows.)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import ibi_rs as ibi
from frame import records
from frame.layouts import NO_NORMALS

SCANS, SHIPPED = "scans", "shipped scans"
BANDS = ("outlier-10-50", "outlier-50-70", "outlier-70-90", "outlier-90-99")


@dataclass(frozen=True)
class Row:
    """One row of a table.

    Attributes
    ----------
    name : str
        As printed, and the key of the paper's figures.
    params : ibi_rs.Params or None
        Ours.
    peer : str or None
        Name in `peers.METHODS`.
    change : dict or None
        Settings of the peer that differ from those it has for this kind of data.
    missing : str
        Why it cannot be run; empty if it can.
    order : str
        What is done to the list of correspondences before; see `reorder` in paper_tables.py.
    loop : str
        Not the library but benchmarks/paper_loop.py: "random" or "first" players, and "alone" if the seeds
        vote on them alone, with commas between.
    """

    name: str
    params: ibi.Params | None = None
    peer: str | None = None
    change: dict[str, Any] | None = None
    missing: str = ""
    order: str = ""
    loop: str = ""


@dataclass(frozen=True)
class Table:
    """One table of the paper.

    Attributes
    ----------
    title : str
        What it asks, and where the paper has it.
    data : tuple of str
        Layouts, `SCANS`, `SHIPPED`; each is a block of its own.
    rows : callable
        Gives the rows for a kind of data.
    timed : bool
        Whether its seconds are of interest: then one process runs all.
    scenes : int or None
        So many scenes at most, where a row is slow.
    """

    title: str
    data: tuple[str, ...]
    rows: Callable[[str], Iterator[Row]]
    timed: bool = True
    scenes: int | None = None


def is_real(data: str) -> bool:
    """Whether data are scans."""
    return data in (SCANS, SHIPPED)


def paper(data: str) -> ibi.Params:
    """Return the paper's preset for a kind of data."""
    return ibi.Params.paper_real() if is_real(data) else ibi.Params.paper_synthetic()


def main_rows(data: str) -> Iterator[Row]:
    """All presets of ours, and the peers."""
    yield Row("default", ibi.Params())
    if is_real(data):
        yield Row("default, no normals", *NO_NORMALS.values())
        yield Row("single_view", ibi.Params.single_view())
    yield Row("paper_synthetic", ibi.Params.paper_synthetic())
    yield Row("paper_synthetic, t_he 3 pr", ibi.Params.paper_synthetic().replace(t_he_pr=3))
    yield Row("paper_real", ibi.Params.paper_real())
    peers = ("ECC", "PCL GC + check", "Open3D RANSAC, sequence", "OpenCV PPF + check")
    for name in (*peers, "T-Linkage", "Progressive-X", "CONSAC", "PointCLM"):
        yield Row(name, peer=name)


def module_rows(data: str) -> Iterator[Row]:
    """Swap one module."""
    base = paper(data)
    yield Row("paper preset", base)
    variants = {
        "scs": (ibi.Nnsr(), ibi.Hough3d()),
        "ce": (ibi.Off(),),
        "te": (ibi.Ransac(), ibi.SacCot(), ibi.Mac()),
        "hv": (ibi.None_(), ibi.InlierCount()),
    }
    for stage, others in variants.items():
        for other in others:
            yield Row(f"{stage.upper()} {other.variant}", base.replace(**{stage: other}))


def validation_rows(data: str) -> Iterator[Row]:
    """Thresholds of the validation."""
    base = paper(data)
    for t_s in (5, 10, 15):
        yield Row(f"none, t_s {t_s}", base.replace(hv=ibi.None_(), t_s=t_s))
    for count in (50, 100, 150):
        yield Row(f"inlier_count {count}", base.replace(hv=ibi.InlierCount(t_inliers=count)))
    for share in (0.8, 0.85, 0.9):
        yield Row(f"overlap {share:g}", base.replace(hv=ibi.Overlap(t_overlap=share)))


def density_rows(data: str) -> Iterator[Row]:
    """How many correspondences play."""
    for count in (256, 512, 1024, 2048, 5096):
        yield Row(f"N_downsample {count}", _with(paper(data), scs={"n_downsample": count}))
    for count in (512, 1024, 2048):
        yield Row(f"ECC, {count} samples", peer="ECC", change={"samples": count})


def outlier_rows(data: str) -> Iterator[Row]:
    """Share of outliers."""
    del data
    yield Row("default", ibi.Params())
    yield Row("paper_synthetic", ibi.Params.paper_synthetic())
    yield Row("ECC", peer="ECC")
    yield Row("PCL GC + check", peer="PCL GC + check")


def ppf_rows(data: str) -> Iterator[Row]:
    """Point pair features, as they are and with the overlap check of the peers."""
    del data
    name = "OpenCV PPF + check"
    yield Row("PPF (Drost)", peer=name, change={"candidates": 10, "least": None})
    yield Row("PPF (Drost) + check", peer=name)
    yield Row("PPF (central voting)", missing="no free program")


def reason_rows(data: str) -> Iterator[Row]:
    """Experiments: why ours differs from the paper's figures, or from what it claims."""
    yield from {"ecc": _ecc_reasons, "outlier": _outlier_reasons}.get(data.split("-")[0], _scan_reasons)()


def _ecc_reasons() -> Iterator[Row]:
    base = ibi.Params.paper_synthetic()
    yield Row("paper_synthetic", base)
    yield Row("naive twin", base, loop="random")
    yield Row(
        "players from the head of the list, by target point", base, loop="first", order="by target point"
    )
    for count in (256, 512, 1024):
        of_count = _with(base, scs={"n_downsample": count})
        yield Row(f"{count} players, who alone are voted on", of_count, loop="random, alone")
    for count in (256, 512, 1024):
        yield Row(f"list cut to {count}", base, order=f"first {count}")
    for count in (20, 50):
        counted = base.replace(hv=ibi.InlierCount(t_inliers=count), t_he_pr=1)
        yield Row(f"inlier_count {count}, t_he 1 pr", counted)
    for name in ("T-Linkage", "Progressive-X"):
        as_drawn = f"{name}, triplets as drawn"
        yield Row(as_drawn, peer=name, change={"rigid": False})
        yield Row(f"{as_drawn}, from anywhere", peer=name, change={"rigid": False, "neighbors": None})
    yield Row("ECC, settings of its paper", peer="ECC", change={"inlier": 0.3, "t_merge": 0.2})


def _outlier_reasons() -> Iterator[Row]:
    base = ibi.Params.paper_synthetic()
    inliers = base.replace(removal="inliers", max_rejections=60)
    yield Row("paper_synthetic", base)
    yield Row("removal inliers", inliers)
    for count in (50, 150):
        yield Row(f"N_vot {count}", _with(base, ce={"n_vot": count}))
    first = "inliers first, first 1024"
    yield Row("the first 1024, inliers first", base, order=first)
    yield Row("the first 1024, inliers first; removal inliers", inliers, order=first)
    yield Row("ECC, settings of its paper", peer="ECC", change={"inlier": 0.3, "t_merge": 0.2})


def _scan_reasons() -> Iterator[Row]:
    base = ibi.Params.paper_real()
    yield Row("paper_real", base)
    for share in (0.2, 0.3, 0.5):
        yield Row(f"t_overlap {share:g}", base.replace(hv=ibi.Overlap(t_overlap=share)))
    # Without validation: what was lost before it.
    free = base.replace(hv=ibi.None_())
    wide = free.replace(t_he_pr=3)
    few = _with(wide, ce={"n_vot": 50})
    yield Row("HV none", free)
    yield Row("HV none, t_he 3 pr", wide)
    yield Row("HV none, t_he 3 pr, N_vot 50", few)
    yield Row("the same, δ_r 2 pr, SCS local_gtm", few.replace(delta_r_pr=2, scs=ibi.LocalGtm()))


TABLES = {
    "main": Table("The main comparison (Tables 1 and 2)", ("ecc-0.02", "ecc-0.1", SCANS, SHIPPED), main_rows),
    "modules": Table(
        "One module swapped (Tables 6 and 7)", ("ecc-0.02", "ecc-0.1", SCANS, SHIPPED), module_rows
    ),
    "validation": Table(
        "Thresholds of the validation (Table 3)", ("ecc-0.02",), validation_rows, timed=False
    ),
    "density": Table(
        "Density of correspondences (Tables 4 and 5)", ("ecc-0.02", SCANS), density_rows, scenes=10
    ),
    "outliers": Table("Share of outliers (Table 8)", BANDS, outlier_rows, timed=False),
    # On the scans the detector is trained for minutes; the main comparison has it there.
    "ppf": Table("Point pair features (Tables 9 and 10)", ("ecc-0.02",), ppf_rows),
    "reasons": Table(
        "Why the figures differ",
        ("ecc-0.02", BANDS[0], BANDS[-1], SCANS),
        reason_rows,
        timed=False,
        scenes=10,
    ),
}
"""Every table by name."""

CURVES = {
    "n_gtm": ("scs", (5, 10, 20, 30, 40, 50)),
    "n_vot": ("ce", (50, 100, 200, 300, 400, 500, 600)),
    "n_gsac": ("te", (5, 10, 20, 50, 100, 200, 500)),
}
"""Robustness curves: of each parameter the stage and the values."""


def curve_rows(name: str, data: str) -> Iterator[Row]:
    """Return the points of one curve."""
    stage, values = CURVES[name]
    for value in values:
        yield Row(str(value), _with(paper(data), **{stage: {name: value}}))


ALL = TABLES | {
    name: Table(f"Robustness to {name}", ("ecc-0.02", SCANS), partial(curve_rows, name), timed=False)
    for name in CURVES
}
"""Tables and curves by name."""


def cited(table: str, data: str) -> dict[str, records.Row]:
    """Return the paper's figures for a kind of data, scores in percent, by row."""
    held = [row for row in FIGURES if row["table"] == table]
    exact = [row for row in held if row["data"] == data]
    kind = "real" if is_real(data) else "synthetic"
    return {row["row"]: row for row in exact or held if row["data"] in (data, kind)}


FIGURES = records.read(Path(__file__).parent / "paper_figures.csv")


def _with(params: ibi.Params, **stages: dict[str, Any]) -> ibi.Params:
    """Change parameters within stages."""
    return params.replace(**{stage: replace(getattr(params, stage), **of) for stage, of in stages.items()})
