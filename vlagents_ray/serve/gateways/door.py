"""What every door with a port of its own has: the listening socket, and who may come in."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.gateways.talk import Connect
from vlagents_ray.wire.messages import Limits

_TAKEN_S = 2.0  # for a door that is being replaced to let go of its port
_BACKLOG = 128

Check = Callable[[str | None], Any]
"""Lets a client in by its key, or raises; None is a client without one."""


@dataclass(frozen=True, slots=True)
class House:
    """What the doors of one application share."""

    app: str
    connect: Connect  # to the application, for one client
    limits: Limits
    sessions: int  # clients of one door, at most
    idle_s: float  # a client that sends nothing for so long is forgotten
    contract: Contract | None
    check: Check | None = None  # None lets everybody in


class Door(Protocol):
    """One protocol on one port."""

    def open(self) -> None:
        """Let clients in."""
        ...

    def alive(self) -> bool:
        """Does it still let clients in?"""
        ...

    def close(self) -> None:
        """Let nobody in any more, and end all sessions."""
        ...


def reserve(name: str, host: str, port: int, timeout_s: float = _TAKEN_S) -> socket.socket:
    """A socket that holds the port, and does not listen yet; `ConfigError` if another has it."""
    family, _, _, _, address = _resolve(name, host, port)
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
                f"{name}: cannot listen on {host}:{port} ({error.strerror}); choose another port or host "
                f"in dialects.{name}"
            ) from error
        return listener


def listen(listener: socket.socket) -> None:
    """From now on clients can connect."""
    listener.listen(_BACKLOG)


def _resolve(name: str, host: str, port: int) -> Any:
    try:
        return socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    except OSError as error:
        raise ConfigError(
            f"{name}: {host!r} is no address of this machine ({error}); change dialects.{name}.host"
        ) from error
