"""Tests of a robot of LeRobot in a Python without LeRobot."""

from __future__ import annotations

import sys

import pytest

from vlagents_ray.cli import robot


def test_a_robot_of_lerobot_names_how_to_install_lerobot_for_the_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "lerobot", None)
    assert robot.main(["check", "lerobot:so101_follower"]) == 2
    error = capsys.readouterr().err
    assert "LeRobot is not installed in this Python; run `pip install lerobot`" in error
    assert "vlagents-ray venv create lerobot" in error
    assert "deployment" not in error
