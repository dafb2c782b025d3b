"""Weights of a network that the user has and this repository has not."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .contract import Missing

Network = Callable[[NDArray[np.float32]], NDArray[np.float64]]


def find(name: str, variable: str, checkpoint: str | None = None) -> Path:
    """Path of a network's checkpoint; raises `Missing` where there is none or nothing to load it with."""
    path = checkpoint or os.environ.get(variable)
    if not path:
        raise Missing(f"no weights of {name}; set {variable} to a TorchScript file, see benchmarks/peers")
    if not Path(path).is_file():
        raise Missing(f"{variable}: there is no file {path}")
    try:
        import torch  # noqa: F401
    except ImportError as error:
        raise Missing(f"{name} needs PyTorch: {error}") from error
    return Path(path)


def load(path: Path) -> Network:
    """Load a TorchScript module that takes (n, d) float32 and gives an array with n rows."""
    import torch

    module = torch.jit.load(str(path), map_location="cpu").eval()

    def network(features: NDArray[np.float32]) -> NDArray[np.float64]:
        with torch.inference_mode():
            out: Any = module(torch.from_numpy(np.ascontiguousarray(features, dtype=np.float32)))
        return np.asarray(out.numpy(), dtype=np.float64)

    return network
