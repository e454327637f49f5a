"""Timings of requests and batches: reported in each reply, and buffered for the metrics exporter.

Each request costs two readings of the clock and one addition to a sample. The exporter thread
(`vlagents_ray.serve.replica.metrics`) does as little as possible, since requests may wait while it
holds the interpreter lock.
"""

from __future__ import annotations

import random
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from vlagents_ray.policies.compilation import CudaGraph
from vlagents_ray.serve.in_time import RobotReport
from vlagents_ray.serve.models.loaded_model import GpuWork
from vlagents_ray.serve.requests import IncomingMessage

T = TypeVar("T")

STAGES = ("decode", "queue", "inference", "encode")
# Times of a reply's `timing`: the total, then the stages.
_TIMES = ("total_ms", *(f"{stage}_ms" for stage in STAGES))
_NOT_MEASURED = (0.0,) * len(STAGES)  # stages of a request that failed
SAMPLE = 100  # largest number of values in a sample

Kind = tuple[str, str, str, str]
"""Kind of a request: op, transport, priority, and "ok" or the error's code."""

Times = tuple[float, ...]
"""Durations of a request, ms: the total, and the duration of each stage in `STAGES`."""


class Sample(Generic[T]):
    """The number of added values, and a uniform random sample of at most `SAMPLE` of
    these values.
    """

    __slots__ = ("count", "values")

    def __init__(self) -> None:
        self.count = 0
        self.values: list[T] = []

    def add(self, value: T) -> None:
        """Add a value (Vitter's algorithm R)."""
        self.count += 1
        if self.count <= SAMPLE:
            self.values.append(value)
        else:
            index = int(random.random() * self.count)
            if index < SAMPLE:
                self.values[index] = value


@dataclass(slots=True)
class Collected:
    """The metrics of one collection interval."""

    requests: dict[Kind, Sample[Times]] = field(default_factory=dict)
    batches: Sample[int] = field(default_factory=Sample)  # observations per forward pass
    gpu_ms: Sample[float] = field(default_factory=Sample)  # time of forward passes on the GPU
    padding: int = 0  # number of padding rows in all batches
    out_of_memory: int = 0  # forward passes that did not fit into memory
    replays: int = 0  # replays of CUDA graphs
    # Calls of the policy that exceeded their limit, by op.
    hung: Counter[str] = field(default_factory=Counter)
    # Reports of robots, by priority: ticks, starved ticks, and ages of executed actions, ms.
    ticks: Counter[str] = field(default_factory=Counter)
    starved: Counter[str] = field(default_factory=Counter)
    ages_ms: dict[str, Sample[float]] = field(default_factory=dict)
    # Number of ages that were compared with the tolerance of the policy, and of those within it.
    compared: Counter[str] = field(default_factory=Counter)
    tolerated: Counter[str] = field(default_factory=Counter)


class MetricsBuffer:
    """A bounded buffer of metrics, which records requests and batches only after `enable`.
    Thread-safe.
    """

    def __init__(self) -> None:
        self.gpu_ms: float | None = None  # time of the last forward pass on a GPU
        self._replayed_elsewhere = 0  # number of replays of CUDA graphs in other processes
        # Number of replays of this process before, and of those that were collected; other engines
        # of the process may have been there before.
        self._replayed_before = self._collected_replays = CudaGraph.replays
        self._enabled = False
        self._lock = threading.Lock()
        self._collected = Collected()

    def enable(self) -> None:
        """Start recording requests and batches, which an exporter then collects."""
        self._enabled = True

    def record(self, message: IncomingMessage) -> None:
        """Record the requests of a message, whose replies are encoded with complete `timing`.

        Call this after sending if possible, so that no client waits.
        """
        if not self._enabled:
            return

        kinds = message.kinds
        if len(message.replies) != len(kinds):  # the message was unreadable as a whole
            kinds = kinds[:1]
        for (op, priority), reply in zip(kinds, message.replies, strict=True):
            if reply.error is None:
                # Replies whose total size is too large are sent as errors, without times.
                times = tuple([reply.timing.get(name, 0.0) for name in _TIMES])
                self.handled((op, message.transport, priority, "ok"), times)
            else:
                total_ms = (time.perf_counter() - message.arrived) * 1e3
                kind = (op, message.transport, priority, reply.error.code)
                self.handled(kind, (total_ms, *_NOT_MEASURED))

    def record_failure(self, message: IncomingMessage, code: str) -> None:
        """Record all requests of a message as failed with the given error code, even if the caller
        no longer waits.
        """
        total_ms = (time.perf_counter() - message.arrived) * 1e3
        for op, priority in message.kinds:
            self.handled((op, message.transport, priority, code), (total_ms, *_NOT_MEASURED))

    def handled(self, kind: Kind, times: Times) -> None:
        """Record a request that was answered."""
        if not self._enabled:
            return
        with self._lock:
            sample = self._collected.requests.get(kind)
            if sample is None:
                sample = self._collected.requests[kind] = Sample()
            sample.add(times)

    def report(self, priority: str, report: RobotReport) -> None:
        """Record the report of a robot in a request with the given priority."""
        if not self._enabled:
            return
        with self._lock:
            collected = self._collected
            collected.ticks[priority] += report.ticks
            collected.starved[priority] += report.starved
            if report.age_ms is not None:
                collected.ages_ms.setdefault(priority, Sample()).add(report.age_ms)
            if report.is_tolerated is not None:
                collected.compared[priority] += 1
                collected.tolerated[priority] += report.is_tolerated

    def batch(self, observations: int, rows: int) -> None:
        """Record a forward pass with this number of observations, and this number of rows including
        padding.
        """
        if not self._enabled:
            return
        with self._lock:
            self._collected.batches.add(observations)
            self._collected.padding += rows - observations

    def gpu(self, took_ms: float) -> None:
        """Record the time of a forward pass on the GPU."""
        self.gpu_ms = took_ms
        with self._lock:
            self._collected.gpu_ms.add(took_ms)

    def hung(self, op: str) -> None:
        """Record a call of the policy that has exceeded its limit."""
        with self._lock:
            self._collected.hung[op] += 1

    def out_of_memory(self) -> None:
        """Record a forward pass that did not fit into the accelerator's memory."""
        with self._lock:
            self._collected.out_of_memory += 1

    @property
    def replays(self) -> int:
        """The number of replays of CUDA graphs in all processes of the replica."""
        return CudaGraph.replays - self._replayed_before + self._replayed_elsewhere

    def add_gpu_work(self, work: GpuWork) -> None:
        """Record the GPU work of another process of the replica."""
        if work.last_ms is not None:
            self.gpu_ms = work.last_ms
        with self._lock:
            for took_ms in work.passes_ms:
                self._collected.gpu_ms.add(took_ms)
            self._collected.out_of_memory += work.out_of_memory
            self._collected.replays += work.replays
            self._replayed_elsewhere += work.replays

    def collect(self) -> Collected:
        """Return the metrics recorded since the last call."""
        with self._lock:
            collected, self._collected = self._collected, Collected()
            replays = CudaGraph.replays
            collected.replays += replays - self._collected_replays
            self._collected_replays = replays
        return collected

    def collect_gpu_work(self) -> GpuWork:
        """Return the GPU work of this process since the last call. A child process uses this in
        place of `collect`, for the replica whose policy it runs.
        """
        collected = self.collect()
        return GpuWork(
            passes_ms=collected.gpu_ms.values,
            last_ms=self.gpu_ms,
            out_of_memory=collected.out_of_memory,
            replays=collected.replays,
        )
