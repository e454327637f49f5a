"""Measures the cost of sessions with many fine-tunes: LoRA adapters over one base in one batch,
compared with a whole model for each session.

Each variant runs in its own process. The adapters are random, for all linear layers, over a
checkpoint of a family that supports them; the models are all loaded from that checkpoint, which
takes as much memory and time as merged models would.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.console import Out, parse_dims, save
from vlagents_ray.cli.console import errors
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.base import ModelPolicy
from vlagents_ray.registry import policy_class
from vlagents_ray.serve.models.agent_copies import AgentCopies
from vlagents_ray.testing import random_observation
from vlagents_ray.weights.safetensors import header_of, parts_of

ADAPTERS, MODELS, BASE = "adapters", "models", "base alone"


def measure_adapters(
    policy: str,
    config: dict[str, Any],
    dims: Mapping[str, int],
    sessions: int,
    rank: int,
    rounds: int,
) -> dict[str, Any]:
    """Return the memory of the process, MiB, and the actions per second of CPU time, by variant and
    round.

    Args:
        policy: The name of the policy.
        config: Its settings.
        dims: The lengths of the parts of the state that the policy leaves open.
        sessions: The number of sessions, each with its own fine-tune.
        rank: The rank of the adapters.
        rounds: The number of batches that are timed.
    """
    with tempfile.TemporaryDirectory() as folder:
        adapters = _alone(_random_adapters, policy, config, sessions, rank, Path(folder))
        return {
            ADAPTERS: _alone(
                _measure, policy, config | {"adapters": adapters}, dims, 1, sessions, rounds
            ),
            MODELS: _alone(_measure, policy, config, dims, sessions, sessions, rounds),
            BASE: _alone(_measure, policy, config, dims, 1, sessions, rounds),
        }


def _alone(function: Callable[..., Any], *args: Any) -> Any:
    """Call the function in a new process."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *args).result()


def _loaded(policy: str, config: dict[str, Any]) -> ModelPolicy:
    agent: Any = policy_class(policy).from_config(config)
    agent.initialize()
    loaded: ModelPolicy = agent
    return loaded


def _random_adapters(
    policy: str, config: dict[str, Any], count: int, rank: int, folder: Path
) -> dict[str, str]:
    """Write adapters of all linear layers, as PEFT does, and return their folders by name."""
    agent, rng = _loaded(policy, config), np.random.default_rng(0)
    modules = attrgetter(agent.network or "")(agent).named_modules()
    shapes = {name: one.weight.shape for name, one in modules if type(one).__name__ == "Linear"}
    for number in range(count):
        values = {}
        for name, (outputs, inputs) in shapes.items():
            for part, shape in (("A", (rank, inputs)), ("B", (outputs, rank))):
                draw = rng.standard_normal(shape, dtype=np.float32)
                values[f"base_model.model.{name}.lora_{part}.weight"] = 0.01 * draw
        (folder / str(number)).mkdir()
        (folder / str(number) / "adapter_model.safetensors").write_bytes(
            header_of(values) + b"".join(parts_of(values))
        )
        said = json.dumps({"peft_type": "LORA", "r": rank, "lora_alpha": rank})
        (folder / str(number) / "adapter_config.json").write_text(said)
    return {str(number): str(folder / str(number)) for number in range(count)}


def _measure(
    policy: str,
    config: dict[str, Any],
    dims: Mapping[str, int],
    models: int,
    sessions: int,
    rounds: int,
) -> dict[str, Any]:
    agents = [_loaded(policy, config) for _ in range(models)]
    views = [random_observation(agents[0].contract, seed, dims=dims) for seed in range(sessions)]
    begun = []
    for number, obs in enumerate(views):
        session = AgentCopies(agents[number % len(agents)]).make()
        session.reset(
            obs, "a task", seed=number, adapter=str(number) if "adapters" in config else None
        )
        begun.append(session)
    size = sessions // len(agents)
    _run(agents, views, begun, size)
    rates = []
    for _ in range(rounds):
        start = time.process_time()
        _run(agents, views, begun, size)
        rates.append(sessions / (time.process_time() - start))
    return {"resident_mib": _resident_mib(), "acts_per_cpu_s": rates}


def _run(agents: list[ModelPolicy], views: list[Obs], sessions: list[Agent], size: int) -> None:
    """Compute one action for each session as a replica's engine does: one batch for each model."""
    for number, agent in enumerate(agents):
        part = slice(number * size, (number + 1) * size)
        for act in agent.act_batch(views[part], sessions[part]):
            if not isinstance(act, Act):
                raise act


def _resident_mib() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def main(
    checkpoint: Annotated[str, typer.Argument(help="The base: a folder or hub id.")],
    policy: Annotated[str, typer.Option(help="The policy's name.")] = "pi0",
    sessions: Annotated[
        int, typer.Option(min=1, help="Number of sessions, each with a separate fine-tune.")
    ] = 10,
    rank: Annotated[int, typer.Option(min=1, help="Rank of the adapters.")] = 16,
    state: Annotated[
        list[str] | None, typer.Option(help="NAME=LENGTH of a part of the state.")
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, help="Number of batches of all sessions.")] = 7,
    out_file: Out = None,
) -> None:
    """Measure the cost of sessions with many fine-tunes: adapters over one base, compared with a
    model for each.
    """
    with errors():
        dims = parse_dims(state or [], "--state-dim")
        found = measure_adapters(policy, {"checkpoint": checkpoint}, dims, sessions, rank, rounds)
    for way, row in found.items():
        rate = statistics.median(row["acts_per_cpu_s"])
        typer.echo(
            f"{way:12} {row['resident_mib']:7.0f} MiB of the process, {rate:6.1f} acts a second of "
            "CPU time"
        )
    save(found, out_file)


if __name__ == "__main__":
    typer.run(main)
