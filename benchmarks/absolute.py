"""The tabletop with absolute actions, and the wrapper with which the reference policy acts in it.

`benchmarks.delays` measures with them how the success of absolute targets falls with the delay. The
policy and the task are those of the measurement with relative actions, so only the kind of action
differs:

    python -m benchmarks.delays benchmarks/absolute.yaml \\
        --env benchmarks.absolute:AbsoluteTabletop --clock 'neutral=[0,0.2,0.16,1]'
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vlagents_ray.contract import Contract, StateSpec
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.envs.tabletop.world import STEP_LIMIT
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.wrapper import Wrapper


class AbsoluteTabletop(Tabletop):
    """The tabletop whose actions are target positions of the fingertips, m, and the gripper.

    The fingertips move towards the target by at most 3 cm per step along each axis.
    `state["xyz"]` (3,) is their position.
    """

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract:
        relative = super().known_contract(arguments)
        action = replace(relative.action, delta=False, low=None, high=None)
        state = {**(relative.state or {}), "xyz": StateSpec(3, "m")}
        return replace(relative, state=state, action=action)

    def reset(
        self, *, seed: int, options: Mapping[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        obs, info = super().reset(seed=seed, options=options)
        return _with_position(obs), info

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        world = self._world
        if world is not None:
            here = np.array((world.x, world.y, world.z))
            motion = np.clip((act.action[:3] - here) / STEP_LIMIT, -1.0, 1.0)
            act = Act(np.append(motion, act.action[3]).astype(np.float32))
        obs, *rest = super().step(act)
        return _with_position(obs), *rest  # type: ignore[return-value]


class FromFirstPose(Wrapper):
    """Makes the actions of a chunk relative to the position at its beginning, m, which the wrapper
    `absolute_actions` then makes absolute. The policy's actions are steps from row to row.
    """

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """Return the actions of the policy with the sums of its steps."""
        return [
            act if isinstance(act, Exception) else self._summed(act)
            for act in super().act_batch(obs, sessions)
        ]

    def _summed(self, act: Act) -> Act:
        steps = STEP_LIMIT * np.clip(act.action[..., :3], -1.0, 1.0)
        grippers = act.action[..., 3:]
        action = np.concatenate([np.cumsum(steps, axis=0), grippers], -1).astype(np.float32)
        return replace(act, action=action)

    @property
    def contract(self) -> Contract | None:
        """The contract of the policy, without the limits of its steps."""
        inner = self.agent.contract
        if inner is None:
            return None
        return replace(inner, action=replace(inner.action, low=None, high=None))


def _with_position(obs: Obs) -> Obs:
    return replace(obs, state={**obs.state, "xyz": obs.state["xyzrpy"][:3]})
