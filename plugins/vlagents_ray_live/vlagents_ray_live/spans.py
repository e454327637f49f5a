"""OpenTelemetry spans of the requests of a replica, from arrival to answer, with spans of decoding,
queue, batch and encoding.
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

# Maximum number of answers with spans in half a second; older answers beyond it have none.
_KEPT = 4096
# The stages in order, after decoding, and the names of their spans.
_STAGES = {"queue": "queue", "inference": "batch"}
_OPS = ("act", "reset")  # the requests that have spans
_TEXT = 200  # maximum length of an error, or of a client's text, characters


class _ServedRequest(NamedTuple):
    """The data that are kept for a request and its answer, of bounded size."""

    session: str
    op: str
    priority: str
    traceparent: str  # the client's span, in W3C's format; empty if unknown
    decoded_ns: int  # the time at which the request was decoded, ns since 1970
    timing: Mapping[str, float]  # ms by stage; completed when the answer is sent
    error: str  # the code of an error; empty without an error
    answered_ns: int  # the time at which the answer was sent, ns since 1970


class RequestSpans(Observer):
    """Creates spans of requests, twice a second and on its own thread, until `close`.

    Args:
        tracer: The tracer of OpenTelemetry.
        replica: The name of the replica.
    """

    def __init__(self, tracer: Any, replica: str) -> None:
        self._tracer = tracer
        self._replica = replica
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
        if pending.request.op not in _OPS:
            return
        obs = pending.request.obs
        traceparent = "" if obs is None else obs.info.get(tracing.TRACEPARENT, "")
        if not isinstance(traceparent, str):  # the client may send a value of any type
            traceparent = ""
        # The durations of the stages count from this time. The observer may be called later.
        pending.observer_data[self] = traceparent[:_TEXT], _since_1970_ns(pending.arrived)

    def on_answer(self, pending: PendingRequest, reply: Reply) -> None:
        """Keep the data of the answered request for `export`."""
        begun: tuple[str, int] | None = pending.observer_data.pop(self, None)
        if begun is None:
            return
        traceparent, decoded_ns = begun
        served = _ServedRequest(
            session=pending.session_id,
            op=pending.request.op,
            priority=pending.priority.name.lower(),
            traceparent=traceparent,
            decoded_ns=decoded_ns,
            timing=reply.timing,
            error="" if reply.error is None else f"{reply.error.code}: {reply.error}"[:_TEXT],
            answered_ns=time.time_ns(),
        )
        self._answered.append(served)

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

        context = self._trace.set_span_in_context(request_span, parent)
        self._make_stage("decode", context, begun_ns, served.decoded_ns)
        stage_begun_ns = served.decoded_ns
        for stage, span_name in _STAGES.items():
            if f"{stage}_ms" in timing:
                ended_ns = stage_begun_ns + _ns(timing[f"{stage}_ms"])
                self._make_stage(span_name, context, stage_begun_ns, ended_ns)
                stage_begun_ns = ended_ns

        encoded_ns = served.answered_ns + _ns(timing.get("encode_ms", 0.0))
        self._make_stage("encode", context, served.answered_ns, encoded_ns)
        request_span.end(encoded_ns)

    def _make_stage(self, name: str, context: Any, begun_ns: int, ended_ns: int) -> None:
        """Create the span of a stage within the span of its request."""
        self._tracer.start_span(name, context, start_time=begun_ns).end(ended_ns)


class Spans(ReplicaPart):
    """Creates spans of requests if the environment of the replica enables traces, see
    `vlagents_ray.tracing`.
    """

    def observer(self) -> RequestSpans | None:
        """Return the observer of requests; None without traces."""
        tracer = tracing.tracer()
        return None if tracer is None else RequestSpans(tracer, self.context.short_name)


def _since_1970_ns(at: float) -> int:
    """Return a past time of `time.perf_counter`, s, as ns since 1970."""
    now_ns, now = time.time_ns(), time.perf_counter()
    return now_ns - int((now - at) * 1e9)


def _ns(milliseconds: float) -> int:
    """Convert milliseconds to nanoseconds."""
    return int(milliseconds * 1e6)
