"""Torch and JAX on whatever there is: devices, dtypes, and a torchvision that does not match."""

from __future__ import annotations

import importlib.util
import sys
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base.config import DType
from vlagents_ray.registry import require

_kept: list[Any] = []  # operators live as long as the object that defined them


def torch_device(name: str = "auto") -> Any:
    """The `torch.device` of that name; "auto" takes CUDA if there is one. `ConfigError` if it is not there."""
    torch = require("torch")
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(
            f"device {name!r}: not here ({str(error).splitlines()[0]}); use 'auto' or 'cpu', or give the "
            f"replica a GPU with resources: {{num_gpus: 1}}"
        ) from error
    return device


def torch_dtype(name: DType, device: Any, preferred: str = "bfloat16") -> Any:
    """The `torch.dtype` of that name; "auto": `preferred` on an accelerator, float32 on a CPU."""
    torch = require("torch")
    usual = "float32" if device.type == "cpu" else preferred
    return getattr(torch, usual if name == "auto" else name)


def jax_device(name: str = "auto") -> Any:
    """The JAX device of that name; "auto" takes the first there is. `ConfigError` if it is not there."""
    jax = require("jax")
    if name == "auto":
        return jax.devices()[0]
    kind, _, index = name.partition(":")
    try:
        return jax.devices(kind)[int(index or 0)]
    except (RuntimeError, IndexError, ValueError) as error:
        raise ConfigError(
            f"device {name!r}: not here, JAX sees {jax.devices()}; use 'auto' or 'cpu', or install the jaxlib of your "
            f"accelerator and give the replica a GPU with resources: {{num_gpus: 1}}"
        ) from error


def ensure_torchvision() -> None:
    """Make torchvision importable beside a CPU-only torch, for which there is no build of it.

    Its compiled operators are missing then. Two of them are only looked up on import, so that declaring them is
    enough for transforms and models; calling them still fails, as it must.
    """
    if "torchvision" in sys.modules or importlib.util.find_spec("torchvision") is None:
        return
    torch = require("torch")
    try:
        importlib.import_module("torchvision")
    except RuntimeError as error:
        if "torchvision::" not in str(error) or torch.cuda.is_available():
            raise
    else:
        return
    for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
        del sys.modules[name]
    library = torch.library.Library("torchvision", "FRAGMENT")
    for operator in ("nms", "qnms"):
        library.define(f"{operator}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    _kept.append(library)
    importlib.import_module("torchvision")
