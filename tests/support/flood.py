"""A keyed replica in a separate process, and one that floods it.

`flood.py serve`, `flood.py haproxy PORT`, `flood.py gateways`, `flood.py page`, and `flood.py
attacks`.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import itertools
import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import asdict, astuple, dataclass
from functools import cache, partial
from http.client import HTTPConnection
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import grpc
import hostile_images
import numpy as np
import pytest
import rpyc_client
from api_key_replica import plasma_server
from asgi_server import served
from dialect_server import ALL, METADATA, xpolicylab
from eval_fakes import wait_for
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Receive, Scope, Send
from websockets.client import ClientProtocol
from websockets.extensions.permessage_deflate import ClientPerMessageDeflateFactory
from websockets.protocol import State
from websockets.uri import parse_uri

from benchmarks.processes import cpu_seconds
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.shm import ShmTransport
from vlagents_ray.client.transports.websocket import Stream
from vlagents_ray.errors import MalformedMessage, PolicyUnavailable
from vlagents_ray.images import jpeg_png
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol import frame_layout
from vlagents_ray.protocol.frames import CONTENT_TYPE, decode_replies, encode_requests
from vlagents_ray.protocol.messages import LocalAddress, MessageLimits, Op, PlasmaAddress, Request
from vlagents_ray.protocol.websocket_frames import frame_head
from vlagents_ray.registry import dialect_class
from vlagents_ray.serve.access.api_keys import Keys, NoKey
from vlagents_ray.serve.config.dialects import DialectArgs
from vlagents_ray.serve.dialects.base import GatewayContext, ReplicaContext, dialect_routes
from vlagents_ray.serve.endpoints import http_connection
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.front import FrontMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.endpoints.plasma import PlasmaServer
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.engine.admission import Admission
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.launch.haproxy import haproxy_binary, ingress_environment
from vlagents_ray.serve.ports import free_port, reserve
from vlagents_ray.wire import json_numpy
from vlagents_ray_dialects import gr00t, vlagents
from vlagents_ray_dialects import lerobot as lerobot_dialect
from vlagents_ray_dialects.messages import gr00t as gr00t_wire
from vlagents_ray_dialects.messages import lerobot, rpyc, zmtp
from vlagents_ray_dialects.messages import openpi as openpi_codec
from vlagents_ray_dialects.messages import vla_eval as vla_eval_codec
from vlagents_ray_live.live_page import page_server
from vlagents_ray_live.live_view import Fleet

HEIGHT, WIDTH = 2304, 4096  # of the largest image
GATEWAYS_IN_FLIGHT = 256 * 2**20  # bytes; a key or an address may take half of it
IMAGES = 4  # images of these in the largest request
SLOW_S = 6.0  # time in which a message must arrive
# Time after which a silent client ends: over that of all rows, between which a robot is silent.
IDLE_S = 7200.0
UNIX = socket.AF_UNIX, socket.SOCK_SEQPACKET


class _Policy(Agent):
    def act(self, obs: Obs) -> Act:
        return Act(np.zeros(8, np.float32))


def _key(name: str, **limits: Any) -> dict[str, Any]:
    return {"name": name, "sha256": hashlib.sha256(name.encode()).hexdigest(), **limits}


def key_of(endpoint: str) -> str:
    """Return the key of the client that floods an endpoint, which is also the key's name."""
    return f"endpoint-{[*MESSAGE_FLOODS, *GATEWAYS, *PAGES, *HTTP, PLASMA].index(endpoint)}"


def serve() -> None:
    """Say where it is, as JSON, and serve until the standard input ends."""
    # Without a priority, which is the default of `keys create`: their messages have robots' rights.
    rated = [_key(key_of(endpoint), rate=1) for endpoint in (*MESSAGE_FLOODS, *HTTP)]
    keys = Keys.from_text(json.dumps({"keys": [_key("robot"), *rated]}))
    check_key, limits = partial(keys.check, app="app"), MessageLimits()
    engine = Engine(_Policy(), EngineSettings(session_idle_s=IDLE_S))
    own = OwnPortServer(engine, limits, "127.0.0.1", None, check_key, slow_s=SLOW_S, idle_s=IDLE_S)
    near = ShmServer(engine, limits, check_key)
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        plasma = plasma_server(engine, limits, patch, Path(folder))
        plasma.pool.claim = _claim
        _serve_replica(engine, keys, own, near, plasma)


class _LeasedChannel:
    """A channel in this process, leased to the client that names it; see `LEASED`."""

    capacity = 2**20

    def __init__(self, key: bytes) -> None:
        self.ref = SimpleNamespace(binary=lambda: key)
        self._content = LEASED[key]

    def read(self) -> np.ndarray:
        """Return a copy of what the client wrote."""
        if self._content is None:
            raise MalformedMessage(
                "plasma: expected a frame in the channel of the message, got none"
            )
        return np.frombuffer(self._content, np.uint8).copy()


def _claim(key: bytes) -> _LeasedChannel:
    if key not in LEASED:
        raise MalformedMessage("plasma: this channel is not leased; request a channel first")
    return _LeasedChannel(key)


def _serve_replica(
    engine: Engine, keys: Keys, own: OwnPortServer, near: ShmServer, plasma: PlasmaServer
) -> None:
    limits = MessageLimits()
    for endpoint in (own, near, plasma):
        endpoint.open()
    engine.start()
    routes = dialect_routes(DialectArgs(**ALL), ReplicaContext(engine, lambda: METADATA, limits))
    inside = build_http_app(engine, lambda: METADATA, limits, more=routes)
    guarded = AccessMiddleware(
        inside, keys, "app", slow_s=SLOW_S, idle_s=IDLE_S, admission=engine.admission
    )
    with served(_with_health_check(FrontMiddleware(guarded))) as port, _haproxy(port) as proxied:
        found = {
            "port": port,
            "proxied": proxied,
            "own": [own.address.port, own.path],
            "local": asdict(near.address),
            "plasma": plasma.plasma.socket,
        }
        print(json.dumps(found), flush=True)
        sys.stdin.read()
    engine.close()
    for endpoint in (own, near, plasma):
        endpoint.close()


def _with_health_check(app: ASGIApp) -> ASGIApp:
    """Answer HAProxy's health check, as Serve does."""

    async def run(scope: Scope, receive: Receive, send: Send) -> None:
        is_check = scope["type"] == "http" and scope["path"] == "/-/healthz"
        await (PlainTextResponse("success") if is_check else app)(scope, receive, send)

    return run


@contextlib.contextmanager
def _haproxy(replica: int) -> Iterator[int]:
    """The port of HAProxy in front of a replica's port; 0 if it is not installed."""
    if haproxy_binary() is None:
        yield 0
        return
    with child("haproxy", str(replica)) as process:
        port: int = json.loads(process.stdout.readline())["port"]  # type: ignore[union-attr]
        yield port


def serve_haproxy(replica: int) -> None:
    """Run HAProxy with the settings that Serve writes, in front of a replica's port; print its
    own port as JSON.
    """
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        folder, port = Path(name), free_port()
        # Serve reads it when it is imported.
        os.environ.update(ingress_environment(folder, str(haproxy_binary())))
        from ray.serve._private.haproxy import (
            BackendConfig,
            HAProxyApi,
            HAProxyConfig,
            ServerConfig,
            get_haproxy_binary,
        )
        from ray.serve.config import HTTPOptions

        replicas = [ServerConfig("SERVE_REPLICA_app-Policy-1", "127.0.0.1", replica)]
        backend = BackendConfig("http-app", "/", servers=replicas, app_name="app")
        config = HAProxyConfig(
            http_options=HTTPOptions(host="127.0.0.1", port=port),
            has_received_routes=True,
            has_received_servers=True,
        )
        api = HAProxyApi(config, {"app": backend})
        api._generate_config_file_internal()
        with subprocess.Popen(
            [get_haproxy_binary(), "-db", "-f", api.config_file_path, "-dR"]
        ) as proxy:
            wait_for(lambda: _is_healthy(port), 30)
            print(json.dumps({"port": port}), flush=True)
            sys.stdin.read()
            proxy.terminate()


def _is_healthy(port: int) -> bool:
    """Return whether HAProxy's health check finds the replica."""
    with contextlib.closing(HTTPConnection("127.0.0.1", port, timeout=5)) as connection:
        try:
            connection.request("GET", "/-/healthz")
            return connection.getresponse().status == 200
        except OSError:
            return False


def _no_replica(*_: object) -> RemoteAgent:
    raise PolicyUnavailable("there is no replica")


def serve_gateways() -> None:
    """Serve the dialects with their own port, without a replica; print their ports as JSON."""
    rated = [_key(key_of(endpoint), rate=1) for endpoint in GATEWAYS]
    keys = Keys.from_text(json.dumps({"keys": [_key("robot"), *rated]}))
    limits = MessageLimits()
    gr00t._MESSAGE_S = vlagents._FRAME_S = lerobot_dialect._UPLOAD_S = SLOW_S
    dialects, ports = [], {}
    for name, check in (
        ("gr00t", partial(keys.check, app="app")),
        ("vlagents", NoKey.OPEN),
        ("lerobot", NoKey.OPEN),
    ):
        admission = Admission(GATEWAYS_IN_FLIGHT)
        context = GatewayContext("app", _no_replica, limits, 100, IDLE_S, None, check, admission)
        cls = dialect_class(name)
        listener = reserve(name, "127.0.0.1", 0)
        ports[name] = listener.getsockname()[1]
        dialect = cls(name, cls.Config(), context)
        dialect.serve(listener)
        dialects.append(dialect)
    print(json.dumps({"gateways": ports}), flush=True)
    sys.stdin.read()
    for dialect in dialects:
        dialect.close()


def serve_page() -> None:
    """Serve the live page of an evaluation; print its port as JSON."""
    rated = [_key(key_of(endpoint), rate=1, scopes=["watch"]) for endpoint in PAGES]
    keys = Keys.from_text(json.dumps({"keys": [_key("robot", scopes=["watch"]), *rated]}))
    fleet = Fleet(None, extra=dict)
    with page_server(fleet, ("127.0.0.1", 0), keys, name="app", videos=lambda _: None) as url:
        print(json.dumps({"port": urlsplit(url).port, "own": [0, ""]}), flush=True)
        sys.stdin.read()


def _jpeg() -> bytes:
    """Of the largest image, so that the largest request fits into a WebSocket's message."""
    pixels = np.random.default_rng(0).integers(0, 255, (HEIGHT // 8, WIDTH // 8, 3), np.uint8)
    return jpeg_png.encode_jpeg(np.repeat(np.repeat(pixels, 8, 0), 8, 1), 60, "420")


def _frame(op: str = "reset") -> bytes:
    seen = [{"cameras": {"front": {"$": ["img", i]}}} for i in range(IMAGES)]
    return b"".join(
        frame_layout.pack({"op": op, "obs": seen[0], "history": seen[1:]}, [_jpeg()] * IMAGES)
    )


def _header() -> bytes:
    """Many values in the header, none of which is ever read for a key over its rate."""
    numbers = ",".join(["1.2345678901234"] * 900_000)
    return _assembled(f'{{"op":"act","obs":{{"info":{{"x":[{numbers}]}}}},"blobs":[]}}')


def _allowed_header() -> bytes:
    """The longest header with the most values that a server parses."""
    text = "\\u00e9" * 140_000
    numbers = ",".join(["1"] * (frame_layout.VALUES - 20))
    return _assembled(
        f'{{"op":"act","obs":{{"info":{{"t":"{text}","x":[{numbers}]}}}},"blobs":[]}}'
    )


def _names() -> bytes:
    cameras = ",".join(f'"{i:06d}":{{"$":["img",0]}}' for i in range(400_000))
    return _assembled(f'{{"op":"act","obs":{{"cameras":{{{cameras}}}}},"blobs":[]}}')


def _blobs() -> bytes:
    return _assembled(f'{{"op":"act","obs":{{}},"blobs":[{",".join(["0"] * 7_000_000)}]}}')


def _history() -> bytes:
    seen = ",".join(['{"state":{"a":{"$":["nd",0,"<f4",[1]]}}}'] * 300_000)
    return _assembled(f'{{"op":"reset","obs":{{}},"history":[{seen}],"blobs":[4]}}') + bytes(4)


def _assembled(header: str) -> bytes:
    return b"".join(frame_layout.assemble(header, []))


def _raw_frame() -> bytes:
    size = 2304 * 2400 * 3
    node = {"cameras": {"front": {"$": ["nd", 0, "|u1", [2304, 2400, 3]]}}}
    return b"".join(frame_layout.pack({"op": "reset", "obs": node}, [bytes(size)]))


def _hostile(recipe: hostile_images.PngRecipe | hostile_images.JpegRecipe, number: int) -> bytes:
    """A message of `number` files that take as long as their structure may."""
    seen = [{"cameras": {"front": {"$": ["img", index]}}} for index in range(number)]
    header = {"op": "reset", "obs": seen[0], "history": seen[1:]}
    return b"".join(frame_layout.pack(header, [recipe.file()] * number))


def _probe() -> bytes:
    return b"VLA?\0\0\0\0" + _frame()


def _map(**more: Any) -> bytes:
    both = {
        "observation/image": np.zeros((2304, 2300, 3), np.uint8),
        "observation/wrist_image": np.zeros((8, 8, 3), np.uint8),
    }
    return openpi_codec.encode({**both, "observation/state": np.zeros(8), "prompt": "x", **more})


def _of_vla_eval() -> bytes:
    image = {"__image__": True, "format": "jpeg", "data": _jpeg(), "shape": [HEIGHT, WIDTH, 3]}
    seen = {"images": {f"camera{i}": image for i in range(IMAGES)}, "task_description": "x"}
    return vla_eval_codec.encode(vla_eval_codec.VlaEvalMessage("observation", seen, 1))


def _form() -> bytes:
    parts = [b'--X\r\nContent-Disposition: form-data; name="obs"\r\n\r\n{}\r\n']
    for i in range(IMAGES):
        head = f'--X\r\nContent-Disposition: form-data; name="cameras.{i}"; filename="a"\r\n\r\n'
        parts += [head.encode(), _jpeg(), b"\r\n"]
    return b"".join(parts) + b"--X--\r\n"


def _of_openvla() -> bytes:
    return json_numpy.dumps(
        {"image": np.zeros((HEIGHT, WIDTH, 3), np.uint8), "instruction": "x"}
    ).encode()


def _of_sglang() -> bytes:
    images = {f"camera{i}": np.zeros((2304, 1150, 3), np.uint8) for i in range(2)}
    seen = {"images": images, "state": np.zeros(8)}
    return openpi_codec.encode({"input": {"prompt": "x", "observation": seen}})


def _of_xpolicylab() -> bytes:
    vision = {f"cam_{i}": {"color": np.frombuffer(_jpeg(), np.uint8)} for i in range(IMAGES)}
    return xpolicylab("infer", observation={"vision": vision, "state": {}, "instruction": "x"})


Where = dict[str, Any]
Attack = Callable[[bytes, Where, str, float], None]


def _drain(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while connection.recv(65536):
            pass


def address_of(path: str, where: Where) -> tuple[int, str]:
    """The port and the path of a WebSocket; "own" is that of the replica's own port."""
    return (where["own"][0], where["own"][1]) if path == "own" else (where["port"], path)


@contextlib.contextmanager
def connected(path: str, where: Where) -> Iterator[socket.socket]:
    """A connection before its handshake."""
    with socket.create_connection(
        ("127.0.0.1", address_of(path, where)[0]), timeout=5
    ) as connection:
        yield connection


@contextlib.contextmanager
def opened(path: str, where: Where, key: str) -> Iterator[tuple[socket.socket, bytes]]:
    """A WebSocket, which offers compression, and the answer to its handshake; `OSError` if it is
    rejected.
    """
    port, place = address_of(path, where)
    with connected(path, where) as connection:
        protocol = ClientProtocol(
            parse_uri(f"ws://127.0.0.1:{port}{place}"),
            extensions=[ClientPerMessageDeflateFactory(client_max_window_bits=True)],
        )
        request = protocol.connect()
        request.headers["authorization"] = f"Bearer {key}"
        protocol.send_request(request)
        connection.sendall(b"".join(protocol.data_to_send()))
        answered = b""
        while protocol.state is State.CONNECTING and (answer := connection.recv(65536)):
            protocol.receive_data(answer)
            answered += answer
        if protocol.state is not State.OPEN:
            raise ConnectionRefusedError(answered[:100])
        yield connection, answered


def _websocket(path: str) -> Attack:
    def attack(message: bytes, where: Where, key: str, end: float) -> None:
        # A mask of zeros.
        head = bytes([0x82, 0x80 | 127]) + struct.pack(">Q", len(message)) + bytes(4)
        with opened(path, where, key) as (connection, _):
            threading.Thread(target=_drain, args=(connection,), daemon=True).start()
            while (left_s := end - time.monotonic()) > 0:
                connection.settimeout(left_s)
                connection.sendall(head)
                connection.sendall(message)

    return attack


def _post(path: str, kind: str) -> Attack:
    def attack(content: bytes, where: Where, key: str, end: float) -> None:
        head = (
            f"POST {path} HTTP/1.1\r\nhost: localhost\r\nauthorization: Bearer "
            f"{key}\r\nx-session-id: s\r\n"
            f"content-type: {kind}\r\ncontent-length: {len(content)}\r\n\r\n"
        ).encode()
        with socket.create_connection(("127.0.0.1", where["port"]), timeout=5) as connection:
            while time.monotonic() < end:
                connection.sendall(head)
                connection.sendall(content)
                if not connection.recv(65536):
                    return

    return attack


@cache
def _memory_file(message: bytes) -> int:
    descriptor = os.memfd_create("flood", os.MFD_ALLOW_SEALING)
    os.ftruncate(descriptor, len(message))
    os.pwrite(descriptor, message, 0)
    fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
    return descriptor


def _shared_memory(message: bytes, where: Where, key: str, end: float) -> None:
    with socket.socket(*UNIX) as connection:
        connection.connect("\0" + where["local"]["socket"])
        connection.send(key.encode())
        descriptor = _memory_file(message)
        threading.Thread(target=_drain, args=(connection,), daemon=True).start()
        head = LocalAddress.REQUEST.pack(0, 0, len(message))
        socket.send_fds(connection, [head], [descriptor])
        # blocking, as poll() calls such a socket writable while its peer reads nothing.
        while time.monotonic() < end:
            connection.send(head)


# By endpoint: its largest message, and how a client sends that again and again.
MESSAGE_FLOODS: dict[str, tuple[Callable[[], bytes], Attack]] = {
    "own port": (_frame, _websocket("own")),
    "own port, raw": (_raw_frame, _websocket("own")),
    "own port, probes": (_probe, _websocket("own")),
    "WS /v1/stream": (_frame, _websocket("/v1/stream")),
    "WS /v1/stream, probes": (_probe, _websocket("/v1/stream")),
    "WS /openpi": (_map, _websocket("/openpi")),
    "WS /roboarena": (partial(_map, endpoint="infer", session_id="a"), _websocket("/roboarena")),
    "WS /vla-eval": (_of_vla_eval, _websocket("/vla-eval")),
    "WS /xpolicylab": (_of_xpolicylab, _websocket("/xpolicylab")),
    "POST /v1/reset, form": (_form, _post("/v1/reset", "multipart/form-data; boundary=X")),
    "POST /v1/reset, frame": (_frame, _post("/v1/reset", CONTENT_TYPE)),
    "POST /act": (_of_openvla, _post("/act", "application/json")),
    "POST /v1/actions/generations": (
        _of_sglang,
        _post("/v1/actions/generations", "application/msgpack"),
    ),
    "WS /v1/actions/realtime": (_of_sglang, _websocket("/v1/actions/realtime")),
    "shared memory": (_frame, _shared_memory),
}


PARTS: dict[str, Callable[[], bytes]] = {
    "header": _header,
    "allowed header": _allowed_header,
    "names": _names,
    "blobs": _blobs,
    "history": _history,
    # As many as are decoded by the thread that reads them, and as many as a request may have.
    "some worst JPEG": partial(_hostile, hostile_images.WORST["JPEG"], 60),
    "many worst JPEG": partial(_hostile, hostile_images.WORST["JPEG"], 256),
    "some worst PNG": partial(_hostile, hostile_images.WORST["PNG"], 21),
    "many worst PNG": partial(_hostile, hostile_images.WORST["PNG"], 256),
    "progressive JPEG": partial(_hostile, hostile_images.JpegRecipe(process=0xC2, scans=98), 256),
}
"""The largest message in each part of the grammar of a frame; "images" is the largest that each
endpoint takes.
"""
# The endpoints that take a frame.
FRAMES = ("own port", "WS /v1/stream", "POST /v1/reset, frame", "shared memory")


def _masked(first: int, payload: bytes = b"") -> bytes:
    """A client's frame with this first byte, and a mask of zeros."""
    return bytes([first]) + frame_head(len(payload), bytes(4))[1:] + payload


@cache
def _bomb() -> bytes:
    """A compressed message: 16 kB of 16 MiB."""
    compressor = zlib.compressobj(9, zlib.DEFLATED, -12)
    return (compressor.compress(bytes(16 * 2**20 - 64)) + compressor.flush(zlib.Z_SYNC_FLUSH))[:-4]


HANDSHAKE = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\n"
# The limits of a head: its size, and its fields, of which a handshake here has five more.
_HEAD, _FIELDS = http_connection.HEAD_BYTES, http_connection.MOST_FIELDS - 5


def _head(name: str, first: bytes, *fields: bytes) -> bytes:
    """A head of the largest size, in which "%" stands for what fills it up."""
    head = first + b"".join(fields) + b"\r\n"
    gaps = head.count(b"%")
    return head.replace(b"%", name.encode() * max(0, (_HEAD - len(head)) // max(1, gaps)))


# The most expensive heads within these limits, before a key is known.
HEADS: dict[str, bytes] = {
    "short fields": _head("", b"POST / HTTP/1.1\r\n", *[b"a: b\r\n"] * _FIELDS),
    "long names": _head("A", b"POST / HTTP/1.1\r\n", *[b"%: b\r\n"] * _FIELDS),
    "long values": _head("b", b"POST / HTTP/1.1\r\n", *[b"a: %\r\n"] * _FIELDS),
    "a long name": _head("A", b"POST / HTTP/1.1\r\n", b"%: b\r\n"),
    "a long URL": _head("a", b"POST /% HTTP/1.1\r\nhost: x\r\n"),
    "a long URL with a host": _head("a", b"POST http://%/ HTTP/1.1\r\nhost: x\r\n"),
    "almost upgrades": _head(" ", b"GET / HTTP/1.1\r\n", *[b"upgrade:%x\r\n"] * _FIELDS),
    "a long handshake": _head(
        "A", HANDSHAKE + b"Connection: Upgrade\r\n", *[b"%: b\r\n"] * _FIELDS
    ),
    "more fields": _head("", b"POST / HTTP/1.1\r\n", *[b"a: b\r\n"] * 2700),
}
PART_OF_A_MESSAGE = frame_head(15 * 2**20, bytes(4)) + bytes(2 * 2**20)
# What a client sends before it shows a key, and whether it then waits.
BEFORE_A_KEY: dict[str, tuple[bytes, bool]] = {
    "nothing": (b"", True),
    "half a handshake": (HANDSHAKE, True),
    "a refused handshake": (
        HANDSHAKE + b"Connection: Upgrade\r\n" + b"a: b\r\n" * 90 + b"\r\n",
        False,
    ),
    "closed at once": (b"", False),
    **{f"a head: {name}": (head, False) for name, head in HEADS.items()},
}
# What it sends with a key: once, and then it waits; or repeatedly.
ONCE: dict[str, bytes] = {"half a head": b"\x82", "half a message": PART_OF_A_MESSAGE}
REPEATED: dict[str, Callable[[], bytes]] = {
    "pings": lambda: _masked(0x89),
    "pongs": lambda: _masked(0x8A),
    "closes": lambda: _masked(0x88),
    "empty messages": lambda: _masked(0x82),
    "empty texts": lambda: _masked(0x81),
    "fragments": lambda: _masked(0x02) + _masked(0x00) * 100,
    "reserved opcodes": lambda: _masked(0x83),
    "reserved bits": lambda: _masked(0xF2),
    "compressed messages": lambda: _masked(0xC2, _bomb()),
}
DRIPPED = "a message byte by byte"
BEHAVIOURS = [*BEFORE_A_KEY, *ONCE, DRIPPED, *REPEATED]
WEBSOCKETS = {
    endpoint: endpoint.removeprefix("WS ")
    for endpoint in MESSAGE_FLOODS
    if endpoint.startswith("WS ") and "probes" not in endpoint
}
WEBSOCKETS["own port"] = "own"


PAGES = {"page of an evaluation": "/v1/live"}
# What only a viewer of a page sends.
OF_VIEWERS: dict[str, Callable[[], bytes]] = {
    "requests of viewers": lambda: _masked(0x81, b'{"shown": []}')
}


def misbehave(path: str, behaviour: str, where: Where, key: str, end: float) -> None:
    """Behave like that over one connection, until the server ends it, or until the `end`."""
    if behaviour in BEFORE_A_KEY:
        data, waits = BEFORE_A_KEY[behaviour]
        with connected(path, where) as connection:
            connection.sendall(data)
            if waits:
                connection.settimeout(max(0.01, end - time.monotonic()))
                connection.recv(1)
            elif data:
                connection.recv(100)
        return
    with opened(path, where, key) as (connection, _):
        connection.settimeout(max(0.01, end - time.monotonic()))
        if behaviour == DRIPPED:
            connection.sendall(frame_head(2**20, bytes(4)))
            threading.Thread(target=_drain, args=(connection,), daemon=True).start()
            while time.monotonic() < end:
                connection.sendall(b"x")
                time.sleep(0.05)
        elif behaviour in ONCE:
            connection.sendall(ONCE[behaviour])
            _drain(connection)
        else:
            frame = (REPEATED | OF_VIEWERS)[behaviour]()
            payload = frame * max(1, 2**18 // len(frame))
            threading.Thread(target=_drain, args=(connection,), daemon=True).start()
            while time.monotonic() < end:
                connection.sendall(payload)


# Routes behind HAProxy: the replica's own, and a dialect's.
HTTP = {
    "HAProxy, POST /v1/act": ("/v1/act", CONTENT_TYPE),
    "HAProxy, POST /act": ("/act", "application/json"),
}
# Requests at the replica's own port, whose unguessable path takes the place of `_OWN_PATH`.
OWN_HTTP, _OWN_PATH = "own port, HTTP", "/own"
HTTP[OWN_HTTP] = (f"{_OWN_PATH}/act", CONTENT_TYPE)


def _request(endpoint: str, key: str, *fields: str) -> bytes:
    """The head of a request with a key, and further header fields."""
    path, kind = HTTP[endpoint]
    lines = [
        f"POST {path} HTTP/1.1",
        "host: localhost",
        f"authorization: Bearer {key}",
        f"content-type: {kind}",
        "x-session-id: flood",
        *fields,
    ]
    return "\r\n".join([*lines, "", ""]).encode()


def _with_content(endpoint: str, key: str, content: bytes) -> bytes:
    return _request(endpoint, key, f"content-length: {len(content)}") + content


_LARGE = f"content-length: {15 * 2**20}"
_HEADER_FIELD = "a: " + "b" * 1000


@dataclass(frozen=True)
class HttpBehaviour:
    """What a client of HTTP sends over a connection: once, and then a part again and again."""

    once: Callable[[str, str], bytes]  # by the endpoint and the key
    repeated: Callable[[str, str], bytes] = lambda _endpoint, _key: b""
    period_s: float = 0.0  # between two of the repeated parts
    waits: bool = True  # whether the client then waits for the end of the connection


HTTP_BEHAVIOURS = {
    "nothing": HttpBehaviour(lambda _endpoint, _key: b""),
    "closed at once": HttpBehaviour(lambda _endpoint, _key: b"", waits=False),
    "half a head": HttpBehaviour(lambda endpoint, key: _request(endpoint, key)[:-2]),
    "a head byte by byte": HttpBehaviour(
        lambda endpoint, key: _request(endpoint, key)[:-2], lambda _endpoint, _key: b"a", 0.05
    ),
    "a head that is too long": HttpBehaviour(
        lambda endpoint, key: _request(endpoint, key, *[_HEADER_FIELD] * 100)
    ),
    **{
        f"a head: {name}": HttpBehaviour(lambda _endpoint, _key, head=head: head, waits=False)
        for name, head in HEADS.items()
    },
    "requests without a key": HttpBehaviour(
        lambda _endpoint, _key: b"",
        lambda endpoint, _key: _with_content(endpoint, "wrong", b"x") * 100,
        0.01,
    ),
    "large requests without a key": HttpBehaviour(
        lambda endpoint, _key: _request(endpoint, "wrong", _LARGE),
        lambda _endpoint, _key: bytes(2**18),
    ),
    "half a message": HttpBehaviour(
        lambda endpoint, key: _request(endpoint, key, _LARGE) + bytes(2 * 2**20)
    ),
    DRIPPED: HttpBehaviour(
        lambda endpoint, key: _request(endpoint, key, _LARGE), lambda _endpoint, _key: b"x", 0.05
    ),
    "chunks without an end": HttpBehaviour(
        lambda endpoint, key: _request(endpoint, key, "transfer-encoding: chunked"),
        lambda _endpoint, _key: b"1\r\nx\r\n" * 1000,
    ),
    "small requests": HttpBehaviour(
        lambda _endpoint, _key: b"",
        lambda endpoint, key: _with_content(endpoint, key, b"x") * 100,
        0.01,
    ),
    "small requests by reconnects": HttpBehaviour(
        lambda endpoint, key: _with_content(endpoint, key, b"x"), waits=False
    ),
    "a continuation that is awaited": HttpBehaviour(
        lambda endpoint, key: _request(endpoint, key, _LARGE, "expect: 100-continue")
    ),
    "a refused upgrade": HttpBehaviour(
        lambda endpoint, key: _request(endpoint, key, "connection: upgrade", "upgrade: websocket"),
        waits=False,
    ),
}


def misbehave_over_http(endpoint: str, name: str, where: Where, end: float) -> None:
    """Behave like that over one connection to HAProxy, or to the replica's own port, until it
    ends the connection, or until the `end`.
    """
    behaviour, key = HTTP_BEHAVIOURS[name], key_of(endpoint)
    port, path = where["own"] if endpoint == OWN_HTTP else (where["proxied"], _OWN_PATH)

    def at_port(data: bytes) -> bytes:
        return data.replace(f"POST {_OWN_PATH}/".encode(), f"POST {path}/".encode())

    with socket.create_connection(("127.0.0.1", port), timeout=5) as connection:
        connection.settimeout(max(0.01, end - time.monotonic()))
        connection.sendall(at_port(behaviour.once(endpoint, key)))
        repeated = at_port(behaviour.repeated(endpoint, key))
        if repeated:
            threading.Thread(target=_drain, args=(connection,), daemon=True).start()
            while time.monotonic() < end:
                connection.sendall(repeated)
                time.sleep(behaviour.period_s)
        elif behaviour.waits:
            _drain(connection)
        elif name != "closed at once":
            connection.recv(65536)


@contextlib.contextmanager
def http_robot(where: Where) -> Iterator[Callable[[], None]]:
    """An act of a robot over HTTP through HAProxy, in a separate session."""
    headers = {
        "authorization": "Bearer robot",
        "content-type": CONTENT_TYPE,
        "x-session-id": "robot",
    }
    with contextlib.closing(
        HTTPConnection("127.0.0.1", where["proxied"], timeout=60)
    ) as connection:

        def send(op: Op) -> None:
            # As clients with a pool of connections do: HAProxy ends one that is idle, as between
            # two rows.
            if connection.sock is not None and select.select([connection.sock], [], [], 0)[0]:
                connection.close()
            connection.request("POST", f"/v1/{op}", encode_requests([Request(op, OBS)]), headers)
            answer = connection.getresponse()
            content = answer.read()
            assert answer.status == 200, content[:500]

        send("reset")
        yield partial(send, "act")


@dataclass(frozen=True)
class Behaviour:
    """What a client of a gateway sends over a connection: once, then a part again and again, or
    byte by byte.
    """

    once: Callable[[str], bytes]  # the first bytes, with a key
    repeated: bytes | Callable[[int], bytes] = b""  # a function gets the number of the repetition
    period_s: float = 0.0  # between two of the repeated parts
    waits: bool = True  # whether the client then waits for the end of the connection


def _zmtp(content: bytes = b"") -> bytes:
    """A DEALER's greeting and READY, and what follows them."""
    ready = b"\x05READY\x0bSocket-Type\x00\x00\x00\x06DEALER"
    return zmtp.GREETING + b"\x04" + bytes([len(ready)]) + ready + content


def _gr00t(key: str, **more: Any) -> bytes:
    return zmtp.write_message(
        [b"", gr00t_wire.pack({"endpoint": "ping", "api_token": key, **more})]
    )


_HALF = b"\x02" + struct.pack(">Q", 60 * 2**20) + bytes(50 * 2**20)
_EMPTY_PARTS = b"\x01\x00" * 2**17
_ZMQ_PING = b"\x04\x07\x04PING\x00\x00"
_HTTP2 = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes(3) + b"\x04" + bytes(5)  # and empty settings
_READY = "Ready"
_OBSERVE = "SendObservations"


def _http2_frame(kind: int, flags: int, stream: int, payload: bytes = b"") -> bytes:
    return (
        len(payload).to_bytes(3, "big") + bytes([kind, flags]) + stream.to_bytes(4, "big") + payload
    )


def _grpc_head(stream: int, method: str, *, is_complete: bool = True) -> bytes:
    """The HEADERS of a request, each as a literal without an index; without its end, another
    frame must follow.
    """
    headers = {
        ":method": "POST",
        ":scheme": "http",
        ":path": f"/{lerobot.SERVICE}/{method}",
        ":authority": "x",
        "content-type": "application/grpc",
        "te": "trailers",  # codespell:ignore te
    }
    fields = b""
    for name, value in headers.items():
        fields += b"\0" + bytes([len(name)]) + name.encode() + bytes([len(value)]) + value.encode()
    return _http2_frame(1, 4 if is_complete else 0, stream, fields)


def _ready(stream: int) -> bytes:
    """A complete request `Ready`."""
    return _grpc_head(stream, _READY) + _http2_frame(0, 1, stream, bytes(5))


def _readies(repetition: int) -> bytes:
    """Fifty complete requests, each on its own stream."""
    return b"".join(
        _ready(stream) for stream in range(100 * repetition + 1, 100 * repetition + 101, 2)
    )


def _part_of_an_observation(repetition: int) -> bytes:
    """Nothing at first, while `Ready` is answered; then 9 kB of a message of 1 MiB; then
    nothing.
    """
    if repetition != 1:
        return b""
    return _grpc_head(3, _OBSERVE) + _http2_frame(0, 0, 3, _GRPC_HALF + bytes(9000))


def _bytes_of_an_observation(repetition: int) -> bytes:
    """The same, and then a byte with each repetition."""
    return _part_of_an_observation(repetition) if repetition < 2 else _http2_frame(0, 0, 3, b"x")


@functools.cache  # otherwise most of the attack is work of the attacker, on the robot's own machine
def _cancelled(repetition: int) -> bytes:
    """Return fifty requests that are cancelled at once."""
    streams = range(100 * repetition + 1, 100 * repetition + 101, 2)
    return b"".join(
        _grpc_head(stream, _READY) + _http2_frame(3, 0, stream, bytes(3) + b"\x08")
        for stream in streams
    )


_GRPC_HALF = b"\0" + struct.pack(">I", 2**20)  # the head of a message of 1 MiB
_HTTP2_PING = b"\x00\x00\x08\x06" + bytes(13)
_HTTP2_SETTINGS = b"\x00\x00\x00\x04" + bytes(5)
_RPYC_HALF = rpyc.HEADER.pack(60 * 2**20, 0) + bytes(50 * 2**20)
_RPYC_PING = rpyc_client.request(1, rpyc.Handler.PING, (2, ()))
UPLOADS = "observations without an end"
_OF_ANY = {
    "nothing": Behaviour(lambda _: b""),
    "closed at once": Behaviour(lambda _: b"", waits=False),
}
GATEWAYS: dict[str, dict[str, Behaviour]] = {
    "gr00t": {
        **_OF_ANY,
        "half a handshake": Behaviour(lambda _: zmtp.GREETING[:40]),
        "a refused handshake": Behaviour(
            lambda _: b"\xff" + bytes(8) + b"\x7f\x01\x05\x00\x00", waits=False
        ),
        "half a message": Behaviour(lambda _: _zmtp(_HALF)),
        "one part of many": Behaviour(lambda _: _zmtp(), _EMPTY_PARTS),
        "parts of a message": Behaviour(
            lambda _: _zmtp(), b"\x03" + struct.pack(">Q", 2**20) + bytes(2**20)
        ),
        "pings": Behaviour(lambda _: _zmtp(), _ZMQ_PING * 1000),
        "messages with a wrong key": Behaviour(lambda _: _zmtp(), _gr00t("wrong") * 10),
        "empty messages": Behaviour(lambda _: _zmtp(), bytes(2) * 1000),
        "half a message, with a key": Behaviour(lambda key: _zmtp(_gr00t(key) + _HALF)),
        "a message byte by byte, with a key": Behaviour(
            lambda key: _zmtp(_gr00t(key) + _HALF[:9]), b"x", 0.05
        ),
        "one part of many, with a key": Behaviour(lambda key: _zmtp(_gr00t(key)), _EMPTY_PARTS),
        "a key over its rate": Behaviour(lambda key: _zmtp(_gr00t(key)), b"key"),
    },
    "vlagents": {
        **_OF_ANY,
        "half a head": Behaviour(lambda _: b"\x00"),
        "half a message": Behaviour(lambda _: _RPYC_HALF),
        "a message byte by byte": Behaviour(lambda _: _RPYC_HALF[: rpyc.HEADER.size], b"x", 0.05),
    },
    "lerobot": {
        **_OF_ANY,
        "half a handshake": Behaviour(lambda _: _HTTP2[:10]),
        "a refused handshake": Behaviour(lambda _: b"GET / HTTP/1.1\r\n\r\n"),
        "pings": Behaviour(lambda _: _HTTP2, _HTTP2_PING * 1000),
        "pings, a few at once": Behaviour(lambda _: _HTTP2, _HTTP2_PING * 100, 0.01),
        "settings": Behaviour(lambda _: _HTTP2, _HTTP2_SETTINGS * 1000),
        "settings, a few at once": Behaviour(lambda _: _HTTP2, _HTTP2_SETTINGS * 100, 0.01),
        "requests": Behaviour(lambda _: _HTTP2, _readies),
        "requests by reconnects": Behaviour(lambda _: _HTTP2 + _readies(0), waits=False),
        "cancelled requests": Behaviour(lambda _: _HTTP2, _cancelled),
        "cancelled requests by reconnects": Behaviour(
            lambda _: _HTTP2 + _cancelled(0), waits=False
        ),
        "half a head": Behaviour(lambda _: _HTTP2 + _grpc_head(1, _READY, is_complete=False)),
        "half a message": Behaviour(lambda _: _HTTP2 + _ready(1), _part_of_an_observation, 0.05),
        "a message byte by byte": Behaviour(
            lambda _: _HTTP2 + _ready(1), _bytes_of_an_observation, 0.05
        ),
        UPLOADS: Behaviour(lambda _: b""),
    },
}


def _upload_without_end(where: Where, end: float) -> None:
    """Send the parts of the largest observation, but the last, as gRPC's flow control takes
    them.
    """

    def parts() -> Iterator[bytes]:
        for _ in range(16):
            # 2 MiB of data, in the middle.
            yield b"\x08\x02\x12" + b"\x80\x80\x80\x01" + bytes(2**21)
        time.sleep(max(0.0, end - time.monotonic()))

    address = f"127.0.0.1:{where['gateways']['lerobot']}"
    options = [("grpc.use_local_subchannel_pool", 1)]  # a connection for each channel
    with (
        grpc.insecure_channel(address, options=options) as channel,
        contextlib.suppress(grpc.RpcError),
    ):
        channel.unary_unary(f"/{lerobot.SERVICE}/{_READY}")(b"", timeout=10)
        channel.stream_unary(f"/{lerobot.SERVICE}/{_OBSERVE}")(
            parts(), timeout=max(0.1, end - time.monotonic())
        )


def misbehave_at_gateway(endpoint: str, name: str, where: Where, end: float) -> None:
    """Behave like that over one connection, until the gateway ends it, or until the `end`."""
    if name == UPLOADS:
        _upload_without_end(where, end)
        return
    behaviour, key = GATEWAYS[endpoint][name], key_of(endpoint)
    repeated = (
        _gr00t(key, data=bytes(4 * 2**20)) if behaviour.repeated == b"key" else behaviour.repeated
    )
    with socket.create_connection(
        ("127.0.0.1", where["gateways"][endpoint]), timeout=5
    ) as connection:
        connection.settimeout(max(0.01, end - time.monotonic()))
        connection.sendall(behaviour.once(key))
        if repeated:
            threading.Thread(target=_drain, args=(connection,), daemon=True).start()
            for repetition in itertools.count():
                if time.monotonic() >= end:
                    break
                connection.sendall(repeated(repetition) if callable(repeated) else repeated)
                time.sleep(behaviour.period_s)
        elif behaviour.waits:
            _drain(connection)


_MEMORY = LocalAddress.REQUEST
# What a process of this user sends to the socket of the shared memory: whether it sends a key
# first, the bytes, and whether it sends them repeatedly.
NEAR: dict[str, tuple[bool, bytes, bool]] = {
    "nothing": (False, b"", False),
    "closed at once": (False, b"", False),
    "wrong keys": (False, b"wrong", True),
    "a long key": (False, bytes(200_000), True),
    "nothing after its key": (True, b"", False),
    "half a head": (True, bytes(_MEMORY.size - 1), True),
    "a file that is not there": (True, _MEMORY.pack(0, 0, 2**20), True),
    "a file that is shorter": (True, _MEMORY.pack(0, 0, 2**20), True),
    "a number without a file": (True, _MEMORY.pack(LocalAddress.FILES + 1, 0, 100), True),
    "many connections": (True, b"", False),
}
PLASMA = "plasma"
_CHANNEL = PlasmaAddress.REQUEST
# The content of the leased channels by their ids; None is a channel without a frame.
LEASED: dict[bytes, bytes | None] = {
    b"empty".ljust(28, b"\0"): None,
    b"garbage".ljust(28, b"\0"): bytes(range(256)) * 4096,
    b"half".ljust(28, b"\0"): _assembled('{"op":"act","obs":{},"blobs":[1048576]}') + bytes(1000),
}
_EMPTY, _GARBAGE, _HALF_FRAME = LEASED
# The same, of a process of this user; the endpoint needs no key. The last five have leased channels,
# which a process of the cluster may.
NEAR_PLASMA: dict[str, tuple[bool, bytes, bool]] = {
    "nothing": (False, b"", False),
    "closed at once": (False, b"", False),
    "half a head": (False, bytes(_CHANNEL.size - 1), True),
    "a long message": (False, bytes(200_000), True),
    "a channel that is not leased": (False, _CHANNEL.pack(bytes(28), 0), True),
    "many connections": (False, b"", False),
    "a leased channel that is held": (False, _CHANNEL.pack(_GARBAGE, 0), False),
    "a leased channel without a frame": (False, _CHANNEL.pack(_EMPTY, 0), True),
    "garbage in a leased channel": (False, _CHANNEL.pack(_GARBAGE, 0), True),
    "half a frame in a leased channel": (False, _CHANNEL.pack(_HALF_FRAME, 0), True),
    "a leased channel that is left": (False, _CHANNEL.pack(_GARBAGE, 0), False),
}
_MANY = 60  # connections of each thread


def misbehave_near(endpoint: str, behaviour: str, where: Where, end: float) -> None:
    """Behave like that at the socket of shared memory or plasma, until the server ends it, or
    until the `end`.
    """
    address = where["plasma"] if endpoint == PLASMA else "\0" + where["local"]["socket"]
    shows_key, message, repeats = (NEAR_PLASMA if endpoint == PLASMA else NEAR)[behaviour]
    with contextlib.ExitStack() as stack:
        for _ in range(_MANY if behaviour == "many connections" else 1):
            connection = stack.enter_context(socket.socket(*UNIX))
            connection.connect(address)
            if shows_key:
                connection.send(key_of(endpoint).encode())
        if behaviour in ("a leased channel that is held", "a leased channel that is left"):
            connection.send(message)
        if behaviour in ("closed at once", "a leased channel that is left"):
            return
        threading.Thread(target=_drain, args=(connection,), daemon=True).start()
        if behaviour == "a file that is shorter":
            socket.send_fds(connection, [message], [_memory_file(bytes(100))])
        while repeats and time.monotonic() < end:
            connection.send(message)
        connection.settimeout(max(0.01, end - time.monotonic()))
        connection.recv(1)


def attack(endpoint: str, part: str, where: Where, connections: int, seconds: float) -> None:
    """Send the largest messages, or misbehave, for so long, as fast as bytes are taken, whatever
    is answered.
    """
    make, send = MESSAGE_FLOODS.get(endpoint, (bytes, _shared_memory))
    end = time.monotonic() + seconds
    has_behaviours = endpoint in GATEWAYS or endpoint in HTTP or endpoint == PLASMA
    is_behaviour = has_behaviours or part in BEHAVIOURS or part in OF_VIEWERS or part in NEAR
    message = b"" if is_behaviour else PARTS.get(part, make)()
    if part in REPEATED:
        REPEATED[part]()  # before it is measured, since the bomb takes time to make

    def flood() -> None:
        while time.monotonic() < end:
            with contextlib.suppress(OSError):  # cut off: once more
                if endpoint in GATEWAYS:
                    misbehave_at_gateway(endpoint, part, where, end)
                elif endpoint in HTTP:
                    misbehave_over_http(endpoint, part, where, end)
                elif endpoint == PLASMA or (endpoint == "shared memory" and part in NEAR):
                    misbehave_near(endpoint, part, where, end)
                elif part in BEHAVIOURS or part in OF_VIEWERS:
                    misbehave((WEBSOCKETS | PAGES)[endpoint], part, where, key_of(endpoint), end)
                else:
                    send(message, where, key_of(endpoint), end)
            time.sleep(0.001)

    if is_at_idle_priority(endpoint):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    run_in_threads(flood, connections, seconds)


def is_at_idle_priority(endpoint: str) -> bool:
    """Return whether the flood of an endpoint only runs when nothing else does.

    An attacker has a machine of its own. Its threads would take the turns of HAProxy, the server
    and the robot, through all of which a request goes: p50 3 -> 15 ms on two cores, of which this
    leaves 4.7 -> 5.1 ms, while the flood takes as much of the cores as before.
    """
    return endpoint in HTTP and endpoint != OWN_HTTP


def run_in_threads(target: Callable[[], None], number: int, seconds: float) -> None:
    """Run a function on so many threads, for at most so long; print when they have begun."""
    end = time.monotonic() + seconds
    threads = [threading.Thread(target=target, daemon=True) for _ in range(number)]
    for thread in threads:
        thread.start()
    print(f"begun {os.getpid()}", flush=True)
    for thread in threads:
        thread.join(max(0.0, end - time.monotonic()))


@dataclass(frozen=True)
class Usage:
    """What a process has used so far."""

    at: float  # on the clock `time.monotonic`, s
    cpu_s: float
    waits: int  # how often its threads have waited

    @classmethod
    def by(cls, pid: int) -> Usage:
        """Return the usage of a process."""
        waits = 0
        for task in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # a thread has ended
                for line in (task / "status").read_text().splitlines():
                    if line.startswith("voluntary_ctxt_switches"):
                        waits += int(line.split()[1])
        return cls(time.monotonic(), cpu_seconds(pid), waits)


@dataclass(frozen=True)
class Load:
    """The CPU time that a flood takes from the cores by itself, which an attacker on another
    machine does not.
    """

    threads: int
    cores: float  # CPU seconds a second, of all threads
    waits_per_s: float  # of all threads
    at_idle_priority: bool

    def burn(self, seconds: float) -> None:
        """Take the same CPU time, without a connection to anything."""
        if self.at_idle_priority:
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        share = min(1.0, self.cores / self.threads)
        period_s = min(1.0, self.threads / max(self.waits_per_s, 1.0))
        hashed = bytes(2**20)
        begun = time.thread_time()
        hashlib.sha256(hashed)
        bytes_per_s = len(hashed) / (time.thread_time() - begun)
        end = time.monotonic() + seconds

        def take_turns() -> None:
            due_s = 0.0  # CPU time that this thread is to take, less what it has taken
            before = time.monotonic()
            while (now := time.monotonic()) < end:
                due_s += share * min(now - before, 0.1)
                before = now
                turn = time.thread_time()
                # Without the GIL, as system calls are.
                size = int(due_s * bytes_per_s)
                while size > 0:
                    hashlib.sha256(memoryview(hashed)[:size])
                    size -= len(hashed)
                used_s = time.thread_time() - turn
                due_s -= used_s
                time.sleep(max(1e-6, period_s * (1 - share)))

        run_in_threads(take_turns, self.threads, seconds)


@contextlib.contextmanager
def child(*args: str) -> Iterator[subprocess.Popen[str]]:
    """This file as a process, which has printed its first line to `stdout`."""
    folders = [
        str(Path(__file__).parents[2]),
        str(Path(__file__).parent),
        os.environ.get("PYTHONPATH", ""),
    ]
    process = subprocess.Popen(
        [sys.executable, __file__, *args],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(folders)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        yield process
    finally:
        if process.stdin is not None:
            process.stdin.close()
        process.wait(30)
        if process.stdout is not None:
            process.stdout.close()


def serve_attacks() -> None:
    """Fork a process for each attack or load that the standard input names, and kill it at the
    next line.

    A separate process for each would import for most of a second.
    """
    for line in iter(sys.stdin.readline, ""):
        kind, arguments, seconds = json.loads(line)
        attacker = os.fork()
        if attacker == 0:
            if kind == "load":
                Load(*arguments).burn(seconds)
            else:
                attack(*arguments, seconds)
            os._exit(0)
        sys.stdin.readline()
        os.kill(attacker, signal.SIGKILL)
        os.waitpid(attacker, 0)
        print("ended", flush=True)


@contextlib.contextmanager
def _running(
    attackers: subprocess.Popen[str], kind: str, arguments: list[Any], seconds: float
) -> Iterator[int]:
    """Run an attack or a load for the length of the context, by the process that `serve_attacks`
    runs in; yields the id of its process.
    """
    assert attackers.stdin is not None
    assert attackers.stdout is not None
    attackers.stdin.write(json.dumps([kind, arguments, seconds]) + "\n")
    attackers.stdin.flush()
    begun, pid = attackers.stdout.readline().split()
    assert begun == "begun"
    try:
        yield int(pid)
    finally:
        attackers.stdin.write("end\n")
        attackers.stdin.flush()
        assert attackers.stdout.readline() == "ended\n"


class RunningAttack:
    """An attack whose load can be measured."""

    def __init__(self, pid: int, endpoint: str, connections: int) -> None:
        self._pid = pid
        self._endpoint = endpoint
        self._connections = connections

    @contextlib.contextmanager
    def measured(self) -> Iterator[list[Load]]:
        """Yield a list, to which the load of the attack within the context is added."""
        loads: list[Load] = []
        before = Usage.by(self._pid)
        yield loads
        after = Usage.by(self._pid)
        elapsed_s = after.at - before.at
        loads.append(
            Load(
                self._connections,
                (after.cpu_s - before.cpu_s) / elapsed_s,
                (after.waits - before.waits) / elapsed_s,
                is_at_idle_priority(self._endpoint),
            )
        )


@contextlib.contextmanager
def attacking(
    attackers: subprocess.Popen[str],
    endpoint: str,
    part: str,
    where: Where,
    connections: int,
    seconds: float = 60.0,
) -> Iterator[RunningAttack]:
    """Attack for the length of the context."""
    with _running(attackers, "attack", [endpoint, part, where, connections], seconds) as pid:
        yield RunningAttack(pid, endpoint, connections)


@contextlib.contextmanager
def loading(attackers: subprocess.Popen[str], load: Load, seconds: float = 60.0) -> Iterator[int]:
    """Take the CPU time of an attack for the length of the context, without the attack; yields the
    id of the process.
    """
    with _running(attackers, "load", list(astuple(load)), seconds) as pid:
        yield pid


IMAGE = np.zeros((224, 224, 3), np.uint8)
OBS = Obs({"front": IMAGE, "wrist": IMAGE.copy()}, state={"joints": np.zeros(7, np.float32)})


@contextlib.contextmanager
def robot(where: Where) -> Iterator[ShmTransport]:
    """A robot of the replica, in a session."""
    transport = ShmTransport(LocalAddress(**where["local"]), Credentials("robot"))
    transport.connect(10)
    [reply] = transport.call([Request("reset", OBS)], 30)
    assert reply.error is None
    yield transport
    transport.close()


class CameraRobot:
    """A robot with a camera of 1920x1080, which sends JPEG over a WebSocket at 30 Hz."""

    TICK_S = 1 / 30

    def __init__(self, where: Where) -> None:
        """Connect to the replica's own port, and begin a session."""
        pixels = np.random.default_rng(0).integers(0, 255, (135, 240, 3), np.uint8)
        self._file = jpeg_png.encode_jpeg(np.repeat(np.repeat(pixels, 8, 0), 8, 1), 85, "420")
        port, path = where["own"]
        headers = {"authorization": "Bearer robot"}
        self._stream = Stream(urlsplit("http://127.0.0.1"), port, path, 30, headers)
        self._call("reset")

    def _call(self, op: Op) -> None:
        seen = {"cameras": {"front": {"$": ["img", 0]}}}
        self._stream.send(b"".join(frame_layout.pack({"op": op, "obs": seen}, [self._file])), 60)
        [reply] = decode_replies(self._stream.recv(60))
        assert reply.error is None, reply.error

    def acts_ms(self, seconds: float) -> list[float]:
        """Return the durations of the robot's acts, ms, sorted."""
        taken, end = [], time.monotonic() + seconds
        while time.monotonic() < end:
            begun = time.perf_counter()
            self._call("act")
            taken_s = time.perf_counter() - begun
            taken.append(taken_s * 1e3)
            time.sleep(max(0.0, self.TICK_S - taken_s))
        return sorted(taken)

    def close(self) -> None:
        """End the session."""
        self._stream.close()


def acts_ms(robot: ShmTransport, seconds: float) -> list[float]:
    """Return how long a robot's acts took, sorted, one each 10 ms."""

    def act() -> None:
        [reply] = robot.call([Request("act", OBS)], 60)
        assert reply.error is None

    return times_ms(act, seconds)


def times_ms(call: Callable[[], object], seconds: float) -> list[float]:
    """Return how long a robot's calls took, sorted, one each 10 ms."""
    taken, end = [], time.monotonic() + seconds
    while time.monotonic() < end:
        begun = time.perf_counter()
        call()
        taken.append((time.perf_counter() - begun) * 1e3)
        time.sleep(0.01)
    return sorted(taken)


def percentile(taken: list[float], percent: float) -> float:
    """Return the value below which so many percent of sorted values lie."""
    return taken[int(percent / 100 * len(taken))]


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve()
    elif sys.argv[1] == "haproxy":
        serve_haproxy(int(sys.argv[2]))
    elif sys.argv[1] == "gateways":
        serve_gateways()
    elif sys.argv[1] == "page":
        serve_page()
    else:
        serve_attacks()
