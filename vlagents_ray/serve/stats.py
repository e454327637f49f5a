"""What each request and each batch cost: told in the reply, and kept for whoever exports it.

On a request's way this is two readings of the clock and one addition to a sample; `vlagents_ray.serve.metrics`, on a
thread of its own, has little left to do: each time it takes the interpreter, a request may wait for it.
"""

from __future__ import annotations

import json
import random
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, NamedTuple, TypeVar

from vlagents_ray.serve.batching import BatchQueue
from vlagents_ray.wire.compact import write_answers
from vlagents_ray.wire.frames import encode_replies
from vlagents_ray.wire.messages import Reply, Request
from vlagents_ray.wire.plain import reply_to_json

T = TypeVar("T")

STAGES = ("decode", "queue", "inference", "encode")
_STAGE_KEYS = [f"{stage}_ms" for stage in STAGES]
_NOTHING = (0.0,) * len(STAGES)
SAMPLE = 100

Kind = tuple[str, str, str, str]
"""Of requests: op, transport, class, "ok" or the error's code."""

Times = tuple[float, ...]
"""Of a request, in ms: in all, and in each of `STAGES`."""


class Sample(Generic[T]):
    """How many values there were, and up to `SAMPLE` of them, each as likely to be there as any other."""

    __slots__ = ("seen", "values")

    def __init__(self) -> None:
        self.seen = 0
        self.values: list[T] = []

    def add(self, value: T) -> None:
        """One more (Vitter's algorithm R)."""
        self.seen += 1
        if self.seen <= SAMPLE:
            self.values.append(value)
        elif (place := int(random.random() * self.seen)) < SAMPLE:
            self.values[place] = value


@dataclass(slots=True)
class Collected:
    """What was handled in a while."""

    requests: dict[Kind, Sample[Times]] = field(default_factory=dict)
    batches: Sample[int] = field(default_factory=Sample)  # observations in a forward pass
    padding: int = 0  # rows that filled batches up


class Stats:
    """Bounded; keeps nothing until `keep` is called. Any thread may write."""

    def __init__(self) -> None:
        self._kept = False
        self._lock = threading.Lock()
        self._collected = Collected()

    def keep(self) -> None:
        """From now on somebody collects."""
        self._kept = True

    def handled(self, kind: Kind, times: Times) -> None:
        """A request was answered."""
        if not self._kept:
            return
        with self._lock:
            sample = self._collected.requests.get(kind)
            if sample is None:
                sample = self._collected.requests[kind] = Sample()
            sample.add(times)

    def batch(self, observations: int, rows: int) -> None:
        """A forward pass was made of so many rows, padding included."""
        if not self._kept:
            return
        with self._lock:
            self._collected.batches.add(observations)
            self._collected.padding += rows - observations

    def collect(self) -> Collected:
        """All since the last time."""
        with self._lock:
            collected, self._collected = self._collected, Collected()
        return collected


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
        self.record(replies)
        return data

    def packed(self, replies: Sequence[Reply]) -> tuple[bytes, bool]:
        """The replies in compact form if they fit, else as a frame, and whether they did; `timing` is complete.

        `record` them once they are on their way.
        """
        self._tell_decoding(replies)
        compact = write_answers(replies, arrived=self.arrived)
        data = encode_replies(replies, arrived=self.arrived) if compact is None else compact
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
            self._stats.handled((op, self.transport, rank, code), (total_ms, *_NOTHING))

    def _written(self, reply: Reply, begun: float) -> None:
        ended = time.perf_counter()
        reply.timing["decode_ms"] = (self._decoded - self.arrived) * 1e3
        reply.timing["encode_ms"] = (ended - begun) * 1e3
        reply.timing["total_ms"] = (ended - self.arrived) * 1e3
        self.record([reply])

    def _tell_decoding(self, replies: Sequence[Reply]) -> None:
        decode_ms = (self._decoded - self.arrived) * 1e3
        for reply in replies:
            if reply.error is None:
                reply.timing["decode_ms"] = decode_ms

    def record(self, replies: Sequence[Reply]) -> None:
        """Keep what is kept of the requests; after their answer is sent where that can be, as nobody waits then."""
        if len(replies) != len(self._asked):  # the frame was unreadable as a whole
            self._asked = self._asked[:1]
        for (op, rank), reply in zip(self._asked, replies, strict=True):
            if reply.error is None:
                times = (reply.timing["total_ms"], *[reply.timing.get(key, 0.0) for key in _STAGE_KEYS])
                self._stats.handled((op, self.transport, rank, "ok"), times)
            else:
                total_ms = (time.perf_counter() - self.arrived) * 1e3
                self._stats.handled((op, self.transport, rank, reply.error.code), (total_ms, *_NOTHING))


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
