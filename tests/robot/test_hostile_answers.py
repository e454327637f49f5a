"""Data of any type next to the actions in a server's answers: it does not affect a run of the
control loop, or the run ends with an error of this package before the first motion; and no text of
it can forge a log line.
"""

from __future__ import annotations

import contextlib
import logging
from typing import Any

import numpy as np
import pytest

from vlagents_ray import Act, ActionSpec, Agent, Contract, Obs, VLAgentsError
from vlagents_ray.cli.robot import _say_timeliness
from vlagents_ray.robot import run_loop
from vlagents_ray.robot.loop import LoopReport

HZ = 200.0
FORGED = "\x1b[2J\x1b]52;c;ZXZpbA==\x07 \x9b31m \u202e\r\n2026-11-28 INFO robot: restarted by anna"
VALUES: list[Any] = [
    *(None, True, 0, -1, 1.5, float("nan"), 10**400, "", "x", FORGED, b"x"),
    *([], [1], ["x"], [[1.0, 2.0]], {}, {"a": 1}, {"min": 1}, {"min": [1], "max": "x"}),
]


class Arm:
    contract = Contract(action=ActionSpec(dim=2, delta=False))
    applied = 0

    def observe(self) -> Obs:
        return Obs(state={"joints": np.zeros(2, np.float32)})

    def apply(self, action: np.ndarray) -> None:
        self.applied += 1

    def stop(self) -> None: ...


class Told(Agent):
    """A policy that acts, and returns the given info of a server."""

    contract = Contract(action=ActionSpec(dim=2, delta=False))
    reads_slo = True

    def __init__(self, info: Any = None, statistics: Any = None) -> None:
        self.info, self.statistics = info, statistics

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict[str, Any]:
        info: dict[str, Any] = self.info
        return info

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros(2, np.float32))


@pytest.mark.slow
@pytest.mark.parametrize("value", VALUES, ids=range(len(VALUES)))
@pytest.mark.parametrize("field", ["info", "slo", "load", "in_time", "reason"])
def test_an_answer_to_an_slo_of_any_type_ends_no_run_and_forges_no_line(
    field: str, value: Any, caplog: pytest.LogCaptureFixture
) -> None:
    answer: Any = {"load": 2.0, "in_time": False, "reason": "too many robots"}
    if field in answer:
        answer = answer | {field: value}
    info = value if field == "info" else {"slo": value if field == "slo" else answer}

    said: list[str] = []
    with caplog.at_level(logging.WARNING):
        report = run_loop(Arm(), Told(info), hz=HZ, seconds=2 / HZ)
    _say_timeliness(report, said.append)
    lines = [*said, *(record.getMessage() for record in caplog.records)]
    assert all(line.isprintable() for line in lines)
    if field in ("load", "reason"):
        assert any(line.startswith("slo: ") for line in lines)


@pytest.mark.parametrize("value", VALUES, ids=range(len(VALUES)))
@pytest.mark.parametrize("field", ["statistics", "state", "action", "min", "max", "parts"])
def test_statistics_of_any_type_move_no_arm_unless_they_are_ranges(field: str, value: Any) -> None:
    span: dict[str, Any] = {"min": [-1.0, -1.0], "max": [1.0, 1.0]}
    if field in span:
        span = span | {field: value}
    statistics: Any = {"state": span, "action": span, "parts": ["joints"]}
    if field in statistics:
        statistics = statistics | {field: value}

    arm = Arm()
    with contextlib.suppress(VLAgentsError):
        told = value if field == "statistics" else statistics
        report: LoopReport = run_loop(arm, Told({}, told), hz=HZ, seconds=2 / HZ)
        assert report.jitter
        return
    assert not arm.applied
