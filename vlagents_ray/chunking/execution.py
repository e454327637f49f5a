"""The actions that a robot executes in place of a policy's, which the policy is told with its next request."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from vlagents_ray.interface import EXECUTED

_IN_PLACE = 256  # most actions between two requests that were executed in place of the policy's


class Execution:
    """Collects the actions of one episode that are executed in place of the policy's, and states each once."""

    def __init__(self) -> None:
        """Begin an episode."""
        self._in_place: deque[np.ndarray] = deque(maxlen=_IN_PLACE)
        self._noted = False  # an action was noted in place of the policy's at this tick

    def tick(self) -> None:
        """Begin a tick, at which no action is executed in place of the policy's yet."""
        self._noted = False

    def note_in_place(self, action: np.ndarray) -> None:
        """Note an action, (D,), that is executed in place of the policy's; the next request says so."""
        self._in_place.append(action)
        self._noted = True

    def interrupt(self) -> None:
        """Note that the action of this tick was not executed, since the robot was stopped or moved."""
        if self._noted:
            self._in_place.pop()
            self._noted = False

    def report(self) -> dict[str, Any]:
        """Return the extra info of the next request: `EXECUTED`, if other actions than the policy's were executed."""
        stated: dict[str, Any] = {EXECUTED: np.stack(self._in_place)} if self._in_place else {}
        self._in_place.clear()
        return stated
