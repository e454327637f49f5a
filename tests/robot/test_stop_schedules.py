"""No command begins after a stop on another thread, for any interleaving of the loop's thread and
the stop's thread.
"""

from __future__ import annotations

import itertools
import sys
import threading
import time
from collections.abc import Callable
from types import CodeType, FrameType
from typing import Any

import numpy as np
import pytest

from vlagents_ray.chunking import control as control_module
from vlagents_ray.chunking.control import RobotControl
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.robot import LoopOptions, Watchdog, loop, run_loop
from vlagents_ray.robot.loop import Restart

HZ = 1000.0
EVENT_AT = 4  # the observation in whose tick the robot is stopped
AFTER = 4  # number of observations until the end of a run
LIMIT_S = 60.0  # time limit after which a wait has failed

Tracer = Callable[[FrameType, str, Any], Any]
STOPPER = {
    Watchdog.trip.__code__,
    Watchdog.bark.__code__,
    RobotControl.stopping.__wrapped__.__code__,  # type: ignore[attr-defined]
}


class Arm:
    """A robot that records a trace of its calls."""

    def __init__(self) -> None:
        self.trace: list[str] = []
        self.observations = 0
        self.hangs = threading.Event()
        self.released: threading.Event | None = None  # if set, the next command waits for it

    def observe(self) -> Obs:
        self.observations += 1
        self.trace.append("observe")
        return Obs()

    def apply(self, action: np.ndarray) -> None:
        self.trace.append("apply")
        released, self.released = self.released, None
        if released is not None:
            self.hangs.set()
            assert released.wait(LIMIT_S)
            self.trace.append("applied")

    def stop(self) -> None:
        self.trace.append("stop")


class Standing(Agent):
    """A policy whose plan `interrupt` drops."""

    contract: Contract | None = Contract(action=ActionSpec(dim=2, delta=False))

    def __init__(self, arm: Arm) -> None:
        self._arm = arm

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros(2, np.float32))

    def interrupt(self) -> None:
        self._arm.trace.append("interrupt")


class UnwatchedWatchdog(Watchdog):
    """A watchdog without a thread, so that the test decides when it detects silence."""

    def start(self) -> None: ...

    def close(self) -> None: ...

    def find_silence(self) -> None:
        """Simulate the thread of a watchdog that detects a silent camera, which then continues."""
        self._heard_at["camera"] = -1e9
        reason, _ = self.overdue()
        assert reason is not None
        self.control.heard("camera")
        self.bark(reason)


class Run:
    """A run of the loop with a watchdog, which records its stops as "dog"."""

    def __init__(self) -> None:
        self.arm = Arm()
        self.dog = UnwatchedWatchdog(self._stop, {"camera": 1e6})
        self.stopper: threading.Thread | None = None

    def _stop(self, reason: str) -> None:
        self.arm.trace.append("dog")

    def stop_on_a_thread(self, source: str, tracer: Tracer | None = None) -> None:
        def stops() -> None:
            if tracer is not None:
                sys.settrace(tracer)
            if source == "trip":
                self.dog.trip("a person is in the way")
            else:
                self.dog.find_silence()

        self.stopper = threading.Thread(target=stops)
        self.stopper.start()

    def drive(self, restart: Restart, until: Callable[[], bool] | None = None) -> None:
        arm = self.arm
        stopped_at: list[int] = []

        def over() -> bool:
            if "dog" in arm.trace and not stopped_at:
                stopped_at.append(arm.observations)
            if self.stopper is not None and not stopped_at:  # the stopping thread has not run yet
                return False
            return arm.observations > (stopped_at[0] if stopped_at else 2 * EVENT_AT) + AFTER

        until = until or over
        run_loop(
            arm,
            Standing(arm),
            hz=HZ,
            watchdog=self.dog,
            until=until,
            options=LoopOptions(restart=restart),
        )
        if self.stopper is not None:
            self.stopper.join(LIMIT_S)
            assert not self.stopper.is_alive()

    def require_stopped(self, restart: Restart) -> None:
        """Check that no command follows the watchdog's stop, or after an automatic restart no
        command of the old plan.

        The loop may notice the stop before the watchdog's thread calls `stop`, but only after the
        last command.
        """
        calls_before = self.arm.trace[: self.arm.trace.index("dog")]
        last_command = max(i for i, call in enumerate(calls_before) if call == "apply")
        after = self.arm.trace[last_command + 1 :]
        if "apply" in after:
            assert restart == "auto", after
            assert "interrupt" in after[: after.index("apply")], after
        assert "stop" in after, "the loop must notice the stop"


def tracer_of(codes: set[CodeType], happens: Callable[[FrameType], None]) -> Tracer:
    """Return a trace function that calls `happens` before each line of some functions."""

    def local(frame: FrameType, event: str, arg: Any) -> Any:
        if event == "line":
            happens(frame)
        return local

    def tracer(frame: FrameType, event: str, arg: Any) -> Any:
        return local if frame.f_code in codes else None

    return tracer


def loop_codes() -> set[CodeType]:
    methods = [getattr(loop._Run, name) for name in vars(loop._Run)]
    return {
        method.__code__ for method in methods if callable(method) and hasattr(method, "__code__")
    }


def wait_until(holds: Callable[[], bool]) -> None:
    end = time.monotonic() + LIMIT_S
    while not holds():
        assert time.monotonic() < end
        time.sleep(0)


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a stop wait longer for a command, since a busy machine may not run the command's
    thread.
    """
    monkeypatch.setattr(control_module, "COMMAND_S", LIMIT_S, raising=False)


@pytest.mark.slow
@pytest.mark.parametrize("restart", ["manual", "auto"])
@pytest.mark.parametrize("source", ["trip", "silence"])
def test_no_command_follows_a_stop_at_any_line_of_the_loop(
    patient: None, source: str, restart: Restart
) -> None:
    for point in itertools.count():
        run = Run()
        lines = itertools.count()

        def happens(
            frame: FrameType, run: Run = run, lines: Any = lines, point: int = point
        ) -> None:
            if run.arm.observations != EVENT_AT or run.stopper is not None or next(lines) < point:
                return
            run.stop_on_a_thread(source)
            gate = getattr(run.dog.control, "_commanding", None)
            commands = gate is not None and gate._is_owned()
            wait_until(lambda: bool(run.dog.control.stops) and (commands or "dog" in run.arm.trace))

        before = sys.gettrace()
        sys.settrace(tracer_of(loop_codes(), happens))
        try:
            run.drive(restart)
        finally:
            sys.settrace(before)
        if run.stopper is None:  # a tick has fewer lines than `point`
            assert point > 20
            return
        run.require_stopped(restart)


@pytest.mark.parametrize("restart", ["manual", "auto"])
@pytest.mark.parametrize("source", ["trip", "silence"])
def test_no_command_follows_a_stop_whose_thread_waits_at_any_line(
    patient: None, source: str, restart: Restart
) -> None:
    for point in itertools.count():
        run = Run()
        lines = itertools.count()

        def happens(
            frame: FrameType, run: Run = run, lines: Any = lines, point: int = point
        ) -> None:
            control = run.dog.control
            locks = (control._lock, control._commanding, run.dog._changed)
            if next(lines) != point or any(lock._is_owned() for lock in locks):  # type: ignore[attr-defined]
                return
            seen_before = run.arm.observations
            wait_until(lambda: run.arm.observations > seen_before + 2)

        ended: list[int] = []  # number of observations after the end of the stop

        def over(run: Run = run, ended: list[int] = ended, happens: Any = happens) -> bool:
            if run.stopper is None:
                if run.arm.observations == EVENT_AT:
                    run.stop_on_a_thread(source, tracer_of(STOPPER, happens))
            elif not run.stopper.is_alive():
                ended.append(run.arm.observations)
            return len(ended) > AFTER

        run.drive(restart, over)
        run.require_stopped(restart)
        if next(lines) <= point:
            assert point > 4
            return


@pytest.mark.parametrize("source", ["trip", "silence"])
def test_a_stop_does_not_wait_for_a_command_that_hangs(source: str) -> None:
    run = Run()
    released = threading.Event()

    def over() -> bool:
        if run.arm.observations == EVENT_AT:
            run.arm.released = released
        return run.arm.observations > EVENT_AT + AFTER

    def stop() -> None:
        assert run.arm.hangs.wait(LIMIT_S)
        run.stop_on_a_thread(source)
        wait_until(lambda: "dog" in run.arm.trace)  # while the command hangs
        released.set()

    thread = threading.Thread(target=stop)
    thread.start()
    run.drive("manual", over)
    thread.join()
    hung = run.arm.trace.index("dog") - 1
    assert run.arm.trace[hung : hung + 4] == ["apply", "dog", "applied", "stop"], (
        "the stop is repeated directly after the command"
    )
    assert "apply" not in run.arm.trace[hung + 1 :]


def test_a_stop_within_a_command_is_repeated_after_it() -> None:
    run = Run()
    apply = run.arm.apply

    def trips(action: np.ndarray) -> None:  # like a signal handler on the loop's thread
        if run.arm.observations == EVENT_AT:
            run.dog.trip("a signal")
        apply(action)

    run.arm.apply = trips  # type: ignore[method-assign]
    run.drive("manual")
    stopped = run.arm.trace.index("dog")
    assert run.arm.trace[stopped : stopped + 3] == ["dog", "apply", "stop"]
    assert "apply" not in run.arm.trace[stopped + 2 :]
