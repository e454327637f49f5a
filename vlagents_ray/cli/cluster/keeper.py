"""The process that keeps a warm cluster: `python -m vlagents_ray.cli.cluster.keeper PORT WORKERS`, until SIGTERM."""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping
from pathlib import Path

import typer

from vlagents_ray.cli.console import errors
from vlagents_ray.cli.ray_session import quiet_ray
from vlagents_ray.client.credentials import withheld
from vlagents_ray.evaluate.plan.config import WorkerConfig
from vlagents_ray.evaluate.workers.cluster import worker_variables
from vlagents_ray.ray_tools.head_monitor import HeadMonitor
from vlagents_ray.ray_tools.private import start_workers_ahead
from vlagents_ray.ray_tools.reaper import MARK, marked
from vlagents_ray.ray_tools.signals import stop_signals
from vlagents_ray.ray_tools.warm_cluster import only_keeper
from vlagents_ray.serve.launch.warm import remove_abandoned, warm_ray

_REPLICAS = 1  # processes that are kept ready for policies
_LOOK_S = 1.0
_LOOKS = 60  # within which processes that were started ahead appear, also on a busy machine
# What the processes of servers and of evaluations import; simulators are not among it, as users choose them.
_IMPORTS = (
    "vlagents_ray.serve.replica.app",
    "vlagents_ray.evaluate.workers.rollout",
    "vlagents_ray.evaluate.workers.agents",
    "vlagents_ray.envs.tabletop",
)


class IdleWorkers:
    """Keeps idle worker processes of Ray ready, so that an actor need not wait for Python's imports."""

    def __init__(self, wanted: Mapping[str, int], env_vars: Mapping[str, Mapping[str, str]]) -> None:
        """Keep `wanted` processes of each kind, whose runtime environments have `env_vars`."""
        self._wanted = dict(wanted)
        self._env_vars = env_vars
        self._seen: dict[str, int] = {}
        self._expected = self._looks = 0  # how many there will be, and in how many looks at most

    def refill(self, found: Mapping[str, int]) -> None:
        """Start what is missing, if nobody has taken a process since the last call: who did has the cores now."""
        there = sum(found.values())
        self._expected -= max(sum(self._seen.values()) - there, 0)  # what was taken
        settled, self._seen = self._seen == found, dict(found)
        self._looks = 0 if there >= self._expected else max(self._looks - 1, 0)
        if not settled or self._looks or there >= sum(self._wanted.values()):
            return
        self._expected, self._looks = there, _LOOKS
        for kind, number in self._wanted.items():
            if found[kind] < number:
                start_workers_ahead(number - found[kind], self._env_vars[kind])
                self._expected += number - found[kind]


def idle_workers(folder: str, variables: Mapping[str, str]) -> dict[str, int]:
    """Count the idle processes of a cluster, those that are starting included, by kind.

    Args:
        folder: The folder of the cluster.
        variables: The environment variables of the kind "evaluation"; all others are of the kind "replica".
    """
    pairs = {f"{name}={value}".encode() for name, value in variables.items()}
    found = {"replica": 0, "evaluation": 0}
    for process in marked(folder):
        try:
            words = Path(f"/proc/{process}/cmdline").read_bytes().split(b"\0")
            environment = set(Path(f"/proc/{process}/environ").read_bytes().split(b"\0"))
        except OSError:  # it has ended
            continue
        if words[0].startswith(b"ray::IDLE") or any(word.endswith(b"/default_worker.py") for word in words):
            found["evaluation" if pairs <= environment else "replica"] += 1
    return found


def main(port: int, workers: int) -> None:
    """Keep a warm cluster until SIGTERM, or until its Ray is lost."""
    variables = worker_variables(WorkerConfig().threads, gpus=False)
    idle = IdleWorkers({"replica": _REPLICAS, "evaluation": workers}, {"replica": {}, "evaluation": variables})
    with (
        errors(),
        only_keeper(),
        stop_signals() as stop,
        quiet_ray(None),
        withheld(),  # workers get the key of their run when they are ready
        warm_ray(port, _IMPORTS, _REPLICAS + workers) as client,
    ):
        _keep(HeadMonitor("`vlagents-ray up` starts another warm cluster"), idle, variables, client, stop)


def _keep(
    head: HeadMonitor, idle: IdleWorkers, variables: Mapping[str, str], client: object, stop: threading.Event
) -> None:
    """Do what is due once a second, until `stop`."""
    while not stop.wait(_LOOK_S):
        head.answers()
        remove_abandoned(client)
        idle.refill(idle_workers(os.environ[MARK], variables))


if __name__ == "__main__":
    typer.run(main)
