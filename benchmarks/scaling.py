"""Measures the scaling of episodes per minute with the number of workers, and the capacity of one
driver.

Environment and policy sleep, so that many workers run on few cores and only the overhead is
measured. On clusters of one to three hosts (`benchmarks.hosts`), or on a running cluster,
evaluations with increasing numbers of workers alternate with an evaluation with a single worker.
The rate counts only while all workers are running, so that their start does not count. Every node
has a replica for each of its workers, so that no worker waits for another worker's batch. Links
between the hosts have the given rate and delay, and the bytes that hosts send are counted from the
beginning of an evaluation to its end. On the first cluster, all workers also share one replica per
node, with single actions and with chunks.

The driver is measured by short evaluations with steps, episodes and workers in different
proportions. Its CPU time is fitted with the costs of an episode, a step, and a second of a busy
worker.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.console import Out, parse_counts, save
from benchmarks.far_carrier import Conditions
from benchmarks.far_link import FarLink
from benchmarks.hosts import Host, hosts, ray_cluster
from benchmarks.line_process import LineProcess, our_environment
from benchmarks.scaling_driver import Fleet, PlayedEpisodes, ScalingRound
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.errors import ConfigError

# Applications: one replica per worker; one replica per node, with single actions and with chunks.
OWN, SHARED, CHUNKS = "own", "shared", "chunks"
CHUNK = 8  # number of rows of a chunk
IMAGE_BYTES = 224 * 224 * 3  # image bytes of each call's observation
_START_S = 300.0
_PLAY_S = 600.0
_LATE_S = 1.0  # maximum delay between the starts of two workers, s
# Number of steps, duration of a step in ms, and share of the workers, in different proportions, so
# that costs can be fitted.
_COSTS = ((10, 10.0, 0.25), (100, 1.0, 0.25), (10, 200.0, 0.25), (10, 50.0, 1.0), (10, 400.0, 1.0))
_COST_S = 5.0


@dataclass(frozen=True, slots=True)
class ScalingPlan:
    """The evaluations of `measure_scaling`. The times are near those of a simulator and a VLA on
    a GPU.
    """

    workers: tuple[int, ...] = (1, 2, 4, 8, 16)
    nodes: tuple[int, ...] = (1, 2, 3)  # numbers of hosts; ignored on a running cluster
    rounds: int = 3
    step_ms: float = 20.0
    policy_ms: float = 50.0
    steps: int = 50  # number of steps in an episode
    seconds: float = 8.0  # approximate time in which all workers run at the same time, s
    mbit: float = 1000.0  # rate of a link between two hosts in each direction, Mbit/s
    delay_ms: float = 5.0  # delay of such a link in each direction, ms

    def __post_init__(self) -> None:
        if self.workers[0] != 1 or list(self.workers) != sorted(set(self.workers)):
            raise ConfigError(
                f"workers: expected ascending numbers from 1 on, got {list(self.workers)}"
            )

    @property
    def most(self) -> int:
        """The largest number of workers."""
        return self.workers[-1]

    def round(self, workers: int, app: str) -> ScalingRound:
        """Plan an evaluation in which all workers run at the same time for `seconds`."""
        acts = self.steps / (CHUNK if app == CHUNKS else 1)
        episode_s = (self.steps * self.step_ms + acts * self.policy_ms) / 1e3
        episodes = math.ceil((self.seconds + workers * _LATE_S) / episode_s) + 1
        return ScalingRound(workers, episodes, self.steps, self.step_ms, app)

    def ideal(self, workers: int, app: str) -> float:
        """Return the episodes per minute of workers that only sleep and never wait."""
        acts = math.ceil(self.steps / (CHUNK if app == CHUNKS else 1))
        return 60e3 * workers / (self.steps * self.step_ms + acts * self.policy_ms)


def measure_scaling(
    plan: ScalingPlan, address: str | None = None, progress: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Measure all clusters, or the running cluster at `address`, and return plain JSON values."""
    found: dict[str, Any] = {"plan": asdict(plan), "cores": os.cpu_count(), "clusters": []}
    clusters = (0,) if address else plan.nodes  # 0 stands for all nodes
    for nodes in clusters:
        shared = nodes == clusters[0]
        with driving(plan, nodes, address, shared=shared) as (driver, size, made):
            found["clusters"].append(
                measure_cluster(plan, size, driver, progress, made, shared=shared)
            )
            if nodes == clusters[-1]:
                progress("the driver's costs")
                found["driver"] = _driver_costs(plan, driver)
    return found


@contextlib.contextmanager
def driving(
    plan: ScalingPlan, nodes: int, address: str | None = None, *, shared: bool = False
) -> Iterator[tuple[LineProcess, int, Sequence[Host]]]:
    """Start a driver and its policies on `nodes` hosts or at `address`; yield the driver, the
    number of nodes, and the hosts.

    `shared` adds the policies of workers that share a replica.
    """
    size = max(1, nodes)
    slots = math.ceil(plan.most / size)
    pinned = address is None
    fleets = {OWN: Fleet(slots * size, pinned=pinned)}
    if shared:
        fleets |= {SHARED: Fleet(size, pinned=pinned), CHUNKS: Fleet(size, CHUNK, pinned)}
    with contextlib.ExitStack() as stack:
        start: Callable[[list[str]], list[str]] = list
        made: Sequence[Host] = ()
        if address is None:
            # Resources for replicas on each node.
            resources = json.dumps({OWN: slots, SHARED: 1, CHUNKS: 1})
            made = stack.enter_context(hosts(nodes))
            for one, other in itertools.combinations(made, 2):
                device = f"far{one.number}{other.number}"
                link = stack.enter_context(FarLink(one, other, device=device, own=True))
                link.set(Conditions(plan.delay_ms, mbit=plan.mbit))
            # Without this, Ray's workers would wait for other processes here; our own server sets
            # the same value.
            environment = our_environment() | {"RAY_worker_niceness": "0"}
            cluster = stack.enter_context(
                ray_cluster(made, slots, environment, resources=resources)
            )
            address, start = cluster.address, cluster.head.command
        settings = {
            "address": address,
            "policy_ms": plan.policy_ms,
            "fleets": {app: asdict(one) for app, one in fleets.items()},
        }
        command = start([sys.executable, "-m", "benchmarks.scaling_driver", json.dumps(settings)])
        child = stack.enter_context(LineProcess("driver", command, our_environment(), end_s=60.0))
        yield child, child.read(_START_S)["nodes"], made


def measure_cluster(
    plan: ScalingPlan,
    nodes: int,
    driver: LineProcess,
    progress: Callable[[str], None] = lambda _: None,
    made: Sequence[Host] = (),
    *,
    shared: bool = False,
) -> dict[str, Any]:
    """Measure rates by number of workers, in rounds that run each number once; `shared` adds
    workers that share a replica.

    `made` contains the hosts whose traffic is counted.
    """
    counts = [workers for workers in plan.workers if workers == 1 or workers >= nodes]
    kinds = [(OWN, workers) for workers in counts]
    if shared:
        kinds += [(SHARED, plan.most), (CHUNKS, plan.most)]
    played: dict[tuple[str, int], list[PlayedEpisodes]] = {kind: [] for kind in kinds}
    for number in range(plan.rounds):
        for app, workers in kinds:
            before = sum(host.sent_bytes() for host in made)
            one = _play(driver, plan.round(workers, app))
            if made:
                one = one._replace(sent_bytes=sum(host.sent_bytes() for host in made) - before)
            played[app, workers].append(one)
            progress(
                f"{nodes} nodes, round {number + 1}/{plan.rounds}: {workers} workers ({app}), "
                f"{one.rate:.1f} episodes/min, {one.wall_s:.1f} s"
            )
    single = [one.rate for one in played[OWN, 1]]
    return {
        "nodes": nodes,
        "rows": [row(plan, app, workers, played[app, workers], single) for app, workers in kinds],
    }


def row(
    plan: ScalingPlan,
    app: str,
    workers: int,
    played: Sequence[PlayedEpisodes],
    single: Sequence[float],
) -> dict[str, Any]:
    """Compute medians over rounds; `single` has the episodes of one worker in the same rounds.

    Linear scaling is the rate of the round's single worker times the number of workers. For chunks,
    which no single worker runs, it is the rate that the sleeps alone allow.
    """
    rates = [one.rate for one in played]
    sent = [one.sent_bytes / one.acts for one in played if one.sent_bytes is not None]
    linear = (
        [workers * each for each in single]
        if app != CHUNKS
        else [plan.ideal(workers, app)] * len(rates)
    )
    return {
        "app": app,
        "workers": workers,
        "episodes_per_minute": statistics.median(rates),
        "of_linear": statistics.median(
            rate / each for rate, each in zip(rates, linear, strict=True)
        ),
        "of_ideal": statistics.median(rates) / plan.ideal(workers, app),
        "wall_s": statistics.median(one.wall_s for one in played),
        "failures": sum(one.failures for one in played),
        "transports": sorted({way for one in played for way in one.transports}),
        "near": min(one.near for one in played),
        "sent_bytes_per_act": statistics.median(sent) if sent else None,
        "driver_share": statistics.median(one.driver_s / one.span_s for one in played),
        "daemon_shares": {
            name: statistics.median(one.daemons_s[name] / one.span_s for one in played)
            for name in played[0].daemons_s
        },
        "rounds": rates,
    }


def _play(driver: LineProcess, one: ScalingRound) -> PlayedEpisodes:
    return PlayedEpisodes(**driver.request(json.dumps(asdict(one)), _PLAY_S))


def _driver_costs(plan: ScalingPlan, driver: LineProcess) -> dict[str, Any]:
    """Measure the costs, and the driver's load with more very short episodes than it can serve."""
    rounds = []
    for steps, step_ms, share in _COSTS:
        workers = max(1, round(share * plan.most))
        episodes = math.ceil((_COST_S + workers * _LATE_S) / (steps * step_ms / 1e3))
        rounds.append(ScalingRound(workers, episodes, steps, step_ms, size=32))
    played = [_play(driver, one) for one in rounds]
    costs = fit(rounds, played)
    busy = _play(driver, full := ScalingRound(plan.most, 300, 1, 1.0, size=32))
    return {
        "costs_ms": costs,
        "rounds": [asdict(one) | each._asdict() for one, each in zip(rounds, played, strict=True)],
        "flooded": asdict(full)
        | {
            "episodes_per_s": busy.episodes / busy.span_s,
            "driver_share": busy.driver_s / busy.span_s,
            "driver_ms_per_episode": 1e3 * busy.driver_s / busy.episodes,
        },
        "saturated_workers": {
            f"{seconds:g}": saturation(costs, seconds, 250) for seconds in (3.0, 30.0, 300.0)
        },
    }


def fit(rounds: Sequence[ScalingRound], played: Sequence[PlayedEpisodes]) -> dict[str, float]:
    """Fit the CPU time of a driver, ms, for an episode, a step, a second of each worker, and a
    second.

    The fit minimises the squares of relative errors, so that short rounds count as much as long
    rounds. A cost below 0 is set to 0, and the other costs are fitted without it.
    """
    names = ["episode", "step", "worker_second", "second"]
    causes = np.array(
        [
            [each.episodes, each.episodes * one.steps, each.busy_s, each.span_s]
            for one, each in zip(rounds, played, strict=True)
        ]
    )
    used = np.array([one.driver_s * 1e3 for one in played])
    kept = list(range(len(names)))
    while kept:
        costs = np.linalg.lstsq(causes[:, kept] / used[:, None], np.ones(len(used)), rcond=None)[0]
        if costs.min() >= 0:
            break
        kept.pop(int(costs.argmin()))
    found = dict.fromkeys(names, 0.0)
    return found | {names[i]: float(cost) for i, cost in zip(kept, costs, strict=True)}


def saturation(costs_ms: Mapping[str, float], episode_s: float, steps: int) -> float:
    """Return the number of workers that saturate one driver, if an episode takes `episode_s`."""
    each = (costs_ms["episode"] + costs_ms["step"] * steps) / episode_s + costs_ms["worker_second"]
    return (1e3 - costs_ms["second"]) / each


def show_scaling(found: Mapping[str, Any]) -> None:
    """Print a row for each number of workers on each cluster."""
    plan = found["plan"]
    rows = table(
        "nodes",
        "workers",
        "replicas",
        "episodes/min",
        "of linear",
        "of ideal",
        "whole run s",
        "by",
        "near",
        "bytes sent an act",
    )
    rows.title = (
        f"{plan['steps']} steps of {plan['step_ms']:g} ms, policy {plan['policy_ms']:g} ms, "
        f"medians of {plan['rounds']} rounds on {found['cores']} cores, links of {plan['mbit']:g} "
        f"Mbit/s and {plan['delay_ms']:g} ms; near: workers on a replica's node; an act's image "
        f"has {IMAGE_BYTES} bytes"
    )
    for cluster in found["clusters"]:
        for row in cluster["rows"]:
            counts = (
                str(cluster["nodes"]),
                str(row["workers"]),
                row["app"],
                f"{row['episodes_per_minute']:.1f}",
            )
            ratios = (f"{row['of_linear']:.3f}", f"{row['of_ideal']:.3f}", f"{row['wall_s']:.1f}")
            sent = "" if row["sent_bytes_per_act"] is None else f"{row['sent_bytes_per_act']:.0f}"
            rows.add_row(*counts, *ratios, ", ".join(row["transports"]), f"{row['near']:.0%}", sent)
        rows.add_section()
    out.print(rows)


def show_driver(found: Mapping[str, Any]) -> None:
    """Print the driver's costs, and its capacity in workers."""
    costs, flooded = found["costs_ms"], found["flooded"]
    out.print(
        f"the driver's CPU time: {costs['episode']:.2f} ms an episode, {costs['step'] * 1e3:.1f} "
        f"µs a step, {costs['worker_second']:.2f} ms a second for each worker, "
        f"{costs['second']:.1f} ms a second at all\n"
        f"flooded by {flooded['workers']} workers: {flooded['episodes_per_s']:.0f} episodes/s, "
        f"{flooded['driver_ms_per_episode']:.2f} ms each, {100 * flooded['driver_share']:.0f} % of "
        "a core",
    )
    for seconds, workers in found["saturated_workers"].items():
        out.print(f"episodes of {seconds} s: one driver is saturated by {workers:.0f} workers")


def main(
    workers: Annotated[
        str, typer.Option(help="Numbers of workers, ascending from 1.")
    ] = "1,2,4,8,16",
    nodes: Annotated[
        str, typer.Option(help="Numbers of hosts of the clusters that are made on this machine.")
    ] = ("1,2,3"),
    rounds: Annotated[int, typer.Option(min=1)] = 3,
    step_ms: Annotated[
        float, typer.Option(min=0, help="Duration of a step of the environment, in ms.")
    ] = 20.0,
    policy_ms: Annotated[
        float, typer.Option(min=0, help="Duration of a batch of the policy, in ms.")
    ] = 50.0,
    seconds: Annotated[
        float,
        typer.Option(
            min=0.1, help="Approximate time in which all workers run at the same time, in seconds."
        ),
    ] = 8.0,
    mbit: Annotated[
        float, typer.Option(min=1, help="Rate of a link between two of these hosts, in Mbit/s.")
    ] = 1000.0,
    delay_ms: Annotated[
        float, typer.Option(min=0, help="Delay of such a link in each direction, in ms.")
    ] = 5.0,
    address: Annotated[
        str | None,
        typer.Option(
            help="Address of a running Ray cluster, which replaces these hosts; making "
            "hosts needs root."
        ),
    ] = None,
    out_file: Out = None,
) -> None:
    """Measure episodes per minute by the number of workers and nodes, and the cost of the
    evaluation's driver.
    """
    with errors():
        plan = ScalingPlan(
            workers=tuple(parse_counts(workers, "--workers")),
            nodes=tuple(parse_counts(nodes, "--nodes")),
            rounds=rounds,
            step_ms=step_ms,
            policy_ms=policy_ms,
            seconds=seconds,
            mbit=mbit,
            delay_ms=delay_ms,
        )
        found = measure_scaling(plan, address, progress)
    show_scaling(found)
    show_driver(found["driver"])
    save(found, out_file)


if __name__ == "__main__":
    typer.run(main)
