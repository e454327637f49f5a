"""The way to a server, shared by all sessions of one `RemoteAgent`, and what the server says of itself."""

from __future__ import annotations

import contextlib
import time
import uuid
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, ConnectionLost, PolicyUnavailable, UnknownApp, VLAgentsError
from vlagents_ray.wire.messages import PROTOCOL_VERSION, Reply, Request

if TYPE_CHECKING:
    from vlagents_ray.client.link import CodecChoice
    from vlagents_ray.client.transport import Transport

_CLOSE_S = 2.0


class Connection:
    """Connects when first needed, and again when the connection broke or the replica sends its sessions elsewhere.

    Used by one thread at a time.
    """

    def __init__(
        self, url: str, transport: Transport, codec: CodecChoice, timeout_s: float, connect_timeout_s: float
    ) -> None:
        self.url = url
        self.transport = transport
        self.codec = codec
        self.timeout_s = timeout_s
        self.metadata: dict[str, Any] | None = None
        self.contract: Contract | None = None
        self.users: set[object] = set()  # whoever has a session here
        self._connect_timeout_s = connect_timeout_s
        self._stale = False  # connect anew before the next request
        self._sent_away = False  # because the replica said so, and for no other reason
        self._prefix = uuid.uuid4().hex[:16]
        self._requests = 0

    def request_id(self) -> str:
        """One that no other request has."""
        self._requests += 1
        return f"{self._prefix}-{self._requests:x}"

    def open(self, timeout_s: float | None = None) -> None:
        """Connect, waiting for the server to become ready; `PolicyUnavailable` if it does not."""
        if self._stale:
            self.transport.close()
            self.metadata, self._stale, self._sent_away = None, False, False
        if self.metadata is not None:
            return
        metadata = self.transport.connect(self._connect_timeout_s if timeout_s is None else timeout_s)
        if metadata.get("protocol") != PROTOCOL_VERSION:
            self.transport.close()
            raise ConfigError(
                f"{self.url}: speaks protocol {metadata.get('protocol')}, this client {PROTOCOL_VERSION}; "
                f"upgrade the older of the two"
            )
        contract = metadata.get("contract")
        self.contract = None if contract is None else Contract.from_json(contract)
        self.metadata = metadata

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """The replies to requests that travel together; in place of an answer, an error that was met on the way."""
        deadline = time.monotonic() + timeout_s
        try:
            if self._stale:
                self.open(timeout_s)
            left_s = max(1e-3, deadline - time.monotonic())
            for request in requests:
                request.deadline_ms = left_s * 1e3
            replies = self.transport.call(requests, left_s)
        except VLAgentsError as error:
            replies = [Reply(request.request_id, error=error) for request in requests]
        if len(replies) == len(requests) and not any(map(_matters, replies)):
            return replies
        for reply in replies:
            if isinstance(reply.error, UnknownApp):  # it was there: the server is stopping, or starting again
                reply.error = PolicyUnavailable(f"{self.url}: the application is gone ({reply.error})")
        if len(replies) != len(requests):  # an answer to the frame as a whole
            whole = replies[0].error or PolicyUnavailable(f"got {len(replies)} replies to {len(requests)} requests")
            replies = [Reply(request.request_id, error=whole) for request in requests]
        broken = any(isinstance(reply.error, (ConnectionLost, PolicyUnavailable)) for reply in replies)
        if broken or any(reply.draining for reply in replies):
            self._stale, self._sent_away = True, not broken
        return replies

    def leave(self, user: object, session: str) -> None:
        """A session ends, if there was one; the last one hangs up."""
        begun = user in self.users
        self.users.discard(user)
        told = self.transport.holds_sessions and not self.users  # by hanging up
        if begun and self.metadata is not None and (self._sent_away or not (told or self._stale)):
            close = Request("close", session=session, request_id=self.request_id(), deadline_ms=_CLOSE_S * 1e3)
            with contextlib.suppress(VLAgentsError):  # it would change nothing: the server forgets idle sessions
                self.transport.call([close], _CLOSE_S)  # over this connection still: the session is there
        if not self.users:
            self.transport.close()
            self.metadata, self._stale, self._sent_away = None, False, False


def _matters(reply: Reply) -> bool:
    """Does it say anything of the connection?"""
    return reply.error is not None or reply.draining
