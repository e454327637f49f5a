"""Measures the cost of a push of weights while sessions act: the duration, the longest call, and
the node's memory.
"""

from __future__ import annotations

import statistics
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import ray
import typer
from pydantic import BaseModel

from benchmarks.console import Out, save
from vlagents_ray import RemoteAgent, TrainableAgent
from vlagents_ray.cli.console import out
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server
from vlagents_ray_learn import Publisher

_LAYER = 1_000_000  # number of parameters of a layer
_MOMENTS = 0.05  # time between two samples of the memory, s


class TrainedConfig(BaseModel, extra="forbid"):
    """The size and speed of the model that `Trained` simulates."""

    parameters: int
    dtype: str
    base_ms: float


class Trained(TrainableAgent):
    """Returns zeros after `base_ms` per batch, and has parameters that a learner may replace."""

    Config: ClassVar[type[TrainedConfig]] = TrainedConfig
    trainable = "layers"
    shared = ("config", "layers")

    def __init__(self, config: TrainedConfig) -> None:
        self.config = config

    def initialize(self) -> None:
        self.layers = layers(self.config.parameters, self.config.dtype, 0)

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        time.sleep(self.config.base_ms / 1e3)
        return [Act(np.zeros(7, np.float32)) for _ in obs]


def layers(parameters: int, dtype: str, value: float) -> dict[str, np.ndarray]:
    """Return `parameters` equal numbers, in layers of a million."""
    sizes = [_LAYER] * (parameters // _LAYER) + [parameters % _LAYER]
    return {
        f"layer.{number}": np.full(size, value, dtype) for number, size in enumerate(sizes) if size
    }


class Sessions:
    """Sessions in a process other than the learner's, each on a separate thread."""

    def __init__(self, url: str, number: int) -> None:
        """Begin the sessions, which follow the newest weights."""
        self._obs = Obs(state={"joints": np.zeros(7, np.float32)})
        self._agents = [RemoteAgent(url) for _ in range(number)]
        for agent in self._agents:
            agent.reset(self._obs, "act", weights="follow")

    def act(self, seconds: float) -> dict[str, Any]:
        """Make calls for `seconds`; return the number of calls, the longest duration, ms, the
        failures, and whether versions only increased.
        """
        ends = time.perf_counter() + seconds
        with ThreadPoolExecutor(len(self._agents)) as threads:
            each = list(threads.map(lambda agent: self._act(agent, ends), self._agents))
        return {
            "acts": sum(len(times) for times, _, _ in each),
            "longest_ms": max(max(times) for times, _, _ in each),
            "failed": sum(failed for _, _, failed in each),
            "monotone": all(versions == sorted(versions) for _, versions, _ in each),
            "newest": max(versions[-1] for _, versions, _ in each),
        }

    def _act(self, agent: RemoteAgent, ends: float) -> tuple[list[float], list[int], int]:
        times, versions, failed = [], [], 0
        while (begun := time.perf_counter()) < ends:
            try:
                act = agent.act(self._obs)
            except VLAgentsError:
                failed += 1
            else:
                versions.append(act.info["policy"]["version"])
            times.append((time.perf_counter() - begun) * 1e3)
        return times, versions, failed


def measure_push(
    parameters: int, dtype: str, sessions: int, base_ms: float, rounds: int, seconds: float
) -> list[dict[str, Any]]:
    """Return for each round the sessions' figures without and with a push, the push's duration, s,
    and the node's memory.

    In a round the sessions make calls for `seconds` without a push, then for `seconds` with a push
    after the first quarter. The memory is the largest decrease of available memory during the push,
    as a multiple of the model's bytes, without the learner's own copy of the weights.
    """
    config = {"parameters": parameters, "dtype": dtype, "base_ms": base_ms}
    document = deployment("benchmarks.push:Trained", config=config, batch={"max_size": sessions})
    url = f"serve://{document.applications[0].name}"
    found = []
    with running_server(document, num_cpus=2, ingress=False), Publisher(url) as learner:
        acting = ray.remote(num_cpus=0)(Sessions).remote(url, sessions)
        for number in range(1, rounds + 1):
            values = layers(parameters, dtype, number)
            alone = ray.get(acting.act.remote(seconds))
            during = acting.act.remote(seconds)
            time.sleep(seconds / 4)
            with _LeastAvailable() as available:
                begun = time.perf_counter()
                learner.push(values, mode="keep")
                push_s = time.perf_counter() - begun
            size = sum(value.nbytes for value in values.values())
            row = {
                "alone": alone,
                "push": ray.get(during),
                "push_s": push_s,
                "memory": available.taken / size,
            }
            found.append(row)
    return found


class _LeastAvailable:
    """Watches the memory of the node."""

    def __enter__(self) -> _LeastAvailable:
        self._before = self._least = _available()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._ended.set()
        self._thread.join()

    @property
    def taken(self) -> int:
        """The largest decrease of available memory, bytes."""
        return self._before - self._least

    def _watch(self) -> None:
        while not self._ended.wait(_MOMENTS):
            self._least = min(self._least, _available())


def _available() -> int:
    line = next(
        line
        for line in Path("/proc/meminfo").read_text().splitlines()
        if line.startswith("MemAvailable")
    )
    return int(line.split()[1]) * 1024


def main(
    parameters: Annotated[float, typer.Option(help="Number of parameters of the model.")] = 30e6,
    dtype: Annotated[
        str, typer.Option(help="Type of numpy; float16 has as many bytes as bfloat16.")
    ] = "float32",
    sessions: Annotated[int, typer.Option(min=1)] = 16,
    base_ms: Annotated[float, typer.Option(help="Duration of a batch, in ms.")] = 20.0,
    rounds: Annotated[int, typer.Option(min=1)] = 5,
    seconds: Annotated[
        float,
        typer.Option(
            help="Time for which the sessions make calls, without a push and with "
            "a push, in seconds."
        ),
    ] = 4.0,
    out_file: Out = None,
) -> None:
    """Push weights while sessions make calls."""
    found = measure_push(int(parameters), dtype, sessions, base_ms, rounds, seconds)
    for row in found:
        alone, pushed = row["alone"], row["push"]
        out.print(
            f"push {row['push_s']:.2f} s, memory {row['memory']:.2f} x the model; longest act "
            f"{pushed['longest_ms']:.0f} ms, without a push {alone['longest_ms']:.0f} ms; "
            f"{pushed['failed']} of {pushed['acts']} acts failed; "
            f"versions {'only grew' if pushed['monotone'] else 'went back'}, up to "
            f"{pushed['newest']}"
        )
    for name, value in (
        ("push, s", [row["push_s"] for row in found]),
        ("memory, x the model", [row["memory"] for row in found]),
        ("longest act, ms", [row["push"]["longest_ms"] for row in found]),
        ("longest act without a push, ms", [row["alone"]["longest_ms"] for row in found]),
    ):
        out.print(f"median {name}: {statistics.median(value):.2f}")
    save(found, out_file)


if __name__ == "__main__":
    typer.run(main)
