"""A server with the live page, without Ray, and viewers of this page and of the page of a
command.
"""

from __future__ import annotations

import json
import struct
import urllib.error
import urllib.request
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from typing import Any, TypeVar

from asgi_server import served

from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.websocket import ProxiedSocket, open_websocket
from vlagents_ray.interface import Agent
from vlagents_ray.policies.noop import Noop
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, PROTOCOL_VERSION
from vlagents_ray.serve.access.api_keys import Keys
from vlagents_ray.serve.config.parts import PartArgs
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.ports import free_port
from vlagents_ray.serve.replica.part import (
    OtherReplica,
    PartContext,
    ReplicaParts,
    no_siblings,
    open_parts,
)
from vlagents_ray_live.live_view import Fleet, ReplicaView
from vlagents_ray_live.part import LivePart
from vlagents_ray_live.ring import LiveConfig

Part = TypeVar("Part")

METADATA = {
    "policy": "noop",
    "checkpoint": "org/model@4f0c",
    "weights": {"digest": "sampled-sha256:9f2c", "revision": None},
    "policy_version": {
        "newest": {"version": 3, "fingerprint": "ab"},
        "pinned": {"version": 0, "fingerprint": "cd"},
    },
    "version": "0",
    "protocol": PROTOCOL_VERSION,
    "local": None,
    "dialects": {},
}


class Address:
    """A URL in the form in which `browser.Page.open` accepts files."""

    def __init__(self, url: str) -> None:
        self._url = url

    def as_uri(self) -> str:
        return self._url


class LivePage:
    """The page of a running evaluation command."""

    def __init__(self) -> None:
        self.address = f"127.0.0.1:{free_port()}"
        self.url = f"http://{self.address}"

    def document(self) -> dict[str, Any]:
        """Return the data that the page shows; {} while the page does not exist."""
        with (
            suppress(urllib.error.URLError, ConnectionError),
            urllib.request.urlopen(f"{self.url}/v1/live") as answer,
        ):
            found: dict[str, Any] = json.load(answer)
            return found
        return {}

    def evaluation(self) -> dict[str, Any]:
        found: dict[str, Any] = self.document().get("evaluation", {})
        return found

    def steps(self) -> list[int]:
        """Return the training steps in the learning curve."""
        return [
            point["step"]
            for curve in self.evaluation().get("curves", [])
            for point in curve["points"]
        ]

    def text(self) -> bytes:
        with urllib.request.urlopen(f"{self.url}/live") as answer:
            text: bytes = answer.read()
            return text


@dataclass(frozen=True)
class LiveServer:
    engine: Engine
    view: ReplicaView
    fleet: Fleet
    port: int

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def viewer(self, key: str = "") -> closing[ProxiedSocket]:
        """Return a WebSocket that receives the live page's data."""
        return closing(open_websocket(f"ws://127.0.0.1:{self.port}/v1/live", Credentials(key), 10))


@contextmanager
def live_server(
    agent: Agent | None = None,
    keys: Keys | None = None,
    siblings: Callable[[], Awaitable[Sequence[OtherReplica]]] = no_siblings,
    *,
    insecure: bool = False,
    settings: LiveConfig | None = None,
) -> Iterator[LiveServer]:
    """Run a replica of `agent`, by default `noop`, with the parts that are on by default."""
    engine = Engine(agent or Noop.from_config({}))
    engine.start()
    context = PartContext(
        engine,
        "SERVE_REPLICA::app#Policy#this",
        "here",
        lambda: METADATA,
        open_to_network=insecure,
        siblings=siblings,
    )
    parts = open_parts(PartArgs(**({} if settings is None else {"live": settings})), context)
    live = part_of(parts, LivePart)
    inside = build_http_app(engine, lambda: METADATA, DEFAULT_LIMITS, more=list(parts.routes()))
    with ExitStack() as stack:
        stack.callback(parts.close)
        stack.callback(engine.close)
        port = stack.enter_context(
            served(AccessMiddleware(inside, keys, "app", public=parts.pages(inside.routes)))
        )
        yield LiveServer(engine, live.view, live.fleet, port)


def part_of(parts: ReplicaParts, kind: type[Part]) -> Part:
    """Return the only part of that class."""
    [found] = [part for part in parts._parts.values() if isinstance(part, kind)]
    return found


def ask(socket: ProxiedSocket, shown: Sequence[str] = ()) -> tuple[dict[str, Any], list[bytes]]:
    """Request the next message, and return its document and its files."""
    socket.send(json.dumps({"shown": list(shown)}).encode(), 10)
    return read_message(socket.recv(10))


def read_message(data: bytes) -> tuple[dict[str, Any], list[bytes]]:
    [length] = struct.unpack_from("<I", data)
    document, at, files = json.loads(data[4 : 4 + length]), 4 + length, []
    for size in document["files"]:
        files.append(data[at : at + size])
        at += size
    assert at == len(data)
    return document, files
