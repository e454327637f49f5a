"""RemoteAgent: a policy somewhere else, used like one in this process."""

from __future__ import annotations

import ipaddress
import time
import uuid
from typing import TYPE_CHECKING, Any, Literal, get_args
from urllib.parse import urlsplit

from vlagents_ray.client.http import http_url
from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, NotReset, PolicyFailed
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.wire.frames import JPEG, RAW, ImageCodec
from vlagents_ray.wire.messages import PROTOCOL_VERSION, Op, Reply, Request

if TYPE_CHECKING:
    from vlagents_ray.client.transport import Transport

TransportName = Literal["auto", "shm", "plasma", "websocket", "http", "handle"]


class RemoteAgent(Agent):
    """A policy on a server, as an `Agent`; one object is one session.

    `url` is `http(s)://HOST:PORT[/APP]`, `ws(s)://…` or, inside a Ray cluster, `serve://APP`.
    `transport` "auto" takes the fastest that there is: shared memory to a server of the same user on
    this machine, else a WebSocket; inside the cluster a plasma channel to a replica on this node, else
    a Serve handle. `agent.transport` says which, once connected.
    `codec` "auto" sends raw pixels to this machine and JPEG to others; "raw", "jpeg" or an
    `ImageCodec` with quality and subsampling force one.

    `connect_timeout_s` is how long `initialize` (called by the first `reset`) waits for a server
    that is still loading; `timeout_s` is how long a `reset` or `act` may take. Nothing is ever
    sent twice: after `ConnectionLost` it is unknown whether the request was executed.
    """

    def __init__(
        self,
        url: str,
        *,
        transport: TransportName = "auto",
        timeout_s: float = 30.0,
        connect_timeout_s: float = 60.0,
        codec: ImageCodec | Literal["auto", "raw", "jpeg"] = "auto",
    ) -> None:
        self.url = url
        self._timeout_s = timeout_s
        self._connect_timeout_s = connect_timeout_s
        self._transport: Transport = _choose(url, transport, codec)
        self._metadata: dict[str, Any] | None = None
        self._contract: Contract | None = None

    @property
    def transport(self) -> str:
        """What carries the requests: "shm", "plasma", "websocket", "http" or "handle"; "auto" until connected."""
        return self._transport.name

    @property
    def metadata(self) -> dict[str, Any]:
        """What the server says of itself: policy, checkpoint, contract, protocol version."""
        if self._metadata is None:
            self.initialize()
        return dict(self._metadata or {})

    @property
    def contract(self) -> Contract | None:
        """The policy's side of the contract; None if it states none."""
        if self._metadata is None:
            self.initialize()
        return self._contract

    def initialize(self) -> None:
        """Connect, waiting for the server to become ready; `PolicyUnavailable` if it does not."""
        if self._metadata is not None:
            return
        metadata = self._transport.connect(self._connect_timeout_s)
        if metadata.get("protocol") != PROTOCOL_VERSION:
            self._transport.close()
            raise ConfigError(
                f"{self.url}: speaks protocol {metadata.get('protocol')}, this client {PROTOCOL_VERSION}; "
                f"upgrade the older of the two"
            )
        contract = metadata.get("contract")
        self._contract = None if contract is None else Contract.from_json(contract)
        self._metadata = metadata

    def reset(
        self,
        obs: Obs,
        instruction: str | None = None,
        *,
        contract: Contract | dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> dict[str, Any]:
        """Begin an episode; `kwargs` reach the policy's `reset`.

        With `contract`, the robot's or env's side, the server compares it with the policy's first
        and raises `ContractMismatch` with every difference.
        """
        self.initialize()
        stated = contract.to_json() if isinstance(contract, Contract) else contract
        reply = self._call("reset", obs, instruction=instruction, kwargs=kwargs, contract=stated)
        return reply.info or {}

    def act(self, obs: Obs) -> Act:
        """The next action, (D,) float32, or chunk of actions, (H, D).

        `act.info["timing"]` holds milliseconds by stage: `queue_ms`, `inference_ms`, `decode_ms`
        and `total_ms` on the server, `round_trip_ms` here.
        """
        begun = time.perf_counter()
        if self._metadata is None:
            raise NotReset("act before reset: this agent has no session; reset first")
        reply = self._call("act", obs)
        if reply.act is None:
            raise PolicyFailed("act: the server's reply holds no action")
        reply.act.info["timing"] = {**reply.timing, "round_trip_ms": (time.perf_counter() - begun) * 1e3}
        return reply.act

    def close(self) -> None:
        """End the session. A later `reset` begins another."""
        self._transport.close()
        self._metadata = None

    def _call(self, op: Op, obs: Obs, **fields: Any) -> Reply:
        request = Request(op, obs, request_id=uuid.uuid4().hex, deadline_ms=self._timeout_s * 1e3, **fields)
        reply = self._transport.call(request, self._timeout_s)
        if reply.error is not None:
            raise reply.error
        return reply


def _choose(url: str, transport: str, codec: ImageCodec | str) -> Transport:
    scheme = urlsplit(url).scheme
    if transport not in get_args(TransportName):
        raise ConfigError(f"transport: got {transport!r}, want one of {list(get_args(TransportName))}")
    inside = scheme == "serve"
    if transport in (("http", "websocket") if inside else ("handle", "plasma")):
        raise ConfigError(
            f"transport {transport!r} does not reach {url!r}; 'handle' and 'plasma' go together with serve://APP"
        )
    chosen = _codec(url, codec)
    if transport == "handle":
        from vlagents_ray.client.handle import HandleTransport

        return HandleTransport(urlsplit(url).netloc)
    if transport == "plasma":
        from vlagents_ray.client.plasma import PlasmaTransport

        return PlasmaTransport(urlsplit(url).netloc)
    if transport == "http":
        from vlagents_ray.client.http import HttpTransport

        return HttpTransport(url, chosen)
    if transport == "websocket":
        from vlagents_ray.client.websocket import WebSocketTransport

        return WebSocketTransport(url, chosen)
    if not inside:
        http_url(url)  # raises for what is no URL of ours, before anything is tried
    from vlagents_ray.client.auto import AutoTransport

    return AutoTransport(url, chosen, only_shm=transport == "shm")


def _codec(url: str, codec: ImageCodec | str) -> ImageCodec:
    if isinstance(codec, ImageCodec):
        return codec
    if codec == "auto":
        return RAW if _is_loopback(urlsplit(url).hostname or "") else JPEG
    return ImageCodec(codec)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
