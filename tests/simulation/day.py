"""Tests that a day of control has no jump.

`python -m tests.simulation.day --seed 1` simulates 24 hours at 50 Hz with faults. Control loop, chunk
player, guard, watchdog and command inbox are those of a real robot; the arm, the network, the
server, the operator and all clocks are simulated, so that a day takes some minutes, and a seed
repeats it exactly. At each command the simulation checks:

- no step is above 3 times the largest step of a run without faults, or above the speed limit, even
  from the measured pose after a stop;
- there is no command after a stop or a pause until the operator at the robot has restarted it.

`--relative` runs the day with relative actions, `--arms 2` with two arms. The exit status is 0
without a violation, otherwise 1. The report has the time of a violation, which the same seed and a
suitable `--hours` repeat.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated
from unittest import mock

import numpy as np
import typer

from vlagents_ray.chunking import buffer, player
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.cli.console import errors, out
from vlagents_ray.client.commands import COMMAND, CommandInbox
from vlagents_ray.columns import Columns
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import (
    ConnectionLost,
    DeadlineExceeded,
    PolicyFailed,
    PolicyUnavailable,
    VLAgentsError,
)
from vlagents_ray.interface import CAPTURED, Act, Agent, Obs
from vlagents_ray.robot import Guard, LoopOptions, MotionLimits, Watchdog, loop, run_loop, watchdog

HZ = 50.0
# Duration of a run of the control loop, s; between two runs the arm goes to its rest pose.
RUN_S = 3600.0
CHUNK = 50  # number of rows, which last 1 s
INFERENCE_S = 0.03
TIMEOUT_S = 10.0  # timeout of a request, s
FACTOR = 3.0  # A step above this multiple of the normal step is a jump.
_TURN = 2 * math.pi / (4 * HZ)  # change of the path's angle in a tick, rad: one round takes 4 s
_RADIUS = 0.5  # radius of the path, rad
_SWAY = 0.0005  # distance of the paths of two chunks, rad
_SMOOTHING = 0.5  # share of the distance to its target that a joint moves in a tick
_LAG = 1.0  # number of ticks by which the joints lag behind their targets, with this smoothing
REST = (_RADIUS, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0)
SPEED = 2.0  # speed limit, rad/s
# The motion limits of an arm.
LIMITS = MotionLimits(velocity=SPEED, acceleration=15.0, jerk=1000.0, rest=(*REST[:6], None))
_PULL = 0.0005  # maximum correction of a relative action towards the path in a tick, rad
FAULTS = {  # the mean duration of each fault, s; 0 for a moment
    "killed": 15.0,
    "frozen": 5.0,
    "far": 120.0,
    "lossy": 60.0,
    "cut": 10.0,
    "old picture": 3.0,
    "robot holds": 3.0,
    "NaN": 1.0,
    "wrong shape": 1.0,
    "jump": 1.0,
    "beyond limits": 1.0,
    "policy error": 1.0,
    "broken sensor": 1.0,
    "guard error": 0.0,
    "loop hangs": 0.0,
    "clock step": 0.0,
    "stop from afar": 0.0,
    "pause from afar": 0.0,
    "restart from afar": 0.0,
    "pushed": 0.0,
}
_EVERY_S = 45.0  # mean time between two faults, s


class DayClock:
    """Replaces the module `time` in the modules of the control loop. It advances by ticks, and its
    wall time may be set.
    """

    def __init__(self) -> None:
        self.now, self.offset = 0.0, 1.7e9

    def monotonic(self) -> float:
        return self.now

    def perf_counter(self) -> float:
        return self.now

    def time(self) -> float:
        return self.now + self.offset


@dataclass(slots=True)
class DayReport:
    """The figures of a day."""

    seed: int
    hours: float
    ticks: int = 0
    commands: int = 0
    moving_s: float = 0.0
    relative: bool = False
    arms: int = 1
    runs: int = 0
    failed_runs: int = 0  # number of runs that ended with an error
    stops: int = 0
    restarts: int = 0  # number of restarts by the operator at the robot
    normal_step: float = 0.0  # largest step of a run without faults, rad
    largest_step: float = 0.0  # largest step, rad
    faults: dict[str, int] = field(default_factory=dict)
    # Number of ticks without the policy, by cause, in whole runs.
    held: dict[str, int] = field(default_factory=dict)
    violations: list[str] = field(default_factory=list)
    digest: str = ""  # digest of all commands


class World:
    """The simulated arm, its surroundings and its operator; its `robot` methods are those of
    `vlagents_ray.robot.Robot`.
    """

    def __init__(
        self, seed: int, hours: float, *, faults: bool, relative: bool = False, arms: int = 1
    ) -> None:
        self.clock = DayClock()
        self.report = DayReport(seed, hours, relative=relative, arms=arms)
        self.random = np.random.default_rng(seed)
        names = tuple(f"arm{number}" for number in range(arms)) if arms > 1 else None
        self.action = ActionSpec(
            dim=len(REST) * arms, delta=relative, gripper_open=1.0, gripper_closed=0.0, arms=names
        )
        self.deltas = list(Columns.from_spec(self.action, len(REST) * arms).relative)
        self.grippers = list(Columns.from_spec(self.action, len(REST) * arms).grippers)
        self.joints = np.tile(np.array(REST, np.float32), arms)
        self.target = self.joints.copy()
        self.commanded = self.joints.copy()  # the last command, or the rest pose
        self.holds: str | None = None
        self.until: dict[str, float] = {}  # the end of each current fault, s
        self.forbidden: str | None = None  # the reason why no command is allowed
        self.restart_at = math.inf
        self.hang_s = 0.0
        self.guard_fails = False
        self._next_fault = self.random.exponential(_EVERY_S) if faults else math.inf
        self._picture: Obs | None = None
        self._sum = hashlib.sha256()
        self.commands = CommandInbox()
        self.watchdog = DayWatchdog(self._barked, {"server": 2.0, "loop": 0.25})
        self.watchdog.clock = self.clock

    def has(self, fault: str) -> bool:
        """Return whether a fault is active."""
        return self.until.get(fault, 0.0) > self.clock.now

    def observe(self) -> Obs:
        """Return an observation of the joints; while the camera hangs, return the previous
        observation.
        """
        self.joints = self.joints + np.float32(_SMOOTHING) * (self.target - self.joints)
        if self._picture is None or not self.has("old picture"):
            self._picture = Obs(
                state={"joints": self.joints.copy()}, info={CAPTURED: self.clock.time()}
            )
        return self._picture

    def apply(self, action: np.ndarray) -> None:
        """Check and execute a command."""
        report = self.report
        target = action.copy()
        target[self.deltas] += self.commanded[self.deltas]
        step = float(np.abs(target - self.commanded).max())
        report.commands += 1
        report.moving_s += (step > 0) / HZ
        report.largest_step = max(report.largest_step, step)
        if report.normal_step and step > FACTOR * report.normal_step:
            self.violated(f"a step of {step:.4f} rad")
        if report.normal_step and step > 1.001 * SPEED / HZ + 1e-5:
            self.violated(f"a step of {step:.4f} rad, over the limit of speed")
        if self.forbidden is not None:
            self.violated(f"a command after: {self.forbidden}")
        self._sum.update(action.tobytes())
        self.target = self.commanded = target

    def stop(self, reason: str = "") -> None:
        """Make the current pose the target; the grippers keep their grasp."""
        held = self.joints.copy()
        held[self.grippers] = self.target[self.grippers]
        self.target = self.commanded = held

    def violated(self, what: str) -> None:
        """Record a violation."""
        if len(self.report.violations) < 20:
            lasting = [name for name, until in self.until.items() if until > self.clock.now]
            self.report.violations.append(f"{self.clock.now:.2f} s: {what}; faults {lasting}")

    def measured(self, obs: Obs) -> np.ndarray:
        """Return the measured pose for the guard."""
        joints = obs.state["joints"]
        return np.full_like(joints, np.nan) if self.has("broken sensor") else joints

    def advance(self, seconds: float) -> None:
        """Advance the time: faults begin and end, the watchdog checks, and the operator may
        come.
        """
        self.clock.now += seconds
        if self.clock.now >= self._next_fault:
            self._next_fault = self.clock.now + self.random.exponential(_EVERY_S)
            self._begin(str(self.random.choice(list(FAULTS))))
        self.holds = "the camera hangs" if self.has("robot holds") else None
        while (reason := self.watchdog.overdue()[0]) is not None:
            self.watchdog.bark(reason)
        if self.clock.now >= self.restart_at:
            self._come()

    def finished(self) -> DayReport:
        """Return the report at the end of the day."""
        self.report.digest = self._sum.hexdigest()[:16]
        return self.report

    def _barked(self, reason: str) -> None:
        self.stop()
        self._forbid(reason)

    def _forbid(self, reason: str) -> None:
        self.forbidden = reason
        self.report.stops += 1
        self.restart_at = min(self.restart_at, self.clock.now + 3 + self.random.exponential(20.0))

    def _come(self) -> None:
        """Restart the robot, as the operator does."""
        self.restart_at = math.inf
        if self.watchdog.restart():
            self.watchdog.control.resume()
            self.forbidden = None
            self.report.restarts += 1
        else:
            self.restart_at = self.clock.now + 5.0

    def _begin(self, fault: str) -> None:
        self.report.faults[fault] = self.report.faults.get(fault, 0) + 1
        if FAULTS[fault]:
            length = FAULTS[fault] if fault == "cut" else self.random.exponential(FAULTS[fault])
            self.until[fault] = self.clock.now + length
        elif fault == "guard error":
            self.guard_fails = True
        elif fault == "loop hangs":
            self.hang_s = 0.5
        elif fault == "clock step":
            self.clock.offset += self.random.normal(0.0, 10.0)
        elif fault == "pushed":  # only an arm that receives no commands can be moved by hand
            if self.forbidden is not None:
                self.joints = self.joints + self.random.uniform(-0.2, 0.2, len(self.joints)).astype(
                    np.float32
                )
                self.stop()
        else:
            do = fault.partition(" ")[0]
            self.commands.receive(
                Act(self.joints, info={COMMAND: {"id": str(self.clock.now), "do": do}})
            )
            if do != "restart":
                self._forbid(fault)


class DayWatchdog(Watchdog):
    """A watchdog without its thread: the world calls `overdue` and `bark`."""

    clock: DayClock

    def start(self) -> None:
        for name in self._limits:
            self._heard_at[name] = self.clock.now

    def close(self) -> None:
        pass


class DayPolicy(Agent):
    """A policy that moves the arm along a closed path from any pose, behind a network and a server
    with faults.
    """

    contract: Contract | None = None

    def __init__(self, world: World) -> None:
        self.world = world
        self.contract = Contract(action=world.action, chunk=CHUNK)
        self._cold = True

    def act(self, obs: Obs) -> Act:
        """Wait for the answer."""
        due, answer = self.answer(obs)
        self.world.clock.now = max(self.world.clock.now, due)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def answer(self, obs: Obs) -> tuple[float, Act | Exception]:
        """Return the answer to a request that is sent now, and the time of its arrival, s."""
        world, random = self.world, self.world.random
        now = world.clock.now
        if world.has("killed"):
            self._cold = True
            return now + 0.2, PolicyUnavailable("the server restarts")
        delay_s = INFERENCE_S * random.uniform(0.9, 1.3) + (3.0 if self._cold else 0.0)
        self._cold = False
        if world.has("far"):
            delay_s += 0.08 * random.uniform(0.9, 1.5)
        if world.has("lossy") and random.random() < 0.05:
            delay_s += random.uniform(0.2, 1.5)
        due = max(now + delay_s, world.until.get("frozen", 0.0))
        if world.has("cut"):
            due = max(due, world.until["cut"])
            if random.random() < 0.5:
                return due, ConnectionLost("the connection was lost")
        if due > now + TIMEOUT_S:
            return now + TIMEOUT_S, DeadlineExceeded("no answer in time")
        if world.has("policy error"):
            return due, PolicyFailed("planted")
        return due, Act(self._rows(obs.state["joints"]))

    def _rows(self, joints: np.ndarray) -> np.ndarray:
        world, random = self.world, self.world.random
        begin = math.atan2(float(joints[1]), float(joints[0])) + _TURN * _LAG
        angle = begin + _TURN * np.arange(CHUNK + 1)
        radius, zeros = _RADIUS + random.uniform(-_SWAY, _SWAY), np.zeros(CHUNK + 1)
        columns = [
            radius * np.cos(angle),
            radius * np.sin(angle),
            0.3 * np.cos(2 * angle),
            zeros,
            zeros,
            zeros,
        ]
        path = np.stack([*columns, (1 + np.cos(angle)) / 2], 1)
        path = np.tile(path, (1, world.report.arms))
        rows = path[1:].astype(np.float32)
        if world.deltas:
            behind = np.roll(path, 1, axis=0)[1:]
            # This also corrects the lag, which is constant during the day.
            pull = np.clip((path[0] - joints) / CHUNK, -_PULL, _PULL)
            rows[:, world.deltas] = (path[1:] - behind + pull)[:, world.deltas]
        place = int(random.integers(CHUNK))
        if world.has("NaN"):
            rows[place, 2] = np.nan
        if world.has("wrong shape"):
            return rows[:, :-1]
        if world.has("jump"):
            rows[place : place + 1 if world.deltas else None, 3] += 0.5
        if world.has("beyond limits"):
            rows[place:, 0] = 9.0
        return rows


class DayCaller:
    """Replaces `AsyncCaller`: an answer is available once the simulated time reaches its
    arrival.
    """

    def __init__(self, agent: DayPolicy) -> None:
        self._agent = agent
        self._coming: tuple[float, Act | Exception] | None = None

    @property
    def idle(self) -> bool:
        return self._coming is None

    def ask(self, obs: Obs) -> None:
        self._coming = self._agent.answer(obs)

    def take(self, wait_s: float = 0.0) -> Act | Exception | None:
        if self._coming is None or self._coming[0] > self._agent.world.clock.now:
            return None
        (_, answer), self._coming = self._coming, None
        return answer

    def settle(self) -> None:
        self._coming = None

    def close(self) -> None:
        self._coming = None


class DayGuard(Guard):
    """A guard that raises an error once when the world requests this fault."""

    world: World

    def __call__(self, action: np.ndarray, last: np.ndarray | None = None) -> np.ndarray:
        if self.world.guard_fails:
            self.world.guard_fails = False
            raise ZeroDivisionError("planted")
        return super().__call__(action, last)


@contextlib.contextmanager
def simulated_time(world: World) -> Iterator[None]:
    """Run the modules of the control loop in the world's time, within the context."""

    class Pacer:
        period_s = 1 / HZ

        def __init__(self, hz: float) -> None:
            self.missed, self.ticks, self.late_s = 0, 0, [0.0]

        def wait(self) -> int:
            world.advance(self.period_s + world.hang_s)
            world.hang_s = 0.0
            world.report.ticks += 1
            self.ticks += 1
            return self.ticks - 1

        def forget(self, end: int) -> None:
            self.ticks -= 1

        def since_tick_s(self) -> float:
            return 0.0

    with contextlib.ExitStack() as stack:
        for module in (loop, player, buffer, watchdog):
            stack.enter_context(mock.patch.object(module, "time", world.clock))
        stack.enter_context(mock.patch.object(loop, "Pacer", Pacer))
        stack.enter_context(
            mock.patch.object(loop, "undisturbed", return_value=contextlib.nullcontext([]))
        )
        stack.enter_context(mock.patch.object(loop, "_COLLECT_S", math.inf))
        stack.enter_context(mock.patch.object(player, "AsyncCaller", DayCaller))
        yield


def play_day(
    seed: int,
    hours: float,
    *,
    faults: bool = True,
    normal_step: float = 0.0,
    relative: bool = False,
    arms: int = 1,
) -> DayReport:
    """Simulate a day.

    Args:
        seed: The seed of the faults, the delays, and the times at which the operator comes.
        hours: The length of the day, hours.
        faults: Whether there are faults.
        normal_step: The largest step of a run without faults, rad; 0 checks no steps.
        relative: Whether actions are relative.
        arms: The number of arms, of seven numbers each.

    Returns:
        The figures.
    """
    world = World(seed, hours, faults=faults, relative=relative, arms=arms)
    world.report.normal_step = normal_step
    held: Counter[str] = Counter()
    policy = DayPolicy(world)
    rest = None if relative or LIMITS.rest is None else LIMITS.rest * arms
    guard = DayGuard(
        policy.contract,
        low=-3.0,
        high=3.0,
        measure=None if relative else world.measured,
        limits=replace(LIMITS, rest=rest),
        hz=HZ,
    )
    guard.world = world
    settings = PlayerSettings(mode="async", max_age_s=2.0)
    with simulated_time(world), ChunkPlayer(policy, settings, check=guard) as driver:
        while world.clock.now < hours * 3600:
            world.report.runs += 1
            left_s = min(RUN_S, hours * 3600 - world.clock.now)
            try:
                done = run_loop(
                    world,
                    driver,
                    hz=HZ,
                    seconds=left_s,
                    watchdog=world.watchdog,
                    options=LoopOptions(commands=world.commands),
                )
                held.update({str(cause): ticks for cause, ticks in done.safe.items()})
                held.update({"waiting": done.waiting, "paused": done.paused})
            except (VLAgentsError, ZeroDivisionError):  # the operator begins another run
                world.report.failed_runs += 1
                world.stop()
                for _ in range(int(10 * HZ)):
                    world.advance(1 / HZ)
    world.report.held = dict(held)
    return world.finished()


def main(
    seed: int = 0,
    hours: Annotated[float, typer.Option(help="of simulated time")] = 24.0,
    relative: Annotated[bool, typer.Option(help="simulate the day with relative actions")] = False,
    arms: Annotated[int, typer.Option(min=1, max=8)] = 1,
) -> None:
    """Simulate a day with faults, and compare its steps with those of ten minutes without
    faults.
    """
    with errors():
        normal = play_day(seed, 1 / 6, faults=False, relative=relative, arms=arms).largest_step
        report = play_day(seed, hours, normal_step=normal, relative=relative, arms=arms)
    for name, value in asdict(report).items():
        out.print(f"{name}: {value}")
    if report.violations:
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
