"""What Slurm gave to a job, from the variables of its environment (see sbatch(1)).

python -m vlagents_ray.slurm.allocation      the address of this node, at which other nodes find Ray's head
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass

HEAD = "VLAGENTS_RAY_HEAD"  # address of the first node, which the job's script exports
_FIRST_PORT, _PORTS, _JOBS = 10_000, 4, 2_500  # below those that the package and the system give to others
_REST = ("--block", "--disable-usage-stats", "--log-color=false")
_OBJECTS = (
    0.25  # of the memory: Ray's object store, of which /dev/shm is part; Ray's own default is 0.3 of the machine's
)


@dataclass(frozen=True, slots=True)
class Ports:
    """Of a job, derived from its number, so that jobs that share a node do not meet."""

    gcs: int  # Ray's head
    client: int  # of Ray Client, which cannot be left out
    metrics: int  # of Ray's monitor, likewise
    serve: int  # of a policy server


@dataclass(frozen=True, slots=True)
class Allocation:
    """A job's, as a process on one of its nodes sees it."""

    job: int
    nodes: int
    node: int  # the number of this one, from 0; the head is 0
    cpus: int  # that this node gives
    gpus: int  # likewise
    memory: int | None  # bytes, likewise; None: Slurm does not keep count of it

    @classmethod
    def here(cls, environ: Mapping[str, str] = os.environ) -> Allocation:
        """Of this process."""
        cpus = int(environ["SLURM_CPUS_ON_NODE"])
        return cls(
            job=int(environ["SLURM_JOB_ID"]),
            nodes=int(environ["SLURM_JOB_NUM_NODES"]),
            node=int(environ.get("SLURM_NODEID", "0")),
            cpus=min(cpus, len(os.sched_getaffinity(0))),  # the smaller, should a task be bound to fewer
            gpus=_gpus(environ),
            memory=_memory(environ, cpus),
        )

    @property
    def ports(self) -> Ports:
        """What is listened at, on whichever node."""
        first = _FIRST_PORT + self.job % _JOBS * _PORTS
        return Ports(*range(first, first + _PORTS))

    def ray_start(self, head: str, folder: str) -> list[str]:
        """What starts Ray on this node, with what Slurm gave and no more.

        `head` is the first node's address; `folder`, on this node, is for Ray's sockets, logs and spilled objects.
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
        # Whatever else listens takes a port that is free. (Ray's defaults are the same numbers for every Ray.)
        free = ["--min-worker-port=0", "--max-worker-port=0", "--dashboard-agent-listen-port=0"]
        return ["ray", "start", *where, *given, *free, f"--temp-dir={folder}", *_REST]


def _gpus(environ: Mapping[str, str]) -> int:
    if (said := environ.get("SLURM_GPUS_ON_NODE")) is not None:
        return int(said)
    return len([one for one in environ.get("SLURM_STEP_GPUS", "").split(",") if one])


def _memory(environ: Mapping[str, str], cpus: int) -> int | None:
    """Slurm counts in MiB; 0 is all of the node."""
    mebibytes = int(environ.get("SLURM_MEM_PER_NODE", "0")) or int(environ.get("SLURM_MEM_PER_CPU", "0")) * cpus
    return mebibytes * 2**20 or None


def main() -> None:
    """Print this node's address as Ray finds it out."""
    from ray.util import get_node_ip_address

    sys.stdout.write(f"{get_node_ip_address()}\n")


if __name__ == "__main__":
    main()
