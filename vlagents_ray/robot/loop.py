"""The control loop: observe, act, apply, at a fixed rate."""

from __future__ import annotations

import contextlib
import gc
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from vlagents_ray.errors import ConfigError, InvalidAction
from vlagents_ray.interface import CAPTURED, SAFE, SILENT, Agent, Obs
from vlagents_ray.robot.pacing import KEPT_TICKS, SPIN_S, Pacer, jitter, undisturbed
from vlagents_ray.robot.record import Recorder
from vlagents_ray.robot.safety import Guard, Watchdog

_REASONS = 100  # that a report tells apart
_COLLECT_S = 2.0


class Robot(Protocol):
    """What the loop drives."""

    def observe(self) -> Obs:
        """What the sensors say now; must not wait longer than a fraction of a tick."""
        ...

    def apply(self, action: np.ndarray) -> None:
        """Command one action, (D,) float32; must not wait for the motion."""
        ...

    def stop(self) -> None:
        """Come to rest, whatever the state; may be called more than once, and from another thread."""
        ...


@dataclass(slots=True)
class LoopReport:
    """How a run of the loop went."""

    hz: float
    jitter: dict[str, float] = field(default_factory=dict)  # see `vlagents_ray.robot.pacing.jitter`
    work_p50_ms: float = 0.0  # from when a tick was due until its action was applied
    work_p99_ms: float = 0.0
    safe: dict[str, int] = field(default_factory=dict)  # reason -> ticks with the safe action, or none
    barks: list[str] = field(default_factory=list)  # of the watchdog
    done: bool = False  # the policy considered its task finished
    means: list[str] = field(default_factory=list)  # what was done against jitter

    @property
    def safe_ticks(self) -> int:
        """Ticks without an action of the policy."""
        return sum(self.safe.values())

    def count(self, reason: str) -> None:
        """One more tick without an action of the policy. Reasons may hold numbers: not all of them are told apart."""
        if reason not in self.safe and len(self.safe) >= _REASONS:
            reason = "other reasons"
        self.safe[reason] = self.safe.get(reason, 0) + 1


def run_loop(
    robot: Robot,
    agent: Agent,
    *,
    hz: float,
    seconds: float | None = None,
    instruction: str | None = None,
    reset_options: dict[str, Any] | None = None,
    guard: Guard | None = None,
    watchdog: Watchdog | None = None,
    recorder: Recorder | None = None,
    real_time: bool = False,
    spin_s: float = SPIN_S,
    until: Callable[[], bool] = lambda: False,
) -> LoopReport:
    """Reset `agent`, then let it drive `robot` at `hz` for `seconds`, until it is done, or until `until()`.

    The schedule is absolute, so nothing drifts; a tick that is over before it could begin is left out and counted.
    Every action passes `guard` (default: one of the agent's contract) or ends the loop: an agent that is to go on
    with a safe action instead is a `ChunkPlayer(..., check=guard)`. However the loop ends, `robot.stop()` is called.

    `watchdog` hears "loop" at every tick and "server" as long as the agent's answers come (`act.info["silent_s"]`);
    it watches while the loop runs. After it barked, the robot is stopped and commanded nothing until what was silent
    is heard again; an action that a hanging loop was late with is not applied. `recorder` gets an episode; one that
    ends by an exception is kept, too. A signal such as SIGTERM is the caller's to turn into an exception.
    """
    if seconds is not None and not seconds > 0:
        raise ConfigError(f"seconds: got {seconds}, want above 0, or None")
    report = LoopReport(hz)
    barks = len(watchdog.barks) if watchdog is not None else 0
    agent.initialize()
    guard = guard or Guard(agent.contract)
    with contextlib.ExitStack() as stack:
        try:
            agent.reset(_observed(robot), instruction, **(reset_options or {}))
            if recorder is not None:
                stack.enter_context(recorder.episode(instruction or ""))
            report.means = stack.enter_context(undisturbed(real_time=real_time))
            if watchdog is not None:
                stack.enter_context(watchdog)
            _drive(robot, agent, guard, watchdog, recorder, report, Pacer(hz, spin_s), seconds, until)
        finally:
            robot.stop()  # before anything else ends
    if watchdog is not None:
        report.barks = watchdog.barks[barks:]
    return report


def _drive(
    robot: Robot,
    agent: Agent,
    guard: Guard,
    watchdog: Watchdog | None,
    recorder: Recorder | None,
    report: LoopReport,
    pacer: Pacer,
    seconds: float | None,
    until: Callable[[], bool],
) -> None:
    work_s: deque[float] = deque(maxlen=KEPT_TICKS)
    collected = time.monotonic()
    ticks = None if seconds is None else pacer.ticks_in(seconds)
    last: np.ndarray | None = None
    stopped = False  # by the watchdog
    try:
        while not report.done and not until():
            if time.monotonic() - collected > _COLLECT_S:  # in the idle time: it is off, and failed requests are cycles
                gc.collect()
                collected = time.monotonic()
            tick = pacer.wait()
            if ticks is not None and tick >= ticks:
                pacer.forget(ticks)
                break
            obs = _observed(robot)
            act = agent.act(obs)
            if act.action.ndim != 1:
                raise InvalidAction(f"action: got {act.action.shape}, want one row; wrap the agent in a ChunkPlayer")
            action = guard(act.action, last)
            report.done = act.done
            silent: list[str] = []
            if watchdog is not None:
                silent = watchdog.silent
                watchdog.heard("loop")
                watchdog.heard("server", act.info.get(SILENT, 0.0))
            if silent:
                if not stopped:
                    robot.stop()  # again: the watchdog's may have come just before the last action
                stopped = True
                report.count(f"stopped by the watchdog: no word of the {' and the '.join(silent)}")
                continue
            stopped, last = False, action
            robot.apply(action)
            work_s.append(pacer.since_tick_s())
            reason = act.info.get(SAFE)
            if reason is not None:
                report.count(reason)
            if recorder is not None:
                recorder.add(obs, action, tick=tick, safe=reason is not None)
    finally:
        report.jitter = jitter(pacer.late_s, pacer.missed, pacer.ticks)
        if work_s:
            report.work_p50_ms = float(np.median(work_s)) * 1e3
            report.work_p99_ms = float(np.quantile(work_s, 0.99)) * 1e3


def _observed(robot: Robot) -> Obs:
    at = time.time()
    obs = robot.observe()
    return obs if CAPTURED in obs.info else replace(obs, info={CAPTURED: at, **obs.info})
