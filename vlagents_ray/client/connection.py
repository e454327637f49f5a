"""The connection to a server, which all sessions of a `RemoteAgent` share, and the server's
metadata.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from typing import Any
from urllib.parse import urlsplit

from vlagents_ray.client.transports.base import (
    CodecChoice,
    ReplicaSilent,
    ReplicaWatch,
    Transport,
)
from vlagents_ray.contract import Contract
from vlagents_ray.errors import (
    ConfigError,
    DeadlineExceeded,
    NoReplica,
    PolicyUnavailable,
    UnknownApp,
    VLAgentsError,
)
from vlagents_ray.interface import OF_THE_LOOP
from vlagents_ray.protocol.messages import (
    PROTOCOL_VERSION,
    LocalAddress,
    Reply,
    Request,
    boot_id,
    is_loopback,
    read_address,
)

logger = logging.getLogger(__name__)

_CLOSE_S = 2.0
# The deadline that is sent to the server is earlier, to leave time for the transport of the answer:
# this share of the remaining time, but at most this many seconds.
_TRANSPORT_SHARE, _TRANSPORT_S = 0.1, 0.2
# The time limit for finding another replica, and the pause between two attempts, s.
_LOOK_UP_S, _LOOK_UP_PAUSE_S = 10.0, 1.0
# The time limit for finding another replica while the present replica is silent. The time limit
# contains two attempts, of which the first lasts for a third of it. Both may fail, since the load
# balancer may still choose the silent replica. A failed look-up is repeated at once, until the load
# balancer marks the silent replica as down.
_SILENT_LOOK_UP_S = 1.2
# The time without any answer, s, over one or several calls, after which the next call uses another
# replica, although the replica answers pings or cannot be pinged.
SILENT_S = 5.0
# Durations of an unanswered ping, s: after the first, the client looks for another replica, and
# after the second, it uses that replica.
_LOOK_UP_AFTER_S, FROZEN_S = 0.5, 2.0


class Connection:
    """Connects on first use, and again after the connection is lost or the replica requests a
    reconnection.

    A replica that requests a reconnection still answers, so its connection is used until another
    replica has answered. The connection to a replica that answers no ping is also used until then,
    since that replica may recover. Only one thread may use a connection at a time.
    """

    def __init__(
        self,
        url: str,
        new_transport: Callable[[ReplicaWatch], Transport],
        codec: CodecChoice,
        timeout_s: float,
        connect_timeout_s: float,
        *,
        leaves_silent: bool = True,
    ) -> None:
        """Set up the connection, without opening it.

        Args:
            url: The URL of the server.
            new_transport: Makes a transport to the server, which uses the given watch to detect a
                frozen replica.
            codec: The codec choice of this connection.
            timeout_s: The default time limit of a call.
            connect_timeout_s: The default time limit of `open`.
            leaves_silent: Whether to switch to another replica when the present replica no longer
                answers.
        """
        self.url = url
        self.codec = codec
        self.timeout_s = timeout_s
        self._connect_timeout_s = connect_timeout_s
        self._leaves_silent = leaves_silent
        self._make_transport = new_transport
        self.transport = self._new_transport()

        # The server sends these values when a transport connects; they are None before.
        self.metadata: dict[str, Any] | None = None
        self.contract: Contract | None = None
        self.users: set[object] = set()  # the objects that use this connection for a session

        # Start of the first call after the last answer, time.monotonic(); None if the last call was
        # answered.
        self._silent_since: float | None = None
        self._silent = False  # whether the replica has been silent for `SILENT_S`
        # The transport to the silent replica. It stays open until another replica answers, since
        # the sessions may still be moved from the silent replica.
        self._old_transport: Transport | None = None
        # The transport to the next replica, while the current one still answers.
        self._next: _NextTransport | None = None
        self._look_up_at = float("-inf")  # earliest time of the next look-up, time.monotonic()

        self.reconnects = 0  # the number of reconnections
        self._must_reconnect = False  # whether to connect again before the next request
        # Whether the replica requested a reconnection. The replica then keeps the sessions when the
        # connection is closed.
        self._asked_to_move = False

        self._prefix = uuid.uuid4().hex[:16]
        self._requests = 0

    def _new_transport(self) -> Transport:
        return self._make_transport(ReplicaWatch(self._on_silence if self._leaves_silent else None))

    def request_id(self) -> str:
        """Return a new id for a request."""
        self._requests += 1
        return f"{self._prefix}-{self._requests:x}"

    def open(self, timeout_s: float | None = None) -> None:
        """Connect, and wait until the server is ready.

        Raises:
            PolicyUnavailable: The server is not ready in time.
        """
        if self._must_reconnect:
            self._drop_next()
            self.reconnects += 1
            if self._silent and self._leaves_silent:
                self._close_old_transport()
                self._old_transport, self.transport = self.transport, self._new_transport()
                self._silent, self._silent_since = False, None
            else:
                self.transport.close()
            self.metadata, self._must_reconnect, self._asked_to_move = None, False, False

        if self.metadata is None:
            limit_s = self._connect_timeout_s if timeout_s is None else timeout_s
            self._connected(self.transport.connect(limit_s))

    def _connected(self, metadata: dict[str, Any]) -> None:
        """Store the metadata of the replica to which the transport has connected. Invalid metadata
        close the transport.
        """
        try:
            if metadata.get("protocol") != PROTOCOL_VERSION:
                raise ConfigError(
                    f"{self.url}: uses protocol {metadata.get('protocol')}, this client "
                    f"{PROTOCOL_VERSION}; upgrade the older of the two"
                )
            contract = metadata.get("contract")
            self.contract = None if contract is None else Contract.from_json(contract)
            local = read_address(LocalAddress, metadata.get("local"))
        except VLAgentsError:
            self.transport.close()
            raise

        # A loopback address in the URL is not sufficient, since a tunnel to another machine also
        # has one.
        is_near = (
            local is not None
            and local.boot_id == boot_id() != ""
            and is_loopback(urlsplit(self.url).hostname or "")
        )
        self.codec.connected(near=is_near)
        # Necessary even if the transport is unchanged.
        self._silent, self._silent_since = False, None
        self.metadata = metadata

    def _move(self) -> None:
        """Switch to the next transport once it is connected. If it fails, keep the current one and
        retry later.
        """
        is_due = self._asked_to_move or self._must_reconnect
        if self._next is None or not self._next.ended or not is_due:
            return
        next_transport, self._next = self._next, None
        if next_transport.metadata is None:
            self._look_up_at = time.monotonic() + _LOOK_UP_PAUSE_S
            return

        self._close_old_transport()
        self._old_transport, self.transport = self.transport, next_transport.transport
        self._close_old_transport()
        self.reconnects += 1
        self._must_reconnect = self._asked_to_move = False
        self._connected(next_transport.metadata)

    def _on_silence(self, silent_s: float, is_proxied: bool) -> None:
        """Look for another replica while the present replica does not answer a ping, and switch
        when another replica has answered. The transport calls this, see `ReplicaWatch`.

        If there is no other replica, the call continues to wait. Behind a proxy, it is unknown
        whether the next replica is the present one. However, it has just answered, and a frozen
        replica does not answer.

        Raises:
            ReplicaSilent: Another replica is connected.
        """
        if silent_s < _LOOK_UP_AFTER_S:
            return
        if self._next is not None and self._next.has_failed:
            self._drop_next()
        if self._next is None and time.monotonic() >= self._look_up_at:
            self._next = _NextTransport(self._new_transport(), _SILENT_LOOK_UP_S)
        if silent_s < FROZEN_S or self._next is None or self._next.metadata is None:
            return

        if not is_proxied and _is_same_replica(self.metadata, self._next.metadata):
            self._drop_next()
            self._look_up_at = time.monotonic() + _LOOK_UP_PAUSE_S
            return
        raise ReplicaSilent(
            f"{self.url}: the replica has not answered a ping for {silent_s:.1f} s, while another "
            f"replica answers; the process of the silent replica is frozen, or holds the "
            f"interpreter lock"
        )

    def _drop_next(self) -> None:
        if self._next is not None:
            self._next.drop()
            self._next = None

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """Send requests in one message and return their replies. A reply may be a transport
        error.
        """
        begun = time.monotonic()
        try:
            self._move()
            if self._must_reconnect:
                self.open(timeout_s)
                timeout_s -= time.monotonic() - begun
                if timeout_s <= 0:  # nothing is sent; the next call uses the new connection
                    late = DeadlineExceeded(f"{self.url}: reconnected, but too late for this call")
                    return [Reply(request.request_id, error=late) for request in requests]

            left_s = max(1e-3, timeout_s)
            server_deadline_ms = (left_s - min(_TRANSPORT_SHARE * left_s, _TRANSPORT_S)) * 1e3
            for request in requests:
                request.deadline_ms = server_deadline_ms

            replies = self.transport.call(requests, left_s)
            self._silent_since = None
            if self._old_transport is not None:
                self._close_old_transport()
            if self._next is not None and not self._asked_to_move:
                self._drop_next()  # the replica was silent, but has answered now
        except VLAgentsError as error:
            if isinstance(error, DeadlineExceeded):
                self._silent_since = begun if self._silent_since is None else self._silent_since
                self._silent = time.monotonic() - self._silent_since >= SILENT_S
                self._must_reconnect = self._must_reconnect or (
                    self._silent and self._leaves_silent
                )
            replies = [Reply(request.request_id, error=error) for request in requests]

        for reply in replies:
            # A server must not set the keys that are reserved for the control loop.
            if reply.act is not None:
                for name in OF_THE_LOOP:
                    reply.act.info.pop(name, None)
        if len(replies) == len(requests) and not any(
            reply.error or reply.draining for reply in replies
        ):
            return replies
        return self._after_error_or_drain(requests, replies)

    def _after_error_or_drain(
        self, requests: Sequence[Request], replies: list[Reply]
    ) -> list[Reply]:
        """Record errors and whether to reconnect; return a reply for each request."""
        for reply in replies:
            # The application existed before, so the server is stopping or restarting.
            if isinstance(reply.error, UnknownApp):
                reply.error = NoReplica(f"{self.url}: the application is gone ({reply.error})")

        if len(replies) != len(requests):  # a single reply applies to the whole frame
            error = replies[0].error or PolicyUnavailable(
                f"expected {len(requests)} replies, one for each request, got {len(replies)}"
            )
            replies = [Reply(request.request_id, error=error) for request in requests]

        if any(isinstance(reply.error, PolicyUnavailable) for reply in replies):
            self._must_reconnect, self._asked_to_move = True, False
        elif any(reply.draining for reply in replies):
            self._asked_to_move = True
            if self._next is None and time.monotonic() >= self._look_up_at:
                self._next = _NextTransport(self._new_transport(), _LOOK_UP_S)
        return replies

    def end_session(self, user: object, session: str) -> None:
        """End the session of `user`, if it has begun. Ending the last session closes the
        connection.
        """
        was_begun = user in self.users
        self.users.discard(user)

        # A `close` request is needed unless the session ends when the connection is closed.
        ends_with_connection = self.transport.holds_sessions and not self.users
        must_request = self._asked_to_move or not (ends_with_connection or self._must_reconnect)
        if was_begun and self.metadata is not None and must_request:
            close = Request(
                "close", session=session, request_id=self.request_id(), deadline_ms=_CLOSE_S * 1e3
            )
            with contextlib.suppress(VLAgentsError):  # harmless: the server drops idle sessions
                # The old connection is still open, and the session belongs to it.
                self.transport.call([close], _CLOSE_S)

        if not self.users:
            self._drop_next()
            self._close_old_transport()
            self.transport.close()
            self.metadata, self._must_reconnect, self._asked_to_move = None, False, False

    def _close_old_transport(self) -> None:
        """Close the transport to the former replica in a thread, since closing may take long."""
        if self._old_transport is not None:
            threading.Thread(target=self._old_transport.close, daemon=True).start()
            self._old_transport = None


def _is_same_replica(metadata: dict[str, Any] | None, other: dict[str, Any]) -> bool:
    """Return whether both metadata come from the same replica; no two replicas have the same
    addresses.
    """
    names = ("local", "stream")
    addresses = [None if metadata is None else metadata.get(name) for name in names]
    return any(addresses) and addresses == [other.get(name) for name in names]


class _NextTransport:
    """A transport that connects once, on its own thread."""

    def __init__(self, transport: Transport, timeout_s: float) -> None:
        self.transport = transport
        self._timeout_s = timeout_s
        # Metadata of the replica; None if there was no answer.
        self.metadata: dict[str, Any] | None = None
        self.ended = False
        self._dropped = False
        self._lock = threading.Lock()
        threading.Thread(target=self._connect, name="next-replica", daemon=True).start()

    @property
    def has_failed(self) -> bool:
        """Whether the attempt has ended without an answer."""
        return self.ended and self.metadata is None

    def _connect(self) -> None:
        metadata = None
        try:
            metadata = self.transport.connect(self._timeout_s)
            if metadata.get("protocol") != PROTOCOL_VERSION:
                metadata = None
        except VLAgentsError as error:
            logger.info(
                "the session stays on this replica, as no other replica was found: %s", error
            )
        finally:
            with self._lock:
                self.metadata, self.ended = metadata, True
                unused = metadata is None or self._dropped
            if unused:
                self.transport.close()

    def drop(self) -> None:
        """Close the transport, immediately or when its attempt to connect ends."""
        with self._lock:
            self._dropped = True
        if self.ended:
            self.transport.close()
