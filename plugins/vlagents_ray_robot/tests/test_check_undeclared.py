"""Tests of the check of a robot that declares nothing, and of the checks that need no operator and
no contract.
"""

from __future__ import annotations

import io
import json
import logging
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from vlagents_ray import Act, ActionSpec, Agent, Contract, Obs
from vlagents_ray.contract import StateSpec
from vlagents_ray.robot import run_loop
from vlagents_ray_robot.check import CHECKS, examine
from vlagents_ray_robot.check_command import main


class Own:
    """An arm with a camera, whose class declares nothing."""

    def __init__(self) -> None:
        self.random = np.random.default_rng(0)
        self.applied = 0

    def observe(self) -> Obs:
        return Obs({"front": self.picture()}, state={"joints": np.zeros(3, np.float32)})

    def picture(self) -> np.ndarray:
        return self.random.integers(100, 104, (16, 16, 3), np.uint8)

    def apply(self, action: np.ndarray) -> None:
        self.applied += 1

    def stop(self) -> None: ...


class Repeating(Own):
    def picture(self) -> np.ndarray:
        return np.full((16, 16, 3), 100, np.uint8)


class InPlace(Own):
    """Writes each new picture into the same array."""

    def __init__(self) -> None:
        super().__init__()
        self.buffer = np.zeros((16, 16, 3), np.uint8)

    def picture(self) -> np.ndarray:
        self.buffer[:] = super().picture()
        return self.buffer


class Declared(Own):
    contract = Contract(
        state={"joints": StateSpec(3, "rad")}, action=ActionSpec(dim=3, space="joint", delta=False)
    )


class Partly(Own):
    contract = Contract(action=ActionSpec(dim=3))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "status"),
    [("Own", 3), ("Partly", 3), ("Declared", 0), ("Repeating", 1), ("InPlace", 3)],
)
def test_the_status_tells_a_check_that_checked_nothing_from_a_passed_one(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    kind: str,
    status: int,
) -> None:
    monkeypatch.setitem(sys.modules, "own_arm", sys.modules[__name__])
    monkeypatch.setattr("sys.stdin", io.StringIO())  # no operator answers
    page = tmp_path / "own.html"
    assert main([f"own_arm:{kind}", "--out", str(page), "--hz", "200"]) == status
    lines = capsys.readouterr().out.splitlines()
    assert [line.startswith("NOT CHECKED") for line in lines].count(True) == (status == 3)
    reasons = [line.partition(": ")[2] for line in lines if line.startswith("not checked")]
    assert len(reasons) == len(set(reasons)), "each reason is said once"
    if status == 3:
        assert "Give the class a `contract`" in lines[-1]
        assert not any(line.startswith("ok meaning") for line in lines)
    text = page.read_text()
    head = text[: text.index("<ul>")]
    assert f"own_arm:{kind}" in head
    assert time.strftime("%Y-%m-%d") in head
    assert ("FOUND" in head, "NOT CHECKED" in head) == (status == 1, status == 3)
    assert main([f"own_arm:{kind}", "--json", "--hz", "200"]) == status
    assert json.loads(capsys.readouterr().out)["ok"] == (status == 0)


def test_a_camera_that_repeats_its_picture_is_found_without_a_person_and_a_contract() -> None:
    arm = Repeating()
    [finding] = examine(arm, hz=200).findings
    assert finding.check == "cameras"
    assert "the same picture of 'front'" in finding.got
    assert arm.applied == 0
    arm.simulated = True  # type: ignore[attr-defined]  # pictures of a still simulation have no noise
    assert examine(arm, hz=200).findings == []


def test_checks_that_were_not_made_have_not_passed() -> None:
    report = examine(Own(), hz=200)
    assert not report.ok
    assert "observation" not in report.passed, "there is no contract to compare it with"
    assert set(report.passed) | report.skipped.keys() == set(CHECKS)


@pytest.mark.parametrize("blocks", [False, True])
def test_an_apply_that_blocks_is_reported_by_the_loop(
    caplog: pytest.LogCaptureFixture, *, blocks: bool
) -> None:
    hz = 20.0

    class Still(Agent):
        def act(self, obs: Obs) -> Act:
            return Act(np.zeros(3, np.float32))

    class Waiting(Own):
        def apply(self, action: np.ndarray) -> None:
            if blocks:
                time.sleep(0.8 / hz)

    with caplog.at_level(logging.WARNING):
        report = run_loop(Waiting(), Still(), hz=hz, seconds=0.4)
    assert (report.blocking is not None) == blocks
    assert ("without waiting for the arm to arrive" in caplog.text) == blocks


RANGES = {"rad": 3.1, "deg": 180.0, "%": 100.0}  # of a joint


@pytest.mark.parametrize("share", [0.0, 0.01, 0.03, 0.3, 0.9])
@pytest.mark.parametrize("true_unit", RANGES)
@pytest.mark.parametrize("unit", RANGES)
def test_units_are_checked_only_where_joints_are_not_near_zero(
    unit: str, true_unit: str, share: float
) -> None:
    """An arm with three joints stands at a share of their range, and reads in another unit than it
    declares, or in the same.
    """
    joints = np.array([0.0, -0.5, 1.0], np.float32) * np.float32(share * RANGES[true_unit])

    class Standing(Own):
        contract = Contract(
            state={"joints": StateSpec(3, unit)},
            action=ActionSpec(dim=3, space="joint", delta=False),
        )

        def observe(self) -> Obs:
            return Obs({"front": self.picture()}, state={"joints": joints.copy()})

    report = examine(Standing())
    is_found = any(finding.check == "units" for finding in report.findings)
    if "rad" in (unit, true_unit) and unit != true_unit:
        assert "units" not in report.passed or unit == "rad"
    if unit == "rad" and true_unit == "deg":
        # Degrees below a turn of radians are found only if they are not near zero.
        assert is_found == (share >= 0.3)
    if unit == true_unit:
        assert not is_found
        assert ("units" in report.passed) == (share >= 0.3 or (unit == "rad" and share >= 0.04))
    if share == 0.0:
        assert "all joints are near 0" in report.skipped["units"]
