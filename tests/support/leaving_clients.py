"""A replica and its gateways in this process, and for each endpoint a client that acts, sends half
a message, and leaves.
"""

from __future__ import annotations

import abc
import asyncio
import contextlib
import http.client
import json
import queue
import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import grpc
import msgpack
import numpy as np
from asgi_server import served
from dialect_server import (
    ALL,
    METADATA,
    body,
    image,
    libero,
    seen,
    xpolicylab,
    xpolicylab_error,
    xpolicylab_observation,
)
from eval_fakes import wait_for
from gr00t_client import PolicyClient, encode
from in_flight import pending
from in_process_replicas import InProcess
from lerobot_messages import AsyncClient, parts_of, pickled, robot_saw
from remote_robot import FRONT, SETTINGS, STATE, RemoteRobot, rgb
from rpyc_client import Client as RpycClient
from rpyc_client import call, document
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from websockets.exceptions import ConnectionClosed
from websockets.frames import Frame, Opcode
from websockets.sync.client import connect

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.client.connection import Connection
from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.base import CodecChoice
from vlagents_ray.client.transports.shm import ShmTransport
from vlagents_ray.errors import ConnectionLost, VLAgentsError
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.frames import decode_replies, encode_requests
from vlagents_ray.protocol.messages import MessageLimits, PriorityName, Reply, Request
from vlagents_ray.registry import dialect_class
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.config.dialects import DialectArgs
from vlagents_ray.serve.dialects.base import (
    GatewayContext,
    PortDialect,
    ReplicaContext,
    dialect_routes,
)
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.asgi_websocket import _own_poller
from vlagents_ray.serve.endpoints.front import FrontMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.endpoints.shutdown import Shutdown
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.ports import free_port, reserve
from vlagents_ray_dialects.messages import openpi as openpi_codec
from vlagents_ray_dialects.messages import vla_eval as vla_eval_codec

BOUND_S = 5.0  # longest time for any wait
# Brightness of a picture for which the policy returns 8 MB, more than the kernel's buffers can
# contain.
LARGE = 240
HELD = 250  # from this brightness on, the policy waits until its gate opens
OTHERS = ("another", "a third")  # sessions of other clients
# Duration of each act, so that another thread reads the connections while the policy acts.
SLOW_S = 0.02
ACTED = "acted"
LIMITS = MessageLimits(body_bytes=2**20)


# Random values, which no protocol can compress.
_LARGE_ACTION = np.random.default_rng(0).random(2**21, np.float32)


class Acts(list[int]):
    """The brightness of all pictures on which a policy acted, in all sessions."""


class GatedPolicy(Agent):
    """A policy that records the brightness of the pictures that it receives."""

    def __init__(self) -> None:
        self.acted = Acts()
        self.entered = threading.Event()
        self.gate = threading.Event()

    def shared_objects(self) -> list[object]:
        return [self.acted, self.entered, self.gate]

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {}

    def act(self, obs: Obs) -> Act:
        brightness = max(int(picture[0, 0, 0]) for picture in obs.cameras.values())
        if brightness >= HELD:
            self.entered.set()
            self.gate.wait(BOUND_S)
        time.sleep(SLOW_S)
        self.acted.append(brightness)
        return Act(_LARGE_ACTION if brightness == LARGE else np.zeros(8, np.float32))


class SlowRelay:
    """Forwards one connection to a port; answers are not read while the `gate` is closed."""

    def __init__(self, target: int, stack: contextlib.ExitStack) -> None:
        self.gate = threading.Event()
        self.gate.set()
        self.is_holding = threading.Event()  # whether an answer has arrived at the closed gate
        self._target = target
        self._listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        client, _ = self._listener.accept()
        with client, socket.create_connection(("127.0.0.1", self._target)) as server:
            requests = threading.Thread(target=self._forward, args=(client, server), daemon=True)
            requests.start()
            with contextlib.suppress(OSError):
                while data := server.recv(65536):
                    if not self.gate.is_set():
                        self.is_holding.set()
                        self.gate.wait(BOUND_S)
                    client.sendall(data)
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)
            requests.join()

    @staticmethod
    def _forward(client: socket.socket, server: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := client.recv(65536):
                server.sendall(data)
            server.shutdown(socket.SHUT_WR)


class StoppableServer:
    """A replica that stops as in Serve, and gateways that stop at the same time."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        self.stack = stack
        self.policy = GatedPolicy()
        self.engine = Engine(self.policy, EngineSettings(max_batch_size=1))
        self.queued: list[Any] = []  # all requests that were queued
        put = self.engine.queue.put

        def noted(*requests: Any) -> None:
            self.queued.extend(requests)
            put(*requests)

        self.engine.queue.put = noted  # type: ignore[method-assign]
        self.own = OwnPortServer(self.engine, LIMITS, "127.0.0.1", None, NoKey.OPEN)
        self.near = ShmServer(self.engine, LIMITS, NoKey.OPEN)
        self.own.open()
        self.near.open()
        self.engine.start()
        self.shutdown = Shutdown()
        # The event loop of requests to the server's port.
        self._loop: asyncio.AbstractEventLoop | None = None
        self.requests = 0  # number of HTTP requests and WebSockets in progress
        routes = dialect_routes(
            DialectArgs(**ALL), ReplicaContext(self.engine, lambda: METADATA, LIMITS)
        )
        inside = build_http_app(self.engine, lambda: METADATA, LIMITS, more=routes)
        guarded = AccessMiddleware(
            inside, None, "app", admission=self.engine.admission, shutdown=self.shutdown
        )
        self.port = stack.enter_context(served(FrontMiddleware(self._as_in_serve(guarded))))
        self.gateways: dict[str, PortDialect] = {}
        self.ports = {name: self.open_gateway(name) for name in ("gr00t", "vlagents", "lerobot")}
        self._stopped = False
        stack.callback(self.stop)

    def hold_policy(self) -> None:
        """Send a request of another client on which the policy acts until its gate opens."""
        for session in OTHERS:
            self.ask(session, "reset")
        while not self.engine.queue.window.overlaps:
            for session in OTHERS:
                self.ask(session, "act")
        self._send(OTHERS[0], "act", HELD)
        assert self.policy.entered.wait(BOUND_S)

    def ask(self, session: str, op: Any) -> None:
        """Reset or act in a session of another client, after all waiting requests."""
        assert self._send(session, op, 1).get(timeout=BOUND_S).error is None

    def _send(self, session: str, op: Any, brightness: int) -> queue.SimpleQueue[Reply]:
        replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
        request = Request(op, Obs({"front": image(brightness)}))
        self.engine.intake.submit([pending(session, request, replies.put)])
        return replies

    def freeze(self) -> threading.Event:
        """Block all threads that read connections until the returned event is set."""
        continues = threading.Event()
        self.stack.callback(continues.set)
        schedules: list[Callable[[Callable[[], None]], object]] = [
            self.engine.queue.poller.call_soon,
            _own_poller().call_soon,
        ]
        if self._loop is not None:
            schedules.append(self._loop.call_soon_threadsafe)

        for schedule in schedules:
            frozen = threading.Event()

            def stand_still(frozen: threading.Event = frozen) -> None:
                frozen.set()
                continues.wait(4 * BOUND_S)

            schedule(stand_still)
            assert frozen.wait(BOUND_S)
        return continues

    def is_stopping(self) -> bool:
        """Return whether all parts of the server are stopping that do not wait for the policy's
        gate.
        """
        gateways = self.gateways.values()
        closing = all(
            (getattr(one, "_stopping", None) or one._closing).is_set() for one in gateways
        )  # type: ignore[attr-defined]
        return closing and (self.requests > 0 or self.engine.queue._closed)

    def stop(self) -> None:
        """Stop the replica as Serve and `PolicyReplica` do: requests in progress end first, then
        the engine and its endpoints.
        """
        if self._stopped:
            return
        self._stopped = True
        with ThreadPoolExecutor() as threads:
            closing = [threads.submit(dialect.close) for dialect in self.gateways.values()]
            self.shutdown.begin()
            wait_for(lambda: not self.requests, BOUND_S)
            self.engine.close()
            for endpoint in (self.own, self.near):
                endpoint.close()
            for closed in closing:
                closed.result()

    def relay(self, name: str) -> SlowRelay:
        """Put a relay in front of the own port of the replica or of a dialect, for later
        clients.
        """
        port = self.own.address.port if name == "own port" else self.ports[name.lower()]
        relay = SlowRelay(port, self.stack)
        if name == "own port":
            self.own.address = replace(self.own.address, port=relay.port)
        else:
            self.ports[name.lower()] = relay.port
        return relay

    def is_listening(self) -> bool:
        """Return whether the own port of the replica or of a dialect accepts connections."""
        return self.own._listener.fileno() >= 0 or any(
            dialect.alive() for dialect in self.gateways.values()
        )

    def _as_in_serve(self, app: ASGIApp) -> ASGIApp:
        """Count the requests in progress, and cancel an HTTP request when its client leaves, like
        Serve does.
        """

        async def run(scope: Scope, receive: Receive, send: Send) -> None:
            self._loop = asyncio.get_running_loop()
            self.requests += 1
            try:
                if scope["type"] != "http":
                    await app(scope, receive, send)
                    return
                messages: asyncio.Queue[Message] = asyncio.Queue()

                async def read() -> None:
                    message: Message = {}
                    while message.get("type") != "http.disconnect":
                        message = await receive()
                        messages.put_nowait(message)

                reading = asyncio.ensure_future(read())
                answering = asyncio.ensure_future(app(scope, messages.get, send))
                await asyncio.wait({reading, answering}, return_when=asyncio.FIRST_COMPLETED)
                reading.cancel()
                if not answering.done():
                    answering.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await answering
            finally:
                self.requests -= 1

        return run

    def open_gateway(self, name: str, **settings: Any) -> int:
        """Serve a dialect with a separate port, and return the port."""
        cls, port = dialect_class(name), free_port()
        context = GatewayContext("app", self._agent, LIMITS, 100, 30.0, None, NoKey.OPEN)
        dialect = cls(name, cls.Config(port=port, **settings), context)
        dialect.serve(reserve(name, "127.0.0.1", port))
        self.gateways[name] = dialect
        return port

    def _agent(self, _key: str | None, priority: PriorityName | None) -> RemoteAgent:
        agent = RemoteAgent("http://127.0.0.1:9", priority=priority or "robot")
        engines: Any = SimpleNamespace(
            engines=[self.engine],
            dead=set(),
            frozen=set(),
            prefer=0,
            lose_reply=False,
            stopping=False,
            frames=[],
        )
        transport = InProcess(engines)
        agent._connection = Connection(agent.url, lambda _: transport, CodecChoice("raw"), 5.0, 5.0)
        return agent


class LeavingClient(abc.ABC):
    """A client with a session in which it has acted once."""

    closes_with_code = False  # whether its connection is a WebSocket

    def __init__(self, server: StoppableServer) -> None:
        self.server = server

    @abc.abstractmethod
    def send(self, brightness: int) -> None:
        """Send an act, without waiting for the answer."""

    @abc.abstractmethod
    def answer(self) -> str:
        """Wait for the answer, and return `ACTED` or the code of an error."""

    @abc.abstractmethod
    def send_half(self) -> None:
        """Send the first half of an act message."""

    @abc.abstractmethod
    def end(self) -> str:
        """Wait until the server has ended the connection; return the close code and its reason, if
        they exist.
        """

    @abc.abstractmethod
    def leave(self) -> None:
        """Close the connection at once."""


class WebSocketClient(LeavingClient):
    closes_with_code = True

    def __init__(
        self,
        server: StoppableServer,
        path: str,
        message: Callable[[int], bytes],
        read: Callable[[bytes | str], str],
        opening: bytes = b"",
        greets: bool = False,
    ) -> None:
        super().__init__(server)
        self._message, self._read = message, read
        port = server.port
        if path == "own":
            port, path = server.own.address.port, server.own.address.path
        url = f"ws://127.0.0.1:{port}{path}"
        self._socket = server.stack.enter_context(
            connect(url, compression=None, ping_interval=None, close_timeout=0.1, max_size=None)
        )
        if greets:
            self._socket.recv(BOUND_S)
        if opening:
            self._socket.send(opening)
            self._socket.recv(BOUND_S)
        self.send(2)
        assert self.answer() == ACTED

    def send(self, brightness: int) -> None:
        self._socket.send(self._message(brightness))

    def answer(self) -> str:
        return self._read(self._socket.recv(BOUND_S))

    def send_half(self) -> None:
        frame = Frame(Opcode.BINARY, self._message(2)).serialize(mask=True)
        self._socket.socket.sendall(frame[: len(frame) // 2])

    def end(self) -> str:
        try:
            while True:
                self._socket.recv(BOUND_S)
        except ConnectionClosed as closed:
            return (
                "no close code"
                if closed.rcvd is None
                else f"{closed.rcvd.code} {closed.rcvd.reason}"
            )

    def leave(self) -> None:
        self._socket.socket.shutdown(socket.SHUT_RDWR)


class XPolicyLabClient(WebSocketClient):
    """A client that repeats its message over a new connection if the server ends the
    current one.
    """

    def answer(self) -> str:
        try:
            return super().answer()
        except ConnectionClosed:
            return "unavailable"


class HttpClient(LeavingClient):
    def __init__(
        self,
        server: StoppableServer,
        path: str,
        document: Callable[[int], bytes],
        kind: str,
        at_own_port: bool = False,
    ) -> None:
        super().__init__(server)
        port, base = server.port, "/v1"
        if at_own_port:
            port, base = server.own.address.port, server.own.address.path
        self._path, self._document = path.replace("/v1", base), document
        self._headers = {"x-session-id": "robot-1", "content-type": kind}
        self._connection = http.client.HTTPConnection("127.0.0.1", port, timeout=BOUND_S)
        server.stack.callback(self._connection.close)
        if path == "/v1/act":
            reset = encode_requests([Request("reset", Obs({"front": image(2)}))])
            self._connection.request("POST", f"{base}/reset", reset, self._headers)
            assert self._connection.getresponse().read()
        self.send(2)
        assert self.answer() == ACTED

    def send(self, brightness: int) -> None:
        self._connection.request("POST", self._path, self._document(brightness), self._headers)

    def answer(self) -> str:
        response = self._connection.getresponse()
        content = response.read()
        return ACTED if response.status == 200 else str(json.loads(content)["code"])

    def send_half(self) -> None:
        document = self._document(2)
        self._connection.putrequest("POST", self._path)
        for name, value in {**self._headers, "content-length": str(len(document))}.items():
            self._connection.putheader(name, value)
        self._connection.endheaders(document[: len(document) // 2])

    def end(self) -> str:
        # The answer to the half message, since an idle connection ends only with the process.
        return self.answer()

    def leave(self) -> None:
        self._connection.sock.shutdown(socket.SHUT_RDWR)


class ThreadedClient(LeavingClient):
    """A client whose calls wait for the answer, and therefore run in a thread."""

    def __init__(self, server: StoppableServer) -> None:
        super().__init__(server)
        self._threads = ThreadPoolExecutor(1)
        self._answer: Future[str] = Future()

    def send(self, brightness: int) -> None:
        self._answer = self._threads.submit(self.act, brightness)

    def answer(self) -> str:
        return self._answer.result(BOUND_S)

    @abc.abstractmethod
    def act(self, brightness: int) -> str: ...


class ShmClient(ThreadedClient):
    def __init__(self, server: StoppableServer) -> None:
        super().__init__(server)
        self._transport = ShmTransport(server.near.address, Credentials(""))
        self._transport.connect(BOUND_S)
        server.stack.callback(self._transport.close)
        self._transport.call([Request("reset", Obs({"front": image(2)}), request_id="0")], BOUND_S)
        assert self.act(2) == ACTED

    def act(self, brightness: int) -> str:
        request = Request("act", Obs({"front": image(brightness)}), request_id=str(brightness))
        try:
            error = self._transport.call([request], BOUND_S)[0].error
        except VLAgentsError as raised:
            error = raised
        return ACTED if error is None else error.code

    def send_half(self) -> None:
        """Do nothing, since a datagram is always sent as a whole."""

    def end(self) -> str:
        while (code := self.act(2)) != ConnectionLost.code:
            assert code != ACTED
        return code

    def leave(self) -> None:
        self._transport._socket.shutdown(socket.SHUT_RDWR)  # type: ignore[union-attr]


class Gr00tClient(LeavingClient):
    def __init__(self, server: StoppableServer) -> None:
        super().__init__(server)
        self._client = server.stack.enter_context(
            PolicyClient(server.ports["gr00t"], timeout_ms=int(BOUND_S * 1e3))
        )
        self.send(2)
        assert self.answer() == ACTED

    def send(self, brightness: int) -> None:
        observation = {
            "video": {"ego": np.full((1, 1, 8, 8, 3), brightness, np.uint8)},
            "state": {"arm": np.zeros((1, 1, 3), np.float32)},
            "language": {"task": [["a task"]]},
        }
        data = {"observation": observation, "options": None}
        self._client.socket.send(
            msgpack.packb({"endpoint": "get_action", "data": data}, default=encode)
        )

    def answer(self) -> str:
        reply = msgpack.unpackb(self._client.socket.recv())
        return (
            str(reply["error"]).partition(":")[0]
            if isinstance(reply, dict) and "error" in reply
            else ACTED
        )

    def send_half(self) -> None:
        address = "127.0.0.1", self.server.ports["gr00t"]
        self._half = self.server.stack.enter_context(
            socket.create_connection(address, timeout=BOUND_S)
        )
        self._half.sendall(b"\xff\0\0\0\0\0\0\0\1\x7f")  # the first part of ZeroMQ's greeting

    def end(self) -> str:
        if hasattr(self, "_half"):
            return _end_of(self._half)
        # ZeroMQ connects again automatically, and does not report the end of a connection
        return "ended"

    def leave(self) -> None:
        self._client.close()


class VlagentsClient(LeavingClient):
    def __init__(self, server: StoppableServer) -> None:
        super().__init__(server)
        self._client = server.stack.enter_context(RpycClient(server.ports["vlagents"], BOUND_S))
        self.send(2)
        assert self.answer() == ACTED

    def send(self, brightness: int) -> None:
        self._client.send(call("act", document(brightness)))

    def answer(self) -> str:
        kind, _, content = self._client.receive()
        return ACTED if kind == 2 else str(content[1][0]).partition(":")[0]

    def send_half(self) -> None:
        message = call("act", document(2))
        self._client.send(message[: len(message) // 2])

    def end(self) -> str:
        return _end_of(self._client.socket)

    def leave(self) -> None:
        self._client.socket.shutdown(socket.SHUT_RDWR)


class LeRobotClient(LeavingClient):
    def __init__(self, server: StoppableServer) -> None:
        super().__init__(server)
        self._client = server.stack.enter_context(AsyncClient(server.ports["lerobot"])).begin()
        self._timestep = 0
        self._half_sent = threading.Event()
        self.send(2)
        assert self.answer() == ACTED

    def send(self, brightness: int) -> None:
        self._client.send(robot_saw(self._timestep, pixel=brightness))
        self._timestep += 1
        self._actions = self._client.get.future(b"", timeout=BOUND_S)

    def answer(self) -> str:
        return self._outcome(self._actions)

    def send_half(self) -> None:
        parts = list(parts_of(pickled(robot_saw(self._timestep)), 40))
        arrived = threading.Event()

        def half() -> Any:
            yield from parts[: len(parts) // 2]
            arrived.set()
            self._half_sent.wait(BOUND_S)

        self._sending = self._client.send_parts.future(half(), timeout=BOUND_S)
        assert arrived.wait(BOUND_S)

    def end(self) -> str:
        if hasattr(self, "_sending"):
            outcome = self._outcome(self._sending)
            self._half_sent.set()
            return outcome
        return self._outcome(self._client.get.future(b"", timeout=BOUND_S))

    def leave(self) -> None:
        self._client.channel.close()

    @staticmethod
    def _outcome(call: Any) -> str:
        try:
            return ACTED if call.result() else "no actions"
        except grpc.RpcError as error:
            return str(error.code().name).lower()  # type: ignore[attr-defined]


class RemoteRobotClient(LeavingClient):
    """A robot of LeRobot's remote inference. The gateway takes a while to open, so only this client
    opens it.
    """

    def __init__(self, server: StoppableServer) -> None:
        super().__init__(server)
        settings = SETTINGS | {"action": SETTINGS["action"] | {"shape": [8]}, "steps": 1}
        port = server.open_gateway("lerobot_remote", **settings)
        self._robot = RemoteRobot(port)
        server.stack.callback(self._robot.leave)
        self._robot.begin(action_feature=self._robot.descriptor["capabilities"]["action_feature"])
        self.send(2)
        assert self.answer() == ACTED

    def send(self, brightness: int) -> None:
        features = {
            FRONT["name"]: rgb(image(brightness)),
            STATE["name"]: np.zeros(3, np.float32),
        }
        self._robot.send(brightness, features=features)

    def answer(self) -> str:
        answer = self._robot.answers.get(timeout=BOUND_S)
        if answer.message_type == "action":
            return ACTED
        return "unavailable" if "stopping" in answer.body["message"] else answer.body["code"]

    def send_half(self) -> None:
        """Do nothing, since a sample is always sent as a whole."""

    def end(self) -> str:
        while self._robot.presence.get(timeout=BOUND_S):
            pass
        return "ended"

    def leave(self) -> None:
        self._robot.leave()


def _end_of(connection: socket.socket) -> str:
    connection.settimeout(BOUND_S)
    with contextlib.suppress(ConnectionResetError):
        while connection.recv(2**16):
            pass
    return "ended"


def _frame(op: Any, brightness: int) -> bytes:
    return encode_requests([Request(op, Obs({"front": image(brightness)}))])


def _read_frame(data: bytes | str) -> str:
    assert isinstance(data, bytes)
    error = decode_replies(data)[0].error
    return ACTED if error is None else error.code


def _read_map(data: bytes | str) -> str:
    if isinstance(data, bytes):
        assert b"actions" in data
        return ACTED
    return "unavailable" if "stopping" in data else data


def _see(brightness: int) -> bytes:
    return vla_eval_codec.encode(
        vla_eval_codec.VlaEvalMessage("observation", seen(brightness), brightness)
    )


def _read_vla_eval(data: bytes | str) -> str:
    assert isinstance(data, bytes)
    return str(vla_eval_codec.decode(data).payload.get("code", ACTED))


def _arena(brightness: int) -> bytes:
    return libero(brightness, endpoint="infer", session_id="a")


def _ask_sglang(brightness: int) -> bytes:
    seen_now = {"images": {"front": image(brightness)}, "state": np.ones(3)}
    return openpi_codec.encode({"input": {"prompt": "task 1", "observation": seen_now}})


def _read_sglang(data: bytes | str) -> str:
    assert isinstance(data, bytes)
    error = openpi_codec.decode(data).get("error")
    if error is None:
        return ACTED
    return "unavailable" if "stopping" in error else str(error)


def _ask_xpolicylab(brightness: int) -> bytes:
    observation = xpolicylab_observation(brightness)
    return xpolicylab("infer", f"m-{brightness}", observation=observation)


def _read_xpolicylab(data: bytes | str) -> str:
    assert isinstance(data, bytes)
    return xpolicylab_error(data) or ACTED


Connect = Callable[[StoppableServer], LeavingClient]
_opened = partial(
    WebSocketClient, message=partial(_frame, "act"), read=_read_frame, opening=_frame("reset", 2)
)
CLIENTS: dict[str, Connect] = {
    "own port": partial(_opened, path="own"),
    "WS /v1/stream": partial(_opened, path="/v1/stream"),
    "WS /openpi": partial(
        WebSocketClient, path="/openpi", message=libero, read=_read_map, greets=True
    ),
    "WS /roboarena": partial(
        WebSocketClient, path="/roboarena", message=_arena, read=_read_map, greets=True
    ),
    "WS /vla-eval": partial(WebSocketClient, path="/vla-eval", message=_see, read=_read_vla_eval),
    "WS /xpolicylab": partial(
        XPolicyLabClient, path="/xpolicylab", message=_ask_xpolicylab, read=_read_xpolicylab
    ),
    "WS /v1/actions/realtime": partial(
        WebSocketClient,
        path="/v1/actions/realtime",
        message=_ask_sglang,
        read=_read_sglang,
        greets=True,
    ),
    "POST /v1/actions/generations": partial(
        HttpClient,
        path="/v1/actions/generations",
        document=_ask_sglang,
        kind="application/msgpack",
    ),
    "POST /v1/act": partial(
        HttpClient,
        path="/v1/act",
        document=partial(_frame, "act"),
        kind="application/x-vlagents-frame",
    ),
    "POST at the own port": partial(
        HttpClient,
        path="/v1/act",
        document=partial(_frame, "act"),
        kind="application/x-vlagents-frame",
        at_own_port=True,
    ),
    "POST /act": partial(
        HttpClient,
        path="/act",
        document=lambda brightness: json.dumps(body(brightness)).encode(),
        kind="application/json",
    ),
    "shared memory": ShmClient,
    "GR00T": Gr00tClient,
    "vlagents": VlagentsClient,
    "LeRobot": LeRobotClient,
    "lerobot_remote": RemoteRobotClient,
}
GATEWAYS = ("GR00T", "vlagents", "LeRobot", "lerobot_remote")


def seconds_of(call: Callable[[], Any]) -> float:
    """Return the duration of a call in seconds."""
    begun = time.perf_counter()
    call()
    return time.perf_counter() - begun
