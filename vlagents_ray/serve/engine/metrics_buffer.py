"""Timings of requests and batches: reported in each reply, and buffered for the metrics exporter.

Per request this costs two readings of the clock and one addition to a sample. The exporter thread
(`vlagents_ray.serve.replica.metrics`) has little left to do: while it holds the interpreter lock, requests may wait.
"""

from __future__ import annotations

import json
import random
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, NamedTuple, TypeVar

from vlagents_ray.protocol.frames import encode_replies
from vlagents_ray.protocol.json_messages import reply_to_json
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.protocol.shm_layout import write_answers
from vlagents_ray.serve.queue.batch_queue import BatchQueue

T = TypeVar("T")

STAGES = ("decode", "queue", "inference", "encode")
_NOTHING = (0.0,) * len(STAGES)
SAMPLE = 100  # largest number of values in a sample

Kind = tuple[str, str, str, str]
"""Kind of a request: op, transport, class, and "ok" or the error's code."""

Times = tuple[float, ...]
"""Durations of a request, ms: in total, and in each of `STAGES`."""


class Sample(Generic[T]):
    """The number of values added, and a uniform random sample of up to `SAMPLE` of them."""

    __slots__ = ("seen", "values")

    def __init__(self) -> None:
        self.seen = 0
        self.values: list[T] = []

    def add(self, value: T) -> None:
        """Add a value (Vitter's algorithm R)."""
        self.seen += 1
        if self.seen <= SAMPLE:
            self.values.append(value)
        elif (place := int(random.random() * self.seen)) < SAMPLE:
            self.values[place] = value


@dataclass(slots=True)
class Collected:
    """The metrics of one collection interval."""

    requests: dict[Kind, Sample[Times]] = field(default_factory=dict)
    batches: Sample[int] = field(default_factory=Sample)  # observations per forward pass
    padding: int = 0  # number of padding rows in all batches
    out_of_memory: int = 0  # forward passes that did not fit into memory
    hung: Counter[str] = field(default_factory=Counter)  # calls of the policy that exceeded their limit, by op


class MetricsBuffer:
    """A bounded buffer of metrics, which records requests and batches only after `enable`. Thread-safe."""

    def __init__(self) -> None:
        self._enabled = False
        self._lock = threading.Lock()
        self._collected = Collected()

    def enable(self) -> None:
        """Start recording requests and batches, since an exporter will collect them."""
        self._enabled = True

    def handled(self, kind: Kind, times: Times) -> None:
        """Record a request that was answered."""
        if not self._enabled:
            return
        with self._lock:
            sample = self._collected.requests.get(kind)
            if sample is None:
                sample = self._collected.requests[kind] = Sample()
            sample.add(times)

    def batch(self, observations: int, rows: int) -> None:
        """Record a forward pass with this number of observations, and of rows including padding."""
        if not self._enabled:
            return
        with self._lock:
            self._collected.batches.add(observations)
            self._collected.padding += rows - observations

    def hung(self, op: str) -> None:
        """Record a call of the policy that has exceeded its limit."""
        with self._lock:
            self._collected.hung[op] += 1

    def out_of_memory(self) -> None:
        """Record a forward pass that did not fit into the accelerator's memory."""
        with self._lock:
            self._collected.out_of_memory += 1

    def collect(self) -> Collected:
        """Return the metrics recorded since the last call."""
        with self._lock:
            collected, self._collected = self._collected, Collected()
        return collected


class RequestTrace:
    """Times one frame from the arrival of its last byte; encodes and records its replies.

    Args:
        stats: Buffer for the metrics.
        transport: Name of the transport.
        op: Operation of the frame's one request, if it is known before decoding.
        rank: Class of that request.
    """

    __slots__ = ("_asked", "_decoded", "_stats", "arrived", "transport")

    def __init__(self, stats: MetricsBuffer, transport: str, op: str = "unknown", rank: str = "robot") -> None:
        self._stats = stats
        self._asked: Sequence[tuple[str, str]] = ((op, rank),)
        self.transport = transport
        self.arrived = self._decoded = time.perf_counter()  # s

    def decoded(self, items: Sequence[Request | Reply]) -> None:
        """Record that the requests are decoded; a `Reply` takes the place of an invalid one."""
        self._decoded = time.perf_counter()
        self._asked = [(i.op, i.rank) if isinstance(i, Request) else ("unknown", "robot") for i in items]

    def arrive(self) -> None:
        """Record that the last byte of the frame has arrived."""
        self.arrived = self._decoded = time.perf_counter()

    def decoded_alike(self, requests: int = 1) -> None:
        """Record that the frame's requests, all of the `op` and `rank` given before, are decoded."""
        self._decoded = time.perf_counter()
        self._asked = [self._asked[0]] * requests

    def frame(self, replies: Sequence[Reply]) -> bytes:
        """Encode and record the replies as a frame with complete `timing`."""
        self._set_decode_ms(replies)
        data = encode_replies(replies, arrived=self.arrived)
        self.record(replies)
        return data

    def packed(self, replies: Sequence[Reply]) -> tuple[bytes, bool]:
        """Encode the replies with complete `timing`; call `record` after they are sent.

        Returns:
            The replies in compact form if they fit into that, otherwise as a frame; and whether they are compact.
        """
        self._set_decode_ms(replies)
        compact = write_answers(replies, arrived=self.arrived)
        data = encode_replies(replies, arrived=self.arrived) if compact is None else compact
        return data, compact is not None

    def document(self, reply: Reply) -> bytes:
        """Encode and record the reply, which must not be an error, as JSON with complete `timing`."""
        begun = time.perf_counter()
        document = reply_to_json(reply)
        document.pop("timing")
        text = _json(document)
        self._written([reply], begun)
        return f'{text[:-1]},"timing":{_json(reply.timing)}}}'.encode()

    def written(self, replies: Reply | Sequence[Reply], write: Callable[[], T]) -> T:
        """Encode replies, none an error, with `write` for a client of another system, and record them.

        The `timing` of a reply is complete only afterwards.
        """
        begun = time.perf_counter()
        data = write()
        self._written([replies] if isinstance(replies, Reply) else replies, begun)
        return data

    def refused(self, code: str) -> None:
        """Record all requests of the frame as failed with this error code, also if the caller no longer waits."""
        total_ms = (time.perf_counter() - self.arrived) * 1e3
        for op, rank in self._asked:
            self._stats.handled((op, self.transport, rank, code), (total_ms, *_NOTHING))

    def _written(self, replies: Sequence[Reply], begun: float) -> None:
        ended = time.perf_counter()
        self._set_decode_ms(replies)
        for reply in replies:
            reply.timing["encode_ms"] = (ended - begun) * 1e3
            reply.timing["total_ms"] = (ended - self.arrived) * 1e3
        self.record(replies)

    def _set_decode_ms(self, replies: Sequence[Reply]) -> None:
        decode_ms = (self._decoded - self.arrived) * 1e3
        for reply in replies:
            if reply.error is None:
                reply.timing["decode_ms"] = decode_ms

    def record(self, replies: Sequence[Reply]) -> None:
        """Record the requests; called after the replies are sent where possible, so that the client does not wait."""
        if len(replies) != len(self._asked):  # the frame was unreadable as a whole
            self._asked = self._asked[:1]
        for (op, rank), reply in zip(self._asked, replies, strict=True):
            if reply.error is None:
                timing = reply.timing
                decode_ms, queue_ms = timing.get("decode_ms", 0.0), timing.get("queue_ms", 0.0)
                inference_ms, encode_ms = timing.get("inference_ms", 0.0), timing.get("encode_ms", 0.0)
                times = (timing["total_ms"], decode_ms, queue_ms, inference_ms, encode_ms)  # in the order of `STAGES`
                self._stats.handled((op, self.transport, rank, "ok"), times)
            else:
                total_ms = (time.perf_counter() - self.arrived) * 1e3
                self._stats.handled((op, self.transport, rank, reply.error.code), (total_ms, *_NOTHING))


class QueueLoad(NamedTuple):
    """Mean load of a queue since the last reading."""

    utilisation: float  # share of the time in which the policy's thread was busy, in [0, 1]
    waiting: float  # mean number of requests in the queue


class LoadMeter:
    """Measures the load of a queue between two readings; each reader needs a meter."""

    def __init__(self, queue: BatchQueue) -> None:
        self._queue = queue
        self._last = (time.perf_counter(), queue.idle_time_s(), queue.waited_s())

    def read(self) -> QueueLoad:
        """Return the mean load since the last call, or since the meter was created."""
        now = (time.perf_counter(), self._queue.idle_time_s(), self._queue.waited_s())
        elapsed, idle, waited = (b - a for a, b in zip(self._last, now, strict=True))
        self._last = now
        if elapsed <= 0:
            return QueueLoad(0.0, 0.0)
        return QueueLoad(min(1.0, max(0.0, 1.0 - idle / elapsed)), max(0.0, waited / elapsed))


def _json(value: dict[str, Any]) -> str:
    return json.dumps(value, allow_nan=False, separators=(",", ":"))
