"""A deadline counts from the arrival of a request, not from the time at which the policy's thread
reads it.
"""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import queue
import threading
import time
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from asgi_server import served
from in_flight import ask as ask_of
from in_flight import kernel_timestamps
from starlette.types import Receive, Scope, Send

from vlagents_ray.client.transports.shm import ShmTransport
from vlagents_ray.client.transports.websocket import Stream
from vlagents_ray.errors import DeadlineExceeded
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.frames import decode_replies, encode_requests
from vlagents_ray.protocol.messages import (
    DEADLINE_HEADER,
    SESSION_HEADER,
    MessageLimits,
    Reply,
    Request,
)
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.pauses import PauseDetector
from vlagents_ray.serve.engine.sender import Sender

DEADLINE_MS = 300.0


class Gated(Agent):
    """A policy that counts its acts, and waits for the gate if the observation requests it."""

    gate = threading.Event()
    entered = threading.Event()

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.acts = 0
        return {}

    def act(self, obs: Obs) -> Act:
        self.acts += 1
        if obs.info.get("wait"):
            self.entered.set()
            assert self.gate.wait(20)
        return Act(np.array([self.acts], np.float32))


class Shm:
    """A shared-memory client that can send without waiting for the answer."""

    def __init__(self, endpoint: ShmServer) -> None:
        self._transport = ShmTransport(endpoint.address)
        self._socket = self._transport._open(5)

    def send(self, request: Request) -> None:
        self._transport._send(self._socket, [request], time.monotonic() + 5)

    def receive(self) -> Reply:
        return self._transport._await(self._socket, [Request("act")], time.monotonic() + 20)[0]

    def close(self) -> None:
        self._transport.close()


class WebSocket:
    """A WebSocket client of the replica's own port that can send without waiting for the answer."""

    def __init__(self, endpoint: OwnPortServer) -> None:
        self._stream = Stream(
            urlsplit("http://127.0.0.1"), endpoint.address.port, endpoint.address.path, 5
        )
        self.close = self._stream.close

    def send(self, request: Request) -> None:
        self._stream.send(encode_requests([request]), 5)

    def receive(self) -> Reply:
        return decode_replies(self._stream.recv(20))[0]


@pytest.fixture
def timestamps() -> Iterator[None]:
    """Let the kernel add timestamps to data that arrives over TCP."""
    with kernel_timestamps():
        yield


@pytest.mark.slow
@pytest.mark.usefixtures("timestamps")
@pytest.mark.parametrize("behind", ["an act", "a process that stood still"])
@pytest.mark.parametrize("transport", ["shm", "websocket"])
def test_an_act_that_lay_in_the_socket_until_its_deadline_is_not_executed(
    transport: str, behind: str
) -> None:
    Gated.gate.clear()
    Gated.entered.clear()
    engine = Engine(Gated())
    endpoint = (
        ShmServer(engine, MessageLimits(), NoKey.OPEN)
        if transport == "shm"
        else OwnPortServer(engine, MessageLimits(), "127.0.0.1", None, NoKey.OPEN)
    )
    endpoint.open()
    engine.start()
    slow, hasty = [
        Shm(endpoint) if isinstance(endpoint, ShmServer) else WebSocket(endpoint) for _ in range(2)
    ]
    for client in (slow, hasty):
        client.send(Request("reset", Obs()))
        assert client.receive().error is None
    if behind == "an act":  # the only thread that reads is busy with this act
        slow.send(Request("act", Obs(info={"wait": True})))
    else:
        engine.queue.poller.call_soon(lambda: (Gated.entered.set(), Gated.gate.wait(20)))
    assert Gated.entered.wait(20)
    hasty.send(Request("act", Obs(), deadline_ms=DEADLINE_MS))
    time.sleep(2 * DEADLINE_MS / 1e3)
    Gated.gate.set()
    if behind == "an act":
        assert slow.receive().error is None
    assert type(hasty.receive().error) is DeadlineExceeded
    # A request that is read at once has its whole time.
    hasty.send(Request("act", Obs(), deadline_ms=20e3))
    act = hasty.receive().act
    assert act.action.tolist() == [1], "the policy acted on the late request"
    for client in (slow, hasty):
        client.close()
    engine.close()
    endpoint.close()


def test_a_pause_counts_for_what_is_read_right_after_it_alone() -> None:
    now = 100.0
    pauses = PauseDetector(lambda: now)
    assert pauses.waited_s() == 0  # the detector's thread has not started
    pauses._checked = now
    for _ in range(5):  # checks that are on time, or slightly late
        now += 0.2
        pauses.check()
        assert pauses.waited_s() == 0
    now += 7.0
    assert pauses.waited_s() == pytest.approx(7.0)  # read before the thread has checked again
    pauses.check()
    now += 0.1
    assert pauses.waited_s() == pytest.approx(7.1)
    pauses.check()
    # A short pause while the backlog of the long one is still unread, as on a busy machine.
    now += 0.6
    assert pauses.waited_s() == pytest.approx(7.7)
    pauses.check()
    now += 0.2
    assert pauses.waited_s() == pytest.approx(7.9)
    for _ in range(20):
        now += 0.2
        pauses.check()
    assert pauses.waited_s() == 0
    now += 0.6
    pauses.check()
    now += 0.2
    assert pauses.waited_s() == pytest.approx(0.8)  # a short pause has a short backlog
    pauses.check()
    for _ in range(2):
        now += 0.2
        pauses.check()
    assert pauses.waited_s() == 0


def test_a_machine_that_is_always_starved_refuses_only_what_may_have_waited() -> None:
    """Consecutive pauses extend the backlog only by their own length, and not forever."""
    now = 100.0
    pauses = PauseDetector(lambda: now)
    pauses._checked = now
    longest_s = 0.0
    for _ in range(100):
        for step_s in (0.35, 0.15):
            now += step_s
            longest_s = max(longest_s, pauses.waited_s())
            pauses.check()
    assert 0.35 < longest_s < 3.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sent", "deadline_ms"), [("in the pause", 300.0), ("in the pause", 60e3), ("after it", 300.0)]
)
def test_after_a_pause_an_http_request_is_refused_only_if_it_was_late(
    sent: str, deadline_ms: float
) -> None:
    """The answer follows the record of the request's own connection, and does not depend on how
    long other requests may be late.
    """
    now = 100.0
    engine = Engine(Gated())
    engine.start()
    engine.pauses.stop()
    engine.pauses = PauseDetector(lambda: now)
    loops: queue.SimpleQueue[asyncio.AbstractEventLoop] = queue.SimpleQueue()
    inside = build_http_app(engine, dict, MessageLimits())

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        loops.put(asyncio.get_running_loop())
        await AccessMiddleware(inside, None, "app", slow_s=30, idle_s=30)(scope, receive, send)

    with (
        served(app) as port,
        contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=30)) as client,
    ):

        def send(op: str, limit_ms: float = 60e3) -> None:
            headers = {
                "content-type": "application/json",
                DEADLINE_HEADER: str(limit_ms),
                SESSION_HEADER: "robot",
            }
            client.request("POST", f"/v1/{op}", "{}", headers)

        def answer() -> dict[str, Any]:
            found: dict[str, Any] = json.loads(client.getresponse().read())
            return found

        send("reset")
        assert "code" not in answer()
        engine.pauses.check()
        reads = threading.Event()
        loops.get().call_soon_threadsafe(reads.wait, 20)
        if sent == "in the pause":
            send("act", deadline_ms)
            time.sleep(0.6)
        now += 7.0
        engine.pauses.check()
        reads.set()
        if sent == "after it":
            send("act", deadline_ms)
        if sent == "in the pause" and deadline_ms < 600:
            late = answer()
            assert late["code"] == "deadline_exceeded"
            assert "within 300 ms" in late["detail"]  # the deadline that the sender chose
            send("act")
        assert answer()["action"] == [1.0], "the policy acted on the late request"
    engine.close()


def test_a_request_that_serve_read_late_after_a_pause_is_not_acted_on() -> None:
    now = 0.0
    engine = Engine(Gated())
    engine.start()
    engine.pauses.stop()
    engine.pauses = PauseDetector(lambda: now)
    engine.pauses._checked = now
    sender = Sender(engine, "http", caller=NoKey.OPEN, has_left=None)

    def ask(op: str) -> Reply:
        request = Request(op, Obs(), request_id="1", deadline_ms=60_000.0)
        (reply,) = asyncio.run(ask_of(sender, [request]))
        return reply

    assert ask("reset").error is None
    now = 100.0
    assert isinstance(ask("act").error, DeadlineExceeded)
    engine.pauses._checked = now
    assert ask("act").act is not None
    engine.close()
