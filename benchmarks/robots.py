"""Runs robots that send requests at their rate and do nothing else: `python -m benchmarks.robots
URL [TRANSPORT ROBOTS]`.

Each line that the process reads is a burst, {"robots": 12, "hz": 10, "seconds": 20}. At its end it
writes each robot's figures. With TRANSPORT and ROBOTS, the robots connect at once: the process
writes the replica of each, and then each line has the arguments of `ConnectedRobots.run`.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import random
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

from benchmarks.own_clients import connect, observation
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.serve.python_env.child_start import die_with_parent, own_stdout

_CONNECT_S = 120.0


class RobotBurst(NamedTuple):
    """One robot's figures of a burst."""

    reset_s: float  # duration of the first reset, connection included, s
    # Time of each answer, s of `time.time()`, and duration of the call, ms.
    acts: list[tuple[float, float]]
    resumed: int  # number of calls before which the session had to begin again
    failed: list[str]  # reasons of calls without an action, or of a failed reset


def burst(url: str, robots: int, hz: float, seconds: float) -> list[RobotBurst]:
    """Run all robots at once, each for `seconds` after its reset."""
    with ThreadPoolExecutor(robots) as pool:
        return list(pool.map(lambda _: play(url, hz, seconds), range(robots)))


def play(url: str, hz: float, seconds: float) -> RobotBurst:
    """Run one robot. Ticks that pass during a call are skipped."""
    obs, acts, resumed, failed = observation(64, 1), [], 0, []
    with RemoteAgent(url, connect_timeout_s=_CONNECT_S, priority="robot") as agent:
        begun = time.time()
        try:
            agent.reset(obs, "let time pass")
        except VLAgentsError as error:
            return RobotBurst(time.time() - begun, [], 0, [f"reset: {error}"])
        reset_s, tick = time.time() - begun, time.time()
        until = tick + seconds
        while tick < until:
            asked = time.time()
            try:
                resumed += bool(agent.act(obs).info.get("resumed"))
                acts.append((time.time(), 1e3 * (time.time() - asked)))
            except VLAgentsError as error:
                failed.append(f"{type(error).__name__}: {error}")
            tick = max(tick + 1 / hz, time.time())
            time.sleep(max(0.0, tick - time.time()))
    return RobotBurst(reset_s, acts, resumed, failed)


class ConnectedRobots:
    """Robots that send requests at their rate, each with a session."""

    def __init__(self, url: str, transport: str, robots: int) -> None:
        self._agents = [connect(url, transport, "jpeg", "robot") for _ in range(robots)]
        # Robots connect one after another, since a server accepts only a limited number of
        # handshakes at once.
        self.replicas: list[int] = [
            agent.reset(observation(), "measure")["pid"] for agent in self._agents
        ]
        self._threads = ThreadPoolExecutor(robots)

    def run(self, begin: float, end: float, hz: float) -> list[float]:
        """Run the robots at `hz` between two times, s of `time.monotonic`, and return the time from
        tick to action of each call, ms.

        A tick that passes during a call is skipped.
        """

        def play(agent: RemoteAgent, tick: float) -> list[float]:
            taken = []
            while tick < end:
                time.sleep(max(0.0, tick - time.monotonic()))
                agent.act(observation())
                taken.append(time.monotonic() - tick)
                tick += max(1, math.ceil(taken[-1] * hz)) / hz
            return taken

        phase = random.Random(os.getpid())  # random times, which differ between processes
        ticks = [begin + phase.uniform(0, 1 / hz) for _ in self._agents]
        return [
            1e3 * taken
            for played in self._threads.map(play, self._agents, ticks)
            for taken in played
        ]

    def close(self) -> None:
        """Close all connections."""
        for agent in self._agents:
            agent.close()
        self._threads.shutdown()


def main(url: str, transport: str | None = None, robots: str = "0") -> None:
    """Run the process."""
    die_with_parent()
    out = own_stdout()
    with contextlib.ExitStack() as stack:
        said: Any = "ready"
        run: Callable[..., Any] = partial(burst, url)
        if transport is not None:
            connected = stack.enter_context(
                contextlib.closing(ConnectedRobots(url, transport, int(robots)))
            )
            said, run = connected.replicas, connected.run
        print(json.dumps(said), file=out, flush=True)
        for line in sys.stdin:
            print(json.dumps(run(**json.loads(line))), file=out, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
