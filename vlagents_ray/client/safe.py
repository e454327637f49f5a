"""What a robot does when there is no action for it in time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, get_args

import numpy as np

from vlagents_ray.contract import ActionSpec
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Obs

SafeName = Literal["auto", "hold", "zero"]
Safe = SafeName | np.ndarray | Callable[[Obs], np.ndarray]


class SafeAction:
    """Keeps a robot where it is, by what its actions mean.

    "hold" commands the last action again: right for absolute targets. "zero" commands no motion: right for
    deltas and velocities; the columns in `grippers` keep the last action's value, as 0 would half open a gripper
    whose command is a position. "auto" takes the one that the contract's `ActionSpec` calls for, and raises
    `ConfigError` if that says neither: repeating a delta would go on moving, and zeros as joint targets would
    move the arm to its zero position. An array (D,), or a function of the observation that returns one
    (for instance of the measured joints), is taken as it is.
    """

    def __init__(self, safe: Safe, spec: ActionSpec, grippers: Sequence[int] | None = None) -> None:
        """`grippers` None: the last column, if the contract says how the gripper is opened; else none."""
        if isinstance(safe, str):
            if safe not in get_args(SafeName):
                raise ConfigError(f"safe: got {safe!r}, want one of {list(get_args(SafeName))}, an array or a function")
            self._make: SafeName | np.ndarray | Callable[[Obs], np.ndarray] = _fitting(spec) if safe == "auto" else safe
        else:
            self._make = safe if callable(safe) else np.asarray(safe, np.float32)
        self._grippers = list(grippers) if grippers is not None else [-1] if spec.gripper_open is not None else []

    def __call__(self, obs: Obs, last: np.ndarray) -> np.ndarray:
        """The safe action, (D,) float32; `last` is what the robot was commanded before."""
        if callable(self._make):
            return np.asarray(self._make(obs), np.float32)
        if isinstance(self._make, np.ndarray):
            return self._make.copy()
        if self._make == "hold":
            return last.copy()
        action = np.zeros_like(last)
        action[self._grippers] = last[self._grippers]
        return action


def _fitting(spec: ActionSpec) -> SafeName:
    if spec.delta or (spec.space is not None and "velocity" in spec.space):
        return "zero"
    if spec.delta is False:
        return "hold"
    raise ConfigError(
        "safe: the policy's contract does not say whether its actions are relative or absolute (ActionSpec.delta); "
        "give safe='hold' for absolute ones, safe='zero' for deltas and velocities, or an action of your own"
    )
