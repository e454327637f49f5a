"""The wrapper that makes a policy's relative actions absolute.

It adds the state of the robot at the beginning of each chunk.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
from pydantic import BaseModel, Field

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, InvalidAction
from vlagents_ray.interface import DISTRIBUTION, LEFTOVER, Act, Agent, Obs
from vlagents_ray.policies.base import ModelPolicy
from vlagents_ray.policies.base.model_inputs import (
    leftover_plan,
    needs_gripper,
    state_specs,
    state_vector,
)
from vlagents_ray.policies.outcomes import attempt
from vlagents_ray.policies.wrapper import Wrapper, unwrapped


class AbsoluteActionsConfig(BaseModel, extra="forbid"):
    """Settings of `AbsoluteActions`."""

    state: list[str] = Field(
        min_length=1,
        description="Parts of the observation's state to which actions are relative. Together, "
        "these parts have one number for each relative column of an action.",
    )
    absolute: list[int] = Field(
        default=[],
        description="Columns of an action that are already absolute, such as grippers. -1 is the "
        "last column.",
    )


class AbsoluteActions(Wrapper):
    """Adds the state of an observation to all rows of the chunk that a policy computes from it.

    Rows of several chunks then have the same meaning, however late each chunk arrives: they can be
    merged, delayed and continued. A leftover plan, which is absolute, is made relative to the state
    of the new observation.

    The checkpoints of LeRobot, openpi and GR00T have processors that make actions absolute. The
    wrapper is for any other policy that was trained with actions relative to the state at the
    beginning of a chunk. It is not for policies in which each action is relative to the previous
    pose, such as LIBERO's actions.

    Args:
        agent: The policy. It returns whole chunks of relative actions whose sum with the state is
            meaningful: joints or positions.
        config: The settings.

    Raises:
        ConfigError: The policy returns single rows of earlier chunks, or its actions are of another
            kind.
    """

    Config: ClassVar[type] = AbsoluteActionsConfig
    repeatable: ClassVar[bool] = True
    config: AbsoluteActionsConfig

    def __init__(self, agent: Agent, config: AbsoluteActionsConfig) -> None:
        super().__init__(agent, config)
        policy = unwrapped(agent)
        if isinstance(policy, ModelPolicy) and policy.config.actions != "chunk":
            raise ConfigError(
                "absolute_actions: expected a policy with actions: chunk, got "
                f"{policy.config.actions}, whose rows belong to chunks of earlier states; let the "
                "chunk player or the evaluation execute the chunks"
            )

    @property
    def contract(self) -> Contract | None:
        """The contract of the policy, with absolute actions and the state that they need."""
        inner, state_names = self.agent.contract, self.config.state
        if inner is None:
            return None
        dim = inner.action.dim
        relative_dim = None if dim is None else dim - len(self.config.absolute)
        state = state_specs(state_names, relative_dim)
        return replace(
            inner,
            state=state | dict(inner.state or {}),
            gripper=needs_gripper(state_names) or inner.gripper,
            action=replace(inner.action, delta=False, absolute=None),
        )

    def initialize(self) -> None:
        """Initialize the policy.

        Raises:
            ConfigError: The actions of the policy are not relative to a state.
        """
        super().initialize()
        inner = self.agent.contract
        if inner is None:
            return

        action = inner.action
        faults = []
        if action.delta is False:
            faults.append("absolute actions")
        if "velocity" in (action.space or ""):
            faults.append(f"actions in the space {action.space!r}")
        if action.rotation not in (None, "none"):
            faults.append(f"rotations as {action.rotation!r}")
        dim = action.dim or 0
        targets = {column % dim for column in self.config.absolute if dim}
        added = sorted({*(action.absolute or ())} - targets)
        if added:
            faults.append(f"the absolute columns {added}, which `absolute` does not name")
        if faults:
            raise ConfigError(
                "absolute_actions: expected relative actions that add up with the policy's "
                f"state, such as joints, got {' and '.join(faults)}; leave the wrapper out"
            )

    def change_batch(
        self, obs: Sequence[Obs], sessions: Sequence[Wrapper]
    ) -> list[Obs | Exception]:
        """Make the leftover plan of each observation relative to its state."""
        return [attempt(self._with_relative_plan, session_obs) for session_obs in obs]

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """Return the inner agent's actions with the states of the observations added."""
        acts = super().act_batch(obs, sessions)
        absolute: list[Act | Exception] = []
        for session_obs, act in zip(obs, acts, strict=True):
            if isinstance(act, Exception):
                absolute.append(act)
            else:
                absolute.append(attempt(self._absolute, session_obs, act))
        return absolute

    def _with_relative_plan(self, obs: Obs) -> Obs:
        """Return an observation whose leftover plan, if any, is relative to its state."""
        if obs.info.get(LEFTOVER) is None:
            return obs
        plan = leftover_plan(obs, self.agent.contract)
        relative_plan = plan - self._origin(obs, plan.shape[-1])
        return replace(obs, info={**obs.info, LEFTOVER: relative_plan})

    def _absolute(self, obs: Obs, act: Act) -> Act:
        """Return an answer in which the state of its observation is added to all actions."""
        origin = self._origin(obs, act.action.shape[-1])
        info = act.info
        if DISTRIBUTION in info:
            distribution = dict(info[DISTRIBUTION])
            for name in ("mean", "samples"):
                if name in distribution:
                    distribution[name] = distribution[name] + origin
            info = {**info, DISTRIBUTION: distribution}
        return Act(act.action + origin, act.done, info)

    def _origin(self, obs: Obs, dim: int) -> np.ndarray:
        """Return the state to which actions are relative, (dim,) float32.

        Absolute columns are zeros.
        """
        outside = [column for column in self.config.absolute if not -dim <= column < dim]
        if outside:
            raise InvalidAction(
                f"absolute_actions: expected columns of actions with {dim} numbers, got "
                f"{outside}; correct `absolute`"
            )

        relative = np.ones(dim, bool)
        relative[self.config.absolute] = False
        origin = np.zeros(dim, np.float32)
        origin[relative] = state_vector(obs, self.config.state, int(relative.sum()))
        return origin
