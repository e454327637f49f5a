"""The commands that a robot got last, and the checks that the next one has to pass."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Literal

import numpy as np

from vlagents_ray.chunking.fallback import Held, SafeAction
from vlagents_ray.contract import Contract
from vlagents_ray.errors import InvalidAction
from vlagents_ray.interface import Obs
from vlagents_ray.validation import check_action

Check = Callable[[np.ndarray, "np.ndarray | None"], np.ndarray]
"""The action and the one before it, (D,) each -> the action to be taken, or `InvalidAction`."""


class Motion:
    """The motion of a robot in an episode: every action passes the check against the one before it.

    Args:
        check: Sees every action, such as a `vlagents_ray.robot.Guard`; None: only the contract is checked.
        contract: The policy's contract.
        safe: The action that keeps the robot still; None if an error is to be raised in its place.
    """

    def __init__(self, check: Check | None, contract: Contract | None = None, safe: SafeAction | None = None) -> None:
        self._check, self._contract, self._safe = check, contract, safe
        self._last: np.ndarray | None = None  # the last commanded action
        self._before: np.ndarray | None = None  # the last one of the ticks before
        self._state: Literal["stopped", "moving", "held"] = "stopped"

    @property
    def can_hold(self) -> bool:
        """Whether an action is known that keeps the robot still."""
        return self._safe is not None

    def tick(self) -> None:
        """Begin a tick, at which one action may be commanded."""
        self._before = self._last

    def stop(self) -> None:
        """Note that the robot was stopped, and did not execute a command of this tick."""
        self._last = self._before
        self._state = "stopped"

    def move(self, action: np.ndarray, obs: Obs) -> np.ndarray:
        """Return an action of the policy or of a human, (D,) float32, if it may reach the robot.

        Raises:
            InvalidAction: It is not close enough to the robot's position or last target, or breaks another rule.
        """
        action = self._passed(action, obs)
        self._state = "moving"
        return self._command(action)

    def hold(self, obs: Obs, why: Held) -> tuple[np.ndarray, Held]:
        """Return the action that keeps the robot still, (D,) float32, and why, with what was refused meanwhile.

        Raises:
            InvalidAction: There is none, or none that passes the check.
        """
        if self._safe is None:
            raise InvalidAction(f"no action for this tick: {why.reason}")
        last = self._standing(obs) if self._state == "stopped" else self._last
        try:
            action = self._checked(self._safe(obs, last), last)
        except InvalidAction as refused:
            why = why._replace(reason=f"{why.reason}; the safe action is refused, too: {refused}")
            if last is None or not self._safe.holds:
                raise InvalidAction(
                    f"no action for this tick: {why.reason}; let the guard pass it, or give another one (safe=)"
                ) from refused
            action = self._checked(last, last)
        self._state = "held" if self._state == "moving" else self._state
        return self._command(action).copy(), why

    def _command(self, action: np.ndarray) -> np.ndarray:
        self._last = action
        return action

    def _passed(self, action: np.ndarray, obs: Obs) -> np.ndarray:
        if self._state == "moving":
            return self._checked(action, self._last)
        if self._state == "held":  # the last target; the robot may have been moved since, or never have arrived
            with contextlib.suppress(InvalidAction):
                return self._checked(action, self._last)
        return self._checked(action, self._standing(obs))

    def _standing(self, obs: Obs) -> np.ndarray | None:
        """Return the robot's position, (D,), as far as it is known."""
        reference = getattr(self._check, "reference", None)
        return self._last if reference is None else reference(obs, self._last)

    def _checked(self, action: np.ndarray, last: np.ndarray | None) -> np.ndarray:
        """Return a row, (D,) float32, that may be sent to the robot; raises `InvalidAction` for any other."""
        action = check_action(action, self._contract)
        if action.ndim != 1:
            raise InvalidAction(f"action: got {action.shape}, want (D,), a single row")
        return action if self._check is None else self._check(action, last)
