"""TCP ports that nobody listens on."""

from __future__ import annotations

import random
import socket
from collections.abc import Collection

from vlagents_ray.errors import ConfigError

LOOPBACK, EVERYWHERE = "127.0.0.1", "0.0.0.0"  # noqa: S104 - compared, and tried
HOST = "VLAGENTS_RAY_HOST"  # in the environment of a replica: where its server listens, if not where Serve does
_PORTS = (30_000, 32_700)  # of HAProxy and the like
_BLOCKS = (20_000, 30_000)


def free_port(host: str = LOOPBACK, but: Collection[int] = ()) -> int:
    """A TCP port that nobody listens on at this moment, none of `but`.

    Drawn at random below the range from which the system gives ports to whoever asks for any, so
    that it is still free when its process has started.
    """
    for _ in range(100):
        port = random.randrange(*_PORTS)
        if port not in but and is_free(host, port):
            return port
    raise ConfigError(f"no free port between {_PORTS[0]} and {_PORTS[1]}")


def free_ports(number: int) -> list[int]:
    """Different ones, free on every address of this machine: HAProxy listens to all for its metrics and statistics."""
    found: set[int] = set()
    while len(found) < number:
        found.add(free_port(EVERYWHERE))
    return sorted(found)


def free_block(size: int) -> int:
    """The first of `size` ports for the replicas; the first is free, and Ray steps over taken ones."""
    for _ in range(100):
        base = random.randrange(*_BLOCKS, size)
        if is_free(LOOPBACK, base):
            return base
    raise ConfigError(f"no free block of ports between {_BLOCKS[0]} and {_BLOCKS[1]} for the replicas")


def is_free(host: str, port: int) -> bool:
    """Can this process listen there?"""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError:
            return False
        return True
