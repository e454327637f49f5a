"""The fleet of robots, and the curves by number of sessions and replicas."""

from __future__ import annotations

import contextlib
import json
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks import robots
from benchmarks.growth import GrowthPlan, figures, measure_growth, plot_growth, show_growth


def test_an_act_is_on_time_if_it_ends_within_its_period() -> None:
    """Three acts at 10 Hz; during the last one, two further ticks passed."""
    found = figures(np.array([20.0, 100.0, 260.0]), hz=10.0)
    assert found["on_time"] == pytest.approx(2 / 5)
    assert found["p50_ms"] == pytest.approx(100)


class SlowAgent:
    """A policy whose acts take 0.15 s."""

    def reset(self, *_: object) -> dict[str, int]:
        return {"pid": 7}

    def act(self, _: object) -> None:
        time.sleep(0.15)

    def close(self) -> None:
        pass


def test_a_robot_skips_the_ticks_that_pass_during_an_act(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robots, "connect", lambda *_: SlowAgent())
    with contextlib.closing(
        robots.ConnectedRobots("http://127.0.0.1:9", "websocket", 2)
    ) as connected:
        assert connected.replicas == [7, 7]
        begun = time.monotonic()
        ms = connected.run(begun, begun + 1, hz=10)
    assert 2 <= len(ms) <= 10  # five of each, if the machine is not busy
    assert min(ms) >= 150


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.server
def test_the_fleet_and_both_curves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = GrowthPlan(robots=10, hz=10, sessions=[1, 6], replicas=[1, 2], acts_per_s=100, seconds=1)
    found = json.loads(json.dumps(measure_growth(plan)))
    # 100 ticks, some of which are missed if the machine is busy
    assert 0 < found["fleet"]["acts"] <= 100
    assert [one["sessions"] for one in found["sessions"]] == [1, 6]
    assert [one["replicas"] for one in found["replicas"]] == [1, 2]
    assert [sum(one["sessions_by_replica"]) for one in found["replicas"]] == [10, 10]
    for one in (found["fleet"], *found["sessions"], *found["replicas"]):
        assert 0 <= one["on_time"] <= 1
        assert one["client"]["cpu_ms"] > 0
        assert one["server"]["programs"]["ServeReplica"] > 0
    show_growth(found)
    assert len([line for line in capsys.readouterr().out.splitlines() if "%" in line]) == 5
    plot_growth(found, tmp_path / "growth.svg")
    assert (tmp_path / "growth.svg").stat().st_size > 1000
