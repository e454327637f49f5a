"""Connecting while a replica hangs, and while there is no server yet."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import ray

from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports import base, http, serve_handle, websocket
from vlagents_ray.client.transports.base import CodecChoice
from vlagents_ray.client.transports.http import HttpTransport
from vlagents_ray.client.transports.serve_handle import HandleTransport
from vlagents_ray.client.transports.websocket import WebSocketTransport
from vlagents_ray.errors import ConnectionLost, DeadlineExceeded, NoReplica, PolicyUnavailable
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.ports import free_port

TIMEOUT_S = 2.0  # of an act, in which a session whose replica froze connects to another


class Clock:
    """Time that passes while somebody waits, and no other."""

    def __init__(self) -> None:
        self.now = 0.0
        self.asked = 0

    def hang_once(self, timeout_s: float, error: Exception) -> None:
        """The first replica that is asked says nothing."""
        self.asked += 1
        if self.asked == 1:
            self.now += timeout_s
            raise error

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def over_http(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    def metadata(self: HttpTransport, timeout_s: float) -> dict[str, Any]:
        clock.hang_once(timeout_s, DeadlineExceeded("no answer"))
        return {"protocol": 1}

    monkeypatch.setattr(HttpTransport, "_metadata", metadata)
    HttpTransport("http://127.0.0.1:1", CodecChoice("raw")).connect(TIMEOUT_S)


def through_the_proxy(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    def proxied(url: str, credentials: Credentials, timeout_s: float) -> str:
        clock.hang_once(timeout_s, TimeoutError("timed out"))
        return "connected"

    monkeypatch.setattr(websocket, "ProxiedSocket", proxied)
    WebSocketTransport("http://127.0.0.1:1", CodecChoice("raw"))._stream(TIMEOUT_S)


def by_the_handle(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    def attach(self: HandleTransport, timeout_s: float) -> dict[str, Any]:
        clock.hang_once(timeout_s, DeadlineExceeded("no answer"))
        return {"policy": "p"}

    monkeypatch.setattr(ray, "is_initialized", lambda: True)
    monkeypatch.setattr(HandleTransport, "_attach", attach)
    HandleTransport("app").connect(TIMEOUT_S)


@pytest.mark.parametrize("connect", [over_http, through_the_proxy, by_the_handle])
def test_an_act_that_connects_has_time_left_when_the_first_replica_hangs(
    connect: Callable[[Clock, pytest.MonkeyPatch], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of it went to the replica that was chosen first, which might be the frozen one again."""
    clock = Clock()
    for module in (http, websocket, serve_handle):
        monkeypatch.setattr(module, "time", clock)
    connect(clock, monkeypatch)
    assert clock.asked == 2
    assert clock.now <= TIMEOUT_S / 2, "less than half is left for the act"


@pytest.mark.parametrize(
    ("transport", "attempt", "url", "error"),
    [
        (HttpTransport("http://127.0.0.1:9", CodecChoice("raw")), "_metadata", "http://127.0.0.1:9", PolicyUnavailable),
        (HandleTransport("app"), "_attach", "serve://app", ConnectionLost),
    ],
)
@pytest.mark.parametrize("ready_s", [1.0, 30.0])
def test_a_server_that_is_waited_for_is_reported_once_within_seconds(
    transport: HttpTransport | HandleTransport, attempt: str, url: str, error: type[Exception], ready_s: float,
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    """A wrong URL was silent for a minute; a server that restarts within a second is no news."""
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
    """So that a reset waits for HAProxy as it waits for a replica; both start again within seconds."""
    transport = kind(f"http://127.0.0.1:{free_port()}", CodecChoice("raw"))
    with pytest.raises(NoReplica, match="is it running"):
        transport.call([Request("reset", Obs(), request_id="1")], 1.0)
