"""Agents around agents: what changes the observations of any policy, and building a policy with its wrappers."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from typing import Any

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.registry import policy_class, wrapper_class


class Wrapper(Agent, abc.ABC):
    """An agent that shows another one changed observations.

    `Config` and `shared` are as in any agent; a session has its own copy of the wrapper and of what is inside.
    `__init__` takes the agent inside and, where there is a `Config`, an instance of it.
    """

    def __init__(self, agent: Agent, config: Any = None) -> None:
        self.agent = agent
        self.config = config

    @classmethod
    def around(cls, agent: Agent, settings: Mapping[str, Any]) -> Wrapper:
        """Wrap `agent`. An unknown setting raises `ConfigError`."""
        try:
            return cls(agent) if cls.Config is None and not settings else cls(agent, cls.Config(**settings))  # type: ignore[misc]
        except (TypeError, ValueError) as error:
            raise ConfigError(f"wrapper {cls.__name__}: {error}") from error

    @abc.abstractmethod
    def begin(self, obs: Obs, instruction: str | None) -> Obs:
        """Begin an episode: the first observation, as the policy shall see it."""

    @abc.abstractmethod
    def change_batch(self, obs: Sequence[Obs], sessions: Sequence[Wrapper]) -> list[Obs | Exception]:
        """The observations of several sessions, as the policy shall see them; an exception fails its own alone."""

    @property
    def contract(self) -> Contract | None:
        """The inner agent's."""
        return self.agent.contract

    def shared_objects(self) -> list[Any]:
        """Its own, and the inner agent's."""
        return [*super().shared_objects(), *self.agent.shared_objects()]

    def initialize(self) -> None:
        """Load the inner agent."""
        self.agent.initialize()

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode of both."""
        return self.agent.reset(self.begin(obs, instruction), instruction, **kwargs)

    def observe(self, obs: Obs) -> None:
        """Show the inner agent an observation that no action is wanted for."""
        self.agent.observe(self._change(obs))

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """One batch here, and one of the inner agent."""
        changed = self.change_batch(obs, sessions)  # type: ignore[arg-type]
        good = [i for i, one in enumerate(changed) if not isinstance(one, Exception)]
        acts = self.agent.act_batch([changed[i] for i in good], [sessions[i].agent for i in good])  # type: ignore[misc, attr-defined]
        results: list[Any] = list(changed)
        for i, act in zip(good, acts, strict=True):
            results[i] = act
        return results

    def check_health(self) -> None:
        """Ask the inner agent."""
        self.agent.check_health()

    def close(self) -> None:
        """Close the inner agent."""
        self.agent.close()

    def _change(self, obs: Obs) -> Obs:
        [changed] = self.change_batch([obs], [self])
        if isinstance(changed, Exception):
            raise changed
        return changed


def build_agent(
    policy: str, config: Mapping[str, Any], wrappers: Sequence[str | Mapping[str, Mapping[str, Any]]] = ()
) -> Agent:
    """The policy of that name with its settings, inside its wrappers; the first of them is the nearest to the robot."""
    agent: Agent = policy_class(policy).from_config(config)
    for entry in reversed(wrappers):
        named = {entry: {}} if isinstance(entry, str) else dict(entry)
        if len(named) != 1:
            raise ConfigError(f"wrappers: got {sorted(named)} in one entry, want one name each, with its settings")
        [(name, settings)] = named.items()
        cls = wrapper_class(name)
        if not issubclass(cls, Wrapper):
            raise ConfigError(f"wrappers: {name!r} is {cls.__name__}, want a subclass of {Wrapper.__module__}.Wrapper")
        agent = cls.around(agent, settings or {})
    return agent
