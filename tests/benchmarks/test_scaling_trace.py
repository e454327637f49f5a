"""The figures of an autoscaling trace; tests/integration/test_load.py records one."""

from __future__ import annotations

from typing import Any

from benchmarks.autoscaling import ScaleSample
from benchmarks.scaling_trace import TracePlan, report


def figures(late: list[float], missed: int = 0, resumed: int = 0) -> dict[str, Any]:
    return {
        "ticks": 100,
        "starved": len(late) + missed,
        "missed": missed,
        "late": late,
        "resumed": resumed,
        "failed": "",
    }


def test_a_trace_has_the_time_of_the_replicas_and_that_of_the_last_late_tick() -> None:
    samples = [
        ScaleSample(-5.0, 1, 1, 1),
        ScaleSample(1.0, 1, 1, 3),
        ScaleSample(4.0, 2, 1, 3),
        ScaleSample(8.0, 2, 2, 3),
        ScaleSample(35.0, 1, 1, 1),
    ]
    plan = TracePlan(robots=3, burst_s=30.0)
    # Neither a second in which the robot's own process paused counts for the server, nor a tick
    # long after the burst.
    burst = [figures([0.5, 3.0, 7.5, 25.0], missed=10), figures([1.0], resumed=1)]
    traced = report(plan, samples, [figures([-4.0])], burst)
    assert (traced["requested_s"], traced["running_s"], traced["in_time_s"]) == (4.0, 8.0, 7.5)
    assert traced["replicas"] == [[-5.0, 1, 1], [4.0, 2, 1], [8.0, 2, 2], [35.0, 1, 1]]
    assert (traced["ticks"], traced["starved"], traced["missed"]) == (300, 6, 10)
    assert (traced["starved_by_first"], traced["resumed"], traced["failed"]) == (1, 1, [])
