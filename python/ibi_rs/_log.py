"""What runs tell the standard `logging`: the logger `ibi_rs`, which is silent until somebody listens."""

from __future__ import annotations

import logging
from dataclasses import asdict
from typing import TYPE_CHECKING

from ibi_rs._numbers import significant

if TYPE_CHECKING:
    from ibi_rs.registration import Registration

LOGGER = logging.getLogger("ibi_rs")
LOGGER.addHandler(logging.NullHandler())


def ended(what: str, of: str, found: Registration) -> None:
    """Tell what went in and came out, what is doubtful, and, if it is asked for, where the time went."""
    for warning in found.warnings:
        LOGGER.warning("%s: %s", what, warning)
    if not LOGGER.isEnabledFor(logging.INFO):
        return
    sizes = f"{of}; resolution {significant(found.resolution)}"
    counts = f"{len(found)} found, {len(found.rejected)} rejected in {len(found.rounds)} rounds"
    text = "%s: %s; %s, %.3f s; stopped by %s"
    LOGGER.info(text, what, sizes, counts, found.timings.total_s, found.stop_reason)
    if not LOGGER.isEnabledFor(logging.DEBUG):
        return
    steps = {name.removesuffix("_s"): value for name, value in asdict(found.timings).items()}
    LOGGER.debug("%s: %s", what, ", ".join(f"{name} {value:.3f} s" for name, value in steps.items()))
    for number, pose in enumerate(found):
        name = "" if pose.model_name is None else f" {pose.model_name}"
        measured = f"score {pose.score:.3f}, overlap {pose.overlap:.3f}, inliers {pose.num_inliers}"
        LOGGER.debug("%s: pose %d%s of round %d: %s", what, number, name, pose.round, measured)
    for other in found.rejected:
        text = "%s: rejected of round %d: %s, score %.3f"
        LOGGER.debug(text, what, other.round, other.objection, other.score)
