"""What a policy alone gives on this machine, by batch size, without Ray: bare, and behind a replica's batch queue.

Bare is `act_batch` on full batches, one after another. Behind the queue as many sessions as the batch has rows ask
again as soon as they are answered. The policy is loaded once for both. `python -m vlagents_ray.bench.policy JSON` is
the bare policy of `bench throughput`, in a process of its own.
"""

from __future__ import annotations

import json
import queue
import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from vlagents_ray.bench.clients import observation
from vlagents_ray.bench.peers.peer import die_with_parent, own_stdout
from vlagents_ray.bench.throughput import rate_of
from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Agent, Obs
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.registry import policy_class
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.models.agent_copies import AgentCopies
from vlagents_ray.serve.models.loaded_model import synchronise
from vlagents_ray.testing.observations import random_observation

INSTRUCTION = "pick up the cube"
_LATE_S = 600.0  # a first batch may be compiled
_WARM = 2  # batches that do not count


@dataclass(frozen=True, slots=True)
class PolicyPlan:
    """The settings of `measure_policy`."""

    args: ServerArgs  # of a deployment file
    batches: Sequence[int] = (1, 8)
    seconds: float = 2.0  # of each measurement
    rounds: int = 3  # in which all measurements take turns
    side: int = 224  # px, of images of which the policy takes any size
    dims: Mapping[str, int] = field(default_factory=dict)  # of parts of the state for which it does not say


def measure_policy(plan: PolicyPlan, progress: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Measure what the plan says; returns plain JSON values: actions a second, ms, MiB."""
    batch = plan.args.batch
    if batch.sizes is not None and max(plan.batches) > batch.sizes[-1]:
        raise ConfigError(f"--batch: got {max(plan.batches)}, the file's largest of batch.sizes is {batch.sizes[-1]}")
    agent: Agent = build_agent(plan.args.policy, plan.args.config, plan.args.wrappers)
    began = time.perf_counter()
    with _serving(agent, plan) as engine:
        load_s = time.perf_counter() - began
        progress(f"{plan.args.policy}: loaded in {load_s:.1f} s")
        copies, rows = AgentCopies(agent), {size: _SizedRow(size) for size in plan.batches}
        for number in range(plan.rounds):
            for row in rows.values():
                _forget_peak()
                row.bare.append(_bare(agent, copies, plan, row.size))
                row.queued.append(_queued(engine, plan, row.size))
                row.memory.append(_peak_mib())
            rates = ", ".join(f"{row.size}: {row.bare[-1]['actions_per_s']:.1f}/s" for row in rows.values())
            progress(f"round {number + 1} of {plan.rounds}: {rates}")
        contract = engine.contract
    return {
        "policy": plan.args.policy,
        "device": _device(),
        "load_s": load_s,
        "chunk": None if contract is None else contract.chunk,
        "batches": [row.to_json() for row in rows.values()],
    }


@dataclass(slots=True)
class _SizedRow:
    """A batch size, measured in each round."""

    size: int
    bare: list[dict[str, float]] = field(default_factory=list)
    queued: list[dict[str, float]] = field(default_factory=list)
    memory: list[float] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """Return the medians of the rounds, and the rounds."""
        return {
            "batch": self.size,
            "bare": _medians(self.bare),
            "queued": _medians(self.queued),
            "peak_mib": max(self.memory),
            "rounds": {"bare": self.bare, "queued": self.queued},
        }


def _medians(rounds: list[dict[str, float]]) -> dict[str, float]:
    return {name: statistics.median(one[name] for one in rounds) for name in rounds[0]}


@contextmanager
def _serving(agent: Agent, plan: PolicyPlan) -> Iterator[Engine]:
    engine = Engine(
        agent,
        max_batch_size=max(plan.batches),
        patience=plan.args.batch.patience,
        batch_sizes=plan.args.batch.sizes or (),
    )
    try:
        engine.start()
        yield engine
    finally:
        engine.close()


def _views(contract: Contract | None, plan: PolicyPlan, size: int) -> list[Obs]:
    return [random_observation(contract, seed, side=plan.side, dims=plan.dims) for seed in range(size)]


def _bare(agent: Agent, copies: AgentCopies, plan: PolicyPlan, size: int) -> dict[str, float]:
    views, sessions = _views(agent.contract, plan, size), [copies.make() for _ in range(size)]
    for seed, (session, obs) in enumerate(zip(sessions, views, strict=True)):
        session.reset(obs, INSTRUCTION, seed=seed)
    times: list[float] = []
    while len(times) < _WARM + 1 or sum(times[_WARM:]) < plan.seconds:
        begun = time.perf_counter()
        for act in agent.act_batch(views, sessions):
            if isinstance(act, Exception):
                raise act
        synchronise()
        times.append(time.perf_counter() - begun)
    times = times[_WARM:]
    return {"actions_per_s": size * len(times) / sum(times), "batch_ms": statistics.median(times) * 1e3}


def _queued(engine: Engine, plan: PolicyPlan, size: int) -> dict[str, float]:
    """Measure sessions that send the next request as soon as they are answered, as simulations do."""
    views = _views(engine.contract, plan, size)
    answers: queue.SimpleQueue[tuple[int, Reply]] = queue.SimpleQueue()
    asked = [0.0] * size

    def ask(i: int, op: Any, **given: Any) -> None:
        asked[i] = time.perf_counter()
        request = Request(op, views[i], rank="simulation", **given)
        engine.submit(f"bench-{i}", request, lambda reply: answers.put((i, reply)))

    def answer() -> tuple[int, Reply, float]:
        i, reply = answers.get(timeout=_LATE_S)
        if reply.error is not None:
            raise reply.error
        return i, reply, time.perf_counter()

    for i in range(size):
        ask(i, "reset", instruction=INSTRUCTION, kwargs={"seed": i})
    for _ in range(size):
        answer()
    for i in range(size):
        ask(i, "act")
    calls: list[tuple[float, float, float]] = []
    waiting, first = size, _WARM * size
    while waiting:
        i, reply, now = answer()
        calls.append((now, now - asked[i], reply.timing["batch_size"]))
        waiting -= 1
        if len(calls) <= first or now - calls[first][0] < plan.seconds:
            waiting += 1
            ask(i, "act")
    for i in range(size):
        ask(i, "close")
        answer()
    calls = calls[first:]
    return {
        "actions_per_s": rate_of([calls]),  # type: ignore[list-item]
        "round_trip_ms": statistics.median(call[1] for call in calls) * 1e3,
        # Each call counts its batch once for each of the batch's members: the harmonic mean is the batches' own.
        "mean_batch": len(calls) / sum(1 / call[2] for call in calls),
    }


def _cuda() -> Any:
    """Return `torch.cuda` if this process uses it."""
    torch = sys.modules.get("torch")
    return torch.cuda if torch is not None and torch.cuda.is_available() and torch.cuda.is_initialized() else None


def _jax_device() -> Any:
    """Return JAX's first device, if this process uses one that is no CPU."""
    jax = sys.modules.get("jax")
    device = None if jax is None else jax.local_devices()[0]
    return None if device is None or device.platform == "cpu" else device


def _forget_peak() -> None:
    if (cuda := _cuda()) is not None:
        cuda.reset_peak_memory_stats()


def _peak_mib() -> float:
    """Return the peak memory of the policy's accelerator, by torch since `_forget_peak`; else of this process."""
    if (cuda := _cuda()) is not None:
        return float(cuda.max_memory_allocated()) / 2**20
    if (device := _jax_device()) is not None:
        return float((device.memory_stats() or {}).get("peak_bytes_in_use", 0)) / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def _device() -> str:
    if (cuda := _cuda()) is not None:
        return str(cuda.get_device_name())
    if (device := _jax_device()) is not None:
        return str(device.device_kind)
    return "cpu"


class BarePolicy:
    """A policy without any server, `batch` observations at a time: what a served one is compared with."""

    def __init__(self, policy: str, config: dict[str, Any], batch: int) -> None:
        self._agent = policy_class(policy).from_config(config)
        self._agent.initialize()
        self._obs = [observation()] * batch
        self._agent.reset(self._obs[0], "measure")
        self._batch()

    def rate(self, seconds: float) -> float:
        """Measure for at least that time, s; returns actions a second."""
        begun = time.perf_counter()
        batches = 0
        while (taken := time.perf_counter() - begun) < seconds or batches == 0:
            self._batch()
            batches += 1
            taken = time.perf_counter() - begun
        return batches * len(self._obs) / taken

    def _batch(self) -> None:
        for act in self._agent.act_batch(self._obs, [self._agent] * len(self._obs)):
            if isinstance(act, Exception):
                raise act


def main() -> None:
    """Run a bare policy as a process: its settings are JSON; each line is a number of seconds, answered by the rate."""
    die_with_parent()
    out = own_stdout()
    bare = BarePolicy(**json.loads(sys.argv[1]))
    print(json.dumps(True), file=out, flush=True)
    for line in sys.stdin:
        print(json.dumps(bare.rate(float(line))), file=out, flush=True)


if __name__ == "__main__":
    main()
