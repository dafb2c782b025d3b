"""`ibi doctor`: what is installed, and what the machine has."""

from __future__ import annotations

import os
import platform
import re
import sys
from importlib import metadata
from typing import Any

import numpy as np

import ibi_rs as ibi
from ibi_rs import _batch, _core

from .terminal import command, out

EXTRAS = {
    "open3d": ("open3d",),
    "plot": ("matplotlib", "plotly"),
    "io": ("trimesh", "mapbox-earcut", "pypcd4", "laspy", "pillow"),
    "cli": ("typer", "rich"),
    "dask": ("distributed",),
    "ray": ("ray",),
    "viz": ("rerun-sdk",),
}
"""The packages that each extra of `pyproject.toml` brings."""


@command()
def doctor() -> None:
    """Print versions, cores, SIMD level and what is installed: for reports of what is wrong."""
    threads = os.environ.get("IBI_NUM_THREADS")
    limit = f", IBI_NUM_THREADS={threads}" if threads else ""
    rows = [
        ("ibi_rs", f"{ibi.__version__}  {_core.__file__}"),
        ("Python", f"{platform.python_version()}  {sys.executable}"),
        ("numpy", np.__version__),
        ("machine", f"{platform.system()} {platform.release()}, {platform.machine()}"),
        ("cores", f"{_batch._cores()} of {os.cpu_count()}{limit}"),
        ("SIMD", simd()),
    ]
    for extra, packages in EXTRAS.items():
        found = {name: _version(name) for name in packages}
        texts = [f"{name} {version}" if version else f"no {name}" for name, version in found.items()]
        more = "" if all(found.values()) else f"  (pip install 'ibi_rs[{extra}]')"
        rows.append((extra, ", ".join(texts) + more))
    for name, text in rows:
        out.print(f"{name:8} {text}", highlight=False, markup=False, soft_wrap=True)


def simd() -> str:
    """Name the widest vectors that the core uses here."""
    if not re.fullmatch(r"x86_64|amd64", platform.machine().lower()):
        return "as the compiler makes it"
    module: Any = getattr(np, "_core", None) or np.core
    has = module._multiarray_umath.__cpu_features__
    if all(has.get(name) for name in ("AVX512F", "AVX512CD", "AVX512_SKX")):
        return "AVX-512 (x86-64-v4)"
    return "AVX2 (x86-64-v3)" if has.get("AVX2") and has.get("FMA3") else "SSE2: without AVX2 it is slower"


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
