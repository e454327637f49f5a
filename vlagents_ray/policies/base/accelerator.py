"""Devices, dtypes, memory and errors of torch, JAX and ONNX Runtime."""

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

VISIBLE = "CUDA_VISIBLE_DEVICES"  # set by Ray in a process that has GPUs
# Environment variable with the share of the GPU's memory that a process may use. If it is not set,
# the process may use all memory.
GPU_SHARE = "VLAGENTS_RAY_GPU_SHARE"

# The oldest driver that supports each major version of CUDA:
# https://docs.nvidia.com/deploy/cuda-compatibility/minor-version-compatibility.html
OLDEST_DRIVERS = {12: 525, 13: 580}
_DRIVER = Path("/proc/driver/nvidia/version")
# Error messages of torch, JAX and ONNX Runtime. The classes of these errors differ between
# versions.
_EXHAUSTED = re.compile(
    r"out of memory|ALLOC_FAILED|ALLOCATION_FAILED|OUT_OF_MEMORY|RESOURCE_EXHAUSTED"
    # The messages of ONNX Runtime without and with a memory limit
    r"|Failed to allocate memory|Available memory of \d+ is smaller than requested",
    re.IGNORECASE,
)
_GPU_ERROR = re.compile(
    r"CUDA error|CUDA_ERROR_|(?:CUDA|CUDNN|CUBLAS|CUFFT|HIP|MIOPEN|ROCBLAS) failure "
    r"\d|CUDNN_STATUS_|CUBLAS_STATUS_"
    r"|HIP error|DEVICE_RESET"
)


def torch_device(name: str = "auto") -> Any:
    """Return the `torch.device` with a name.

    Args:
        name: A device name of torch, or "auto". "auto" selects a GPU, or the CPU if Ray assigned no
            GPU to this process and torch finds none.

    Raises:
        ConfigError: The device does not exist, or torch cannot use it.
    """
    share = _limit_jax()
    torch = require("torch")
    needs_gpu = name == "auto" and bool(_given_gpus())
    kind = name
    try:
        if name == "auto":
            kind = "cuda" if needs_gpu or torch.cuda.is_available() else "cpu"
        device = torch.device(kind)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        if needs_gpu:
            raise _unusable(f"torch {torch.__version__}", reason) from error
        raise ConfigError(
            f"device {name!r}: not available ({reason}); use 'auto' or 'cpu', or give the replica "
            "a GPU with resources: {num_gpus: 1}"
        ) from error

    # `torch.__version__` is an instance of a class of torch, which a process without torch cannot
    # unpickle.
    version = str(torch.__version__)
    described = {"kind": device.type, "device": str(device), "torch": version}
    if device.type == "cpu":
        # The number of threads decides how products are divided, and with it their rounding.
        described["threads"] = torch.get_num_threads()
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
    """Limit the memory of JAX, before its first use of a GPU.

    By default, JAX allocates three quarters of the memory at once, even if torch uses the same GPU.

    Returns:
        The share of the memory that this process may use; 0 if it has no limit.
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    share = os.environ.get(GPU_SHARE, "")
    if share:
        os.environ.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", share)
    return float(share or 0)


def _given_gpus() -> str:
    """Return the GPUs that Ray assigned to this process; empty if there are none."""
    visible = os.environ.get(VISIBLE, "")
    return "" if visible in ("-1", "NoDevFiles") else visible


def _unusable(library: str, reason: str) -> ConfigError:
    """Return the error for a library that cannot use the GPU of this process."""
    return ConfigError(
        f"device 'auto': this process was given GPU {_given_gpus()} ({VISIBLE}), which {library} "
        f"cannot use: {reason}; install a build of it for the GPU and its driver, or set device: "
        "cpu with resources: {num_gpus: 0}"
    )


def driver_version() -> str | None:
    """Return the version of NVIDIA's driver, such as "580.65.06"; None if the version is
    unknown.
    """
    with suppress(OSError):
        driver = re.search(r"Kernel Module\s+(?:for \S+\s+)?([\d.]+)", _DRIVER.read_text())
        return driver and driver[1]

    # The file does not exist in WSL2.
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    with suppress(OSError, subprocess.SubprocessError, IndexError):
        answer = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)  # noqa: S603
        return answer.stdout.split()[0]
    return None


def torch_dtype(name: DType, device: Any, preferred: str = "bfloat16") -> Any:
    """Return the `torch.dtype` with a name.

    "auto" selects `preferred` on an accelerator, and float32 on a CPU.
    """
    torch = require("torch")
    usual = "float32" if device.type == "cpu" else preferred
    return getattr(torch, usual if name == "auto" else name)


def jax_device(name: str = "auto") -> Any:
    """Return the JAX device with a name.

    After this call, the programs that JAX compiles for an accelerator are kept for the next start.

    Args:
        name: A platform of JAX, such as "gpu" or "gpu:1", or "auto". "auto" selects the first
            device, which may be a CPU only if Ray assigned no GPU to this process.

    Raises:
        ConfigError: The device does not exist, or JAX cannot use it.
    """
    _limit_jax()
    jax = require("jax")
    platform, _, index = name.partition(":")
    try:
        device = jax.devices()[0] if name == "auto" else jax.devices(platform)[int(index or 0)]
        if name == "auto" and device.platform == "cpu" and _given_gpus():
            device = jax.devices("gpu")[0]
    except (RuntimeError, IndexError, ValueError) as error:
        if name == "auto":
            raise _unusable(f"jax {jax.__version__}", str(error).splitlines()[0]) from error
        raise ConfigError(
            f"device {name!r}: not available, JAX finds {jax.devices()}; use 'auto' or 'cpu', or "
            "install the jaxlib of your accelerator and give the replica a GPU with resources: "
            "{num_gpus: 1}"
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
    """Return the provider of ONNX Runtime for a device, and its settings.

    Args:
        name: "cpu", "cuda" or "cuda:1", or "auto" as in `torch_device`.
        matmul: The precision of float32 products.

    Raises:
        ConfigError: This ONNX Runtime was not built for the device.
    """
    runtime = require("onnxruntime")
    kind, _, index = name.partition(":")
    cuda = "CUDAExecutionProvider"
    offers_cuda = cuda in runtime.get_available_providers()
    if name == "auto":
        kind = "cuda" if (offers_cuda and driver_version()) or _given_gpus() else "cpu"

    if kind == "cpu":
        report_device({"kind": "cpu", "device": "cpu", "onnxruntime": runtime.__version__})
        return "CPUExecutionProvider", {}

    if kind != "cuda" or not offers_cuda:
        raise ConfigError(
            f"device {name!r}: this onnxruntime supports only "
            f"{runtime.get_available_providers()}; replace it with `pip uninstall onnxruntime && "
            "pip install onnxruntime-gpu`, or set device: cpu with resources: {num_gpus: 0}"
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
    """Set the precision of this process's float32 matrix products and convolutions.

    Args:
        precision: The precision.
        device: The description of the device, to which the precision is added. For a CPU, nothing
            is changed.
    """
    if device["kind"] == "cpu" or "onnxruntime" in device:
        return
    if "jax" in device:
        jax_precision = {"high": "tensorfloat32", "highest": "float32"}[precision]
        require("jax").config.update("jax_default_matmul_precision", jax_precision)
    else:
        torch = require("torch")
        torch.set_float32_matmul_precision(precision)
        torch.backends.cudnn.allow_tf32 = precision == "high"
    device["matmul"] = precision


def fetch(tensor: Any) -> np.ndarray:
    """Wait until a tensor is computed, and return it as an array.

    Meanwhile, other threads can use the GPU to prepare the next batch or to load weights. The
    method `Tensor.cpu` would copy to pageable memory. During such a copy, each CUDA call of another
    thread waited for all work on the GPU (torch 2.11, H200).
    """
    if tensor.device.type != "cuda":
        return np.asarray(tensor.cpu())
    on_host = tensor.to("cpu", non_blocking=True)  # copies to pinned memory
    require("torch").cuda.current_stream(tensor.device).synchronize()
    return np.asarray(on_host)


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error means that the memory of an accelerator is exhausted."""
    return _is_from_runtime(error) and bool(_EXHAUSTED.search(str(error)))


def is_device_failure(error: BaseException) -> bool:
    """Return whether an error means a failure of an accelerator, other than exhausted memory.

    Such failures are permanent: after an illegal access, or the loss of the device, each further
    call in the process fails.
    """
    return (
        _is_from_runtime(error)
        and bool(_GPU_ERROR.search(str(error)))
        and not is_out_of_memory(error)
    )


def _is_from_runtime(error: BaseException) -> bool:
    """Return whether torch, JAX or ONNX Runtime may have raised an error."""
    if isinstance(error, RuntimeError):
        return True
    # The classes of ONNX Runtime are not derived from RuntimeError.
    return type(error).__module__.partition(".")[0] == "onnxruntime"


def free_memory() -> None:
    """Free the memory of deleted objects immediately.

    Agents often contain reference cycles, and torch caches the GPU memory that it has allocated.
    """
    gc.collect()
    empty_cache()


def empty_cache() -> None:
    """Release the GPU memory that torch caches, so that other processes can use it.

    JAX never releases its memory.
    """
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_initialized():
        torch.cuda.empty_cache()


def gpu_memory(devices: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    """Return the memory of this process's GPUs.

    Args:
        devices: Descriptions of devices. Devices of other processes are ignored.

    Returns:
        The numbers of bytes that are "allocated" for values, "reserved" and "free". The result is
        empty if this process uses no GPU, for example if the policy runs in a child process, which
        reports its own memory.
    """
    memory: Counter[str] = Counter()
    torch, jax = sys.modules.get("torch"), sys.modules.get("jax")
    for device in devices:
        if device["kind"] == "cuda" and torch is not None and torch.cuda.is_initialized():
            memory.update(_torch_memory(torch.cuda, device.get("device", "cuda")))
        elif device["kind"] == "gpu" and jax is not None:
            memory.update(_jax_memory(jax, device["device"]))
    return dict(memory)


def _torch_memory(cuda: Any, device: str) -> dict[str, int]:
    """Return the memory of a torch device, limited to the share that this process may use."""
    reserved = cuda.memory_reserved(device)
    free, total = cuda.mem_get_info(device)
    share = float(os.environ.get(GPU_SHARE) or 1)
    free = min(free, int(share * total) - reserved)
    return {
        "allocated": cuda.memory_allocated(device),
        "reserved": reserved,
        "free": max(0, free),
    }


def _jax_memory(jax: Any, name: str) -> dict[str, int]:
    """Return the memory of a JAX device."""
    device = next(device for device in jax.local_devices() if str(device) == name)
    stats = device.memory_stats() or {}
    used = stats.get("bytes_in_use", 0)
    free = stats.get("bytes_limit", used) - used
    return {"allocated": used, "reserved": stats.get("pool_bytes", used), "free": free}


def gpu_timer(report: LoadingReport) -> Callable[[], AbstractContextManager[None]]:
    """Return a context manager that measures the GPU time of each forward pass of a policy.

    The time is reported when the next pass begins, so that no thread waits for the GPU. It extends
    from the first operation to the last one and includes gaps between operations.
    """
    cuda = require("torch").cuda if "torch" in sys.modules else None
    gpus = [device for device in report.devices if device["kind"] == "cuda"]
    if not gpus or cuda is None or not cuda.is_initialized():
        return nullcontext

    device = gpus[0].get("device", "cuda")
    begin, end = (cuda.Event(enable_timing=True) for _ in range(2))
    timed = False

    @contextmanager
    def timer() -> Iterator[None]:
        """Report the time of the previous pass, then record the beginning and the end of this
        one.
        """
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
    """Make torchvision importable with a CPU-only torch, for which PyPI has no build of
    torchvision.
    """
    import_fixes.install()
    if importlib.util.find_spec("torchvision") is not None:
        importlib.import_module("torchvision")
