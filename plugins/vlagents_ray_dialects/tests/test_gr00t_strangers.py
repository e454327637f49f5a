"""Tests that peers without a key cost GR00T's gateway no memory, threads or places, whatever frames
they send.
"""

from __future__ import annotations

import contextlib
import gc
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq
from eval_fakes import wait_for
from in_memory_keys import ChangingKeys

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.protocol.messages import DEFAULT_LIMITS
from vlagents_ray.serve.access import api_keys
from vlagents_ray.serve.dialects.base import GatewayContext
from vlagents_ray.serve.engine.admission import Admission
from vlagents_ray.serve.ports import LOOPBACK, reserve
from vlagents_ray_dialects import gateway_sessions, gr00t

pytestmark = pytest.mark.own_process

PLACES = 8  # maximum number of clients
MEMORY = 32 * 2**20  # maximum growth of the memory, bytes; the peers send 96 MiB and more
LARGE = bytes(8 * 2**20)
PING = msgpack.packb({"endpoint": "ping"})
WRONG = msgpack.packb({"endpoint": "ping", "api_token": "vlr_wrong"})
NUMBERS = itertools.count()


@dataclass
class Gateway:
    dialect: gr00t.GR00TDialect
    port: int
    admission: Admission
    keys: ChangingKeys

    @property
    def clients(self) -> int:
        return len(self.dialect._clients._clients)

    def connect(self, kind: int = zmq.DEALER, identity: bytes = b"") -> Any:
        peer = zmq.Context.instance().socket(kind)
        peer.setsockopt(zmq.LINGER, 0)
        peer.setsockopt(zmq.SNDTIMEO, 2000)
        peer.setsockopt(zmq.RCVTIMEO, 20_000)
        if identity:
            peer.setsockopt(zmq.ROUTING_ID, identity)
        peer.connect(f"tcp://127.0.0.1:{self.port}")
        return peer

    def ping(self, peer: Any, key: str) -> dict[str, Any]:
        peer.send(msgpack.packb({"endpoint": "ping", "api_token": key}))
        answer: dict[str, Any] = msgpack.unpackb(peer.recv())
        return answer


def _no_replica(*_: object) -> RemoteAgent:
    raise PolicyUnavailable("there is no replica")


@pytest.fixture
def gateway(monkeypatch: pytest.MonkeyPatch) -> Iterator[Gateway]:
    monkeypatch.setattr(api_keys, "_CHECK_S", 0.0)
    keys = ChangingKeys()
    keys.add("robot")
    admission = Admission(DEFAULT_LIMITS.in_flight_bytes)
    check = partial(keys.keys.check, app="app")
    context = GatewayContext(
        "app", _no_replica, DEFAULT_LIMITS, PLACES, 600.0, None, check, admission
    )
    dialect = gr00t.GR00TDialect("gr00t", gr00t.GR00TDialectConfig(), context)
    listener = reserve("gr00t", LOOPBACK, 0)
    port = listener.getsockname()[1]
    dialect.serve(listener)
    yield Gateway(dialect, port, admission, keys)
    dialect.close()


def resident() -> int:
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def threads() -> int:
    return sum(thread.name == "gr00t-client" for thread in threading.enumerate())


def _parts(*parts: bytes) -> Callable[[], tuple[bytes, list[bytes]]]:
    return lambda: (b"", list(parts))


# A message of a new connection: the identity that the connection requests, and the parts of the
# message.
MESSAGES: dict[str, Callable[[], tuple[bytes, list[bytes]]]] = {
    "large first part": _parts(LARGE, PING),
    "large parts": _parts(*[LARGE] * 5, PING),
    "many parts": _parts(*[b"x"] * 10_000, PING),
    "empty parts": _parts(*[b""] * 10_000, PING),
    "large payload": _parts(b"", LARGE),
    "large key": _parts(b"", msgpack.packb({"endpoint": "ping", "api_token": "x" * 8_000_000})),
    "large data before the key": _parts(
        b"", msgpack.packb({"data": LARGE, "api_token": "vlr_wrong"})
    ),
    "a part of its own": lambda: (b"", [b"%d" % next(NUMBERS), b"", PING]),
    "an identity of its own": lambda: (b"me %d" % next(NUMBERS), [b"", WRONG]),
    "the longest identity": lambda: (b"%0255d" % next(NUMBERS), [b"", WRONG]),
    "no payload": _parts(b""),
    "one part": _parts(PING),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_without_a_key_leaves_nothing_behind(gateway: Gateway, name: str) -> None:
    with gateway.connect(zmq.REQ) as robot:
        assert gateway.ping(robot, "vlr_robot")["status"] == "ok"
        before = resident()
        for number in range(12 if "large" in name else 3):
            identity, parts = MESSAGES[name]()
            with gateway.connect(identity=identity) as peer:
                peer.send_multipart(parts, copy=False)
                peer.poll(100)
                assert gateway.ping(robot, "vlr_robot")["status"] == "ok"
                assert gateway.clients == 1
                # One thread for each connection, whatever the connection sends.
                assert threads() <= 2 + number
        wait_for(lambda: threads() == 1)
        assert gateway.admission.held == gateway.dialect.of_strangers.held == 0
        wait_for(lambda: resident() - before < MEMORY)


@pytest.mark.slow
@pytest.mark.parametrize("chooses", ["one part each", "one identity each", "nothing"])
def test_a_flood_without_keys_takes_no_place_and_no_thread(gateway: Gateway, chooses: str) -> None:
    """There are eight places. During the flood a client with a key can connect, and is answered
    about as fast as without the flood.
    """
    stopped = threading.Event()

    def flood() -> None:
        while not stopped.is_set():
            identity = b"me %d" % next(NUMBERS) if chooses == "one identity each" else b""
            with gateway.connect(identity=identity) as peer, contextlib.suppress(zmq.Again):
                for number in range(1 if identity else 1000):
                    added = [b"%d" % number] if chooses == "one part each" else []
                    peer.send_multipart([*added, b"", WRONG])
                    if number % 20 == 0:
                        # The pause limits the rate to that of s15b in the proofs, so that the
                        # sender does not use a whole core.
                        time.sleep(0.005)
                peer.poll(20)

    def median_ms() -> float:
        times = []
        for _ in range(60):
            begun = time.perf_counter()
            assert gateway.ping(robot, "vlr_robot")["status"] == "ok"
            times.append((time.perf_counter() - begun) * 1e3)
        return sorted(times)[len(times) // 2]

    with gateway.connect(zmq.REQ) as robot:
        gateway.ping(robot, "vlr_robot")
        alone = median_ms()
        thread = threading.Thread(target=flood)
        thread.start()
        try:
            beside = [median_ms() for _ in range(3)]
            late = [gateway.connect(zmq.REQ) for _ in range(PLACES - 1)]
            for peer in late:
                assert gateway.ping(peer, "vlr_robot")["status"] == "ok"
            assert gateway.clients == PLACES
            assert threads() <= PLACES + gr00t._STRANGERS
            for peer in late:
                peer.close()
        finally:
            stopped.set()
            thread.join()
    # With a thread for each envelope, the median was 130 times as long.
    assert min(beside) < 20 * alone


def test_a_stranger_with_the_identity_of_a_client_stays_a_stranger(gateway: Gateway) -> None:
    with gateway.connect(zmq.REQ, b"robot-1") as robot:
        assert gateway.ping(robot, "vlr_robot")["status"] == "ok"
        with gateway.connect(zmq.REQ, b"robot-1") as peer:
            assert "unauthorized" in gateway.ping(peer, "vlr_wrong")["error"]
            assert len(gateway.dialect._strangers) == 1
            assert gateway.ping(robot, "vlr_robot")["status"] == "ok"
            assert gateway.clients == 1


def test_a_connection_whose_messages_have_no_key_is_closed_after_some(
    gateway: Gateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After each such message the connection is not read for `_REFUSAL_S`."""
    monkeypatch.setattr(gr00t, "_REFUSAL_S", 0.02)
    with gateway.connect() as peer:
        monitor = peer.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        begun = time.monotonic()
        for _ in range(gr00t._REFUSALS):
            peer.send_multipart([b"", WRONG])
        assert monitor.poll(20_000)
        assert time.monotonic() - begun > 0.02 * (gr00t._REFUSALS - 1)
        peer.disable_monitor()
        monitor.close()


def test_a_proxy_that_would_mix_the_sessions_of_its_clients_gets_an_error(gateway: Gateway) -> None:
    with gateway.connect() as proxy:
        proxy.send_multipart(
            [b"client-1", b"", msgpack.packb({"endpoint": "ping", "api_token": "vlr_robot"})]
        )
        *envelope, answer = proxy.recv_multipart()
        assert envelope == [b"client-1", b""]
        assert "without a ZeroMQ proxy" in msgpack.unpackb(answer)["error"]


def test_a_client_with_a_revoked_key_is_a_stranger_again(gateway: Gateway) -> None:
    with gateway.connect(zmq.REQ) as robot:
        assert gateway.ping(robot, "vlr_robot")["status"] == "ok"
        gateway.keys.change("robot", revoked=True)
        wait_for(lambda: gateway.clients == 0 and len(gateway.dialect._strangers) == 1)
        assert "revoked" in gateway.ping(robot, "vlr_robot")["error"]
        assert len(gateway.dialect._strangers) == 1
        assert gateway.clients == 0


@pytest.mark.slow
@pytest.mark.parametrize("cause", ["idle", "revoked key", "place given to another"])
def test_a_client_that_loses_its_place_keeps_its_connection(
    gateway: Gateway, monkeypatch: pytest.MonkeyPatch, cause: str
) -> None:
    """A request that is sent while its connection is being closed is lost, and ZeroMQ's clients
    wait forever for the answer.
    """
    with contextlib.ExitStack() as stack:
        robot = stack.enter_context(gateway.connect(zmq.REQ))
        monitor = stack.enter_context(robot.get_monitor_socket(zmq.EVENT_DISCONNECTED))
        stack.callback(robot.disable_monitor)
        assert gateway.ping(robot, "vlr_robot")["status"] == "ok"
        [robots_place] = gateway.dialect._clients._clients
        if cause == "idle":
            monkeypatch.setattr(gateway_sessions, "_QUIET_S", 0.1)
        elif cause == "revoked key":
            gateway.keys.change("robot", revoked=True)
        else:
            others = [stack.enter_context(gateway.connect(zmq.REQ)) for _ in range(PLACES)]
            for peer in others:
                assert gateway.ping(peer, "vlr_robot")["status"] == "ok"
        wait_for(lambda: gateway.dialect._clients.get(robots_place) is None)
        answer = gateway.ping(robot, "vlr_robot")
        assert "revoked" in answer["error"] if cause == "revoked key" else answer["status"] == "ok"
        assert not monitor.poll(0)
