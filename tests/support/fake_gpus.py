"""The devices of a machine with two GPUs, for tests of the choice of the GPU on which a worker
renders.
"""

from __future__ import annotations

import os

import pytest

from vlagents_ray.envs import graphics
from vlagents_ray.envs.graphics import EGL_DEVICE, GPUS, EglDevice

# EGL numbers devices differently from CUDA, includes a device that CUDA does not have, and lists
# Mesa's last.
TWO_GPUS = [
    EglDevice(0, software=False, cuda=1),
    EglDevice(1, software=False, cuda=0),
    EglDevice(2, software=False, cuda=None),
    EglDevice(3, software=True, cuda=None),
]


@pytest.fixture
def nothing_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (
        GPUS,
        EGL_DEVICE,
        "MUJOCO_GL",
        "DISPLAY",
        "LP_NUM_THREADS",
        *graphics.VULKAN_DRIVERS,
    ):
        monkeypatch.setenv(name, "")  # monkeypatch restores the variable, whatever the test sets
        monkeypatch.delenv(name)
    monkeypatch.setattr(graphics, "devices", lambda: TWO_GPUS)


def chosen(monkeypatch: pytest.MonkeyPatch, visible: str) -> str | None:
    monkeypatch.setenv(GPUS, visible)
    graphics.choose_devices()
    return os.environ.get(EGL_DEVICE)
