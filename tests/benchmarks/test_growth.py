"""The fleet of robots and the curves by sessions and replicas."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.growth import GrowthPlan, figures, measure_growth, plot_growth, show_growth


def test_an_act_is_on_time_if_it_ends_within_its_period() -> None:
    """Three acts at 10 Hz; during the last one, two further ticks passed."""
    found = figures([(1.0, 20.0, 0.0, 1), (1.1, 100.0, 0.0, 1), (1.5, 260.0, 0.0, 1)], hz=10.0)
    assert found["acts"] == 3
    assert found["on_time"] == pytest.approx(2 / 5)
    assert found["p50_ms"] == pytest.approx(100)


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.server
def test_the_fleet_and_both_curves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = GrowthPlan(robots=3, hz=5, sessions=[1, 6], replicas=[1, 2], acts_per_s=20, seconds=1)
    found = json.loads(json.dumps(measure_growth(plan)))
    assert 0 < found["fleet"]["acts"] <= 15  # 15 ticks, some of which pass if the machine is busy
    assert [one["sessions"] for one in found["sessions"]] == [1, 6]
    assert [one["replicas"] for one in found["replicas"]] == [1, 2]
    assert [sum(one["sessions_by_replica"]) for one in found["replicas"]] == [3, 3]
    for one in (found["fleet"], *found["sessions"], *found["replicas"]):
        assert 0 <= one["on_time"] <= 1
        assert one["client"]["cpu_ms"] > 0
        assert one["server"]["programs"]["ServeReplica"] > 0
    show_growth(found)
    assert len([line for line in capsys.readouterr().out.splitlines() if "%" in line]) == 5
    plot_growth(found, tmp_path / "growth.svg")
    assert (tmp_path / "growth.svg").stat().st_size > 1000
