"""A request that is not executed leaves no trace.

Two runs are compared: one with a request that is rejected, arrives late, or is dropped while it
waits, and the end of its connection; and one without both. The answers to all other connections,
and all fields of all sessions, must be equal. The clocks are simulated, so that times are also
compared.
"""

from __future__ import annotations

import contextlib
import dataclasses
import http.client
import queue
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from asgi_server import served
from eval_fakes import wait_for
from in_flight import send
from websockets.sync.client import ClientConnection, connect

from vlagents_ray.client.transports.shm import ShmTransport
from vlagents_ray.client.transports.websocket import Stream
from vlagents_ray.contract import Contract, StateSpec
from vlagents_ray.errors import Overloaded
from vlagents_ray.interface import EXECUTED_AGE, SLACK, TICKS, Act, Agent, Obs
from vlagents_ray.protocol.frames import CONTENT_TYPE, encode_requests
from vlagents_ray.protocol.messages import (
    DEFAULT_LIMITS,
    OPS,
    SESSION_HEADER,
    Reply,
    Request,
)
from vlagents_ray.serve import sessions as sessions_module
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.requests import Origin
from vlagents_ray.serve.sessions import Session

ARM, OTHER, NEW = "arm", "other", "new"
DEADLINE_MS = 50.0


class Counts(Agent):
    """A policy that answers with its instruction and the number of its acts, and waits at a gate if
    the observation requests it.
    """

    gate = threading.Event()
    waits = threading.Semaphore(0)

    @property
    def contract(self) -> Contract:
        return Contract(state={"joints": StateSpec(2)})

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.instruction, self.acts = instruction, 0
        return {}

    def observe(self, obs: Obs) -> None:
        self.acts += 1

    def act(self, obs: Obs) -> Act:
        self.acts += 1
        if obs.info.get("wait"):
            self.waits.release()
            assert self.gate.wait(20)
        return Act(np.array([self.acts], np.float32), info={"obeys": self.instruction})


def obs(**info: Any) -> Obs:
    return Obs(state={"joints": np.zeros(2, np.float32)}, info=info)


class Clock:
    """The clock of the engine, s; it only advances between the steps of a run."""

    def __init__(self) -> None:
        self.now = 1000.0

    def advance(self) -> None:
        self.now += 2.0


class World:
    """An engine with a robot that is in its second episode, and a robot that keeps the policy
    busy.
    """

    def __init__(self) -> None:
        Counts.gate.clear()
        self.clock = Clock()
        self.engine = Engine(
            Counts(),
            EngineSettings(session_limit=2),
            clock=lambda: self.clock.now,
            wall_clock=lambda: int(self.clock.now * 1e9),
        )
        self.engine.start()
        self.origins: dict[str, Origin] = {}
        self.robot, self.other = self.sender("robot"), self.sender("other")
        self.answers: list[Any] = []

    def sender(self, name: str, *, connected: bool = True) -> Sender:
        sender = Sender(self.engine, "test", caller=NoKey.OPEN, has_left=None, connected=connected)
        self.origins[name] = sender._origin
        return sender

    def begin(self, sender: Sender, request: Request) -> Callable[[], Reply]:
        replies: queue.SimpleQueue[list[Reply]] = queue.SimpleQueue()
        send(sender, [request], replies.put)
        return lambda: replies.get(timeout=20)[0]

    def advance(self) -> None:
        """Advance the clock between two batches. The end of a batch is later than its answer, and
        a batch that seems to take seconds would leave no room for other requests.
        """
        wait_for(lambda: not self.engine.queue._running)
        self.clock.advance()

    def ask(self, sender: Sender, op: Any, session: str = ARM, **fields: Any) -> Reply:
        """Send a request of another client than the intruder, and record its answer."""
        self.advance()
        reply = self.begin(sender, Request(op, obs(), session=session, **fields))()
        act = reply.act and (reply.act.action.tolist(), reply.act.info)
        error = reply.error and (type(reply.error).__name__, str(reply.error))
        self.answers.append((op, act, reply.info, reply.step, error))
        return reply

    def act_with_report(self) -> None:
        """The robot acts, with its slack and its report."""
        self.advance()
        info = {SLACK: 500.0, TICKS: (5, 1), EXECUTED_AGE: 30.0}
        self.begin(self.robot, Request("act", obs(**info), session=ARM))()

    def close(self) -> None:
        """Close the engine."""
        Counts.gate.set()
        self.engine.close()

    def snapshot(self) -> dict[str, Any]:
        """Return the state of all sessions, and of the table."""
        table = self.engine.sessions
        names = {id(origin): name for name, origin in self.origins.items()}

        def plain(name: str, value: Any) -> Any:
            if isinstance(value, Origin):
                return names.get(id(value), f"a connection of {value.transport}")
            if name in ("agent", "times"):
                return value and repr({k: v for k, v in vars(value).items() if k != "_lock"})
            if name == "model":
                return value is not None
            if name == "weights":
                return value and value.number
            return repr(value)

        fields = {
            f"{session.id}: {field.name}": plain(field.name, getattr(session, field.name))
            for session in table.all()
            for field in dataclasses.fields(Session)
        }
        return fields | {
            "robot's sessions": dict(self.robot._origin.sessions),
            "versions": table.versions(),
            "connections": dict(table.movable_by_connection(1e9)),
            "number": (len(table), table.opened),
            "waiting": self.engine.queue.depth(),
            "present": [
                plan.is_present(self.clock.now, waits=waits) for plan, waits in self.engine._plans()
            ],
        }


class Client:
    """A connection of the intruder."""

    def send(self, request: Request) -> None:
        raise NotImplementedError

    def receive(self) -> None:
        """Wait for the answer."""
        raise NotImplementedError

    def end(self) -> None:
        """End the connection."""
        raise NotImplementedError


class EngineClient(Client):
    def __init__(self, world: World, *, connected: bool = True) -> None:
        self._world = world
        self._sender = Sender(
            world.engine, "test", ARM, caller=NoKey.OPEN, has_left=None, connected=connected
        )

    def send(self, request: Request) -> None:
        self.receive = self._world.begin(self._sender, request)  # type: ignore[method-assign]

    def end(self) -> None:
        self._sender.release()


class ShmClient(Client):
    def __init__(self, endpoint: ShmServer) -> None:
        self._transport = ShmTransport(endpoint.address)
        self._socket = self._transport._open(5)
        self.end = self._transport.close  # type: ignore[method-assign]

    def send(self, request: Request) -> None:
        self._request = request
        self._transport._send(self._socket, [request], time.monotonic() + 5)

    def receive(self) -> None:
        self._transport._await(self._socket, [self._request], time.monotonic() + 20)


class StreamClient(Client):
    def __init__(self, endpoint: OwnPortServer) -> None:
        address = endpoint.address
        self._stream = Stream(urlsplit("http://127.0.0.1"), address.port, address.path, 5)
        self.end = self._stream.close  # type: ignore[method-assign]

    def send(self, request: Request) -> None:
        self._stream.send(encode_requests([request]), 5)

    def receive(self) -> None:
        self._stream.recv(20)


class ServerStreamClient(Client):
    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self.end = socket.close  # type: ignore[method-assign]

    def send(self, request: Request) -> None:
        self._socket.send(encode_requests([request]))

    def receive(self) -> None:
        self._socket.recv(20)


class HttpClient(Client):
    def __init__(self, port: int, path: str) -> None:
        self._connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
        self._path = path
        self.end = self._connection.close  # type: ignore[method-assign]

    def send(self, request: Request) -> None:
        headers = {"content-type": CONTENT_TYPE, SESSION_HEADER: request.session}
        body = encode_requests([request])
        self._connection.request("POST", f"{self._path}/{request.op}", body, headers)

    def receive(self) -> None:
        self._connection.getresponse().read()


@contextlib.contextmanager
def client_of(world: World, way: str) -> Iterator[Client]:
    """Connect the intruder's client, and wait until the engine has noticed the end of its
    connection.
    """
    with contextlib.ExitStack() as stack:
        if way == "shm":
            shm = ShmServer(world.engine, DEFAULT_LIMITS, NoKey.OPEN)
            shm.open()
            stack.callback(shm.close)
            client: Client = ShmClient(shm)
        elif way.startswith("own port"):
            own = OwnPortServer(world.engine, DEFAULT_LIMITS, "127.0.0.1", None, NoKey.OPEN)
            own.open()
            stack.callback(own.close)
            address = own.address
            is_http = way.endswith("HTTP")
            client = HttpClient(address.port, address.path) if is_http else StreamClient(own)
        elif way.startswith("server's port"):
            app = build_http_app(world.engine, dict, DEFAULT_LIMITS)
            port = stack.enter_context(served(AccessMiddleware(app, None, "app")))
            is_http = way.endswith("HTTP")
            if is_http:
                client = HttpClient(port, "/v1")
            else:
                socket = connect(f"ws://127.0.0.1:{port}/v1/stream")
                client = ServerStreamClient(stack.enter_context(socket))
        else:
            client = EngineClient(world, connected=way == "engine")
        stack.callback(world.close)  # before its endpoints, as a replica does
        stack.callback(client.end)
        yield client


WAYS = {
    "engine": False,
    "engine without connection": True,
    "shm": False,
    "own port": False,
    "own port, HTTP": True,
    "server's port": False,
    "server's port, HTTP": True,
}
"""The ways in, and whether a request without a step belongs to the current episode there."""

REPORT = {SLACK: 7.0, TICKS: (900, 800), EXECUTED_AGE: 900.0}
OPERATIONS: dict[str, Callable[[], Request]] = {
    "reset": lambda: Request("reset", obs(), "intruder", session=ARM),
    "reset with options": lambda: Request(
        "reset", obs(), "intruder", {"weights": "follow", "seed": 3}, session=ARM
    ),
    "reset with history": lambda: Request(
        "reset", obs(), "intruder", history=[obs(), obs()], session=ARM
    ),
    "reset of a new session": lambda: Request("reset", obs(), "intruder", session=NEW),
    "act": lambda: Request("act", obs(), session=ARM),
    "act with a report": lambda: Request("act", obs(**REPORT), session=ARM),
    "close": lambda: Request("close", session=ARM),
    "close of a new session": lambda: Request("close", session=NEW),
}

WAITING = ("expired", "withdrawn", "its connection ends", "the replica stops")
REFUSALS = (
    *WAITING,
    "late step",
    "future step",
    "late episode",
    "rejected by the contract",
    "invalid",
    "full",
    "overloaded",
)


def is_refused(operation: str, refusal: str, way: str) -> bool:
    """Return whether the combination exists."""
    op = operation.partition(" ")[0]
    has_step = op in ("act", "close") and not operation.endswith("new session")
    return {
        "expired": True,
        "withdrawn": way.startswith("engine"),
        "its connection ends": way != "engine without connection",
        "the replica stops": True,
        "late step": has_step,
        "future step": has_step,
        "late episode": has_step and not WAYS[way],
        "rejected by the contract": op in ("act", "reset"),
        "invalid": operation in ("act with a report", "reset with options"),
        "full": operation == "reset of a new session",
        "overloaded": way == "engine",
    }[refusal]


CASES = [
    (operation, refusal, way)
    for operation in OPERATIONS
    for refusal in REFUSALS
    for way in WAYS
    if is_refused(operation, refusal, way)
]


def request_of(operation: str, refusal: str, steps: dict[str, int]) -> Request:
    """Return the intruder's request, with the property for which it is refused."""
    request = OPERATIONS[operation]()
    if refusal == "expired":
        request.deadline_ms = DEADLINE_MS
    elif refusal == "late step":
        request.step = steps["late"]
    elif refusal == "future step":
        request.step = steps["future"]
    elif refusal == "rejected by the contract":
        request.obs = Obs(info=request.obs.info if request.obs else {})
    elif refusal == "invalid" and request.op == "act":
        request.obs = obs(**{SLACK: -1.0})
    elif refusal == "invalid":
        request.kwargs = {"weights": 3}
    return request


def play(
    operation: str,
    refusal: str,
    way: str,
    monkeypatch: pytest.MonkeyPatch,
    *,
    comes: bool,
) -> tuple[list[Any], list[Any]]:
    """Run the world, and return the answers to the other clients, and the states; with the
    intruder's request if it `comes`.
    """
    world = World()
    monkeypatch.setattr(sessions_module, "time", SimpleNamespace(monotonic=lambda: world.clock.now))
    states: list[Any] = []
    with client_of(world, way) as intruder:
        if refusal == "late episode":
            world.advance()
            intruder.send(Request("reset", obs(), "episode 1", session=ARM))
            intruder.receive()
        before = world.ask(world.robot, "reset", instruction="episode 2").step
        for _ in range(2):
            world.act_with_report()
        step = world.ask(world.robot, "act").step
        assert before is not None
        assert step is not None
        world.ask(world.other, "reset", OTHER, instruction="other")
        if operation.endswith("new session") and refusal != "full":
            world.engine.sessions.limit = 3

        world.advance()
        request = request_of(operation, refusal, {"late": before + 1, "future": step + 9})
        if refusal == "late step" and request.op == "close":
            request.step = before - 7
        if refusal in WAITING:
            wait_until_refused(world, intruder, request, refusal, comes=comes)
        elif comes:
            with monkeypatch.context() as patch:
                if refusal == "overloaded":
                    patch.setattr(world.engine.admission, "hold", refuse)
                intruder.send(request)
                intruder.receive()

        states.append(world.snapshot())
        if comes:
            intruder.end()
        world.ask(world.other, "act", OTHER)  # a barrier, after which the end has been read
        wait_for(lambda: world.engine.queue.depth() == 0)
        states.append(world.snapshot())

        world.act_with_report()
        world.ask(world.robot, "act")
        world.ask(world.robot, "act", step=step + 2)
        world.ask(world.sender("http", connected=False), "act")
        world.ask(world.sender("late client"), "act")
        states.append(world.snapshot())
        world.ask(world.robot, "reset", instruction="episode 3")
        world.ask(world.robot, "act")
        states.append(world.snapshot())
        world.robot.release()
        states.append(world.snapshot())
        # Messages are released after their answers, on other threads.
        wait_for(lambda: world.engine.admission.held == 0)
    return world.answers, states


def refuse(*_: object) -> None:
    raise Overloaded("no memory")


def wait_until_refused(
    world: World, intruder: Client, request: Request, refusal: str, *, comes: bool
) -> None:
    """Let the intruder's request wait behind an act of the other robot until it is refused."""
    Counts.gate.clear()
    busy = world.begin(world.other, Request("act", obs(wait=True), session=OTHER))
    assert Counts.waits.acquire(timeout=10)
    world.engine.queue.poller.hand_to_reader()  # connections are read during the act
    ends = refusal == "its connection ends"
    if comes:
        intruder.send(request)
        # A close of a session that no replica has is answered at once.
        is_queued = not (request.op == "close" and request.session == NEW)
        if is_queued:
            wait_for(lambda: world.engine.queue.depth() == 1)
        if refusal == "withdrawn":
            world.engine.intake.withdraw(*world.engine.queue._waiting.clear())
        if ends:
            intruder.end()
    world.clock.advance()
    if refusal == "the replica stops":
        stopping = threading.Thread(target=world.engine.stop, args=[20.0])
        stopping.start()
        wait_for(lambda: not world.engine.health.alive or world.engine.queue._closed)
    Counts.gate.set()
    busy()
    if comes and refusal not in ("withdrawn", "its connection ends"):
        intruder.receive()
    if refusal == "the replica stops":
        stopping.join()
    else:
        wait_for(lambda: world.engine.queue.depth() == 0)


def test_each_operation_of_the_protocol_is_refused_in_some_way() -> None:
    assert {operation.partition(" ")[0] for operation, _, _ in CASES} == set(OPS)
    assert {refusal for _, refusal, _ in CASES} == set(REFUSALS)
    assert len(CASES) > 200


@pytest.mark.slow
@pytest.mark.parametrize(("operation", "refusal", "way"), CASES)
def test_a_request_that_is_not_executed_leaves_no_trace(
    operation: str, refusal: str, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected_answers, expected_states = play(operation, refusal, way, monkeypatch, comes=False)
    answers, states = play(operation, refusal, way, monkeypatch, comes=True)
    assert answers == expected_answers
    for state, expected in zip(states, expected_states, strict=True):
        assert state == expected
