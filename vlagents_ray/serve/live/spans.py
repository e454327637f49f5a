"""OpenTelemetry spans of the requests of a replica: from arrival to answer, decoding, queue, and batch."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from vlagents_ray import tracing
from vlagents_ray.images.codecs import DecodedFiles
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.registry import require
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.responses import Done
from vlagents_ray.serve.periodic import each_half_second

_KEPT = 4096  # most answers between two half seconds; older ones have no spans
_STAGES = ("queue", "inference")  # one after the other, from the end of decoding on
_OPS = ("act", "reset")
_TEXT = 200  # most characters of an error, or of what a client states


class _ServedRequest(NamedTuple):
    """What is kept of a request and its answer: nothing that its client may make large."""

    session: str
    op: str
    rank: str
    traceparent: str
    timing: Mapping[str, float]  # ms by stage; still completed when the answer was sent
    error: str
    decoded_ns: int  # since 1970: when the request was read
    answered_ns: int


class RequestSpans:
    """Makes the spans of the requests that it sees, twice a second and on a thread of its own."""

    def __init__(self, engine: Engine, tracer: Any, replica: str) -> None:
        """Trace the requests of `engine` by `tracer`, as those of the replica of this name."""
        self._engine = engine
        self._tracer = tracer
        self._replica = replica
        self._answered: deque[_ServedRequest] = deque(maxlen=_KEPT)
        self._trace = require("opentelemetry.trace", extra="otel")
        module = require("opentelemetry.trace.propagation.tracecontext", extra="otel")
        self._propagator = module.TraceContextTextMapPropagator()

    def open(self) -> None:
        """Begin to see requests."""
        self._engine.observers.add(self)
        each_half_second.add(self.export)

    def close(self) -> None:
        """See no more, and export the last spans."""
        self._engine.observers.remove(self)
        each_half_second.remove(self.export)
        self.export()
        tracing.flush()

    def note(self, sessions: Sequence[str], items: Sequence[Request | Reply], files: DecodedFiles, done: Done) -> Done:
        """Return `done`, which then also keeps the answers (see `Watcher`)."""
        decoded_ns = time.time_ns()
        traced = [None if isinstance(item, Reply) else _traceparent(item) for item in items]

        def answer(replies: list[Reply]) -> None:
            done(replies)
            now_ns = time.time_ns()
            for session, item, parent, reply in zip(sessions, items, traced, replies, strict=True):
                if isinstance(item, Request) and parent is not None and item.op in _OPS:
                    error = "" if reply.error is None else f"{reply.error.code}: {reply.error}"[:_TEXT]
                    self._answered.append(
                        _ServedRequest(session, item.op, item.rank, parent, reply.timing, error, decoded_ns, now_ns)
                    )

        return answer

    def export(self) -> None:
        """Make the spans of the answers since the last call, whose timing is complete by now."""
        while self._answered:
            self._make(self._answered.popleft())

    def _make(self, one: _ServedRequest) -> None:
        timing = one.timing
        begun_ns = one.decoded_ns - _ns(timing.get("decode_ms", 0.0))
        about: dict[str, str | int] = {"replica": self._replica, "session": one.session, "rank": one.rank}
        if "batch_size" in timing:
            about["batch_size"] = int(timing["batch_size"])
        parent = self._propagator.extract({tracing.TRACEPARENT: one.traceparent}) if one.traceparent else None
        name, kind = f"vlagents {one.op}", self._trace.SpanKind.SERVER
        whole = self._tracer.start_span(name, parent, kind=kind, attributes=about, start_time=begun_ns)
        if one.error:
            whole.set_status(self._trace.StatusCode.ERROR, one.error)
        inside = self._trace.set_span_in_context(whole, parent)
        self._stage("decode", inside, begun_ns, one.decoded_ns)
        at_ns = one.decoded_ns
        for stage in _STAGES:
            if f"{stage}_ms" in timing:
                ended_ns = at_ns + _ns(timing[f"{stage}_ms"])
                self._stage("batch" if stage == "inference" else stage, inside, at_ns, ended_ns)
                at_ns = ended_ns
        encoded_ns = one.answered_ns + _ns(timing.get("encode_ms", 0.0))
        self._stage("encode", inside, one.answered_ns, encoded_ns)
        whole.end(encoded_ns)

    def _stage(self, name: str, inside: Any, begun_ns: int, ended_ns: int) -> None:
        self._tracer.start_span(name, inside, start_time=begun_ns).end(ended_ns)


def open_spans(engine: Engine, replica: str) -> RequestSpans | None:
    """Trace the requests of a replica if the environment asks for it."""
    tracer = tracing.tracer()
    if tracer is None:
        return None
    spans = RequestSpans(engine, tracer, replica)
    spans.open()
    return spans


def _traceparent(request: Request) -> str:
    """Return the trace that a request states, which may come from anybody; "" if it states none."""
    stated = "" if request.obs is None else request.obs.info.get(tracing.TRACEPARENT, "")
    return stated[:_TEXT] if isinstance(stated, str) else ""


def _ns(milliseconds: float) -> int:
    return int(milliseconds * 1e6)
