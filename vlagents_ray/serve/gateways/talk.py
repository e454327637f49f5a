"""What one client says, as sessions of the policy: begun with its first observation, and with each new instruction."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.interface import Act, Obs

Connect = Callable[[str | None], RemoteAgent]
"""Reaches the application for one client, whose API key that is; None for a client without one."""


class Talk:
    """The sessions of one client, all over one connection. For one thread at a time."""

    def __init__(self, connect: Connect) -> None:
        self._connect = connect
        self._key: str | None = None
        self._agents: list[RemoteAgent] = []
        self._instructions: list[str | None] = []  # of those of `_agents` that have begun

    @property
    def begun(self) -> bool:
        """Does it hold a session?"""
        return bool(self._agents)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin the next episode of its only session."""
        agent = self._sessions(1)[0]
        self._instructions = []
        info = agent.reset(obs, instruction, **kwargs)
        self._instructions = [instruction]
        return info

    def act(self, obs: Obs, instruction: str | None) -> Act:
        """The next action of its only session, which is reset before if the instruction is another one."""
        return self.act_batch([obs], [instruction])[0]

    def act_on(self, obs: Obs) -> Act:
        """The next action of its only session, whatever the instruction; `NotReset` if there is none yet."""
        return self._sessions(1)[0].act(obs)

    def act_batch(self, obs: Sequence[Obs], instructions: Sequence[str | None]) -> list[Act]:
        """The next actions of as many sessions; raises what keeps the first of them from acting."""
        agents = self._sessions(len(obs))
        begun, self._instructions = self._instructions[: len(obs)], []
        fresh = [i for i, text in enumerate(instructions) if i >= len(begun) or begun[i] != text]
        if fresh:
            infos = agents[0].reset_batch([obs[i] for i in fresh], [instructions[i] for i in fresh], _of(agents, fresh))
            _raise_first(infos)
        acts = agents[0].act_batch(obs, agents)
        self._instructions = list(instructions)
        _raise_first(acts)
        return [act for act in acts if isinstance(act, Act)]

    def show(self, key: str | None) -> None:
        """The client's API key; what was begun with another one ends."""
        if key != self._key:
            self.close()
            self._key = key

    def restart(self) -> None:
        """Reset every session before it acts again."""
        self._instructions = []

    def close(self) -> None:
        """End its sessions; whatever comes next begins others."""
        agents, self._agents, self._instructions = self._agents, [], []
        for agent in agents:
            agent.close()

    def _sessions(self, number: int) -> list[RemoteAgent]:
        if not self._agents:
            self._agents = [self._connect(self._key)]
        for agent in self._agents[number:]:
            agent.close()
        del self._agents[number:]
        if missing := number - len(self._agents):
            self._agents += self._agents[0].sessions(missing)
        return self._agents


def _of(agents: Sequence[RemoteAgent], places: Sequence[int]) -> list[RemoteAgent]:
    return [agents[i] for i in places]


def _raise_first(found: Sequence[object]) -> None:
    for one in found:
        if isinstance(one, Exception):
            raise one
