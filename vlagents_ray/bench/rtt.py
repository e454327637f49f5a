"""Round trips of one `act`: every transport of ours, interleaved on one server of a `noop` policy.

The observation is that of the paper's measurement: two 224x224 RGB cameras and seven joints. All
transports take turns in short rounds, so that whatever else the machine does hits them alike.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.client.ways import TransportName
from vlagents_ray.interface import Obs
from vlagents_ray.serve.cluster import Server, running_server
from vlagents_ray.serve.files import deployment
from vlagents_ray.wire.codecs import JPEG, RAW, ImageCodec

_WARM_UP = 20
_ROUND = 25  # calls of one transport before it is the next one's turn


@dataclass(frozen=True, slots=True)
class Way:
    """One way to the policy."""

    transport: TransportName
    codec: ImageCodec

    @property
    def name(self) -> str:
        """For the table."""
        coded = self.transport in ("websocket", "http")
        return f"{self.transport}, {self.codec.name}" if coded else self.transport


WAYS = (
    Way("shm", RAW),
    Way("websocket", RAW),
    Way("websocket", JPEG),
    Way("http", RAW),
    Way("http", JPEG),
    Way("handle", RAW),
)


@dataclass(frozen=True, slots=True)
class RoundTrips:
    """Milliseconds of each call by one way."""

    name: str
    ms: np.ndarray  # (N,) float64

    @property
    def median(self) -> float:
        """Half of the calls took less."""
        return float(np.median(self.ms))

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of the median, from order statistics, without assuming a distribution."""
        ordered = np.sort(self.ms)
        n = len(ordered)
        half = 0.98 * np.sqrt(n)  # 1.96 standard deviations of a binomial with p = 1/2
        low, high = int(max(0, np.floor(n / 2 - half))), int(min(n - 1, np.ceil(n / 2 + half)))
        return float(ordered[low]), float(ordered[high])

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        p99 = float(np.quantile(self.ms, 0.99))
        return {
            "way": self.name,
            "calls": len(self.ms),
            "median_ms": self.median,
            "ci95_ms": self.interval,
            "p99_ms": p99,
        }


def observation(size: int = 224, cameras: int = 2) -> Obs:
    """Cameras with smooth structure and some noise, as photographs have; seven joints; a gripper."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[0:size, 0:size] / size
    images = {}
    for number in range(cameras):
        waves = [np.sin(2 * np.pi * (a * x + b * y) + number) for a, b in rng.uniform(-4, 4, (6, 2))]
        base = np.stack([sum(waves[i : i + 2]) for i in (0, 2, 4)], axis=-1)
        images[f"camera_{number}"] = np.clip(128 + 50 * base + rng.normal(0, 6, base.shape), 0, 255).astype(np.uint8)
    return Obs(images, 0.5, {"joints": np.zeros(7, np.float32)})


def measure_rtt(calls: int = 500, tell: Callable[[str], None] = lambda _: None) -> list[RoundTrips]:
    """`calls` round trips by each way, on a server started for them."""
    obs = observation()
    taken: dict[str, list[float]] = {way.name: [] for way in WAYS}
    with running_server(deployment("noop")) as server, _agents(server) as agents:
        for agent in agents.values():
            agent.reset(obs, "measure")
            for _ in range(_WARM_UP):
                agent.act(obs)
        done = 0
        while done < calls:
            for name, agent in agents.items():
                for _ in range(min(_ROUND, calls - done)):
                    begun = time.perf_counter()
                    agent.act(obs)
                    taken[name].append((time.perf_counter() - begun) * 1e3)
            done += _ROUND
            tell(f"{min(done, calls)} of {calls} calls by each way")
    return [RoundTrips(name, np.array(ms)) for name, ms in taken.items()]


@contextlib.contextmanager
def _agents(server: Server) -> Iterator[dict[str, RemoteAgent]]:
    with contextlib.ExitStack() as stack:
        yield {
            way.name: stack.enter_context(
                RemoteAgent(
                    "serve://noop" if way.transport == "handle" else server.url,
                    transport=way.transport,
                    codec=way.codec,
                )
            )
            for way in WAYS
        }
