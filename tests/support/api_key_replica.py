"""A replica with API keys in this process, and functions that send a request to each of its
endpoints and return the outcome as one word.
"""

from __future__ import annotations

import contextlib
import http.client
import itertools
import json
import re
import socket
import struct
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from asgi_server import served
from dialect_server import (
    ALL,
    METADATA,
    body,
    libero,
    seen,
    xpolicylab,
    xpolicylab_error,
    xpolicylab_observation,
)
from eval_fakes import wait_for
from gr00t_client import PolicyClient
from in_flight import answer_to_frame, opened
from in_memory_keys import ChangingKeys
from in_process_replicas import InProcess
from lerobot_messages import AsyncClient, robot_saw
from remote_robot import SETTINGS, RemoteRobot
from rpyc_client import Client, document
from websockets.client import ClientProtocol
from websockets.exceptions import InvalidStatus
from websockets.frames import Close, Frame, Opcode
from websockets.protocol import State
from websockets.uri import parse_uri

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.client.connection import Connection
from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.base import CodecChoice
from vlagents_ray.client.transports.shm import ShmTransport
from vlagents_ray.errors import BY_CODE, TooManyRequests, VLAgentsError
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.frames import decode_replies, encode_requests
from vlagents_ray.protocol.messages import (
    PROTOCOL_VERSION,
    LocalAddress,
    MessageLimits,
    PlasmaAddress,
    PriorityName,
    Request,
)
from vlagents_ray.registry import dialect_class
from vlagents_ray.serve import periodic
from vlagents_ray.serve.access import api_keys
from vlagents_ray.serve.config.dialects import DialectArgs
from vlagents_ray.serve.config.parts import PartArgs
from vlagents_ray.serve.dialects.base import GatewayContext, ReplicaContext, dialect_routes
from vlagents_ray.serve.endpoints import access_middleware, own_port
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.front import FrontMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.ports import free_port, reserve
from vlagents_ray.serve.replica.part import PartContext, open_parts
from vlagents_ray.weights.safetensors import ValueSpec, header_of, read_header
from vlagents_ray_dialects.messages import openpi as openpi_codec
from vlagents_ray_dialects.messages import vla_eval as vla_eval_codec
from vlagents_ray_learn.weight_push import PushResult
from vlagents_ray_learn.weights_endpoint import weights_routes

ANSWER_S = 10.0
LIMITS = MessageLimits(body_bytes=2**20)
_NUMBERS = itertools.count()
_WORDS = {  # patterns in the messages of rejections, for protocols without error codes
    "401": r"revoked|expired|not known|needs an API key",
    "403": r"is for \[",
    "429": r"requests a second|may hold \d+ sessions|sessions here",
}


class Done(list[str]):
    """Marks of the requests that reached the policy, in all sessions."""


class Recorder(Agent):
    """A policy that records the marks of the requests that reach it."""

    def __init__(self) -> None:
        self.done = Done()

    def shared_objects(self) -> list[object]:
        return [self.done]

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.instruction = str(instruction)
        self.done.append(self.instruction)
        return {}

    def act(self, obs: Obs) -> Act:
        self.done.append(str(obs.info.get("mark", self.instruction)))
        return Act(np.zeros(8, np.float32))


@dataclass
class Visitor:
    """A client with one kind of credential, and a mark that identifies its request."""

    replica: KeyedReplica
    credential: str
    name: str = field(default_factory=lambda: f"key-{next(_NUMBERS)}")

    def __post_init__(self) -> None:
        self.token = self.replica.known.add(self.name)
        self.mark = f"mark of {self.name}"

    @property
    def shown(self) -> str | None:
        """Return the key that the client sends after `become`."""
        return {"none": None, "wrong": "vlr_wrong"}.get(self.credential, self.token)

    @property
    def ends(self) -> bool:
        """Return whether the server ends this client's connection."""
        return self.credential in ("expired", "revoked", "another application's")

    def become(self) -> None:
        """Turn the key, which was valid so far, into the kind that the credential names."""
        changes: dict[str, dict[str, Any]] = {
            "expired": {"expires": 1.0},
            "revoked": {"revoked": True},
            "another application's": {"apps": ["another"]},
            "simulation": {"priority": "simulation"},
            "over its rate": {"rate": 1e-6},
            "over its sessions": {"sessions": 1},
        }
        if self.credential not in changes:
            return
        self.replica.known.change(self.name, **changes[self.credential])
        for keys in (self.replica.known.keys, self.replica.at_gateway):
            if self.credential == "over its rate":
                # The end of a rejected WebSocket has already been charged to the key.
                with contextlib.suppress(TooManyRequests):
                    keys.check(self.token, "app").take_request()
            if self.credential == "over its sessions":
                keys.hold(self.name, 1, None)
        if self.credential == "over its sessions":
            opened(self.replica.engine.sessions, f"{self.name}/held")


class KeyedReplica:
    """An engine and all servers and middleware in front of it."""

    def __init__(
        self, stack: contextlib.ExitStack, patch: pytest.MonkeyPatch, folder: Path
    ) -> None:
        patch.setattr(api_keys, "_CHECK_S", 0.0)
        # Each test changes keys, and the changes must be read in time even on a busy machine.
        patch.setattr(api_keys, "_WAIT_S", 60.0)
        patch.setattr(access_middleware, "_TICK_S", 0.02)
        patch.setattr(periodic.each_half_second, "_period_s", 0.02)
        self.known = ChangingKeys()
        self.at_gateway = self.known.another()  # the keys as another process reads them
        self.policy = Recorder()
        self.engine = Engine(self.policy, EngineSettings(session_limit=5000))
        self.priorities: dict[str, str] = {}
        self._watch_priorities()
        check_key = partial(self.known.keys.check, app="app")
        self.own = OwnPortServer(self.engine, LIMITS, "127.0.0.1", None, check_key)
        self.local = ShmServer(self.engine, LIMITS, check_key)
        self.plasma = plasma_server(self.engine, LIMITS, patch, folder)
        for each in (self.own, self.local, self.plasma):
            each.open()
        self.engine.start()
        routes = dialect_routes(
            DialectArgs(**ALL), ReplicaContext(self.engine, lambda: METADATA, LIMITS)
        )
        metadata = METADATA | {"policy_version": None, "weights": None}
        context = PartContext(self.engine, "this", "here", lambda: metadata)
        # Without the part of weights, whose routes are added below with another receiver.
        parts = open_parts(PartArgs(weights=None), context)
        stack.callback(parts.close)
        others = [*weights_routes(_Receiving(self), 30.0, open_to_network=False), *parts.routes()]
        inside = build_http_app(self.engine, lambda: METADATA, LIMITS, more=[*routes, *others])
        self.routes = inside.routes
        with_access = AccessMiddleware(
            inside,
            self.known.keys,
            "app",
            admission=self.engine.admission,
            public=parts.pages(inside.routes),
        )
        self.port = stack.enter_context(served(FrontMiddleware(with_access)))
        check = partial(self.at_gateway.check, app="app")
        self.gr00t = {
            near: self._on_own_port(stack, "gr00t", near, check) for near in (True, False)
        }
        self.vlagents = self._on_own_port(stack, "vlagents", False, check, without_key=True)
        self.lerobot = self._on_own_port(stack, "lerobot", False, check, without_key=True)
        self.lerobot_remote = self._on_own_port(
            stack, "lerobot_remote", False, check, without_key=True, **SETTINGS
        )
        stack.callback(self._close)

    def visitor(self, credential: str) -> Visitor:
        """Return a client with a new key."""
        return Visitor(self, credential)

    def _close(self) -> None:
        self.engine.close()
        for each in (self.own, self.local, self.plasma):
            each.close()

    def _watch_priorities(self) -> None:
        put = self.engine.queue.put

        def watched(*tickets: Any) -> None:
            for ticket in tickets:
                obs = ticket.request.obs
                mark = (
                    ticket.request.instruction
                    or (obs is not None and obs.info.get("mark"))
                    or ticket.session_id
                )
                self.priorities[str(mark)] = ticket.priority.name
            put(*tickets)

        self.engine.queue.put = watched  # type: ignore[method-assign]

    def _agent(self, near: bool, key: str | None, priority: PriorityName | None) -> RemoteAgent:
        agent = RemoteAgent("http://127.0.0.1:9", priority=priority or "robot")
        engines = SimpleNamespace(
            engines=[self.engine],
            dead=set(),
            frozen=set(),
            prefer=0,
            lose_reply=False,
            stopping=False,
            frames=[],
        )
        transport = (
            _Near(self.local.address, Credentials(key or "")) if near else InProcess(engines)
        )  # type: ignore[arg-type]
        agent._connection = Connection(agent.url, lambda _: transport, CodecChoice("raw"), 5.0, 5.0)  # type: ignore[arg-type]
        return agent

    def _on_own_port(
        self, stack: contextlib.ExitStack, name: str, near: bool, check: Any, **settings: Any
    ) -> int:
        """Serve a dialect of the gateway, and return its port."""
        cls, port = dialect_class(name), free_port()
        context = GatewayContext("app", partial(self._agent, near), LIMITS, 100, 2.0, None, check)
        dialect = cls(name, cls.Config(port=port, **settings), context)
        dialect.serve(reserve(name, "127.0.0.1", port))
        stack.callback(dialect.close)
        return port


class _Near(ShmTransport):
    def connect(self, timeout_s: float) -> dict[str, Any]:  # type: ignore[override]
        super().connect(timeout_s)
        return {"protocol": PROTOCOL_VERSION, "contract": None}


def plasma_server(
    engine: Engine, limits: MessageLimits, patch: pytest.MonkeyPatch, folder: Path
) -> Any:
    """Return a plasma endpoint whose channels contain frames as they are."""
    import ray

    from vlagents_ray.serve.endpoints.plasma import PlasmaServer

    node = SimpleNamespace(plasma_store_socket_name=str(folder / "plasma_store"))
    with pytest.MonkeyPatch.context() as for_now:
        for_now.setattr(ray._private.worker.global_worker, "node", node, raising=False)
        for_now.setattr(
            ray, "get_runtime_context", lambda: SimpleNamespace(get_node_id=lambda: "node")
        )
        server = PlasmaServer(engine, limits)
    patch.setattr(server.pool, "claim", PlasmaChannel)
    patch.setattr(server.pool, "release", lambda _channel: None)
    return server


class PlasmaChannel:
    """A channel whose frame is the one that the client wrote under the channel's key."""

    frames: ClassVar[dict[bytes, bytes]] = {}

    capacity = 2**20

    def __init__(self, key: bytes) -> None:
        self.ref = SimpleNamespace(binary=lambda: key)
        self._key = key

    def read(self) -> np.ndarray:
        return np.frombuffer(self.frames[self._key], np.uint8)


@contextlib.contextmanager
def keyed_replica(folder: Path) -> Iterator[KeyedReplica]:
    """Yield a replica for any number of clients."""
    with pytest.MonkeyPatch.context() as patch, contextlib.ExitStack() as stack:
        yield KeyedReplica(stack, patch, folder)


Attempt = Callable[[Visitor, str], str]
"""Sends a request before, with or after the credential, and returns the outcome: an HTTP status,
"done" or "ended".
"""


def over_http(method: str, path: str, **options: Any) -> Attempt:
    """Return an attempt over HTTP. With `session`, the client first resets a session while its key
    is still valid. With `own`, the request goes to the replica's own port.
    """

    def attempt(visitor: Visitor, _when: str) -> str:
        def ask(method: str, path: str, document: dict[str, Any] | None, token: str | None) -> int:
            port, own = visitor.replica.port, visitor.replica.own
            if options.get("own"):
                port, path = own.address.port, own.path + path.removeprefix("/v1")
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=ANSWER_S)
            headers = (
                {"x-session-id": "robot-1", "content-type": "application/json"}
                if path != "/act"
                else {}
            )
            headers |= {} if token is None else {"authorization": f"Bearer {token}"}
            with contextlib.closing(connection):
                content = json.dumps(document).encode()
                connection.request(method, path, None if document is None else content, headers)
                return connection.getresponse().status

        if options.get("session"):
            assert ask("POST", "/v1/reset", {"instruction": "before"}, visitor.token) == 200
        visitor.become()
        document = options.get("document", lambda _mark: None)(visitor.mark)
        status = ask(method, path, document, visitor.shown)
        gone = f"{visitor.name}/robot-1" not in visitor.replica.engine.sessions
        if path == "/v1/close" and gone:
            visitor.replica.policy.done.append(visitor.mark)
            visitor.replica.priorities[visitor.mark] = visitor.replica.priorities[
                f"{visitor.name}/robot-1"
            ]
        return str(status)

    return attempt


def over_websocket(
    path: str, message: Callable[[str], bytes], read: Callable[[bytes | str], str | None]
) -> Attempt:
    """Return an attempt over a WebSocket. `message` encodes a request with a mark; `read` returns
    the outcome that a received message contains, or None if it contains none.
    """

    def attempt(visitor: Visitor, when: str) -> str:
        replica = visitor.replica
        port, place = replica.port, path
        if path.startswith("own"):
            port, place = replica.own.address.port, replica.own.path + path.removeprefix("own")
        protocol = ClientProtocol(parse_uri(f"ws://127.0.0.1:{port}{place}"))
        with socket.create_connection(("127.0.0.1", port), timeout=ANSWER_S) as connection:
            if when == "before":
                visitor.become()
                with pytest.MonkeyPatch.context() as impatient:
                    impatient.setattr(own_port, "_HANDSHAKE_S", 0.1)
                    connection.sendall(_frame(message(visitor.mark)) * 3)
                    return _until_closed(connection)
            refused = visitor.credential in ("none", "wrong")
            if when == "with" or refused:
                visitor.become()
            request = protocol.connect()
            shown = visitor.token if when == "after" and not refused else visitor.shown
            if shown is not None:
                request.headers["authorization"] = f"Bearer {shown}"
            protocol.send_request(request)
            handshake, asked = b"".join(protocol.data_to_send()), _frame(message(visitor.mark))
            connection.sendall(handshake + (asked if when == "with" else b""))
            while protocol.state is State.CONNECTING and protocol.handshake_exc is None:
                protocol.receive_data(_some(connection))
            if when == "with":
                if protocol.state is State.OPEN and not path.startswith("own"):
                    # Uvicorn drops a message that arrives in the same segment as the handshake.
                    connection.sendall(asked)
                return _answer(protocol, connection, read)
            said = "" if protocol.handshake_exc is None else _answer(protocol, connection, read)
            if not refused:
                visitor.become()
            with contextlib.suppress(OSError):  # the server may already have closed the connection
                connection.sendall(asked)
                said = said or _answer(protocol, connection, read)
            if visitor.ends:
                _until_ended(protocol, connection)
            return said or "ended"

    return attempt


def _frame(payload: bytes) -> bytes:
    return bytes([0x82, 0x80 | 127]) + struct.pack(">Q", len(payload)) + bytes(4) + payload


def _until_closed(connection: socket.socket) -> str:
    """Read until the server closes the connection, and fail if it does not."""
    with contextlib.suppress(ConnectionError):
        while connection.recv(65536):
            pass
    return "ended"


def _some(connection: socket.socket) -> bytes:
    data = connection.recv(65536)
    if not data:
        raise ConnectionError("the server closed the connection without an answer")
    return data


def _until_ended(protocol: ClientProtocol, connection: socket.socket) -> None:
    """Read and answer the server's close frame, and fail if it does not arrive."""
    with contextlib.suppress(ConnectionError):
        while protocol.state is State.OPEN and (data := connection.recv(65536)):
            protocol.receive_data(data)
        connection.sendall(b"".join(protocol.data_to_send()))


def _answer(
    protocol: ClientProtocol, connection: socket.socket, read: Callable[[bytes | str], str | None]
) -> str:
    while True:
        for event in protocol.events_received():
            if isinstance(event, Frame) and event.opcode in (Opcode.BINARY, Opcode.TEXT):
                data = bytes(event.data)
                if (
                    said := read(data.decode() if event.opcode is Opcode.TEXT else data)
                ) is not None:
                    return said
            elif isinstance(event, Frame) and event.opcode is Opcode.CLOSE:
                return status_of(Close.parse(bytes(event.data)).reason)
        if isinstance(protocol.handshake_exc, InvalidStatus):
            return str(protocol.handshake_exc.response.status_code)
        data = connection.recv(65536)
        if not data:
            protocol.receive_eof()
            if isinstance(protocol.handshake_exc, InvalidStatus):
                return str(protocol.handshake_exc.response.status_code)
            return "ended"
        protocol.receive_data(data)


def status_of(text: str) -> str:
    """Return the HTTP status that matches the text of a rejection, `code: message` or the message
    alone.
    """
    code = text.partition(":")[0].removeprefix("Server error: ")
    if code in BY_CODE:
        return str(BY_CODE[code].status)
    return next((status for status, words in _WORDS.items() if re.search(words, text)), text)


def _read_reply(data: bytes | str) -> str:
    assert isinstance(data, bytes)
    error = decode_replies(data)[0].error
    return "done" if error is None else str(error.status)


def _read_map(data: bytes | str) -> str | None:
    if isinstance(data, str):
        return status_of(data)
    return "done" if b"actions" in data else None  # the server's first message is its metadata


def _read_vla_eval(data: bytes | str) -> str:
    assert isinstance(data, bytes)
    payload = vla_eval_codec.decode(data).payload
    return str(BY_CODE[payload["code"]].status) if "code" in payload else "done"


def over_shm(visitor: Visitor, when: str) -> str:
    """Send a request over shared memory."""
    address = visitor.replica.local.address
    if when != "after":
        visitor.become()
    refused = visitor.credential in ("none", "wrong")
    token = visitor.token if when == "after" and not refused else visitor.shown
    transport = ShmTransport(replace(address, keyed=when != "before"), Credentials(token or ""))
    with contextlib.closing(transport):
        transport.connect(ANSWER_S)
        if when == "after":
            if not refused:
                local = visitor.replica.local
                wait_for(
                    lambda: any(
                        getattr(c.caller, "name", "") == visitor.name for c in list(local._clients)
                    )
                )
            visitor.become()
        try:
            [reply] = transport.call([Request("reset", Obs(), visitor.mark)], ANSWER_S)
        except VLAgentsError:  # the server closed the connection
            return "ended"
        if when == "after" and visitor.ends:
            with pytest.raises(VLAgentsError, match=r"closed|reset|pipe"):
                wait_for(lambda: not transport.call([Request("close")], ANSWER_S))
        return "done" if reply.error is None else str(reply.error.status)


def over_plasma(visitor: Visitor, _when: str) -> str:
    """Send a request through a plasma channel."""
    visitor.become()
    key = visitor.name.encode().ljust(28, b"\0")
    PlasmaChannel.frames[key] = encode_requests([Request("reset", Obs(), visitor.mark)])
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        connection.settimeout(ANSWER_S)
        connection.connect(visitor.replica.plasma.plasma.socket)
        connection.send(PlasmaAddress.REQUEST.pack(key, 0))
        reply = connection.recv(65536)
    return _read_reply(reply[LocalAddress.REPLY.size :])


def over_handle(visitor: Visitor, _when: str) -> str:
    """Call the entry point of the actor that a Serve handle calls."""
    visitor.become()
    frame = encode_requests([Request("reset", Obs(), visitor.mark)])
    [reply] = decode_replies(answer_to_frame(visitor.replica.engine, LIMITS, visitor.name, frame))
    return "done" if reply.error is None else str(reply.error.status)


def over_gr00t(near: bool) -> Attempt:
    """Return an attempt through GR00T's gateway, with a replica on the same host (`near`) or on
    another.
    """

    def attempt(visitor: Visitor, when: str) -> str:
        observation = {
            "video": {"ego": np.zeros((1, 1, 8, 8, 3), np.uint8)},
            "state": {"arm": np.zeros((1, 1, 3), np.float32)},
            "language": {"task": [[visitor.mark]]},
        }
        refused = visitor.credential in ("none", "wrong")
        if when == "with":
            visitor.become()
        token = visitor.token if when == "after" and not refused else visitor.shown
        with PolicyClient(visitor.replica.gr00t[near], token) as client:
            if when == "after":
                with contextlib.suppress(RuntimeError) if refused else contextlib.nullcontext():
                    client.ping()
                visitor.become()
            try:
                client.get_action(observation)
            except RuntimeError as error:
                return status_of(str(error).removeprefix("Server error: "))
        return "done"

    return attempt


def over_vlagents(visitor: Visitor, _when: str) -> str:
    """Send a request through vlagents' gateway, which requires no key."""
    visitor.become()
    with Client(visitor.replica.vlagents) as client:
        client.act(document(1, visitor.mark))
    return "done"


def over_lerobot(visitor: Visitor, _when: str) -> str:
    """Send a request through LeRobot's gateway, which requires no key."""
    visitor.become()
    with AsyncClient(visitor.replica.lerobot).begin() as client:
        client.act(robot_saw(0, task=visitor.mark))
    return "done"


def over_lerobot_remote(visitor: Visitor, _when: str) -> str:
    """Send a request through the gateway of LeRobot's remote inference, which requires no key."""
    visitor.become()
    with RemoteRobot(visitor.replica.lerobot_remote).begin() as robot:
        robot.act(1, visitor.mark)
    return "done"


class _Receiving:
    """Receives pushes of weights, and records the names of the weights as marks."""

    def __init__(self, replica: KeyedReplica) -> None:
        self._replica = replica

    def read_header(self, header: bytes, options: Any) -> dict[str, ValueSpec]:
        """Accept any names and shapes."""
        return read_header(header)

    async def push_received(self, values: Any, options: Any) -> PushResult:
        for mark in values:
            self._replica.policy.done.append(mark)
            self._replica.priorities[mark] = "ROBOT"
        return PushResult(1, "", ("replica",))

    async def rest_all(self, rest: Any) -> None:
        """Do nothing, since the replica is awake."""

    async def versions(self) -> list[int]:
        return [1]


def _with_scope(scope: str, without_scope: Attempt) -> Attempt:
    """Return the same attempt with a key of this scope."""

    def attempt(visitor: Visitor, when: str) -> str:
        visitor.replica.known.change(visitor.name, scopes=[scope])
        return without_scope(visitor, when)

    return attempt


def _weights(mark: str) -> bytes:
    return header_of({mark: np.zeros(0, np.float32)})


def _read_pushed(data: bytes | str) -> str:
    answer = json.loads(data)
    return str(BY_CODE[answer["code"]].status) if "code" in answer else "done"


def _press(mark: str) -> dict[str, str]:
    return {"session": f"{mark.removeprefix('mark of ')}/robot-1", "do": "pause"}


def _watch(_mark: str) -> bytes:
    return b'{"shown": []}'


def _read_seen(data: bytes | str) -> str:
    return "200" if isinstance(data, bytes) else str(BY_CODE[json.loads(data)["code"]].status)


def _stream_message(mark: str) -> bytes:
    return encode_requests([Request("reset", Obs(), mark)])


def _reset(mark: str) -> dict[str, Any]:
    return {"instruction": mark}


def _act(mark: str) -> dict[str, Any]:
    return {"info": {"mark": mark}}


def _see(mark: str) -> bytes:
    return vla_eval_codec.encode(vla_eval_codec.VlaEvalMessage("observation", seen(1, mark), 3))


def _infer(mark: str) -> bytes:
    observation = xpolicylab_observation(1, mark)
    return xpolicylab("infer", f"m-{uuid.uuid4().hex}", observation=observation)


def _read_xpolicylab(data: bytes | str) -> str:
    assert isinstance(data, bytes)
    code = xpolicylab_error(data)
    return "done" if code is None else str(BY_CODE[code].status)


def _arena(mark: str) -> bytes:
    return libero(1, mark, endpoint="infer", session_id="a")


def _ask_sglang(mark: str) -> dict[str, Any]:
    pixels = np.ones((8, 8, 3), np.uint8)
    observation = {"images": {"front": pixels}, "state": np.ones(3)}
    return {"input": {"prompt": mark, "observation": observation}}


def _ask_sglang_in_json(mark: str) -> dict[str, Any]:
    asked = _ask_sglang(mark)
    pixels = np.ones((8, 8, 3), np.uint8).tolist()
    asked["input"]["observation"] = {"images": {"front": pixels}, "state": [1.0, 1.0, 1.0]}
    return asked


def _read_sglang(data: bytes | str) -> str | None:
    assert isinstance(data, bytes)
    answer = openpi_codec.decode(data)
    if "error" in answer:
        return status_of(answer["error"])
    return "done" if "data" in answer else None  # the server's first message is its metadata


# The keys are the names of the endpoints in docs/access.md.
ATTEMPTS: dict[str, Attempt] = {
    "`GET /healthz`": over_http("GET", "/healthz"),
    "`GET /v1/metadata`": over_http("GET", "/v1/metadata"),
    "`GET /docs`": over_http("GET", "/docs"),
    "`GET /health`": over_http("GET", "/health"),
    "`GET /no/such/path`": over_http("GET", "/no/such/path"),
    "`POST /v1/reset`": over_http("POST", "/v1/reset", document=_reset),
    "`POST /v1/act`": over_http("POST", "/v1/act", document=_act, session=True),
    "`POST /v1/close`": over_http("POST", "/v1/close", document=lambda _: {}, session=True),
    "`POST /act`": over_http("POST", "/act", document=lambda mark: body(1, mark)),
    "`GET /v1/actions/metadata`": over_http("GET", "/v1/actions/metadata"),
    "`POST /v1/actions/generations`": over_http(
        "POST", "/v1/actions/generations", document=_ask_sglang_in_json
    ),
    "`WS /v1/actions/realtime`": over_websocket(
        "/v1/actions/realtime", lambda mark: openpi_codec.encode(_ask_sglang(mark)), _read_sglang
    ),
    "`WS /v1/stream`": over_websocket("/v1/stream", _stream_message, _read_reply),
    "`WS /`": over_websocket("/", partial(libero, 1), _read_map),
    "`WS /openpi`": over_websocket("/openpi", partial(libero, 1), _read_map),
    "`WS /roboarena`": over_websocket("/roboarena", _arena, _read_map),
    "`WS /vla-eval`": over_websocket("/vla-eval", _see, _read_vla_eval),
    "`WS /xpolicylab`": over_websocket("/xpolicylab", _infer, _read_xpolicylab),
    "`GET /v1/weights`": over_http("GET", "/v1/weights"),
    "`GET /v1/weights`, scope `weights`": _with_scope("weights", over_http("GET", "/v1/weights")),
    "`POST /v1/weights/{step}`": over_http("POST", "/v1/weights/wake"),
    "`POST /v1/weights/{step}`, scope `weights`": _with_scope(
        "weights", over_http("POST", "/v1/weights/wake")
    ),
    "`WS /v1/weights`": over_websocket("/v1/weights", _weights, _read_pushed),
    "`WS /v1/weights`, scope `weights`": _with_scope(
        "weights", over_websocket("/v1/weights", _weights, _read_pushed)
    ),
    "`GET /live`": over_http("GET", "/live"),
    "`GET /v1/live`": over_http("GET", "/v1/live"),
    "`GET /v1/live`, scope `watch`": _with_scope("watch", over_http("GET", "/v1/live")),
    "`POST /v1/live/command`": over_http("POST", "/v1/live/command", document=_press, session=True),
    "`POST /v1/live/command`, scope `operate`": _with_scope(
        "operate", over_http("POST", "/v1/live/command", document=_press, session=True)
    ),
    "`WS /v1/live`": over_websocket("/v1/live", _watch, _read_seen),
    "`WS /v1/live`, scope `watch`": _with_scope(
        "watch", over_websocket("/v1/live", _watch, _read_seen)
    ),
    "own port": over_websocket("own", _stream_message, _read_reply),
    "own port, HTTP reset": over_http("POST", "/v1/reset", document=_reset, own=True),
    "own port, HTTP act": over_http("POST", "/v1/act", document=_act, session=True, own=True),
    "own port, another path": over_websocket("own/x", _stream_message, _read_reply),
    "shared memory": over_shm,
    "GR00T's gateway, replica on its host": over_gr00t(True),
    "GR00T's gateway, replica on another": over_gr00t(False),
    "vlagents' gateway, `without_key: true`": over_vlagents,
    "LeRobot's gateway, `without_key: true`": over_lerobot,
    "LeRobot's remote inference, `without_key: true`": over_lerobot_remote,
    "Serve handle (`serve://`)": over_handle,
    "plasma (`serve://`)": over_plasma,
}
