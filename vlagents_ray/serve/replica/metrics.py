"""Prometheus metrics of a replica. Ray exports them at the metrics port of the node, with the
prefix `ray_`. `Exporter` creates the series. All series have the tags `application`, `deployment`,
`replica` and `policy`. The tag `transport` is `shm`, `plasma`, `websocket`, `http` or `handle`,
`priority` is `robot` or `simulation`, and `code` is "ok", an error's code or "disconnected".
Latencies are measured for successful requests, and stages for successful acts. Counters are exact.
Histograms use a random sample of up to 100 values per second for each kind of request and for the
batches.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from typing import Any, TypeVar

from ray import serve
from ray.util.metrics import Counter, Gauge, Histogram

from vlagents_ray.serve.access.api_keys import Keys
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.metrics_buffer import STAGES, Collected
from vlagents_ray.serve.periodic import Periodic
from vlagents_ray.serve.queue.batch_queue import LoadMeter

logger = logging.getLogger(__name__)

PERIOD_S = 1.0
_SLICE_S = 50e-6
_PAUSE_S = 300e-6
# Boundaries of histograms of durations, ms.
MS_BOUNDARIES = [
    0.05,
    0.1,
    0.2,
    0.5,
    1.0,
    2.0,
    5.0,
    10.0,
    20.0,
    50.0,
    100.0,
    200.0,
    500.0,
    1000.0,
    2000.0,
    5000.0,
    10_000.0,
]
_SIZES = [1.0, 2.0, 4.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0, 64.0, 128.0, 256.0]
_TRANSPORTS = ("shm", "plasma", "websocket", "http", "handle")

T = TypeVar("T")


class Exporter:
    """Exports an engine's metrics to Ray once per second, on a separate thread, until `close`."""

    def __init__(self, engine: Engine, tags: Mapping[str, str], keys: Keys | None = None) -> None:
        """Create the series of an engine with the `tags` application, deployment, replica and
        policy.

        If there are `keys`, the state of their file is also exported.
        """
        make = partial(series, tags)
        self._engine = engine
        self._requests = make(
            Counter, "requests", "Requests answered.", "op", "transport", "priority", "code"
        )
        self._latency = make(
            Histogram,
            "latency_ms",
            "Server time of a request.",
            "op",
            "transport",
            "priority",
            boundaries=MS_BOUNDARIES,
        )
        self._stage = make(
            Histogram,
            "stage_ms",
            "Time of an act by stage.",
            "stage",
            "transport",
            boundaries=MS_BOUNDARIES,
        )
        self._batch = make(
            Histogram, "batch_size", "Observations in one forward pass.", boundaries=_SIZES
        )
        self._padding = make(
            Counter, "padding_rows", "Rows that filled batches up to a fixed size."
        )
        self._depth = make(Gauge, "queue_depth", "Requests that wait.", "priority")
        self._sessions = make(Gauge, "sessions", "Sessions of the replica.", "transport")
        # Also those that have no session any more, whose value is 0. A dialect is a transport.
        self._transports = set(_TRANSPORTS)
        self._utilisation = make(Gauge, "utilisation", "Busy share of the policy's thread.")
        # These series of a GPU include the work of a policy in a child process. The values of the
        # tag `kind` are allocated, reserved and free.
        self._gpu_memory = make(Gauge, "gpu_memory_bytes", "Memory of the GPU.", "kind")
        self._gpu_ms = make(
            Histogram, "gpu_ms", "Forward pass on the GPU.", boundaries=MS_BOUNDARIES
        )
        self._replays = make(Counter, "graph_replays", "Replays of CUDA graphs.")
        self._version = make(Gauge, "policy_version", "Newest version of the weights.")
        self._hung = make(Counter, "hung_calls", "Calls of the policy over their time limit.", "op")
        self._out_of_memory = make(
            Counter, "out_of_memory", "Forward passes that did not fit into memory."
        )
        self._uncompiled = make(
            Gauge, "uncompiled", "Batch sizes that run without the configured compilation."
        )
        # The next five series describe robots that report their ticks.
        self._ticks = make(
            Counter,
            "ticks",
            "Ticks at which the policy had to act, as reported by robots.",
            "priority",
        )
        self._starved = make(
            Counter,
            "starved_ticks",
            "Ticks without an action in time, as reported by robots.",
            "priority",
        )
        self._executed_age = make(
            Histogram,
            "executed_age_ms",
            "Age of executed actions, as reported by robots.",
            "priority",
            boundaries=MS_BOUNDARIES,
        )
        self._compared_ages = make(
            Counter,
            "compared_ages",
            "Ages of executed actions that were compared with the policy's tolerance.",
            "priority",
        )
        self._beyond_tolerance = make(
            Counter,
            "ages_beyond_tolerance",
            "Ages of executed actions that the policy does not tolerate.",
            "priority",
        )
        self._unreadable = make(
            Gauge, "keys_unreadable_s", "Time in which the key file could not be read."
        )
        self._keys = keys
        self._meter = LoadMeter(engine.queue)
        self._periodic = Periodic(PERIOD_S)

    def start(self) -> None:
        """Make the engine record its metrics, and start to export the metrics."""
        self._engine.stats.enable()
        self._periodic.add(self.export)

    def close(self) -> None:
        """Export the remaining metrics and end the thread."""
        self._periodic.remove(self.export)
        try:
            self.export()
        except Exception:
            logger.exception("the last metrics were not exported")

    def export(self) -> None:
        """Export the metrics since the last call."""
        collected = self._engine.collect_stats()
        self._export_collected(collected)
        self._export_gpu_work(collected)
        for priority, depth in self._engine.queue.depth_by_priority().items():
            self._depth.set(depth, {"priority": priority.name.lower()})
        sessions = self._engine.sessions.by_transport()
        self._transports.update(sessions)
        for transport in self._transports:
            self._sessions.set(sessions.get(transport, 0), {"transport": transport})
        self._utilisation.set(self._meter.read().utilisation)
        self._version.set(self._engine.weights.number)
        self._uncompiled.set(len(self._engine.model.uncompiled))
        for kind, size in self._engine.model.gpu_memory().items():
            self._gpu_memory.set(size, {"kind": kind})

        self._unreadable.set(0.0 if self._keys is None else self._keys.unreadable_s)

    def _export_collected(self, collected: Collected) -> None:
        for (op, transport, priority, code), sample in collected.requests.items():
            tags = {"op": op, "transport": transport, "priority": priority}
            self._requests.inc(sample.count, {**tags, "code": code})
            if code != "ok":
                continue
            for total_ms, *stages in _in_slices(sample.values):
                self._latency.observe(total_ms, tags)
                if op == "act":
                    for stage, stage_ms in zip(STAGES, stages, strict=True):
                        self._stage.observe(stage_ms, {"stage": stage, "transport": transport})
        for observations in _in_slices(collected.batches.values):
            self._batch.observe(observations)
        for op, calls in collected.hung.items():
            self._hung.inc(calls, {"op": op})
        self._export_reports(collected)
        if collected.padding:
            self._padding.inc(collected.padding)

    def _export_reports(self, collected: Collected) -> None:
        """Export the reports of robots."""
        for priority, ticks in collected.ticks.items():
            starved = collected.starved[priority]
            if ticks:  # Ray's counters raise an error for 0
                self._ticks.inc(ticks, {"priority": priority})
            if starved:
                self._starved.inc(starved, {"priority": priority})
        for priority, ages_ms in collected.ages_ms.items():
            for age_ms in _in_slices(ages_ms.values):
                self._executed_age.observe(age_ms, {"priority": priority})
        for priority, compared in collected.compared.items():
            self._compared_ages.inc(compared, {"priority": priority})
            beyond = compared - collected.tolerated[priority]
            if beyond:
                self._beyond_tolerance.inc(beyond, {"priority": priority})

    def _export_gpu_work(self, collected: Collected) -> None:
        for took_ms in _in_slices(collected.gpu_ms.values):
            self._gpu_ms.observe(took_ms)
        if collected.out_of_memory:
            self._out_of_memory.inc(collected.out_of_memory)
        if collected.replays:
            self._replays.inc(collected.replays)


def series(
    tags: Mapping[str, str], series_class: Any, name: str, text: str, *tag_keys: str, **options: Any
) -> Any:
    """Create a series of a replica, with the prefix `vlagents_`.

    Args:
        tags: The tags of the replica, such as `PartContext.metric_tags`.
        series_class: The class in `ray.util.metrics`.
        name: The name of the series without the prefix.
        text: The description of the series.
        tag_keys: The names of further tags, whose values are set with each measurement.
        options: Further arguments of `series_class`, such as the `boundaries` of a histogram.
    """
    created = series_class(
        f"vlagents_{name}", description=text, tag_keys=(*tags, *tag_keys), **options
    )
    return created.set_default_tags(dict(tags))


def _in_slices(values: Iterable[T]) -> Iterator[T]:
    """Yield each value, with short pauses, so that the policy's thread never waits long for the
    interpreter's lock.
    """
    until = time.perf_counter() + _SLICE_S
    for value in values:
        yield value
        if time.perf_counter() > until:
            time.sleep(_PAUSE_S)
            until = time.perf_counter() + _SLICE_S


def tags_of(policy: str) -> dict[str, str]:
    """Return the tags of Serve's own metrics and the policy's name."""
    context = serve.get_replica_context()
    return {
        "application": context.app_name,
        "deployment": context.deployment,
        "replica": context.replica_tag,
        "policy": policy,
    }
