"""TCP ports: finds free ports, and reserves a port for a server that starts later."""

from __future__ import annotations

import os
import random
import socket
import time
from collections import deque

from vlagents_ray.errors import ConfigError

LOOPBACK, EVERYWHERE = "127.0.0.1", "0.0.0.0"  # noqa: S104 - only compared, and bound for a moment
# Environment variable of a replica: the address at which its server listens, if it differs from
# Serve's address.
HOST = "VLAGENTS_RAY_HOST"
_BLOCKS = (20_000, 24_000)  # range of the ports for replicas
# Range of the ports for HAProxy and other servers, below the system's ephemeral ports.
_PORTS = (24_000, 32_700)
_CLAIMS = 256  # maximum number of claims of this process; older claims are released
_RELEASE_S = 2.0  # time limit for a server that is being replaced to close its port
_PROBES = 64  # maximum number of processes that read the owner of a claim at the same time
_LISTEN_S = 0.002  # time within which a process listens at a claim that it has just bound
# Descriptors of the claims; the kernel closes them when the process ends.
_claims: deque[int] = deque()
_excluded: set[int] = set()  # ports that `free_port` never returns
_random = random.SystemRandom()


def free_port(host: str = LOOPBACK) -> int:
    """Return a TCP port that is free at the moment, and was neither returned recently nor passed to
    `keep`.

    The server for an earlier port may not listen yet, so this process claims each port that it
    returns. While this process runs, and until it has returned `_CLAIMS` further ports, the
    function does not return the claimed port in any other process on this machine. Ports are drawn
    with the system's random generator, so that processes with equal seeds for Python's generator do
    not draw the same ports.
    """
    for _ in range(100):
        port = _random.randrange(*_PORTS)
        if port not in _excluded and is_free(host, port) and _claim(port):
            return port
    raise ConfigError(f"no free port between {_PORTS[0]} and {_PORTS[1]}")


def _claim(port: int) -> bool:
    """Claim a port for this process; return False if another process of this user has claimed the
    port.

    The claim is an abstract Unix socket named after the port, which the kernel lets only one
    process bind, and closes when that process ends. Any account of the machine can bind such names,
    so claims of other users do not count: they could otherwise claim all ports, and no server of
    this user would start.
    """
    name = f"\0vlagents-ray-port-{port}"
    claim = socket.socket(socket.AF_UNIX)
    try:
        claim.bind(name)
    except OSError:
        claim.close()
        return not _is_claim_of_this_user(name)
    claim.listen(_PROBES)  # so that other processes can read the claim's owner
    _claims.append(claim.detach())
    if len(_claims) > _CLAIMS:
        os.close(_claims.popleft())
    return True


def _is_claim_of_this_user(name: str) -> bool:
    from vlagents_ray.protocol.messages import peer_uid

    for _ in range(2):
        with socket.socket(socket.AF_UNIX) as probe:
            probe.setblocking(False)
            try:
                probe.connect(name)
            except OSError:
                time.sleep(_LISTEN_S)
            else:
                return peer_uid(probe) == os.getuid()
    return False


def keep(*ports: int) -> None:
    """Exclude ports from `free_port`, since they belong to servers that may not listen yet."""
    _excluded.update(ports)


def free_block(size: int) -> int:
    """Return the first of `size` consecutive ports for the replicas. The first port is free; Ray
    skips other ports of the block that are in use. The block is claimed as in `free_port`, since
    servers that start at the same time would otherwise choose the same block. If all free blocks
    are claimed, a block is shared.
    """
    bases = list(range(*_BLOCKS, size))
    _random.shuffle(bases)
    free_bases = [base for base in bases if is_free(LOOPBACK, base)]
    for base in free_bases:
        if _claim(base):
            return base
    if free_bases:
        return free_bases[0]
    raise ConfigError(
        f"no free block of ports between {_BLOCKS[0]} and {_BLOCKS[1]} for the replicas"
    )


def is_free(host: str, port: int) -> bool:
    """Return whether this process can listen on a port."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError:
            return False
        return True


def reserve(name: str, host: str, port: int, timeout_s: float = _RELEASE_S) -> socket.socket:
    """Return a socket that is bound to the port for the dialect `name`, and does not listen yet.

    Raises:
        ConfigError: Another process still uses the port after `timeout_s`, or the address does not
            belong to this machine.
    """
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except OSError as error:
        raise ConfigError(
            f"{name}: {host!r} is not an address of this machine ({error}); change "
            f"dialects.{name}.host"
        ) from error
    family, _, _, _, address = addresses[0]

    deadline = time.monotonic() + timeout_s
    while True:
        listener = socket.socket(family, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind(address)
        except OSError as error:
            listener.close()
            if time.monotonic() < deadline:
                time.sleep(0.1)
                continue
            raise ConfigError(
                f"{name}: cannot listen on {host}:{port} ({error.strerror}); choose another port "
                f"or host in dialects.{name}"
            ) from error
        return listener
