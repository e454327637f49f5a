"""The arms of a scene: one flat row and named parts of the state here, a dict for each robot in RCS."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, Rotation, StateSpec
from vlagents_ray.envs.rcs.tasks import ControlMode

# RCS's angles are roll, pitch, yaw about fixed axes, R = Rz Ry Rx; its quaternions end with w.
_UNITS = {"joints": "rad", "tquat": "m+quat_xyzw", "xyzrpy": "m+rad"}
_COMMANDS: dict[ControlMode, tuple[str, Rotation]] = {
    "joints": ("joint", "none"),
    "tquat": ("ee_pose", "quat_xyzw"),
    "xyzrpy": ("ee_pose", "euler_xyz"),
}


class Arms:
    """Translates between RCS's dicts, keyed by robot, and what policies see.

    The parts of a single arm's state have plain names, `joints`; those of several begin with the
    arm's, `left/joints`, and so does the gripper, which then is a part of the state, (1,). In a row of
    the action each arm has its command, then its gripper, 1 = open; the arms follow each other.
    """

    def __init__(self, actions: Mapping[str, Any], observations: Mapping[str, Any], mode: ControlMode) -> None:
        """`actions` and `observations` are RCS's spaces: robot -> part -> Box (D,)."""
        self.names = tuple(actions)
        self.single = len(self.names) == 1
        self._mode = mode
        self._sizes = {name: int(actions[name][mode].shape[0]) for name in self.names}
        self._grippers = {name for name in self.names if "gripper" in actions[name].spaces}
        self.state = {
            self._key(name, part): StateSpec(int(observations[name][part].shape[0]), unit)
            for name in self.names
            for part, unit in _UNITS.items()
        }
        if not self.single:
            self.state |= {self._key(name, "gripper"): StateSpec(1) for name in self.names if name in self._grippers}
        self.has_gripper = self.single and bool(self._grippers)  # that `Obs.gripper` can tell

    def action_spec(self, *, delta: bool) -> ActionSpec:
        """The contract of an action."""
        space, rotation = _COMMANDS[self._mode]
        return ActionSpec(
            dim=sum(self._sizes.values()) + len(self._grippers),
            space=space,
            delta=delta,
            rotation=rotation,
            frame=None if self._mode == "joints" else "base",
            gripper_open=1.0 if self._grippers else None,
            gripper_closed=0.0 if self._grippers else None,
            arms=None if self.single else self.names,
        )

    def command(self, row: np.ndarray) -> dict[str, dict[str, np.ndarray]]:
        """A row, (D,), as RCS takes it."""
        commands: dict[str, dict[str, np.ndarray]] = {}
        rest = row.astype(np.float64)
        for name in self.names:
            pose, rest = np.split(rest, [self._sizes[name]])
            commands[name] = {self._mode: pose}
            if name in self._grippers:
                commands[name]["gripper"], rest = np.split(rest, [1])
        return commands

    def read(self, observation: Mapping[str, Any]) -> tuple[dict[str, np.ndarray], float | None]:
        """The state, each part (D,) float32, and a single arm's gripper in [0, 1], 1 = open."""
        state = {
            self._key(name, part): np.array(observation[name][part], dtype=np.float32)
            for name in self.names
            for part in _UNITS
        }
        openings = {name: np.clip(np.array(observation[name]["gripper"], np.float32), 0, 1) for name in self._grippers}
        if self.single:
            return state, float(openings[self.names[0]][0]) if openings else None
        return state | {self._key(name, "gripper"): opening for name, opening in openings.items()}, None

    def _key(self, name: str, part: str) -> str:
        return part if self.single else f"{name}/{part}"
