"""OpenTelemetry tracing of this process, if environment variables enable it; needs the extra
"otel".

`VLAGENTS_RAY_OTEL=1` turns tracing on, both in a client's process and in a server's. A request
carries its trace in the observation's `info["traceparent"]`, in the format of
https://www.w3.org/TR/trace-context/, over every transport. The spans go to the program's own tracer
provider if the program has set one; otherwise to an OTLP exporter, which OpenTelemetry's
environment variables configure (`OTEL_EXPORTER_OTLP_ENDPOINT`, `OTEL_SERVICE_NAME`,
`OTEL_TRACES_SAMPLER`).
"""

from __future__ import annotations

import functools
import os
from typing import Any

from vlagents_ray.registry import require

VARIABLE = "VLAGENTS_RAY_OTEL"
TRACEPARENT = "traceparent"


def tracer() -> Any | None:
    """Return the tracer of this process; None unless `VLAGENTS_RAY_OTEL` enables tracing.

    Raises:
        MissingDependency: The extra "otel" is not installed.
    """
    if os.environ.get(VARIABLE, "0") in {"", "0"}:
        return None
    return _provider().get_tracer("vlagents_ray")


def flush() -> None:
    """Export the spans that have ended."""
    if hasattr(_provider(), "force_flush"):
        _provider().force_flush()


@functools.cache
def _provider() -> Any:
    """Return the tracer provider that the program has set, or else a new one with an exporter."""
    program_provider = require("opentelemetry.trace", extra="otel").get_tracer_provider()
    sdk = require("opentelemetry.sdk.trace", extra="otel")
    if isinstance(program_provider, sdk.TracerProvider):
        return program_provider

    export = require("opentelemetry.sdk.trace.export", extra="otel")
    otlp = require("opentelemetry.exporter.otlp.proto.http.trace_exporter", extra="otel")
    provider = sdk.TracerProvider()
    provider.add_span_processor(export.BatchSpanProcessor(otlp.OTLPSpanExporter()))
    return provider
