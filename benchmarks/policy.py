"""Measures the speed of a policy on this machine by batch size, without Ray: bare, and behind a
replica's batch queue.

"Bare" calls `act_batch` with full batches, one after another. Behind the queue there are as many
sessions as the batch has rows, and each sends its next request at each answer. "Network alone" is
the part of the bare time in the model's cores, and "GPU busy" is the part in which the GPU runs any
kernel. The policy is loaded only once.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.console import Out, Rounds, Seconds, parse_counts, save
from benchmarks.figures import measured_on
from benchmarks.measured_policy import (
    MeasuredPolicy,
    QueuedTurn,
    cuda,
    device_name,
    forget_peak,
    peak_mib,
)
from benchmarks.network import profile
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.cli.options import (
    ConfigDir,
    ServeSet,
    Set,
    find_policy,
    policy_overrides,
)
from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Agent, Obs
from vlagents_ray.overrides import parse_settings
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.testing import random_observation

_MOST_DIMS = 1_000_000  # maximum number of values in a part of the state


@dataclass(frozen=True, slots=True)
class PolicyPlan:
    """The settings of `measure_policy`."""

    args: ServerArgs  # arguments of a deployment file
    batches: Sequence[int] = (1, 8)
    seconds: float = 2.0  # duration of each measurement, s
    rounds: int = 3  # number of rounds, in which all measurements alternate
    side: int = 224  # size of images if the policy accepts any size, px
    # Sizes of the parts of the state for which the policy has no size.
    dims: Mapping[str, int] = field(default_factory=dict)


def measure_policy(
    plan: PolicyPlan, progress: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Measure the plan, and return plain JSON values: actions per second, ms, MiB."""
    batch = plan.args.batch
    if batch.sizes is not None and max(plan.batches) > batch.sizes[-1]:
        raise ConfigError(
            f"--batch: got {max(plan.batches)}, the file's largest of batch.sizes is "
            f"{batch.sizes[-1]}"
        )
    agent: Agent = build_agent(plan.args.policy, plan.args.config, plan.args.wrappers)

    def view(contract: Contract | None, seed: int) -> Obs:
        return random_observation(contract, seed, image_size=plan.side, dims=plan.dims)

    measured = MeasuredPolicy(
        agent,
        view,
        max_size=max(plan.batches),
        patience=batch.patience,
        batch_sizes=batch.sizes or (),
    )
    with measured:
        progress(f"{plan.args.policy}: loaded in {measured.load_s:.1f} s")
        rows = {size: _SizedRow(size) for size in plan.batches}
        for number in range(plan.rounds):
            for row in rows.values():
                forget_peak()
                row.bare.append(measured.bare(row.size, plan.seconds))
                row.queued.append(measured.queued(row.size, plan.seconds, "simulation"))
                row.memory.append(peak_mib())
            rates = ", ".join(
                f"{row.size}: {row.bare[-1]['actions_per_s']:.1f}/s" for row in rows.values()
            )
            progress(f"round {number + 1} of {plan.rounds}: {rates}")
        for row in rows.values() if cuda() is not None else ():
            row.busy_ms = profile(measured.batch(range(row.size)))["busy_ms"]
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
    busy_ms: float | None = None  # time of a batch in which the GPU ran a kernel, ms

    def to_json(self) -> dict[str, Any]:
        """Return the medians of the rounds, the 99th percentile of all their round trips, and the
        rounds.

        `queued_share` is the median over rounds of the actions per second behind the queue divided
        by those without the queue; `network_share` is the same ratio relative to the network alone.
        `gpu_busy` is the GPU's busy share of the bare time.
        """
        queued = [_figures(turn) for turn in self.queued]
        shares = [
            ours["actions_per_s"] / bare["actions_per_s"]
            for ours, bare in zip(queued, self.bare, strict=True)
        ]
        networks = [
            ours["actions_per_s"] * bare["network_ms"] / 1e3 / self.size
            for ours, bare in zip(queued, self.bare, strict=True)
        ]
        bare_ms = statistics.median(one["batch_ms"] for one in self.bare)
        p99 = float(np.quantile([trip for turn in self.queued for trip in turn.trips_ms], 0.99))
        return {
            "batch": self.size,
            "bare": _medians(self.bare),
            "queued": _medians(queued) | {"p99_ms": p99},
            "queued_share": statistics.median(shares),
            "network_share": statistics.median(networks) or None,
            "gpu_busy": None if self.busy_ms is None else self.busy_ms / bare_ms,
            "peak_mib": max(self.memory),
            "rounds": {"bare": self.bare, "queued": queued},
        }


def _figures(turn: QueuedTurn) -> dict[str, float]:
    return {
        "actions_per_s": turn.actions_per_s,
        "round_trip_ms": statistics.median(turn.trips_ms),
        "p99_ms": float(np.quantile(turn.trips_ms, 0.99)),
        "mean_batch": turn.mean_batch,
    }


def _medians(rounds: list[dict[str, float]]) -> dict[str, float]:
    return {name: statistics.median(one[name] for one in rounds) for name in rounds[0]}


def main(
    file: Annotated[str, typer.Argument(help="A deployment file, or a registered policy.")],
    batch: Annotated[str, typer.Option(help="Batch sizes, separated by commas.")] = "1,8",
    seconds: Seconds = 2.0,
    rounds: Rounds = 3,
    app: Annotated[
        str | None, typer.Option(help="Application of the file, if it contains several.")
    ] = None,
    image: Annotated[
        int,
        typer.Option(
            min=1, help="Width and height of images in pixels, if the policy accepts any size."
        ),
    ] = 224,
    state: Annotated[
        list[str],
        typer.Option(
            "--state-dim",
            metavar="PART=N",
            help="Number of values in a part of the state, if the policy does not declare it.",
        ),
    ] = [],  # noqa: B006
    settings: Set = [],  # noqa: B006
    serve_settings: ServeSet = [],  # noqa: B006
    config_dir: ConfigDir = None,
    out_file: Out = None,
) -> None:
    """Measure actions per second of one policy by batch size, bare and behind its batch queue,
    without Ray.
    """
    # This imports Ray, for the schema of the file.
    from vlagents_ray.serve.launch.deployment_file import policy_application

    with errors():
        origin = measured_on("python -m benchmarks.policy")
        overrides = policy_overrides(settings, serve_settings)
        application = policy_application(find_policy(file, config_dir), app, overrides)
        args = ServerArgs(**application.args)
        batches = parse_counts(batch, "--batch")
        plan = PolicyPlan(args, batches, seconds, rounds, image, _parse_dims(state))
        found = measure_policy(plan, progress)
    show_policy(found)
    save({**origin, **found}, out_file)


def _parse_dims(texts: Sequence[str]) -> dict[str, int]:
    """Parse the sizes of parts of the state.

    Args:
        texts: The texts, PART=N.

    Returns:
        The number of values in each part.

    Raises:
        ConfigError: A size is not a whole number above 0.
    """
    dims = parse_settings(texts, "--state-dim")
    for number in dims.values():
        if type(number) is not int or not 1 <= number <= _MOST_DIMS:
            raise ConfigError(
                f"--state-dim: expected a whole number from 1 to {_MOST_DIMS} for each part, got "
                f"{dims}"
            )
    return dims


def show_policy(found: Mapping[str, Any]) -> None:
    """Print a row for each batch size."""
    rows = table(
        "batch",
        "bare actions/s",
        "ms a batch",
        "network ms",
        "GPU busy",
        "queued actions/s",
        "of bare",
        "of network",
        "round trip ms",
        "p99 ms",
        "mean batch",
        "peak MiB",
    )
    chunk = f", {found['chunk']} rows an action" if (found["chunk"] or 1) > 1 else ""
    rows.title = f"{found['policy']} on {found['device']}{chunk}"
    for row in found["batches"]:
        bare, queued = row["bare"], row["queued"]
        rows.add_row(
            str(row["batch"]),
            f"{bare['actions_per_s']:.1f}",
            f"{bare['batch_ms']:.2f}",
            f"{bare['network_ms']:.2f}" if row["network_share"] else "",
            _percent(row["gpu_busy"]),
            f"{queued['actions_per_s']:.1f}",
            f"{row['queued_share']:.1%}",
            _percent(row["network_share"]),
            f"{queued['round_trip_ms']:.2f}",
            f"{queued['p99_ms']:.2f}",
            f"{queued['mean_batch']:.2f}",
            f"{row['peak_mib']:.0f}",
        )
    out.print(rows)


def _percent(share: float | None) -> str:
    return "" if share is None else f"{share:.1%}"


if __name__ == "__main__":
    typer.run(main)
