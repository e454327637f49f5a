"""The common parts of the clients of all protocols."""

from __future__ import annotations

import abc
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.errors import (
    ConnectionLost,
    MalformedMessage,
    PolicyFailed,
    PolicyUnavailable,
    shown,
)
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, MessageLimits
from vlagents_ray.wire.mapping import matches
from vlagents_ray_dialects.messages.outgoing import Outgoing

logger = logging.getLogger(__name__)

# The actions in an answer, (D,) or (H, D), or several such arrays by the upstream's names.
Answer = np.ndarray | Mapping[str, np.ndarray]
_LOGGED = 8000  # maximum number of characters of an upstream's error that are logged


@dataclass(frozen=True, slots=True)
class ClientOptions:
    """The address and the settings of an upstream."""

    url: str
    timeout_s: float  # time without an answer after which the connection counts as lost, s
    key: str | None = field(default=None, repr=False)  # the upstream's API key
    limits: MessageLimits = DEFAULT_LIMITS


class UpstreamClient(abc.ABC):
    """One connection to an upstream, used by one thread at a time."""

    batches: ClassVar[bool] = False  # whether `ask` sends all observations in one message
    # Whether the upstream keeps a session for each connection, unless the deployment says
    # otherwise.
    keeps_sessions: ClassVar[bool] = False
    mapping: ClassVar[str | None] = None
    """The preset that is used if the deployment has no mapping."""
    # The schemes that a URL may have, the usual scheme first.
    schemes: ClassVar[tuple[str, ...]] = ()
    takes_key: ClassVar[bool] = True  # whether the protocol has a field for an API key
    text_key: ClassVar[str] = "task"  # the replacement of `*` in the key of the instruction

    def __init__(self, options: ClientOptions) -> None:
        self.options = options

    @staticmethod
    def is_nested(key: str) -> bool:
        """Return whether a key `a/b` of the mapping means the key `b` within `a`, rather than a
        single key.
        """
        return "/" in key

    @abc.abstractmethod
    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Connect, and return the upstream's metadata; raises `PolicyUnavailable` if it does not
        answer.
        """

    @property
    @abc.abstractmethod
    def is_open(self) -> bool:
        """Whether the connection can be used."""

    @abc.abstractmethod
    def ask(self, observations: Sequence[Mapping[str, Any]]) -> list[Answer]:
        """Return the actions for one observation, or for several if `batches`.

        Raises:
            ConnectionLost: The connection broke, or there was no answer in time; `close` was
                called.
            PolicyFailed: The upstream answered with an error.
            MalformedMessage, MessageTooLarge: Its answer is invalid.
        """

    def begin(self) -> None:  # noqa: B027 - not abstract: a protocol may have no such message
        """Announce the start of an episode, if the protocol can; raises the same errors as
        `ask`.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Close the connection; repeated calls are allowed."""

    def differences(self, metadata: Mapping[str, Any], outgoing: Outgoing) -> list[str]:
        """Return the differences between the upstream's metadata and the mapping, each with its
        cure.

        SGLang ignores a camera that is not in its `image_keys`, and acts as if the robot had no
        such camera. A camera of `image_keys` that the mapping lacks is no difference, as it may be
        missing on purpose.
        """
        upstream_input = metadata.get("input")
        keys = upstream_input.get("image_keys") if isinstance(upstream_input, Mapping) else None
        if not isinstance(keys, list):
            return []

        read_keys: set[str] = set()
        for key in keys:
            read_keys |= {f"{key}", f"images/{key}", f"observation.images.{key}"}

        wrong = []
        for camera in outgoing.mapping.cameras.values():
            sent_key = camera.key.partition("|")[0]
            if not any(matches(read_key, sent_key) for read_key in read_keys):
                wrong.append(sent_key)

        if not wrong:
            return []
        difference = (
            f"cameras: expected {keys}, which the upstream reads, got {wrong} in the mapping; "
            "change mapping.cameras"
        )
        return [difference]

    def chunk(self, metadata: Mapping[str, Any]) -> int | None:
        """Return the number of rows of the upstream's actions; None if the metadata do not contain
        it. SGLang's metadata contain it in `output`.
        """
        output = metadata.get("output")
        rows = (output if isinstance(output, Mapping) else metadata).get("action_horizon")
        return rows if type(rows) is int and rows > 0 else None

    def actions(self, reply: Any) -> np.ndarray:
        """Return the actions in a reply that is a map.

        Raises:
            MalformedMessage: The reply has no array `actions`.
        """
        actions = reply.get("actions") if isinstance(reply, dict) else None
        if not isinstance(actions, np.ndarray):
            content: object = type(reply).__name__
            if isinstance(reply, dict):
                content = sorted(map(str, reply))[:8]
            raise self.unreadable(content, "a map with an array `actions`")
        return actions

    def failed(self, text: object, noun: str = "an error") -> PolicyFailed:
        """Log an error that the upstream sent, and return our error, without the upstream's
        details.

        Args:
            text: The text of the upstream's error.
            noun: A noun for what the upstream sent, for the message.
        """
        logger.error(
            "upstream %s answered with %s: %s", self.options.url, noun, shown(text, _LOGGED)
        )
        return PolicyFailed(
            f"upstream {self.options.url}: it answered with {noun}, whose text the server's log has"
        )

    def closed(self) -> ConnectionLost:
        """Return the error of a request over a closed connection."""
        return ConnectionLost(f"upstream {self.options.url}: the connection is closed")

    def unreachable(self, error: Exception) -> PolicyUnavailable:
        """Return the error of an upstream that does not answer."""
        return PolicyUnavailable(
            f"upstream {self.options.url}: cannot connect ({error}); is it running?"
        )

    def lost(self, reason: object) -> ConnectionLost:
        """Close the connection, and return the error of its loss."""
        self.close()
        if isinstance(reason, TimeoutError):
            reason = f"no answer within {self.options.timeout_s:g} s"
        return ConnectionLost(f"upstream {self.options.url}: {reason}")

    def unreadable(self, content: object, expected: str) -> MalformedMessage:
        """Return the error for an answer that violates the protocol."""
        return MalformedMessage(
            f"upstream {self.options.url}: expected {expected}, got {content}; check whether it "
            "speaks the protocol of the deployment"
        )
