"""The answers to clients when a server stops, and the fate of a client's acts when the client
leaves, at each endpoint.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from dialect_server import image
from eval_fakes import wait_for
from leaving_clients import (
    ACTED,
    BOUND_S,
    CLIENTS,
    GATEWAYS,
    HELD,
    LARGE,
    OTHERS,
    LeavingClient,
    StoppableServer,
    seconds_of,
)

from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.shm import ShmTransport
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.messages import Request
from vlagents_ray.registry import dialect_class, names
from vlagents_ray.serve.dialects.base import RouteDialect

SITUATIONS = ("idle", "in flight", "waiting", "half a message")
BRIGHTNESS = {"in flight": HELD + 1, "waiting": 3}  # brightness of the picture in the act
EACH = [
    pytest.param(name, situation, id=f"{name}, {situation}")
    for name in CLIENTS
    for situation in SITUATIONS
    # Datagrams and Zenoh's samples always arrive as a whole.
    if situation != "half a message" or name not in ("shared memory", "lerobot_remote")
]


@dataclass
class Scene:
    server: StoppableServer
    client: LeavingClient
    situation: str

    @property
    def acts(self) -> list[int]:
        """Return the acts that the policy executed for the client since the client's first act."""
        return [
            brightness
            for brightness in self.server.policy.acted
            if brightness == BRIGHTNESS.get(self.situation)
        ]


@contextlib.contextmanager
def scene(name: str, situation: str) -> Iterator[Scene]:
    """Yield a server and its client in this situation."""
    with contextlib.ExitStack() as stack:
        server = StoppableServer(stack)
        stack.callback(server.policy.gate.set)
        client = CLIENTS[name](server)
        if situation == "waiting":
            server.hold_policy()
        queued = len(server.queued)
        if situation in BRIGHTNESS:
            client.send(BRIGHTNESS[situation])
            wait_for(lambda: len(server.queued) > queued, BOUND_S)
        if situation == "in flight":
            assert server.policy.entered.wait(BOUND_S)
        if situation == "half a message":
            client.send_half()
        yield Scene(server, client, situation)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "situation"), EACH)
def test_a_server_that_stops_leaves_no_client_waiting(name: str, situation: str) -> None:
    """The server answers all accepted requests, and closes WebSockets with 1012 and a reason."""
    with scene(name, situation) as at:
        stopping = threading.Thread(target=at.server.stop)
        stopping.start()
        wait_for(at.server.is_stopping, BOUND_S)
        at.server.policy.gate.set()
        if situation in BRIGHTNESS:
            answer = at.client.answer()
            assert answer in ((ACTED,) if situation == "in flight" else (ACTED, "unavailable"))
            assert at.acts == ([BRIGHTNESS[situation]] if answer == ACTED else [])
        if at.client.closes_with_code:
            assert at.client.end() == "1012 the replica is stopping; connect again"
        elif not name.startswith("POST"):
            assert at.client.end() in ("ended", "unavailable", "connection_lost")
        elif situation == "half a message":
            assert at.client.end() == "unavailable"
        assert seconds_of(lambda: stopping.join(BOUND_S)) < BOUND_S


@pytest.mark.slow
@pytest.mark.parametrize("sends_more", [False, True], ids=["only reads", "sends half a message"])
# LeRobot's clients accept at most 4 MB; test_http2_front.py tests them.
@pytest.mark.parametrize("name", ["own port", "GR00T", "vlagents"])
def test_an_answer_that_is_written_before_a_stop_arrives_at_a_slow_client(
    name: str, sends_more: bool
) -> None:
    """This also holds if the client has sent bytes that the server never reads, for which the
    kernel resets a connection when it is closed.
    """
    with contextlib.ExitStack() as stack:
        server = StoppableServer(stack)
        relay = server.relay(name)
        client = CLIENTS[name](server)
        relay.gate.clear()
        client.send(LARGE)
        assert relay.is_holding.wait(BOUND_S)
        # GR00T's client cannot send more before it has an answer
        if sends_more and name != "GR00T":
            client.send_half()
        stopping = threading.Thread(target=server.stop)
        stopping.start()
        wait_for(lambda: not server.is_listening(), BOUND_S)
        relay.gate.set()
        assert client.answer() == ACTED
        if client.closes_with_code:
            assert client.end() == "1012 the replica is stopping; connect again"
        assert seconds_of(lambda: stopping.join(BOUND_S)) < BOUND_S


def test_an_answer_over_shared_memory_arrives_though_a_later_message_is_never_read() -> None:
    with contextlib.ExitStack() as stack:
        server = StoppableServer(stack)
        transport = ShmTransport(server.near.address, Credentials(""))
        transport.connect(BOUND_S)
        stack.callback(transport.close)
        transport.call([Request("reset", Obs({"front": image(2)}), request_id="0")], BOUND_S)
        connection = transport._socket
        assert connection is not None
        deadline = time.monotonic() + BOUND_S
        acts = [Request("act", Obs({"front": image(2)}), request_id="1")]
        transport._send(connection, acts, deadline)
        connection.setblocking(True)
        connection.recv(1, socket.MSG_PEEK)  # the answer has been written
        server.engine.close()
        connection.send(b"x")
        server.near.close()
        [reply] = transport._await(connection, acts, deadline)
        assert reply.error is None


@pytest.mark.slow
@pytest.mark.parametrize(("name", "situation"), EACH)
def test_no_act_is_executed_for_a_client_that_left_before_it_began(
    name: str, situation: str
) -> None:
    """A gateway notices only after an act that its client has left. The acts of that client end
    with its session.
    """
    with scene(name, situation) as at:
        of_client = [request for request in at.server.queued if request.session_id not in OTHERS]
        at.client.leave()
        if situation == "waiting" and name not in GATEWAYS:
            wait_for(
                lambda: all(request.over or request.origin.ended for request in of_client), BOUND_S
            )
        at.server.policy.gate.set()
        for op in ("reset", "act"):
            at.server.ask(OTHERS[1], op)
        if situation == "waiting" and name not in GATEWAYS:
            assert at.acts == []
        assert len(at.acts) <= 1
        if at.client.closes_with_code or name in ("shared memory", "vlagents"):
            wait_for(lambda: set(OTHERS).issuperset(at.server.engine.sessions.ids()), BOUND_S)


def test_the_table_has_each_endpoint() -> None:
    ports = {
        name for name in names("dialects") if not issubclass(dialect_class(name), RouteDialect)
    }
    assert ports == {name.lower() for name in GATEWAYS}
    paths = {
        path
        for name in names("dialects")
        if issubclass(cls := dialect_class(name), RouteDialect)
        for path in cls.paths
    }
    assert paths <= set(CLIENTS)
