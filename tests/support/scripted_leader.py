"""Leaders for tests, which do at each tick what the test says."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vlagents_ray import Obs


class HoldingLeader:
    """Has a robot of two joints all the time, and holds it; made without arguments, as commands
    make a leader.
    """

    def engaged(self) -> bool:
        return True

    def action(self, obs: Obs) -> np.ndarray:
        return np.full(2, 0.25, np.float32)


class ScriptedLeader:
    """Wants the robot while `wants` is set or true, and commands what `command` says or returns."""

    def __init__(
        self,
        command: np.ndarray | Callable[[Obs], np.ndarray],
        wants: Callable[[], bool] = lambda: False,
    ) -> None:
        self.command = command
        self.wants = wants
        self.held = False
        self.polls = 0
        self.given: list[np.ndarray] = []

    def engaged(self) -> bool:
        self.polls += 1
        return self.held or self.wants()

    def action(self, obs: Obs) -> np.ndarray:
        self.given.append(self.command(obs) if callable(self.command) else self.command)
        return self.given[-1]
