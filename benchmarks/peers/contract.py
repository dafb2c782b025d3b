"""The contract of a peer."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

from frame.runs import Register
from frame.runs import spacing as model_spacing
from frame.timing import CORES
from ibi_rs import synth

__all__ = ["CORES", "Method", "Missing", "Register", "model_spacing"]


class Missing(Exception):
    """A peer cannot run here; the message says why."""


@dataclass(frozen=True)
class Method:
    """One row of the table.

    Attributes
    ----------
    module : module
        The peer's, with `version` and `prepare`.
    threads : int
        How many it may use.
    fixed : dict
        Settings that tell this row from others of the same peer.
    needs_normals : bool
        Whether it makes sense only in layouts with normals.
    """

    module: ModuleType
    threads: int = CORES
    fixed: dict[str, object] | None = None
    needs_normals: bool = False

    def prepare(self, scene: synth.Scene, settings: dict[str, object]) -> Register:
        """Prepare for the model of a scene."""
        register: Register = self.module.prepare(scene, **{**settings, **(self.fixed or {})})
        return register
