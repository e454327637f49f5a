"""The device on which a worker renders: with simulated devices of other machines, and with the real
ones of this machine.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
from fake_gpus import TWO_GPUS, chosen, nothing_chosen

from vlagents_ray.envs import graphics
from vlagents_ray.envs.graphics import (
    EGL_DEVICE,
    GPUS,
    EglDevice,
    Renderer,
    fitting,
    require_own,
    usable_devices,
)
from vlagents_ray.errors import ConfigError

LLVMPIPE = Renderer("llvmpipe (LLVM 15.0.6, 256 bits)", software=True, cuda=None)
NVIDIA = Renderer("NVIDIA H200/PCIe/SSE2", software=False, cuda=0)
OTHERS = Renderer("NVIDIA H200/PCIe/SSE2", software=False, cuda=None)
SUMMARY = """GPU: NVIDIA H200
  Supported: 1
  Present:   0
  cudaId:    0
GPU: NVIDIA T4
  Supported: 0
  cudaId:    1
GPU: llvmpipe (LLVM 15.0.6, 256 bits)
  Supported: 1
  cudaId:    -1
"""


__all__ = ["nothing_chosen"]

pytestmark = pytest.mark.usefixtures("nothing_chosen")


@pytest.mark.parametrize(
    ("given", "egl", "want"),
    [
        ({}, True, ("egl", "1")),
        ({}, False, (None, "1")),  # with the variable, `import mujoco` would fail
        ({"DISPLAY": ":0"}, True, (None, "1")),
        ({"MUJOCO_GL": "osmesa", "LP_NUM_THREADS": "4"}, True, ("osmesa", "4")),
    ],
)
def test_without_a_display_mujoco_renders_through_egl_and_in_software_on_one_core(
    monkeypatch: pytest.MonkeyPatch, given: dict[str, str], egl: bool, want: tuple[str | None, str]
) -> None:
    monkeypatch.setattr(graphics, "_has_egl", lambda: egl)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    graphics.prepare_rendering()
    assert (os.environ.get("MUJOCO_GL"), os.environ.get("LP_NUM_THREADS")) == want


@pytest.mark.parametrize(
    ("visible", "device"), [("1", "1"), ("GPU-8c9a", "1"), ("0,1", "1"), ("", "3"), ("-1", "3")]
)
def test_a_worker_draws_on_what_egl_calls_its_gpu_or_in_software(
    monkeypatch: pytest.MonkeyPatch, visible: str, device: str
) -> None:
    assert chosen(monkeypatch, visible) == device


def test_a_process_that_nobody_gave_or_forbade_gpus_is_left_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    graphics.choose_devices()
    assert EGL_DEVICE not in os.environ
    monkeypatch.setattr(graphics, "_lavapipe", lambda: Path("/lvp_icd.json"))
    assert graphics.VULKAN_DRIVERS[0] not in os.environ
    require_own(OTHERS)


def test_vulkan_is_left_with_its_software_driver_where_there_is_no_gpu(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(graphics, "_lavapipe", lambda: Path("/lvp_icd.json"))
    chosen(monkeypatch, "0")
    assert graphics.VULKAN_DRIVERS[0] not in os.environ
    chosen(monkeypatch, "")
    assert os.environ[graphics.VULKAN_DRIVERS[0]] == "/lvp_icd.json"


def test_what_the_user_chose_stays_and_is_no_mistake(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(EGL_DEVICE, "0")
    monkeypatch.setenv(graphics.VULKAN_DRIVERS[1], "/other.json")
    assert chosen(monkeypatch, "") == "0"
    assert graphics.VULKAN_DRIVERS[0] not in os.environ
    require_own(graphics.vulkan_renderer("NVIDIA H200", None))


def test_the_nvidia_driver_that_sapien_names_by_itself_is_nobodys_wish(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(GPUS, "")
    monkeypatch.setenv(graphics.VULKAN_DRIVERS[0], "/venv/sapien/vulkan_library/nvidia_icd.json")
    with pytest.raises(ConfigError, match="no GPU is assigned to the worker"):
        require_own(graphics.vulkan_renderer("NVIDIA H200", None))


def test_where_no_device_fits_none_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graphics, "devices", lambda: TWO_GPUS[:3])
    assert chosen(monkeypatch, "") is None
    assert fitting([EglDevice(0, software=True, cuda=None)], gpu=True) is None


@pytest.mark.parametrize(
    ("visible", "good", "bad", "said"),
    [
        (
            "",
            LLVMPIPE,
            [NVIDIA, OTHERS],
            r"no GPU is assigned .* renders on 'NVIDIA H200.*worker: \{gpus: 0.25\}",
        ),
        (
            "3",
            NVIDIA,
            [LLVMPIPE, OTHERS],
            r"the GPU 3 is assigned to the worker, but its env renders on .*libnvidia-gl",
        ),
    ],
)
def test_drawing_on_anything_but_what_was_given_is_an_error_with_its_cure(
    monkeypatch: pytest.MonkeyPatch, visible: str, good: Renderer, bad: list[Renderer], said: str
) -> None:
    monkeypatch.setenv(GPUS, visible)
    require_own(good)
    for other in bad:
        with pytest.raises(ConfigError, match=said):
            require_own(other)


def test_sapiens_devices_are_read_from_its_summary() -> None:
    assert usable_devices(SUMMARY) == [
        ("NVIDIA H200", 0),
        ("llvmpipe (LLVM 15.0.6, 256 bits)", None),
    ]


DRAW = """
from vlagents_ray.envs import make_env
from vlagents_ray.envs import graphics
assert graphics.opengl_renderer() is None
with make_env("gymnasium/Hopper-v5") as env:
    env.reset(seed=0)
    renderer = env.renderer()
    assert renderer is not None and renderer.software, renderer
    graphics.require_own(renderer)
    print(renderer.name)
"""


@pytest.mark.sim
@pytest.mark.skipif(importlib.util.find_spec("mujoco") is None, reason="mujoco is not installed")
def test_mujoco_without_a_gpu_really_draws_in_software() -> None:
    child = subprocess.run(
        [sys.executable, "-c", DRAW],
        env=os.environ | {GPUS: "", "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert child.returncode == 0, child.stderr
    assert child.stdout.splitlines()[-1].startswith(("llvmpipe", "softpipe"))
