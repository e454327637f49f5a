"""Devices, dtypes and errors of torch and JAX, and the fix for a torchvision that does not match
torch.
"""

from __future__ import annotations

import gc
import importlib
import importlib.util
import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base import import_fixes
from vlagents_ray.policies.base.config import DType, Matmul
from vlagents_ray.policies.compilation import keep_jax_programs
from vlagents_ray.policies.loading import LoadingReport, report_device
from vlagents_ray.registry import require

VISIBLE = "CUDA_VISIBLE_DEVICES"  # Ray sets it in a process that it gives GPUs
# Share of its GPU's memory that a process may use; unset: all of it.
GPU_SHARE = "VLAGENTS_RAY_GPU_SHARE"

# The oldest driver for each major version of CUDA:
# https://docs.nvidia.com/deploy/cuda-compatibility/minor-version-compatibility.html
OLDEST_DRIVERS = {12: 525, 13: 580}
_DRIVER = Path("/proc/driver/nvidia/version")
# Texts of errors of torch, JAX and ONNX Runtime, whose classes differ between their versions.
_EXHAUSTED = re.compile(
    r"out of memory|ALLOC_FAILED|OUT_OF_MEMORY|RESOURCE_EXHAUSTED|Failed to allocate memory",
    re.IGNORECASE,
)
_GPU_ERROR = re.compile(
    r"CUDA error|CUDA_ERROR_|(?:CUDA|CUDNN|CUBLAS|CUFFT|HIP|MIOPEN|ROCBLAS) failure "
    r"\d|CUDNN_STATUS_|CUBLAS_STATUS_"
    r"|HIP error|DEVICE_RESET"
)


def torch_device(name: str = "auto") -> Any:
    """Return the `torch.device` of a name; "auto" takes a CPU only where no GPU is meant; raises
    `ConfigError`.
    """
    share = _limit_jax()
    torch = require("torch")
    given = name == "auto" and bool(_given_gpus())
    try:
        device = torch.device(
            ("cuda" if given or torch.cuda.is_available() else "cpu") if name == "auto" else name
        )
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        said = str(error).splitlines()[0]
        if given:
            raise _unusable(f"torch {torch.__version__}", said) from error
        raise ConfigError(
            f"device {name!r}: not here ({said}); use 'auto' or 'cpu', or give the replica a GPU "
            "with "
            f"resources: {{num_gpus: 1}}"
        ) from error
    described = {"kind": device.type, "device": str(device), "torch": torch.__version__}
    if device.type == "cuda":
        if share:
            torch.cuda.set_per_process_memory_fraction(share, device)
        properties = torch.cuda.get_device_properties(device)
        described |= {
            "name": properties.name,
            "memory_mib": properties.total_memory // 2**20,
            "cuda": torch.version.cuda or torch.version.hip,
            "driver": driver_version(),
        }
    report_device(described)
    return device


def _limit_jax() -> float:
    """Limit the memory of JAX, also beside torch, before its first use of a GPU; return this
    process's share, or 0.

    By itself JAX allocates three quarters of the memory at once.
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    if share := os.environ.get(GPU_SHARE, ""):
        os.environ.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", share)
    return float(share or 0)


def _given_gpus() -> str:
    """Return the GPUs that this process was given; empty if none was."""
    named = os.environ.get(VISIBLE, "")
    return "" if named in ("-1", "NoDevFiles") else named


def _unusable(library: str, said: str) -> ConfigError:
    return ConfigError(
        f"device 'auto': this process was given GPU {_given_gpus()} ({VISIBLE}), which {library} "
        f"cannot use: {said}; "
        "install a build of it for the GPU and its driver, or set device: cpu with resources: "
        f"{{num_gpus: 0}}"
    )


def driver_version() -> str | None:
    """Return the version of NVIDIA's driver, such as "580.65.06"; None if there is none, or it
    does not say.
    """
    with suppress(OSError):
        driver = re.search(r"Kernel Module\s+(?:for \S+\s+)?([\d.]+)", _DRIVER.read_text())
        return driver and driver[1]
    with suppress(OSError, subprocess.SubprocessError, IndexError):  # WSL2 has no such file
        command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
        return subprocess.run(  # noqa: S603
            command, capture_output=True, text=True, timeout=10, check=True
        ).stdout.split()[0]
    return None


def torch_dtype(name: DType, device: Any, preferred: str = "bfloat16") -> Any:
    """Return the `torch.dtype` of a name; "auto" is `preferred` on an accelerator, float32 on a
    CPU.
    """
    torch = require("torch")
    usual = "float32" if device.type == "cpu" else preferred
    return getattr(torch, usual if name == "auto" else name)


def jax_device(name: str = "auto") -> Any:
    """Return the JAX device of a name; "auto" takes the first one, and a CPU only where no GPU is
    meant.

    Raises `ConfigError` for a missing device.

    From then on, the programs that JAX compiles for a device that is no CPU are kept for the next
    start.
    """
    _limit_jax()
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
            f"device {name!r}: not here, JAX sees {jax.devices()}; use 'auto' or 'cpu', or install "
            "the jaxlib of your "
            f"accelerator and give the replica a GPU with resources: {{num_gpus: 1}}"
        ) from error
    keep_jax_programs(jax, device.platform)
    report_device(
        {
            "kind": device.platform,
            "device": str(device),
            "name": device.device_kind,
            "jax": jax.__version__,
        }
    )
    return device


def onnx_provider(name: str, matmul: Matmul) -> tuple[str, dict[str, str]]:
    """Return the provider of ONNX Runtime for a device, and its settings; "auto" as in
    `torch_device`.

    Raises `ConfigError` for a device that this ONNX Runtime was not built for.
    """
    runtime = require("onnxruntime")
    kind, _, index = name.partition(":")
    cuda = "CUDAExecutionProvider"
    there = cuda in runtime.get_available_providers()
    if name == "auto":
        kind = "cuda" if (there and driver_version()) or _given_gpus() else "cpu"
    if kind == "cpu":
        report_device({"kind": "cpu", "device": "cpu", "onnxruntime": runtime.__version__})
        return "CPUExecutionProvider", {}
    if kind != "cuda" or not there:
        raise ConfigError(
            f"device {name!r}: this onnxruntime offers {runtime.get_available_providers()}; "
            "replace it by "
            f"`pip uninstall onnxruntime && pip install onnxruntime-gpu`, or set device: cpu with "
            f"resources: {{num_gpus: 0}}"
        )
    device = {
        "kind": "cuda",
        "device": f"cuda:{index or 0}",
        "onnxruntime": runtime.__version__,
        "matmul": matmul,
    }
    report_device(device)
    return cuda, {"device_id": index or "0", "use_tf32": str(int(matmul == "high"))}


def set_matmul(precision: Matmul, device: dict[str, Any]) -> None:
    """Set, and add to the description of a GPU, the precision of float32 products and
    convolutions of this process.
    """
    if device["kind"] == "cpu" or "onnxruntime" in device:
        return
    if "jax" in device:
        named = {"high": "tensorfloat32", "highest": "float32"}[precision]
        require("jax").config.update("jax_default_matmul_precision", named)
    else:
        torch = require("torch")
        torch.set_float32_matmul_precision(precision)
        torch.backends.cudnn.allow_tf32 = precision == "high"
    device["matmul"] = precision


def fetch(tensor: Any) -> np.ndarray:
    """Return the values of a tensor as an array, after the work that computes them.

    Meanwhile other threads should use the GPU, to prepare the next batch or to load weights. During
    `Tensor.cpu`, whose copy is to pageable memory, each of their calls of CUDA waited for all of
    that work (torch 2.11, H200).
    """
    if tensor.device.type != "cuda":
        return np.asarray(tensor.cpu())
    on_host = tensor.to("cpu", non_blocking=True)  # to pinned memory
    require("torch").cuda.current_stream(tensor.device).synchronize()
    return np.asarray(on_host)


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether a library's error says that the memory of an accelerator is exhausted."""
    return _is_of_a_runtime(error) and bool(_EXHAUSTED.search(str(error)))


def is_device_failure(error: BaseException) -> bool:
    """Return whether an error says that an accelerator failed, other than for its memory.

    Such errors last: after an illegal access, or the loss of the device, each further call of the
    process fails.
    """
    return (
        _is_of_a_runtime(error)
        and bool(_GPU_ERROR.search(str(error)))
        and not is_out_of_memory(error)
    )


def _is_of_a_runtime(error: BaseException) -> bool:
    """Return whether torch, JAX or ONNX Runtime may have raised an error; classes of the latter
    are no RuntimeError.
    """
    return (
        isinstance(error, RuntimeError) or type(error).__module__.partition(".")[0] == "onnxruntime"
    )


def free_memory() -> None:
    """Free memory at once: agents often contain reference cycles, and torch caches the GPU
    memory that it allocated.
    """
    gc.collect()
    empty_cache()


def empty_cache() -> None:
    """Return the GPU memory that torch does not use to the device, for other processes; JAX
    keeps its own.
    """
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_initialized():
        torch.cuda.empty_cache()


def gpu_memory(devices: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    """Return the memory of this process's GPUs among `devices`, bytes: "allocated" for values,
    "reserved" and "free".

    The result is empty if there is none, as when the policy runs in a child process.
    """
    found: Counter[str] = Counter()
    torch, jax = sys.modules.get("torch"), sys.modules.get("jax")
    for device in devices:
        if device["kind"] == "cuda" and torch is not None and torch.cuda.is_initialized():
            place, cuda = device.get("device", "cuda"), torch.cuda
            reserved, (free, total) = cuda.memory_reserved(place), cuda.mem_get_info(place)
            free = min(free, int(float(os.environ.get(GPU_SHARE) or 1) * total) - reserved)
            found.update(
                allocated=cuda.memory_allocated(place), reserved=reserved, free=max(0, free)
            )
        elif device["kind"] == "gpu" and jax is not None:
            stats = (
                next(
                    one for one in jax.local_devices() if str(one) == device["device"]
                ).memory_stats()
                or {}
            )
            used = stats.get("bytes_in_use", 0)
            free = stats.get("bytes_limit", used) - used
            found.update(allocated=used, reserved=stats.get("pool_bytes", used), free=free)
    return dict(found)


def gpu_timer(report: LoadingReport) -> Callable[[], AbstractContextManager[None]]:
    """Return a context of each forward pass of a policy, which reports the time on a GPU when the
    next pass begins.

    The time is that from the first operation to the last one, with the gaps between them. Nothing
    waits for the GPU.
    """
    cuda = require("torch").cuda if "torch" in sys.modules else None
    device = next(
        (one.get("device", "cuda") for one in report.devices if one["kind"] == "cuda"), None
    )
    if device is None or cuda is None or not cuda.is_initialized():
        return nullcontext
    begin, end = (cuda.Event(enable_timing=True) for _ in range(2))
    timed = False

    @contextmanager
    def timer() -> Iterator[None]:
        nonlocal timed
        if timed and end.query():
            report.on_gpu_ms(begin.elapsed_time(end))
        timed = False
        begin.record(cuda.current_stream(device))
        yield
        end.record(cuda.current_stream(device))
        timed = True

    return timer


def ensure_torchvision() -> None:
    """Make torchvision importable beside a CPU-only torch, for which PyPI has no build of it."""
    import_fixes.install()
    if importlib.util.find_spec("torchvision") is not None:
        importlib.import_module("torchvision")
