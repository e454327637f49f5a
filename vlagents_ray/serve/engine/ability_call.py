"""The use of an agent's ability from another process: the replica uses an agent that runs in its
child process.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass, field
from typing import Any

from vlagents_ray.abilities import ability, bind, members, observation_arguments
from vlagents_ray.errors import ConfigError, PolicyFailed
from vlagents_ray.interface import Agent, Obs
from vlagents_ray.registry import named_class


@dataclass(frozen=True, slots=True)
class AbilityCall:
    """A call of one method of an ability, or the request for one of its values."""

    protocol: str  # "module:Class"
    member: str = ""  # a method or an attribute; empty to check only for the ability
    # The arguments by their names in the protocol, without the observation.
    arguments: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def from_arguments(
        cls, protocol: type, member: str, args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> tuple[AbilityCall, Obs | None]:
        """Return a call of a method, and the observation among its arguments, which is None if
        there is none.

        Raises:
            TypeError: The arguments do not fit the method.
        """
        arguments = dict(bind(protocol, member, args, kwargs).arguments)
        arguments.pop("self", None)
        observing = observation_arguments(protocol).get(member)
        obs = None if observing is None else arguments.pop(observing)
        return cls(name_of(protocol), member, arguments), obs

    def is_available(self, agent: Agent) -> bool:
        """Return whether the agent has the ability. If the module of the protocol is not installed
        here, the agent does not have the ability.
        """
        try:
            protocol: type = named_class(self.protocol)
        except ConfigError:
            return False
        return ability(agent, protocol) is not None

    def execute(self, agent: Agent, obs: Obs | None) -> Any:
        """Call the method, or read the attribute, and return the result.

        Args:
            agent: The agent.
            obs: The observation among the method's arguments, if any.

        Raises:
            PolicyFailed: The agent has no such ability.
            Exception: The method has raised it.
        """
        protocol: type = named_class(self.protocol)
        able: Any = ability(agent, protocol)
        if able is None or self.member not in members(protocol):
            raise PolicyFailed(
                f"{type(agent).__name__}: expected the ability {self.protocol}, with "
                f"{self.member!r}, got an agent without it; check for it with `ability` first"
            )
        value = getattr(able, self.member)
        if not is_method(protocol, self.member):
            return value

        arguments = dict(self.arguments)
        observing = observation_arguments(protocol).get(self.member)
        if observing is not None:
            arguments[observing] = obs
        bound = bind(protocol, self.member, (), arguments)
        return value(*bound.args[1:], **bound.kwargs)


def name_of(protocol: type) -> str:
    """Return the name by which another process finds a protocol, "module:Class"."""
    return f"{protocol.__module__}:{protocol.__qualname__}"


def is_method(protocol: type, member: str) -> bool:
    """Return whether a member of a protocol is a method, rather than a value."""
    return inspect.isfunction(getattr(protocol, member, None))
