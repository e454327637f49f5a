"""The simulation of a large fleet, on a small one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.fleet_simulation import IN_TIME, RACK_LOST_S, Shape, events, limits, main, run

SMALL = Shape(robots=100, replicas=10, nodes=5)


def test_robots_are_in_time_again_after_the_losses() -> None:
    tally, world = run(SMALL, seed=1, least_loaded=True, until_s=170.0)
    found = events(tally, 170.0)
    assert [event.name for event in found][-1] == "the nodes are back"
    assert all(event.share > 0.9 for event in found)
    by_name = {event.name: event for event in found}
    assert by_name["all act"].worst_share >= IN_TIME
    assert by_name["a rack is lost"].worst_share < 1
    assert 0 < by_name["a rack is lost"].recovered_s < 15
    assert sum(replica.sessions for replica in world.replicas["pi0"]) == SMALL.robots
    assert RACK_LOST_S < 170


def test_the_first_limit_is_named_first() -> None:
    found = limits(Shape(), requests_hz=2.0)
    assert [limit.limit_robots for limit in found] == sorted(limit.limit_robots for limit in found)
    assert {"controller of Ray Serve", "comparisons of sessions between replicas"} <= {
        limit.part for limit in found
    }
    assert all(limit.source for limit in found)


def test_the_results_are_printed_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--robots", "40", "--replicas", "5", "--nodes", "5", "--seconds", "70", "--hashed"]
    main([*words, "--json", str(tmp_path / "results.json")])
    printed = capsys.readouterr().out
    assert "40 robots at 10 Hz" in printed
    assert "| all robots start within a minute | " in printed
    assert "Assumed: " in printed
    document = json.loads((tmp_path / "results.json").read_text())
    assert document["placement"] == "by hash"
    assert document["share"] > 0.9
