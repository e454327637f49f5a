"""Successful robots of a replica, and the tasks that they solve per GPU-hour.

A robot that has an action at each tick can still fail, since each action was computed from an
observation of the past. The `SuccessCurve` of a policy says how many tasks it solves at each delay
of its answers. The *delay of an answer* is the number of rows that the robot executed between the
answer's observation and its first row. A robot is **successful** if

- at least 98 % of its ticks were in time, or spent in a wait that its control loop chose, such as
  that of a loop which executes a chunk, and then waits for the next one,
- and at least 98 % of its answers came within the policy's *tolerated delay* d*.

A wait is chosen for at most d* ticks. Otherwise a robot that waits for each answer would be
successful behind any server, however late.

The **tasks per GPU-hour** rank all loops and servers on one scale: the sum over robots of the tasks
that the curve promises at the delays of their answers, less the ticks at which they stood.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vlagents_ray.success import SuccessCurve, read_curves

CHECKPOINT = Path("examples/reference/checkpoint")  # its success is assumed of all robots
ENOUGH = 0.98  # minimum share of the ticks of a robot in time, and of its answers within d*


@dataclass(frozen=True, slots=True)
class ServedRobot:
    """The service to one robot during a measurement."""

    hz: float  # rate of its ticks
    ticks: float  # number of ticks, with all waits
    starved: float  # number of ticks without an action, not counting waits that the loop chose
    # The duration of each wait that the loop chose, in ticks.
    waits: Sequence[float] = ()
    # The delay of each answer, in rows; `math.inf` for an answer that had no row left.
    delays: Sequence[float] = ()

    def moving(self) -> float:
        """Return the share of the ticks at which the robot executed a row; 0 without ticks."""
        if not self.ticks > 0:
            return 0.0
        return max(0.0, 1 - (self.starved + sum(self.waits)) / self.ticks)

    def in_time(self, tolerated: float) -> float:
        """Return the share of the ticks in time, or in a chosen wait; 0 without ticks.

        Args:
            tolerated: The largest number of ticks of a chosen wait.
        """
        if not self.ticks > 0:
            return 0.0
        # In this order, NaN stays NaN, and the share becomes 0.
        too_long = sum(max(wait - tolerated, 0.0) for wait in self.waits)
        return max(0.0, 1 - (self.starved + too_long) / self.ticks)

    def within(self, tolerated: float) -> float:
        """Return the share of the answers with a delay of at most `tolerated` rows; 0 without
        answers.
        """
        if not self.delays:
            return 0.0
        return sum(delay <= tolerated for delay in self.delays) / len(self.delays)

    def is_successful(self, tolerated: int) -> bool:
        """Return whether the robot is successful, as the docstring of the module defines it.

        Args:
            tolerated: The tolerated delay of the policy, in rows.
        """
        return self.in_time(tolerated) >= ENOUGH and self.within(tolerated) >= ENOUGH

    def tasks_per_hour(self, curve: SuccessCurve) -> float:
        """Return the number of tasks that the robot solves in an hour, according to the curve.

        Answers without a row left do not count, as they move no robot; the robot then starves. The
        waits are those of a waiting loop. Those of the chunk player, before it moves a gripper, are
        in the ticks of the curve, and the policy of the benchmark moves no gripper.
        """
        delays = [delay for delay in self.delays if math.isfinite(delay)]
        if not delays:
            return 0.0
        per_hour = sum(curve.tasks_per_hour(delay) for delay in delays) / len(delays)
        # The curve's rate is that of its environment.
        return self.moving() * per_hour * self.hz / curve.hz


@dataclass(frozen=True, slots=True)
class FleetSuccess:
    """The two figures of a replica's robots."""

    successful: int  # number of successful robots
    tasks_per_gpu_hour: float

    @classmethod
    def from_robots(cls, robots: Sequence[ServedRobot], curve: SuccessCurve) -> FleetSuccess:
        """Return the figures of robots that share one replica on one GPU."""
        return cls(
            sum(robot.is_successful(curve.tolerated) for robot in robots),
            sum(robot.tasks_per_hour(curve) for robot in robots),
        )


def curve_of(checkpoint: Path, loop: str = "player") -> SuccessCurve | None:
    """Return the measured success of a checkpoint with a control loop; None if it was not measured
    (`benchmarks.delays`).

    Of several settings, it is the success with those that tolerate the longest delay, each in its
    hardest environment, as in `vlagents_ray.serve.in_time.tolerated_age_ms`.

    Args:
        checkpoint: The folder of the checkpoint.
        loop: "player", which executes chunks in the background, or "waiting".

    Raises:
        ConfigError: The checkpoint's file of curves cannot be read.
    """
    curves = read_curves(checkpoint)
    of_player = [curve for curve in curves if curve.mode == "async"]
    of_waiting = [curve for curve in curves if curve.mode == "open_loop"]
    # Answers to a waiting loop have no delay, at which the success of all modes is the same.
    chosen = of_player if loop == "player" else of_waiting or of_player

    hardest: dict[str, SuccessCurve] = {}  # keys: settings
    for curve in chosen:
        settings = repr(sorted(curve.settings.items()))
        hardest[settings] = min(hardest.get(settings, curve), curve, key=_tolerated)
    return max(hardest.values(), key=_tolerated, default=None)


def _tolerated(curve: SuccessCurve) -> int:
    return curve.tolerated
