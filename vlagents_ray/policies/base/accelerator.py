"""Devices, dtypes and errors of torch and JAX, and the fix for a torchvision that does not match torch."""

from __future__ import annotations

import gc
import importlib
import importlib.util
import os
import re
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base import import_fixes
from vlagents_ray.policies.base.config import DType
from vlagents_ray.policies.compilation import keep_jax_programs
from vlagents_ray.policies.loading import report_device
from vlagents_ray.registry import require

VISIBLE = "CUDA_VISIBLE_DEVICES"  # Ray sets it in a process that it gives GPUs

_DRIVER = Path("/proc/driver/nvidia/version")
# Texts of errors of torch and of JAX, whose classes differ between their versions.
_EXHAUSTED = re.compile(r"out of memory|ALLOC_FAILED|OUT_OF_MEMORY|RESOURCE_EXHAUSTED", re.IGNORECASE)
_GPU_ERROR = re.compile(r"CUDA error|CUDA_ERROR_|CUDNN_STATUS_|CUBLAS_STATUS_|HIP error")


def torch_device(name: str = "auto") -> Any:
    """Return the `torch.device` of a name; "auto" takes a CPU only where no GPU is meant; raises `ConfigError`."""
    torch = require("torch")
    given = name == "auto" and bool(_given_gpus())
    try:
        device = torch.device(("cuda" if given or torch.cuda.is_available() else "cpu") if name == "auto" else name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        said = str(error).splitlines()[0]
        if given:
            raise _unusable(f"torch {torch.__version__}", said) from error
        raise ConfigError(
            f"device {name!r}: not here ({said}); use 'auto' or 'cpu', or give the replica a GPU with "
            f"resources: {{num_gpus: 1}}"
        ) from error
    report_device(_described(torch, device))
    return device


def _given_gpus() -> str:
    """Return the GPUs that this process was given; empty if none was."""
    named = os.environ.get(VISIBLE, "")
    return "" if named in ("-1", "NoDevFiles") else named


def _unusable(library: str, said: str) -> ConfigError:
    return ConfigError(
        f"device 'auto': this process was given GPU {_given_gpus()} ({VISIBLE}), which {library} cannot use: {said}; "
        f"install a build of it for the GPU and its driver, or set device: cpu with resources: {{num_gpus: 0}}"
    )


def _described(torch: Any, device: Any) -> dict[str, Any]:
    described = {"kind": device.type, "device": str(device), "torch": torch.__version__}
    if device.type != "cuda":
        return described
    properties = torch.cuda.get_device_properties(device)
    driver = None
    with suppress(OSError):
        driver = re.search(r"Kernel Module\s+(?:for \S+\s+)?([\d.]+)", _DRIVER.read_text())
    return described | {
        "name": properties.name,
        "memory_mib": properties.total_memory // 2**20,
        "cuda": torch.version.cuda or torch.version.hip,
        "driver": driver and driver[1],
    }


def torch_dtype(name: DType, device: Any, preferred: str = "bfloat16") -> Any:
    """Return the `torch.dtype` of a name; "auto" is `preferred` on an accelerator, float32 on a CPU."""
    torch = require("torch")
    usual = "float32" if device.type == "cpu" else preferred
    return getattr(torch, usual if name == "auto" else name)


def jax_device(name: str = "auto") -> Any:
    """Return the JAX device of a name; "auto" takes the first one, and a CPU only where no GPU is meant.

    Raises `ConfigError` for a missing device.

    From then on, the programs that JAX compiles for a device that is no CPU are kept for the next start.
    """
    jax = require("jax")
    kind, _, index = name.partition(":")
    try:
        device = jax.devices()[0] if name == "auto" else jax.devices(kind)[int(index or 0)]
        if name == "auto" and device.platform == "cpu" and _given_gpus():
            device = jax.devices("gpu")[0]
    except (RuntimeError, IndexError, ValueError) as error:
        if name == "auto":
            raise _unusable(f"jax {jax.__version__}", str(error).splitlines()[0]) from error
        raise ConfigError(
            f"device {name!r}: not here, JAX sees {jax.devices()}; use 'auto' or 'cpu', or install the jaxlib of your "
            f"accelerator and give the replica a GPU with resources: {{num_gpus: 1}}"
        ) from error
    keep_jax_programs(jax, device.platform)
    report_device({"kind": device.platform, "device": str(device), "name": device.device_kind, "jax": jax.__version__})
    return device


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error of torch or JAX says that the memory of an accelerator is exhausted."""
    return isinstance(error, RuntimeError) and bool(_EXHAUSTED.search(str(error)))


def is_device_failure(error: BaseException) -> bool:
    """Return whether an error says that an accelerator failed, other than for its memory.

    Such errors last: after an illegal access, or the loss of the device, each further call of the process fails.
    """
    return isinstance(error, RuntimeError) and bool(_GPU_ERROR.search(str(error))) and not is_out_of_memory(error)


def free_memory() -> None:
    """Free memory at once: agents often contain reference cycles, and torch caches the GPU memory that it allocated."""
    gc.collect()
    empty_cache()


def empty_cache() -> None:
    """Return the GPU memory that torch does not use to the device, for other processes; JAX keeps its own."""
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_initialized():
        torch.cuda.empty_cache()


def ensure_torchvision() -> None:
    """Make torchvision importable beside a CPU-only torch, for which PyPI has no build of it."""
    import_fixes.install()
    if importlib.util.find_spec("torchvision") is not None:
        importlib.import_module("torchvision")
