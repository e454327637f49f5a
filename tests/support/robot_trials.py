"""An evaluation on a simulated arm with a scripted operator."""

from __future__ import annotations

import contextlib
import itertools
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.evaluate import EvalConfig, Summary
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.robot import Operator, TerminalOperator, evaluate_on_robot
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.robot.simulated import SimulatedRobot

NAMES = ("policy-zebra", "policy-walrus")
CHECKPOINTS = {name: f"/weights/{name}/step-4711" for name in NAMES}
URLS = {name: f"http://{name}.example:8{number}17" for number, name in enumerate(NAMES)}
_CONTRACT = Contract(
    cameras={"front": CameraSpec(32, 32)},
    state={"joints": StateSpec(2)},
    action=ActionSpec(dim=2, delta=False, low=-1.0, high=1.0),
)


class Arm(SimulatedRobot):
    """A simulated arm, selected with `--robot robot_trials:Arm`. It fails once, before the action
    with the number `fails_at`, counted from 0.
    """

    def __init__(self, fails_at: int | None = None) -> None:
        super().__init__(_CONTRACT)
        self._fails_at = fails_at
        self.stops = 0

    def apply(self, action: np.ndarray) -> None:
        if self._fails_at is not None and self.applied == self._fails_at:
            self._fails_at = None
            raise RuntimeError("joint 3 is too hot")
        super().apply(action)

    def stop(self) -> None:
        super().stop()
        self.stops += 1


class Reaching(Agent):
    """A policy with absolute targets. Policies with different names have different targets, and
    report their names in all metadata.
    """

    contract = _CONTRACT

    def __init__(self, name: str, checkpoint: str | None = None) -> None:
        self.name = name
        self.acts = 0
        self.metadata = {
            "policy": name,
            "checkpoint": checkpoint or CHECKPOINTS[name],
            "url": URLS[name],
        }

    def reset(self, obs: Obs, instruction: str | None = None, **kwargs: Any) -> dict[str, Any]:
        return {"checkpoint": self.metadata["checkpoint"], "weights": f"digest-of-{self.name}"}

    def act(self, obs: Obs) -> Act:
        target = 0.1 + 0.2 * NAMES.index(self.name)
        about = {"version": 0, "fingerprint": f"fingerprint-of-{self.name}"}
        return Act(
            np.full((4, 2), target, np.float32),
            info={"policy": about, "timing": {"round_trip_ms": 3.0}},
        )


def plan(out: Path, **changes: Any) -> EvalConfig:
    """Return a plan with two policies, two tasks and short trials."""
    robot = {
        "arm": "robot_trials:Arm",
        "hz": 200,
        "key": "a key of the plan",
        "tasks": tasks(),
        "mode": "open_loop",
    }
    suite = {"envs": ["cups", "drawer"], "episodes": 2, "seeds": [3]}
    settings = {
        "policies": [{"name": name, "url": URLS[name]} for name in NAMES],
        "suites": [suite | changes.pop("suite", {})],
        "robot": robot | changes.pop("robot", {}),
        "out": out,
    }
    return EvalConfig.model_validate(settings | changes)


def tasks(max_steps: int = 4) -> dict[str, dict[str, Any]]:
    rubric = {"the cup is grasped": 1, "the cup is on the plate": 3}
    cups = {
        "instruction": "put the cup on the plate",
        "setup": "cup on the mark",
        "max_steps": 6,
        "rubric": rubric,
    }
    return {"cups": cups, "drawer": {"instruction": "open the drawer", "max_steps": max_steps}}


class Policies:
    """A factory of agents that records their names in order; the first agent of each name runs the
    rehearsal.
    """

    def __init__(self, make: Callable[[str], Agent] = Reaching) -> None:
        self.made: list[str] = []
        self.make = make

    def __call__(self, case: EvalCase) -> Agent:
        self.made.append(case.policy.name)
        return self.make(case.policy.name)


class Evaluation:
    """An evaluation in a thread."""

    def __init__(self, config: EvalConfig, operator: Operator, arm: Arm) -> None:
        self.summary: Summary | None = None
        self.error: BaseException | None = None
        self._play = lambda: evaluate_on_robot(
            config, operator, robot=arm, agent_factory=Policies()
        )
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.summary = self._play()
        except BaseException as error:  # noqa: BLE001 - the test reads it
            self.error = error

    def join(self) -> None:
        self._thread.join(60)
        assert not self._thread.is_alive()


class ScriptedPerson(TerminalOperator):
    """An operator at the terminal who types the result of `answer` for each question; `printed` has
    the output.
    """

    def __init__(
        self, answer: Callable[[str], str], before: Callable[[], None] = lambda: None
    ) -> None:
        self.printed: list[str] = []
        self._answer = answer
        self._before = before
        super().__init__(self._asked, self.printed.append, stopping=lambda: False)

    def _asked(self, question: str) -> str:
        self.printed.append(question)
        self._before()
        return self._answer(question)


def typed(lines: Sequence[str]) -> Callable[[str], str]:
    """Return an answer function that types these lines in order, and then ends the input."""
    left = iter(lines)

    def answer(_: str) -> str:
        try:
            return next(left)
        except StopIteration:
            raise EOFError from None

    return answer


def judged(verdicts: str) -> Callable[[str], str]:
    """Return an answer function that is always ready, and types these verdicts, one letter each,
    again and again.
    """
    letters = itertools.cycle(verdicts)

    def answer(question: str) -> str:
        return next(letters) if question.startswith("verdict") else ""

    return answer


@contextlib.contextmanager
def captured_output() -> Iterator[Callable[[], bytes]]:
    """Capture all output of this process to stdout and stderr, including output from C and other
    threads.
    """
    read, write = os.pipe()
    kept = {number: os.dup(number) for number in (1, 2)}
    parts: list[bytes] = []

    def drain() -> None:
        while data := os.read(read, 65536):
            parts.append(data)

    thread = threading.Thread(target=drain)
    thread.start()
    for number in kept:
        os.dup2(write, number)
    try:
        yield lambda: b"".join(parts)
    finally:
        for number, original in kept.items():
            os.dup2(original, number)
            os.close(original)
        os.close(write)
        thread.join()
        os.close(read)
