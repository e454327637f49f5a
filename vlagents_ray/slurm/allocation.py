"""The resources that Slurm allocated to a job, from its environment variables (see sbatch(1)).

`python -m vlagents_ray.slurm.allocation` prints the address of this node, at which other nodes find Ray's head.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass

from vlagents_ray.ray_tools.session import FILES

HEAD = "VLAGENTS_RAY_HEAD"  # variable with the address of the first node, exported by the job's script
_FIRST_PORT, _PORTS, _JOBS = 10_000, 4, 2_500  # below the ports that the package and the system assign
_REST = ("--block", "--disable-usage-stats", "--log-color=false")
_OBJECTS = 0.25  # share of the memory for Ray's object store, in /dev/shm; Ray's default is 0.3 of the machine's


@dataclass(frozen=True, slots=True)
class Ports:
    """The ports of a job, derived from its number so that jobs on the same node have different ones."""

    gcs: int  # Ray's head
    client: int  # Ray Client, which cannot be disabled
    metrics: int  # Ray's monitor, which cannot be disabled
    serve: int  # the policy server


@dataclass(frozen=True, slots=True)
class Allocation:
    """The resources of a job, as a process on one of its nodes sees them."""

    job: int
    nodes: int
    node: int  # number of this node, from 0; the head is 0
    cpus: int  # on this node
    gpus: int  # on this node
    memory: int | None  # on this node, bytes; None if Slurm does not manage memory

    @classmethod
    def here(cls, environ: Mapping[str, str] = os.environ) -> Allocation:
        """Read the allocation of this process."""
        cpus = int(environ["SLURM_CPUS_ON_NODE"])
        return cls(
            job=int(environ["SLURM_JOB_ID"]),
            nodes=int(environ["SLURM_JOB_NUM_NODES"]),
            node=int(environ.get("SLURM_NODEID", "0")),
            cpus=min(cpus, len(os.sched_getaffinity(0))),  # a task may be bound to fewer
            gpus=_gpus(environ),
            memory=_memory(environ, cpus),
        )

    @property
    def ports(self) -> Ports:
        """The ports of the job, the same on all nodes."""
        first = _FIRST_PORT + self.job % _JOBS * _PORTS
        return Ports(*range(first, first + _PORTS))

    def ray_start(self, head: str, folder: str) -> list[str]:
        """Return the command that starts Ray on this node with the allocated resources.

        Args:
            head: The address of the first node.
            folder: A folder on this node for Ray's sockets, logs and spilled objects, in a subfolder that Ray opens to
                every user.
        """
        ports = self.ports
        if self.node == 0:
            where = ["--head", f"--node-ip-address={head}", f"--port={ports.gcs}", "--include-dashboard=false"]
            where += [f"--ray-client-server-port={ports.client}"]
        else:
            where = [f"--address={head}:{ports.gcs}"]
        given = [f"--num-cpus={self.cpus}", f"--num-gpus={self.gpus}"]
        if self.memory is not None:
            objects = int(self.memory * _OBJECTS)
            given += [f"--object-store-memory={objects}", f"--memory={self.memory - objects}"]
        # The other listeners use free ports, as Ray's defaults are the same numbers for every cluster.
        free = ["--min-worker-port=0", "--max-worker-port=0", "--dashboard-agent-listen-port=0"]
        return ["ray", "start", *where, *given, *free, f"--temp-dir={folder}/{FILES}", *_REST]


def _gpus(environ: Mapping[str, str]) -> int:
    if (count := environ.get("SLURM_GPUS_ON_NODE")) is not None:
        return int(count)
    return len([one for one in environ.get("SLURM_STEP_GPUS", "").split(",") if one])


def _memory(environ: Mapping[str, str], cpus: int) -> int | None:
    """Return the memory in bytes; Slurm counts MiB, and 0 is all of the node's."""
    mebibytes = int(environ.get("SLURM_MEM_PER_NODE", "0")) or int(environ.get("SLURM_MEM_PER_CPU", "0")) * cpus
    return mebibytes * 2**20 or None


def main() -> None:
    """Print the address of this node as Ray determines it."""
    from ray.util import get_node_ip_address

    sys.stdout.write(f"{get_node_ip_address()}\n")


if __name__ == "__main__":
    main()
