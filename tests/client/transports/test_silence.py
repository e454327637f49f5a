"""A replica that does not answer: a client checks whether its process is alive, and leaves the
replica if it is not.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from eval_fakes import wait_for
from in_flight import kernel_timestamps

from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports import http
from vlagents_ray.client.transports.base import CodecChoice, ReplicaSilent, ReplicaWatch, Transport
from vlagents_ray.client.transports.http import HttpTransport
from vlagents_ray.client.transports.shm import ShmTransport
from vlagents_ray.client.transports.websocket import Stream, WebSocketTransport
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import LocalAddress, MessageLimits, Request
from vlagents_ray.protocol.websocket_frames import CONTROL_FRAMES
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.engine.engine import Engine

TRANSPORTS = ("shm", "websocket", "http")


class Gated(Agent):
    """A policy that counts its acts, and waits for a gate if the observation requests it."""

    gate: threading.Event  # gate of all sessions
    acts: list[str]

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {}

    def act(self, obs: Obs) -> Act:
        Gated.acts.append(obs.info["name"])
        if obs.info.get("wait"):
            assert Gated.gate.wait(60)
        return Act(np.zeros(1, np.float32))


class Watch(ReplicaWatch):
    """Records signs of life and silences."""

    def __init__(self, limit_s: float = float("inf")) -> None:
        super().__init__(self._note_silence)
        self.limit_s = limit_s
        self.pinged = False
        self.signs = threading.Event()  # whether there was a sign of life since a ping
        self.silent = threading.Event()

    def _note_silence(self, silent_s: float, is_proxied: bool) -> None:
        self.pinged = True
        self.silent.set()
        if silent_s > self.limit_s:
            raise ReplicaSilent("left")

    def received(self) -> None:
        super().received()
        if self.pinged:
            self.signs.set()


class Replica:
    """A policy with an endpoint for each transport."""

    def __init__(self) -> None:
        Gated.gate, Gated.acts = threading.Event(), []
        self.engine = Engine(Gated())
        self.local = ShmServer(self.engine, MessageLimits(), NoKey.OPEN)
        self.stream = OwnPortServer(self.engine, MessageLimits(), "127.0.0.1", None, NoKey.OPEN)
        self.local.open()
        self.stream.open()
        self.engine.start()

    def client(self, transport: str, watch: ReplicaWatch) -> Transport:
        if transport == "shm":
            local = ShmTransport(self.local.address, watch=watch)
            local.connect(5)
            return local  # type: ignore[return-value]
        if transport == "http":
            over_http = HttpTransport("http://127.0.0.1:1", CodecChoice("raw"), watch=watch)
            over_http._set_direct(self.stream.address)
            return over_http
        stream = WebSocketTransport("http://127.0.0.1:1", CodecChoice("raw"), watch=watch)
        stream._socket = Stream(
            urlsplit("http://127.0.0.1"),
            self.stream.address.port,
            self.stream.address.path,
            5,
            watch=watch,
        )
        return stream

    def freeze(self) -> None:
        """Block all threads that read the connections until the gate opens."""
        frozen = threading.Event()
        self.engine.queue.poller.call_soon(lambda: (frozen.set(), Gated.gate.wait(60)))
        assert frozen.wait(20)

    def close(self) -> None:
        Gated.gate.set()
        self.engine.close()
        self.local.close()
        self.stream.close()


@pytest.fixture
def replica() -> Iterator[Replica]:
    replica = Replica()
    with ExitStack() as stack:
        stack.callback(replica.close)
        stack.enter_context(kernel_timestamps())
        yield replica


def request(op: Any, name: str, **info: Any) -> Request:
    return Request(op, Obs(info={"name": name, **info}), request_id=name)


@pytest.mark.slow
@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_replica_answers_pings_while_its_policy_is_at_work(
    replica: Replica, transport: str
) -> None:
    """During the first long act after short ones, no other thread polls yet."""
    watch = Watch()
    client = replica.client(transport, watch)
    assert client.call([request("reset", "a")], 20)[0].error is None
    for number in range(5):
        assert client.call([request("act", f"short-{number}")], 20)[0].error is None

    def finish() -> None:
        watch.signs.wait(60)
        Gated.gate.set()

    finishing = threading.Thread(target=finish)
    finishing.start()
    [reply] = client.call([request("act", "long", wait=True)], 60)
    finishing.join()
    assert reply.error is None
    assert watch.signs.is_set()
    client.close()


@pytest.mark.slow
@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_frozen_replica_is_left_and_does_not_act_when_it_continues(
    replica: Replica, transport: str
) -> None:
    watch = Watch(limit_s=0.5)
    client, other = replica.client(transport, watch), replica.client(transport, Watch())
    for each in (client, other):
        assert each.call([request("reset", "a")], 20)[0].error is None
    replica.freeze()
    with pytest.raises(ReplicaSilent):
        client.call([request("act", "late")], 60)
    clients = replica.local._clients if transport == "shm" else replica.stream._clients
    assert len(clients) >= 2

    Gated.gate.set()
    wait_for(lambda: len(clients) == 1)
    assert other.call([request("act", "other")], 20)[0].error is None
    assert Gated.acts == ["other"]
    other.close()


@pytest.mark.slow
@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_replica_that_continues_in_time_is_not_left(replica: Replica, transport: str) -> None:
    watch = Watch(limit_s=60.0)
    client = replica.client(transport, watch)
    assert client.call([request("reset", "a")], 20)[0].error is None
    replica.freeze()

    def thaw() -> None:
        watch.silent.wait(60)
        Gated.gate.set()

    thawing = threading.Thread(target=thaw)
    thawing.start()
    [reply] = client.call([request("act", "delayed")], 60)
    thawing.join()
    assert reply.error is None
    assert Gated.acts == ["delayed"]
    client.close()


def test_through_the_proxy_only_the_replica_of_the_call_shows_that_it_is_alive(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The proxy sends later pings to another replica when it marks this one as down."""
    answering = ["a"]

    def exchange(*_: Any) -> tuple[int, str, bytes]:
        stream = {"port": 9000, "path": f"/v1/stream/{answering[0]}"}
        return 200, "application/json", json.dumps({"stream": stream}).encode()

    monkeypatch.setattr(http._Link, "exchange", exchange)
    url = urlsplit("http://127.0.0.1:1")
    link = '<//127.0.0.1:9000/v1/stream/a/act>; rel="alternate"'
    answered_by = http._address_of_link(link, "act")

    probe = http._ProxiedProbe(url, Credentials(""), "session", answered_by)
    assert probe()
    answering[0] = "b"
    assert not probe()
    answering[0] = "a"
    assert probe()

    # This call reaches another replica than the call before.
    answering[0] = "b"
    probe = http._ProxiedProbe(url, Credentials(""), "session", answered_by)
    assert probe()
    assert probe()


def test_a_local_client_that_floods_pings_is_cut_off(replica: Replica) -> None:
    client = ShmTransport(replica.local.address)
    assert client.call([request("reset", "a")], 20)[0].error is None
    connection = client._socket
    assert connection is not None
    connection.settimeout(20)

    def answered_pings() -> int:
        """Return the number of pings that are answered before the connection ends."""
        for number in range(1000 * CONTROL_FRAMES):
            try:
                connection.send(LocalAddress.PING)
                if connection.recv(16) != LocalAddress.PONG:
                    return number
            except OSError:
                return number
        return 1000 * CONTROL_FRAMES

    assert CONTROL_FRAMES <= answered_pings() < 1000 * CONTROL_FRAMES
    client.close()
