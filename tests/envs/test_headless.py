"""The variables that rendering libraries read when they are loaded."""

from __future__ import annotations

import os

import pytest

from vlagents_ray.envs import graphics


@pytest.fixture(autouse=True)
def _nothing_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("MUJOCO_GL", "DISPLAY", "LP_NUM_THREADS"):
        monkeypatch.setenv(name, "")  # so that what the test sets is undone
        monkeypatch.delenv(name)
    monkeypatch.setattr(graphics, "_has_egl", lambda: True)


def chosen(name: str) -> str | None:
    graphics.prepare_rendering()
    return os.environ.get(name)


def test_without_a_display_mujoco_renders_through_egl() -> None:
    assert chosen("MUJOCO_GL") == "egl"


def test_a_display_is_left_to_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":0")
    assert chosen("MUJOCO_GL") is None


def test_without_an_egl_library_mujoco_stays_importable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graphics, "_has_egl", lambda: False)
    assert chosen("MUJOCO_GL") is None


def test_what_the_user_set_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setenv("LP_NUM_THREADS", "4")
    assert chosen("MUJOCO_GL") == "osmesa"
    assert chosen("LP_NUM_THREADS") == "4"


def test_software_drivers_take_one_core() -> None:
    assert chosen("LP_NUM_THREADS") == "1"
