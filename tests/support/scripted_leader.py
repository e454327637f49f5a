"""Scripted leaders for tests of teleoperation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vlagents_ray import Obs


class HoldingLeader:
    """A leader that always controls a robot with two joints. It has no arguments, so that commands
    can create it.
    """

    def engaged(self) -> bool:
        return True

    def action(self, obs: Obs) -> np.ndarray:
        return np.full(2, 0.25, np.float32)


class ScriptedLeader:
    """A leader that is engaged while `held` is set or `wants` returns true, and whose actions come
    from `command`.
    """

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
