"""A caller of a policy whose answers arrive after a number of ticks, without threads."""

from __future__ import annotations

from vlagents_ray import Act, Agent, Obs


class Delayed:
    """Replaces `AsyncCaller`: an answer arrives after a number of calls of `take`, one per tick."""

    delay = 0

    def __init__(self, agent: Agent) -> None:
        self._agent, self.idle, self._answer, self._left = agent, True, None, 0

    def ask(self, obs: Obs) -> None:
        self.idle, self._answer, self._left = False, self._agent.act(obs), self.delay

    def take(self, wait_s: float = 0.0) -> Act | None:
        if self.idle or wait_s:
            return None
        if self._left > 1:
            self._left -= 1
            return None
        self.idle = True
        return self._answer

    def settle(self) -> None:
        self.idle = True

    def close(self) -> None:
        self.idle = True
