"""Charges of messages to the keys of their senders. Nothing else counts towards the rate of a key.

Each connection and each request over HTTP has an `Account`. A message is charged by
`Account.charge` when its bytes have arrived, before any of them is parsed. The resulting `Charge`
accompanies the message to the engine, which accepts no message without a charge. Endpoints and
dialects therefore count nothing themselves::

    account = Account(caller)  # for as long as the connection is open
    charge = account.charge()  # a message has arrived: its first request is charged
    charge.require()  # raises `TooManyRequests`; decoders call it before they parse anything
    charge.cover(3)  # the message has three requests: the second and the third are charged

The argument of `cover` is the number of all requests in the message; `cover` charges the requests
that were not charged before. Decoders, dialects and the `Sender` therefore call it independently of
each other, and none counts a request twice.

What is charged to the rate of a key:

- A message costs as much as it has requests, but at least one. This includes messages that cannot
  be parsed, probes of the link, and an HTTP request to any path that needs a key.
- A message whose images take more than `REQUEST_DECODING_S` for each of these requests to decode
  costs one request for each `REQUEST_DECODING_S`.
- Closing a session is free, unless the message has no other request.
- A reset that the server adds at the beginning of an episode is free.
- A control frame is free within `CONTROL_FRAMES_PER_S`. Above that rate, the connection costs one
  request, and ends.
- A WebSocket that ends before its first message, or with an invalid frame, costs one request.

A rejected request costs nothing. A limit per key on the number of messages, requests or control
frames belongs here, and then applies at every endpoint. A limit on the content of requests, such as
the size of images, belongs in `vlagents_ray.serve.engine.sender.Sender`, which receives the decoded
requests of every endpoint with their key.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from vlagents_ray.errors import MalformedMessage, TooManyRequests, VLAgentsError
from vlagents_ray.protocol.websocket_frames import CONTROL_FRAMES, CONTROL_FRAMES_PER_S
from vlagents_ray.serve.access.api_keys import Caller, Identity, NoKey
from vlagents_ray.serve.token_bucket import TokenBucket

# Number of consecutive messages over the rate of the key after which a connection ends.
REFUSALS = 8
# Malformed messages of a connection that are answered at once, and further ones of each second. A
# client of this package sends none; without a key, a rate does not limit them.
_MALFORMED = 8
_MALFORMED_PER_S = 10.0
# CPU time of decoding images that a request includes, s. A robot with four cameras of 1920x1080
# needs about half of it.
REQUEST_DECODING_S = 0.1
REFUSED = f"over the rate of its key {REFUSALS} times in a row; send less, or raise the rate"


class Account:
    """The account of one connection, or of one request without a connection.

    It charges to the key of its caller; without a key, everything is free. One thread at a time may
    use it.
    """

    __slots__ = ("_control_frames", "_free", "_malformed", "_refused", "caller")

    def __init__(self, caller: Identity | None = None) -> None:
        """Open the account of a client; `caller` is None until the client is identified."""
        self.caller: Identity | None = None
        self._free: Charge | None = None  # charge of all messages of a client without a key
        self._refused = 0  # number of consecutive messages over the rate
        self._control_frames: TokenBucket | None = None  # created with the first control frame
        self._malformed: TokenBucket | None = None  # created with the first malformed message
        if caller is not None:
            self.identify(caller)

    def identify(self, caller: Identity) -> None:
        """Set the caller, which has sent a valid key or needs no key."""
        self.caller = caller
        self._free = None if isinstance(caller, Caller) else Charge(caller)

    def charge(self) -> Charge:
        """Charge a message that has arrived, and with it its first request.

        Returns:
            The charge, which raises an error when the message is decoded if the key is over its
            rate or no longer valid: the endpoint sends this error in its own protocol.

        Raises:
            TypeError: The client is not identified yet.
        """
        if self._free is not None:
            return self._free
        caller = self.caller
        if not isinstance(caller, Caller):
            raise TypeError(
                f"caller: expected a Caller, or a NoKey if no key is needed, got {caller!r}; "
                "identify the client before its first message"
            )

        try:
            key = caller.take_request()
        except TooManyRequests as error:
            self._refused += 1
            return Charge(caller, refusal=error)
        except VLAgentsError as error:
            return Charge(caller, refusal=error)
        self._refused = 0
        return Charge(caller, is_robot=key.priority != "simulation")

    def charge_control_frame(self) -> None:
        """Count a control frame or a small fragment of a message, either of which takes as long to
        read as a message.

        Raises:
            MalformedMessage: There are too many of them. A request is charged, and the connection
                has to end.
        """
        now = time.monotonic()
        if self._control_frames is None:
            self._control_frames = TokenBucket(CONTROL_FRAMES_PER_S, now, CONTROL_FRAMES)
        if self._control_frames.take(now) > 0:
            self.charge_abuse()
            raise MalformedMessage(
                f"more than {CONTROL_FRAMES} control frames or small fragments at once"
            )

    def charge_abuse(self) -> None:
        """Charge a request for a connection that ends because of an error of its client, or without
        a message.
        """
        if isinstance(self.caller, Caller):
            with contextlib.suppress(VLAgentsError):
                self.caller.take_request()

    def malformed_s(self) -> float:
        """Count a malformed message; return how long the server must not read from the client, s.

        Otherwise a client that repeats malformed messages would take the time of the thread that
        reads them, which also answers robots.
        """
        now = time.monotonic()
        if self._malformed is None:
            self._malformed = TokenBucket(_MALFORMED_PER_S, now, _MALFORMED)
        return self._malformed.take(now)

    @property
    def refused_too_often(self) -> bool:
        """Whether so many consecutive messages were rejected that the connection has to end."""
        return self._refused >= REFUSALS

    def throttled_s(self) -> float:
        """Return how long the server must not read from the client, s; 0 if the key is within its
        rate.

        The pause slows down clients of a key whose messages would be rejected anyway.
        """
        return self.caller.throttled_s() if isinstance(self.caller, Caller) else 0.0

    async def wait_unthrottled(self) -> None:
        """Wait until the server may read from the client."""
        wait_s = self.throttled_s()
        while wait_s > 0:
            await asyncio.sleep(wait_s)
            wait_s = self.throttled_s()


class Charge:
    """The charge of one message: the number of its requests that were charged to the sender's key.
    Not thread-safe.
    """

    __slots__ = ("_charged", "_decoding_s", "_refusal", "caller", "is_robot")

    def __init__(
        self, caller: Identity, *, refusal: VLAgentsError | None = None, is_robot: bool = True
    ) -> None:
        """Create the charge of a message; only an `Account` creates charges.

        Args:
            caller: The sender.
            refusal: The reason why the message is rejected.
            is_robot: Whether the key allows requests with the priority of robots.
        """
        self.is_robot = is_robot
        # The holder of the key that is charged; None without a key.
        self.caller = caller if isinstance(caller, Caller) else None
        self._refusal = refusal
        self._charged = 1.0  # number of requests that were charged to the key
        self._decoding_s = 0.0  # CPU time of decoding the images of the message so far, s

    @property
    def key(self) -> str | None:
        """Name of the key that is charged; None without a key."""
        return None if self.caller is None else self.caller.name

    def require(self) -> None:
        """Raise an error with the reason if the message is rejected. No part of a rejected message
        may be parsed.
        """
        if self._refusal is not None:
            raise self._refusal

    def require_valid(self) -> None:
        """Raise an error if the message is rejected, or its key has become invalid meanwhile."""
        if self.caller is not None:
            self.require()
            self.caller.require()

    def cover(self, requests: int) -> None:
        """Charge the first `requests` requests of the message, except those that were charged
        before.

        Raises:
            TooManyRequests: The key is over its rate; fewer requests are covered.
            Unauthorized: The key has become invalid.
            Forbidden: The key is no longer for this application.
        """
        caller = self.caller
        if caller is None:
            return
        self.require()
        while self._charged < requests:
            caller.take_request()
            self._charged += 1

    def spend(self, seconds: float) -> None:
        """Charge CPU time of decoding the images of the message, s, beyond what the charged
        requests include. The key's next messages wait for it.
        """
        if self.caller is None:
            return
        self._decoding_s += seconds
        more = self._decoding_s / REQUEST_DECODING_S - self._charged
        if more > 0:
            self.caller.owe(more)
            self._charged += more


def free(reason: NoKey) -> Charge:
    """Return the charge of a message for which no key is needed."""
    return Account(reason).charge()


_CHARGE: ContextVar[Charge] = ContextVar("vlagents_ray_charge")


def current_charge() -> Charge:
    """Return the charge of the HTTP request that this task serves.

    Raises:
        LookupError: The task runs outside `charged`.
    """
    return _CHARGE.get()


@contextmanager
def charged(charge: Charge) -> Iterator[None]:
    """Make `charge` the current charge within the context, and in tasks that are started there."""
    token = _CHARGE.set(charge)
    try:
        yield
    finally:
        _CHARGE.reset(token)
