"""Data of any type next to the actions in a server's answers: it does not affect a run of the
control loop, or the run ends with an error of this package before the first motion; and no text of
it can forge a log line.
"""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
import pytest

from vlagents_ray import Act, ActionSpec, Agent, Contract, Obs, VLAgentsError
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

    def __init__(self, info: Any = None, statistics: Any = None) -> None:
        self.info, self.statistics = info, statistics

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict[str, Any]:
        info: dict[str, Any] = self.info
        return info

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros(2, np.float32))


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
