"""A server whose answers a test writes: of the metadata, and of each WebSocket. For what a real server never does."""

from __future__ import annotations

import http
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request as HttpRequest
from websockets.http11 import Response
from websockets.sync.server import ServerConnection, serve

from vlagents_ray.interface import Act
from vlagents_ray.protocol.frames import decode_requests, encode_replies
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, PROTOCOL_VERSION, Budget, Reply, Request

Script = Callable[["Visit"], None]


@dataclass
class Visit:
    """One WebSocket."""

    socket: ServerConnection
    number: int  # of the server's WebSockets, from 0
    requests: list[Request] = field(default_factory=list)

    def request(self) -> Request:
        """The next request; probes are left out."""
        data = self.socket.recv()
        while bytes(data[:4]) == b"VLA?":  # type: ignore[arg-type]
            data = self.socket.recv()
        [request] = decode_requests(data, Budget(DEFAULT_LIMITS)).requests  # type: ignore[arg-type]
        assert isinstance(request, Request), request
        self.requests.append(request)
        return request

    def answer(self, request: Request, **more: Any) -> None:
        self.socket.send(answer(request, **more))

    def watch(self) -> None:
        """Receive, and say nothing, until the client leaves."""
        for _ in self.socket:
            pass

    def raw(self, data: bytes) -> None:
        """Bytes past the WebSocket."""
        self.socket.socket.sendall(data)


def answer(request: Request, **more: Any) -> bytes:
    """A reply: to an act the action [7], if `more` says nothing else."""
    what: dict[str, Any] = {"act": Act(np.array([7.0], np.float32))} if request.op == "act" else {"info": {}}
    return encode_replies([Reply(request_id=request.request_id, **what | more)])


@dataclass
class ScriptedServer:
    port: int = 0
    metadata: dict[str, Any] = field(default_factory=lambda: {"protocol": PROTOCOL_VERSION, "policy": "scripted"})
    refuse: Response | None = None  # what each request gets
    visits: list[Visit] = field(default_factory=list)
    keys: list[str | None] = field(default_factory=list)  # the header `authorization` of each request

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"


def document(status: int, content: dict[str, Any] | str, **headers: str) -> Response:
    """A response with JSON, or with plain text."""
    kind = "text/plain" if isinstance(content, str) else "application/problem+json"
    body = content.encode() if isinstance(content, str) else json.dumps(content).encode()
    more = {name.replace("_", "-"): value for name, value in headers.items()}
    named = {"content-type": kind, "content-length": str(len(body)), "connection": "close", **more}
    return Response(status, http.HTTPStatus(status).phrase, Headers(named), body)


@contextmanager
def scripted_server(script: Script) -> Iterator[ScriptedServer]:
    """Run `script` for each WebSocket, in a thread; one that the client leaves ends quietly."""
    server = ScriptedServer()

    def process_request(_: ServerConnection, request: HttpRequest) -> Response | None:
        server.keys.append(request.headers.get("authorization"))
        if server.refuse is not None:
            return server.refuse
        return document(200, server.metadata) if request.path == "/v1/metadata" else None

    def handle(socket: ServerConnection) -> None:
        visit = Visit(socket, len(server.visits))
        server.visits.append(visit)
        with suppress(ConnectionClosed, OSError):
            script(visit)

    with serve(
        handle, "127.0.0.1", 0, process_request=process_request, compression=None, max_size=None, close_timeout=1
    ) as listening:
        server.port = listening.socket.getsockname()[1]
        thread = threading.Thread(target=listening.serve_forever)
        thread.start()
        try:
            yield server
        finally:
            listening.shutdown()
            for visit in server.visits:
                visit.socket.socket.close()
            thread.join()
