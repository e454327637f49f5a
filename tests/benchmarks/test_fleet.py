"""The settings of the fleet benchmark, and a small fleet with a server, also over an
emulated link.
"""

from __future__ import annotations

import contextlib
import json
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks import fleet_robots
from benchmarks.fleet import OURS, FleetPlan, Kind, measure_fleet
from benchmarks.fleet_robots import Robot, RunningRobot
from benchmarks.fleet_runs import summary
from benchmarks.link import enter
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Act, Agent, Obs

# Four robots need a tenth of the policy's time, but the machine of the tests may be busy.
IN_TIME = 0.7
FEW = FleetPlan(
    systems=(OURS,),
    robots=(4,),
    kinds=(Kind(10.0, 8),),
    chunk=8,
    warm=2.0,
    seconds=3.0,
    python=Path("/opt/peers/bin/python"),
)


def test_a_plan_crosses_a_process_as_json() -> None:
    settings = json.loads(json.dumps(FEW.to_json()))
    assert json.loads(json.dumps(FleetPlan.from_json(settings).to_json())) == settings
    assert FleetPlan.from_json(settings).fleet(3) == [Kind(10.0, 8)] * 3


class Late(Agent):
    """A policy whose answers arrive after the end of a measurement."""

    contract = Contract(action=ActionSpec(dim=7, delta=True), chunk=8)

    def act(self, obs: Obs) -> Act:
        time.sleep(0.6)
        return Act(np.zeros((8, 7), np.float32))


def test_a_robot_that_waits_for_its_first_answer_is_not_served(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(fleet_robots, "connect", lambda _: Late())
    with contextlib.closing(RunningRobot(Robot("", 10.0, 8))) as robot:
        begin = time.monotonic()
        figures = robot.run(begin, begin + 0.1, begin + 0.5)
    assert (figures["ticks"], figures["starved"]) == (4, 4)
    assert summary([figures])["served"] == 0


@pytest.mark.server
@pytest.mark.integration
@pytest.mark.parametrize(
    ("transport", "real_time_chunking", "hz"),
    [("http", False, 10.0), ("websocket", True, 10.0), ("websocket", False, 5.0)],
)
def test_a_few_robots_are_in_time(transport: str, real_time_chunking: bool, hz: float) -> None:
    plan = FleetPlan.from_json(
        {
            **FEW.to_json(),
            "kinds": [{"hz": hz, "rows": 8}],
            "transport": transport,
            "real_time_chunking": real_time_chunking,
        }
    )
    [point] = measure_fleet(plan)["points"]
    assert point["failed"] == []
    assert point["share"] >= IN_TIME, point
    assert point["server_cpu_s"] > 0
    assert point["client_cpu_s"] > 0


@pytest.mark.slow
@pytest.mark.server
@pytest.mark.integration
@pytest.mark.alone
def test_a_few_robots_over_a_link_are_in_time() -> None:
    try:
        enter()
    except ConfigError as error:
        pytest.skip(str(error))
    plan = FleetPlan.from_json({**FEW.to_json(), "link": "100mbit"})
    measured = measure_fleet(plan)
    assert measured["measured_mbit_per_s"] <= 100
    [point] = measured["points"]
    assert point["failed"] == []
    assert point["share"] >= IN_TIME, point
