"""What each request and each batch cost: told in the reply, and kept for whoever exports it.

On a request's way this is two readings of the clock and one append; `vlagents_ray.serve.metrics`
takes what was appended out again, on a thread of its own.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

from vlagents_ray.serve.batching import BatchQueue
from vlagents_ray.wire.compact import write_answers
from vlagents_ray.wire.frames import encode_replies
from vlagents_ray.wire.messages import Reply, Request
from vlagents_ray.wire.plain import reply_to_json

T = TypeVar("T")

_KEPT = 20_000  # requests, and batches, between two collections; the oldest are dropped

STAGES = ("decode", "queue", "inference", "encode")
_STAGE_KEYS = [f"{stage}_ms" for stage in STAGES]

Handled = tuple[str, str, str, str, float, float, float, float, float]
"""A request: op, transport, class, "ok" or the error's code, total ms, ms of each of `STAGES`.

Flat and of plain values, which the garbage collector need not look at.
"""

Batch = tuple[int, int]
"""Observations in a forward pass, and rows of it, padding included."""


class Taken(Generic[T]):
    """What a queue holds at this moment, to be taken out of it once."""

    def __init__(self, queue: deque[T]) -> None:
        self._queue = queue
        self._left = len(queue)

    def __len__(self) -> int:
        return self._left

    def __iter__(self) -> Iterator[T]:
        while self._left:
            self._left -= 1
            yield self._queue.popleft()  # never empty: who adds to a full one drops no more than it adds


class Stats:
    """Bounded; keeps nothing until `keep` is called. Any thread may write."""

    def __init__(self) -> None:
        self._handled: deque[Handled] = deque(maxlen=0)
        self._batches: deque[Batch] = deque(maxlen=0)

    def keep(self) -> None:
        """From now on somebody collects."""
        self._handled = deque(maxlen=_KEPT)
        self._batches = deque(maxlen=_KEPT)

    def handled(self, one: Handled) -> None:
        """A request was answered."""
        self._handled.append(one)

    def batch(self, observations: int, rows: int) -> None:
        """A forward pass was made."""
        self._batches.append((observations, rows))

    def collect(self) -> tuple[Taken[Handled], Taken[Batch]]:
        """All since the last time; they leave one by one, as they are looked at."""
        return Taken(self._handled), Taken(self._batches)


class Visit:
    """One frame's way through a door, begun when its last byte is here. Encodes and records its replies."""

    __slots__ = ("_asked", "_decoded", "_stats", "arrived", "transport")

    def __init__(self, stats: Stats, transport: str, op: str = "unknown", rank: str = "robot") -> None:
        self._stats = stats
        self._asked: Sequence[tuple[str, str]] = ((op, rank),)
        self.transport = transport
        self.arrived = self._decoded = time.perf_counter()  # s

    def decoded(self, items: Sequence[Request | Reply]) -> None:
        """The requests are out of their bytes; a `Reply` stands for one that was wrong."""
        self._decoded = time.perf_counter()
        self._asked = [(i.op, i.rank) if isinstance(i, Request) else ("unknown", "robot") for i in items]

    def arrive(self) -> None:
        """Its last byte is here."""
        self.arrived = self._decoded = time.perf_counter()

    def decoded_one(self) -> None:
        """Its one request, of the kind that the visit began with, is out of its bytes."""
        self._decoded = time.perf_counter()

    def frame(self, replies: Sequence[Reply]) -> bytes:
        """The replies as a frame, in which `timing` is complete."""
        self._tell_decoding(replies)
        data = encode_replies(replies, arrived=self.arrived)
        self._record(replies)
        return data

    def packed(self, replies: Sequence[Reply]) -> tuple[bytes, bool]:
        """The replies in compact form if they fit, else as a frame, and whether they did; `timing` is complete."""
        self._tell_decoding(replies)
        compact = write_answers(replies, arrived=self.arrived)
        data = encode_replies(replies, arrived=self.arrived) if compact is None else compact
        self._record(replies)
        return data, compact is not None

    def document(self, reply: Reply) -> bytes:
        """The reply as JSON, in which `timing` is complete; not an error's."""
        begun = time.perf_counter()
        document = reply_to_json(reply)
        document.pop("timing")
        text = _json(document)
        self._written(reply, begun)
        return f'{text[:-1]},"timing":{_json(reply.timing)}}}'.encode()

    def written(self, reply: Reply, write: Callable[[], T]) -> T:
        """What `write` makes of a reply for another system's client, `timing` complete after it; not of an error."""
        begun = time.perf_counter()
        data = write()
        self._written(reply, begun)
        return data

    def refused(self, code: str) -> None:
        """The answer to all of it is the error with this code, or nobody waits for one."""
        total_ms = (time.perf_counter() - self.arrived) * 1e3
        for op, rank in self._asked:
            self._stats.handled((op, self.transport, rank, code, total_ms, 0.0, 0.0, 0.0, 0.0))

    def _written(self, reply: Reply, begun: float) -> None:
        ended = time.perf_counter()
        reply.timing["decode_ms"] = (self._decoded - self.arrived) * 1e3
        reply.timing["encode_ms"] = (ended - begun) * 1e3
        reply.timing["total_ms"] = (ended - self.arrived) * 1e3
        self._record([reply])

    def _tell_decoding(self, replies: Sequence[Reply]) -> None:
        decode_ms = (self._decoded - self.arrived) * 1e3
        for reply in replies:
            if reply.error is None:
                reply.timing["decode_ms"] = decode_ms

    def _record(self, replies: Sequence[Reply]) -> None:
        if len(replies) != len(self._asked):  # the frame was unreadable as a whole
            self._asked = self._asked[:1]
        for (op, rank), reply in zip(self._asked, replies, strict=True):
            get = reply.timing.get
            if reply.error is not None:
                total_ms = (time.perf_counter() - self.arrived) * 1e3
                self._stats.handled((op, self.transport, rank, reply.error.code, total_ms, 0.0, 0.0, 0.0, 0.0))
                continue
            decode, queue, inference, encode = [get(key, 0.0) for key in _STAGE_KEYS]
            total = reply.timing["total_ms"]
            self._stats.handled((op, self.transport, rank, "ok", total, decode, queue, inference, encode))


class Load(NamedTuple):
    """Means since the reading before."""

    utilisation: float  # share of the time in which the policy's thread was not idle, in [0, 1]
    waiting: float  # requests in the queue


class LoadMeter:
    """Load of a queue between one reading and the next; a meter has one reader."""

    def __init__(self, queue: BatchQueue) -> None:
        self._queue = queue
        self._last = (time.perf_counter(), queue.slept_s(), queue.waited_s())

    def read(self) -> Load:
        """Since the last call, or since the meter was made."""
        now = (time.perf_counter(), self._queue.slept_s(), self._queue.waited_s())
        elapsed, slept, waited = (b - a for a, b in zip(self._last, now, strict=True))
        self._last = now
        if elapsed <= 0:
            return Load(0.0, 0.0)
        return Load(min(1.0, max(0.0, 1.0 - slept / elapsed)), max(0.0, waited / elapsed))


def _json(value: dict[str, Any]) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
