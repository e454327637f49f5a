"""The monitoring data of a server: traces for OpenTelemetry."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from eval_fakes import wait_for
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.proto.trace.v1.trace_pb2 import Span

from tests.integration.conftest import serving
from vlagents_ray import Obs, RemoteAgent, tracing
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.serve.launch.server import Server

ACTS = 5


class Collector(ThreadingHTTPServer):
    """An OpenTelemetry collector that stores all spans."""

    spans: list[Span]


class Handler(BaseHTTPRequestHandler):
    server: Collector

    def do_POST(self) -> None:
        sent = ExportTraceServiceRequest.FromString(
            self.rfile.read(int(self.headers["Content-Length"]))
        )
        for resource in sent.resource_spans:
            for scope in resource.scope_spans:
                self.server.spans += scope.spans
        self.send_response(200)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(scope="module")
def collector() -> Iterator[Collector]:
    with Collector(("127.0.0.1", 0), Handler) as server:
        server.spans = []
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


@pytest.fixture(scope="module")
def server(shared_ray: None, collector: Collector) -> Iterator[Server]:
    """Run a server whose replica, and whose clients in this process, export their traces."""
    variables = {
        "VLAGENTS_RAY_OTEL": "1",
        "OTEL_EXPORTER_OTLP_ENDPOINT": f"http://127.0.0.1:{collector.server_port}",
        "OTEL_BSP_SCHEDULE_DELAY": "200",  # ms
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in variables.items():
            patch.setenv(name, value)
        with serving("noop", environment={"env_vars": variables}) as server:
            yield server
        tracing._provider().shutdown()
        tracing._provider.cache_clear()


def act(url: str, transport: TransportName) -> None:
    obs = Obs({"front": np.zeros((16, 16, 3), np.uint8)}, state={"joints": np.zeros(3, np.float32)})
    with RemoteAgent(url, transport=transport) as agent:
        agent.reset(obs, "stack")
        for _ in range(ACTS):
            agent.act(obs)


def batches_of_acts(collector: Collector) -> list[Span]:
    """Return the spans of batches whose acts have also arrived."""
    acts = {one.span_id for one in collector.spans if one.name == "vlagents act"}
    return [one for one in collector.spans if one.name == "batch" and one.parent_span_id in acts]


@pytest.mark.parametrize("transport", ["shm", "websocket"])
def test_client_and_replica_export_one_trace_of_each_request(
    server: Server, collector: Collector, transport: TransportName
) -> None:
    collector.spans.clear()
    act(server.url, transport)
    tracing.flush()
    wait_for(lambda: len(batches_of_acts(collector)) == ACTS)
    by_id = {one.span_id: one for one in collector.spans}
    batches = batches_of_acts(collector)
    for batch in batches:
        served = by_id[batch.parent_span_id]
        sent = by_id[served.parent_span_id]
        assert (served.name, served.kind) == ("vlagents act", Span.SPAN_KIND_SERVER)
        assert (sent.name, sent.kind, sent.parent_span_id) == (
            "vlagents act",
            Span.SPAN_KIND_CLIENT,
            b"",
        )
        assert batch.trace_id == served.trace_id == sent.trace_id
        about = {one.key: one.value.string_value for one in sent.attributes}
        assert about["transport"] == transport
        # Both processes use the clock of the same machine.
        assert sent.start_time_unix_nano <= batch.start_time_unix_nano < batch.end_time_unix_nano
    assert len({one.trace_id for one in batches}) == ACTS
