"""A leader whose commands come from elsewhere: another thread, a socket, a page of a browser."""

from __future__ import annotations

import math
import threading
import time
from typing import Literal, get_args

import numpy as np

from vlagents_ray.errors import ConfigError, InvalidAction
from vlagents_ray.interface import Obs

Silence = Literal["hold", "release"]


class RelayedLeader:
    """A leader that relays the commands of a human who is far away, and executes none that is too old.

    `command` and `release` may be called from any thread. If no command comes for `deadline_s`, the robot holds still,
    and moves again with the next command, or the policy gets it back.

    Args:
        deadline_s: How long a command counts, s, from when it was sent.
        silence: What happens then: "hold", so that only a human decides that the policy continues, or "release".

    Raises:
        ConfigError: `deadline_s` is not above 0, or `silence` is unknown.
    """

    def __init__(self, deadline_s: float = 0.2, *, silence: Silence = "hold") -> None:
        if not (math.isfinite(deadline_s) and deadline_s > 0):
            raise ConfigError(f"deadline_s: got {deadline_s}, want seconds above 0")
        if silence not in get_args(Silence):
            raise ConfigError(f"silence: got {silence!r}, want one of {list(get_args(Silence))}")
        self._deadline_s, self._silence = deadline_s, silence
        self._lock = threading.Lock()
        self._command: np.ndarray | None = None  # None: the policy has the robot
        self._sent = -math.inf  # s of `time.monotonic`: when the last command or release was

    def command(self, action: np.ndarray, ago_s: float = 0.0, *, at: float | None = None) -> bool:
        """Take over, or go on, with an action.

        Args:
            action: The human's action, (D,) float32; it is commanded at each tick until the next one.
            ago_s: How long ago it was sent, s; a sender's clock need not agree with this one.
            at: When it was sent at the earliest, s of this computer's `time.monotonic`, in place of `ago_s`.

        Returns:
            Whether it counts. One that is older than the last one, or than the deadline, does not.
        """
        sent = time.monotonic() - max(ago_s, 0.0) if at is None else at
        with self._lock:
            if sent < self._sent or self._is_late(sent):
                return False
            self._command, self._sent = np.array(action, np.float32), sent
            return True

    def release(self) -> None:
        """Give the robot back to the policy; commands that were sent before do not count any more."""
        with self._lock:
            self._command, self._sent = None, time.monotonic()

    def engaged(self) -> bool:
        """Return whether a human has the robot."""
        with self._lock:
            if self._silence == "release" and self._is_late(self._sent):
                self._command = None
            return self._command is not None

    def action(self, obs: Obs) -> np.ndarray:
        """Return the last command, (D,) float32; raises `InvalidAction` if it is too old."""
        with self._lock:
            if self._command is None:
                raise InvalidAction("relay: the human has just given the robot back")
            if self._is_late(self._sent):
                raise InvalidAction(f"relay: no command for {time.monotonic() - self._sent:.2f} s")
            return self._command

    def _is_late(self, sent: float) -> bool:
        return time.monotonic() - sent > self._deadline_s
