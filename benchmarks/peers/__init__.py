"""Other programs that find poses, each in a file of its own, behind one contract; see benchmarks/compare.py.

A peer's module has two functions:

``version() -> str``
    The peer's version; raises `Missing` with the reason where the peer cannot run.
``prepare(scene, **settings) -> register``
    What a user does once for a model, such as training a detector; not timed. ``register(scene)`` is timed
    and gives the poses found, (K, 4, 4) target_from_source, best first. All that depends on the scene is in
    there: trees, normals, conversions, checks. Settings that are lengths end in ``_pr`` and are multiples of
    the model's spacing.

`METHODS` lists what is run; `settings` holds how. CONSAC and PointCLM need weights, which are not here: their
files say what the weights have to be and where their path is looked for.
"""

from .contract import Method, Missing, Register
from .methods import METHODS, available

__all__ = ["METHODS", "Method", "Missing", "Register", "available"]
