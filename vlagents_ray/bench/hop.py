"""What a child process behind the replica costs: one `act` of a policy that does nothing, here and there, in turns."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable
from typing import Any

from vlagents_ray.bench.observing import observation
from vlagents_ray.bench.rtt import RoundTripsOfAll, in_turns
from vlagents_ray.interface import Agent
from vlagents_ray.policies.noop import Noop
from vlagents_ray.serve.environments.agent import ChildAgent
from vlagents_ray.serve.environments.child import Child
from vlagents_ray.serve.environments.host import Settings
from vlagents_ray.serve.environments.interpreter import probe
from vlagents_ray.serve.sessions import AgentCopies

IN_PROCESS, CHILD = "in the replica", "child process"
_WARM_UP = 20


def measure_hop(
    calls: int, python: str = sys.executable, tell: Callable[[str], None] = lambda _: None
) -> RoundTripsOfAll:
    """`calls` acts on the bench's observation by each way, from the engine's side: `RoundTripsOfAll`.

    `python` is the child's interpreter; `ConfigError` if no policy can run there.
    """
    probe(python)
    with contextlib.ExitStack() as stack:
        agents = {
            IN_PROCESS: Noop.from_config({}),
            CHILD: ChildAgent(Child(python, Settings("noop", {}, 1, ""), {})),
        }
        drivers = {name: _Driver(stack.enter_context(agent)) for name, agent in agents.items()}
        found = in_turns(drivers, calls, tell)
        return RoundTripsOfAll(tuple(found.values()))


class _Driver:
    """An agent with one session, asked as an engine asks it."""

    def __init__(self, agent: Agent) -> None:
        agent.initialize()
        self._agent = agent
        self._session = AgentCopies(agent).make()
        self._session.reset(observation(), "a task")
        self.measure(_WARM_UP)

    def ready(self) -> dict[str, Any]:
        """It is."""
        return {}

    def measure(self, calls: int) -> list[float]:
        """Milliseconds of each call."""
        taken = []
        for _ in range(calls):
            begun = time.perf_counter()
            self._agent.act_batch([observation()], [self._session])
            taken.append((time.perf_counter() - begun) * 1e3)
        return taken
