"""A signal that ends a program stops its robot first."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from typing import Any

import numpy as np
import pytest

from vlagents_ray import Act, ActionSpec, Agent, ChunkPlayer, Contract, Obs, PlayerSettings
from vlagents_ray.robot import run_loop
from vlagents_ray.robot.end_signal import ended_by_signals

ENDING = [signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1]

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
    before = signal.signal(number, signal.SIG_DFL)
    try:
        with (
            pytest.raises(SystemExit) as ended,
            ChunkPlayer(agent, PlayerSettings(mode="async")) as player,
        ):
            run_loop(arm, player if is_player else agent, hz=200, seconds=60)
        assert signal.getsignal(number) is signal.SIG_DFL
    finally:
        signal.signal(number, before)
    assert ended.value.code == 128 + number
    assert (arm.commands, arm.stops) == (3, 1)


def test_the_process_ends_with_the_status_of_the_signal_after_the_stop() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM],
        cwd=os.path.dirname(__file__),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGTERM)
        said = process.stdout.read()
        assert process.wait(30) == 143
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
