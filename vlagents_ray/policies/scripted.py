"""A policy that uses scripted experts, which solve the simulators' tasks without learning."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import BaseModel, Field

from vlagents_ray.contract import Contract
from vlagents_ray.errors import InvalidInput, NotReset
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.experts import Expert, expert_class
from vlagents_ray.registry import named_class


class ScriptedConfig(BaseModel, extra="forbid"):
    """Settings of `Scripted`: the env for clients that name no env, and the user's expert."""

    task: str | None = Field(
        default=None, description="an env's full name, e.g. 'tabletop' or 'maniskill/PushCube-v1'"
    )
    expert: str | None = Field(
        default=None, description="'module:Class' of an expert that replaces the env's own"
    )


class Scripted(Agent):
    """Chooses the expert of each session according to the session's env (see
    `policies.experts`).
    """

    Config: ClassVar[type] = ScriptedConfig
    shared: ClassVar[tuple[str, ...]] = ("config",)

    def __init__(self, config: ScriptedConfig | None = None) -> None:
        self.config = config or ScriptedConfig()
        self._class = named_class(self.config.expert) if self.config.expert else None
        self._expert: Expert | None = None

    @property
    def contract(self) -> Contract:
        return Contract()

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode of the env `kwargs["env"]`, or of the config's `task`."""
        self._expert = None  # if the reset fails, the previous episode's expert must not be used
        env = kwargs.get("env") or self.config.task
        if not isinstance(env, str):
            raise InvalidInput(
                "scripted: expected the name of an env, e.g. reset(..., env='tabletop'), got "
                f"env={env!r}; or set `task` in the policy's config"
            )
        expert: Expert = (self._class or expert_class(env))(env)
        expert.reset(obs, instruction or "")
        self._expert = expert
        return {"expert": type(expert).__name__}

    def act(self, obs: Obs) -> Act:
        """Return the action of the session's expert, (D,)."""
        if self._expert is None:
            raise NotReset(
                "scripted: act was called before reset; call reset(obs, instruction, env=...) first"
            )
        return self._expert.act(obs)
