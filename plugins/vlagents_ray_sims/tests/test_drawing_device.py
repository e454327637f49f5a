"""Tests of the device on which robosuite and LIBERO render, with fakes of other machines'
devices.
"""

from __future__ import annotations

import os

import pytest
from fake_gpus import chosen, nothing_chosen

from vlagents_ray.envs.graphics import EGL_DEVICE, GPUS
from vlagents_ray.errors import EnvFailed
from vlagents_ray_sims.robosuite import importing_robosuite

__all__ = ["nothing_chosen"]

pytestmark = pytest.mark.usefixtures("nothing_chosen")


def test_robosuite_sees_the_number_that_egl_has_for_the_gpu_while_it_is_imported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    chosen(monkeypatch, "7")
    with importing_robosuite("libero"):
        assert os.environ[GPUS] == os.environ[EGL_DEVICE] == "1"
    assert os.environ[GPUS] == "7"


def test_libero_without_a_gpu_and_without_software_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setenv(GPUS, "")
    with (
        pytest.raises(EnvFailed, match="no EGL device that renders in software"),
        importing_robosuite("libero"),
    ):
        pass
