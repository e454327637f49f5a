"""Placement of replicas for robots with large and small needs, in virtual time."""

from __future__ import annotations

import pytest

from benchmarks.placement import PlacementPlan, place


@pytest.mark.slow
def test_replicas_of_robots_that_differ_are_evener_if_sessions_are_placed_by_needs() -> None:
    plan = PlacementPlan(replicas=4, robots=30, begin_within_s=20.0, seconds=40.0)
    by_number = place(plan, 0, weighs_robots=False)
    by_needs = place(plan, 0, weighs_robots=True)
    assert by_needs.largest_load < 1.05 < by_number.largest_load
    assert by_needs.share >= by_number.share
    assert by_needs.robots_in_time >= by_number.robots_in_time
    assert by_needs.robots_in_time >= 0.98 * by_needs.robots
