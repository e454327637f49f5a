"""Environments whose state has an angle that wraps from pi to -pi, and a policy that solves them
and then stops.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs import EvalEnv
from vlagents_ray.interface import Act, Agent, Obs

ROLLER, TILTED_ROLLER = "wrist_roll_env:Roller", "wrist_roll_env:TiltedRoller"


class Roller(EvalEnv):
    """An environment in which a wrist turns past pi. With an even seed, the task is solved at the
    sixth of twelve steps.
    """

    max_steps = 12
    TURN = 0.3  # rad per step

    @property
    def contract(self) -> Contract:
        return Contract(
            cameras={"base": CameraSpec(32, 48), "wrist": CameraSpec(16, 16)},
            state={"joints": StateSpec(2, "rad"), "xyzrpy": StateSpec(6, "m+rad")},
            gripper=True,
            action=ActionSpec(
                dim=2,
                delta=True,
                space="joint",
                gripper_open=1.0,
                gripper_closed=-1.0,
                low=-1.0,
                high=1.0,
            ),
            control_hz=10.0,
        )

    @property
    def instruction(self) -> str:
        return "turn the wrist"

    def reset(
        self, *, seed: int, options: Mapping[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        self.seed, self.turned, self.steps = seed, 2.5, 0
        return self.look(), {}

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        self.turned += float(act.action[0])
        solved = self.seed % 2 == 0 and self.steps >= 6
        return self.look(), 0.0, False, self.steps == self.max_steps, {"success": solved}

    def close(self) -> None:
        self.steps = 0

    def look(self) -> Obs:
        roll = float(np.angle(np.exp(1j * self.turned)))
        state = {"joints": [0.1, self.turned - 2.5], "xyzrpy": [0.1, 0.2, 0.3, roll, 0.0, 0.0]}
        return Obs(
            cameras={
                "base": np.full((32, 48, 3), 90, np.uint8),
                "wrist": np.full((16, 16, 3), 30, np.uint8),
            },
            gripper=1.0,
            state={name: np.array(values, np.float32) for name, values in state.items()},
        )


class TiltedRoller(Roller):
    """Roller with a rotation vector about a tilted axis."""

    AXIS = np.array([0.6, 0.0, 0.8])

    @property
    def contract(self) -> Contract:
        return replace(
            super().contract,
            state={"joints": StateSpec(2, "rad"), "xyz_axis_angle": StateSpec(6, "m+rad")},
        )

    def look(self) -> Obs:
        obs = super().look()
        pose = np.array([0.1, 0.2, 0.3, *(obs.state["xyzrpy"][3] * self.AXIS)], np.float32)
        return replace(obs, state={"joints": obs.state["joints"], "xyz_axis_angle": pose})


class Turner(Agent):
    """A policy that turns for six steps, and then stands still."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.steps = 0
        return {}

    def act(self, obs: Obs) -> Act:
        self.steps += 1
        return Act(np.array([Roller.TURN if self.steps <= 6 else 0.0, 1.0], np.float32))
