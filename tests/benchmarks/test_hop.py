from __future__ import annotations

from benchmarks.hop import CHILD, IN_PROCESS, measure_hop


def test_both_ways_are_measured_in_turns_and_the_child_costs_time() -> None:
    here, there = measure_hop(200).ours
    assert (here.name, there.name) == (IN_PROCESS, CHILD)
    assert here.rounds.shape == there.rounds.shape == (2, 100)
    assert 0 < here.median < there.median
