"""Measures the cost of a child process behind the replica: calls of `act` of a policy that does
nothing, in either process, interleaved.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable
from typing import Annotated, Any

import typer

from benchmarks.console import Out, save, show_round_trips
from benchmarks.own_clients import observation
from benchmarks.round_trips import RoundTripsOfAll, in_turns
from vlagents_ray.cli.console import errors, progress
from vlagents_ray.interface import Agent
from vlagents_ray.policies.noop import Noop
from vlagents_ray.serve.models.agent_copies import AgentCopies
from vlagents_ray.serve.python_env.child_agent import ChildAgent
from vlagents_ray.serve.python_env.child_main import Settings
from vlagents_ray.serve.python_env.child_process import ChildProgram
from vlagents_ray.serve.python_env.probe import probe

IN_PROCESS, CHILD = "in the replica", "child process"
_WARM_UP = 20


def measure_hop(
    calls: int, python: str = sys.executable, progress: Callable[[str], None] = lambda _: None
) -> RoundTripsOfAll:
    """Measure `calls` calls of `act` in each process, as the engine makes them.

    `python` is the child's interpreter; raises `ConfigError` if no policy can run in it.
    """
    probe(python)
    with contextlib.ExitStack() as stack:
        agents = {
            IN_PROCESS: Noop.from_config({}),
            CHILD: ChildAgent(ChildProgram(python, Settings("noop", {}, 1, ""), {})),
        }
        drivers = {name: _Driver(stack.enter_context(agent)) for name, agent in agents.items()}
        found = in_turns(drivers, calls, progress)
        return RoundTripsOfAll(tuple(found.values()))


class _Driver:
    """Calls an agent with one session as an engine does."""

    def __init__(self, agent: Agent) -> None:
        agent.initialize()
        self._agent = agent
        self._session = AgentCopies(agent).make()
        self._session.reset(observation(), "a task")
        self.measure(_WARM_UP)

    def ready(self) -> dict[str, Any]:
        """Return nothing: the agent is ready."""
        return {}

    def measure(self, calls: int) -> list[float]:
        """Make calls, and return their durations, ms."""
        taken = []
        for _ in range(calls):
            begun = time.perf_counter()
            self._agent.act_batch([observation()], [self._session])
            taken.append((time.perf_counter() - begun) * 1e3)
        return taken


def main(
    calls: Annotated[int, typer.Option(min=1, help="Number of calls in each process.")] = 2000,
    python: Annotated[
        str, typer.Option(help="The child's interpreter; default: this one.")
    ] = sys.executable,
    out_file: Out = None,
) -> None:
    """Measure the cost of a policy in a child process behind the replica, compared with a policy in
    the replica.
    """
    with errors():
        found = measure_hop(calls, python, progress).to_json()
    show_round_trips(found, "one act, as the batch queue sees it")
    save(found, out_file)


if __name__ == "__main__":
    typer.run(main)
