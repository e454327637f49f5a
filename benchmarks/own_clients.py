"""Our clients, each in a process or a Ray actor: `python -m benchmarks.own_clients JSON`.

A process holds one client that makes calls in its turn (`BenchCaller`), or several that make load
(`LoadGenerator`).
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.closed_loop import Call, ClosedLoop
from benchmarks.drivers import CALL_S, START_S, ClientProcess, ProcessDriver
from benchmarks.line_client import WARM_UP, obey, timed
from benchmarks.line_process import our_environment
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Obs
from vlagents_ray.serve.python_env.child_start import die_with_parent, own_stdout

ROBOT, SIMULATION = "robot", "simulation"


@functools.cache
def observation(size: int = 224, cameras: int = 2) -> Obs:
    """Return the observation that every server in a benchmark receives, ours and others, with
    identical bytes.

    It has camera images with smooth structure and some noise, like photographs, seven joints and a
    gripper. Each call returns the same object, which must not be changed.
    """
    rng = np.random.default_rng(0)
    y, x = np.mgrid[0:size, 0:size] / size
    images = {}
    for number in range(cameras):
        waves = [
            np.sin(2 * np.pi * (a * x + b * y) + number) for a, b in rng.uniform(-4, 4, (6, 2))
        ]
        base = np.stack([sum(waves[i : i + 2]) for i in (0, 2, 4)], axis=-1)
        images[f"camera_{number}"] = np.clip(
            128 + 50 * base + rng.normal(0, 6, base.shape), 0, 255
        ).astype(np.uint8)
    return Obs(images, 0.5, {"joints": np.zeros(7, np.float32)})


def save_observation(obs: Obs, path: Path) -> None:
    """Save an .npz file for the client of another system: every camera by its name, `joints`,
    `gripper`.
    """
    if obs.gripper is None:
        raise ValueError("the observation of a benchmark has a gripper")
    np.savez(path, gripper=np.float64(obs.gripper), joints=obs.state["joints"], **obs.cameras)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class OwnClient:
    """A client of ours, described by its transport. `codec` is as in `connect`."""

    transport: str
    codec: str = "raw"
    actor: bool = False  # whether the client is in a Ray actor, over serve://

    @property
    def name(self) -> str:
        if self.transport in ("shm", "handle", "plasma"):
            return f"{self.transport}, Ray actor" if self.actor else self.transport
        return f"{self.transport}, {'default' if self.codec == 'auto' else self.codec}"


OWN_CLIENTS = (
    OwnClient("plasma", actor=True),
    OwnClient("handle", actor=True),
    OwnClient("shm", actor=True),
    OwnClient("shm"),
    OwnClient("websocket", "raw"),
    OwnClient("websocket", "jpeg"),
    OwnClient("websocket", "auto"),
    OwnClient("http", "raw"),
    OwnClient("http", "jpeg"),
)


def own_clients(only: Sequence[str] = ()) -> list[OwnClient]:
    """Return all clients, or those with a transport in `only`."""
    if unknown := set(only) - {client.transport for client in OWN_CLIENTS}:
        known = sorted({client.transport for client in OWN_CLIENTS})
        raise ConfigError(f"transports: expected only {known}, got {sorted(unknown)}")
    return [client for client in OWN_CLIENTS if not only or client.transport in only]


def connect(url: str, transport: str, codec: str, priority: str = ROBOT) -> RemoteAgent:
    """Return an agent that has not connected yet.

    `codec` is "auto", "raw" or "jpeg", and `priority` "robot" or "simulation".
    """
    return RemoteAgent(url, transport=transport, codec=codec, priority=priority)  # type: ignore[arg-type]


class BenchCaller:
    """One session that measures its calls, in a Ray actor or a process."""

    def __init__(self, url: str, transport: str, codec: str) -> None:
        self._agent = connect(url, transport, codec)
        self._obs = observation()
        info = self._agent.reset(self._obs, "measure")
        self.description: dict[str, Any] = {
            "transport": self._agent.transport,
            "psnr_db": info.get("psnr_db"),
            "pid": os.getpid(),
        }

    def measure(self, calls: int) -> list[float]:
        return timed(lambda: self._obs, self._agent.act, calls)

    def ready(self) -> dict[str, Any]:
        """Warm up, and return the client's description."""
        self.measure(WARM_UP)
        return self.description

    def close(self) -> None:
        self._agent.close()


class LoadGenerator:
    """Clients of one process that make load: first robots, then simulations."""

    def __init__(self, url: str, transport: str, codec: str, robots: int, simulations: int) -> None:
        self._obs = observation()
        priorities = [ROBOT] * robots + [SIMULATION] * simulations
        self._agents = [connect(url, transport, codec, priority) for priority in priorities]
        with ThreadPoolExecutor(len(priorities)) as pool:
            list(pool.map(lambda agent: agent.reset(self._obs, "measure"), self._agents))
        self._loop = ClosedLoop(
            [functools.partial(self._act, agent) for agent in self._agents], robots
        )

    def ready(self) -> bool:
        """Return once `__init__` of an actor is done."""
        return True

    def run(self, **wanted: Any) -> list[list[Call]]:
        """Make calls; see `ClosedLoop.run`."""
        return self._loop.run(**wanted)

    def close(self) -> None:
        for agent in self._agents:
            agent.close()
        self._loop.close()

    def _act(self, agent: RemoteAgent) -> tuple[float, float, int]:
        timing = agent.act(self._obs).info["timing"]
        return timing["round_trip_ms"], timing["inference_ms"], int(timing["batch_size"])


@dataclass(slots=True)
class ActorDriver:
    """A client in a Ray actor, like the clients of rollouts."""

    actor: Any
    pid: int = 0  # process id of the actor, once it is ready
    server_pid: int | None = None

    def ready(self) -> dict[str, Any]:
        import ray

        said: dict[str, Any] = ray.get(self.actor.ready.remote(), timeout=START_S)
        self.pid = said["pid"]
        return said

    def measure(self, calls: int) -> list[float]:
        import ray

        taken: list[float] = ray.get(self.actor.measure.remote(calls), timeout=CALL_S + calls)
        return taken


@contextlib.contextmanager
def connected(client: OwnClient, url: str, app: str) -> Iterator[ProcessDriver]:
    """Start a client of ours to the server at `url`."""
    if client.actor:
        import ray

        actor = ray.remote(num_cpus=0)(BenchCaller).remote(
            f"serve://{app}", client.transport, client.codec
        )
        try:
            yield ActorDriver(actor)
        finally:
            # If the client never connected, `ready` has raised the reason.
            with contextlib.suppress(ray.exceptions.RayError):
                ray.get(actor.close.remote(), timeout=CALL_S)
            ray.kill(actor)
        return
    settings = json.dumps({"url": url, "transport": client.transport, "codec": client.codec})
    command = [sys.executable, "-m", "benchmarks.own_clients", settings]
    with ClientProcess(client.name, command, our_environment()) as child:
        yield child


def main() -> None:
    """Run the process: the settings are JSON; with "robots" it makes load."""
    die_with_parent()
    out = own_stdout()
    settings = json.loads(sys.argv[1])
    if "robots" not in settings:
        caller = BenchCaller(**settings)
        try:
            obey(sys.stdin, out, caller.measure, caller.description)
        finally:
            caller.close()
        return
    load = LoadGenerator(**settings)
    print(json.dumps(load.ready()), file=out, flush=True)
    for line in sys.stdin:
        print(json.dumps(load.run(**json.loads(line))), file=out, flush=True)
    load.close()


if __name__ == "__main__":
    main()
