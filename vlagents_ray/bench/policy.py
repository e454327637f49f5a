"""The speed of a policy on this machine by batch size, without Ray: bare, and behind a replica's batch queue.

Bare is `act_batch` on full batches, one after another. Behind the queue as many sessions as the batch has rows ask
again as soon as they are answered. The policy is loaded once for both. `python -m vlagents_ray.bench.policy JSON` is
the bare policy of `bench throughput`, as a process.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlagents_ray.bench.clients import observation
from vlagents_ray.bench.line_client import die_with_parent, own_stdout
from vlagents_ray.bench.measured_policy import MeasuredPolicy, QueuedTurn, device_name, forget_peak, peak_mib
from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Agent, Obs
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.registry import policy_class
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.testing.agents import random_observation


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

    def view(contract: Contract | None, seed: int) -> Obs:
        return random_observation(contract, seed, side=plan.side, dims=plan.dims)

    measured = MeasuredPolicy(
        agent, view, max_size=max(plan.batches), patience=batch.patience, batch_sizes=batch.sizes or ()
    )  # fmt: skip
    with measured:
        progress(f"{plan.args.policy}: loaded in {measured.load_s:.1f} s")
        rows = {size: _SizedRow(size) for size in plan.batches}
        for number in range(plan.rounds):
            for row in rows.values():
                forget_peak()
                row.bare.append(measured.bare(row.size, plan.seconds))
                row.queued.append(measured.queued(row.size, plan.seconds, "simulation"))
                row.memory.append(peak_mib())
            rates = ", ".join(f"{row.size}: {row.bare[-1]['actions_per_s']:.1f}/s" for row in rows.values())
            progress(f"round {number + 1} of {plan.rounds}: {rates}")
        contract = measured.engine.contract
    return {
        "policy": plan.args.policy,
        "device": device_name(),
        "load_s": measured.load_s,
        "chunk": None if contract is None else contract.chunk,
        "batches": [row.to_json() for row in rows.values()],
    }


@dataclass(slots=True)
class _SizedRow:
    """A batch size, measured in each round."""

    size: int
    bare: list[dict[str, float]] = field(default_factory=list)
    queued: list[QueuedTurn] = field(default_factory=list)
    memory: list[float] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """Return the medians of the rounds, the 99th percentile of all their round trips, and the rounds.

        `queued_share` is the median of the rounds' actions a second behind the queue, divided by those without it.
        """
        queued = [turn.to_json() for turn in self.queued]
        shares = [ours["actions_per_s"] / bare["actions_per_s"] for ours, bare in zip(queued, self.bare, strict=True)]
        p99 = float(np.quantile([trip for turn in self.queued for trip in turn.trips_ms], 0.99))
        return {
            "batch": self.size,
            "bare": _medians(self.bare),
            "queued": _medians(queued) | {"p99_ms": p99},
            "queued_share": statistics.median(shares),
            "peak_mib": max(self.memory),
            "rounds": {"bare": self.bare, "queued": queued},
        }


def _medians(rounds: list[dict[str, float]]) -> dict[str, float]:
    return {name: statistics.median(one[name] for one in rounds) for name in rounds[0]}


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
