"""The clients of one dialect of the gateway whose protocol does not say when they are gone."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable
from typing import Generic, Protocol, TypeVar

from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.serve.dialects.base import GatewayContext

_QUIET_S = 30.0  # a client without a session is removed after this time without a request


class GatewayClient(Protocol):
    """One client, with its sessions."""

    @property
    def begun(self) -> bool:
        """Whether the client has a session."""
        ...

    def quiet_s(self, now: float) -> float:
        """Return the time since the client's last request, s; 0 while it waits for a reply."""
        ...

    def refusal(self) -> str | None:
        """Return the reason if the client's key is no longer valid; None if it is valid or there is none."""
        ...

    def end(self) -> None:
        """End the client's sessions, after the current request."""
        ...


K = TypeVar("K", bound=Hashable)
C = TypeVar("C", bound=GatewayClient)


class GatewayClients(Generic[K, C]):
    """The clients by what the protocol tells them apart by, at most `sessions` of the context. Thread-safe."""

    def __init__(self, context: GatewayContext) -> None:
        self._context = context
        self._clients: dict[K, C] = {}
        self._lock = threading.Lock()

    def get(self, key: K) -> C | None:
        """Return a client; None if it is not known, or was removed."""
        return self._clients.get(key)

    def add(self, key: K, make: Callable[[], C]) -> C:
        """Make a client, in place of one with the same key.

        If there are too many, the one without a session that has been idle for the longest is removed.

        Raises:
            PolicyUnavailable: There are too many, and all have sessions or wait for a reply.
        """
        removed = []
        try:
            with self._lock:
                if (earlier := self._clients.pop(key, None)) is not None:
                    removed.append(earlier)
                if len(self._clients) >= self._context.sessions:
                    removed.append(self._clients.pop(self._idlest()))
                client = self._clients[key] = make()
                return client
        finally:
            _end(removed)

    def forget_quiet(self) -> None:
        """End the sessions of idle clients and of clients whose key is no longer valid."""
        now = time.monotonic()
        with self._lock:
            removed = [key for key, client in self._clients.items() if self._is_gone(client, now)]
            ended = [self._clients.pop(key) for key in removed]
        _end(ended)

    def end_all(self) -> list[C]:
        """End the sessions of all clients, and return the clients."""
        with self._lock:
            clients = list(self._clients.values())
        return _end(clients)

    def _is_gone(self, client: C, now: float) -> bool:
        patience_s = self._context.idle_s if client.begun else min(_QUIET_S, self._context.idle_s)
        return client.quiet_s(now) > patience_s or client.refusal() is not None

    def _idlest(self) -> K:
        """Return the key of the client without a session that has been idle for the longest."""
        now = time.monotonic()
        idle = [(client.quiet_s(now), key) for key, client in self._clients.items() if not client.begun]
        quiet_s, key = max(idle, key=lambda one: one[0], default=(0.0, None))
        if key is None or quiet_s <= 0:
            raise PolicyUnavailable(f"{len(self._clients)} clients are connected, the limit; try again later")
        return key


def _end(clients: list[C]) -> list[C]:
    for client in clients:
        client.end()
    return clients
