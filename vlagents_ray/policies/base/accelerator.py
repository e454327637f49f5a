"""Devices and dtypes of torch and JAX, and the fix for a torchvision that does not match torch."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base import import_fixes
from vlagents_ray.policies.base.config import DType
from vlagents_ray.policies.compilation.kept_programs import keep_jax_programs
from vlagents_ray.registry import require


def torch_device(name: str = "auto") -> Any:
    """Return the `torch.device` of a name; "auto" takes CUDA if available.

    Raises `ConfigError` for a missing device.
    """
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
    """Return the `torch.dtype` of a name; "auto" is `preferred` on an accelerator, float32 on a CPU."""
    torch = require("torch")
    usual = "float32" if device.type == "cpu" else preferred
    return getattr(torch, usual if name == "auto" else name)


def jax_device(name: str = "auto") -> Any:
    """Return the JAX device of a name; "auto" takes the first one; raises `ConfigError` for a missing device.

    From then on, the programs that JAX compiles for a device that is no CPU are kept for the next start.
    """
    jax = require("jax")
    kind, _, index = name.partition(":")
    try:
        device = jax.devices()[0] if name == "auto" else jax.devices(kind)[int(index or 0)]
    except (RuntimeError, IndexError, ValueError) as error:
        raise ConfigError(
            f"device {name!r}: not here, JAX sees {jax.devices()}; use 'auto' or 'cpu', or install the jaxlib of your "
            f"accelerator and give the replica a GPU with resources: {{num_gpus: 1}}"
        ) from error
    keep_jax_programs(jax, device.platform)
    return device


def ensure_torchvision() -> None:
    """Make torchvision importable beside a CPU-only torch, for which PyPI has no build of it."""
    import_fixes.install()
    if importlib.util.find_spec("torchvision") is not None:
        importlib.import_module("torchvision")
