"""Devices that are missing, exhausted or broken."""

from __future__ import annotations

import copy
import os
import re
import sys
import time
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from fake_cuda import FakeCuda

from vlagents_ray import Obs
from vlagents_ray.contract import ActionSpec, Contract, StateSpec
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import DISTRIBUTION, SAMPLES, Act
from vlagents_ray.policies.base import ModelConfig, ModelPolicy, Prediction, Row
from vlagents_ray.policies.base.accelerator import (
    GPU_SHARE,
    fetch,
    gpu_memory,
    is_device_failure,
    is_out_of_memory,
    jax_device,
    set_matmul,
    torch_device,
)
from vlagents_ray.policies.base.model_inputs import state_vector
from vlagents_ray.policies.loading import loading_report, report_device
from vlagents_ray.policies.row_limit import FIRST_WAIT_S
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings

pytestmark = pytest.mark.torch

DIM, HORIZON = 2, 3
OLD = "The NVIDIA driver on your system is too old (found version 12040)"


def without_cuda(patch: pytest.MonkeyPatch) -> None:
    """Simulate a torch whose CUDA version the driver does not support."""

    def empty(*_: Any, device: Any) -> None:
        if device.type == "cuda":
            raise RuntimeError(f"{OLD}. Please update it.\nmore")

    patch.setattr(torch.cuda, "is_available", lambda: False)
    patch.setattr(torch, "empty", empty)


@pytest.mark.parametrize("given", ["0", "3,4", "GPU-8f2c", "MIG-1"])
def test_a_gpu_that_torch_cannot_use_is_an_error_with_torchs_reason(
    monkeypatch: Any, given: str
) -> None:
    without_cuda(monkeypatch)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", given)
    torchs = re.escape(f"torch {torch.__version__} cannot use: {OLD}")
    with pytest.raises(ConfigError, match=rf"given GPU {given} .*{torchs}.*or set device: cpu"):
        torch_device("auto")
    assert torch_device("cpu").type == "cpu"


@pytest.mark.parametrize("given", [None, "", "-1", "NoDevFiles"])
def test_without_a_gpu_auto_is_the_cpu(monkeypatch: Any, given: str | None) -> None:
    without_cuda(monkeypatch)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if given is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", given)
    with loading_report(lambda _: None) as report:
        assert torch_device("auto").type == "cpu"
    threads = torch.get_num_threads()
    assert report.devices == [
        {"kind": "cpu", "device": "cpu", "torch": torch.__version__, "threads": threads}
    ]
    assert type(report.devices[0]["torch"]) is str  # readable without torch


def test_what_a_gpu_is_is_reported(monkeypatch: Any) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch, "empty", lambda *_, **__: None)
    h100 = SimpleNamespace(name="NVIDIA H100", total_memory=80 * 2**30)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _: h100)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    with loading_report(lambda _: None) as report:
        torch_device("auto")
    [device] = report.devices
    assert device.pop("driver", "") is None or device  # this machine's driver, if it has one
    assert device == {
        "kind": "cuda",
        "device": "cuda",
        "torch": torch.__version__,
        "name": "NVIDIA H100",
        "memory_mib": 81920,
        "cuda": "13.0",
    }


@pytest.fixture
def no_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (GPU_SHARE, "XLA_PYTHON_CLIENT_PREALLOCATE", "XLA_PYTHON_CLIENT_MEM_FRACTION"):
        monkeypatch.setenv(name, "restored afterwards")
        monkeypatch.delenv(name)


@pytest.mark.parametrize("share", [None, "0.5"])
def test_a_share_of_a_gpu_is_a_limit_of_its_memory(
    no_limits: None, monkeypatch: Any, share: str | None
) -> None:
    cuda, limits = FakeCuda(), []
    cuda.install(monkeypatch)
    monkeypatch.setattr(torch, "empty", lambda *_, **__: None)
    monkeypatch.setattr(
        torch.cuda, "get_device_properties", lambda _: SimpleNamespace(name="", total_memory=0)
    )
    monkeypatch.setattr(
        torch.cuda, "set_per_process_memory_fraction", lambda *limit: limits.append(limit)
    )
    if share is not None:
        monkeypatch.setenv(GPU_SHARE, share)
    with loading_report(lambda _: None) as report:
        torch_device()
    assert limits == ([] if share is None else [(0.5, torch.device("cuda"))])
    assert os.environ.get("XLA_PYTHON_CLIENT_MEM_FRACTION") == share, (
        "in addition to torch, as in openpi's port"
    )
    tensors = [cuda.tensor(torch.zeros(10**6))]
    free = (80 if share is None else 40) * 10**9 - 4 * 10**6
    assert gpu_memory(report.devices) == {
        "allocated": 4 * 10**6,
        "reserved": 4 * 10**6,
        "free": free,
    }
    del tensors
    assert gpu_memory([{"kind": "cpu", "device": "cpu"}]) == {}


@pytest.mark.parametrize("chosen", [None, "true"])
def test_jax_allocates_as_it_needs_unless_told_otherwise(
    no_limits: None, monkeypatch: Any, chosen: str | None
) -> None:
    class Jax(FakeJax):
        def devices(self, kind: str = "cpu") -> list[Any]:
            assert os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] == (chosen or "false"), (
                "JAX must be configured before its first use"
            )
            return super().devices(kind)

    monkeypatch.setitem(sys.modules, "jax", Jax())
    if chosen is not None:
        monkeypatch.setenv("XLA_PYTHON_CLIENT_PREALLOCATE", chosen)
    jax_device("cpu")
    assert os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] == (chosen or "false")


def test_the_memory_of_jax_is_that_of_its_device(monkeypatch: Any) -> None:
    class Gpu:
        def __str__(self) -> str:
            return "cuda:0"

        def memory_stats(self) -> dict[str, int]:
            return {"bytes_in_use": 3, "bytes_limit": 10, "pool_bytes": 4}

    monkeypatch.setitem(sys.modules, "jax", SimpleNamespace(local_devices=lambda: [Gpu()]))
    assert gpu_memory([{"kind": "gpu", "device": "cuda:0"}]) == {
        "allocated": 3,
        "reserved": 4,
        "free": 7,
    }


class FakeJax:
    """A JAX whose GPU plug-in failed to load."""

    __version__ = "0.5.3"
    config = SimpleNamespace(jax_compilation_cache_dir="set")

    def devices(self, kind: str = "cpu") -> list[Any]:
        if kind != "cpu":
            raise RuntimeError("Unknown backend: 'gpu' requested, but no platforms are present.")
        return [SimpleNamespace(platform="cpu", device_kind="cpu")]


def test_a_gpu_that_jax_cannot_use_is_an_error_with_jaxs_reason(monkeypatch: Any) -> None:
    monkeypatch.setitem(sys.modules, "jax", FakeJax())
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert jax_device("auto").platform == "cpu"
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1")
    with pytest.raises(
        ConfigError, match=r"given GPU 1 .*jax 0\.5\.3 cannot use: Unknown backend: 'gpu'"
    ):
        jax_device("auto")
    assert jax_device("cpu").platform == "cpu"


@pytest.mark.parametrize(
    ("error", "exhausted", "failed"),
    [
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."), True, False),
        (
            RuntimeError("CUDA error: out of memory\nCUDA kernel errors might be reported later"),
            True,
            False,
        ),
        (
            RuntimeError(
                "CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`"
            ),
            True,
            False,
        ),
        (
            RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 8589934592 bytes."),
            True,
            False,
        ),
        (torch.AcceleratorError("CUDA error: device-side assert triggered", 710), False, True),
        (RuntimeError("CUDA error: an illegal memory access was encountered"), False, True),
        (RuntimeError("cuDNN error: CUDNN_STATUS_EXECUTION_FAILED"), False, True),
        (
            RuntimeError("INTERNAL: CUDA_ERROR_ILLEGAL_ADDRESS: an illegal memory access"),
            False,
            True,
        ),
        (
            RuntimeError("The size of tensor a (3) must match the size of tensor b (4)"),
            False,
            False,
        ),
        (ValueError("CUDA error: of a name"), False, False),
        (MemoryError("out of memory"), False, False),
    ],
)
def test_errors_of_accelerators_are_told_apart(
    error: Exception, exhausted: bool, failed: bool
) -> None:
    assert (is_out_of_memory(error), is_device_failure(error)) == (exhausted, failed)


ALLOCATION = "Failed to allocate memory for requested buffer of size 2147483648"
CONVOLUTION = (
    "Non-zero status code returned while running Conv node. Name:'/vision/conv' Status Message: "
)


@pytest.mark.parametrize(
    "name", ["Fail", "RuntimeException", "EPFail", "EngineError", "DeviceReset"]
)
@pytest.mark.parametrize(
    ("text", "exhausted", "failed"),
    [
        (
            f"6 : RUNTIME_EXCEPTION : {CONVOLUTION}/core/framework/bfc_arena.cc:376 {ALLOCATION}",
            True,
            False,
        ),
        (
            (
                f"6 : RUNTIME_EXCEPTION : {CONVOLUTION}/core/framework/bfc_arena.cc:376 Available "
                "memory of 0 is smaller than requested bytes of 2147483648"
            ),
            True,
            False,
        ),
        (
            (
                "1 : FAIL : CUDNN failure 4002: "
                "CUDNN_STATUS_INTERNAL_ERROR_DEVICE_ALLOCATION_FAILED ; GPU=0"
            ),
            True,
            False,
        ),
        (
            "1 : FAIL : CUDA failure 2: out of memory ; GPU=0 ; expr=cudaMalloc((void**)&p, size);",
            True,
            False,
        ),
        (
            "1 : FAIL : CUBLAS failure 3: CUBLAS_STATUS_ALLOC_FAILED ; GPU=0 ; hostname=robot",
            True,
            False,
        ),
        (
            "1 : FAIL : CUDA failure 700: an illegal memory access was encountered ; GPU=0",
            False,
            True,
        ),
        (
            f"1 : FAIL : {CONVOLUTION}CUDNN failure 8: CUDNN_STATUS_EXECUTION_FAILED ; GPU=0",
            False,
            True,
        ),
        ("1 : FAIL : CUBLAS failure 13: the GPU program failed to execute ; GPU=0", False, True),
        ("1 : FAIL : CUFFT failure 6: CUFFT_EXEC_FAILED ; GPU=0", False, True),
        ("1 : FAIL : HIP failure 719: unspecified launch failure ; GPU=0", False, True),
        ("16 : DEVICE_RESET : the device was removed", False, True),
        (
            (
                "2 : INVALID_ARGUMENT : Got invalid dimensions for input: images for the following "
                "indices"
            ),
            False,
            False,
        ),
        ("1 : FAIL : the model of CUDA devices is not found", False, False),
    ],
)
def test_errors_of_onnx_runtime_are_told_apart(
    name: str, text: str, exhausted: bool, failed: bool
) -> None:
    classes = pytest.importorskip("onnxruntime.capi.onnxruntime_pybind11_state")
    error = getattr(classes, name)(f"[ONNXRuntimeError] : {text}")
    assert not isinstance(error, RuntimeError), "the error's class alone must not identify it"
    assert (is_out_of_memory(error), is_device_failure(error)) == (exhausted, failed)
    own = ValueError(str(error))  # the text of a request does not make an error a device error
    assert not is_out_of_memory(own)
    assert not is_device_failure(own)


class Crowded(ModelPolicy):
    """A model on a GPU whose memory has room for a few rows; its actions are noise."""

    Config = ModelConfig
    fits = 3
    exhausted: Exception = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")

    @property
    def contract(self) -> Contract:
        return Contract(
            state={"joints": StateSpec(DIM)}, action=ActionSpec(dim=DIM), chunk=self.chunk(HORIZON)
        )

    def load(self) -> Any:
        report_device({"kind": "cuda"})
        return {"passes": []}

    def perceive(self, obs: Obs) -> np.ndarray:
        return state_vector(obs, ["joints"], DIM)

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        self.model["passes"].append(len(rows))
        noise = [row.noise(HORIZON, DIM) for row in rows]
        if len(rows) > self.fits:
            raise self.exhausted
        return [Prediction(one) for one in noise]


class Roomy(Crowded):
    """The same model on a larger GPU."""

    fits = 10**6


def made(kind: type[Crowded], **config: Any) -> Crowded:
    policy = kind.from_config({"checkpoint": "none", **config})
    policy.initialize()
    policy.model["passes"].clear()
    # The durations of the passes depend on other processes.
    policy.report.splits_by_time = False
    return policy


def acted(policy: Crowded, number: int, samples: int = 0) -> list[Act]:
    sessions = [copy.copy(policy) for _ in range(number)]
    view = Obs(
        state={"joints": np.zeros(DIM, np.float32)}, info={SAMPLES: samples} if samples else {}
    )
    for seed, session in enumerate(sessions):
        session.reset(view, "go", seed=seed)
    acts = policy.act_batch([view] * number, sessions)
    assert all(isinstance(act, Act) for act in acts)
    return acts  # type: ignore[return-value]


class Timed(Roomy):
    """A model whose passes take 1 s each on a fake clock, except one that takes 100 s."""

    now_s = 0.0
    delayed: tuple[int, int] | None = None  # (number of rows, how many such passes were before)

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        earlier = self.model["passes"].count(len(rows))
        Timed.now_s += 100.0 if (len(rows), earlier) == self.delayed else 1.0
        return super().predict(rows)


@pytest.mark.parametrize("earlier", range(3))
@pytest.mark.parametrize(("rows", "size"), [(2, 2), (5, 8)])
def test_one_delayed_pass_while_a_model_loads_does_not_divide_later_batches(
    monkeypatch: pytest.MonkeyPatch, rows: int, size: int, earlier: int
) -> None:
    """The first pass of a size also loads kernels; another process may delay any pass."""
    monkeypatch.setattr(time, "perf_counter", lambda: Timed.now_s)
    monkeypatch.setattr(Timed, "delayed", (size, earlier))
    policy = Timed.from_config({"checkpoint": "none", "max_rows": 8, "batch_sizes": [1, 2, 8]})
    policy.initialize()
    assert policy.report.splits_by_time
    policy.model["passes"].clear()
    acted(policy, rows)
    assert policy.model["passes"] == [size]


def test_values_are_read_after_a_copy_that_does_not_wait_is_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    values, on_host = torch.arange(6.0).view(2, 3), torch.zeros(2, 3)

    def to(place: str, *, non_blocking: bool) -> torch.Tensor:
        assert (place, non_blocking) == ("cpu", True)
        return on_host

    device = torch.device("cuda", 1)
    streams = {device: SimpleNamespace(synchronize=lambda: on_host.copy_(values))}
    monkeypatch.setattr(torch.cuda, "current_stream", streams.__getitem__)
    np.testing.assert_array_equal(fetch(SimpleNamespace(device=device, to=to)), values.numpy())
    np.testing.assert_array_equal(fetch(values), values.numpy())


@pytest.mark.parametrize(("setting", "wanted"), [({}, "high"), ({"matmul": "highest"}, "highest")])
def test_float32_products_on_a_gpu_are_as_set(
    monkeypatch: pytest.MonkeyPatch, setting: dict[str, Any], wanted: str
) -> None:
    found: list[Any] = []
    monkeypatch.setattr(torch, "set_float32_matmul_precision", found.append)
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", wanted != "high")
    monkeypatch.setattr(
        Roomy, "predict", lambda _, rows: found.append("rows") or Crowded.predict(_, rows)
    )
    policy = made(Roomy, **setting)
    assert found[:2] == [wanted, "rows"]
    assert torch.backends.cudnn.allow_tf32 is (wanted == "high")
    assert policy.report.devices == [{"kind": "cuda", "matmul": wanted}]


def test_float32_products_of_jax_are_as_set_and_those_of_a_cpu_stay(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found: list[Any] = []
    monkeypatch.setitem(
        sys.modules,
        "jax",
        SimpleNamespace(config=SimpleNamespace(update=lambda *to: found.append(to))),
    )
    gpu, cpu = {"kind": "gpu", "jax": "0.5.3"}, {"kind": "cpu", "torch": "2.13.0"}
    set_matmul("highest", gpu)
    set_matmul("high", cpu)
    assert found == [("jax_default_matmul_precision", "float32")]
    assert (gpu["matmul"], "matmul" in cpu) == ("highest", False)


def test_a_full_batch_that_does_not_fit_is_found_while_a_model_loads(
    caplog: pytest.LogCaptureFixture,
) -> None:
    policy = Crowded.from_config({"checkpoint": "none", "max_rows": 12})
    policy.initialize()
    assert policy.model["passes"] == [1, 12, 6, 3, 3, 3, 3]
    assert policy.most_rows == 3
    assert (
        "out of memory in a forward pass of 12 rows: of at most 6 rows from now on" in caplog.text
    )
    assert "Lower batch.max_size, max_rows or batch_sizes" in caplog.text


@pytest.mark.parametrize(
    ("sizes", "passes", "later"),
    [(None, [5, 2, 2, 1], [2, 2, 1]), ([1, 2, 5, 8], [5, 2, 2, 1], [2, 2, 1])],
)
def test_a_batch_that_does_not_fit_is_halved_and_acts_as_if_it_had(
    monkeypatch: pytest.MonkeyPatch, sizes: list[int] | None, passes: list[int], later: list[int]
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(Crowded, "fits", 8)
        policy = made(Crowded, max_rows=8, batch_sizes=sizes)
    cuda = FakeCuda()
    cuda.install(monkeypatch)
    acts = acted(policy, 5)
    assert (policy.model["passes"], cuda.emptied) == (passes, 1)
    policy.model["passes"].clear()
    acted(policy, 5)
    assert policy.model["passes"] == later
    for one, other in zip(acts, acted(made(Roomy), 5), strict=True):
        np.testing.assert_array_equal(one.action, other.action)


@pytest.mark.parametrize(
    ("sizes", "limits"), [(None, [2, 4, 8, 12]), ([1, 2, 5, 8, 12], [2, 5, 8, 12])]
)
def test_after_a_shortage_of_memory_the_passes_grow_again(
    monkeypatch: pytest.MonkeyPatch, sizes: list[int] | None, limits: list[int]
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(Crowded, "fits", 12)
        policy = made(Crowded, max_rows=12, batch_sizes=sizes)
    limit, now = policy.report.row_limit, [0.0]
    limit.clock = lambda: now[0]
    with monkeypatch.context() as patch:
        patch.setattr(Crowded, "fits", limits[0])
        acted(policy, 9)
        now[0] += FIRST_WAIT_S - 1
        acted(policy, 9)
        assert policy.most_rows == limits[0]

    monkeypatch.setattr(Crowded, "fits", 12)
    reached = []
    for _ in range(5):
        now[0] += 1
        acted(policy, 9)
        reached.append(policy.most_rows)
        now[0] += FIRST_WAIT_S - 1
    assert reached == [*limits[1:], 12, 12]
    policy.model["passes"].clear()
    acted(policy, 9)
    assert policy.model["passes"] == [9 if sizes is None else 12]


def test_memory_that_stays_short_is_tried_more_and_more_seldom(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(Crowded, "fits", 4)
        policy = made(Crowded, max_rows=4)
    limit, now = policy.report.row_limit, [0.0]
    limit.clock = lambda: now[0]
    monkeypatch.setattr(Crowded, "fits", 2)
    acts, failures = acted(policy, 4), []
    for second in range(30, 4 * 3600, 30):
        now[0] = float(second)
        policy.model["passes"].clear()
        for one, other in zip(acted(policy, 4), acts, strict=True):
            np.testing.assert_array_equal(one.action, other.action)
        if 4 in policy.model["passes"]:
            failures.append(second)
    assert policy.most_rows == 2
    waits = np.diff([0, *failures])
    assert waits.tolist() == [60, 120, 240, 480, 960, 1920, 3600, 3600]


def test_a_batch_that_onnx_runtime_cannot_fit_is_halved(monkeypatch: pytest.MonkeyPatch) -> None:
    classes = pytest.importorskip("onnxruntime.capi.onnxruntime_pybind11_state")
    monkeypatch.setattr(
        Crowded, "exhausted", classes.RuntimeException(f"6 : RUNTIME_EXCEPTION : {ALLOCATION}")
    )
    policy = made(Crowded, max_rows=8)
    for one, other in zip(acted(policy, 5), acted(made(Roomy), 5), strict=True):
        np.testing.assert_array_equal(one.action, other.action)
    assert policy.most_rows == 2


def test_samples_that_do_not_fit_are_those_that_would_have_fitted() -> None:
    policy = made(Crowded, max_rows=3)
    policy.config = policy.config.model_copy(update={"max_rows": 64})
    for one, other in zip(
        acted(policy, 2, samples=6), acted(made(Roomy), 2, samples=6), strict=True
    ):
        np.testing.assert_array_equal(one.action, other.action)
        np.testing.assert_array_equal(
            one.info[DISTRIBUTION]["samples"], other.info[DISTRIBUTION]["samples"]
        )
    assert policy.most_rows == 3


def test_one_row_that_does_not_fit_is_an_error_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = Crowded.from_config({"checkpoint": "none", "max_rows": 12})
    engine = Engine(policy)
    engine.start()
    try:
        # Errors with the full batch and with half of it, during loading.
        assert engine.stats.collect().out_of_memory == 2
        monkeypatch.setattr(Crowded, "fits", 0)
        with pytest.raises(torch.OutOfMemoryError):
            acted(policy, 3)
        assert engine.stats.collect().out_of_memory == 2
        engine.health.check()
    finally:
        engine.close()


def test_the_time_of_a_batch_on_the_gpu_is_reported_at_the_next_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cuda = FakeCuda()
    cuda.install(monkeypatch)
    predict = Crowded.predict

    def predicted(self: Crowded, rows: Sequence[Row]) -> list[Prediction | Exception]:
        cuda.clock_ms += len(rows)
        return predict(self, rows)

    monkeypatch.setattr(Crowded, "predict", predicted)
    policy = Crowded.from_config({"checkpoint": "none", "max_rows": 3})
    engine = Engine(policy, EngineSettings(threaded=False))
    engine.start()
    assert engine.stats.gpu_ms is None, "the report must be from the start"
    for rows in (1, 3):
        acted(policy, rows)
    assert engine.stats.gpu_ms == 1
    monkeypatch.setattr(Crowded, "fits", 0)
    with pytest.raises(torch.OutOfMemoryError):
        acted(policy, 1)
    assert engine.stats.gpu_ms == 3
    monkeypatch.setattr(Crowded, "fits", 3)
    acted(policy, 1)
    assert engine.stats.collect().gpu_ms.count == 2, "a failed pass has no time"
