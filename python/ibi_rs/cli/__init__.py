"""The command `ibi`. Needs typer, rich and the readers: ``pip install 'ibi_rs[cli]'``."""

from .terminal import FOUND_NOTHING, INTERRUPTED, TERMINATED, app

# Each adds itself to `app`, and stands in the help, in this order.
from . import register, batch, bop, evaluate, bench, doctor  # isort: skip

__all__ = [
    "FOUND_NOTHING",
    "INTERRUPTED",
    "TERMINATED",
    "app",
    "batch",
    "bench",
    "bop",
    "doctor",
    "evaluate",
    "register",
]
