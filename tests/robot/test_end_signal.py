"""A signal that ends a program stops its robot first."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from dropped_signals import SendsSignal

from vlagents_ray import Act, ActionSpec, Agent, ChunkPlayer, Contract, Obs, PlayerSettings
from vlagents_ray.robot import Guard, LoopOptions, MotionLimits, run_loop
from vlagents_ray.signals import END_SIGNALS, ended_by_signals, interrupts, raise_dropped

ENDING = [*END_SIGNALS, signal.SIGUSR1]

PROGRAM = """
from test_end_signal import Arm, Still
from vlagents_ray.robot import run_loop

class Loud(Arm):
    observations = 0

    def observe(self):
        self.observations += 1
        if self.observations == 3:
            print("ready", flush=True)
        return super().observe()

    def stop(self):
        print("the arm stops", flush=True)

run_loop(Loud(), Still(), hz=50, seconds=60)
"""


# A program that has used Ray before it drives its arm.
PROGRAM_WITH_RAY = f"""
import ray
from vlagents_ray.ray_tools.session import joined

with joined("local", num_cpus=1):
    pass
{PROGRAM}
"""


def default_handler(number: int) -> Any:
    """Return the handler of a signal in a new Python process."""
    return signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL


class Still(Agent):
    contract = Contract(action=ActionSpec(dim=2, delta=False, low=-1.0, high=1.0))

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros(2, np.float32))


class Arm:
    """An arm that sends this process a signal at a command."""

    def __init__(self, number: int = 0, at: int = 3) -> None:
        self.number, self.at = number, at
        self.commands = self.stops = 0

    def observe(self) -> Obs:
        return Obs()

    def apply(self, action: np.ndarray) -> None:
        self.commands += 1
        if self.number and self.commands == self.at:
            os.kill(os.getpid(), self.number)

    def stop(self) -> None:
        self.stops += 1


@pytest.mark.parametrize("is_player", [True, False])
@pytest.mark.parametrize("number", ENDING)
def test_a_signal_ends_a_loop_of_a_users_own_program_and_stops_the_robot(
    number: signal.Signals, *, is_player: bool
) -> None:
    """The robot is stopped before the process ends; it must not stay in motion."""
    arm, agent = Arm(number), Still()
    default = default_handler(number)
    before = signal.signal(number, default)
    try:
        with (
            pytest.raises((SystemExit, KeyboardInterrupt)) as ended,
            ChunkPlayer(agent, PlayerSettings(mode="async")) as player,
        ):
            run_loop(arm, player if is_player else agent, hz=200, seconds=60)
        assert signal.getsignal(number) is default
    finally:
        signal.signal(number, before)
    if number != signal.SIGINT:
        assert isinstance(ended.value, SystemExit)
        assert ended.value.code == 128 + number
    assert (arm.commands, arm.stops) == (3, 1)


class Interrupted(Arm):
    """An arm whose driver is interrupted in a destructor at a call of `method`, in the run or on the
    way to the rest pose.
    """

    def __init__(self, number: signal.Signals, method: str, *, at_rest: bool) -> None:
        super().__init__()
        self.sends, self.method, self.at_rest = number, method, at_rest
        self.calls = 0
        self.commands_at_signal: int | None = None

    def _called(self, method: str) -> None:
        if method != self.method:
            return
        self.calls += 1
        # The run has 5 ticks, and the way to the rest pose many more.
        if self.calls == (9 if self.at_rest else 3):
            self.commands_at_signal = self.commands
            SendsSignal(self.sends)

    def observe(self) -> Obs:
        self._called("observe")
        return super().observe()

    def apply(self, action: np.ndarray) -> None:
        super().apply(action)
        self._called("apply")


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("at_rest", [False, True])
@pytest.mark.parametrize("method", ["observe", "apply"])
@pytest.mark.parametrize(
    ("number", "context"),
    [
        *((number, contextlib.nullcontext) for number in ENDING),
        *((number, partial(ended_by_signals, *END_SIGNALS)) for number in END_SIGNALS),
        *((number, interrupts) for number in (signal.SIGINT, signal.SIGTERM)),
    ],
)
def test_nothing_is_commanded_after_a_signal_whose_exception_python_drops(
    number: signal.Signals,
    context: Callable[[], contextlib.AbstractContextManager[None]],
    method: str,
    *,
    at_rest: bool,
) -> None:
    arm = Interrupted(number, method, at_rest=at_rest)
    limits = MotionLimits(velocity=1.0, acceleration=5.0, rest=(0.5, 0.5))
    guard = Guard(Still.contract, limits=limits, hz=200)
    before = signal.signal(number, default_handler(number))
    try:
        with context(), pytest.raises((SystemExit, KeyboardInterrupt)):
            run_loop(arm, Still(), hz=200, seconds=5 / 200, options=LoopOptions(guard=guard))
        with ended_by_signals(number):
            raise_dropped()  # raises nothing: the signal of the earlier program is forgotten
    finally:
        signal.signal(number, before)
    assert arm.commands_at_signal is not None
    assert (arm.commands, arm.stops) == (arm.commands_at_signal, 1)


@pytest.mark.parametrize(
    "program",
    [
        pytest.param(PROGRAM, id="robot"),
        pytest.param(PROGRAM_WITH_RAY, id="after Ray", marks=[pytest.mark.ray, pytest.mark.slow]),
    ],
)
def test_the_process_ends_with_the_status_of_the_signal_after_the_stop(program: str) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=os.path.dirname(__file__),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGTERM)
        said, _ = process.communicate(timeout=30)
        assert process.returncode == 143
    assert said == "the arm stops\n"


def test_handlers_of_the_program_and_ignored_signals_are_unchanged() -> None:
    received: list[Any] = []
    before = [
        signal.signal(signal.SIGTERM, lambda *_: received.append(1)),
        signal.signal(signal.SIGHUP, signal.SIG_IGN),
    ]
    try:
        for number in (signal.SIGTERM, signal.SIGHUP):
            report = run_loop(Arm(number), Still(), hz=200, seconds=0.05)
            assert report.jitter["ticks"] > 3
    finally:
        signal.signal(signal.SIGTERM, before[0])
        signal.signal(signal.SIGHUP, before[1])
    assert received == [1]


def test_outside_of_the_main_thread_no_handler_is_set() -> None:
    handlers = []

    def enter() -> None:
        with ended_by_signals(*ENDING):
            handlers.extend(signal.getsignal(number) for number in ENDING)

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert handlers == [signal.getsignal(number) for number in ENDING]
