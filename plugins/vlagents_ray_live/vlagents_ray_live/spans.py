"""OpenTelemetry spans of the requests of a replica: from arrival to answer, decoding, queue, and
batch.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

from vlagents_ray import tracing
from vlagents_ray.protocol.messages import Reply
from vlagents_ray.registry import require
from vlagents_ray.serve.engine.observer import Observer
from vlagents_ray.serve.periodic import each_half_second
from vlagents_ray.serve.replica.part import ReplicaPart
from vlagents_ray.serve.requests import PendingRequest

_KEPT = 4096  # maximum number of answers per half second; older ones get no spans
# Stages in order, after decoding, and names of their spans.
_STAGES = {"queue": "queue", "inference": "batch"}
_OPS = ("act", "reset")
_TEXT = 200  # maximum length of an error, or of a client's text


class _ServedRequest(NamedTuple):
    """The kept data of a request and its answer, of bounded size."""

    session: str
    op: str
    priority: str
    traceparent: str
    decoded_ns: int  # time at which the request was decoded, ns since 1970
    timing: Mapping[str, float]  # ms by stage; completed when the answer was sent
    error: str
    answered_ns: int


class RequestSpans(Observer):
    """Creates spans of requests, twice a second and on its own thread, until `close`."""

    def __init__(self, tracer: Any, replica: str) -> None:
        """Trace requests with `tracer`, under the replica's name."""
        self._tracer, self._replica = tracer, replica
        self._answered: deque[_ServedRequest] = deque(maxlen=_KEPT)
        self._trace = require("opentelemetry.trace", extra="otel")
        module = require("opentelemetry.trace.propagation.tracecontext", extra="otel")
        self._propagator = module.TraceContextTextMapPropagator()
        each_half_second.add(self.export)

    def close(self) -> None:
        """Export the last spans, and end."""
        each_half_second.remove(self.export)
        self.export()
        tracing.flush()

    def on_request(self, pending: PendingRequest) -> None:
        """Store the start of the request."""
        if pending.request.op in _OPS:
            obs = pending.request.obs
            # The client's value is untrusted.
            traceparent = "" if obs is None else obs.info.get(tracing.TRACEPARENT, "")
            if not isinstance(traceparent, str):
                traceparent = ""
            pending.observer_data[self] = traceparent[:_TEXT], time.time_ns()

    def on_answer(self, pending: PendingRequest, reply: Reply) -> None:
        """Export the span of the answered request."""
        begun: tuple[str, int] | None = pending.observer_data.pop(self, None)
        if begun is not None:
            about = pending.session_id, pending.request.op, pending.priority.name.lower()
            error = "" if reply.error is None else f"{reply.error.code}: {reply.error}"[:_TEXT]
            self._answered.append(
                _ServedRequest(*about, *begun, reply.timing, error, time.time_ns())
            )

    def export(self) -> None:
        """Create the spans of the answers since the last call, whose timing is complete by now."""
        while self._answered:
            self._make(self._answered.popleft())

    def _make(self, served: _ServedRequest) -> None:
        """Create the span of a request, and within it the spans of its stages."""
        timing = served.timing
        begun_ns = served.decoded_ns - _ns(timing.get("decode_ms", 0.0))
        attributes: dict[str, str | int] = {
            "replica": self._replica,
            "session": served.session,
            "priority": served.priority,
        }
        if "batch_size" in timing:
            attributes["batch_size"] = int(timing["batch_size"])

        parent = None
        if served.traceparent:
            parent = self._propagator.extract({tracing.TRACEPARENT: served.traceparent})

        request_span = self._tracer.start_span(
            f"vlagents {served.op}",
            parent,
            kind=self._trace.SpanKind.SERVER,
            attributes=attributes,
            start_time=begun_ns,
        )
        if served.error:
            request_span.set_status(self._trace.StatusCode.ERROR, served.error)

        inside = self._trace.set_span_in_context(request_span, parent)
        self._stage("decode", inside, begun_ns, served.decoded_ns)
        at_ns = served.decoded_ns
        for stage, span in _STAGES.items():
            if f"{stage}_ms" in timing:
                ended_ns = at_ns + _ns(timing[f"{stage}_ms"])
                self._stage(span, inside, at_ns, ended_ns)
                at_ns = ended_ns

        encoded_ns = served.answered_ns + _ns(timing.get("encode_ms", 0.0))
        self._stage("encode", inside, served.answered_ns, encoded_ns)
        request_span.end(encoded_ns)

    def _stage(self, name: str, inside: Any, begun_ns: int, ended_ns: int) -> None:
        self._tracer.start_span(name, inside, start_time=begun_ns).end(ended_ns)


class Spans(ReplicaPart):
    """Creates spans of requests if the environment of the replica enables traces, see
    `vlagents_ray.tracing`.
    """

    def observer(self) -> RequestSpans | None:
        """Return the observer of requests; None without traces."""
        tracer = tracing.tracer()
        return None if tracer is None else RequestSpans(tracer, self.context.short_name)


def _ns(milliseconds: float) -> int:
    return int(milliseconds * 1e6)
