"""The output of a worker's process, which is read after the process has ended."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Sequence
from pathlib import Path

import ray
from ray.exceptions import GetTimeoutError, RayError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

MOST_BYTES = 64_000  # most bytes of a kept log, all files together
TIMEOUT_S = 5.0  # s for another node to read it


def own_logs() -> list[str]:
    """Return the files of this process's standard output and error; in a Ray worker, Ray's log files."""
    found = []
    for number in (1, 2):
        with contextlib.suppress(OSError):  # no /proc
            found.append(os.readlink(f"/proc/self/fd/{number}"))
    return [path for path in dict.fromkeys(found) if Path(path).is_file()]


def tail(paths: Sequence[str]) -> str:
    """Return the end of each file under its name, except of missing files."""
    parts = []
    for path in paths:
        with contextlib.suppress(OSError), open(path, "rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - MOST_BYTES // len(paths)))
            parts.append(f"== {Path(path).name}\n{file.read().decode(errors='replace').strip()}")
    return "\n".join(parts)


def tail_at(host: str, paths: Sequence[str]) -> str:
    """Return `tail` of files on any host of the cluster; "" if the host is lost.

    Raises:
        TimeoutError: The host does not answer.
    """
    if host == socket.gethostname():
        return tail(paths)
    nodes = [node["NodeID"] for node in ray.nodes() if node["Alive"] and node["NodeManagerHostname"] == host]
    if not nodes:
        return ""
    there = NodeAffinitySchedulingStrategy(nodes[0], soft=False)
    try:
        read: str = ray.get(
            ray.remote(tail).options(num_cpus=0, scheduling_strategy=there).remote(list(paths)), timeout=TIMEOUT_S
        )
    except GetTimeoutError:
        raise TimeoutError(f"host {host} did not answer within {TIMEOUT_S:g} s") from None
    except RayError:  # the node is gone with its files
        return ""
    return read
