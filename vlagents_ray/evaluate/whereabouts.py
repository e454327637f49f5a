"""Where a worker runs, how it reaches its policy, and what draws its env's images."""

from __future__ import annotations

import os
import socket
from dataclasses import dataclass

import ray

from vlagents_ray.client.plasma import this_node
from vlagents_ray.envs import EvalEnv
from vlagents_ray.envs.batch import BatchEnv
from vlagents_ray.envs.graphics import SHARE, require_own
from vlagents_ray.evaluate.cells import Cell
from vlagents_ray.evaluate.episode import transport_of
from vlagents_ray.interface import Agent


@dataclass(frozen=True, slots=True)
class Whereabouts:
    """Of one worker, with one policy and one env."""

    host: str
    node: str | None  # Ray's id; None of a process that is on no node
    pid: int
    policy: str  # its name in the evaluation
    transport: str
    renderer: str | None  # as its driver names it; None if no device draws


def here(policy: str, agent: Agent, env: EvalEnv | BatchEnv) -> Whereabouts:
    """This process, with both at hand. `ConfigError` if the env draws on a GPU that is not this worker's."""
    renderer = env.renderer()
    if renderer is not None:
        require_own(renderer)
    name = None if renderer is None else renderer.name
    return Whereabouts(socket.gethostname(), this_node(), os.getpid(), policy, transport_of(agent), name)


def unused_gpus(cell: Cell, where: Whereabouts) -> str | None:
    """A hint that the workers of `cell` draw in software in a cluster with GPUs, which may be meant; None if not so."""
    gpus = 0 if cell.worker.gpus else ray.cluster_resources().get("GPU", 0)
    if not gpus:
        return None
    return (
        f"{cell.env} draws on {where.renderer}, as its workers have no GPU; the cluster has {gpus:g}: {SHARE}, "
        f"see docs/cluster/placement.md"
    )
