"""Tests of OpenTelemetry spans: one trace contains a request from the client's program to the
batch.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest
from live_server import live_server
from opentelemetry.sdk.trace import ReadableSpan, TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from opentelemetry.trace import SpanKind, StatusCode

from vlagents_ray import Obs, RemoteAgent, tracing
from vlagents_ray.errors import InvalidObservation, VLAgentsError
from vlagents_ray.interface import Act, Agent
from vlagents_ray.serve.requests import PendingRequest
from vlagents_ray_live import spans

OBS = Obs(state={"joints": np.zeros(3, np.float32)})


class Picky(Agent):
    """Fails if an observation requests it; otherwise reports whether the observation had a
    trace.
    """

    def act(self, obs: Obs) -> Act:
        if obs.info.get("fail"):
            raise InvalidObservation("as it was asked for")
        return Act(np.zeros(2, np.float32), info={"traced": "traceparent" in obs.info})


@pytest.fixture
def exporter(monkeypatch: pytest.MonkeyPatch) -> Iterator[InMemorySpanExporter]:
    """Yield the exporter of a process that traces."""
    kept = InMemorySpanExporter()
    provider = TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(kept))
    monkeypatch.setenv("VLAGENTS_RAY_OTEL", "1")
    monkeypatch.setattr(tracing, "_provider", lambda: provider)
    yield kept
    provider.shutdown()


def children(spans: list[ReadableSpan], parent: ReadableSpan) -> list[ReadableSpan]:
    found = [
        one
        for one in spans
        if one.parent is not None and one.parent.span_id == parent.context.span_id
    ]
    return sorted(found, key=lambda one: one.start_time)


@pytest.mark.parametrize("late_s", [0.0, 0.05])
@pytest.mark.parametrize("transport", ["http", "websocket"])
def test_a_request_is_one_trace_from_the_program_to_the_batch(
    exporter: InMemorySpanExporter, monkeypatch: pytest.MonkeyPatch, transport: str, late_s: float
) -> None:
    """Other observers, or a busy machine, may delay the observer of a request."""
    observe = spans.RequestSpans.on_request

    def observe_late(observer: spans.RequestSpans, pending: PendingRequest) -> None:
        time.sleep(late_s)
        observe(observer, pending)

    monkeypatch.setattr(spans.RequestSpans, "on_request", observe_late)
    with (
        live_server(Picky()) as server,
        RemoteAgent(server.url, transport=transport) as agent,
        tracing.tracer().start_as_current_span("my program") as mine,
    ):
        agent.reset(OBS, "stack")
        assert agent.act(OBS).info["traced"]
    found = list(exporter.get_finished_spans())
    assert {one.context.trace_id for one in found} == {mine.get_span_context().trace_id}
    [program] = [one for one in found if one.name == "my program"]
    reset, act = children(found, program)
    assert [one.name for one in (reset, act)] == ["vlagents reset", "vlagents act"]
    assert act.kind == SpanKind.CLIENT
    assert act.attributes == {"server.url": server.url, "transport": transport, "requests": 1}
    [served] = children(found, act)
    assert (served.name, served.kind) == ("vlagents act", SpanKind.SERVER)
    assert (served.attributes["replica"], served.attributes["batch_size"]) == ("this", 1)
    stages = children(found, served)
    assert [one.name for one in stages] == ["decode", "queue", "batch", "encode"]
    assert all(before.end_time <= after.start_time for before, after in pairwise(stages[:3]))
    assert act.start_time <= served.start_time < served.end_time <= act.end_time + 5e6


def test_what_fails_is_an_error_at_both_ends(exporter: InMemorySpanExporter) -> None:
    with live_server(Picky()) as server, RemoteAgent(server.url, transport="http") as agent:
        agent.reset(OBS, "stack")
        with pytest.raises(VLAgentsError, match="as it was asked for"):
            agent.act(Obs(state=OBS.state, info={"fail": True}))
    acts = [one for one in exporter.get_finished_spans() if one.name == "vlagents act"]
    assert [one.status.status_code for one in acts] == [StatusCode.ERROR] * 2
    assert all("as it was asked for" in str(one.status.description) for one in acts)


@pytest.mark.parametrize("stated", ["", "no trace", "00-" + "0" * 32 + "-" + "0" * 16 + "-01", 7])
def test_a_client_that_states_no_trace_gets_one_of_the_server(
    exporter: InMemorySpanExporter, monkeypatch: pytest.MonkeyPatch, stated: object
) -> None:
    with live_server(Picky()) as server:
        monkeypatch.delenv("VLAGENTS_RAY_OTEL")
        with RemoteAgent(server.url, transport="http") as agent:
            agent.reset(OBS, "stack")
            agent.act(Obs(state=OBS.state, info={"traceparent": stated}))
    [served] = [one for one in exporter.get_finished_spans() if one.name == "vlagents act"]
    assert served.parent is None


def test_nothing_is_traced_unless_it_is_asked_for() -> None:
    with live_server(Picky()) as server, RemoteAgent(server.url, transport="http") as agent:
        assert server.engine.observers.any is False
        assert "_call" not in vars(agent)
        agent.reset(OBS, "stack")
        assert not agent.act(OBS).info["traced"]
