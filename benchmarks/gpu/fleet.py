"""The fleet experiment with π0 itself, without Ray: robots in separate processes, whose ticks do
not wait for the policy.
"""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from typing import Any

from benchmarks.fleet_robots import Robot
from benchmarks.fleet_runs import run_robots, summary
from benchmarks.gpu.http_server import http_server
from benchmarks.gpu.lab import Lab
from benchmarks.measured_policy import MeasuredPolicy
from vlagents_ray.serve.fleet import CostCurve, RobotNeed, most_robots

SHORT_ROWS = 8  # number of rows of an answer that robots with short chunks execute
# Rate, whether robots execute whole chunks, and numbers of robots as shares of the number that the
# measured batches can serve by arithmetic.
FLEETS: Sequence[tuple[float, bool, Sequence[float]]] = (
    (10.0, False, (0.6, 0.9)),
    (5.0, False, (0.9,)),
    (10.0, True, (0.9,)),
)
LEAST_SHARE = 0.98  # minimum share of the ticks of a fleet that must have an action in time


def fleet(lab: Lab) -> None:
    """Robots at 5 and 10 Hz, with short and with whole chunks: the share of ticks with an action in
    time, by the number of robots.
    """
    sizes: Sequence[int] = lab.size((1, 4, 8, 12, 16), (1, 2))
    config = lab.settings(max_rows=sizes[-1], compile=lab.graphs, batch_sizes=list(sizes))
    points: list[dict[str, Any]] = []
    with lab.measured(config=config, largest=sizes[-1]) as measured:
        contract = measured.engine.contract
        chunk = 1 if contract is None or contract.chunk is None else contract.chunk
        costs = padded_costs(measured, sizes, lab.size(0.5, 0.02))
        lab.show(batches=[{"rows": size, "ms": 1e3 * costs.cost_s(size)} for size in sizes])
        with http_server(measured.engine) as url:
            for hz, is_whole, shares in FLEETS:
                rows = chunk if is_whole else min(SHORT_ROWS, chunk)
                most = lab.size(most_robots(costs, RobotNeed(hz, rows), sizes[-1]), 2)
                robot = Robot(url, hz, chunk, rows=rows, fits_contract=True)
                for share in shares:
                    figures = _figures(lab, robot, max(1, int(share * most)))
                    points.append({**figures, "of_arithmetic": share})
                    lab.show(fleet=points)

    lab.check("failed robots", sum(point["failed"] for point in points), equal=0)
    lab.check(
        "least share of the ticks in time",
        min(point["share"] for point in points),
        least=LEAST_SHARE,
        speed=True,
    )


def _figures(lab: Lab, robot: Robot, count: int) -> dict[str, Any]:
    """Run a number of equal robots, and return their combined figures."""
    plan_s = robot.chunk / robot.hz if robot.rows is None else robot.rows / robot.hz
    # The pace of a fleet whose robots begin at the same time settles within two plans.
    warm_s = lab.size(max(5.0, 2 * plan_s), 0.5)
    run = run_robots([robot] * count, warm_s, lab.size(8.0, 1.0))
    errors = [figures["failed"] for figures in run.figures if figures["failed"]]
    if errors:
        lab.show(error=errors[0])
    return {
        "hz": robot.hz,
        "rows": robot.rows,
        "robots": count,
        **summary(run.figures),
        "failed": len(errors),
    }


def padded_costs(measured: MeasuredPolicy, sizes: Sequence[int], seconds: float) -> CostCurve:
    """Measure the durations of batches of all sizes up to the largest one.

    Args:
        measured: The policy.
        sizes: The compiled sizes in ascending order; a batch is padded to the next size.
        seconds: The duration of the measurement of each size, s.
    """
    durations_s = [measured.bare(size, seconds)["batch_ms"] / 1e3 for size in sizes]
    table = [
        (rows, durations_s[bisect.bisect_left(sizes, rows)]) for rows in range(1, sizes[-1] + 1)
    ]
    return CostCurve(table=tuple(table))
