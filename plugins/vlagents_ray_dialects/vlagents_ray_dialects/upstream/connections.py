"""Connections to upstreams: shared by all sessions, or one for each session if the upstream
keeps sessions.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from vlagents_ray.errors import (
    ConnectionLost,
    NoReplica,
    PolicyFailed,
    PolicyUnavailable,
    UnknownSession,
    VLAgentsError,
)
from vlagents_ray_dialects.upstream.client import Answer, UpstreamClient

logger = logging.getLogger(__name__)

_CONNECT_S = 5.0  # the time limit of one attempt to connect, s
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.02, 1.0  # pauses between two attempts to connect, s
# The number of connections that one row may lose, so that a row that crashes an upstream cannot end
# all connections.
_ATTEMPTS = 3

Check = Callable[[UpstreamClient, Mapping[str, Any]], None]


@dataclass(slots=True)
class _Share:
    """Rows of a batch that are sent together."""

    rows: range
    attempts: int = 0  # the number of connections that were lost while these rows were sent


class Lanes:
    """The shared connections; a lost connection is reopened in the background while the others
    continue.

    Args:
        clients: The clients, not connected yet.
        check: Raises an error if the metadata shows that an upstream is the wrong one.
        retry_s: The time for which a batch waits for a lost upstream if there is no other, s.
    """

    def __init__(self, clients: Sequence[UpstreamClient], check: Check, retry_s: float) -> None:
        self._clients = clients
        self._check = check
        self._retry_s = retry_s
        self._ready: list[UpstreamClient] = []  # the clients that are connected
        self._changed = threading.Condition()
        # The error of the last attempt to connect.
        self._reason: VLAgentsError = NoReplica("upstream: not connected yet")
        self._connecting: list[threading.Thread] = []
        self._closed = False
        self._pool = ThreadPoolExecutor(max(1, len(clients) - 1), "upstream")

    def start(self, timeout_s: float) -> None:
        """Wait until one upstream answers.

        Args:
            timeout_s: The time limit, s.

        Raises:
            ContractMismatch: The upstream is the wrong one.
            PolicyUnavailable: No upstream answers in time.
        """
        for client in self._clients:
            self._connect_in_background(client)
        with self._changed:
            # If the upstream is unavailable, the next attempt may succeed. If it is the wrong one,
            # no attempt will.
            self._changed.wait_for(
                lambda: self._ready or self._reason.status != NoReplica.status, timeout_s
            )
            failed = None if self._ready else self._reason
        if failed is not None:
            self.close()
            raise failed

    def ask(self, observations: Sequence[Mapping[str, Any]]) -> list[Answer | Exception]:
        """Send observations to the upstreams.

        If a connection is lost, its rows are sent again over another connection, or over the same
        one after it is reopened. This is safe, as an upstream without sessions keeps no state.

        Args:
            observations: The observations, in the upstream's format.

        Returns:
            The answer to each observation, or the error in its place.
        """
        results: list[Answer | Exception] = [NoReplica("upstream: not asked")] * len(observations)
        deadline = time.monotonic() + self._retry_s
        work: deque[_Share] = deque()
        while not work or time.monotonic() < deadline:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._ready or self._closed, max(0.0, deadline - time.monotonic())
                )
                ready = list(self._ready)

            if not work:
                work.extend(self._shares(len(observations), len(ready)))
            if not ready:
                break

            futures = []
            for client in ready[1 : len(work)]:
                futures.append(self._pool.submit(self._work, client, work, observations, results))
            self._work(ready[0], work, observations, results)
            for future in futures:
                future.result()
            if not work:
                return results

        for share in work:
            for row in share.rows:
                results[row] = NoReplica(
                    f"{self._reason}; no other upstream answers either: send the request again"
                )
        return results

    def _shares(self, rows: int, connections: int) -> list[_Share]:
        """Divide the rows of a batch: as many shares as there are connections if the protocol has
        batches, otherwise single rows.
        """
        count = min(rows, max(1, connections)) if self._clients[0].batches else rows
        return [_Share(range(rows * i // count, rows * (i + 1) // count)) for i in range(count)]

    def close(self) -> None:
        """Close all connections."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
            ready, self._ready = self._ready, []
        self._pool.shutdown()
        for client in ready:  # a client that is connecting is closed by the thread that connects it
            client.close()
        for thread in self._connecting:
            thread.join(2 * _CONNECT_S)

    def _work(
        self,
        client: UpstreamClient,
        work: deque[_Share],
        observations: Sequence[Mapping[str, Any]],
        results: list[Answer | Exception],
    ) -> None:
        """Send shares over one connection until no shares are left or the connection is lost; a
        connection that has ended sends none.
        """
        while True:
            if not client.is_open:
                self._lose(client, None)
                return
            try:
                share = work.popleft()
            except IndexError:
                return

            share_observations = [observations[row] for row in share.rows]
            try:
                answers: Sequence[Answer | Exception] = client.ask(share_observations)
            except ConnectionLost as error:
                share.attempts += 1
                if share.attempts < _ATTEMPTS:
                    work.append(share)
                for row in share.rows:
                    results[row] = error
                self._lose(client, error)
                return
            except Exception as error:  # noqa: BLE001 - the result of these rows alone
                answers = [error] * len(share.rows)
                # One of the rows may have caused the loss; the other rows are then sent without it.
                if len(share.rows) > 1:
                    work.extend(_Share(range(row, row + 1), share.attempts) for row in share.rows)
            for row, answer in zip(share.rows, answers, strict=True):
                results[row] = answer

    def _lose(self, client: UpstreamClient, reason: VLAgentsError | None) -> None:
        """Close a connection that is lost, and open it again in the background."""
        client.close()
        with self._changed:
            if reason is not None:
                self._reason = reason
            if client not in self._ready:
                return
            self._ready.remove(client)
        if reason is not None:
            logger.warning("%s; connecting again", reason)
        self._connect_in_background(client)

    def _connect_in_background(self, client: UpstreamClient) -> None:
        """Connect a client on a new thread."""
        thread = threading.Thread(
            target=self._connect, args=(client,), name="upstream-connect", daemon=True
        )
        running = [earlier for earlier in self._connecting if earlier.is_alive()]
        self._connecting = [*running, thread]
        thread.start()

    def _connect(self, client: UpstreamClient) -> None:
        """Try to connect a client until it succeeds; runs on its own thread."""
        pause_s = _FIRST_PAUSE_S
        logged_reason = ""
        while not self._closed:
            try:
                self._check(client, client.connect(_CONNECT_S))
            except Exception as error:
                if isinstance(error, VLAgentsError):
                    reason = error
                else:
                    logger.exception("upstream %s: connecting failed", client.options.url)
                    reason = PolicyFailed(
                        f"upstream {client.options.url}: connecting failed, the server's log says "
                        "how"
                    )
                client.close()
            else:
                break

            with self._changed:
                if str(reason) != logged_reason:
                    logged_reason = str(reason)
                    logger.warning("%s", logged_reason)
                self._reason = reason
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._closed, pause_s)
            pause_s = min(_LONGEST_PAUSE_S, 2 * pause_s)

        with self._changed:
            if self._closed:
                client.close()
                return
            self._ready.append(client)
            self._changed.notify_all()
        logger.info("upstream %s answers", client.options.url)


# Connections to upstreams that keep sessions: one connection for each session's episode.

_AT_ONCE = 32  # maximum number of sessions of a batch that are sent at the same time


class SessionConnections:
    """The connection of each session, to the upstream with the fewest sessions.

    Args:
        urls: The addresses of the upstreams.
        make: Returns a client for an address.
        check: Raises an error if the metadata shows that an upstream is the wrong one.
        retry_s: The time for which the beginning of an episode waits for an upstream, s.
    """

    def __init__(
        self,
        urls: Sequence[str],
        make: Callable[[str], UpstreamClient],
        check: Check,
        retry_s: float,
    ) -> None:
        self._urls = urls
        self._make = make
        self._check = check
        self._retry_s = retry_s
        self._clients: dict[str, UpstreamClient] = {}
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(_AT_ONCE, "upstream")

    def start(self, timeout_s: float) -> None:
        """Wait until one upstream answers; raises errors as `Lanes.start`."""
        self._connected(timeout_s).close()

    def begin(self, session: str) -> None:
        """Connect for an episode of a session.

        Raises:
            NoReplica: No upstream answers within `retry_s`.
        """
        client = self._connected(self._retry_s)
        try:
            client.begin()
        except BaseException:
            client.close()
            raise
        with self._lock:
            self._clients[session] = client

    def ask(
        self, sessions: Sequence[str], observations: Sequence[Mapping[str, Any]]
    ) -> list[Answer | Exception]:
        """Return the answer to the observation of each session, or the error in its place."""
        if not sessions:
            return []
        futures = []
        for session, observation in zip(sessions[1:], observations[1:], strict=True):
            futures.append(self._pool.submit(self._ask, session, observation))
        first_answer = self._ask(sessions[0], observations[0])
        return [first_answer, *(future.result() for future in futures)]

    def drop(self, session: str) -> None:
        """Close the connection of a session."""
        with self._lock:
            client = self._clients.pop(session, None)
        if client is not None:
            # Closing may wait for a reply.
            threading.Thread(target=client.close, name="upstream-close", daemon=True).start()

    def close(self) -> None:
        """Close all connections."""
        self._pool.shutdown()
        with self._lock:
            clients, self._clients = self._clients, {}
        for client in clients.values():
            client.close()

    def _ask(self, session: str, observation: Mapping[str, Any]) -> Answer | Exception:
        """Return the answer to the observation of one session, or the error."""
        with self._lock:
            client = self._clients.get(session)
        if client is None:
            return UnknownSession("upstream: the session's connection is lost; reset it")
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
        """Return a client connected to the upstream with the fewest sessions among those that
        answer.
        """
        deadline = time.monotonic() + timeout_s
        pause_s = _FIRST_PAUSE_S
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
