"""TCP ports that nobody listens on."""

from __future__ import annotations

import random
import socket
from collections import deque

from vlagents_ray.errors import ConfigError

LOOPBACK, EVERYWHERE = "127.0.0.1", "0.0.0.0"  # noqa: S104 - compared, and tried
HOST = "VLAGENTS_RAY_HOST"  # in the environment of a replica: where its server listens, if not where Serve does
_BLOCKS = (20_000, 24_000)
_PORTS = (24_000, 32_700)  # of HAProxy and the like: below those that the system gives to whoever asks for any
_given: deque[int] = deque(maxlen=4_000)  # the latest
_kept: set[int] = set()
_random = random.SystemRandom()


def free_port(host: str = LOOPBACK) -> int:
    """A TCP port that nobody listens on at this moment, and none that was given lately or is kept.

    Whoever has that one may not listen yet. The system's own generator of random numbers draws, so
    that processes which seed Python's alike do not draw the same ports.
    """
    for _ in range(100):
        port = _random.randrange(*_PORTS)
        if port not in _given and port not in _kept and is_free(host, port):
            _given.append(port)
            return port
    raise ConfigError(f"no free port between {_PORTS[0]} and {_PORTS[1]}")


def keep(*ports: int) -> None:
    """These are somebody's, who may not listen yet: `free_port` gives them to nobody."""
    _kept.update(ports)


def free_ports(number: int) -> list[int]:
    """Different ones, free on every address of this machine: HAProxy listens to all for its metrics and statistics."""
    return sorted(free_port(EVERYWHERE) for _ in range(number))


def free_block(size: int) -> int:
    """The first of `size` ports for the replicas; the first is free, and Ray steps over taken ones."""
    for _ in range(100):
        base = _random.randrange(*_BLOCKS, size)
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
