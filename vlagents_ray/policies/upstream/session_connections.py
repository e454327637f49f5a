"""Connections to upstreams that keep sessions: one for each session's episode."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from vlagents_ray.errors import ConnectionLost, NoReplica, PolicyUnavailable, UnknownSession
from vlagents_ray.policies.upstream.clients.base import Answer, UpstreamClient
from vlagents_ray.policies.upstream.lanes import Check

logger = logging.getLogger(__name__)

_AT_ONCE = 32  # sessions of a batch that are asked at the same time
_CONNECT_S = 5.0
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.02, 0.5


class SessionConnections:
    """The connection of each session, to the upstream that has the fewest.

    Args:
        urls: The addresses of the upstreams.
        make: Returns a client of an address.
        check: Raises an error if an upstream, by what it says about itself, is not the one that is wanted.
        retry_s: How long the begin of an episode waits for an upstream, s.
    """

    def __init__(
        self, urls: Sequence[str], make: Callable[[str], UpstreamClient], check: Check, retry_s: float
    ) -> None:
        self._urls = urls
        self._make = make
        self._check = check
        self._retry_s = retry_s
        self._clients: dict[str, UpstreamClient] = {}
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(_AT_ONCE, "upstream")

    def start(self, timeout_s: float) -> None:
        """Return when one upstream answers, with which the mapping is checked; raises as `Lanes.start`."""
        self._connected(timeout_s).close()

    def begin(self, session: str) -> None:
        """Connect for an episode of a session.

        Raises:
            NoReplica: No upstream answers within `retry_s`.
            PolicyFailed: The upstream refuses the episode.
        """
        client = self._connected(self._retry_s)
        if client.one_session:  # whose state the begin of this episode ends
            for other in list(self._clients):
                self.drop(other)
        try:
            client.begin()
        except BaseException:
            client.close()
            raise
        with self._lock:
            self._clients[session] = client

    def ask(self, sessions: Sequence[str], observations: Sequence[Mapping[str, Any]]) -> list[Answer | Exception]:
        """Return the answer to the observation of each session, or the error in its place."""
        others = [
            self._pool.submit(self._ask, session, observation)
            for session, observation in zip(sessions[1:], observations[1:], strict=True)
        ]
        first = self._ask(sessions[0], observations[0]) if sessions else None
        return [] if first is None else [first, *(other.result() for other in others)]

    def drop(self, session: str) -> None:
        """Close the connection of a session that has ended."""
        with self._lock:
            client = self._clients.pop(session, None)
        if client is not None:
            threading.Thread(target=client.close, name="upstream-close", daemon=True).start()  # it may wait for a reply

    def close(self) -> None:
        """Close all connections."""
        self._pool.shutdown()
        with self._lock:
            clients, self._clients = self._clients, {}
        for client in clients.values():
            client.close()

    def _ask(self, session: str, observation: Mapping[str, Any]) -> Answer | Exception:
        with self._lock:
            client = self._clients.get(session)
        if client is None:
            return UnknownSession(
                "upstream: the session's connection is lost, or another session began at an upstream that keeps one; "
                "reset it"
            )
        try:
            [answer] = client.ask([observation])
        except ConnectionLost as error:
            logger.warning("%s; its session begins again", error)
            self.drop(session)
            return UnknownSession(f"{error}, and with it the upstream's session; reset it")
        except Exception as error:  # noqa: BLE001 - the result of this row alone
            if not client.is_open:
                self.drop(session)
            return error
        return answer

    def _connected(self, timeout_s: float) -> UpstreamClient:
        """Return a client that is connected to the upstream with the fewest sessions of those that answer."""
        deadline, pause_s = time.monotonic() + timeout_s, _FIRST_PAUSE_S
        while True:
            with self._lock:
                load = Counter(client.options.url for client in self._clients.values())
            for url in sorted(self._urls, key=lambda url: load[url]):
                client = self._make(url)
                try:
                    self._check(client, client.connect(_CONNECT_S))
                except PolicyUnavailable as error:
                    client.close()
                    reason = error
                except BaseException:
                    client.close()
                    raise
                else:
                    return client
            if time.monotonic() + pause_s > deadline:
                raise NoReplica(f"{reason}; no other upstream answers either") from reason
            time.sleep(pause_s)
            pause_s = min(_LONGEST_PAUSE_S, 2 * pause_s)
