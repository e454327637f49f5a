"""An operator at a terminal, who types the answers."""

from __future__ import annotations

import select
import sys
from collections.abc import Callable

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.robot.operator import Operator, Outcome, Verdict, VisibleTrial
from vlagents_ray.evaluate.robot.pictures import save_overlay
from vlagents_ray.interface import Obs
from vlagents_ray.naming import distinct

_OUTCOMES: dict[str, Outcome] = {"s": "success", "f": "failure", "p": "partial", "r": "repeat"}


class TerminalOperator(Operator):
    """An operator at a terminal. Enter stops a running trial.

    Args:
        ask: Prints a question and returns the typed line, as `input` does; raises `EOFError` if nobody answers.
        say: Prints a line.
        stopping: Returns whether the running trial is to be stopped; by default, whether Enter was pressed.
    """

    def __init__(
        self,
        ask: Callable[[str], str] = input,
        say: Callable[[str], None] = print,
        stopping: Callable[[], bool] | None = None,
    ) -> None:
        self._ask = ask
        self._say = say
        self._stopping = _enter_pressed if stopping is None else stopping

    def prepare(self, trial: VisibleTrial, observe: Callable[[], Obs]) -> bool:
        self._say(f"\ntrial {trial.number} of {trial.total}: {trial.task}, scene {trial.scene}")
        if trial.message:
            self._say(f"  {trial.message}")
        self._say(f"  {trial.instruction}")
        if trial.setup:
            self._say(f"  {trial.setup}")
        for picture in trial.start.values():
            self._say(f"  set it as in {picture}")
        while True:
            try:
                typed = self._ask("Enter when the scene is ready, l to look at it over the start picture, q to end: ")
            except EOFError:
                return False
            if typed.strip().lower() in ("", "q"):
                return not typed.strip()
            if typed.strip().lower() == "l":
                self._look(trial, observe())

    def watch(self, obs: Obs) -> None:
        """Show nothing: the operator sees the robot."""

    def stops(self) -> bool:
        return self._stopping()

    def judge(self, trial: VisibleTrial, ending: str) -> Verdict:
        self._say(f"trial {trial.number} has ended: {ending}")
        choices = "s success, f failure, p partial, r repeat" if trial.rubric else "s success, f failure, r repeat"
        while True:
            try:
                outcome = _OUTCOMES.get(self._ask(f"verdict ({choices}): ").strip().lower())
                if outcome is None:
                    continue
                earned = self._earned(trial) if outcome == "partial" and trial.rubric else ()
                verdict = Verdict(outcome, earned, self._ask("why: " if outcome == "repeat" else "note: ").strip())
            except EOFError:
                raise KeyboardInterrupt from None
            try:
                verdict.score(trial.rubric)
            except ConfigError as error:
                self._say(str(error))
            else:
                return verdict

    def _earned(self, trial: VisibleTrial) -> tuple[str, ...]:
        return tuple(
            part
            for part, points in trial.rubric.items()
            if self._ask(f"  {part} ({points:g} points), reached? y/n: ").strip().lower().startswith("y")
        )

    def _look(self, trial: VisibleTrial, obs: Obs) -> None:
        if not trial.start:
            self._say("  this scene has no start picture yet: it is taken when you begin")
        for camera, name in distinct(obs.cameras).items():
            if name in trial.start:
                self._say(f"  {save_overlay(trial.start[name], obs.cameras[camera])}")


def _enter_pressed() -> bool:
    """Whether a line was typed at the terminal; False for an input that is no terminal, which is not read ahead."""
    if not sys.stdin.isatty() or not select.select([sys.stdin], [], [], 0)[0]:
        return False
    sys.stdin.readline()
    return True
