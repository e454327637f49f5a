"""The interface between `RemoteAgent` and the transports that carry its requests."""

from __future__ import annotations

import logging
import math
import select
import socket
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal, Protocol, get_args

from vlagents_ray.errors import ConnectionLost, DeadlineExceeded, InvalidInput
from vlagents_ray.images.codecs import JPEG, LOSSLESS, RAW, ImageCodec
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.messages import Reply, Request

logger = logging.getLogger(__name__)

CodecName = Literal["auto", "exact", "raw", "lossless", "jpeg"]
# Names whose codec depends on the location of the server.
_OVER_A_NETWORK = {"auto": JPEG, "exact": LOSSLESS}

_ANSWER_S = 2.0  # s, time limit for the first byte of the first replica's answer
_SILENT_S = 2.0  # s after which an unfinished attempt to connect is reported
# s to wait for a replica's own port: a firewall may drop the packets
DIRECT_S = 1.0
# s, pause before an own port that could not be used is tried again: the replica may have been
# restarting or full, or the network down
AVOIDED_S = 30.0

# The time without an answer after which a replica is pinged, the shortest time between two pings on
# a connection, and the time between two checks, s. A server permits one ping per second.
_PING_AFTER_S, _PING_PERIOD_S, _CHECK_PERIOD_S = 0.5, 1.25, 0.25
PROBE_S = 5.0  # time limit of a ping on its own thread


def no_answer(address: str, timeout_s: float) -> DeadlineExceeded:
    """Return the error for a request without an answer, with likely causes."""
    return DeadlineExceeded(
        f"{address}: no answer within {round(timeout_s, 3):g} s; the policy may need more time "
        f"(raise timeout_s), or hang in a call (the server's log then contains the line)"
    )


def connection_lost(address: str, reason: object) -> ConnectionLost:
    """Return the error for a connection that ended after a request was sent, with likely causes."""
    return ConnectionLost(
        f"{address}: {reason}; if the server was not restarted, the policy may have ended its "
        "process (os._exit, a crash in C code, exhausted memory): see the server's log"
    )


class ReplicaSilent(ConnectionLost):
    """The client has left a replica that does not even answer pings: the replica's process is
    frozen, or its machine cannot be reached.

    The connection is closed, so that the replica does not execute the request later.
    """


class ReplicaWatch:
    """Detects, for one connection, whether a replica that has not answered yet is alive.

    The watch pings the replica. The replica's process answers pings even while the policy's thread
    runs a long batch or loads a checkpoint, but not while the process is frozen.
    """

    def __init__(self, on_silence: Callable[[float, bool], None] | None = None) -> None:
        """Watch a replica.

        Args:
            on_silence: Called several times a second while the replica does not answer a ping, with
                the time since the first such ping, s, and `is_proxied`. The function raises
                `ReplicaSilent` to end the call. If None, the replica is not pinged.
        """
        # Whether the connection ends at a proxy; then the metadata may be from another replica.
        self.is_proxied = False
        self._on_silence = on_silence
        self._check_at = float("inf")  # time of the next check, time.monotonic()
        self._pinged_at = float("-inf")  # time of the latest ping
        # Time of the first ping since the last sign of life; None if no ping is unanswered.
        self._silent_since: float | None = None

    @property
    def is_silent(self) -> bool:
        """Whether a ping, perhaps one of an earlier call, is unanswered."""
        return self._silent_since is not None

    def begin(self) -> None:
        """Begin to wait for an answer."""
        if self._on_silence is not None:
            self._check_at = time.monotonic() + _PING_AFTER_S

    def received(self) -> None:
        """Record a sign of life: the replica has sent or read bytes."""
        self._silent_since = None

    def wait(
        self,
        poller: select.poll,
        deadline: float,
        ping: Callable[[], None] | None = None,
    ) -> None:
        """Sleep until a file of `poller` is ready, and check the replica meanwhile.

        Args:
            poller: The poller of a socket.
            deadline: The time limit, time.monotonic().
            ping: Sends a ping, without waiting. None while a message is being sent; then the
                replica must read bytes of the message instead.

        Raises:
            TimeoutError: The deadline has passed.
            ReplicaSilent: The client leaves the replica.
        """

        def is_ready(limit_s: float) -> bool:
            return bool(poller.poll(math.ceil(limit_s * 1e3)))

        self.wait_until(is_ready, deadline, ping)

    def wait_until(
        self,
        is_ready: Callable[[float], bool],
        deadline: float,
        ping: Callable[[], None] | None = None,
    ) -> None:
        """Wait like `wait`, but for a condition other than a socket.

        Args:
            is_ready: Waits for at most its argument, s, and returns whether the answer has arrived.
                It may be called again after it has returned True.
            deadline: The time limit, time.monotonic().
            ping: Sends a ping, without waiting.

        Raises:
            TimeoutError: The deadline has passed.
            ReplicaSilent: The client leaves the replica.
        """
        while True:
            left_s = min(deadline, self._check_at) - time.monotonic()
            if left_s > 0 and is_ready(left_s):
                return
            if time.monotonic() >= deadline:
                raise TimeoutError
            self._check(is_ready, ping)

    def probe(self, is_alive: Callable[[], bool]) -> None:
        """Ping on another thread, with a call that waits for the replica's answer.

        Args:
            is_alive: Returns whether the replica has answered; takes at most `PROBE_S`.
        """

        def ping() -> None:
            if is_alive():
                self.received()

        threading.Thread(target=ping, name="ping", daemon=True).start()

    def _check(self, is_ready: Callable[[float], bool], ping: Callable[[], None] | None) -> None:
        now = time.monotonic()
        self._check_at = now + _CHECK_PERIOD_S
        if now - self._pinged_at >= _PING_PERIOD_S:
            if ping is not None:
                ping()
            self._pinged_at = now
            if self._silent_since is None:
                self._silent_since = now

        # This process itself may have been paused, while the answer was already in the socket.
        is_silent = self._silent_since is not None and not is_ready(0.0)
        if is_silent and self._silent_since is not None and self._on_silence is not None:
            self._on_silence(now - self._silent_since, self.is_proxied)


class Transport(Protocol):
    """Sends requests, one frame at a time, to the replica of a server that `connect` chooses.

    A request contains the id of its session. A session ends with its `close` request or with the
    connection. An error that the server returns is in `Reply.error`. After `close`, `connect` may
    choose another replica.

    Raises:
        PolicyUnavailable: The server cannot be reached or is not ready.
        ConnectionLost: The connection broke after the request was sent, or the client left the
            replica (`ReplicaSilent`).
        DeadlineExceeded: No answer arrived in time.
    """

    @property
    def holds_sessions(self) -> bool:
        """Whether sessions end with the connection."""

    @property
    def name(self) -> str:
        """The name of the transport for users: "shm", "plasma", "websocket", "http" or "handle"."""

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Try once to reach the server, and return the server's metadata."""

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """Send requests as one frame and wait for their replies, in order. No request is ever sent
        twice.
        """

    def close(self) -> None:
        """End the connection."""


class ConnectReport:
    """Logs once, after 2 s of failed attempts to connect, that a server is not ready and that the
    client retries.

    An unknown host name is logged immediately, since it is usually misspelt. The client still
    retries, since the name of a container may be registered later.
    """

    def __init__(self, url: str, timeout_s: float) -> None:
        """Begin a report of attempts to connect that last for `timeout_s` in total."""
        self._url = url
        self._begun, self._timeout_s = time.monotonic(), timeout_s
        self._logged = False

    def failed(self, error: Exception) -> None:
        """Record that an attempt failed and will be repeated."""
        waited_s = time.monotonic() - self._begun
        left_s = self._timeout_s - waited_s
        is_due = waited_s >= _SILENT_S or isinstance(error.__cause__, socket.gaierror)
        if not self._logged and is_due and left_s > 0:
            self._logged = True
            logger.warning(
                "%s: not ready; trying again for up to %.0f s (%s)", self._url, left_s, error
            )


def first_timeout_s(timeout_s: float) -> float:
    """Return the time limit for the first byte of the first replica's answer, s, a part of
    `timeout_s`.

    The time limit of the next replica is twice as long. So each attempt to connect, however short,
    tries at least two replicas, since the first replica may hang.
    """
    return min(_ANSWER_S, timeout_s / 3)


def left_s(deadline: float) -> float:
    """Return the time until a deadline of `time.monotonic`, s. It is at least 1 ms, as 0 means no
    limit in some calls.
    """
    return max(1e-3, deadline - time.monotonic())


def poller_of(connection: socket.socket, event: int) -> select.poll:
    """Return a poller of one socket, for `select.POLLIN` or `POLLOUT`."""
    poller = select.poll()
    poller.register(connection, event)
    return poller


def wait(poller: select.poll, deadline: float) -> None:
    """Sleep until a file of `poller` is ready.

    Raises:
        TimeoutError: The deadline has passed.
    """
    left_s = deadline - time.monotonic()
    if left_s <= 0 or not poller.poll(math.ceil(left_s * 1e3)):
        raise TimeoutError


class CodecChoice:
    """The codec of a connection's camera images. It is the user's choice, or depends on the
    location of the server.

    Within a machine, "auto" and "exact" select raw pixels; over a network, "auto" selects JPEG and
    "exact" PNG. On one core of a server, encoding and decoding JPEG takes 3 ns per byte of pixels,
    and the result has 7 to 10 % of the bytes. So JPEG is faster than raw pixels on networks of up
    to 300 MB/s (2.4 Gbit/s). PNG takes 18 ns, and the result has about half of the bytes.
    """

    def __init__(self, requested: CodecName | ImageCodec) -> None:
        self._compressed = (
            None if isinstance(requested, ImageCodec) else _OVER_A_NETWORK.get(requested)
        )
        self.codec: ImageCodec | None = None  # None until a connection determines the choice
        if isinstance(requested, ImageCodec):
            self.codec = requested
        elif self._compressed is None:
            if requested not in get_args(CodecName):
                raise InvalidInput(
                    f"codec: expected one of {list(get_args(CodecName))}, got {requested!r}"
                )
            self.codec = ImageCodec(requested)

    def connected(self, *, near: bool) -> None:
        """Choose the codec of a new connection; `near`: whether its server is on this machine."""
        if self._compressed is not None:
            self.codec = RAW if near else self._compressed

    def codec_for(self, obs: Obs | None, most_bytes: float = float("inf")) -> ImageCodec:
        """Return the codec for an observation. It is not raw for more than `most_bytes`, unless the
        user chose raw pixels.
        """
        codec = self.codec or RAW
        if self._compressed is not None and obs is not None and codec == RAW:
            size = sum(image.nbytes for image in obs.cameras.values())
            return self._compressed if size > most_bytes else RAW
        return codec
