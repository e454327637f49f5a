"""A span for each message of a `RemoteAgent`, which the server's spans belong to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from vlagents_ray.registry import require
from vlagents_ray.tracing import TRACEPARENT

if TYPE_CHECKING:
    from vlagents_ray.client.connection import Connection
    from vlagents_ray.client.session import ClientSession
    from vlagents_ray.protocol.messages import Reply, Request

Call = Callable[[Sequence["ClientSession"], Sequence["Request"], float], list["Reply"]]


def traced(tracer: Any, connection: Connection, call: Call) -> Call:
    """Return `call` with a span around it, below the caller's own span if there is one.

    Args:
        tracer: The tracer of the process.
        connection: The connection that sends the requests.
        call: Sends one request of each of several sessions, and returns their replies.
    """
    trace = require("opentelemetry.trace", extra="otel")
    propagator = require("opentelemetry.trace.propagation.tracecontext", extra="otel").TraceContextTextMapPropagator()

    def with_span(sessions: Sequence[ClientSession], requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        about = {"server.url": connection.url, "transport": connection.transport.name, "requests": len(requests)}
        name = f"vlagents {requests[0].op}"
        with tracer.start_as_current_span(name, kind=trace.SpanKind.CLIENT, attributes=about) as span:
            carrier: dict[str, str] = {}
            propagator.inject(carrier)
            for request in requests:
                if request.obs is not None:
                    info = {**request.obs.info, TRACEPARENT: carrier[TRACEPARENT]}
                    request.obs = replace(request.obs, info=info)
            replies = call(sessions, requests, timeout_s)
            if failed := [reply.error for reply in replies if reply.error is not None]:
                span.set_status(trace.StatusCode.ERROR, f"{failed[0].code}: {failed[0]}")
            return replies

    return with_span
