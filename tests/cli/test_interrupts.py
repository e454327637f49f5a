"""One Ctrl-C or one SIGTERM ends a command, whichever call hangs: episodes keep their results, a
robot is stopped.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from eval_fakes import wait_for
from ray_processes import START_S

END_S = 120.0  # end of a command that has been interrupted
EPISODES, HANGS_AFTER = 4, 2
# The variable with the number of the signal that a thread of the command gets, if set.
OTHER_THREAD = "TESTED_OTHER_THREAD"
MODULE = f"""
import os, pathlib, signal, threading, time
import numpy as np
from vlagents_ray import Act, ActionSpec, Agent, Contract, StateSpec


def deliver(number):
    # This thread cannot run the handler.
    time.sleep(0.05)
    signal.pthread_kill(threading.get_ident(), number)


def hang():
    pathlib.Path("hangs").touch()
    if "{OTHER_THREAD}" in os.environ:
        number = int(os.environ.pop("{OTHER_THREAD}"))
        threading.Thread(target=deliver, args=[number]).start()
    while True:
        try:
            threading.Event().wait()
        except Exception:  # as a client that tries again for ever
            pass


class Policy(Agent):
    hangs_in, resets = None, 0

    @property
    def contract(self):
        return Contract(state={{"xyzrpy": StateSpec(6, "m+rad")}}, action=ActionSpec(dim=4, delta=True))

    def initialize(self):
        if self.hangs_in == "initialize":
            hang()

    def reset(self, obs, instruction, **options):
        Policy.resets += 1
        self.is_last = Policy.resets > {HANGS_AFTER}
        if self.is_last and self.hangs_in == "reset":
            hang()
        return {{}}

    def act(self, obs):
        if self.is_last and self.hangs_in == "act":
            hang()
        return Act(np.zeros((1, 4), np.float32))

    def close(self):
        if self.hangs_in == "close":
            hang()


class Initialize(Policy):
    hangs_in = "initialize"


class Reset(Policy):
    hangs_in = "reset"


class Acting(Policy):
    hangs_in = "act"


class Close(Policy):
    hangs_in = "close"


class ActingAndClose(Acting):
    def close(self):
        hang()
"""
SIGNALS = [signal.SIGINT, signal.SIGTERM]
WITHOUT_RAY = [
    ("Initialize", 0),
    ("Reset", HANGS_AFTER),
    ("Acting", HANGS_AFTER),
    ("Close", EPISODES),
    ("ActingAndClose", HANGS_AFTER),
]
CASES = [(policy, "0", finished, number) for policy, finished in WITHOUT_RAY for number in SIGNALS]
WITH_RAY = pytest.param(
    "Acting", "1", HANGS_AFTER, signal.SIGTERM, marks=[pytest.mark.ray, pytest.mark.slow]
)


def interrupted(
    words: list[str], number: signal.Signals, folder: Path, *, on_another_thread: bool = False
) -> tuple[int, str]:
    """Run a command until its file `hangs` exists, send it one signal; returns its status and
    what it printed.

    The kernel chooses the thread that gets a signal, mostly the main one. If the signal is to
    arrive `on_another_thread`, the command sends it.
    """
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), *sys.path])}
    if on_another_thread:
        environment[OTHER_THREAD] = str(int(number))
    command = subprocess.Popen(
        [sys.executable, "-m", "vlagents_ray", *words],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    with command:
        try:
            wait_for(lambda: (folder / "hangs").exists() or command.poll() is not None, START_S)
            if not on_another_thread:
                command.send_signal(number)
            printed, _ = command.communicate(timeout=END_S)
        finally:
            command.kill()
    return command.returncode, printed


def evaluate_interrupted(
    policy: str,
    workers: str,
    finished: int,
    number: signal.Signals,
    folder: Path,
    *,
    on_another_thread: bool = False,
) -> None:
    """Run an evaluation whose policy hangs, and check how it ends."""
    (folder / "own.py").write_text(MODULE)
    options = (
        f"--episodes {EPISODES} --env-set max_steps=2 --video none --workers {workers} --out out"
    ).split()
    words = ["eval", "tabletop", "--policy", f"own:{policy}", *options]
    status, printed = interrupted(words, number, folder, on_another_thread=on_another_thread)
    assert status == 130, printed
    assert "Traceback" not in printed
    [error] = [line for line in printed.splitlines() if line.startswith("Error: ")]
    assert error == (
        f"Error: interrupted after {finished} of {EPISODES} episodes; continue with --resume --out out"
    )
    summary = json.loads((folder / "out" / "summary.json").read_text())
    assert (summary["state"], summary["totals"][0]["episodes"]) == ("interrupted", finished)


@pytest.mark.slow
@pytest.mark.parametrize(("policy", "workers", "finished", "number"), [*CASES, WITH_RAY])
def test_one_signal_ends_an_evaluation_that_hangs(
    policy: str, workers: str, finished: int, number: signal.Signals, tmp_path: Path
) -> None:
    evaluate_interrupted(policy, workers, finished, number, tmp_path)


@pytest.mark.ray
@pytest.mark.slow
def test_one_signal_ends_an_evaluation_whose_policy_hangs_while_its_server_starts(
    tmp_path: Path,
) -> None:
    (tmp_path / "own.py").write_text(MODULE)
    options = ["--policy", "own:Initialize", "--workers", "1", "--video", "none", "--out", "out"]
    words = ["eval", "tabletop", *options]
    # The replica runs in the folder of the command.
    status, printed = interrupted(words, signal.SIGTERM, tmp_path)
    assert status == 130, printed
    assert "Traceback" not in printed
    [error] = [line for line in printed.splitlines() if line.startswith("Error: ")]
    assert error == (
        "Error: interrupted while Ray and the policies started; no episode began: repeat the command"
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("policy", "finished", "number"),
    [("Initialize", 0, signal.SIGTERM), ("Close", EPISODES, signal.SIGINT)],
)
def test_a_signal_that_does_not_interrupt_the_main_thread_ends_an_evaluation_that_hangs(
    policy: str, finished: int, number: signal.Signals, tmp_path: Path
) -> None:
    evaluate_interrupted(policy, "0", finished, number, tmp_path, on_another_thread=True)


ARM = """
import numpy as np
from own import hang
from vlagents_ray import Obs


class Starting:
    def __init__(self):
        hang()

    observe = apply = stop = lambda *_: None


class Observing:
    def observe(self):
        hang()

    def apply(self, action):
        pass

    def stop(self):
        print("the arm stops", flush=True)
"""
ARMS = {"Starting": False, "Observing": True}  # whether the arm is stopped


CHECKS = [
    ("Starting", signal.SIGINT, False),
    ("Starting", signal.SIGTERM, False),
    ("Starting", signal.SIGTERM, True),
    ("Observing", signal.SIGINT, False),
    ("Observing", signal.SIGTERM, False),
    ("Observing", signal.SIGINT, True),
]


@pytest.mark.slow
@pytest.mark.parametrize(("arm", "number", "on_another_thread"), CHECKS)
def test_one_signal_ends_a_check_of_a_robot_that_hangs(
    arm: str, number: signal.Signals, on_another_thread: bool, tmp_path: Path
) -> None:
    (tmp_path / "own.py").write_text(MODULE)
    (tmp_path / "arm.py").write_text(ARM)
    words = ["robot", "check", f"arm:{arm}"]
    status, printed = interrupted(words, number, tmp_path, on_another_thread=on_another_thread)
    assert status == 128 + number, printed
    assert "Traceback" not in printed
    assert ("the arm stops" in printed) == ARMS[arm]
