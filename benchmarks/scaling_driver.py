"""The driver of `bench scaling`, a process at the cluster's head: `python -m
benchmarks.scaling_driver JSON`.

It serves policies that sleep, writes a line of JSON when they are ready, and answers each
`ScalingRound`, a line of JSON, with a `PlayedEpisodes`. Like `vlagents-ray eval`, it is both
Serve's client and the evaluation's driver, so that its CPU time over all threads is that of a
driver.
"""

from __future__ import annotations

import contextlib
import functools
import json
import sys
import tempfile
import time
from array import array
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.environments import ACTION_DIM, SLEEPING_ENV
from benchmarks.overhead import recorded, steady
from benchmarks.processes import cpu_seconds, program
from vlagents_ray.evaluate import (
    EvalConfig,
    PolicyConfig,
    Progress,
    Results,
    SuiteConfig,
    WorkerConfig,
    evaluate,
)
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.policies.noop import Noop, NoopConfig
from vlagents_ray.serve.launch.deployment_file import deployment, together
from vlagents_ray.serve.launch.server import running_server
from vlagents_ray.serve.python_env.child_start import die_with_parent, own_stdout

NEAR = ("shm", "plasma", "local")  # transports within a node
DAEMONS = ("gcs_server", "raylet", "ServeController")  # names of Ray's daemons on this node


@dataclass(frozen=True, slots=True)
class Fleet:
    """One application: replicas of a policy that sleeps."""

    replicas: int
    chunk: int = 1
    # Number of replicas; each reserves one unit of a resource with the application's name.
    pinned: bool = False

    def args(self, app: str, policy_ms: float) -> dict[str, Any]:
        """Return the arguments of the application's deployment."""
        return {
            "config": {"action_dim": ACTION_DIM, "chunk": self.chunk, "base_ms": policy_ms},
            "replicas": self.replicas,
            "resources": {"custom": {app: 1.0}} if self.pinned else {},
        }


@dataclass(frozen=True, slots=True)
class ScalingRound:
    """An evaluation to run."""

    workers: int
    episodes: int  # number of episodes of each worker
    steps: int
    step_ms: float
    # Name of the application; None for a policy in each worker's own process, which takes no time.
    app: str | None = None
    size: int = 224


class PlayedEpisodes(NamedTuple):
    """The figures of a `ScalingRound`."""

    # Rate while all workers were running; None with a policy in the workers' own processes.
    episodes_per_minute: float | None
    wall_s: float  # wall time of the whole evaluation, including the start of the workers, s
    transports: list[str]
    failures: int  # number of failed attempts
    # From the first recorded episode to the last:
    episodes: int
    span_s: float
    busy_s: float  # running time of all workers together, s
    driver_s: float  # CPU time of this process, s
    daemons_s: dict[str, float]  # CPU time of Ray's daemons on this node, s
    near: float = 1.0  # share of the workers whose observations do not leave their node
    acts: int = 1  # number of calls in all recorded episodes
    # Bytes that all hosts sent to others, including the start of the workers; None if not counted.
    sent_bytes: int | None = None

    @property
    def rate(self) -> float:
        """The episodes per minute of a round with an application."""
        assert self.episodes_per_minute is not None, "a round without one has no rate"  # noqa: S101
        return self.episodes_per_minute


class ScalingLedger(Progress):
    """Records the time of each recorded episode, and the CPU time of the driver and the daemons
    until then.
    """

    def __init__(self) -> None:
        self.at_s, self.cpu_s = array("d"), array("d")
        self.failures = 0
        self.first: dict[str, float] = {}

    def episode(self, case: EvalCase, result: EpisodeResult) -> None:
        """Record the time."""
        self.first = self.first or daemons_s()
        self.at_s.append(time.monotonic())
        self.cpu_s.append(time.process_time())

    def retry(self, *_: object) -> None:
        """Count a retry."""
        self.failures += 1


def play(one: ScalingRound, out: Path) -> PlayedEpisodes:
    """Run a round; `out` is a new folder. Raises `EnvFailed` if the workers were never
    all running.
    """
    policy = PolicyConfig(name="noop", url=None if one.app is None else f"serve://{one.app}")
    options: dict[str, Any] = {"step_ms": one.step_ms, "max_steps": one.steps, "size": one.size}
    config = EvalConfig(
        policies=[policy],
        suites=[
            SuiteConfig(
                envs=[SLEEPING_ENV], env_options=options, episodes=one.workers * one.episodes
            )
        ],
        workers=one.workers,
        worker=WorkerConfig(cpus=1.0),  # one worker for each CPU of a node
        video="none",
        out=out,
    )
    local = functools.partial(Noop, NoopConfig(action_dim=ACTION_DIM)) if one.app is None else None
    ledger, begun = ScalingLedger(), time.monotonic()
    summary = evaluate(config, agent_factory=local, progress=ledger)
    wall_s, last = time.monotonic() - begun, daemons_s()
    played = recorded(out)
    first = min(each.ended for each in played)
    results = Results.load(out)
    near = [worker.transport in NEAR for worker in results.workers]
    acts = sum(episode.result.acts for case in results.cases for episode in case.episodes)
    return PlayedEpisodes(
        None if one.app is None else 60 * steady(played, one.workers).rate / one.steps,
        wall_s,
        summary.transports,
        ledger.failures,
        len(ledger.at_s) - 1,
        ledger.at_s[-1] - ledger.at_s[0],
        sum(each.ended - max(first, each.begun) for each in played),
        ledger.cpu_s[-1] - ledger.cpu_s[0],
        {name: used - ledger.first.get(name, 0.0) for name, used in last.items()},
        sum(near) / len(near),
        acts,
    )


def daemons_s() -> dict[str, float]:
    """Return the CPU time that Ray's own processes of this node have used so far, s."""
    found = dict.fromkeys(DAEMONS, 0.0)
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # the process has ended
            if (name := program(pid := int(entry.name))) in found:
                found[name] += cpu_seconds(pid)
    return found


def main() -> None:
    """Run the process."""
    import ray

    die_with_parent()
    out = own_stdout()
    settings = json.loads(sys.argv[1])
    fleets = {app: Fleet(**fleet) for app, fleet in settings["fleets"].items()}
    parts = {
        app: deployment("noop", **fleet.args(app, settings["policy_ms"]))
        for app, fleet in fleets.items()
    }
    with (
        running_server(together(parts), address=settings["address"]),
        tempfile.TemporaryDirectory() as top,
    ):
        print(
            json.dumps({"nodes": sum(node["Alive"] for node in ray.nodes())}), file=out, flush=True
        )
        for number, line in enumerate(sys.stdin):
            played = play(ScalingRound(**json.loads(line)), Path(top) / str(number))
            print(json.dumps(played._asdict()), file=out, flush=True)


if __name__ == "__main__":
    main()
