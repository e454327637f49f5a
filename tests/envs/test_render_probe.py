"""The rendering probe: its results, and its messages if no renderer works."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator

import pytest

from vlagents_ray.envs import graphics
from vlagents_ray.envs.maniskill import ManiSkill
from vlagents_ray.registry import pip_install

needs_sapien = pytest.mark.skipif(
    importlib.util.find_spec("sapien") is None, reason="sapien is not installed"
)


@pytest.fixture(autouse=True)
def _fresh_answers() -> Iterator[None]:
    graphics.render_probe.cache_clear()
    yield
    graphics.render_probe.cache_clear()


@pytest.mark.vulkan
def test_a_frame_is_rendered_and_the_device_named() -> None:
    found = graphics.render_probe()
    assert found.ok, found.error
    assert found.device
    assert found.cure is None
    assert 0.0 < found.seconds < graphics.TIMEOUT_S


@pytest.mark.sim
@pytest.mark.skipif(importlib.util.find_spec("mujoco") is None, reason="mujoco is not installed")
def test_mujoco_renders_through_egl() -> None:
    found = graphics.egl_probe()
    assert found.ok, found.error
    assert found.device
    assert [one.number for one in found.devices] == list(range(len(found.devices)))


@needs_sapien
def test_without_a_vulkan_driver_the_cure_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VK_ICD_FILENAMES", "/nonexistent.json")
    monkeypatch.setenv("VK_DRIVER_FILES", "/nonexistent.json")
    found = graphics.render_probe()
    assert not found.ok
    assert found.error
    assert found.cure == graphics.vulkan_cure()
    missing = ManiSkill.missing()
    assert missing is not None
    assert found.cure in missing


@needs_sapien
def test_a_driver_that_hangs_is_given_up_once_a_process(monkeypatch: pytest.MonkeyPatch) -> None:
    found = graphics.render_probe(timeout_s=0.01)
    assert (found.ok, found.error) == (False, "no frame within 0.01 s")
    monkeypatch.setattr("subprocess.run", lambda *_, **__: pytest.fail("a second child"))
    assert graphics.render_probe(timeout_s=0.01) is found


def test_without_sapien_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert graphics.render_probe().cure == pip_install("maniskill")
    assert pip_install("maniskill") in (ManiSkill.missing() or "")


def test_a_machine_with_an_nvidia_driver_gets_its_own_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.which", lambda _: "/usr/bin/nvidia-smi")
    assert graphics.vulkan_cure() == graphics.VULKAN_CURE_NVIDIA
