"""Connecting while a replica hangs, and while no server is running."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest
import ray
from asgi_server import policy_server
from eval_fakes import SimulatedTime

from vlagents_ray import RemoteAgent
from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports import base, http, serve_handle, websocket
from vlagents_ray.client.transports.base import CodecChoice, first_timeout_s
from vlagents_ray.client.transports.http import HttpTransport
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.client.transports.serve_handle import HandleTransport
from vlagents_ray.client.transports.websocket import WebSocketTransport
from vlagents_ray.errors import ConnectionLost, DeadlineExceeded, NoReplica, PolicyUnavailable
from vlagents_ray.interface import Obs
from vlagents_ray.policies.noop import Noop
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.ports import free_port

TIMEOUT_S = 2.0  # timeout of an act, in which a session whose replica froze connects to another


class Clock(SimulatedTime):
    """A clock that advances while the first replicas that a client tries do not answer."""

    def __init__(self, hanging: int = 1) -> None:
        self.hanging = hanging
        self.waited: list[float] = []  # timeout of each attempt, s

    def ask(self, timeout_s: float, error: Exception) -> None:
        self.waited.append(timeout_s)
        if len(self.waited) <= self.hanging:
            self.now += timeout_s
            raise error


def over_http(clock: Clock, timeout_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    def metadata(self: HttpTransport, timeout_s: float) -> dict[str, Any]:
        clock.ask(timeout_s, DeadlineExceeded("no answer"))
        return {"protocol": 1}

    monkeypatch.setattr(HttpTransport, "_metadata", metadata)
    HttpTransport("http://127.0.0.1:1", CodecChoice("raw")).connect(timeout_s)


def through_the_proxy(clock: Clock, timeout_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    def proxied(url: str, credentials: Credentials, timeout_s: float, watch: object) -> str:
        clock.ask(timeout_s, TimeoutError("timed out"))
        return "connected"

    monkeypatch.setattr(websocket, "ProxiedSocket", proxied)
    WebSocketTransport("http://127.0.0.1:1", CodecChoice("raw"))._stream(timeout_s)


def by_the_handle(clock: Clock, timeout_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    def attach(self: HandleTransport, timeout_s: float) -> dict[str, Any]:
        clock.ask(timeout_s, DeadlineExceeded("no answer"))
        return {"policy": "p"}

    monkeypatch.setattr(ray, "is_initialized", lambda: True)
    monkeypatch.setattr(HandleTransport, "_attach", attach)
    HandleTransport("app").connect(timeout_s)


@pytest.mark.parametrize("connect", [over_http, through_the_proxy, by_the_handle])
def test_what_connects_has_time_left_when_the_first_replicas_hang(
    connect: Callable[[Clock, float, pytest.MonkeyPatch], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In an earlier version, the replica that was tried first used up all of the time, and it might
    be the frozen one again.
    """
    act, reset = Clock(), Clock(hanging=2)
    for clock, timeout_s in ((act, TIMEOUT_S), (reset, 60.0)):
        for module in (http, websocket, serve_handle):
            monkeypatch.setattr(module, "time", clock)
        connect(clock, timeout_s, monkeypatch)
    assert len(act.waited) == 2
    assert act.now <= TIMEOUT_S / 2, "less than half of the time is left for the act"
    first = first_timeout_s(60)
    assert reset.waited == [first, 2 * first, 4 * first]
    never = Clock(hanging=99)
    for module in (http, websocket, serve_handle):
        monkeypatch.setattr(module, "time", never)
    with pytest.raises(PolicyUnavailable):
        connect(never, 0.0, monkeypatch)


@pytest.mark.parametrize(
    ("transport", "attempt", "url", "error"),
    [
        (
            HttpTransport("http://127.0.0.1:9", CodecChoice("raw")),
            "_metadata",
            "http://127.0.0.1:9",
            PolicyUnavailable,
        ),
        (HandleTransport("app"), "_attach", "serve://app", ConnectionLost),
    ],
)
@pytest.mark.parametrize("ready_s", [1.0, 30.0])
def test_a_server_that_is_waited_for_is_reported_once_within_seconds(
    transport: HttpTransport | HandleTransport,
    attempt: str,
    url: str,
    error: type[Exception],
    ready_s: float,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """In an earlier version, a wrong URL caused no message for a minute. A server that restarts
    within a second needs no message.
    """
    clock = Clock()
    reported_at: list[float] = []

    def metadata(*_: object) -> dict[str, Any]:
        reported_at.extend([clock.now] * (len(caplog.messages) - len(reported_at)))
        if clock.now < ready_s:
            raise error("connection refused")
        return {"protocol": 1}

    for module in (base, http, serve_handle):
        monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(ray, "is_initialized", lambda: True)
    monkeypatch.setattr(type(transport), attempt, metadata)
    transport.connect(60.0)
    assert len(caplog.messages) == (0 if ready_s < 2 else 1)
    for message in caplog.messages:
        assert message.startswith(f"{url}: not ready; trying again for up to 5")
        assert message.endswith(" s (connection refused)")
        assert reported_at[0] < 5


@pytest.mark.parametrize("kind", [HttpTransport, WebSocketTransport])
def test_a_server_that_refuses_connections_is_one_without_replicas(
    kind: type[HttpTransport | WebSocketTransport],
) -> None:
    """So a reset waits for HAProxy as for a replica; both restart within seconds."""
    transport = kind(f"http://127.0.0.1:{free_port()}", CodecChoice("raw"))
    with pytest.raises(NoReplica, match="is it running"):
        transport.call([Request("reset", Obs(), request_id="1")], 1.0)


@pytest.mark.parametrize("transport", ["auto", "websocket", "http"])
def test_the_metadata_is_fetched_once(transport: TransportName) -> None:
    asked: Counter[str] = Counter()
    with (
        policy_server(Noop(), asked) as port,
        RemoteAgent(f"http://127.0.0.1:{port}", transport=transport) as agent,
    ):
        agent.reset(Obs(), "stack")
        agent.act(Obs())
    assert asked["/v1/metadata"] == 1, asked
