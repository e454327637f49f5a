"""Simulates autoscaling by the objective in virtual time: traces of a burst, a square wave and a
slow rise.

The real policy of autoscaling is called as Serve's controller calls it, with the reports of
simulated replicas. Each replica takes a while to start, serves its share of the robots once they
have moved, and misses ticks when the robots need more than its capacity. The delays before a change
are those of the deployment's settings: a change must be requested without a break for that long.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import typer

from benchmarks.console import Out, save
from vlagents_ray.cli.console import errors, out, table
from vlagents_ray.serve.config.deployment import AutoscalingArgs
from vlagents_ray.serve.fleet import CostCurve, RobotNeed
from vlagents_ray.serve.scaling.autoscaling import (
    LATE_ROBOTS,
    SESSIONS,
    SLO_LOAD,
    SLO_ROBOTS,
    UTILISATION,
    WAITING,
    MeasuredLoad,
)
from vlagents_ray.serve.scaling.slo_load import most_on_replica, slo_load
from vlagents_ray.slo import SHARE

PI0 = CostCurve(0.0293, 0.00806)  # costs of pi0 on an H200, compiled, s
# Needs of a robot; a replica of pi0 serves seven such robots.
FRESH = RobotNeed(hz=10.0, rows=8, age_s=0.2)
_STEP_S = 1.0  # step of virtual time, s
_WINDOW_S = 10  # time over which a robot's share is computed, s


@dataclass(frozen=True, slots=True)
class SimulatedFleet:
    """The robots' needs, the replicas and the settings of autoscaling."""

    need: RobotNeed = FRESH
    costs: CostCurve = PI0
    max_batch_size: int = 16
    start_s: float = 30.0  # duration of the start of a replica, s
    # Time from the start of a replica until its share of the sessions has moved to it, s: the
    # replica tells the others that it has started, and their clients reconnect after their next
    # answers.
    move_s: float = 2.0
    autoscaling: AutoscalingArgs = field(default_factory=partial(AutoscalingArgs, max_replicas=16))
    hidden_late: Callable[[int, int], int] | None = None
    """Returns, for a number of replicas and of robots, the number of robots that are late for a
    reason that their needs do not show.
    """


class ScalingStep(NamedTuple):
    """One second of a trace."""

    at: float  # time, s
    robots: int
    replicas: int  # number of replicas that serve robots
    requested: int  # number of requested replicas
    missed: float  # share of the robots' ticks that were missed in this second


class _Report(NamedTuple):
    """The sums of the reports of all replicas at one time."""

    at: float  # time, s
    values: dict[str, float]  # reported values by name


@dataclass(slots=True)
class _Controller:
    """A simulation of Serve's controller, which delays each change."""

    policy: MeasuredLoad
    options: Mapping[str, Any]  # autoscaling options of Serve
    target: int = 1
    state: dict[str, Any] = field(default_factory=dict)
    requested_since: float | None = None
    direction: int = 0

    def decide(self, now: float, running: int, reports: Sequence[_Report]) -> None:
        """Call the policy with the reports of `running` replicas, and apply its request after its
        delay.
        """
        look_back_s = self.options["look_back_period_s"]
        recent = [report for report in reports if now - report.at < look_back_s]
        aggregated, raw = {}, {}
        for name, last in reports[-1].values.items():
            mean = sum(report.values[name] for report in recent) / len(recent)
            aggregated[name] = dict.fromkeys(range(running), mean / running)
            series = [SimpleNamespace(value=last / running)]
            raw[name] = dict.fromkeys(range(running), series)

        context = SimpleNamespace(
            aggregated_metrics=aggregated,
            raw_metrics=raw,
            target_num_replicas=self.target,
            current_num_replicas=running,
            total_num_requests=0.0,
            policy_state=self.state,
            current_time=now,
            config=SimpleNamespace(look_back_period_s=look_back_s),
        )
        requested, self.state = self.policy(context)
        requested = min(self.options["max_replicas"], max(1, requested))

        direction = (requested > self.target) - (requested < self.target)
        if direction != self.direction:
            self.direction, self.requested_since = direction, now
        delays_s = {
            1: self.options["upscale_delay_s"],
            -1: self.options["downscale_delay_s"],
            0: math.inf,
        }
        if self.requested_since is not None and now - self.requested_since >= delays_s[direction]:
            self.target, self.direction, self.requested_since = requested, 0, None


def simulate(
    robots_at: Callable[[float], int], seconds: float, fleet: SimulatedFleet
) -> list[ScalingStep]:
    """Return the trace of one run from a single replica.

    Args:
        robots_at: The number of robots at a time, s.
        seconds: The length of the run.
        fleet: The robots' needs, the replicas and the settings.
    """
    options = fleet.autoscaling.options()
    controller = _Controller(MeasuredLoad(**options["policy"]["policy_kwargs"]), options)
    ready_at = [0.0]  # the times at which each replica serves its share of the robots, s
    reports: list[_Report] = []
    reported_robots = 0
    shares: list[float] = []  # shares of missed ticks in the last seconds
    trace = []
    now = 0.0
    while now < seconds:
        robots = robots_at(now)
        running = sum(ready <= now for ready in ready_at)
        most = running * most_on_replica(fleet.costs, fleet.need, fleet.max_batch_size)
        missed = max(0.0, 1 - most / robots) if robots else 0.0
        shares = [*shares, missed][-_WINDOW_S:]
        late = robots if sum(shares) / len(shares) > 1 - SHARE else 0
        if fleet.hidden_late is not None:
            late = max(late, fleet.hidden_late(running, robots))

        # Replicas report periodically, and at once when robots come or leave.
        is_due = not reports or now - reports[-1].at >= options["metrics_interval_s"]
        if is_due or robots != reported_robots:
            reported_robots = robots
            values = {
                # The robots replan as often as they may, which keeps all replicas busy.
                UTILISATION: float(running) if robots else 0.0,
                WAITING: 0.0,
                SESSIONS: float(robots),
                SLO_LOAD: slo_load(fleet.costs, {fleet.need: robots}, fleet.max_batch_size),
                SLO_ROBOTS: float(robots),
                LATE_ROBOTS: float(late),
            }
            reports.append(_Report(now, values))
        controller.decide(now, running, reports)
        starting = controller.target - len(ready_at)
        ready_at += [now + fleet.start_s + fleet.move_s] * max(0, starting)
        ready_at = sorted(ready_at)[: controller.target]
        trace.append(ScalingStep(now, robots, running, controller.target, missed))
        now += _STEP_S
    return trace


def changes(trace: list[ScalingStep]) -> list[int]:
    """Return the numbers of replicas that were requested one after the other."""
    requested = [step.requested for step in trace]
    return [
        number
        for number, before in zip(requested, [None, *requested], strict=False)
        if number != before
    ]


def seconds_late(trace: list[ScalingStep]) -> float:
    """Return the time in which ticks were missed, s."""
    return _STEP_S * sum(step.missed > 1 - SHARE for step in trace)


def burst(now: float) -> int:
    """Return 1 robot, and 16 robots after a minute."""
    return 1 if now < 60 else 16


def square_wave(now: float) -> int:
    """Return 4 and 12 robots, alternating every two minutes."""
    return 4 if now % 240 < 120 else 12


def slow_rise(now: float) -> int:
    """Return a number of robots that grows by one each minute, up to 24."""
    return min(24, 1 + int(now // 60))


SCENARIOS: Mapping[str, tuple[Callable[[float], int], float]] = {
    "burst": (burst, 600.0),
    "square wave": (square_wave, 1920.0),
    "slow rise": (slow_rise, 1800.0),
}


def main(out_file: Out = None) -> None:
    """Print the numbers of replicas over time, and the ticks missed, for each scenario."""
    with errors():
        fleet = SimulatedFleet()
        traces = {}
        rows = table("", "robots", "replicas requested", "s with missed ticks", "ticks missed")
        for name, (robots_at, seconds) in SCENARIOS.items():
            trace = simulate(robots_at, seconds, fleet)
            traces[name] = [step._asdict() for step in trace]
            ticks = sum(step.robots for step in trace)
            missed = sum(step.missed * step.robots for step in trace) / ticks
            rows.add_row(
                name,
                f"{min(step.robots for step in trace)} to {max(step.robots for step in trace)}",
                " ".join(map(str, changes(trace))),
                f"{seconds_late(trace):g}",
                f"{100 * missed:.2f} %",
            )
        out.print(rows)
        save(traces, out_file)


if __name__ == "__main__":
    typer.run(main)
